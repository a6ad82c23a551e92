"""Faults of a city to order (nmfd.faults.CITY): a closed street, a signal that takes no programme, a gate that is held,
SUMO that exits.

Gates may be held by hand, too (`Incidents.hold`), as if that had been ordered.
"""

from collections.abc import Collection, Sequence

import numpy as np

from cosim.plant.perimeter import GREEN, YELLOW
from cosim.sumo.arrays import EdgeMask
from cosim.sumo.net import City
from cosim.sumo.session import Session
from nmfd.arrays import PerPair
from nmfd.errors import InputError
from nmfd.faults import Fault, gate

STANDSTILL = 0.001  # m/s, the speed limit of a closed street: who is on it stands, and soon nobody else gets in


def check(faults: Sequence[Fault], city: City, where: str, others: Collection[str] = ()) -> None:
    """InputError for a fault of an edge or a signal that the city does not have. others: signals besides those with a
    gateway movement that are given states"""
    joined = {(gateway.source, gateway.target) for gateway in city.gateways}
    signals = sorted({gateway.signal for gateway in city.gateways if gateway.signal is not None} | {*others})
    for fault in faults:
        if fault.kind == "closed" and fault.name not in city.edges:
            raise InputError(f"{where}: closed: edge {fault.name!r} is not in {city.net_file}; name one that cars use")
        if fault.kind == "gate" and fault.pair not in joined:
            raise InputError(
                f"{where}: gate: no street leads from region {fault.name.partition('=')[0].replace('-', ' to ')}; "
                f"choose from {', '.join(f'{i}-{h}' for i, h in sorted(joined)[:8])}"
                f"{' and others' if len(joined) > 8 else ''}"
            )
        if fault.kind == "signal" and fault.name not in signals:
            raise InputError(
                f"{where}: signal: {fault.name!r} is no signal with a gateway movement; choose from "
                f"{', '.join(signals[:8])}{' and others' if len(signals) > 8 else ''}"
            )


class Incidents:
    """The faults of one run: `begin` at the beginning of every control interval, `play` before every simulation step,
    `show` instead of the session's own setting of a signal state.

    Where a signal goes deaf, or hears again, what is green there and would be red turns yellow first.
    """

    def __init__(self, faults: Sequence[Fault], session: Session, city: City):
        """faults: of the city, already checked (`check`)"""
        self._faults, self._session, self._city = faults, session, city
        self._gates: dict[tuple[int, int], float] = {}  # that are held, at what share of u_min .. u_max
        self._by_hand: dict[tuple[int, int], float] = {}
        self._limits: dict[str, list[float]] = {}  # closed edge -> what its lanes allowed before
        self._own = {fault.name: session.programme_id(fault.name) for fault in faults if fault.kind == "signal"}
        self._silent: set[str] = set()  # signals that take no programme
        self._refused: set[str] = set()  # signals to which SUMO said no in this interval
        self._wanted: dict[str, str] = {}  # the last state that a signal should have shown
        self._yellow: dict[str, float] = {}  # signal on its way from one to the other -> the end of its yellow
        self.silent_loops = 0.0  # share of the loop detectors that tell nothing

    @property
    def closed(self) -> EdgeMask:
        """(E,) bool, of the city's edges."""
        return np.array([edge in self._limits for edge in self._city.edges], dtype=bool)

    def begin(self, k: int) -> None:
        """Let what is due happen, and what is over be well again."""
        due = [fault for fault in self._faults if fault.active(k)]
        self._gates = {fault.pair: fault.number for fault in due if fault.pair is not None} | self._by_hand
        closed = {fault.name for fault in due if fault.kind == "closed"}
        for edge in closed - self._limits.keys():
            self._limits[edge] = self._session.limit_speed(edge, [STANDSTILL])
        for edge in self._limits.keys() - closed:
            self._session.limit_speed(edge, self._limits.pop(edge))
        silent = {fault.name for fault in due if fault.kind == "signal"}
        changed, self._silent, self._refused = sorted(silent ^ self._silent), silent, set()
        for signal in changed:
            self._change(signal)
        self.silent_loops = max((fault.number for fault in due if fault.kind == "detectors"), default=0.0)
        if any(fault.kind == "sumo-exits" for fault in due):
            self._session.exit_at_next_step()

    def hold(self, source: int, target: int, share: float | None) -> None:
        """From the next control interval on hold the gate from one region to another at a share [-] between u_min and
        u_max; None: let go of it. InputError."""
        if share is None:
            self._by_hand.pop((source, target), None)
            return
        fault = gate(f"{source}-{target}={share:g}", "gate", self._city.regions)
        check([fault], self._city, "gate")
        self._by_hand[source, target] = fault.number

    def gated(self, perimeter: PerPair, low: float, high: float) -> PerPair:
        """(R, R) [-]: u as commanded, but for gates that are held. low, high: bounds of u"""
        if not self._gates:
            return perimeter
        u = np.array(perimeter)
        for pair, share in self._gates.items():
            u[pair] = low + share * (high - low)
        return u

    def play(self, now: float) -> None:
        """End the yellow that is over at `now` [s]; call after all that shows states."""
        for signal in [signal for signal, end in self._yellow.items() if now >= end - 1e-6]:
            del self._yellow[signal]
            self._change(signal)

    def show(self, signal: str, state: str) -> None:
        """Put a state on a signal, or note that it does not take it: its own programme runs on."""
        self._wanted[signal] = state
        if (
            signal not in self._silent
            and signal not in self._yellow
            and not (self._session.set_signal_state(signal, state))
        ):
            self._refused.add(signal)

    def release(self, signal: str, programme: str) -> None:
        """Let a signal show its own programme again, which has run on underneath."""
        self._wanted.pop(signal, None)
        if signal not in self._silent and signal not in self._yellow:
            self._session.restart_programme(signal, programme)

    @property
    def refused(self) -> set[str]:
        """Signals that did not take their states in this interval."""
        return self._refused | (self._silent & self._wanted.keys())

    def problem(self, *, estimating: bool) -> str:
        """What was wrong in this interval, "" if nothing was. estimating: controllers see what detectors tell"""
        streets = [f"edge {edge} closed" for edge in sorted(self._limits)]
        if estimating and self.silent_loops:
            streets.append(f"{100 * self.silent_loops:g} % of the loop detectors silent")
        streets += [f"gate {i}-{h} held at {share:g}" for (i, h), share in sorted(self._gates.items())]
        return ", ".join([*streets, *(f"signal {signal} took no programme" for signal in sorted(self.refused))])

    def _change(self, signal: str) -> None:
        """From what it shows to its own programme, or back to what it should show; through yellow if need be."""
        session, shown = self._session, self._session.signal_state(signal)
        alone = signal in self._silent or signal not in self._wanted
        if alone:
            session.restart_programme(signal, self._own[signal])
            target = session.signal_state(signal)
        else:
            target = self._wanted[signal]
        losing = [a in GREEN and b not in GREEN for a, b in zip(shown, target, strict=True)]
        if any(losing):
            session.set_signal_state(signal, "".join("y" if lost else a for lost, a in zip(losing, shown, strict=True)))
            self._yellow[signal] = session.time + YELLOW
        elif not alone:
            session.set_signal_state(signal, target)
