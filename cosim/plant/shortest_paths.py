"""Searches for fastest ways in a city of regions, at given travel times."""

from collections import OrderedDict
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from cosim.sumo.arrays import EdgeMask, GatewayMask, MoveEnds, PerEdge, PerGateway, PerMove

FAR = 1e9  # s, longer than any way
MOST_KEPT = 20_000_000  # nodes of the trees that are kept, of 4 to 12 bytes each
FEWEST_KEPT = 8  # trees, however large the city: those that a decision needs at once


class Moves:
    """The moves between allowed edges as a graph of these edges, from first[n] to second[n] or, reversed, back.

    number: edge -> its node, -1 for edges that are not allowed
    """

    def __init__(self, first: MoveEnds, second: MoveEnds, *, allowed: EdgeMask, reverse: bool):
        """first, second: (M,), numbers of edges; allowed: (E,), edges"""
        self.edges = np.flatnonzero(allowed)
        self.number = np.full(len(allowed), -1)
        self.number[self.edges] = np.arange(len(self.edges))
        rows, columns = (self.number[part] for part in ((second, first) if reverse else (first, second)))
        kept = np.flatnonzero(allowed[first] & allowed[second])
        kept = kept[np.lexsort((columns[kept], rows[kept]))]
        self._kept, self._second, self._columns = kept, second[kept], columns[kept].astype(np.int32)
        self._begins = np.searchsorted(rows[kept], np.arange(len(self.edges) + 1)).astype(np.int32)
        self._ids = self.edges.tolist()

    def costing(self, time: PerEdge, turns: PerMove, ahead: Float[np.ndarray, " nodes"] | None = None) -> csr_array:
        """A move costs its own time, of `turns` (M,) [s], and `time` (E,) [s] of the edge that it leads to; less the
        time by which it comes nearer, of `ahead` (nodes,) [s], if that is given: then a search from t finds cost +
        ahead - ahead[t], and what leads astray last (A*)."""
        cost = np.maximum(time[self._second] + turns[self._kept], 1e-3)
        if ahead is not None:
            cost += ahead[self._columns] - np.repeat(ahead, np.diff(self._begins))
        return csr_array((cost, self._columns, self._begins), shape=(len(self.edges),) * 2)

    def leading_to(self, nodes: Int[np.ndarray, " G"]) -> Bool[np.ndarray, "nodes G"]:
        """(all nodes, G) bool: from which of all nodes each of `nodes` (G,) can be reached."""
        moves = csr_array((np.ones(len(self._columns)), self._columns, self._begins), shape=(len(self.edges),) * 2)
        # Nodes that lead to each other are reached from the same ones: in most cities nearly all.
        _, part = connected_components(moves, connection="strong")
        _, once, which = np.unique(part[nodes], return_index=True, return_inverse=True)
        return np.isfinite(dijkstra(moves.T.tocsr(), indices=nodes[once], unweighted=True)).T[:, which]

    def ahead(self, nodes: Int[np.ndarray, " G"], time: PerEdge, turns: PerMove) -> Float[np.ndarray, " nodes"]:
        """(all nodes,) [s]: hardly less than the time from each to the nearest of `nodes` (G,) at `time` (E,) [s] and
        `turns` (M,) [s], and FAR where none can be reached."""
        least = dijkstra(self.costing(time, turns).T.tocsr(), indices=nodes, min_only=True)
        return np.where(np.isfinite(least), (1.0 - 1e-6) * least, FAR)  # less, for no move may cost nothing

    def path(self, before: Int[np.ndarray, " nodes"], first: int, last: int) -> list[int]:
        """The edges from node `first` to node `last` by the predecessors `before` of a search from `last`."""
        way = [self._ids[first]]
        while first != last:
            first = before[first]
            way.append(self._ids[first])
        return way


