"""Travel times of streets and junctions, and searches for fastest routes.

A few vehicles are on one street at a time, so recent minutes count together, the newest most: on a
street by the mean speed, over a junction by Little's law, vehicles on it over vehicles that get
over it per second. In the mesoscopic model, which has no junctions to wait on, the newest control
interval counts half.
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from functools import cache, cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from cosim.plant.sampling import STANDING_M_S, StreetMeans
from cosim.sumo.arrays import EdgeMask, MoveEnds, PerEdge, PerGateway, PerMove
from cosim.sumo.net import City
from nmfd.arrays import PerRegion

MESO_SMOOTHING = 0.5  # weight of the newest control interval in the mesoscopic model
WINDOW_S = 300.0  # after which an observation counts a third
EMPTY_WEIGHT = 0.5  # of earlier observations after a control interval without vehicles
PRIOR_VEH_S = 3.0  # at the speed limit, which count besides
FAR_S = 1e9  # longer than any way
MOST_NODES = 20_000_000  # of the searches that are kept, of 12 bytes each
MOST_TOGETHER = 1000  # nodes of a graph with searches in one call: in larger ones, limits save more
MOST_WHOLE = 120  # nodes of a graph with searches from all of them
FEWEST_TREES = 8  # that are kept, however large the city: one decision needs as many
PerNode = Float[np.ndarray, " nodes"]  # of a graph of moves
Nodes = Int[np.ndarray, " nodes"]
GatewayNumbers = Int[np.ndarray, " G"]


class TravelTimes:
    """Travel times of one run.

    first, second: numbers of the edges that each move joins (M,); move: these two -> its number
    free, free_turns: in free flow, along edges (s, (E,)) and of moves over junctions (s, (M,))
    edges, turns: the same at present; turn_list: `turns` as a list
    """

    def __init__(self, city: City, *, lanes: bool = True):
        """lanes: False in the mesoscopic model"""
        self._lanes = lanes
        self.first, self.second = city.move_edges.T
        pairs = zip(self.first.tolist(), self.second.tolist(), strict=True)
        self.move = {pair: n for n, pair in enumerate(pairs)}
        self._length = np.array([city.length[edge] for edge in city.edges])
        self._limit = np.array([city.speed[edge] for edge in city.edges])
        self.free = city.free_time
        self.free_turns = city.move_time
        self.edges = self.free.copy()
        self.turns = self.free_turns.copy()
        self.turn_list = self.turns.tolist()
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
        self.turn_list = self.turns.tolist()


class Moves:
    """Moves between allowed edges as a graph whose nodes are these edges.

    number, node: edge -> its node, -1 for edges that are not allowed, as an array (E,) and a list
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
        self._columns = columns[kept].astype(np.int32)
        self._begins = np.searchsorted(rows[kept], nodes).astype(np.int32)
        self._ids = self.edges.tolist()

    def costing(self, time: PerEdge, turns: PerMove, ahead: PerNode | None = None) -> csr_array:
        """Return the graph with costs (s).

        They are the times of each move and of the edge that it leads to.

        time: of edges (s, (E,)); turns: of moves (s, (M,))
        ahead: lower bound of the time from each node to the nearest aim (s, (nodes,)), for an A*
            search: edge costs are reduced by the drop in this bound. Distances returned are
            therefore cost + ahead - ahead[start], and detours come last.
        """
        cost = np.maximum(time[self._second] + turns[self._kept], 1e-3)
        if ahead is not None:
            cost += ahead[self._columns] - np.repeat(ahead, np.diff(self._begins))
        return self._graph(cost)

    def leading_to(self, nodes: GatewayNumbers) -> Bool[np.ndarray, "nodes G"]:
        """Return which nodes lead to each of `nodes` (bool, (all nodes, G))."""
        moves = self._graph(np.ones(len(self._columns)))
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
        least = dijkstra(self.costing(time, turns).T.tocsr(), indices=nodes, min_only=True)
        # Just below the least time, because no move may cost nothing.
        return np.where(np.isfinite(least), (1.0 - 1e-6) * least, FAR_S)

    def path(self, before: Nodes, first: int, last: int) -> list[int]:
        """Return the edges from node `first` to node `last`.

        before: predecessors of a search from `last`
        """
        way = [self._ids[first]]
        while first != last:
            first = before[first]
            way.append(self._ids[first])
        return way

    def _graph(self, cost: Float[np.ndarray, " kept"]) -> csr_array:
        """Return the moves as a graph with these costs."""
        return csr_array((cost, self._columns, self._begins), shape=(len(self.edges),) * 2)


class _Tree(NamedTuple):
    """One search.

    most: its limit (s); costs: of every node (s, (nodes,)); before: predecessors (nodes,)
    times: to each aim (s)
    """

    most: float
    costs: PerNode
    before: Nodes
    times: list[float]


