"""Shares of drivers by next region, and the next region of every driver.

Travel times move the drivers' wishes away from the split ratios without guidance. Theta shifts
these wishes as it does the drivers' own split ratios in the regional model (`shifted`).

Drivers are assigned deterministically, not at random: each takes the next region that costs least,
with a bonus for regions that are behind their share (`assigned`). Random assignment sends drivers
round the far end of a region, and jams a city.
"""

from typing import TypeAlias

import numpy as np
from jaxtyping import Int

from cosim.plant import fastest
from cosim.plant.routes import Choices
from nmfd.arrays import PerTurn

SHARE_PENALTY_S = 30.0  # per vehicle that a region is behind its share
MEMORY = 0.9  # of the vehicles assigned before and of their wishes, per control interval
Turn: TypeAlias = tuple[int, int, int]  # region, next region, region of destination


class Shares:
    """Drivers by region, next region and destination.

    interval: number of the control interval
    realised: drivers by the last region that each was given, since the start (veh, (R, R, R))
    """

    def __init__(self, own: PerTurn):
        """own: split ratios without guidance (-, (R, R, R))"""
        # By region, destination and next region: a driver needs one row of each.
        self._own = _rows(own)
        self._theta = self._own
        self._wished = _rows(np.zeros(own.shape))
        self._given = _rows(np.zeros(own.shape))
        self.interval = 0
        self.realised = np.zeros(own.shape, dtype=int)

    def command(self, theta: PerTurn) -> None:
        """Begin a control interval with split ratios theta (-, (R, R, R))."""
        self._theta = _rows(theta)
        self._wished *= MEMORY
        self._given *= MEMORY
        self.interval += 1

    def next_region(
        self,
        region: int,
        neighbours: Int[np.ndarray, " N"],
        destination: int,
        choices: Choices,
        limit: float,
    ) -> int | None:
        """Return which of `neighbours` a driver in `region` gets.

        None if no share is left.

        choices: by each of them; limit: time beyond which a route is too long (s)
        """
        row = region, destination
        n = fastest.chosen(
            choices.times,
            choices.exist,
            limit,
            neighbours,
            self._wished[row],
            self._own[row],
            self._theta[row],
            self._given[row],
            SHARE_PENALTY_S,
        )
        return None if n == fastest.UNKNOWN else n

    def assign(self, turn: Turn) -> None:
        """Count a driver for a next region."""
        self.realised[turn] += 1
        region, following, destination = turn
        self._given[region, destination, following] += 1.0

    def withdraw(self, turn: Turn, interval: int) -> None:
        """Uncount a driver who was assigned in `interval`."""
        self.realised[turn] -= 1
        region, following, destination = turn
        self._given[region, destination, following] -= MEMORY ** (self.interval - interval)


def _rows(values: PerTurn) -> PerTurn:
    """Return values by region, destination and next region."""
    return np.swapaxes(values, 1, 2).copy()
