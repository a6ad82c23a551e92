"""Travel times of streets and junctions, and what searches need.

A few vehicles are on one street at a time, so recent minutes count together, the newest most: on a
street by the mean speed, over a junction by Little's law, vehicles on it over vehicles that get
over it per second. In the mesoscopic model, which has no junctions to wait on, the newest control
interval counts half.
"""

import math

import numpy as np
from jaxtyping import Float, Int

from cosim.plant import fastest
from cosim.plant.sampling import STANDING_M_S, StreetMeans
from cosim.sumo.arrays import MoveEnds, PerEdge, PerMove
from cosim.sumo.net import City
from nmfd.arrays import PerRegion

MESO_SMOOTHING = 0.5  # weight of the newest control interval in the mesoscopic model
WINDOW_S = 300.0  # after which an observation counts a third
EMPTY_WEIGHT = 0.5  # of earlier observations after a control interval without vehicles
PRIOR_VEH_S = 3.0  # at the speed limit, which count besides
FAR_S = 1e9  # longer than any way
LEAST_COST_S = 1e-3  # of a move, for searches
MOST_TIMES = 1_000_000  # to gateways that are kept, of 8 bytes each
PerView = Float[np.ndarray, "V E"]
Views = Int[np.ndarray, "classes R"]


class TravelTimes:
    """Travel times of one run.

    first, second: numbers of the edges that each move joins (M,); onward: the same as a graph
    free, free_turns: in free flow, along edges (s, (E,)) and of moves over junctions (s, (M,))
    edges, turns: the same at present
    """

    def __init__(self, city: City, *, lanes: bool = True):
        """lanes: False in the mesoscopic model"""
        self._lanes = lanes
        self.first, self.second = np.ascontiguousarray(city.move_edges.T, np.int64)
        self.onward = _graph(self.first, self.second, len(city.edges))
        self._length = np.array([city.length[edge] for edge in city.edges])
        self._limit = np.array([city.speed[edge] for edge in city.edges])
        self.free = city.free_time
        self.free_turns = city.move_time
        self.edges = self.free.copy()
        self.turns = self.free_turns.copy()
        self._longest = np.array(list(city.inside.values())) / STANDING_M_S
        # Pairs of moves and internal edges that they lead over, which several moves may share.
        inside = {edge: n for n, edge in enumerate(city.inside)}
        over = []
        for n, move in enumerate(city.moves):
            over += [(n, inside[edge]) for edge in city.over.get(move, ()) if edge in inside]
        self._move, self._via = np.array(over, dtype=int).reshape(-1, 2).T
        # Weighted sums on edges: time [veh s] and distance [veh m].
        self._spent = np.zeros(len(city.edges))
        self._driven = np.zeros(len(city.edges))
        # The same on internal edges: time [veh s] and vehicles that got over them [veh].
        self._crossing = np.zeros(len(inside))
        self._crossed = np.zeros(len(inside))

    def learn(self, seen: StreetMeans) -> None:
        """Update the times from the means of a control interval."""
        if self._lanes:
            kept = math.exp(-seen.duration / WINDOW_S)
            self._learn_edges(seen, kept)
            self._learn_turns(seen, kept)
        else:
            speed = np.maximum(seen.speed, STANDING_M_S)
            now = np.where(np.isnan(seen.speed), self.free, self._length / speed)
            self.edges = self.edges + MESO_SMOOTHING * (np.maximum(now, self.free) - self.edges)

    def _learn_edges(self, seen: StreetMeans, kept: float) -> None:
        """Update the times along edges.

        kept: weight of earlier observations (-)
        """
        spent = seen.timed * seen.duration
        used = spent > 0.0
        kept_here = np.where(used, kept, min(kept, EMPTY_WEIGHT))
        self._spent = kept_here * self._spent + spent
        self._driven = kept_here * self._driven + spent * np.where(used, seen.speed, 0.0)
        speed = (self._driven + PRIOR_VEH_S * self._limit) / (self._spent + PRIOR_VEH_S)
        speed[seen.speed == 0.0] = 0.0  # closed, or all vehicles stand
        self.edges = np.maximum(self._length / np.maximum(speed, STANDING_M_S), self.free)

    def _learn_turns(self, seen: StreetMeans, kept: float) -> None:
        """Update the times of moves over junctions.

        kept: weight of earlier observations (-)
        """
        self._crossing = kept * self._crossing + seen.crossing * seen.duration
        self._crossed = kept * self._crossed + seen.crossed * seen.duration
        # Over each internal edge [s], 0 without vehicles.
        standing = np.where(self._crossing > 0.0, self._longest, 0.0)
        takes = np.divide(self._crossing, self._crossed, out=standing, where=self._crossed > 0.0)
        over = np.minimum(takes, self._longest)[self._via]
        self.turns = np.maximum(np.bincount(self._move, over, len(self.turns)), self.free_turns)


