"""Standstill: where nothing moves any more, the rest of a run is booked without simulating it.

A city that has locked takes minutes of computing for every hour in which nothing happens. Once every trip is due, what
is left inside or waiting can only leave. Of what left in the last LOOK control intervals, at f [veh/s], the time that
is spent in the remaining t [s] would be less by f t^2 / 2 at most if it went on like that: where this is under ERROR of
the total time spent, everybody is booked as standing where they are until the end. Vehicles on the road go on emitting
what they emit at that moment.
"""

from collections import deque

from nmfd.types import State

LOOK = 4  # control intervals
ERROR = 5e-4  # of the total time spent


class Standstill:
    """Watches the states of one run."""

    def __init__(self, trips: int, step: float, steps: int):
        """trips: that are due until the end; step: control interval [s]; steps: of the run"""
        self._trips, self._step, self._steps = trips, step, steps
        self._left: deque[float] = deque(maxlen=LOOK + 1)  # at the end of the last intervals [veh]
        self._spent = 0.0  # [veh s]

    def reached(self, state: State, left: float) -> bool:
        """Whether the rest may be booked from `state` on, of which all are to be shown in order.

        left: vehicles that ended their trip since the beginning
        """
        inside = float(state.accumulation.sum() + state.backlog.sum())
        self._left.append(left)
        remaining = self._step * (self._steps - state.step)
        booked = self._spent + inside * remaining
        self._spent += inside * self._step
        if len(self._left) <= LOOK or left + inside < self._trips or not inside:
            return False
        leaving = (left - self._left[0]) / (LOOK * self._step)
        return leaving * remaining**2 / 2.0 <= ERROR * booked
