"""Route guidance to reroutes: every vehicle is given its next region once per region it enters, in shares theta.

Drivers who are told travel times do not keep to the split ratios that they had without: what they would choose now is
followed up, and theta shifts it as it shifts the drivers' own split ratios in the regional model (`shifted`). A
controller that asks for these gets guidance by travel times alone; one that asks for everybody gets everybody.

Who is sent where is not drawn by lot: a driver at the western edge of a region would be sent round its eastern end as
often as the others, and trips get so much longer that guidance with the drivers' own split ratios jams a city that
flows without it (measured on grid7). Instead everybody takes the next region that costs least, with a bonus for the
regions that are behind their share; the bonus grows until the shares are met, by those who lose least.

A guided vehicle in region i bound for edge d takes the fastest way inside i to a gateway i -> h, and from there to d
without coming back to i, at the travel times of the last control interval (smoothed), as its group of drivers sees
them. In h it is guided again, and in the region of d it is sent there on the fastest way. Nobody is sent on a detour
that takes much longer, whatever theta says, and nobody leaves the way that he is on for a small gain: everybody who
changes his way makes the travel times that the others were told wrong.

Where the boundaries of the regions are ragged, a main road may leave i and come back. With `ways_return` the fastest
way of all is open to everybody, wherever it leads, and counts for the region that it enters when it leaves i for good;
other ways into h still never come back. Without it such a road is closed to guided drivers, however much it costs them.
"""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cosim.measure import Event
from cosim.regions import City
from cosim.sumo import Session

SMOOTHING = 0.5  # weight of the newest travel times
TASTES = 4       # groups of drivers who see different travel times: were they all sent one way, it would jam
SPREAD = 0.15    # standard deviation of the logarithm of their travel times
SLOWEST = 0.1    # m/s; slower is as good as standing
BONUS = 30.0     # s per vehicle that a region is behind its share
LOYALTY = 0.3    # a driver keeps his way if the best one does not save more than this share of its own time
MEMORY = 0.9     # of the vehicles assigned before and of their wishes, per control interval


