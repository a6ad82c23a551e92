"""Shares of drivers by next region, and the next region of every driver.

Travel times move the drivers' wishes away from the split ratios without guidance. Theta shifts
these wishes as it does the drivers' own split ratios in the regional model (`shifted`).

Drivers are assigned deterministically, not at random: each takes the next region that costs least,
with a bonus for regions that are behind their share (`assigned`). Random assignment sends drivers
round the far end of a region, and jams a city.
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from cosim.plant.routes import Choices
from nmfd.arrays import PerTurn

SHARE_PENALTY_S = 30.0  # per vehicle that a region is behind its share
LEAST_SHARE = 1e-3  # a region with a smaller share gets no drivers
MEMORY = 0.9  # of the vehicles assigned before and of their wishes, per control interval
Turn: TypeAlias = tuple[int, int, int]  # region, next region, region of destination


class Shares:
    """Drivers by region, next region and destination.

    interval: number of the control interval
    realised: drivers by the last region that each was given, since the start (veh, (R, R, R))
    """

    def __init__(self, own: PerTurn):
        """own: split ratios without guidance (-, (R, R, R))"""
        # Lists by region, destination and next region: a driver needs one row of each.
        self._own = _rows(own)
        self._theta = self._own
        self._wished = _rows(np.zeros(own.shape))
        self._given = _rows(np.zeros(own.shape))
        self.interval = 0
        self.realised = np.zeros(own.shape, dtype=int)

    def command(self, theta: PerTurn) -> None:
        """Begin a control interval with split ratios theta (-, (R, R, R))."""
        self._theta = _rows(theta)
        self._wished = (MEMORY * np.array(self._wished)).tolist()
        self._given = (MEMORY * np.array(self._given)).tolist()
        self.interval += 1

    def next_region(
        self,
        region: int,
        neighbours: Sequence[int],
        destination: int,
        choices: Choices,
        limit: float,
    ) -> int | None:
        """Return which of `neighbours` a driver in `region` gets.

        None if no share is left.

        choices: by each of them; limit: time beyond which a route is too long (s)
        """
        times = [time if time <= limit else math.inf for time in choices.times]
        fastest = neighbours[times.index(min(times))]
        self._wished[region][destination][fastest] += 1.0
        wish = _picked(self._wished[region][destination], neighbours)
        own = _picked(self._own[region][destination], neighbours)
        theta = _picked(self._theta[region][destination], neighbours)
        given = _picked(self._given[region][destination], neighbours)
        wishes = sum(wish)
        shares = shifted([w / wishes for w in wish], own, theta)
        for n, exists in enumerate(choices.exist):
            if not exists:
                shares[n] = 0.0
        total = sum(shares)
        if total <= 0.0:
            return None
        return assigned(times, [share / total for share in shares], given)

    def assign(self, turn: Turn) -> None:
        """Count a driver for a next region."""
        self.realised[turn] += 1
        region, following, destination = turn
        self._given[region][destination][following] += 1.0

    def withdraw(self, turn: Turn, interval: int) -> None:
        """Uncount a driver who was assigned in `interval`."""
        self.realised[turn] -= 1
        region, following, destination = turn
        self._given[region][destination][following] -= MEMORY ** (self.interval - interval)


def shifted(wish: Sequence[float], own: Sequence[float], theta: Sequence[float]) -> list[float]:
    """Return shares (-) that differ from `wish` as `theta` does from `own`.

    A next region that theta lowers loses the same part of its wishes. The regions that theta raises
    get these in proportion to how much it raises them.
    """
    if own == theta:
        return list(wish)
    kept = []
    raised = []
    for w, o, t in zip(wish, own, theta, strict=True):
        kept.append(w * (t / o) if t < o else w)
        raised.append(max(t - o, 0.0))
    freed = sum(wish) - sum(kept)
    total = max(sum(raised), 1e-12)
    return [k + freed * r / total for k, r in zip(kept, raised, strict=True)]


def assigned(times: Sequence[float], shares: Sequence[float], given: Sequence[float]) -> int:
    """Return which next region a driver gets.

    times: by each next region (s), infinite if too long; shares: of the drivers (-)
    given: vehicles assigned before (veh)
    """
    allowed = []
    for n, share in enumerate(shares):
        if share > LEAST_SHARE and times[n] < math.inf:
            allowed.append(n)
    if not allowed:  # every region with a share is too long a detour
        fastest = min(times)
        allowed = [n for n, time in enumerate(times) if time <= fastest]
    count = sum(given) + 1.0
    costs = {}
    for n in allowed:
        behind = shares[n] * count - given[n]
        costs[n] = times[n] - SHARE_PENALTY_S * behind
    return min(costs, key=costs.__getitem__)


def _rows(values: PerTurn) -> list[list[list[float]]]:
    """Return values by region, destination and next region."""
    return np.swapaxes(values, 1, 2).tolist()


def _picked(row: Sequence[float], regions: Sequence[int]) -> list[float]:
    return [row[region] for region in regions]