class Searches:
    """Searches for fastest routes as drivers see them (cosim.plant.fastest).

    Classes of drivers see different travel times. Prices lengthen the times through all regions but
    that of the destination. Searches are kept for one control interval.

    scene: of the present control interval
    """

    def __init__(
        self,
        city: City,
        times: TravelTimes,
        taste: Float[np.ndarray, "classes E"],
        *,
        most_detour: float,
        ways_return: bool,
        lanes: bool,
    ):
        """taste: factors of the times that every class sees (-, (classes, E))
        most_detour: that a next region, or a price, may cost a driver (s)
        ways_return: routes may leave a region and come back; lanes: False in the mesoscopic model
        """
        self._times = times
        self._taste = taste
        self._regions = city.regions
        edges = len(city.edges)
        region = city.edge_region.astype(np.int64)
        inside = region == np.arange(city.regions)[:, None]
        number = {move: n for n, move in enumerate(city.moves)}
        rows = []
        for gateway in city.gateways:
            move = gateway.from_edge, gateway.to_edge
            pair = [city.number[edge] for edge in move]
            rows.append((gateway.source, gateway.target, *pair, number[move]))
        gateways = np.array(sorted(rows, key=lambda row: row[:2]), np.int64).reshape(-1, 5)
        source, _, before, behind, over = np.ascontiguousarray(gateways.T)
        boundaries, first = np.unique(gateways[:, :2], axis=0, return_index=True)
        all_regions = np.arange(city.regions + 1)
        self._streets = fastest.Streets(
            region=region,
            onward=times.onward,
            backward=_graph(times.second, times.first, edges),
            allowed=np.concatenate([inside, ~inside, np.full((1, edges), True)]),
            free=times.free,
            free_turns=times.free_turns,
            gates=np.searchsorted(source, all_regions),
            boundaries=np.searchsorted(boundaries[:, 0], all_regions),
            boundary_gates=np.append(first, len(source)),
            neighbours=np.ascontiguousarray(boundaries[:, 1]),
            before=before,
            behind=behind,
            over=over,
            leading=np.full((len(source), edges), False),
            reached=np.full((len(source), edges), False),
            ahead=np.zeros((city.regions + 1, len(taste), edges)),
            back=np.zeros((len(source), len(taste))),
            most_detour=float(most_detour),
            ways_return=ways_return,
            lanes=lanes,
        )
        self._work = _work(self._streets, len(taste))
        self._look_ahead()
        self.command(None)

    def _look_ahead(self) -> None:
        """Note what does not change: which gateways lead where, and least times."""
        streets = self._streets
        classes = range(len(self._taste))
        no_views = np.zeros((0, 0), np.int64)
        free = self._seen(streets.free * self._taste, streets.free_turns, no_views)
        scene = fastest.scene_of(fastest.Parts(streets, free, self._work))
        for region in range(self._regions):
            inside = streets.allowed[region]
            outside = streets.allowed[self._regions + region]
            gates = range(streets.gates[region], streets.gates[region + 1])
            for gate in gates:
                before = streets.before[gate]
                streets.leading[gate] = fastest.connected(streets.backward, before, inside)
                behind = streets.behind[gate]
                streets.reached[gate] = fastest.connected(streets.onward, behind, outside)
            begins = streets.behind[gates.start : gates.stop]
            ends = streets.before[gates.start : gates.stop]
            for number in classes:
                ahead = _just_below(fastest.least_times(scene, number, begins, outside))
                streets.ahead[region, number] = ahead
                if streets.ways_return:
                    least = fastest.least_times(scene, number, begins, streets.allowed[-1])
                    streets.back[gates.start : gates.stop, number] = _just_below(least)[ends]

    def command(self, prices: PerRegion | None) -> None:
        """Begin a control interval with new travel times.

        prices: of the regions (-, (R,)); None: no prices
        """
        times = self._times
        classes = np.arange(len(self._taste))
        first_views = {(0.0,) * self._regions: 0}  # prices -> first view
        views = np.empty((len(classes), self._regions), np.int64)
        for destination in range(self._regions):
            told = np.zeros(self._regions) if prices is None else prices.astype(float)
            told[destination] = 0.0
            first = first_views.setdefault(tuple(told.tolist()), len(first_views) * len(classes))
            views[:, destination] = first + classes
        factors = 1.0 + np.array(list(first_views))[:, self._streets.region]
        edges = (times.edges * factors)[:, None] * self._taste
        edges = edges.reshape(-1, len(times.edges))
        if len(edges) != self._work.rows.shape[1]:
            self._work = _work(self._streets, len(edges))
        fastest.forget(self._work)
        seen = self._seen(edges, times.turns, views)
        self.scene = fastest.scene_of(fastest.Parts(self._streets, seen, self._work))

    def _seen(self, edges: PerView, turns: PerMove, views: Views) -> fastest.Seen:
        """Return the travel times that searches need.

        Arguments and result: as in `fastest.Seen`
        """
        streets = self._streets
        costs = np.maximum(np.take(edges, self._times.second, axis=1) + turns, LEAST_COST_S)
        return fastest.Seen(
            edges=edges,
            turns=turns,
            onward=np.take(costs, streets.onward.moves, axis=1),
            backward=np.take(costs, streets.backward.moves, axis=1),
            views=views,
        )


