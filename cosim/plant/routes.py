"""Travel times of streets and junctions, and searches for fastest routes.

A few vehicles are on one street at a time, so recent minutes count together, the newest most: on a
street by the mean speed, over a junction by Little's law, vehicles on it over vehicles that get
over it per second. In the mesoscopic model, which has no junctions to wait on, the newest control
interval counts half.
"""

import math
from collections.abc import Callable
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from cosim.plant import fastest
from cosim.plant.sampling import STANDING_M_S, StreetMeans
from cosim.sumo.arrays import EdgeMask, MoveEnds, PerEdge, PerGateway, PerMove
from cosim.sumo.net import City
from nmfd.arrays import PerRegion

MESO_SMOOTHING = 0.5  # weight of the newest control interval in the mesoscopic model
WINDOW_S = 300.0  # after which an observation counts a third
EMPTY_WEIGHT = 0.5  # of earlier observations after a control interval without vehicles
PRIOR_VEH_S = 3.0  # at the speed limit, which count besides
FAR_S = 1e9  # longer than any way
MOST_NODES = 500_000  # of all searches to the same aims that are kept, of 4 bytes each
PerNode = Float[np.ndarray, " nodes"]  # of a graph of moves
Nodes = Int[np.ndarray, " nodes"]
PerNeighbour = Float[np.ndarray, " N"]
NeighbourMask = Bool[np.ndarray, " N"]
PerKept = Float[np.ndarray, " kept"]  # moves of a graph
GatewayNumbers = Int[np.ndarray, " G"]
Route = Int[np.ndarray, " route"]  # edges


class TravelTimes:
    """Travel times of one run.

    first, second: numbers of the edges that each move joins (M,)
    free, free_turns: in free flow, along edges (s, (E,)) and of moves over junctions (s, (M,))
    edges, turns: the same at present
    """

    def __init__(self, city: City, *, lanes: bool = True):
        """lanes: False in the mesoscopic model"""
        self._lanes = lanes
        self.first, self.second = city.move_edges.T
        self._order = np.lexsort((self.second, self.first))
        edges = np.arange(len(city.edges) + 1)
        self._begins = np.searchsorted(self.first[self._order], edges)
        self._ends = self.second[self._order]
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

    def moves(self, route: Route) -> Route:
        """Return the moves of a route, UNKNOWN where the city has none."""
        return fastest.moves_of(route, self._begins, self._ends, self._order)

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


class Moves:
    """Moves between allowed edges as a graph whose nodes are these edges.

    number, node: edge -> its node, -1 for edges that are not allowed, as an array (E,) and a list
    edges: of each node (nodes,); begins, columns: of rows as in csr_array
    """

    def __init__(self, first: MoveEnds, second: MoveEnds, *, allowed: EdgeMask, reverse: bool):
        """first, second: numbers of edges (M,)
        allowed: edges that are nodes (E,)
        reverse: moves lead from second to first
        """
        self.edges = np.flatnonzero(allowed)
        self.number = np.full(len(allowed), -1)
        self.number[self.edges] = np.arange(len(self.edges))
        self.node = self.number.tolist()
        rows = self.number[second if reverse else first]
        columns = self.number[first if reverse else second]
        kept = np.flatnonzero(allowed[first] & allowed[second])
        kept = kept[np.lexsort((columns[kept], rows[kept]))]
        nodes = np.arange(len(self.edges) + 1)
        self._kept = kept
        self._second = second[kept]
        self.columns = columns[kept].astype(np.int32)
        self.begins = np.searchsorted(rows[kept], nodes).astype(np.int32)

    def costs(self, time: PerEdge, turns: PerMove, ahead: PerNode | None = None) -> PerKept:
        """Return times of moves, and of the edges that they lead to (s).

        time: of edges (s, (E,)); turns: of moves (s, (M,))
        ahead: lower bound of the time from each node to the nearest aim (s, (nodes,)), for an A*
            search: edge costs are reduced by the drop in this bound. Distances returned are
            therefore cost + ahead - ahead[start], and detours come last.
        """
        cost = np.maximum(time[self._second] + turns[self._kept], 1e-3)
        if ahead is not None:
            cost += ahead[self.columns] - np.repeat(ahead, np.diff(self.begins))
        return cost

    def leading_to(self, nodes: GatewayNumbers) -> Bool[np.ndarray, "nodes G"]:
        """Return which nodes lead to each of `nodes` (bool, (all nodes, G))."""
        moves = self._graph(np.ones(len(self.columns)))
        # Nodes that lead to each other are reached from the same ones: in most cities nearly all.
        _, part = connected_components(moves, connection="strong")
        _, once, which = np.unique(part[nodes], return_index=True, return_inverse=True)
        steps = dijkstra(moves.T.tocsr(), indices=nodes[once], unweighted=True)
        return np.isfinite(steps).T[:, which]

    def ahead(self, nodes: GatewayNumbers, time: PerEdge, turns: PerMove) -> PerNode:
        """Return a lower bound of the time to the nearest of `nodes` (s).

        It is FAR_S for nodes that lead to none.

        time: of edges (s, (E,)); turns: of moves (s, (M,))
        """
        moves = self._graph(self.costs(time, turns))
        least = dijkstra(moves.T.tocsr(), indices=nodes, min_only=True)
        # Just below the least time, because no move may cost nothing.
        return np.where(np.isfinite(least), (1.0 - 1e-6) * least, FAR_S)

    def _graph(self, cost: PerKept) -> csr_array:
        """Return the moves as a graph with these costs."""
        return csr_array((cost, self.columns, self.begins), shape=(len(self.edges),) * 2)


