"""Searches for fastest ways in a city of regions, at given travel times."""

from collections import OrderedDict
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from cosim.sumo.arrays import EdgeMask, GatewayMask, MoveEnds, PerEdge, PerGateway, PerMove

FAR = 1e9               # s, longer than any way
MOST_KEPT = 20_000_000  # nodes of the trees that are kept, of 4 to 12 bytes each
FEWEST_KEPT = 8         # trees, however large the city: those that a decision needs at once


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

    def costing(
        self, time: PerEdge, turns: PerMove, ahead: Float[np.ndarray, " nodes"] | None = None,
    ) -> csr_array:
        """A move costs its own time, of `turns` (M,) [s], and `time` (E,) [s] of the edge that it leads to; less the
        time by which it comes nearer, of `ahead` (nodes,) [s], if that is given: then a search from t finds cost +
        ahead - ahead[t], and what leads astray last (A*)."""
        cost = np.maximum(time[self._second] + turns[self._kept], 1e-3)
        if ahead is not None:
            cost += ahead[self._columns] - np.repeat(ahead, np.diff(self._begins))
        return csr_array((cost, self._columns, self._begins), shape=(len(self.edges),) * 2)

    def leading_to(self, nodes: Int[np.ndarray, " G"]) -> Bool[np.ndarray, "nodes G"]:
        """(all nodes, G) bool: from which of all nodes each of `nodes` (G,) can be reached."""
        moves = csr_array(
            (np.ones(len(self._columns)), self._columns, self._begins), shape=(len(self.edges),) * 2)
        # Nodes that lead to each other are reached from the same ones: in most cities nearly all.
        _, part = connected_components(moves, connection="strong")
        _, once, which = np.unique(part[nodes], return_index=True, return_inverse=True)
        return np.isfinite(dijkstra(moves.T.tocsr(), indices=nodes[once], unweighted=True)).T[:, which]

    def ahead(
        self, nodes: Int[np.ndarray, " G"], time: PerEdge, turns: PerMove,
    ) -> Float[np.ndarray, " nodes"]:
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


class Home:
    """Fastest ways to single edges by `moves`, searched back from them when somebody first goes there."""

    def __init__(self, moves: Moves, time: PerEdge, turns: PerMove, searches: Searches):
        """time: (E,) [s]; turns: (M,) [s]"""
        self.time, self._moves, self._costs = time, moves, moves.costing(time, turns)
        # Not this object itself: `searches` would hold it, and both would stay until the garbage is collected.
        self._searches, self._back = searches, object()

    def cost(self, here: int, target: int, most: float) -> float:
        """[s] from the end of edge `here` to the end of edge `target`, infinite if it is more than `most`."""
        found = self._searches.get(self._back, target)
        if found is None or found[0] < most:
            cost, before = dijkstra(
                self._costs, indices=self._moves.number[target], return_predecessors=True, limit=most)
            found = self._searches.put(self._back, target, (most, cost, before), len(cost))
        cost = found[1][self._moves.number[here]]
        return float(cost) if cost <= most else np.inf

    def route(self, here: int, target: int) -> list[int]:
        """The edges from `here` to `target`, whose cost was asked for just now."""
        number, found = self._moves.number, self._searches.get(self._back, target)
        assert found is not None  # it was asked for
        return self._moves.path(found[2], int(number[here]), int(number[target]))


class Ways:
    """Fastest ways out of one region by each of its G gateways (first[g] -> second[g], into next_region[g]).

    Gateways begins[n] to ends[n] - 1 lead into region neighbours[n]. Searched is from where drivers are and from where
    they go, when somebody first is or goes there, and no further than they would go: in a large city that is much less
    than from all gateways to everywhere.
    """

    def __init__(
        self, first: Int[np.ndarray, " G"], second: Int[np.ndarray, " G"], next_region: Int[np.ndarray, " G"], *,
        inside: Moves, outside: Moves, crossing: PerGateway, reached: Bool[np.ndarray, "nodes G"],
        ahead: Float[np.ndarray, " nodes"], time: PerEdge, turns: PerMove, searches: Searches,
    ):
        """first, second, next_region: (G,), the last in rising order; inside: moves in the region; outside: those
        elsewhere, back; crossing: (G,) [s], over each gateway; reached: (nodes of `outside`, G), which edges can be
        reached from second[g]; ahead: (nodes of `outside`,) [s], to the nearest second[g] at times that are no more
        than `time` (E,) [s] and `turns` (M,) [s]"""
        self.time, self._inside, self._outside, self._reached, self._ahead = time, inside, outside, reached, ahead
        self._first, self._second, self._entering = (
            inside.number[first], outside.number[second], crossing + time[second])
        self.neighbours, self.begins = np.unique(next_region, return_index=True)
        self.ends = np.append(self.begins[1:], len(next_region))
        self._costs = inside.costing(time, turns), outside.costing(time, turns, ahead)
        self._searches, self._from_here, self._to_there = searches, object(), object()

    def cost(self, here: int, target: int, most: float) -> tuple[PerGateway, GatewayMask]:
        """(G,) [s] from the end of edge `here` to the end of edge `target`, infinite if it is more than `most`, and
        (G,) bool, whether there is a way at all."""
        found = self._searches.get(self._from_here, here)
        if found is None:
            cost, before = dijkstra(self._costs[0], indices=self._inside.number[here], return_predecessors=True)
            there = cost[self._first] + self._entering
            found = self._searches.put(self._from_here, here, (
                there, np.isfinite(there), float(there.min(initial=np.inf)), before), len(before))
        (there, leads_out, nearest, _), last = found, int(self._outside.number[target])
        if nearest == np.inf:
            return there, leads_out
        left = max(most - min(nearest, most) - self._ahead[last], 0.0)
        onward = self._searches.get(self._to_there, target)
        if onward is None or onward[0] < left:
            cost, after = dijkstra(self._costs[1], indices=last, return_predecessors=True, limit=left)
            onward = self._searches.put(
                self._to_there, target, (left, cost[self._second] + self._ahead[last], after), len(after))
        return there + onward[1], leads_out & self._reached[last]

    def route(self, here: int, gateway: int, target: int) -> list[int]:
        """The edges from `here` to `target` through `gateway`, whose cost was asked for just now."""
        there, onward = self._searches.get(self._from_here, here), self._searches.get(self._to_there, target)
        assert there is not None and onward is not None  # they were asked for
        to_gateway = self._inside.path(there[-1], int(self._first[gateway]), int(self._inside.number[here]))
        return to_gateway[::-1] + self._outside.path(
            onward[2], int(self._second[gateway]), int(self._outside.number[target]))
