r"""No control as Sirmatel and Geroliminis (2018) have it: every gate open, and drivers who look at
travel times.

nmfd benchmark seven_region_2018 \
    --controllers no-control,scenarios/seven_region_2018/logit.py:LogitDrivers
"""

from collections.abc import Iterator

import numpy as np

from nmfd import Controls, Observation, PlanningModel

CHOICES = 3  # published: the shortest sequences of regions that a driver chooses from
PER_SECOND = 1 / 60.0  # of travel time: ours, the paper does not say how much drivers care


def sequences(
    adjacency: np.ndarray, here: int, end: int, before: tuple[int, ...] = ()
) -> Iterator[tuple[int, ...]]:
    """All ways from region `here` to `end` through regions that are not in `before`, each with both
    ends."""
    if here == end:
        yield (here,)
        return
    for onward in np.flatnonzero(adjacency[here]):
        if onward not in (here, *before):
            for rest in sequences(adjacency, int(onward), end, (*before, here)):
                yield here, *rest


class LogitDrivers:
    """Of those in i bound for j, a share proportional to exp(-PER_SECOND t) takes each of the
    CHOICES fastest ways.

    t: the sum over the regions of a way of the time that vehicles spend in it now, n / G(n) [s]
    """

    name = "logit-drivers"

    def __init__(self, planning: PlanningModel):
        network = self._network = planning.network
        self._open = np.where(network.adjacency, network.u_max, 0.0)
        pairs = [(i, j) for i in range(network.regions) for j in range(network.regions) if i != j]
        self._ways = {pair: list(sequences(network.adjacency, *pair)) for pair in pairs}
        self._visits = {
            pair: np.array([np.isin(np.arange(network.regions), way) for way in ways], dtype=float)
            for pair, ways in self._ways.items()
        }

    def reset(self, seed: int = 0) -> None:
        """Nothing is remembered."""

    def act(self, observation: Observation) -> Controls:
        """Open gates, and where drivers go."""
        inside = np.maximum(observation.accumulation.sum(axis=1), 0.0)
        spent = np.array(
            [1.0 / mfd.rate(n) for mfd, n in zip(self._network.mfds, inside, strict=True)]
        )
        splits = np.zeros((self._network.regions,) * 3)
        for (i, j), ways in self._ways.items():
            time = self._visits[i, j] @ spent
            fastest = np.argsort(time, kind="stable")[:CHOICES]
            weight = np.exp(-PER_SECOND * (time[fastest] - time[fastest[0]]))
            for way, share in zip(fastest, weight / weight.sum(), strict=True):
                splits[i, ways[way][1], j] += share
        return Controls(perimeter=self._open, splits=splits)