class Tree(NamedTuple):
    """One search.

    most: its limit (s), infinite if all aims were reached
    times: to each aim and beyond (s), infinite above the limit; nearest: the least of them
    before: predecessors (nodes,)
    """

    most: float
    times: PerGateway
    nearest: float
    before: Nodes


class Trees:
    """Fastest routes by `moves` from single edges to some aims.

    They are searched on demand and no further than needed.

    node: edge -> its node, as in `Moves`
    """

    def __init__(
        self,
        moves: Moves,
        time: PerEdge,
        turns: PerMove,
        ahead: PerNode | None = None,
        *,
        aims: Nodes | tuple[()] = (),
        beyond: PerGateway | float = 0.0,
    ):
        """time: of edges (s, (E,)); turns: of moves (s, (M,))
        ahead: see `Moves.costs` (s, (nodes,))
        aims: nodes (G,); beyond: time from each aim on (s, (G,))
        """
        self.node = moves.node
        self._moves = moves
        self._costs = moves.costs(time, turns, ahead)
        self._searches: dict[int, Tree] = {}
        self._ahead = ahead
        self._aims = np.array(aims, dtype=int)
        self._beyond = beyond

    def tree(self, begin: int, most: float) -> Tree:
        """Return the search from edge `begin`, at least up to `most` (s)."""
        node = self.node[begin]
        tree = self._searches.get(node)
        if tree is None or tree.most < most:
            if len(self._searches) * len(self._moves.edges) > MOST_NODES:
                self._searches.clear()
            tree = self._search(node, most)
            self._searches[node] = tree
        return tree

    def time(self, begin: int, end: int, most: float) -> tuple[float, Nodes]:
        """Return the time from edge `begin` to `end` (s), and predecessors.

        The time is infinite above `most`. Aims and `ahead` do not count.
        """
        aims = np.array([self.node[end]])
        times, before, _ = self._found(self.node[begin], most, aims)
        return float(times[0]), before

    def back(self, before: Nodes, begin: int, end: int) -> Route:
        """Return the edges from `end` back to `begin`, by predecessors."""
        return fastest.path(before, self._moves.edges, self.node[end], self.node[begin])

    def _search(self, node: int, most: float) -> Tree:
        """Return a new search from a node up to `most` (s)."""
        times, before, complete = self._found(node, most, self._aims)
        if self._ahead is not None:
            times += self._ahead[node]
        times += self._beyond
        nearest = float(times.min(initial=math.inf))
        return Tree(math.inf if complete else most, times, nearest, before)

    def _found(self, node: int, most: float, aims: Nodes) -> tuple[PerGateway, Nodes, bool]:
        """Return times, predecessors and completeness of `fastest.search`."""
        moves = self._moves
        return fastest.search(moves.begins, moves.columns, self._costs, node, most, aims)


class Choices(NamedTuple):
    """The fastest routes of a driver by each next region.

    times: (s, (N,)), infinite if too long; fastest: the least of them
    exist: True if there is a route, however long (N,)
    route: returns the edges of the n-th
    """

    times: PerNeighbour
    fastest: float
    exist: NeighbourMask
    route: Callable[[int], Route]


class Exits:
    """Gateways out of one region, with the moves that lead there and on.

    Gateway g leads from edge first[g] to second[g]. Gateways from begins[n] up to begins[n + 1]
    lead into region neighbours[n].

    first, second, move: edges of each gateway, and move from one to the other (G,)
    inside: moves in the region; outside: reversed moves elsewhere
    first_nodes, second_nodes: nodes of first[g] in `inside`, and of second[g] in `outside` (G,)
    """

    def __init__(self, gateways: Int[np.ndarray, "G 4"], *, inside: Moves, outside: Moves):
        """gateways: first, second, move and next region, which rises"""
        self.first, self.second, self.move, next_region = gateways.T.copy()
        self.neighbours, begins = np.unique(next_region, return_index=True)
        self.begins = np.append(begins, len(next_region))
        self.inside = inside
        self.outside = outside
        self.first_nodes = inside.number[self.first]
        self.second_nodes = outside.number[self.second]

    @cached_property
    def leading(self) -> Bool[np.ndarray, "nodes G"]:
        """Return to which gateways each edge inside leads."""
        return self.inside.leading_to(self.first_nodes)

    @cached_property
    def reached(self) -> Bool[np.ndarray, "nodes G"]:
        """Return from which gateways each edge outside is reached."""
        return self.outside.leading_to(self.second_nodes)