class Searches:
    """Trees of fastest ways, by where they begin, of one owner or several: of all together `most` nodes are kept, and
    the tree that was not asked for longest goes first. Without a limit guidance keeps thousands of them, of 0.2 MB each
    in a city of 17,000 edges.
    """

    def __init__(self, most: int = MOST_KEPT):
        self._most, self._nodes = most, 0
        self._trees: OrderedDict[tuple[object, int], tuple[tuple, int]] = OrderedDict()

    def get(self, owner: object, begin: int) -> tuple[Any, ...] | None:
        """What `owner` put there for `begin`, if it is still there."""
        if (found := self._trees.get((owner, begin))) is None:
            return None
        self._trees.move_to_end((owner, begin))
        return found[0]

    def put(self, owner: object, begin: int, tree: tuple, nodes: int) -> tuple[Any, ...]:
        """Keep it, instead of what was there, and at least the newest FEWEST_KEPT; returns it."""
        _, before = self._trees.pop((owner, begin), (None, 0))
        self._trees[owner, begin] = tree, nodes
        self._nodes += nodes - before
        while self._nodes > self._most and len(self._trees) > FEWEST_KEPT:
            _, (_, gone) = self._trees.popitem(last=False)
            self._nodes -= gone
        return tree


class Trees:
    """Fastest ways by `moves` from single edges, searched when somebody first asks for one, and no further than they
    would go."""

    def __init__(self, moves: Moves, time: PerEdge, turns: PerMove, searches: Searches):
        """time: (E,) [s]; turns: (M,) [s]"""
        self.time, self.number = time, moves.number
        self._moves, self._costs = moves, moves.costing(time, turns)
        # Not this object itself: `searches` would hold it, and both would stay until the garbage is collected.
        self._searches, self._owner = searches, object()

    def costs(self, begin: int, most: float) -> Float[np.ndarray, " nodes"]:
        """(nodes,) [s] by `moves` from edge `begin`, `number` having the node of an edge; what is more than `most` may
        be infinite."""
        found = self._searches.get(self._owner, begin)
        if found is None or found[0] < most:
            cost, before = dijkstra(self._costs, indices=self.number[begin], return_predecessors=True, limit=most)
            found = self._searches.put(self._owner, begin, (most, cost, before), len(cost))
        return found[1]

    def back(self, begin: int, end: int) -> list[int]:
        """The edges from `end` back to `begin`, whose costs were asked for just now."""
        found = self._searches.get(self._owner, begin)
        assert found is not None  # they were asked for
        return self._moves.path(found[2], int(self.number[end]), int(self.number[begin]))


class Home(Trees):
    """Fastest ways to single edges: `moves` lead back."""

    def cost(self, here: int, target: int, most: float) -> float:
        """[s] from the end of edge `here` to the end of edge `target`, infinite if it is more than `most`."""
        cost = self.costs(target, most)[self.number[here]]
        return float(cost) if cost <= most else np.inf

    def route(self, here: int, target: int) -> list[int]:
        """The edges from `here` to `target`, whose cost was asked for just now."""
        return self.back(target, here)


