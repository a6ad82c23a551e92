"""Route guidance to reroutes: every vehicle is given its next region when it enters a region, in shares theta.

Drivers who are told travel times do not keep to the split ratios that they had without: what they would choose now is
followed up, and theta shifts it as it shifts the drivers' own split ratios in the regional model (`shifted`). A
controller that asks for these gets guidance by travel times alone; one that asks for everybody gets everybody.

Prices are the other way to the same end: travel times through a region are told longer than they are, to all who are
bound for elsewhere, and no share is commanded. Who has a good way round takes it, whoever has none goes through.

Who is sent where is not drawn by lot: a driver at the western edge of a region would be sent round its eastern end as
often as the others, and trips get so much longer that guidance with the drivers' own split ratios jams a city that
flows without it (measured on grid7). Instead everybody takes the next region that costs least, with a bonus for the
regions that are behind their share; the bonus grows until the shares are met, by those who lose least.

A guided vehicle in region i bound for edge d takes the fastest way inside i to a gateway i -> h, and from there to d
without coming back to i, at the travel times of late (`travel_times`), as its group of drivers sees them. In h it is
guided again, and in the region of d it is sent there on the fastest way. With a period it is asked again where it is,
every so often as long as it stays in i: in a city that congests, the fastest way when it came may be a standing one
soon. Nobody is sent on a detour that takes much longer, whatever theta says, and nobody leaves the way that they are on
for a small gain: everybody who changes his way makes the travel times that the others were told wrong. What is small
grows with the delay: 2 % where a fifth of the time is delay, 30 % where it is most of it and times change fastest.

Where the boundaries of the regions are ragged, a main road may leave i and come back. With `ways_return` the fastest
way of all is open to everybody, wherever it leads, and counts for the region that it enters when it leaves i for good;
other ways into h still never come back. Without it such a road is closed to guided drivers, however much it costs them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from cosim.plant.lanes import NEAR, Lanes
from cosim.plant.meter import Event
from cosim.plant.sampling import StreetMeans
from cosim.plant.shortest_paths import Home, Moves, Searches, Trees, Ways
from cosim.plant.travel_times import TravelTimes
from cosim.sumo.arrays import PerEdge, PerGateway
from cosim.sumo.net import City
from cosim.sumo.session import REFUSALS, Session
from nmfd.arrays import PerRegion, PerTurn

DRIVER_CLASSES = 4  # groups of drivers who see different travel times: were all sent one way, it would jam
SPREAD = 0.05  # standard deviation of the logarithm of their travel times
MESO_SPREAD = 0.15  # the same in the mesoscopic model
SHARE_PENALTY = 30.0  # s per vehicle that a region is behind its share
SWITCHING_THRESHOLD = 0.6  # drivers keep their way if the best one saves less than this share of the delay on theirs,
# times the share that the delay has in the time of their way
MESO_THRESHOLD = 0.3  # in the mesoscopic model: if it saves less than this share of its own time
SOON = 10.0  # s after which they are asked again for whom it was too late to change lanes
MEMORY = 0.9  # of the vehicles assigned before and of their wishes, per control interval


def shifted(wish: Sequence[float], own: Sequence[float], theta: Sequence[float]) -> list[float]:
    """Shares (n,) [-] that differ from `wish` as `theta` does from `own`.

    A next region that theta lowers loses the same part of those who wish to go there, and what is freed goes to the
    regions that theta raises, in proportion to by how much.
    """
    kept = [w * (t / o) if t < o else w for w, o, t in zip(wish, own, theta, strict=True)]
    raised = [max(t - o, 0.0) for o, t in zip(own, theta, strict=True)]
    freed, total = sum(wish) - sum(kept), max(sum(raised), 1e-12)
    return [k + freed * r / total for k, r in zip(kept, raised, strict=True)]


@dataclass(eq=False)
class _Visit:
    """A driver who follows, in one region: how they came, and how they see travel times; following: where they were
    sent last, and in which control interval."""

    event: Event
    taste: int
    following: int | None = None
    interval: int = 0


@dataclass(frozen=True)
class _Present:
    """A driver's present way from where they are: way, edges, None where it uses roads closed to cars; takes [s] from
    the end of the first, infinite if that is not where they are asked; delay: [s], of these; bound: whether a search
    would find it: by known moves and, unless ways may return, out of the region and never back."""

    way: list[int] | None
    takes: float = math.inf
    delay: float = math.inf
    bound: bool = False


class Guide:
    """Reroutes vehicles; `compliance` is the probability that a driver follows, drawn anew in every region,
    `most_detour` [s] the most that a commanded next region may cost them, and `period` [s] the time after which he is
    asked again; 0: never in the same region.

    realised: (R, R, R) [veh], [i, h, j] = vehicles sent from i to h on their way to j since the start, those who were
    asked several times as they were sent last
    refused: ways that SUMO did not take; led_on: drivers who could not go where they were bound for (cosim.plant.lanes)
    """

    def __init__(
        self,
        session: Session,
        city: City,
        own: PerTurn,
        *,
        compliance: float,
        most_detour: float,
        random: np.random.Generator,
        ways_return: bool = False,
        period: float = 0.0,
        lanes: bool = True,
        turn_late: bool = False,
    ):
        """own: (R, R, R) [-], the drivers' own split ratios, which controllers mean as well
        lanes: whether vehicles are on lanes, as in the mesoscopic model they are not
        turn_late: whether drivers who are asked again may turn elsewhere from the wrong lane before the stop line"""
        self._own, self._late = own, False
        self._lanes = Lanes(session, 0.0 if turn_late and period else NEAR) if lanes else None
        self._period = math.ceil(period / session.step_length - 1e-6) if period else 0  # simulation steps
        self._soon = math.ceil(SOON / session.step_length - 1e-6)
        self._steps = self._interval = 0
        self._visits: dict[str, _Visit] = {}
        self._due: dict[int, list[_Visit]] = {}  # simulation step -> whom to ask again then
        self._most_detour = most_detour
        self._session, self._city, self._compliance, self._random = session, city, compliance, random
        self._index = {edge: n for n, edge in enumerate(city.edges)}
        self._region = [city.region_of[edge] for edge in city.edges]
        self._times = times = TravelTimes(city, lanes=lanes)
        self._move = {move: n for n, move in enumerate(zip(times.first.tolist(), times.second.tolist(), strict=True))}
        here = [np.array(self._region) == region for region in range(city.regions)]
        self._within, within_back, self._without_back = (
            [Moves(times.first, times.second, allowed=allowed ^ outside, reverse=reverse) for allowed in here]
            for outside, reverse in ((False, False), (False, True), (True, True))
        )
        self._ways_return = ways_return
        self._homeward, self._anywhere = within_back, None  # by region, or one for all
        if ways_return:
            self._anywhere, back = (
                Moves(times.first, times.second, allowed=np.full(len(city.edges), True), reverse=reverse)
                for reverse in (False, True)
            )
            self._homeward = [back]
        ends = [(self._index[g.from_edge], self._index[g.to_edge], g) for g in city.gateways]
        self._gateways = [
            np.array(
                [
                    (first, second, self._move[first, second], g.target)
                    for first, second, g in ends
                    if g.source == region
                ],
                dtype=int,
            )
            .reshape(-1, 4)
            .T
            for region in range(city.regions)
        ]
        spread = SPREAD if lanes else MESO_SPREAD
        self._taste = np.exp(spread * random.standard_normal((DRIVER_CLASSES, len(city.edges))))
        self._prices: PerRegion | None = None
        self._told: dict[int | None, PerEdge] = {}  # region without a price, None for all with theirs -> (E,) [s]
        self._leading: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # region -> from where to gateways, and to where
        self._ahead: dict[tuple[int, int], np.ndarray] = {}
        self._back: dict[tuple[int, int], np.ndarray] = {}
        # By region, taste and region without a price.
        self._ways: dict[tuple[int, int, int | None], Ways] = {}
        self._homes: dict[tuple[int, int, int | None], Home] = {}
        self._everywhere: dict[tuple[int, int | None], Trees] = {}  # by the last two
        self._searches = Searches()
        self._guides, self._splits = False, own
        self._assigned, self._wished = np.zeros((2, *(city.regions,) * 3))
        self.realised = np.zeros((city.regions,) * 3, dtype=int)
        self.refused = self.led_on = 0

    def command(self, splits: PerTurn | None, seen: StreetMeans | None, prices: PerRegion | None = None) -> None:
        """Take over theta (R, R, R) [-] for the next control interval; None: no guidance.

        seen: in the last interval; None: nothing new
        prices: (R,) [-], by how much longer than they take drivers are told that the ways through each region take,
            unless it is the one that they are bound for
        """
        self._guides = splits is not None
        if splits is not None:
            self._splits = splits
            self._interval += 1
            if seen is not None:
                self._times.learn(seen)
            self._told, self._prices = {}, prices
            self._ways, self._homes, self._everywhere, self._searches = {}, {}, {}, Searches()
            self._assigned *= MEMORY
            self._wished *= MEMORY

    def apply(self, events: list[Event]) -> None:
        """Guide the vehicles that departed or entered a region in the last step, and those whose time has come."""
        if not self._guides:
            return
        self._steps += 1
        for event in events:
            self._visits.pop(event.vehicle, None)
            if event.free and self._random.random() < self._compliance:
                visit = _Visit(event, int(self._random.integers(DRIVER_CLASSES)))
                if event.edge in self._index:  # or it may use roads that are closed to cars, as taxis do
                    self._ask(visit)
        for visit in self._due.pop(self._steps, ()):
            if self._visits.get(visit.event.vehicle) is visit:
                self._ask(visit)

    def _ask(self, visit: _Visit) -> None:
        """Guide a driver, unless they are on a junction or in the next region already, or before the stop line on a
        lane that does not lead there: too late to turn, and they are asked again soon."""
        event, target, after = visit.event, self._index[visit.event.edge], self._period
        self._late = False
        try:
            here = self._index.get(self._session.road(event.vehicle))
        except REFUSALS:  # they have arrived
            self._visits.pop(event.vehicle, None)
            return
        if here is None or self._region[here] != event.region:
            after = min(self._period, 1)
        elif self._lanes and (way := self._lanes.way_out(event.vehicle, event.edge)):
            self.led_on += self._session.set_route(event.vehicle, way)
        elif event.region == event.destination:
            self._guide_home(visit, here, target)
        else:
            self._guide_on(visit, here, target)
        if self._late:
            after = self._soon
        if after:
            self._visits[event.vehicle] = visit
            self._due.setdefault(self._steps + after, []).append(visit)

    def _guide_home(self, visit: _Visit, here: int, target: int) -> None:
        """The fastest way inside the region of destination; if ways may return, the fastest of all."""
        event, home = visit.event, self._home(visit.event.region, visit.taste, visit.event.destination)
        present = self._present(event.vehicle, here, home.time)
        cost = home.cost(here, target, self._worth(present) + 1.0)
        if here == target or not np.isfinite(cost) or self._keeps(present, cost):
            return
        self._send(event.vehicle, home.route(here, target))

    def _guide_on(self, visit: _Visit, here: int, target: int) -> None:
        """The next region, and the fastest way through it."""
        event, ways = visit.event, self._ways_from(visit.event.region, visit.taste, visit.event.destination)
        present = self._present(event.vehicle, here, ways.time)
        cost, reached = ways.cost(here, target, self._most_detour + present.takes + 1.0 if present.bound else np.inf)
        # Plain numbers from here on: there are a handful of next regions, too few for arrays to pay.
        least, open_ways = (
            best.reduceat(values, ways.begins).tolist()
            for best, values in ((np.minimum, cost), (np.logical_or, reached))
        )
        fastest = min(least, default=np.inf)
        returning = None  # the next region of the fastest way of all, where that is one that comes back
        of_all, gateway = ways.returning(here, target, min(fastest, present.takes + 1.0 if present.bound else np.inf))
        if of_all < fastest:
            way, fastest = ways.returning_route(here, gateway, target), of_all
            returning = int(np.searchsorted(ways.begins, gateway, side="right")) - 1
            least[returning], open_ways[returning] = fastest, True
        if fastest == np.inf:
            return
        self._wished[event.region, ways.neighbours[least.index(fastest)], event.destination] += 1.0
        wish, own, theta, assigned = (
            values[event.region, ways.neighbours, event.destination].tolist()
            for values in (self._wished, self._own, self._splits, self._assigned)
        )
        wishes = sum(wish)
        shares = [
            share * is_open
            for share, is_open in zip(shifted([w / wishes for w in wish], own, theta), open_ways, strict=True)
        ]
        if (total := sum(shares)) <= 0:
            return
        shares, everybody = [share / total for share in shares], sum(assigned) + 1.0
        allowed = [share > 1e-3 and c <= fastest + self._most_detour for share, c in zip(shares, least, strict=True)]
        if not any(allowed):  # every region with a share is too far out of the way
            allowed = [c <= fastest for c in least]
        price = [
            c - SHARE_PENALTY * (share * everybody - sent) if good else np.inf
            for c, share, sent, good in zip(least, shares, assigned, allowed, strict=True)
        ]
        n = price.index(min(price))
        following = int(ways.neighbours[n])
        if not self._keeps(present, least[n], following):
            if n != returning:
                way = ways.route(here, int(ways.begins[n] + np.argmin(cost[ways.begins[n] : ways.ends[n]])), target)
            if not self._send(event.vehicle, way):
                return
        if visit.following is not None:  # what they were told before does not count any more
            before = event.region, visit.following, event.destination
            self.realised[before] -= 1
            self._assigned[before] -= MEMORY ** (self._interval - visit.interval)
        self.realised[event.region, following, event.destination] += 1
        self._assigned[event.region, following, event.destination] += 1.0
        visit.following, visit.interval = following, self._interval

    def _present(self, vehicle: str, here: int, time: PerEdge) -> _Present:
        """The driver's, who is asked on edge `here`, at `time` (E,) [s]."""
        route = self._session.route(vehicle)[self._session.route_index(vehicle) :]
        way: list[int] = []
        try:
            way += map(self._index.__getitem__, route)
        except KeyError:
            return _Present(None)
        if way[0] != here:
            return _Present(way)
        moves = list(map(self._move.get, pairwise(way)))
        known = np.array([move for move in moves if move is not None], dtype=int)
        times, ahead = self._times, np.array(way[1:], dtype=int)
        takes = time.take(ahead).sum() + times.turns.take(known).sum()
        free = times.free.take(ahead).sum() + times.free_turns.take(known).sum()
        back = not self._ways_return and (regions := self._regions(way)).count(regions[0]) > 1
        return _Present(way, takes, max(takes - free, 0.0), len(known) == len(moves) and not back)

    def _regions(self, way: list[int]) -> list[int]:
        """The regions that a way leads through, one after the other."""
        return [region for region, _ in groupby(map(self._region.__getitem__, way))]

    def _keeps(self, present: _Present, cost: float, following: int | None = None) -> bool:
        """Whether the driver's present way is about as good as one of `cost` [s], and leads into the region `following`
        next, if that is given; so it is where the way uses roads that are closed to cars."""
        if present.way is None:
            return True
        if math.isinf(present.takes) or following is not None and self._next_region(present.way) != following:
            return False
        return cost >= self._worth(present)

    def _worth(self, present: _Present) -> float:
        """How little another way must take [s] for a driver to leave the present one."""
        if not self._lanes or math.isinf(present.takes):
            return present.takes / (1.0 + MESO_THRESHOLD)
        return present.takes - SWITCHING_THRESHOLD * present.delay**2 / max(present.takes, 1e-9)

    def _next_region(self, way: list[int]) -> int:
        """The region that a way enters first, or, if ways may return, when it leaves its own for good; its own if it
        stays there."""
        regions = self._regions(way)
        left = max(n for n, region in enumerate(regions) if region == regions[0]) if self._ways_return else 0
        return regions[min(left + 1, len(regions) - 1)]

    def _send(self, vehicle: str, way: list[int]) -> bool:
        """Give a vehicle this way, unless it is too late to change lanes; counts what SUMO refuses."""
        edges = [self._city.edges[n] for n in way]
        if self._lanes and self._lanes.too_late(vehicle, edges):
            self._late = True
            return False
        taken = self._session.set_route(vehicle, edges)
        self.refused += not taken
        return taken

    def _bound_for(self, destination: int) -> tuple[int | None, PerEdge]:
        """What drivers on their way to region `destination` are told (E,) [s], and that region, if it has a price that
        they do not see."""
        free = destination if self._prices is not None and self._prices[destination] > 0.0 else None
        if free not in self._told:
            prices = np.zeros(self._city.regions) if self._prices is None else self._prices.copy()
            prices[[] if free is None else free] = 0.0
            self._told[free] = self._times.edges * (1.0 + prices)[self._region]
        return free, self._told[free]

    def _home(self, region: int, taste: int, destination: int) -> "Home":
        free, time = self._bound_for(destination)
        key = 0 if self._ways_return else region, taste, free
        if key not in self._homes:
            self._homes[key] = Home(
                self._homeward[key[0]], time * self._taste[taste], self._times.turns, self._searches
            )
        return self._homes[key]

    def _ways_from(self, region: int, taste: int, destination: int) -> "Ways":
        free, time = self._bound_for(destination)
        key = region, taste, free
        if key not in self._ways:
            inside, outside, tastes = self._within[region], self._without_back[region], self._taste[taste]
            first, second, move, following = self._gateways[region]
            if region not in self._leading:
                self._leading[region] = (
                    inside.leading_to(inside.number[first]),
                    outside.leading_to(outside.number[second]),
                )
            if (region, taste) not in self._ahead:
                self._ahead[region, taste] = outside.ahead(
                    outside.number[second], self._times.free * tastes, self._times.free_turns
                )
            leading, reached = self._leading[region]
            turns = self._times.turns
            self._ways[key] = Ways(
                first,
                second,
                following,
                inside=inside,
                outside=outside,
                crossing=turns[move] if self._lanes else np.zeros(len(move)),
                leading=leading,
                reached=reached,
                ahead=self._ahead[region, taste],
                time=time * tastes,
                turns=turns,
                searches=self._searches,
                everywhere=self._by_all_moves(region, taste, free, time),
            )
        return self._ways[key]

    def _by_all_moves(
        self, region: int, taste: int, free: int | None, time: PerEdge
    ) -> tuple[Trees, PerGateway, PerGateway] | None:
        """What Ways calls `everywhere`."""
        if self._anywhere is None:
            return None
        first, second, move, _ = self._gateways[region]
        if (region, taste) not in self._back:
            self._back[region, taste] = self._homeward[0].ahead(
                second, self._times.free * self._taste[taste], self._times.free_turns
            )[first]
        if (taste, free) not in self._everywhere:
            self._everywhere[taste, free] = Trees(
                self._anywhere, time * self._taste[taste], self._times.turns, self._searches
            )
        return self._everywhere[taste, free], self._times.turns[move], self._back[region, taste]
