"""Faults of a city to order (nmfd.faults.CITY): a closed street, a signal that takes no programme, SUMO that exits."""

from collections.abc import Sequence

import numpy as np

from cosim.regions import City
from cosim.sumo import Session
from nmfd.errors import InputError
from nmfd.faults import Fault

STANDSTILL = 0.001  # m/s, the speed limit of a closed street: who is on it stands, and soon nobody else gets in


def check(faults: Sequence[Fault], city: City, where: str) -> None:
    """InputError for a fault of an edge or a signal that the city does not have."""
    signals = sorted({gateway.signal for gateway in city.gateways if gateway.signal is not None})
    for fault in faults:
        if fault.kind == "closed" and fault.name not in city.edges:
            raise InputError(f"{where}: closed: edge {fault.name!r} is not in {city.net_file}; name one that cars use")
        if fault.kind == "signal" and fault.name not in signals:
            raise InputError(
                f"{where}: signal: {fault.name!r} is no signal with a gateway movement; choose from "
                f"{', '.join(signals[:8])}{' and others' if len(signals) > 8 else ''}")


class Incidents:
    """The faults of one run; `begin` at the beginning of every control interval, `show` instead of the session's own
    setting of a signal state."""

    def __init__(self, faults: Sequence[Fault], session: Session, city: City):
        self._faults, self._session, self._city = faults, session, city
        self._limits: dict[str, list[float]] = {}  # closed edge -> what its lanes allowed before
        self._silent: set[str] = set()             # signals that take no programme
        self._refused: set[str] = set()            # of this interval
        self.silent_loops = 0.0                    # share of the loop detectors that tell nothing

    @property
    def closed(self) -> np.ndarray:
        """(E,) bool, of the city's edges."""
        return np.array([edge in self._limits for edge in self._city.edges], dtype=bool)

    def begin(self, k: int) -> None:
        """Let what is due happen, and what is over be well again."""
        due = [fault for fault in self._faults if fault.active(k)]
        closed = {fault.name for fault in due if fault.kind == "closed"}
        for edge in closed - self._limits.keys():
            self._limits[edge] = self._session.limit_speed(edge, [STANDSTILL])
        for edge in self._limits.keys() - closed:
            self._session.limit_speed(edge, self._limits.pop(edge))
        silent = {fault.name for fault in due if fault.kind == "signal"}
        for signal in silent - self._silent:
            self._session.restart_programme(signal)
        self._silent, self._refused = silent, set()
        self.silent_loops = max((fault.number for fault in due if fault.kind == "detectors"), default=0.0)
        if any(fault.kind == "sumo-exits" for fault in due):
            self._session.exit_at_next_step()

    def show(self, signal: str, state: str) -> None:
        """Put a state on a signal, or note that it does not take it: its own programme runs on."""
        if signal in self._silent or not self._session.set_signal_state(signal, state):
            self._refused.add(signal)

    def refused(self, signal: str | None) -> bool:
        """Whether it has refused a state in this interval."""
        return signal in self._refused

    def problem(self, *, estimating: bool) -> str:
        """What was wrong in this interval, "" if nothing was. estimating: controllers see what detectors tell"""
        streets = [f"edge {edge} closed" for edge in sorted(self._limits)]
        if estimating and self.silent_loops:
            streets.append(f"{100 * self.silent_loops:g} % of the loop detectors silent")
        return ", ".join([*streets, *(f"signal {signal} took no programme" for signal in sorted(self._refused))])