class Ways:
    """Fastest ways out of one region by each of its G gateways (first[g] -> second[g], into next_region[g]).

    Gateways begins[n] to ends[n] - 1 lead into region neighbours[n]. Searched is from where drivers are and from where
    they go, when somebody first is or goes there, and no further than they would go: in a large city that is much less
    than from all gateways to everywhere.

    A way may also come back into the region before it leaves for good (`returning`): then it has the same end as one
    that does not, from the last gateway on, and only the part before that is to be searched elsewhere.
    """

    def __init__(
        self,
        first: Int[np.ndarray, " G"],
        second: Int[np.ndarray, " G"],
        next_region: Int[np.ndarray, " G"],
        *,
        inside: Moves,
        outside: Moves,
        crossing: PerGateway,
        leading: Bool[np.ndarray, "inside G"],
        reached: Bool[np.ndarray, "nodes G"],
        ahead: Float[np.ndarray, " nodes"],
        time: PerEdge,
        turns: PerMove,
        searches: Searches,
        everywhere: tuple[Trees, PerGateway, PerGateway] | None = None,
    ):
        """first, second, next_region: (G,), the last in rising order; inside: moves in the region; outside: those
        elsewhere, back; crossing: (G,) [s], over each gateway; leading: (nodes of `inside`, G), from which edges
        first[g] can be reached; reached: (nodes of `outside`, G), which edges can be reached from second[g]; ahead:
        (nodes of `outside`,) [s], to the nearest second[g] at times that are no more than `time` (E,) [s] and `turns`
        (M,) [s]; everywhere: ways by all moves at the same times, (G,) [s] over each gateway on such a way, and (G,)
        [s], no more than it takes from behind the nearest gateway back to first[g]; None where no way may come back"""
        self.time, self._inside, self._outside, self._ahead = time, inside, outside, ahead
        self._leading, self._reached = leading, reached
        self._gates, self._first, self._second = first, inside.number[first], outside.number[second]
        self._entering, self._everywhere = crossing + time[second], None
        if everywhere is not None:
            trees, over, back = everywhere
            self._everywhere = trees, trees.number[first], over + time[second], back
        self.neighbours, self.begins = np.unique(next_region, return_index=True)
        self.ends = np.append(self.begins[1:], len(next_region))
        self._costs = inside.costing(time, turns), outside.costing(time, turns, ahead)
        self._searches, self._from_here, self._to_there = searches, object(), object()

    def cost(self, here: int, target: int, most: float) -> tuple[PerGateway, GatewayMask]:
        """(G,) [s] from the end of edge `here` to the end of edge `target`, infinite if it is more than `most`, and
        (G,) bool, whether there is a way at all."""
        last = int(self._outside.number[target])
        open_ways = self._leading[self._inside.number[here]] & self._reached[last]
        within = max(most - self._ahead[last], 0.0)
        found = self._searches.get(self._from_here, here)
        if found is None or found[0] < within:
            cost, before = dijkstra(
                self._costs[0], indices=self._inside.number[here], return_predecessors=True, limit=within
            )
            there = cost[self._first] + self._entering
            found = self._searches.put(
                self._from_here, here, (within, there, float(there.min(initial=np.inf)), before), len(before)
            )
        _, there, nearest, _ = found
        if nearest == np.inf:
            return there, open_ways
        left = max(most - min(nearest, most) - self._ahead[last], 0.0)
        onward = self._searches.get(self._to_there, target)
        if onward is None or onward[0] < left:
            cost, after = dijkstra(self._costs[1], indices=last, return_predecessors=True, limit=left)
            onward = self._searches.put(
                self._to_there, target, (left, cost[self._second] + self._ahead[last], after), len(after)
            )
        return there + onward[1], open_ways

    def returning(self, here: int, target: int, most: float) -> tuple[float, int]:
        """[s] of the fastest way of all and the gateway by which it leaves for good, if it comes back before and takes
        less than `most`; infinite if not. `cost` was asked for just now, for as much at least."""
        there, onward = self._searches.get(self._from_here, here), self._searches.get(self._to_there, target)
        if self._everywhere is None or there is None or onward is None:  # or there is no way out
            return np.inf, 0
        trees, gates, entering, back = self._everywhere
        end = entering + onward[1]
        # By then it has left, and come back, which alone takes too long for most gateways.
        end[there[2] + back + end >= most] = np.inf
        if (nearest := float(end.min(initial=np.inf))) == np.inf:
            return np.inf, 0
        cost = trees.costs(here, most - nearest)[gates] + end
        gateway = int(cost.argmin())
        return float(cost[gateway]), gateway

    def route(self, here: int, gateway: int, target: int) -> list[int]:
        """The edges from `here` to `target` through `gateway`, whose cost was asked for just now."""
        there = self._searches.get(self._from_here, here)
        assert there is not None  # it was asked for
        to_gateway = self._inside.path(there[-1], int(self._first[gateway]), int(self._inside.number[here]))
        return to_gateway[::-1] + self._onward(gateway, target)

    def returning_route(self, here: int, gateway: int, target: int) -> list[int]:
        """As `route`, of a way that `returning` has found."""
        assert self._everywhere is not None  # it has found one
        return self._everywhere[0].back(here, int(self._gates[gateway]))[::-1] + self._onward(gateway, target)

    def _onward(self, gateway: int, target: int) -> list[int]:
        """The edges from behind `gateway` to `target`."""
        onward = self._searches.get(self._to_there, target)
        assert onward is not None  # it was asked for
        return self._outside.path(onward[2], int(self._second[gateway]), int(self._outside.number[target]))
