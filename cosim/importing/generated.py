"""A demand for a city that comes without any: a morning peak towards the centre, through traffic and a background.

The centre is where the signals are. Everybody takes a fastest way at free flow, with some seconds for every junction
and more for a signal, as one of DRIVER_CLASSES groups of drivers sees the times.
"""

from collections.abc import Iterable
from xml.etree.ElementTree import Element

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cosim.importing.demand import Traffic
from cosim.importing.streets import Streets
from cosim.sumo.trips import CLASS_SPREAD, DRIVER_CLASSES, SHORT
from nmfd.errors import InputError

RAMP_UP, FLAT, RAMP_DOWN = 1800.0, 1800.0, 1800.0  # s
INWARD, THROUGH = 0.5, 0.25  # shares of the trips; the rest is the background
BUSY = 3.0e-3  # veh/m of lane that the peak would keep on the streets at free flow, at level 1
STARTS = 400  # streets where trips begin, at most: bounds the shortest paths to find
JUNCTION, SIGNAL = 3.0, 10.0  # s that a driver reckons with
PILOT = 1500  # trips from which the mean trip time is estimated


def morning_peak(streets: Streets, *, level: float, begin: float, seed: int) -> Traffic:
    """Trips on the largest part of the network in which every edge can be reached from every other.

    level 1 would keep BUSY vehicles per metre of lane under way if they met no queue; they will. Raises InputError
    for a network that is too small.
    """
    if streets.core.sum() < 4:
        raise InputError(
            f"{streets.path}: only {streets.core.sum()} streets can be reached from each other; give a demand of your "
            "own with route-files in a sumocfg"
        )
    random = np.random.default_rng([seed, 0x7065616B])
    ends = _Ends(streets, random)
    ways = _Ways(streets, random)
    pilot = ways.routes(*ends.draw(PILOT))
    mean = float(np.mean([ways.time[list(route)].sum() for route in pilot if route]))
    held = level * BUSY * float(streets.lane_metres[streets.core].sum())
    count = max(1, round(held / mean * (RAMP_UP / 2 + FLAT + RAMP_DOWN / 2)))
    first, last = ends.draw(count)
    depart = begin + np.sort(_times(random.random(count)))
    routes = ways.routes(first, last)
    kept = np.array([bool(route) for route in routes])
    vehicles = (
        _vehicle(n, time, [streets.edges[edge] for edge in route])
        for n, (time, route) in enumerate(zip(depart, routes, strict=True))
        if route
    )
    return Traffic(
        vehicles=tuple(vehicles),
        depart=depart[kept],
        origin=first[kept],
        destination=last[kept],
        shared=(Element("vType", {"id": "car", "sigma": "0.2"}),),
        notes={"trips of a generated morning peak": int(kept.sum())},
    )