class Searches:
    """Cache of searches by owner and beginning.

    The least recently used go first.
    """

    def __init__(self, most: int = MOST_NODES):
        """most: nodes of all searches that are kept"""
        self._most = most
        self._nodes = 0
        self._trees: dict[tuple[object, int], _Tree] = {}

    def tree(
        self, owner: object, begin: int, most: float, search: Callable[[int, float], _Tree]
    ) -> _Tree:
        """Return the search of `owner` from a node.

        most: limit that the search has at least (s); search: does it
        """
        tree = self._trees.pop((owner, begin), None)
        if tree is None:
            tree = search(begin, most)
            self._nodes += len(tree.costs)
        elif tree.most < most:
            tree = search(begin, most)
        while self._nodes > self._most and len(self._trees) >= FEWEST_TREES:
            oldest = next(iter(self._trees))
            self._nodes -= len(self._trees.pop(oldest).costs)
        self._trees[owner, begin] = tree
        return tree


class Trees:
    """Fastest routes by `moves` from single edges.

    They are searched on demand and no further than needed.

    node: edge -> its node, as in `Moves`
    asked: nodes from which searches were needed
    """

    def __init__(
        self,
        moves: Moves,
        time: PerEdge,
        turns: PerMove,
        searches: Searches,
        ahead: PerNode | None = None,
        together: Iterable[int] = (),
        *,
        aims: Nodes | Sequence[int] = (),
        beyond: PerGateway | float = 0.0,
    ):
        """time: of edges (s, (E,)); turns: of moves (s, (M,))
        ahead: see `Moves.costing` (s, (nodes,))
        together: different nodes to search from in one call, when the first of them is needed
        aims: nodes that `times` are for; beyond: time from each aim on (s)
        """
        self.node = moves.node
        self._moves = moves
        self._costs = moves.costing(time, turns, ahead)
        self._searches = searches
        # Not this object itself: `searches` would hold it, and both would stay until the garbage is
        # collected.
        self._owner = object()
        self._ahead = ahead
        self._aims = np.array(aims, dtype=int)
        self._beyond = beyond
        self._row = {node: row for row, node in enumerate(together)}
        self._found: dict[int, _Tree] = {}  # of the searches done together
        self.asked: set[int] = set()

    def costs(self, begin: int, most: float) -> PerNode:
        """Return the times from edge `begin` (s, (nodes,)).

        Times above `most` may be infinite. They are less by the drop of `ahead`.
        """
        return self._tree(self.node[begin], most).costs

    def times(self, begin: int, most: float) -> list[float]:
        """Return the times from edge `begin` to each aim and beyond (s).

        Times above `most` may be infinite.
        """
        return self._tree(self.node[begin], most).times

    def back(self, begin: int, end: int) -> list[int]:
        """Return the edges from `end` back to `begin`, after its search."""
        first = self.node[end]
        last = self.node[begin]
        return self._moves.path(self._tree(last, 0.0).before, first, last)

    def _tree(self, node: int, most: float) -> _Tree:
        """Return the search from a node, at least up to `most` (s)."""
        tree = self._found.get(node)
        if tree is None:
            self.asked.add(node)
            row = self._row.get(node)
            if row is None:
                return self._searches.tree(self._owner, node, most, self._search)
            costs, before = self._searched_together
            tree = self._as_tree(node, math.inf, costs[row], before[row])
            self._found[node] = tree
        return tree

    def _search(self, node: int, most: float) -> _Tree:
        """Return a new search from a node up to `most` (s)."""
        found = dijkstra(self._costs, indices=node, return_predecessors=True, limit=most)
        return self._as_tree(node, most, *found)

    @cached_property
    def _searched_together(self) -> tuple[np.ndarray, np.ndarray]:
        """Return costs and predecessors from all nodes of `together`."""
        return dijkstra(self._costs, indices=[*self._row], return_predecessors=True)

    def _as_tree(self, node: int, most: float, costs: PerNode, before: Nodes) -> _Tree:
        """Return a search from a node up to `most` (s) with the times to the aims."""
        times = costs[self._aims]
        if self._ahead is not None:
            times = times + self._ahead[node]
        times = times + self._beyond
        return _Tree(most, costs, before, times.tolist())


class Choices(NamedTuple):
    """The fastest routes of a driver by each next region.

    times: (s), infinite if too long
    exist: True if there is a route, however long
    route: returns the edges of the n-th
    """

    times: list[float]
    exist: list[bool]
    route: Callable[[int], list[int]]