class Returning(NamedTuple):
    """Fastest routes by all moves, for those that come back into a region.

    trees: to first[g]
    entering: time from the end of first[g] to that of second[g] (s, (G,))
    back: no more than the time from behind the nearest gateway back to first[g] (s, (G,))
    """

    trees: Trees
    entering: PerGateway
    back: PerGateway


class _Way(NamedTuple):
    """A fastest route of a driver as far as its last gateway.

    time: of the whole route (s); before: predecessors in `trees` (nodes,)
    """

    time: float
    gateway: int
    trees: Trees
    before: Nodes


class Ways:
    """Fastest routes out of one region by each of its G gateways.

    Searches start where drivers are and where they go, on demand and no further than needed. A
    route that comes back into the region before it leaves for good has the same end, from the last
    gateway on.
    """

    def __init__(
        self,
        exits: Exits,
        *,
        there: Trees,
        onward: Trees,
        ahead: PerNode,
        everywhere: Returning | None = None,
    ):
        """there: routes by moves `inside` to first[g], and on to second[g]
        onward: routes by reversed moves `outside` to second[g], with `ahead`
        ahead: time from the nearest second[g] to nodes of `outside`, not above their times (s)
        everywhere: for routes that come back; None if none may
        """
        self.exits = exits
        self._there = there
        self._onward = onward
        self._ahead = ahead.tolist()
        self._everywhere = everywhere
        # Least time from a gateway back to one and over it (s).
        self._back_soonest = math.inf
        if everywhere:
            around = everywhere.back + everywhere.entering
            self._back_soonest = float(around.min(initial=math.inf))

    def choices(self, here: int, target: int, longest: float, detour: float) -> Choices:
        """Return the fastest routes from `here` to `target` by each next region.

        longest: no less than the fastest of all takes (s), infinite if unknown
        detour: beyond this, routes that take longer are left out (s)
        """
        exits = self.exits
        ahead = self._ahead[self._onward.node[target]]
        most = detour + longest
        there = self._there.tree(here, max(most - ahead, 0.0))
        left = 0.0
        if there.nearest < math.inf:
            left = max(most - min(there.nearest, most) - ahead, 0.0)
        onward = self._onward.tree(target, left)
        times, gateways, exist, soonest = fastest.by_region(
            there.times,
            onward.times,
            exits.begins,
            exits.leading[self._there.node[here]],
            exits.reached[self._onward.node[target]],
        )
        back = self._returning(here, there, onward, min(soonest, longest), ahead)
        by_return = None
        if back is not None and back.time < soonest:
            by_return = int(np.searchsorted(exits.begins, back.gateway, side="right")) - 1
            soonest = back.time
            times[by_return] = soonest
            exist[by_return] = True

        def route(n: int) -> Route:
            way = _Way(times[n], gateways[n], self._there, there.before)
            if back is not None and n == by_return:
                way = back
            inside = way.trees.back(way.before, here, exits.first[way.gateway])
            outside = self._onward.back(onward.before, target, exits.second[way.gateway])
            return np.concatenate((inside[::-1], outside))

        return Choices(times, soonest, exist, route)

    def _returning(
        self, here: int, there: Tree, onward: Tree, most: float, ahead: float
    ) -> _Way | None:
        """Return the fastest route that comes back; None if it is too long.

        most: time that it has to be below (s)
        ahead: least time from the nearest second[g] on (s)
        """
        everywhere = self._everywhere
        # It has left, and come back, which alone takes too long for most drivers.
        if everywhere is None or there.nearest + self._back_soonest + ahead >= most:
            return None
        ends, nearest = fastest.ends_of_returns(
            there.nearest, everywhere.back, everywhere.entering, onward.times, most
        )
        if nearest == math.inf:
            return None
        tree = everywhere.trees.tree(here, most - nearest)
        times = tree.times + ends
        gateway = int(times.argmin())
        return _Way(float(times[gateway]), gateway, everywhere.trees, tree.before)


