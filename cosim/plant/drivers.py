"""Judgement of drivers' present routes: which are worth a change.

Drivers keep their route unless the gain is large: every reroute invalidates the travel times used
for others.
"""

import math
from typing import NamedTuple

import numpy as np

from cosim.plant import fastest
from cosim.plant.fastest import UNKNOWN
from cosim.plant.routes import Route, TravelTimes
from cosim.sumo.arrays import PerEdge
from cosim.sumo.net import City

# Drivers keep their route if another one saves less than this share of its delay, times the delay's
# share of its time.
SWITCHING_THRESHOLD = 0.6
MESO_THRESHOLD = 0.3  # in the mesoscopic model: less than this share of the other's own time


class Itinerary(NamedTuple):
    """A route as SUMO has it.

    names: of its edges
    edges, moves: by number, UNKNOWN on roads closed to cars
    known_from: place of the first edge after these roads
    """

    names: tuple[str, ...]
    edges: Route
    moves: Route
    known_from: int


class Present(NamedTuple):
    """The present route of a driver.

    route: edges by number; None on roads closed to cars
    time: from the end of the first edge (s), infinite if unknown; delay: part of it (s)
    found: a search would find the route
    """

    route: Route | None
    time: float = math.inf
    delay: float = math.inf
    found: bool = False

    @property
    def longest(self) -> float:
        """Return the time (s) that no search for faster routes has to exceed."""
        return self.time + 1.0 if self.found else math.inf


class Drivers:
    """Judgement of drivers in one city."""

    def __init__(self, city: City, times: TravelTimes, *, ways_return: bool, lanes: bool):
        """ways_return: routes may come back into a region
        lanes: False in the mesoscopic model
        """
        self._number = city.number
        self._region = city.edge_region
        self._times = times
        self._ways_return = ways_return
        self._lanes = lanes

    def itinerary(self, names: tuple[str, ...]) -> Itinerary:
        """Return the route with edges of these names."""
        route = np.array([self._number.get(edge, UNKNOWN) for edge in names], dtype=int)
        closed = np.flatnonzero(route == UNKNOWN)
        known_from = int(closed[-1]) + 1 if len(closed) else 0
        return Itinerary(names, route, self._times.moves(route), known_from)

    def present(self, itinerary: Itinerary, place: int, here: int, time: PerEdge) -> Present:
        """Return the present route of a driver on edge `here`.

        place: of the present edge in the itinerary; time: of every edge (s, (E,))
        """
        if place < itinerary.known_from:
            return Present(None)
        route = itinerary.edges[place:]
        if route[0] != here:
            return Present(route)
        moves = itinerary.moves[place:]
        takes, free, found = fastest.times_of(
            route, moves, time, self._times.turns, self._times.free, self._times.free_turns
        )
        if found and not self._ways_return:
            found = fastest.leaves_once(route, self._region)
        return Present(route, takes, max(takes - free, 0.0), found)

    def time(self, route: Route, time: PerEdge) -> float:
        """Return the time of a route from the end of its first edge (s).

        time: of every edge (s, (E,))
        """
        moves = self._times.moves(route)
        takes, *_ = fastest.times_of(
            route, moves, time, self._times.turns, self._times.free, self._times.free_turns
        )
        return takes

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

    def next_region(self, route: Route) -> int:
        """Return the next region of a route.

        It is the first other region, or with `ways_return` the region after its last exit.
        """
        return fastest.next_region(route, self._region, self._ways_return)