class Exits:
    """Gateways out of one region, with the moves that lead there and on.

    Gateway g leads from edge first[g] to second[g]. Gateways parts[n], from begins[n] on, lead into
    region neighbours[n].

    first, second, move: edges of each gateway, and move from one to the other (G,)
    inside: moves in the region; outside: reversed moves elsewhere
    first_nodes, second_nodes: nodes of first[g] in `inside`, and of second[g] in `outside` (G,)
    """

    def __init__(self, gateways: Int[np.ndarray, "G 4"], *, inside: Moves, outside: Moves):
        """gateways: first, second, move and next region, which rises"""
        self.first, self.second, self.move, next_region = gateways.T.copy()
        neighbours, begins = np.unique(next_region, return_index=True)
        self.neighbours: list[int] = neighbours.tolist()
        self.begins: list[int] = begins.tolist()
        self.parts = [slice(*part) for part in pairwise([*self.begins, len(next_region)])]
        self._bits = [(1 << part.stop) - (1 << part.start) for part in self.parts]
        self.inside = inside
        self.outside = outside
        self.first_nodes = inside.number[self.first]
        self.second_nodes = outside.number[self.second]

    def exist(self, here: int, target: int) -> list[bool]:
        """Return by which `neighbours` a way from `here` to `target` exists."""
        through = self._leading[self.inside.node[here]] & self._reached[self.outside.node[target]]
        return [through & gateways != 0 for gateways in self._bits]

    @cached_property
    def _leading(self) -> list[int]:
        """Return to which gateways each edge inside leads, a bit for each."""
        return _as_bits(self.inside.leading_to(self.first_nodes))

    @cached_property
    def _reached(self) -> list[int]:
        """Return from which gateways each edge outside is reached, a bit for each."""
        return _as_bits(self.outside.leading_to(self.second_nodes))


class Returning(NamedTuple):
    """Fastest routes by all moves, for those that come back into a region.

    nodes: of first[g] (G,)
    entering: time from the end of first[g] to that of second[g] (s)
    back: no more than the time from behind the nearest gateway back to first[g] (s)
    """

    trees: Trees
    nodes: GatewayNumbers
    entering: Sequence[float]
    back: Sequence[float]


