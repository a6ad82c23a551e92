"""Travel times along streets and over junctions, and searches for the fastest ways at these times.

A few vehicles are on one street at a time, so recent minutes count together, the newest most: on a
street by the mean speed, over a junction by Little's law, vehicles on it over vehicles that get
over it per second. In the mesoscopic model, which has no junctions to wait on, the newest control
interval counts half.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from cosim.plant.sampling import STANDING_M_S, StreetMeans
from cosim.sumo.arrays import EdgeMask, GatewayMask, MoveEnds, PerEdge, PerGateway, PerMove
from cosim.sumo.net import City

MESO_SMOOTHING = 0.5  # weight of the newest control interval in the mesoscopic model
WINDOW_S = 300.0  # after which an observation counts a third
EMPTY_WEIGHT = 0.5  # of earlier observations after a control interval without vehicles
PRIOR_VEH_S = 3.0  # at the speed limit, which count besides
FAR_S = 1e9  # longer than any way
MOST_NODES = 20_000_000  # of the searches that are kept, of 12 bytes each
FEWEST_TREES = 8  # that are kept, however large the city: one decision needs as many


class TravelTimes:
    """Travel times of one run.

    first, second: (M,), numbers of the edges that each move joins; free: (E,) [s], in free flow;
        free_turns: (M,) [s]
    edges: (E,) [s], present times along edges; turns: (M,) [s], of moves over junctions
    """

    def __init__(self, city: City, *, lanes: bool = True):
        """lanes: False in the mesoscopic model"""
        self._lanes = lanes
        moves = [(e, f) for e, after in city.successors.items() for f in after]
        self.first, self.second = np.array([(city.number[e], city.number[f]) for e, f in moves]).T
        self._length = np.array([city.length[edge] for edge in city.edges])
        self._limit = np.array([city.speed[edge] for edge in city.edges])
        self.free, self.free_turns = (
            self._length / self._limit,
            np.array([city.turn_time[move] for move in moves]),
        )
        self.edges, self.turns = self.free.copy(), self.free_turns.copy()
        inside = {edge: n for n, edge in enumerate(city.inside)}
        self._longest = np.array(list(city.inside.values())) / STANDING_M_S
        # Pairs of moves and internal edges that they lead over, which several moves may share.
        over = [
            (n, inside[edge])
            for n, move in enumerate(moves)
            for edge in city.over.get(move, ())
            if edge in inside
        ]
        self._move, self._via = np.array(over, dtype=int).reshape(-1, 2).T
        # Weighted sums: time [veh s] and distance [veh m] on edges, time and ways over [veh] on
        # internal ones.
        self._spent, self._driven = np.zeros((2, len(city.edges)))
        self._crossing, self._crossed = np.zeros((2, len(inside)))

    def learn(self, seen: StreetMeans) -> None:
        """Update the times from the means of a control interval."""
        if not self._lanes:
            now = np.where(
                np.isnan(seen.speed), self.free, self._length / np.maximum(seen.speed, STANDING_M_S)
            )
            self.edges = self.edges + MESO_SMOOTHING * (np.maximum(now, self.free) - self.edges)
            return
        kept, spent = math.exp(-seen.duration / WINDOW_S), seen.timed * seen.duration
        used = spent > 0.0
        kept_here = np.where(used, kept, min(kept, EMPTY_WEIGHT))
        self._spent = kept_here * self._spent + spent
        self._driven = kept_here * self._driven + spent * np.where(used, seen.speed, 0.0)
        speed = (self._driven + PRIOR_VEH_S * self._limit) / (self._spent + PRIOR_VEH_S)
        speed[seen.speed == 0.0] = 0.0  # closed, or all vehicles stand
        self.edges = np.maximum(self._length / np.maximum(speed, STANDING_M_S), self.free)
        self._crossing = kept * self._crossing + seen.crossing * seen.duration
        self._crossed = kept * self._crossed + seen.crossed * seen.duration
        # Over each internal edge [s], 0 without vehicles.
        standing = np.where(self._crossing > 0.0, self._longest, 0.0)
        takes = np.divide(self._crossing, self._crossed, out=standing, where=self._crossed > 0.0)
        over = np.minimum(takes, self._longest)[self._via]
        self.turns = np.maximum(np.bincount(self._move, over, len(self.turns)), self.free_turns)


class Moves:
    """Moves between allowed edges as a graph of these edges, from first[n] to second[n] or,
    reversed, back.

    number: edge -> its node, -1 for edges that are not allowed
    """

    def __init__(self, first: MoveEnds, second: MoveEnds, *, allowed: EdgeMask, reverse: bool):
        """first, second: (M,), numbers of edges; allowed: (E,)"""
        self.edges = np.flatnonzero(allowed)
        self.number = np.full(len(allowed), -1)
        self.number[self.edges] = np.arange(len(self.edges))
        rows, columns = (
            self.number[part] for part in ((second, first) if reverse else (first, second))
        )
        kept = np.flatnonzero(allowed[first] & allowed[second])
        kept = kept[np.lexsort((columns[kept], rows[kept]))]
        self._kept, self._second, self._columns = kept, second[kept], columns[kept].astype(np.int32)
        self._begins = np.searchsorted(rows[kept], np.arange(len(self.edges) + 1)).astype(np.int32)
        self._ids = self.edges.tolist()

    def costing(
        self, time: PerEdge, turns: PerMove, ahead: Float[np.ndarray, " nodes"] | None = None
    ) -> csr_array:
        """Return the graph with costs [s]: of a move (turns, (M,)) and of the edge that it leads to
        (time, (E,)).

        ahead: (nodes,) [s]; costs are less by the time that a move comes nearer, so that a search
            from t finds cost +
        ahead - ahead[t], and detours last (A*)
        """
        cost = np.maximum(time[self._second] + turns[self._kept], 1e-3)
        if ahead is not None:
            cost += ahead[self._columns] - np.repeat(ahead, np.diff(self._begins))
        return csr_array((cost, self._columns, self._begins), shape=(len(self.edges),) * 2)

    def leading_to(self, nodes: Int[np.ndarray, " G"]) -> Bool[np.ndarray, "nodes G"]:
        """Return (all nodes, G) bool: each of `nodes` (G,) can be reached from it."""
        moves = csr_array(
            (np.ones(len(self._columns)), self._columns, self._begins), shape=(len(self.edges),) * 2
        )
        # Nodes that lead to each other are reached from the same ones: in most cities nearly all.
        _, part = connected_components(moves, connection="strong")
        _, once, which = np.unique(part[nodes], return_index=True, return_inverse=True)
        return np.isfinite(dijkstra(moves.T.tocsr(), indices=nodes[once], unweighted=True)).T[
            :, which
        ]

    def ahead(
        self, nodes: Int[np.ndarray, " G"], time: PerEdge, turns: PerMove
    ) -> Float[np.ndarray, " nodes"]:
        """Return (all nodes,) [s], just below the time to the nearest of `nodes` (G,), FAR_S if
        there is none."""
        least = dijkstra(self.costing(time, turns).T.tocsr(), indices=nodes, min_only=True)
        return np.where(
            np.isfinite(least), (1.0 - 1e-6) * least, FAR_S
        )  # below: no move may cost nothing

    def path(self, before: Int[np.ndarray, " nodes"], first: int, last: int) -> list[int]:
        """Return the edges from node `first` to node `last` by the predecessors of a search from
        `last`."""
        way = [self._ids[first]]
        while first != last:
            first = before[first]
            way.append(self._ids[first])
        return way


class Searches:
    """Cache of searches by owner and beginning, at most `most` nodes in all; the least recently
    used go first."""

    def __init__(self, most: int = MOST_NODES):
        self._most, self._nodes = most, 0
        self._trees: dict[tuple[object, int], tuple[float, np.ndarray, np.ndarray]] = {}

    def tree(
        self, owner: object, begin: int, costs: csr_array, most: float
    ) -> tuple[float, Float[np.ndarray, " nodes"], Int[np.ndarray, " nodes"]]:
        """Return limit [s], costs [s] and predecessors of the search of `owner` from node `begin`,
        up to `most` [s]."""
        tree = self._trees.pop((owner, begin), None)
        self._nodes += costs.shape[0] if tree is None else 0
        if tree is None or tree[0] < most:
            tree = most, *dijkstra(costs, indices=begin, return_predecessors=True, limit=most)
        while self._nodes > self._most and len(self._trees) >= FEWEST_TREES:
            self._nodes -= len(self._trees.pop(next(iter(self._trees)))[1])
        self._trees[owner, begin] = tree
        return tree


class Trees:
    """Fastest ways by `moves` from single edges, searched on demand and no further than needed."""

    def __init__(
        self,
        moves: Moves,
        time: PerEdge,
        turns: PerMove,
        searches: Searches,
        ahead: Float[np.ndarray, " nodes"] | None = None,
    ):
        """time: (E,) [s]; turns: (M,) [s]; ahead: (nodes,) [s], see `Moves.costing`"""
        self.time, self.number = time, moves.number
        self._moves, self._costs = moves, moves.costing(time, turns, ahead)
        # Not this object itself: `searches` would hold it, and both would stay until the garbage is
        # collected.
        self._searches, self._owner = searches, object()

    def costs(self, begin: int, most: float) -> Float[np.ndarray, " nodes"]:
        """Return (nodes,) [s] from edge `begin`; more than `most` may be infinite."""
        return self._searches.tree(self._owner, int(self.number[begin]), self._costs, most)[1]

    def back(self, begin: int, end: int) -> list[int]:
        """Return the edges from `end` back to `begin`, after `costs` of `begin`."""
        first, last = int(self.number[end]), int(self.number[begin])
        return self._moves.path(
            self._searches.tree(self._owner, last, self._costs, 0.0)[2], first, last
        )


class Ways:
    """Fastest ways out of one region by each of its G gateways (first[g] -> second[g], into
    next_region[g]).

    Gateways begins[n] to ends[n] - 1 lead into region neighbours[n]. Searches start where drivers
    are and where they go, on demand and no further than needed. A way that comes back into the
    region before it leaves for good (`returning`) has the same end, from the last gateway on.
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
        """first, second, next_region: (G,), the last one rising
        inside: moves in the region; outside: reversed moves elsewhere; crossing: (G,) [s], over
            each gateway
        leading: (nodes of `inside`, G), first[g] can be reached; reached: (nodes of `outside`, G),
            from second[g]
        ahead: (nodes of `outside`,) [s], to the nearest second[g] at times not above `time` (E,)
            and `turns` (M,) [s]
        everywhere: ways by all moves, (G,) [s] over each gateway on these, and (G,) [s], not above
            the time from behind the nearest gateway back to first[g]; None if no way may come back
        """
        self.time, self._ahead, self._leading, self._reached = time, ahead, leading, reached
        self._there, self._onward = (
            Trees(inside, time, turns, searches),
            Trees(outside, time, turns, searches, ahead),
        )
        self._first, self._second, self._entering = first, second, crossing + time[second]
        self._exits, self._entries, self._everywhere = (
            inside.number[first],
            outside.number[second],
            everywhere,
        )
        self.neighbours, self.begins = np.unique(next_region, return_index=True)
        self.ends = np.append(self.begins[1:], len(next_region))

    def cost(self, here: int, target: int, most: float) -> tuple[PerGateway, GatewayMask]:
        """Return (G,) [s] from the end of `here` to that of `target`, infinite above `most`; (G,),
        a way exists."""
        last = int(self._onward.number[target])
        open_ways = self._leading[self._there.number[here]] & self._reached[last]
        there = self._to_entries(here, max(most - self._ahead[last], 0.0))
        if (nearest := float(there.min(initial=np.inf))) == np.inf:
            return there, open_ways
        return there + self._from_entries(
            target, max(most - min(nearest, most) - self._ahead[last], 0.0)
        ), open_ways

    def returning(self, here: int, target: int, most: float) -> tuple[float, int]:
        """Return [s] of the fastest way of all, and its last gateway, after `cost`.

        Infinite if it takes `most` or longer, or does not come back into the region.
        """
        if self._everywhere is None:
            return np.inf, 0
        trees, over, back = self._everywhere
        end = over + self.time[self._second] + self._from_entries(target, 0.0)
        # By then it has left, and come back, which alone takes too long for most gateways.
        end[self._to_entries(here, 0.0).min(initial=np.inf) + back + end >= most] = np.inf
        if (nearest := float(end.min(initial=np.inf))) == np.inf:
            return np.inf, 0
        cost = trees.costs(here, most - nearest)[trees.number[self._first]] + end
        gateway = int(cost.argmin())
        return float(cost[gateway]), gateway

    def route(self, here: int, gateway: int, target: int, *, returning: bool = False) -> list[int]:
        """Return the edges from `here` to `target` through `gateway`, after `cost`; or those of
        `returning`."""
        trees = self._everywhere[0] if returning and self._everywhere else self._there
        first, second = int(self._first[gateway]), int(self._second[gateway])
        return trees.back(here, first)[::-1] + self._onward.back(target, second)

    def _to_entries(self, here: int, most: float) -> PerGateway:
        """Return (G,) [s] from the end of `here` to that of second[g]."""
        return self._there.costs(here, most)[self._exits] + self._entering

    def _from_entries(self, target: int, most: float) -> PerGateway:
        """Return (G,) [s] from the end of second[g] to that of `target`."""
        return (
            self._onward.costs(target, most)[self._entries]
            + self._ahead[self._onward.number[target]]
        )