def shifted(wish: np.ndarray, own: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Shares (n,) [-] that differ from `wish` as `theta` does from `own`.

    A next region that theta lowers loses the same part of those who wish to go there, and what is freed goes to the
    regions that theta raises, in proportion to by how much.
    """
    kept = wish * np.where(theta < own, theta / np.where(own > 0, own, 1.0), 1.0)
    raised = np.maximum(theta - own, 0.0)
    return kept + (wish.sum() - kept.sum()) * raised / max(raised.sum(), 1e-12)


class Guide:
    """Reroutes vehicles; `compliance` is the probability that a driver follows, drawn anew in every region, and
    `most_detour` [s] the most that a commanded next region may cost him.

    realised: (R, R, R) [veh], [i, h, j] = vehicles sent from i to h on their way to j since the start
    """

    def __init__(
        self, session: Session, city: City, own: np.ndarray, *, compliance: float, most_detour: float,
        random: np.random.Generator, ways_return: bool = False,
    ):
        """own: (R, R, R) [-], the drivers' own split ratios, which controllers mean as well"""
        self._own = own
        self._most_detour = most_detour
        self._session, self._city, self._compliance, self._random = session, city, compliance, random
        self._index = {edge: n for n, edge in enumerate(city.edges)}
        self._region = np.array([city.region_of[edge] for edge in city.edges])
        moves = [(e, f) for e, after in city.successors.items() for f in after]
        first, second = np.array([(self._index[e], self._index[f]) for e, f in moves]).T
        turn = np.array([city.turn_time[move] for move in moves])
        self._turn_time = dict(zip(zip(first.tolist(), second.tolist(), strict=True), turn.tolist(), strict=True))
        here = [self._region == region for region in range(city.regions)]
        self._within, within_back, self._without_back = (
            [_Moves(first, second, turn, allowed=allowed ^ outside, reverse=reverse) for allowed in here]
            for outside, reverse in ((False, False), (False, True), (True, True)))
        self._ways_return = ways_return
        if ways_return:
            within_back = [_Moves(first, second, turn, allowed=np.full(len(city.edges), True), reverse=True)]
        self._homeward = within_back  # by region, or one for all
        self._gateways = [
            np.array([(self._index[g.from_edge], self._index[g.to_edge], g.target)
                      for g in city.gateways if g.source == region], dtype=int).reshape(-1, 3).T
            for region in range(city.regions)]
        self._taste = np.exp(SPREAD * random.standard_normal((TASTES, len(city.edges))))
        self._length = np.array([city.length[edge] for edge in city.edges])
        self._free = self._length / np.array([city.speed[edge] for edge in city.edges])
        self._time = self._free.copy()
        self._reached: dict[int, np.ndarray] = {}
        self._ways: dict[tuple[int, int], _Ways] = {}
        self._homes: dict[tuple[int, int], _Home] = {}
        self._splits: np.ndarray | None = None
        self._assigned, self._wished = np.zeros((2, *(city.regions,) * 3))
        self.realised = np.zeros((city.regions,) * 3, dtype=int)
        self.refused = 0

    def command(self, splits: np.ndarray | None, speed: np.ndarray | None) -> None:
        """Take over theta (R, R, R) [-] for the next control interval; None: no guidance.

        speed: (E,) [m/s] of the city's edges, the mean over the last interval and NaN on empty ones; None: as before.
        A mean, because the speed at one instant is that of a red or a green signal, every time the same one.
        """
        self._splits = splits
        if splits is not None:
            if speed is not None:
                now = np.where(np.isnan(speed), self._free, self._length / np.maximum(speed, SLOWEST))
                self._time += SMOOTHING * (np.maximum(now, self._free) - self._time)
            self._ways, self._homes = {}, {}
            self._assigned *= MEMORY
            self._wished *= MEMORY

    def apply(self, events: list[Event]) -> None:
        """Guide the vehicles that departed or entered a region in the last step."""
        if self._splits is None:
            return
        for event in events:
            if event.free and self._random.random() < self._compliance:
                taste, target = int(self._random.integers(TASTES)), self._index.get(event.edge)
                here = self._index.get(self._session.road(event.vehicle))
                if target is None:  # it may use roads that are closed to cars, a taxi on its way to a bus road
                    continue
                if here is None or self._region[here] != event.region:  # on a junction already: too late to turn
                    continue
                if event.region == event.destination:
                    self._guide_home(event, here, target, taste)
                else:
                    self._guide_on(event, here, target, taste)

    def _guide_home(self, event: Event, here: int, target: int, taste: int) -> None:
        """The fastest way inside the region of destination; if ways may return, the fastest of all."""
        home = self._home(event.region, taste)
        present = self._present(event.vehicle)
        takes, bound = self._takes(present, here, home.time)
        cost = home.cost(here, target, takes + 1.0 if bound else np.inf)
        if here == target or not np.isfinite(cost) or self._keeps(present, here, takes, cost):
            return
        self._send(event.vehicle, home.route(here, target))

    def _guide_on(self, event: Event, here: int, target: int, taste: int) -> None:
        """The next region, and the fastest way through it."""
        ways = self._ways_from(event.region, taste)
        present = self._present(event.vehicle)
        takes, bound = self._takes(present, here, ways.time)
        cost, reached = ways.cost(here, target, self._most_detour + takes + 1.0 if bound else np.inf)
        least, open_ = np.minimum.reduceat(cost, ways.begins), np.logical_or.reduceat(reached, ways.begins)
        returning = None  # the next region of the fastest way of all, where that is one that comes back
        if self._ways_return:
            home = self._home(event.region, taste)
            fastest = home.cost(here, target, takes + 1.0 if bound else np.inf)
            if fastest < least.min(initial=np.inf):
                way = home.route(here, target)
                returning = int(np.searchsorted(ways.neighbours, self._next_region(way)))
                least[returning], open_[returning] = fastest, True
        if not np.isfinite(least).any():
            return
        cell = event.region, ways.neighbours, event.destination
        self._wished[event.region, ways.neighbours[np.argmin(least)], event.destination] += 1.0
        wish = self._wished[cell] / self._wished[cell].sum()
        shares = shifted(wish, self._own[cell], self._splits[cell]) * open_
        if shares.sum() <= 0:
            return
        shares /= shares.sum()
        behind = shares * (self._assigned[cell].sum() + 1.0) - self._assigned[cell]
        allowed = (shares > 1e-3) & (least <= least.min() + self._most_detour)
        if not allowed.any():  # every region with a share is too far out of the way
            allowed = least <= least.min()
        n = int(np.argmin(np.where(allowed, least - BONUS * behind, np.inf)))
        following = int(ways.neighbours[n])
        if not self._keeps(present, here, takes, least[n], following):
            if n != returning:
                way = ways.route(here, int(ways.begins[n] + np.argmin(cost[ways.begins[n] : ways.ends[n]])), target)
            if not self._send(event.vehicle, way):
                return
        self.realised[event.region, following, event.destination] += 1
        self._assigned[event.region, following, event.destination] += 1.0

    def _present(self, vehicle: str) -> list[int] | None:
        """The edges of the driver's present way from where he is; None where it uses roads that are closed to cars."""
        route = self._session.route(vehicle)[self._session.route_index(vehicle):]
        way = [self._index.get(edge) for edge in route]
        return None if None in way else way

    def _takes(self, present: list[int] | None, here: int, time: np.ndarray) -> tuple[float, bool]:
        """[s] from the end of edge `here` to the end of the present way, if it begins there, at `time` (E,) [s]; and
        whether it is a way that a search would find: by known moves and, unless ways may return, out of the region of
        `here` and never back."""
        if present is None or present[0] != here:
            return np.inf, False
        turns = [self._turn_time.get(move) for move in zip(present[:-1], present[1:], strict=True)]
        known = None not in turns
        elsewhere = self._region[present] != self._region[here]
        back = not self._ways_return and (elsewhere[:-1] & ~elsewhere[1:]).any()
        return time[present[1:]].sum() + sum(turns if known else filter(None, turns)), known and not back

    def _keeps(self, present: list[int] | None, here: int, takes: float, cost: float,
               following: int | None = None) -> bool:
        """Whether the driver's present way, which takes `takes` [s], is about as good as one of `cost` [s], and leads
        into the region `following` next, if that is given; so it is where the way uses roads that are closed to
        cars."""
        if present is None:
            return True
        if present[0] != here:
            return False
        if following is not None and self._next_region(present) != following:
            return False
        return takes <= (1.0 + LOYALTY) * cost

    def _next_region(self, way: list[int]) -> int:
        """The region that a way enters first, or, if ways may return, when it leaves its own for good; its own if it
        stays there."""
        regions = self._region[way]
        if self._ways_return:
            regions = regions[np.flatnonzero(regions == regions[0])[-1] :]
        return int(regions[np.argmax(regions != regions[0])])

    def _send(self, vehicle: str, way: list[int]) -> bool:
        """Give a vehicle this way; counts the refusals."""
        taken = self._session.set_route(vehicle, [self._city.edges[n] for n in way])
        self.refused += not taken
        return taken

    def _home(self, region: int, taste: int) -> "_Home":
        region = 0 if self._ways_return else region
        if (region, taste) not in self._homes:
            self._homes[region, taste] = _Home(self._homeward[region], self._time * self._taste[taste])
        return self._homes[region, taste]

    def _ways_from(self, region: int, taste: int) -> "_Ways":
        if region not in self._reached:
            outside = self._without_back[region]
            self._reached[region] = outside.leading_to(outside.number[self._gateways[region][1]])
        if (region, taste) not in self._ways:
            time = self._time * self._taste[taste]
            self._ways[region, taste] = _Ways(
                *self._gateways[region], inside=self._within[region], outside=self._without_back[region],
                reached=self._reached[region], time=time)
        return self._ways[region, taste]


class _Moves:
    """The moves between allowed edges as a graph of these edges, from first[n] to second[n] or, reversed, back.

    number: edge -> its node, -1 for edges that are not allowed
    """

    def __init__(self, first: np.ndarray, second: np.ndarray, turn: np.ndarray, *, allowed: np.ndarray, reverse: bool):
        """turn: [s], the time of a move; allowed: (E,), edges"""
        self.edges = np.flatnonzero(allowed)
        self.number = np.full(len(allowed), -1)
        self.number[self.edges] = np.arange(len(self.edges))
        rows, columns = (self.number[part] for part in ((second, first) if reverse else (first, second)))
        kept = np.flatnonzero(allowed[first] & allowed[second])
        kept = kept[np.lexsort((columns[kept], rows[kept]))]
        self._second, self._turn, self._columns = second[kept], turn[kept], columns[kept].astype(np.int32)
        self._begins = np.searchsorted(rows[kept], np.arange(len(self.edges) + 1)).astype(np.int32)
        self._ids = self.edges.tolist()

    def costing(self, time: np.ndarray) -> csr_array:
        """A move costs the time of the turn and `time` (E,) [s] of the edge that it leads to."""
        cost = np.maximum(time[self._second] + self._turn, 1e-3)
        return csr_array((cost, self._columns, self._begins), shape=(len(self.edges),) * 2)

    def leading_to(self, nodes: np.ndarray) -> np.ndarray:
        """(len(nodes), nodes) bool: from which of all nodes each of `nodes` can be reached."""
        once, which = np.unique(nodes, return_inverse=True)
        steps = csr_array(
            (np.ones(len(self._columns)), self._columns, self._begins), shape=(len(self.edges),) * 2).T.tocsr()
        return np.isfinite(dijkstra(steps, indices=once, unweighted=True))[which]

    def path(self, before: np.ndarray, first: int, last: int) -> list[int]:
        """The edges from node `first` to node `last` by the predecessors `before` of a search from `last`."""
        way = [self._ids[first]]
        while first != last:
            first = before[first]
            way.append(self._ids[first])
        return way


class _Home:
    """Fastest ways to single edges by `moves`, searched back from them when somebody first goes there."""

    def __init__(self, moves: _Moves, time: np.ndarray):
        """time: (E,) [s]"""
        self.time, self._moves, self._costs = time, moves, moves.costing(time)
        self._found: dict[int, tuple[float, np.ndarray, np.ndarray]] = {}

    def cost(self, here: int, target: int, most: float) -> float:
        """[s] from the end of edge `here` to the end of edge `target`, infinite if it is more than `most`."""
        if target not in self._found or self._found[target][0] < most:
            self._found[target] = most, *dijkstra(
                self._costs, indices=self._moves.number[target], return_predecessors=True, limit=most)
        cost = self._found[target][1][self._moves.number[here]]
        return float(cost) if cost <= most else np.inf

    def route(self, here: int, target: int) -> list[int]:
        """The edges from `here` to `target`, whose cost was asked for."""
        number = self._moves.number
        return self._moves.path(self._found[target][2], int(number[here]), int(number[target]))


class _Ways:
    """Fastest ways out of one region by each of its G gateways (first[g] -> second[g], into next_region[g]).

    Gateways begins[n] to ends[n] - 1 lead into region neighbours[n]. Searched is from where drivers are and from where
    they go, when somebody first is or goes there, and no further than they would go: in a large city that is much less
    than from all gateways to everywhere.
    """

    def __init__(
        self, first, second, next_region, *, inside: _Moves, outside: _Moves, reached: np.ndarray, time: np.ndarray,
    ):
        """first, second, next_region: (G,), the last in rising order; inside: moves in the region; outside: those
        elsewhere, back; reached: (G, nodes of `outside`), which edges can be reached from second[g]; time: (E,) [s]"""
        self.time, self._inside, self._outside, self._reached = time, inside, outside, reached
        self._first, self._second, self._entering = inside.number[first], outside.number[second], time[second]
        self.neighbours, self.begins = np.unique(next_region, return_index=True)
        self.ends = np.append(self.begins[1:], len(next_region))
        self._costs = inside.costing(time), outside.costing(time)
        self._there: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._onward: dict[int, tuple[float, np.ndarray, np.ndarray]] = {}

    def cost(self, here: int, target: int, most: float) -> tuple[np.ndarray, np.ndarray]:
        """(G,) [s] from the end of edge `here` to the end of edge `target`, infinite if it is more than `most`, and
        (G,) bool, whether there is a way at all."""
        if here not in self._there:
            cost, before = dijkstra(self._costs[0], indices=self._inside.number[here], return_predecessors=True)
            self._there[here] = cost[self._first] + self._entering, before
        there = self._there[here][0]
        if not np.isfinite(there).any():
            return there, np.full(len(there), False)
        left = most - there.min(initial=most)
        if target not in self._onward or self._onward[target][0] < left:
            cost, after = dijkstra(
                self._costs[1], indices=self._outside.number[target], return_predecessors=True, limit=left)
            self._onward[target] = left, cost[self._second], after
        reached = np.isfinite(there) & self._reached[:, self._outside.number[target]]
        return there + self._onward[target][1], reached

    def route(self, here: int, gateway: int, target: int) -> list[int]:
        """The edges from `here` to `target` through `gateway`, whose cost was asked for."""
        to_gateway = self._inside.path(
            self._there[here][1], int(self._first[gateway]), int(self._inside.number[here]))
        return to_gateway[::-1] + self._outside.path(
            self._onward[target][2], int(self._second[gateway]), int(self._outside.number[target]))
