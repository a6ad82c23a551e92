"""Metering: trips begin at a commanded rate; who is due beyond that waits outside, first come, first served.

Gates move a queue; what cannot stand inside must stand outside. The trips of a metered city are not given to SUMO
beforehand, but one by one when they may begin: on the same routes, with the same ids and by the same seed as without
metering, be they drawn from a demand between regions or a city's own vehicles. Who waits is in the backlog and in the
total time spent.

Without a command, PI control of the accumulation of every region (velocity form, as in ALINEA and as nmfd's PI gating):

    r_i(k) = clip(r_i(k-1) + (KP (n_i(k-1) - n_i(k)) + KI (level n_cr,i - n_i(k))) / dt,  0, n_cr,i / FILLING)
"""

from collections import deque

import numpy as np

from cosim.sumo.session import Session
from cosim.sumo.trips import HeldTrips
from nmfd.arrays import PerPair, PerRegion

KP, KI = 1.0, 0.3  # of the vehicles too many, those that are kept out in the next control interval [-]; not tuned
FILLING = 60.0  # s, in which the largest rate fills a region to its critical accumulation


class Metering:
    """Lets the trips of one run begin: `command` for every control interval, `play` before every simulation step.

    waited: by those who were let in so far [s]
    """

    def __init__(
        self,
        session: Session,
        trips: HeldTrips,
        critical: PerRegion,
        *,
        level: float,
        step: float,
    ):
        """critical: (R,) [veh]; level: accumulation that PI control holds, in these [-]; step: control interval [s]"""
        self._session, self._trips, self._set_point, self._interval = session, trips, level * critical, step
        self._most = critical / FILLING
        self._queues: list[deque[int]] = [deque() for _ in critical]  # trips by their number, in order of departure
        self._due, self.waited = 0, 0.0
        self._rate, self._credit = self._most.copy(), np.ones(len(critical))
        self._before: PerRegion | None = None

    def command(self, rate: PerRegion | None, accumulation: PerRegion) -> None:
        """rate: (R,) [veh/s], the most trips that may begin in each region; None: by PI control of `accumulation`
        (R,) [veh]."""
        if rate is not None:
            self._rate = rate
        else:
            before = accumulation if self._before is None else self._before
            change = KP * (before - accumulation) + KI * (self._set_point - accumulation)
            self._rate = np.clip(self._rate + change / self._interval, 0.0, self._most)
        self._before = accumulation

    def play(self) -> None:
        """Let begin who is due and may."""
        now, depart, origin = self._session.time, self._trips.depart, self._trips.origin
        while self._due < len(depart) and depart[self._due] <= now:
            self._queues[origin[self._due]].append(self._due)
            self._due += 1
        # What is not used is not saved: after an hour without traffic nobody comes in a flood.
        self._credit = np.minimum(self._credit + self._rate * self._session.step_length, np.maximum(1.0, self._rate))
        for region, queue in enumerate(self._queues):
            while queue and self._credit[region] >= 1.0 - 1e-9:
                self._credit[region] -= 1.0
                trip = queue.popleft()
                self._session.begin_trip(self._trips.orders[trip])
                self.waited += now - depart[trip]

    def backlog(self) -> PerPair:
        """(R, R) [veh]: due to depart from i for j, and made to wait."""
        waiting = np.zeros((len(self._queues),) * 2)
        for region, queue in enumerate(self._queues):
            for trip in queue:
                waiting[region, self._trips.destination[trip]] += 1
        return waiting

    def waiting(self) -> tuple[int, float]:
        """Those who still wait, and how long they have [s]."""
        since = [self._session.time - self._trips.depart[trip] for queue in self._queues for trip in queue]
        return len(since), float(sum(since))