class _Ends:
    """Where trips begin and end."""

    def __init__(self, streets: Streets, random: np.random.Generator):
        self._random = random
        good = streets.core & (streets.length >= SHORT)
        self._edges = np.flatnonzero(good if good.sum() >= 4 else streets.core)
        weight = streets.lane_metres[self._edges]
        signalled = [n for n, signal in enumerate(streets.link_signals) if signal is not None]
        middle = (
            streets.centre[streets.links[signalled, 0]].mean(axis=0)
            if signalled
            else np.average(streets.centre[self._edges], axis=0, weights=weight)
        )
        away = streets.centre[self._edges] - middle
        self._distance, self._angle = np.hypot(*away.T), np.arctan2(*away.T[::-1])
        radius = np.sqrt(np.average(self._distance**2, weights=weight))
        starts = random.choice(len(weight), size=min(STARTS, len(weight)), replace=False, p=weight / weight.sum())
        outside = self._distance[starts] > 0.5 * radius
        self._all, self._outer = starts, starts[outside] if outside.sum() >= 2 else starts
        rim = starts[self._distance[starts] >= np.quantile(self._distance[starts], 0.7)]
        self._rim = rim if len(rim) >= 2 else starts
        self._weight, self._fast = weight, weight * streets.speed[self._edges] ** 2
        self._central = weight * np.exp(-0.5 * (self._distance / (0.3 * radius)) ** 2)

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Edges where `count` trips begin and end."""
        kind = self._random.random(count)
        inward, through = kind < INWARD, (kind >= INWARD) & (kind < INWARD + THROUGH)
        first = self._random.choice(self._all, size=count)
        last = self._pick(np.arange(len(self._weight)), self._weight, count)
        first[inward] = self._random.choice(self._outer, size=inward.sum())
        last[inward] = self._pick(np.arange(len(self._weight)), self._central, int(inward.sum()))
        first[through] = self._pick(self._rim, self._fast[self._rim], int(through.sum()))
        last[through] = [self._opposite(n) for n in first[through]]
        last = np.where(first == last, (last + 1) % len(self._weight), last)
        return self._edges[first], self._edges[last]

    def _pick(self, options: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
        return self._random.choice(options, size=count, p=weight / weight.sum())

    def _opposite(self, n: int) -> int:
        """A street on the far side of the city."""
        turned = np.cos(self._angle[self._rim] - self._angle[n]) < 0.0
        options = self._rim[turned] if turned.any() else self._rim
        return int(self._pick(options, self._fast[options], 1)[0])


class _Ways:
    """Fastest ways; time (E,) [s] of every edge with the junction before it."""

    def __init__(self, streets: Streets, random: np.random.Generator):
        self._size, self._links, self._random = len(streets.edges), streets.links, random
        signalled = np.array([signal is not None for signal in streets.link_signals])
        self._turn = np.where(signalled, SIGNAL, JUNCTION)
        self.time = streets.length / streets.speed + JUNCTION
        self._taste = np.exp(CLASS_SPREAD * random.standard_normal((DRIVER_CLASSES, self._size)))

    def routes(self, first: np.ndarray, last: np.ndarray) -> list[tuple[int, ...]]:
        """The route of every trip; empty where there is none."""
        found: list[tuple[int, ...]] = [()] * len(first)
        tastes = self._random.integers(DRIVER_CLASSES, size=len(first))
        for taste in range(DRIVER_CLASSES):
            cost = self._turn + (self.time * self._taste[taste])[self._links[:, 1]]
            graph = csr_array((cost, (self._links[:, 0], self._links[:, 1])), shape=(self._size,) * 2)
            starts = np.unique(first[tastes == taste])
            for chunk in np.array_split(starts, max(1, len(starts) // 128)):
                if len(chunk):
                    _, before = dijkstra(graph, indices=chunk, return_predecessors=True)
                    for n in np.flatnonzero((tastes == taste) & np.isin(first, chunk)):
                        found[n] = _walk(before[np.searchsorted(chunk, first[n])], int(first[n]), int(last[n]))
        return found


def _walk(before: np.ndarray, first: int, last: int) -> tuple[int, ...]:
    way = [last]
    while way[-1] != first:
        way.append(int(before[way[-1]]))
        if way[-1] < 0:
            return ()
    return tuple(reversed(way))


def _times(uniform: np.ndarray) -> np.ndarray:
    """Departures [s] after the beginning, of a trapezoid."""
    clock = np.linspace(0.0, RAMP_UP + FLAT + RAMP_DOWN, 541)
    rate = np.minimum(np.minimum(clock / RAMP_UP, 1.0), (clock[-1] - clock) / RAMP_DOWN)
    share = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2)])
    return np.interp(uniform, share / share[-1], clock)


def _vehicle(n: int, depart: float, edges: Iterable[str]) -> Element:
    vehicle = Element(
        "vehicle",
        {
            "id": f"v{n}",
            "type": "car",
            "depart": f"{depart:.2f}",
            "departLane": "best",
            "departSpeed": "max",
            "departPos": "random_free",
            "arrivalPos": "random",
        },
    )
    vehicle.append(Element("route", {"edges": " ".join(edges)}))
    return vehicle