class Ways:
    """Fastest routes out of one region by each of its G gateways.

    Searches start where drivers are and where they go, on demand and no further than needed. A
    route that comes back into the region before it leaves for good (`returning`) has the same end,
    from the last gateway on.
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
            around = _sums(everywhere.back, everywhere.entering)
            self._back_soonest = min(around, default=math.inf)

    def choices(self, here: int, target: int, longest: float, detour: float) -> Choices:
        """Return the fastest routes from `here` to `target` by each next region.

        longest: no less than the fastest of all takes (s), infinite if unknown
        detour: beyond this, routes that take longer are left out (s)
        """
        cost = self.cost(here, target, detour + longest)
        parts = self.exits.parts
        times = [min(cost[part]) for part in parts]
        exist = [True] * len(times)
        if math.inf in times:
            exist = self.exits.exist(here, target)
        fastest = min(times, default=math.inf)
        back = None
        time, gateway = self.returning(here, target, min(fastest, longest))
        if time < fastest:
            back = bisect_right(self.exits.begins, gateway) - 1
            times[back] = time
            exist[back] = True

        def route(n: int) -> list[int]:
            if n == back:
                return self.route(here, gateway, target, returning=True)
            return self.route(here, cost.index(times[n], parts[n].start), target)

        return Choices(times, exist, route)

    def cost(self, here: int, target: int, most: float) -> list[float]:
        """Return times from the end of `here` to that of `target` by gateway (s).

        They are infinite above `most`.
        """
        ahead = self._ahead[self._onward.node[target]]
        there = self._there.times(here, max(most - ahead, 0.0))
        nearest = min(there, default=math.inf)
        if nearest == math.inf:
            return there
        left = max(most - min(nearest, most) - ahead, 0.0)
        return _sums(there, self._onward.times(target, left))

    def returning(self, here: int, target: int, most: float) -> tuple[float, int]:
        """Return the time of the fastest route of all (s), and its last gateway.

        The time is infinite if it is `most` or longer, or if the route does not come back into the
        region. Call it after `cost`.
        """
        if self._everywhere is None:
            return math.inf, 0
        everywhere = self._everywhere
        # By then it has left, and come back, which alone takes too long for most drivers.
        left = min(self._there.times(here, 0.0), default=math.inf)
        if left + self._back_soonest + self._ahead[self._onward.node[target]] >= most:
            return math.inf, 0
        ends = _sums(everywhere.entering, self._onward.times(target, 0.0))
        for gateway, back in enumerate(everywhere.back):
            if left + back + ends[gateway] >= most:
                ends[gateway] = math.inf
        nearest = min(ends)
        if nearest == math.inf:
            return math.inf, 0
        costs = everywhere.trees.costs(here, most - nearest)[everywhere.nodes] + ends
        gateway = int(costs.argmin())
        return float(costs[gateway]), gateway

    def route(self, here: int, gateway: int, target: int, *, returning: bool = False) -> list[int]:
        """Return the edges from `here` to `target` through a gateway.

        Call it after `cost`, or after `returning` for a route that comes back.
        """
        trees = self._there
        if returning and self._everywhere:
            trees = self._everywhere.trees
        inside = trees.back(here, int(self.exits.first[gateway]))
        return inside[::-1] + self._onward.back(target, int(self.exits.second[gateway]))


def _as_bits(rows: Bool[np.ndarray, "rows G"]) -> list[int]:
    """Return each row as a number with a bit for each of its entries."""
    packed = np.packbits(rows, axis=1, bitorder="little")
    return [int.from_bytes(row, "little") for row in packed]


def _sums(first: Sequence[float], second: Sequence[float]) -> list[float]:
    return [a + b for a, b in zip(first, second, strict=True)]


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
                    pair = city.number[gateway.from_edge], city.number[gateway.to_edge]
                    rows.append((*pair, times.move[pair], gateway.target))
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
        self._trees = cache(self._trees_of)
        self._seen = cache(self._seen_by)
        self.time = cache(self._time)
        self.home = cache(self._home)
        self.ways = cache(self._ways)
        # Moves and class of drivers -> searches without prices.
        self._unpriced: dict[tuple[Moves, int], Trees] = {}
        self.command(None)

    def command(self, prices: PerRegion | None) -> None:
        """Begin a control interval with new travel times.

        prices: of the regions (-, (R,)); None: no prices
        """
        self._prices = np.zeros(len(self.regions)) if prices is None else prices
        # Many drivers are where others were, or go where others went.
        self._asked = {key: sorted(trees.asked) for key, trees in self._unpriced.items()}
        self._unpriced.clear()
        self._searches = Searches()
        self._free = []
        for destination in self.regions:
            free = [r for r in self.regions if r == destination or not self._prices[r]]
            self._free.append(tuple(free))
        self._trees.cache_clear()
        self._seen.cache_clear()
        self.time.cache_clear()
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

    def _time(self, driver_class: int, free: tuple[int, ...]) -> list[float]:
        """Return the times of `_seen_by` as a list, for single edges."""
        return self._seen(driver_class, free).tolist()

    def _home(self, region: int, driver_class: int, free: tuple[int, ...]) -> Trees:
        """Return routes to edges of a region.

        They stay inside it, unless routes may return.
        """
        return self._trees(self._homeward[region], driver_class, free)

    def _ways(self, region: int, driver_class: int, free: tuple[int, ...]) -> Ways:
        """Return routes out of a region to edges of others."""
        exits = self._exits[region]
        second = self._seen(driver_class, free)[exits.second]
        over = self._times.turns[exits.move] + second
        ahead = self._ahead(exits.outside, region, driver_class)
        everywhere = None
        if self._everywhere:
            trees = self._trees(self._everywhere, driver_class, free)
            back = self._ahead(self._homeward[region], region, driver_class)[exits.first]
            nodes = self._everywhere.number[exits.first]
            everywhere = Returning(trees, nodes, over.tolist(), back.tolist())
        there = self._trees_of(
            exits.inside,
            driver_class,
            free,
            aims=exits.first_nodes,
            beyond=over if self._lanes else second,
        )
        onward = self._trees_of(
            exits.outside, driver_class, free, ahead=ahead, aims=exits.second_nodes
        )
        return Ways(
            exits,
            there=there,
            onward=onward,
            ahead=ahead,
            everywhere=everywhere,
        )

    def _trees_of(
        self,
        moves: Moves,
        driver_class: int,
        free: tuple[int, ...],
        **others: Any,
    ) -> Trees:
        """Return routes at the times that a class of drivers sees.

        others: arguments of `Trees`
        """
        seen = self._seen(driver_class, free)
        turns = self._times.turns
        # With prices, results depend on how far searches go.
        if free != self.regions:
            return Trees(moves, seen, turns, self._searches, **others)
        key = (moves, driver_class)
        together: Iterable[int] = ()
        nodes = len(moves.edges)
        if nodes <= MOST_WHOLE:
            together = range(nodes)
        elif nodes <= MOST_TOGETHER:
            together = self._asked.get(key, ())
        self._unpriced[key] = Trees(moves, seen, turns, self._searches, together=together, **others)
        return self._unpriced[key]

    def _ahead_of(self, back: Moves, region: int, driver_class: int) -> np.ndarray:
        """Return the time from behind the nearest gateway (s, (nodes,)).

        It is the time in free flow. back: reversed moves
        """
        nodes = back.number[self._exits[region].second]
        free = self._times.free * self._taste[driver_class]
        return back.ahead(nodes, free, self._times.free_turns)