def _graph(first: MoveEnds, second: MoveEnds, edges: int) -> fastest.Graph:
    """Return the moves from edges `first` to `second` (M,), by `first`.

    edges: number of all
    """
    order = np.lexsort((second, first))
    begins = np.searchsorted(first[order], np.arange(edges + 1))
    ends = second[order].astype(np.int32)
    return fastest.Graph(begins.astype(np.int32), ends, order)


def _just_below(least: PerEdge) -> PerEdge:
    """Return least times (s, (E,)), FAR_S without a route.

    They are just below them, because no move may cost nothing.
    """
    return np.where(np.isfinite(least), (1.0 - 1e-6) * least, FAR_S)


def _work(streets: fastest.Streets, views: int) -> fastest.Work:
    """Return room for the searches in so many views."""
    edges = len(streets.region)
    regions = len(streets.gates) - 1
    gates = int(np.diff(streets.gates).max(initial=1))
    rows = max(MOST_TIMES // gates, fastest.ROWS_OF_A_DRIVER)
    looks = edges + len(streets.onward.ends) + 1
    return fastest.Work(
        rows=np.full((3, views, regions, edges), fastest.UNKNOWN, np.int32),
        limits=np.empty(rows),
        complete=np.empty(rows, bool),
        to_gates=np.empty((rows, gates)),
        numbers=np.empty(rows, np.int64),
        latest=np.zeros(6, np.int64),
        used=np.zeros(2, np.int64),
        times=np.empty(edges),
        wanted=np.full(edges, False),
        before=np.empty((7, edges), np.int64),
        heap_times=np.empty(looks),
        heap_edges=np.empty(looks, np.int64),
    )


# The first machine code of a process loads parts of Numba for a third of a second. A server that
# imports this module does it once for all runs.
_NO_MOVES = np.zeros(0, int)
fastest.connected(_graph(_NO_MOVES, _NO_MOVES, 1), 0, np.ones(1, bool))
