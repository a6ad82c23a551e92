"""Metering: trips begin no faster than at a commanded rate, or wait.

SUMO gets the trips of a metered city one by one, on the same routes, with the same ids and by the
same seed as without metering. Trips that wait are in the backlog and in the total time spent.
Without a command, PI control holds the accumulation of every region (velocity form, as in ALINEA):

    change_i = KP (n_i(k-1) - n_i(k)) + KI (level n_cr,i - n_i(k))
    r_i(k) = clip(r_i(k-1) + change_i / dt, 0, n_cr,i / FILLING_S)
"""

from collections import deque
from itertools import chain

import numpy as np

from cosim.sumo.recorded_trips import HeldTrips
from cosim.sumo.session import Session
from nmfd.arrays import PerPair, PerRegion

# Shares of the excess vehicles that are kept out in the next control interval [-]; not tuned.
KP = 1.0
KI = 0.3
FILLING_S = 60.0  # in which the largest rate fills a region to its critical accumulation


class Metering:
    """The metered trips of one run.

    Call `command` once per control interval and `play` before every simulation step.

    waited: vehicle -> time that it waited outside [s], of trips that have begun
    """

    def __init__(
        self, session: Session, trips: HeldTrips, critical: PerRegion, *, level: float, step: float
    ):
        """critical: (R,) [veh]; level: set point of the PI control, in these [-]

        step: control interval [s]
        """
        self._session = session
        self._trips = trips
        self._set_point = level * critical
        self._step = step
        self._most = critical / FILLING_S
        # Numbers of the trips that wait in every region, by departure.
        self._queues: list[deque[int]] = [deque() for _ in critical]
        self._due = 0  # number of the next trip that is not due yet
        self.waited: dict[str, float] = {}
        self._rate = self._most.copy()
        self._credit = np.ones(len(critical))  # trips that may begin now
        self._before: PerRegion | None = None

    def command(self, rate: PerRegion | None, accumulation: PerRegion) -> None:
        """Set the largest rate (R,) [veh/s].

        rate: None for PI control of `accumulation` (R,) [veh]
        """
        before = self._before
        if before is None:
            before = accumulation
        if rate is not None:
            self._rate = rate
        else:
            change = KP * (before - accumulation) + KI * (self._set_point - accumulation)
            self._rate = np.clip(self._rate + change / self._step, 0.0, self._most)
        self._before = accumulation

    def play(self) -> None:
        """Let trips begin, as many as the rates allow until now."""
        now = self._session.time
        trips = self._trips
        waiting = np.array([len(queue) > 0 for queue in self._queues])
        while self._due < len(trips.depart) and trips.depart[self._due] <= now:
            self._queues[trips.origin[self._due]].append(self._due)
            self._due += 1
        gained = self._rate * self._session.step_length
        self._credit += gained
        # Fractions of a trip are carried on while trips wait. Without a queue the credit is capped,
        # so that quiet time is not followed by a flood.
        capped = np.minimum(self._credit, np.maximum(1.0, gained))
        self._credit = np.where(waiting, self._credit, capped)
        for region, queue in enumerate(self._queues):
            while queue and self._credit[region] >= 1.0 - 1e-9:
                self._credit[region] -= 1.0
                trip = queue.popleft()
                order = trips.orders[trip]
                self._session.begin_trip(order)
                self.waited[order["vehID"]] = now - trips.depart[trip]

    def backlog(self) -> PerPair:
        """Return (R, R) [veh]: trips from i to j that wait."""
        regions = len(self._queues)
        waiting = np.zeros((regions, regions))
        for region, queue in enumerate(self._queues):
            for trip in queue:
                waiting[region, self._trips.destination[trip]] += 1
        return waiting

    def waiting(self) -> list[tuple[int, float]]:
        """Return region and time [s] at which the trips that wait were due."""
        trips = self._trips
        due = range(self._due, int(np.searchsorted(trips.depart, self._session.time)))
        return [(int(trips.origin[n]), float(trips.depart[n])) for n in chain(*self._queues, due)]