class RegionRoutes:
    """Routes within and out of every region, as drivers see them.

    Classes of drivers see different travel times. Prices lengthen the times through all regions but
    `free` ones. Searches are kept for one control interval.

    regions: all regions
    """

    def __init__(
        self,
        city: City,
        times: TravelTimes,
        taste: Float[np.ndarray, "classes E"],
        *,
        ways_return: bool,
        lanes: bool,
    ):
        """taste: factors of the times that every class sees (-, (classes, E))
        ways_return: routes may leave a region and come back; lanes: False in the mesoscopic model
        """
        self.regions = tuple(range(city.regions))
        self._edge_region = city.edge_region
        self._times = times
        self._taste = taste
        self._lanes = lanes
        ends = (times.first, times.second)
        self._homeward = []
        self._exits = []
        for region in self.regions:
            here = city.edge_region == region
            self._homeward.append(Moves(*ends, allowed=here, reverse=True))
            inside = Moves(*ends, allowed=here, reverse=False)
            outside = Moves(*ends, allowed=~here, reverse=True)
            rows = []
            for gateway in city.gateways:
                if gateway.source == region:
                    pair = [city.number[gateway.from_edge], city.number[gateway.to_edge]]
                    (move,) = times.moves(np.array(pair))
                    rows.append((*pair, move, gateway.target))
            gateways = np.array(rows, dtype=int).reshape(-1, 4)
            self._exits.append(Exits(gateways, inside=inside, outside=outside))
        self._everywhere = None
        if ways_return:
            everywhere = np.full(len(city.edges), True)
            self._everywhere = Moves(*ends, allowed=everywhere, reverse=False)
            back = Moves(*ends, allowed=everywhere, reverse=True)
            self._homeward = [back] * city.regions
        self._ahead = cache(self._ahead_of)
        # Results of one control interval.
        self.seen = cache(self._seen_by)
        self.home = cache(self._home)
        self.ways = cache(self._ways)
        self.command(None)

    def command(self, prices: PerRegion | None) -> None:
        """Begin a control interval with new travel times.

        prices: of the regions (-, (R,)); None: no prices
        """
        self._prices = np.zeros(len(self.regions)) if prices is None else prices
        self._free = []
        for destination in self.regions:
            free = [r for r in self.regions if r == destination or not self._prices[r]]
            self._free.append(tuple(free))
        self.seen.cache_clear()
        self.home.cache_clear()
        self.ways.cache_clear()

    def free(self, destination: int) -> tuple[int, ...]:
        """Return the regions without a price for drivers to `destination`."""
        return self._free[destination]

    def _seen_by(self, driver_class: int, free: tuple[int, ...]) -> PerEdge:
        """Return the times of edges that a class of drivers sees (s, (E,))."""
        prices = self._prices.copy()
        prices[list(free)] = 0.0
        return self._times.edges * (1.0 + prices)[self._edge_region] * self._taste[driver_class]

    def _home(self, region: int, driver_class: int, free: tuple[int, ...]) -> Trees:
        """Return routes to edges of a region.

        They stay inside it, unless routes may return.
        """
        return self._trees(self._homeward[region], driver_class, free)

    def _ways(self, region: int, driver_class: int, free: tuple[int, ...]) -> Ways:
        """Return routes out of a region to edges of others."""
        exits = self._exits[region]
        second = self.seen(driver_class, free)[exits.second]
        over = self._times.turns[exits.move] + second
        ahead = self._ahead(exits.outside, region, driver_class)
        everywhere = None
        if self._everywhere:
            nodes = self._everywhere.number[exits.first]
            trees = self._trees(self._everywhere, driver_class, free, aims=nodes)
            back = self._ahead(self._homeward[region], region, driver_class)[exits.first]
            everywhere = Returning(trees, over, back)
        there = self._trees(
            exits.inside,
            driver_class,
            free,
            aims=exits.first_nodes,
            beyond=over if self._lanes else second,
        )
        onward = self._trees(
            exits.outside, driver_class, free, ahead=ahead, aims=exits.second_nodes
        )
        return Ways(
            exits,
            there=there,
            onward=onward,
            ahead=ahead,
            everywhere=everywhere,
        )

    def _trees(
        self,
        moves: Moves,
        driver_class: int,
        free: tuple[int, ...],
        **others: Any,
    ) -> Trees:
        """Return routes at the times that a class of drivers sees.

        others: arguments of `Trees`
        """
        seen = self.seen(driver_class, free)
        return Trees(moves, seen, self._times.turns, **others)

    def _ahead_of(self, back: Moves, region: int, driver_class: int) -> np.ndarray:
        """Return the time from behind the nearest gateway (s, (nodes,)).

        It is the time in free flow. back: reversed moves
        """
        nodes = back.number[self._exits[region].second]
        free = self._times.free * self._taste[driver_class]
        return back.ahead(nodes, free, self._times.free_turns)
