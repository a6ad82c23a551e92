"""Travel times of moves between edges, and routes of least cost.

A move leads from one edge to the next. Its time is that on the first edge, so that the queue for
one turn does not count for another. A route's cost is the time that it adds for all drivers: on
every move the own time t, and t less the free-flow time for those behind (the marginal cost of a
time that grows in proportion to the flow).
"""

import math
from collections.abc import Iterable, Sequence
from heapq import heappop, heappush
from itertools import pairwise, takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cosim.sumo.net import City
from cosim.sumo.outputs import unfinished
from cosim.sumo.xml_files import BROKEN, attribute, elements_of

PERIOD_S = 300.0  # in which travel times are averaged
PRIOR_VEH = 2.0  # that count besides, with the mean time of all moves from the edge


class Driven(NamedTuple):
    """A vehicle's route as it was driven.

    edges: names; left: time at which it left each of them (s), as far as it came
    """

    depart: float
    edges: tuple[str, ...]
    left: tuple[float, ...]


def options(file: Path) -> dict[str, str]:
    """Return SUMO's options for a file that `read_driven` can read."""
    return {
        "vehroute-output": str(file.resolve()),
        "vehroute-output.exit-times": "true",
        "vehroute-output.last-route": "true",
        "vehroute-output.write-unfinished": "true",
    }


def read_driven(path: Path) -> dict[str, Driven]:
    """Return vehicle -> route. Raise RunFailed for a file that is not whole."""
    driven = {}
    try:
        for element in elements_of(path, "vehicle"):
            route = element.find("route")
            if route is None:
                continue
            times = map(float, route.get("exitTimes", "").split())
            left = tuple(takewhile(lambda time: time >= 0.0, times))
            depart = float(attribute(element, "depart"))
            edges = tuple(attribute(route, "edges").split())
            driven[attribute(element, "id")] = Driven(depart, edges, left)
    except BROKEN as error:
        raise unfinished(path, error) from None
    return driven


class Visits(NamedTuple):
    """Vehicles on moves in one run, by period.

    spent: time (veh s, (K, M)); count: vehicles (veh, (K, M))
    """

    spent: Float[np.ndarray, "K M"]
    count: Float[np.ndarray, "K M"]


def visits(city: City, driven: Iterable[Driven], begin: float, end: float) -> Visits:
    """Return the moves of some vehicles between two times (s)."""
    number = {move: n for n, move in enumerate(city.moves)}
    periods = max(math.ceil((end - begin) / PERIOD_S), 1)
    shape = periods, len(number)
    spent = np.zeros(shape)
    count = np.zeros(shape)
    for trip in driven:
        entered = trip.depart
        # A vehicle that is under way has left fewer edges.
        for pair, left in zip(pairwise(trip.edges), trip.left, strict=False):
            move = number.get(pair)
            if move is not None:
                period = min(int((entered - begin) / PERIOD_S), periods - 1)
                spent[period, move] += left - entered
                count[period, move] += 1.0
            entered = left
    return Visits(spent, count)


class Costs:
    """Times and costs of moves by period, and cheapest routes."""

    def __init__(self, city: City, runs: Sequence[Visits], begin: float):
        """runs: of which the means count; begin: time of the first period (s)"""
        self._begin = begin
        first = city.move_edges[:, 0]
        free = city.free_time[first] + city.move_time
        spent = np.sum([run.spent for run in runs], axis=0)
        count = np.sum([run.count for run in runs], axis=0)
        edges = len(city.edges)
        times = []
        for row, vehicles in zip(spent, count, strict=True):
            edge_spent = np.bincount(first, row, edges)[first]
            edge_count = np.bincount(first, vehicles, edges)[first]
            of_edge = (edge_spent + PRIOR_VEH * free) / (edge_count + PRIOR_VEH)
            times.append(np.maximum((row + PRIOR_VEH * of_edge) / (vehicles + PRIOR_VEH), free))
        # Lists, which a search reads item by item.
        self._times = [row.tolist() for row in times]
        self._costs = [(2.0 * row - free).tolist() for row in times]
        self._move = {tuple(pair): n for n, pair in enumerate(city.move_edges.tolist())}
        self._onward: list[list[tuple[int, int]]] = [[] for _ in range(edges)]
        for n, (edge, following) in enumerate(city.move_edges.tolist()):
            self._onward[edge].append((n, following))

    def of(self, edges: Sequence[int], depart: float) -> float:
        """Return the cost of a route up to its last edge (s).

        It is infinite if two edges do not follow each other.
        """
        cost = 0.0
        time = depart
        for pair in pairwise(edges):
            move = self._move.get(pair)
            if move is None:
                return math.inf
            period = self._period(time)
            cost += self._costs[period][move]
            time += self._times[period][move]
        return cost

    def least(self, origin: int, depart: float) -> "Tree":
        """Return the cheapest routes from an edge to all others."""
        costs = [math.inf] * len(self._onward)
        before = [-1] * len(self._onward)
        heap = [(0.0, depart, origin, -1)]
        while heap:
            cost, time, edge, previous = heappop(heap)
            if costs[edge] < math.inf:
                continue
            costs[edge] = cost
            before[edge] = previous
            period = self._period(time)
            for move, following in self._onward[edge]:
                if costs[following] == math.inf:
                    reached = cost + self._costs[period][move]
                    later = time + self._times[period][move]
                    heappush(heap, (reached, later, following, edge))
        return Tree(costs, before)

    def _period(self, time: float) -> int:
        return min(int((time - self._begin) / PERIOD_S), len(self._times) - 1)


class Tree(NamedTuple):
    """Cheapest routes from one edge. costs: (s); before: the edge before each"""

    costs: list[float]
    before: list[int]

    def way(self, last: int) -> tuple[int, ...]:
        """Return the edges of the route to an edge that can be reached."""
        edges = [last]
        while self.before[edges[-1]] >= 0:
            edges.append(self.before[edges[-1]])
        return tuple(reversed(edges))
