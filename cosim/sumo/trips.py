"""Individual trips of a demand between regions, with static routes."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from cosim.sumo.arrays import PerEdge, PerMove, PerTrip, TripNumbers
from cosim.sumo.net import City
from nmfd.arrays import PairsOverTime
from nmfd.errors import InputError

STREAM = 7101  # keeps the random numbers of trips apart from others of the same seed
DRIVER_CLASSES = 8  # groups of drivers who see different travel times
CLASS_SPREAD = 0.15  # standard deviation of the logarithm of their travel times
SHORT_EDGE_M = 30.0  # no trip starts or ends on a shorter edge if its region has longer ones
POCKET_M = 80.0  # a longer edge is no turn pocket
# Of trips that plans are made for, none of an evaluation.
PLANNING_SEEDS = (778_001, 778_002, 778_003, 778_004)
PEAK_S = 900.0  # the Highway Capacity Manual designs for the busiest quarter of the peak hour
Noise = Float[np.ndarray, "classes E"]


@dataclass(frozen=True, kw_only=True)
class Trips:
    """N trips, sorted by departure.

    depart: (N,) [s]; origin, destination: (N,) regions
    routes: N tuples of edges, from an edge of the origin to an edge of the destination
    arrival: (N,) [m], position on the last edge at which the trip ends
    """

    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    routes: tuple[tuple[str, ...], ...]
    arrival: PerTrip


class _Drawn(NamedTuple):
    """N trips without routes.

    depart, origin, destination: as in Trips; first, last: edges (N,)
    tastes: classes of drivers (N,); positions: drawn from 0 to 1, of their ends (-, (N,))
    noise: as in `fastest_routes`
    """

    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    first: TripNumbers
    last: TripNumbers
    tastes: TripNumbers
    positions: PerTrip
    noise: Noise


def turning_flows(
    city: City, demand: PairsOverTime, step: float
) -> Mapping[tuple[str, str], float]:
    """Return (edge, next edge) -> flow [veh/s] in the peak.

    That is the busiest quarter of an hour.
    demand: (T, R, R) [veh/s], intervals of `step` [s]
    Trips take static routes without delays; the mean of several planning seeds. Unused movements
    are missing.
    """
    window = min(PEAK_S, step * len(demand))
    turns: Counter[tuple[str, str]] = Counter()
    for seed in PLANNING_SEEDS:
        drawn = _drawn(city, demand, step, seed)
        for route in _routes(city, drawn, busiest(drawn.depart, window)):
            turns.update(pairwise(route))
    return {turn: count / (window * len(PLANNING_SEEDS)) for turn, count in turns.items()}


def busiest(depart: PerTrip, window: float) -> slice:
    """Return the trips that depart in the busiest `window` [s].

    depart: (N,) [s], sorted
    """
    if not len(depart):
        return slice(0)
    ends = np.searchsorted(depart, depart + window)
    first = int(np.argmax(ends - np.arange(len(ends))))
    return slice(first, int(ends[first]))


def make_trips(city: City, demand: PairsOverTime, step: float, seed: int) -> Trips:
    """Return individual trips of a demand between regions.

    demand: (T, R, R) [veh/s], intervals of `step` [s]
    Every pair of regions gets its number of vehicles to within one, at the times at which its
    cumulated demand passes whole numbers, shifted by a random phase. Edges are drawn by length
    times lanes. Each route is the fastest one in free flow as one of `DRIVER_CLASSES` groups of
    drivers sees it. Raises InputError if no way leads from i to j.
    """
    drawn = _drawn(city, demand, step, seed)
    routes = _routes(city, drawn, slice(None))
    for n, route in enumerate(routes):
        if len(route) < 2:
            begin, end = city.edges[drawn.first[n]], city.edges[drawn.last[n]]
            raise InputError(
                f"{city.net_file}: no way leads from edge {begin} (region {drawn.origin[n]}) to "
                f"{end} (region {drawn.destination[n]}); leave out edges that are not connected"
            )
    lengths = np.array([city.length[route[-1]] for route in routes])
    return Trips(
        depart=drawn.depart,
        origin=drawn.origin,
        destination=drawn.destination,
        routes=tuple(routes),
        arrival=lengths * (0.1 + 0.8 * drawn.positions),
    )


def _drawn(city: City, demand: PairsOverTime, step: float, seed: int) -> _Drawn:
    """Return the trips of `make_trips` before they have routes."""
    if demand.shape[1:] != (city.regions, city.regions):
        raise InputError(
            f"{city.net_file}: demand for {demand.shape[1]} regions, but the city has "
            f"{city.regions}"
        )
    rng = np.random.default_rng([seed, STREAM])
    depart, origin, destination = _departures(demand, step, rng)
    starts = [_ends(city, region, departing=True) for region in range(city.regions)]
    goals = [_ends(city, region, departing=False) for region in range(city.regions)]
    draws = rng.random((len(depart), 2))
    tastes = rng.integers(DRIVER_CLASSES, size=len(depart))
    positions = rng.random(len(depart))
    noise = perception(len(city.edges), rng)
    first, last = np.empty((2, len(depart)), dtype=int)
    for region in range(city.regions):
        begins = origin == region
        first[begins] = _draw(city, starts[region], draws[begins, 0])
        ends = destination == region
        last[ends] = _draw(city, goals[region], draws[ends, 1])
    for n in np.flatnonzero(first == last):  # to the next edge instead
        edges = goals[destination[n]].edges
        place = edges.index(city.edges[first[n]])
        last[n] = city.number[edges[(place + 1) % len(edges)]]
    return _Drawn(depart, origin, destination, first, last, tastes, positions, noise)


def _routes(city: City, drawn: _Drawn, part: slice) -> list[tuple[str, ...]]:
    """Return the fastest routes of some trips, () where there is none."""
    ends = drawn.first[part], drawn.last[part]
    return routes_in(city, ends, drawn.tastes[part], drawn.noise)


def _departures(
    demand: PairsOverTime, step: float, rng: np.random.Generator
) -> tuple[PerTrip, TripNumbers, TripNumbers]:
    """Return departures to 0.01 s, sorted, origins and destinations."""
    clock = step * np.arange(len(demand) + 1)
    times, origins, destinations = [], [], []
    for i in range(demand.shape[1]):
        for j in range(demand.shape[2]):
            cumulated = np.concatenate([[0.0], np.cumsum(demand[:, i, j]) * step])
            phase = rng.random()
            count = int(np.floor(cumulated[-1] + phase))
            marks = np.arange(1, count + 1) - phase
            rising = np.concatenate([[True], np.diff(cumulated) > 0])
            # The end of a pause begins the next rise.
            keep = rising | np.concatenate([rising[1:], [False]])
            times.append(np.interp(marks, cumulated[keep], clock[keep]))
            origins.append(np.full(count, i))
            destinations.append(np.full(count, j))
    depart = np.floor(np.concatenate(times) * 100) / 100
    origin, destination = np.concatenate(origins), np.concatenate(destinations)
    order = np.lexsort((destination, origin, depart))
    return depart[order], origin[order], destination[order]


class _Ends(NamedTuple):
    """Edges where trips start or end; weights: cumulated, up to 1."""

    edges: list[str]
    weights: np.ndarray


def _ends(city: City, region: int, *, departing: bool) -> _Ends:
    """Return the edges where trips of a region start or end.

    They are good ones if there are any.
    """
    edges = [edge for edge in city.edges if city.region_of[edge] == region]
    onward: Mapping[str, Sequence[str]] = city.successors if departing else city.before
    good = []
    for edge in edges:
        is_long = city.length[edge] >= SHORT_EDGE_M
        if is_long and _stays(city, edge, onward) and not _is_pocket(city, edge):
            good.append(edge)
    ends = good if len(good) >= 2 else edges
    weights = np.cumsum([city.length[edge] * city.lanes[edge] for edge in ends])
    return _Ends(ends, weights / weights[-1])


def _stays(city: City, edge: str, onward: Mapping[str, Sequence[str]]) -> bool:
    """Return True if a way on from the edge stays in its region.

    A dead end does not.
    """
    here = edge
    seen = {edge}
    while len(onward[here]) == 1 and onward[here][0] not in seen:
        here = onward[here][0]
        if city.region_of[here] != city.region_of[edge]:
            return False
        seen.add(here)
    return any(city.region_of[other] == city.region_of[edge] for other in onward[here])


def _is_pocket(city: City, edge: str) -> bool:
    """Return True for a short piece with more lanes at the end of a road."""
    before = city.before[edge]
    if len(before) != 1 or city.length[edge] >= POCKET_M:
        return False
    road = before[0]
    return city.lanes[edge] > city.lanes[road] and city.successors[road] == (edge,)


def _draw(city: City, ends: _Ends, uniforms: PerTrip) -> TripNumbers:
    """Return the edges that random numbers from 0 to 1 (N,) draw."""
    numbers = np.array([city.number[edge] for edge in ends.edges])
    places = np.searchsorted(ends.weights, uniforms, side="right")
    return numbers[np.minimum(places, len(numbers) - 1)]


def perception(edges: int, rng: np.random.Generator) -> Noise:
    """Draw the factors [-] on travel times by class of drivers."""
    return np.exp(CLASS_SPREAD * rng.standard_normal((DRIVER_CLASSES, edges)))


def routes_in(
    city: City,
    ends: tuple[TripNumbers, TripNumbers],
    tastes: TripNumbers,
    noise: Noise,
) -> list[tuple[str, ...]]:
    """Return `fastest_routes` in a city, as ids of edges."""
    routes = fastest_routes(
        ends,
        tastes,
        noise,
        time=city.free_time,
        links=city.move_edges,
        turn=city.move_time,
    )
    return [tuple(city.edges[edge] for edge in route) for route in routes]


def fastest_routes(
    ends: tuple[TripNumbers, TripNumbers],
    tastes: TripNumbers,
    noise: Noise,
    *,
    time: PerEdge,
    links: Int[np.ndarray, "M 2"],
    turn: PerMove,
) -> list[tuple[int, ...]]:
    """Return the fastest route of every trip in free flow.

    It is () if there is none.
    A route is a tuple of numbers of edges.
    ends: first and last edge (N,) of the trips; tastes: (N,), class of each driver
    noise: [-], factor of every class of drivers on time [s] of the edges; turn: [s] over the
        junction of each link
    """
    first, last = ends
    routes: list[tuple[int, ...]] = [()] * len(first)
    for taste, factor in enumerate(noise):
        cost = np.maximum(turn + (time * factor)[links[:, 1]], 1e-6)
        graph = csr_matrix((cost, (links[:, 0], links[:, 1])), shape=(len(time),) * 2)
        members = np.flatnonzero(tastes == taste)
        origins = np.unique(first[members])
        for chunk in np.array_split(origins, max(1, len(origins) // 256)):
            if not len(chunk):
                continue
            _, before = dijkstra(graph, indices=chunk, return_predecessors=True)
            here = members[np.isin(first[members], chunk)]
            for n, row in zip(here, np.searchsorted(chunk, first[here]), strict=True):
                routes[n] = _walk(before[row], int(first[n]), int(last[n]))
    return routes


def _walk(before: np.ndarray, first: int, last: int) -> tuple[int, ...]:
    """Return the way in a tree of shortest paths (E,), () if there is none."""
    way = [last]
    while way[-1] != first:
        way.append(int(before[way[-1]]))
        if way[-1] < 0:
            return ()
    return tuple(reversed(way))
