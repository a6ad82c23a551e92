"""Faults of a city: closed streets, and signals that take no commands."""

from collections.abc import Collection, Sequence

import numpy as np

from cosim.plant.gates import DEFAULT_YELLOW_S
from cosim.sumo.arrays import EdgeMask
from cosim.sumo.net import City
from cosim.sumo.session import Session
from cosim.sumo.signals import GREEN
from nmfd.errors import InputError
from nmfd.faults import Fault

# Speed limit of a closed street: vehicles on it stand, and soon none can enter.
CLOSED_SPEED_M_S = 0.001


def check(faults: Sequence[Fault], city: City, where: str, others: Collection[str] = ()) -> None:
    """Raise InputError for an edge or signal that the city does not have.

    others: signals without a gateway
    """
    signals = {gateway.signal for gateway in city.gateways} | {*others}
    for fault in faults:
        if fault.kind == "closed" and fault.value not in city.edges:
            raise InputError(
                f"{where}: closed: edge {fault.value!r} is not in {city.net_file}; "
                "name one that cars use"
            )
        if fault.kind == "signal" and fault.value not in signals:
            raise InputError(
                f"{where}: signal: {fault.value!r} is no signal that is commanded; "
                "name one at a gateway"
            )


class Incidents:
    """Injected faults of one run.

    All signal states are set through this object, because a fault can block them. A signal that
    stops or starts to obey shows yellow first where it loses a green. Call `begin` at the start of
    every control interval and `play` before every simulation step.
    """

    def __init__(self, faults: Sequence[Fault], session: Session, city: City):
        self._faults = faults
        self._session = session
        self._city = city
        self._limits: dict[str, list[float]] = {}  # closed edge -> speed limits of its lanes before
        self._own: dict[str, str] = {}  # signal -> its programme
        for fault in faults:
            if fault.kind == "signal":
                self._own[fault.value] = session.programme_id(fault.value)
        self._silent: set[str] = set()  # signals that do not obey
        self._failed: set[str] = set()  # signals whose state SUMO refused in this interval
        self._commanded: dict[str, str] = {}  # signal -> last commanded state
        self._yellow_end: dict[str, float] = {}  # signal in transition -> end of its yellow [s]

    @property
    def closed(self) -> EdgeMask:
        """Return (E,) bool, the closed edges of the city."""
        return np.array([edge in self._limits for edge in self._city.edges], dtype=bool)

    @property
    def refused(self) -> set[str]:
        """Return the signals that did not take their states in this interval."""
        return self._failed | (self._silent & self._commanded.keys())

    def begin(self, k: int) -> None:
        """Start the faults of control interval k, and end those that are over."""
        closed = set()
        silent = set()
        for fault in self._faults:
            if not fault.active(k):
                continue
            if fault.kind == "closed":
                closed.add(fault.value)
            elif fault.kind == "signal":
                silent.add(fault.value)
        for edge in closed - self._limits.keys():
            self._limits[edge] = self._session.limit_speed(edge, [CLOSED_SPEED_M_S])
        for edge in self._limits.keys() - closed:
            self._session.limit_speed(edge, self._limits.pop(edge))
        changed = sorted(silent ^ self._silent)
        self._silent = silent
        self._failed = set()
        for signal in changed:
            self._change(signal)

    def play(self, now: float) -> None:
        """End the transitions that are over at `now` [s].

        Call it after everything that shows states.
        """
        for signal, end in list(self._yellow_end.items()):
            if now >= end - 1e-6:
                del self._yellow_end[signal]
                self._change(signal)

    def show(self, signal: str, state: str) -> None:
        """Set the state of a signal, unless it does not obey."""
        self._commanded[signal] = state
        if self._obeys(signal) and not self._session.set_signal_state(signal, state):
            self._failed.add(signal)

    def release(self, signal: str, programme: str) -> None:
        """Let a signal run its own programme again."""
        self._commanded.pop(signal, None)
        if self._obeys(signal):
            self._session.restart_programme(signal, programme)

    def problem(self) -> str:
        """Return what was wrong in this interval, "" if nothing was."""
        problems = [f"edge {edge} closed" for edge in sorted(self._limits)]
        problems += [f"signal {signal} took no programme" for signal in sorted(self.refused)]
        return ", ".join(problems)

    def _obeys(self, signal: str) -> bool:
        return signal not in self._silent and signal not in self._yellow_end

    def _change(self, signal: str) -> None:
        """Switch between own programme and commanded state.

        If a green ends, yellow comes first.
        """
        session = self._session
        shown = session.signal_state(signal)
        target = None if signal in self._silent else self._commanded.get(signal)
        if target is None:
            session.restart_programme(signal, self._own[signal])
            coming = session.signal_state(signal)
        else:
            coming = target
        between = ""
        for light, next_light in zip(shown, coming, strict=True):
            loses_green = light in GREEN and next_light not in GREEN
            between += "y" if loses_green else light
        if between != shown:
            session.set_signal_state(signal, between)
            self._yellow_end[signal] = session.time + DEFAULT_YELLOW_S
        elif target is not None:
            session.set_signal_state(signal, target)
