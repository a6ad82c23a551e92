"""Judgement of drivers' present routes: which are worth a change.

Drivers keep their route unless the gain is large: every reroute invalidates the travel times used
for others.
"""

import math
from collections.abc import Sequence
from itertools import groupby, pairwise
from typing import NamedTuple

from cosim.plant.routes import TravelTimes
from cosim.sumo.net import City

# Drivers keep their route if another one saves less than this share of its delay, times the delay's
# share of its time.
SWITCHING_THRESHOLD = 0.6
MESO_THRESHOLD = 0.3  # in the mesoscopic model: less than this share of the other's own time
UNKNOWN = -1  # number of an edge closed to cars, or of a move that the city does not have


class Present(NamedTuple):
    """The present route of a driver.

    route: edges by number; None on roads closed to cars
    time: from the end of the first edge (s), infinite if unknown; delay: part of it (s)
    found: a search would find the route
    """

    route: list[int] | None
    time: float = math.inf
    delay: float = math.inf
    found: bool = False

    @property
    def longest(self) -> float:
        """Return the time (s) that no search for faster routes has to exceed."""
        return self.time + 1.0 if self.found else math.inf


class Drivers:
    """Judgement of drivers in one city.

    Routes are short, so lists of times take less time than arrays.
    """

    def __init__(self, city: City, times: TravelTimes, *, ways_return: bool, lanes: bool):
        """ways_return: routes may come back into a region
        lanes: False in the mesoscopic model
        """
        self._number = city.number
        self._region = city.edge_region.tolist()
        self._times = times
        self._free = times.free.tolist()
        self._free_turns = times.free_turns.tolist()
        self._ways_return = ways_return
        self._lanes = lanes

    def present(self, edges: Sequence[str], here: int, time: Sequence[float]) -> Present:
        """Return the present route of a driver on edge `here`.

        edges: names, from the present one on; time: of every edge (s)
        """
        route = [self._number.get(edge, UNKNOWN) for edge in edges]
        if UNKNOWN in route:
            return Present(None)
        if route[0] != here:
            return Present(route)
        times = self._times
        ahead = route[1:]
        moves = [times.move.get(pair, UNKNOWN) for pair in pairwise(route)]
        known = [move for move in moves if move != UNKNOWN]
        found = len(known) == len(moves)
        takes = _total(time, ahead) + _total(times.turn_list, known)
        free = _total(self._free, ahead) + _total(self._free_turns, known)
        if found and not self._ways_return:
            regions = self._regions(route)
            found = regions.count(regions[0]) == 1
        return Present(route, takes, max(takes - free, 0.0), found)

    def time(self, route: list[int], time: Sequence[float]) -> float:
        """Return the time of a route from the end of its first edge (s).

        time: of every edge (s)
        """
        moves = [self._times.move[pair] for pair in pairwise(route)]
        return _total(time, route[1:]) + _total(self._times.turn_list, moves)

    def keeps(self, present: Present, time: float, following: int | None = None) -> bool:
        """Return True if a driver keeps the present route.

        time: of another route (s); following: its next region, None if it has none
        """
        if present.route is None:
            return True
        if math.isinf(present.time):
            return False
        if following is not None and self.next_region(present.route) != following:
            return False
        return time >= self.worth(present)

    def worth(self, present: Present) -> float:
        """Return the time (s) below which another route is worth a change."""
        if not self._lanes or math.isinf(present.time):
            return present.time / (1.0 + MESO_THRESHOLD)
        return present.time - SWITCHING_THRESHOLD * present.delay**2 / max(present.time, 1e-9)

    def next_region(self, route: list[int]) -> int:
        """Return the next region of a route.

        It is the first other region, or with `ways_return` the region after its last exit.
        """
        regions = self._regions(route)
        left = 0
        if self._ways_return:
            for n, region in enumerate(regions):
                if region == regions[0]:
                    left = n
        return regions[min(left + 1, len(regions) - 1)]

    def _regions(self, route: list[int]) -> list[int]:
        return [region for region, _ in groupby(map(self._region.__getitem__, route))]


def _total(times: Sequence[float], numbers: Sequence[int]) -> float:
    """Return the sum of the times with these numbers (s)."""
    return sum([times[number] for number in numbers])
