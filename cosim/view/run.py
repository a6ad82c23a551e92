"""A run that is watched, in a process of its own: it sends frames through a pipe, and takes orders from there.

The run is that of `cosim run`: it is shown (cosim.plant.observer), and changed by nothing but the gates that somebody
switches, which are ordered faults. It waits at the next look at the streets, a few simulated seconds on.
"""

import queue
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Self

import numpy as np

from cosim.evaluation.simulate import Result, Task, scenario_of, simulate
from cosim.plant.settings import settings
from cosim.sumo.arrays import PerEdge
from cosim.sumo.net import City
from cosim.view.picture import CityPicture, after, between, first
from nmfd.errors import RunFailed
from nmfd.types import Controls, State

ALONE = "nobody watches any more"
RATE = 8.0  # frames per second of wall time within control intervals, at most


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How fast a run may go on: until `until` [s] since its start, with `delay` [s] of wall time per simulated second
    at least."""

    until: float = float("inf")
    delay: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Switch:
    """A gate to be held from the next control interval on at `share` [-] between u_min and u_max; None: let go of."""

    source: int
    target: int
    share: float | None


@dataclass(frozen=True, kw_only=True)
class Switched:
    """What became of a Switch: it holds from control interval `k` on."""

    k: int
    switch: Switch


def run(connection: Connection, pace: Pace, task: Task) -> Result:
    """Run `task`, watched at the other end of `connection`, at first at `pace`. Raises InputError."""
    with connection, Outbox(connection) as outbox:
        return simulate(task, observer=Reporter(task, connection, outbox, pace))


class Outbox:
    """Sends by a thread of its own, so that a run does not wait for somebody who is slow to look."""

    def __init__(self, connection: Connection):
        """connection: of which nobody else sends"""
        self._connection, self._waiting, self._lost = connection, queue.SimpleQueue[object](), False
        self._thread = threading.Thread(target=self._send, daemon=True)

    def put(self, what: object, *, omit: bool = False) -> None:
        """omit: not if something else is still to be sent. RunFailed where nobody is at the other end any more."""
        if self._lost:
            raise RunFailed(ALONE)
        if not omit or self._waiting.empty():
            self._waiting.put(what)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Send what is left."""
        self._waiting.put(None)
        self._thread.join()

    def _send(self) -> None:
        while (what := self._waiting.get()) is not None:
            try:
                self._connection.send(what)
            except OSError:
                self._lost = True
                return


class Reporter:
    """The observer of one run (cosim.plant.observer.Observer)."""

    def __init__(self, task: Task, connection: Connection, outbox: Outbox, pace: Pace):
        """connection: where orders come from; outbox: where frames go; pace: at first"""
        self._connection, self._outbox, self._pace = connection, outbox, pace
        self._scenario = scenario_of(task)
        self._begin = settings(self._scenario).begin
        self._switches: list[Switch] = []
        self._speed: PerEdge | None = None
        self._sent, self._due = 0.0, 0.0

    def began(self, city: City, state: State) -> None:
        """Send the city and the first frame."""
        self._picture = CityPicture.of(self._scenario, city)
        self._state, self._frame = state, first(self._picture, len(city.gateways), state)
        self._time, self._due = 0.0, time.perf_counter()
        self._send(self._picture)
        self._send(self._frame)
        self._wait(0.0)

    def sampled(self, time_: float, vehicles: PerEdge, speed: PerEdge) -> None:
        """Send a frame, if the last one is long enough ago, and wait if need be."""
        now, self._speed = time_ - self._begin, np.where(vehicles > 0, speed, np.nan)
        paused = now >= self._pace.until
        if now < (self._state.step + 1) * self._picture.step - 1e-6:  # the interval's own frame comes in a moment
            if paused or time.perf_counter() - self._sent > 1.0 / RATE:
                self._send(between(self._picture, self._frame, now, vehicles, speed), omit=not paused)
            self._wait(now)

    def recorded(self, controls: Controls, state: State, row: Mapping[str, np.ndarray]) -> None:
        """Send a frame, and wait if need be."""
        spent = float(self._state.unfinished.sum())
        self._frame = after(self._picture, self._frame, spent, controls, state, row, self._speed)
        self._state = state
        self._send(self._frame)
        self._wait(state.time)

    def _send(self, what: object, *, omit: bool = False) -> None:
        self._outbox.put(what, omit=omit)
        self._sent = time.perf_counter()

    def _wait(self, now: float) -> None:
        """Until the run may go on from `now` [s] since the start."""
        self._due = max(self._due + self._pace.delay * (now - self._time), time.perf_counter() - 1.0)
        self._time = now
        try:
            while True:
                left = self._due - time.perf_counter() if now < self._pace.until else None
                if not self._connection.poll(None if left is None else max(left, 0.0)):
                    return
                order = self._connection.recv()
                if isinstance(order, Switch):
                    self._switches.append(order)
                else:
                    self._pace, self._due = order, time.perf_counter()
        except (EOFError, OSError):
            raise RunFailed(ALONE) from None
