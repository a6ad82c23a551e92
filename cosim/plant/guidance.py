"""Route guidance to reroutes: every vehicle gets its next region when it enters a region, in shares
theta.

Travel times move the drivers' wishes away from the split ratios without guidance. Theta shifts
these wishes as it does the drivers' own split ratios in the regional model (`shifted`). Prices
lengthen the travel times through a region for drivers with another destination; then no share is
commanded.

Drivers are assigned deterministically, not at random: each takes the next region that costs least,
with a bonus for regions that are behind their share. Random assignment sends drivers round the far
end of a region, and jams a city.

A guided vehicle in region i bound for edge d takes the fastest way inside i to a gateway i -> h,
and from there to d without coming back to i, at recent travel times (cosim.plant.routes) as its
class of drivers sees them. With a period, it is guided again in i. No driver takes a much longer
detour, by times without prices, and none leaves the present way for a small gain, because every
change makes the travel times of others wrong. With `ways_return`, for ragged boundaries, the
fastest way of all is open to all drivers and counts for the region that it enters when it leaves i
for good.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby, pairwise
from typing import TypeAlias

import numpy as np

from cosim.plant.meter import Event
from cosim.plant.routes import Moves, Searches, TravelTimes, Trees, Ways
from cosim.plant.sampling import StreetMeans
from cosim.plant.stuck import QUEUE_END_M, Lanes
from cosim.sumo.arrays import PerEdge
from cosim.sumo.net import City
from cosim.sumo.session import REFUSALS, Session
from nmfd.arrays import PerRegion, PerTurn

DRIVER_CLASSES = 4  # groups of drivers who see different travel times: all on one way would jam it
SPREAD, MESO_SPREAD = (
    0.05,
    0.15,
)  # standard deviation of the logarithm of these times, with lanes and without
SHARE_PENALTY_S = 30.0  # per vehicle that a region is behind its share
MOST_DETOUR_S = 60.0  # that a commanded next region, or a price, may cost a driver
# Drivers keep their way if another one saves less than this share of its delay, times the delay's
# share of its time.
SWITCHING_THRESHOLD = 0.6
MESO_THRESHOLD = (
    0.3  # in the mesoscopic model: if another one saves less than this share of its own time
)
# The fastest way by each next region: times [s], infinite if too long; True if there is one; its
# edges by number.
_Options: TypeAlias = tuple[list[float], list[bool], Callable[[int], list[int]]]
RETRY_S = 10.0  # after which a driver is guided again who could not change lanes
MEMORY = 0.9  # of the vehicles assigned before and of their wishes, per control interval


def shifted(wish: Sequence[float], own: Sequence[float], theta: Sequence[float]) -> list[float]:
    """Return shares (n,) [-] that differ from `wish` as `theta` does from `own`.

    A next region that theta lowers loses the same part of its wishes; the regions that theta raises
    get these in proportion to how much it raises them.
    """
    kept = [w * (t / o) if t < o else w for w, o, t in zip(wish, own, theta, strict=True)]
    raised = [max(t - o, 0.0) for o, t in zip(own, theta, strict=True)]
    freed, total = sum(wish) - sum(kept), max(sum(raised), 1e-12)
    return [k + freed * r / total for k, r in zip(kept, raised, strict=True)]


@dataclass(eq=False)
class _Visit:
    """A driver who follows, in one region; `following`, the next region, was given in
    `interval`."""

    event: Event
    taste: int
    following: int | None = None
    interval: int = 0


@dataclass(frozen=True)
class _Present:
    """The present way of a driver."""

    way: list[int] | None  # edges; None on roads closed to cars
    takes: float = math.inf  # [s] from the end of the first edge
    delay: float = math.inf  # [s] of these
    bound: bool = False  # a search would find it


class Guide:
    """Route guidance of one run: `command` once per control interval, `apply` after every
    simulation step.

    realised: (R, R, R) [veh], [i, h, j] = vehicles given next region h in i on their way to j since
        the start, by the last region that each was given
    led_on: drivers who could not change lanes and went where theirs led
    """

    def __init__(
        self,
        session: Session,
        city: City,
        own: PerTurn,
        *,
        compliance: float,
        random: np.random.Generator,
        most_detour: float = MOST_DETOUR_S,
        ways_return: bool = False,
        period: float = 0.0,
        lanes: bool = True,
        turn_late: bool = False,
    ):
        """own: (R, R, R) [-], split ratios without guidance; compliance: probability that a driver
        follows in a region
        period: [s] after which a driver is guided again in the same region; 0: never
        lanes: False in the mesoscopic model; turn_late: drivers who are guided again may turn
            elsewhere from a wrong lane before the stop line
        """
        self._own, self._late = own, False
        self._lanes = (
            Lanes(session, 0.0 if turn_late and period else QUEUE_END_M) if lanes else None
        )
        self._period = (
            math.ceil(period / session.step_length - 1e-6) if period else 0
        )  # simulation steps
        self._retry = math.ceil(RETRY_S / session.step_length - 1e-6)
        self._steps = self._interval = 0
        self._visits: dict[str, _Visit] = {}
        self._due: dict[int, list[_Visit]] = {}  # simulation step -> visits to guide again then
        self._most_detour, self._ways_return = most_detour, ways_return
        self._session, self._city, self._compliance, self._random = (
            session,
            city,
            compliance,
            random,
        )
        self._region = city.edge_region.tolist()
        self._times = times = TravelTimes(city, lanes=lanes)
        self._move = {
            move: n
            for n, move in enumerate(zip(times.first.tolist(), times.second.tolist(), strict=True))
        }
        here = [city.edge_region == region for region in range(city.regions)]
        self._within, self._homeward, self._without_back = (
            [
                Moves(times.first, times.second, allowed=allowed ^ outside, reverse=reverse)
                for allowed in here
            ]
            for outside, reverse in ((False, False), (False, True), (True, True))
        )
        if ways_return:  # everywhere, of ways home, and of ways on that come back
            ends, everywhere = (times.first, times.second), np.full(len(city.edges), True)
            self._homeward = [
                Moves(*ends, allowed=everywhere, reverse=reverse) for reverse in (True, False)
            ]
        gateways = [
            (city.number[g.from_edge], city.number[g.to_edge], g.target, g.source)
            for g in city.gateways
        ]
        rows = (
            np.array([(a, b, self._move[a, b], *pair) for a, b, *pair in gateways], dtype=int)
            .reshape(-1, 5)
            .T
        )
        self._gateways = [rows[:4, rows[4] == region] for region in range(city.regions)]
        spread = SPREAD if lanes else MESO_SPREAD
        self._taste = np.exp(spread * random.standard_normal((DRIVER_CLASSES, len(city.edges))))
        self._prices, self._unpriced = np.zeros(city.regions), tuple(range(city.regions))
        # Results of the run; then those of one control interval, which `command` clears.
        self._leading, self._ahead = cache(self._to_gateways), cache(self._to_nearest)
        self._trees, self._ways = cache(self._trees_from), cache(self._ways_from)
        self._searches = Searches()
        self._guides, self._splits = False, own
        self._assigned, self._wished = np.zeros((2, *(city.regions,) * 3))
        self.realised = np.zeros((city.regions,) * 3, dtype=int)
        self.led_on = 0

    def command(
        self, splits: PerTurn | None, seen: StreetMeans | None, prices: PerRegion | None = None
    ) -> None:
        """Set theta (R, R, R) [-] of the control interval that begins; None: no guidance.

        seen: means of the last interval, None before the first has ended
        prices: (R,) [-], share by which drivers with another destination are told longer times
            through each region
        """
        self._guides = splits is not None
        if splits is None:
            return
        self._splits = splits
        self._interval += 1
        if seen is not None:
            self._times.learn(seen)
        self._prices, self._searches = (
            np.zeros(self._city.regions) if prices is None else prices,
            Searches(),
        )
        self._trees.cache_clear()
        self._ways.cache_clear()
        self._assigned *= MEMORY
        self._wished *= MEMORY

    def apply(self, events: list[Event]) -> None:
        """Guide vehicles that departed or entered a region in the last step, and those that are due
        again."""
        if not self._guides:
            return
        self._steps += 1
        for event in events:
            self._visits.pop(event.vehicle, None)
            if event.free and self._random.random() < self._compliance:
                visit = _Visit(event, int(self._random.integers(DRIVER_CLASSES)))
                if (
                    event.edge in self._city.number
                ):  # else it uses roads closed to cars, as taxis do
                    self._guide(visit)
        for visit in self._due.pop(self._steps, ()):
            if self._visits.get(visit.event.vehicle) is visit:
                self._guide(visit)

    def _guide(self, visit: _Visit) -> None:
        """Guide a driver, except on a junction, in the next region already, or too late to turn:
        then again soon."""
        event, target, after = visit.event, self._city.number[visit.event.edge], self._period
        self._late = False
        try:
            here = self._city.number.get(self._session.road(event.vehicle))
        except REFUSALS:  # it has arrived
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
            after = self._retry
        if after:
            self._visits[event.vehicle] = visit
            self._due.setdefault(self._steps + after, []).append(visit)

    def _guide_home(self, visit: _Visit, here: int, target: int) -> None:
        """Give the fastest way inside the region of destination; if ways may return, the fastest of
        all."""
        event, region = visit.event, 0 if self._ways_return else visit.event.region
        told, true = (
            self._trees(region, visit.taste, free)
            for free in (self._free(event.destination), self._unpriced)
        )
        present = self._present(event.vehicle, here, told.time)
        cost = told.costs(target, self._worth(present) + 1.0)[told.number[here]]
        if here == target or not np.isfinite(cost) or self._keeps(present, cost):
            return
        way = told.back(target, here)
        if told is not true:
            takes = self._takes(way, true.time)
            if true.costs(target, takes)[true.number[here]] < takes - self._most_detour:
                way = true.back(target, here)
        self._send(event.vehicle, way)

    def _guide_on(self, visit: _Visit, here: int, target: int) -> None:
        """Give the next region, and the fastest way through it."""
        event = visit.event
        free = self._free(event.destination)
        told, true = (
            self._ways(event.region, visit.taste, regions) for regions in (free, self._unpriced)
        )
        present = self._present(event.vehicle, here, told.time)
        least, open_ways, way = options = self._options(told, here, target, present)
        if (fastest := min(least, default=np.inf)) == np.inf:
            return
        limit = fastest + self._most_detour
        if told is true:
            least = [cost if cost <= limit else np.inf for cost in least]
        else:
            truly = self._present(event.vehicle, here, true.time)
            shortest = self._options(true, here, target, truly)
            limit = min(shortest[0]) + self._most_detour
            least, open_ways, way = self._shortened(options, shortest, limit, told.time, true.time)
        n = self._next(event, told, least, open_ways)
        if n is None:
            return
        following, cost = int(told.neighbours[n]), least[n]
        if told is not true and truly.takes > limit:
            present, cost = truly, self._takes(way(n), true.time)
        if not self._keeps(present, cost, following) and not self._send(event.vehicle, way(n)):
            return
        if visit.following is not None:  # the region given before does not count any more
            before = event.region, visit.following, event.destination
            self.realised[before] -= 1
            self._assigned[before] -= MEMORY ** (self._interval - visit.interval)
        self.realised[event.region, following, event.destination] += 1
        self._assigned[event.region, following, event.destination] += 1.0
        visit.following, visit.interval = following, self._interval

    def _options(self, ways: Ways, here: int, target: int, present: _Present) -> _Options:
        """Return the fastest ways, if these are not much longer than the present one."""
        most = present.takes + 1.0 if present.bound else np.inf
        cost, reached = ways.cost(here, target, self._most_detour + most)
        # Plain numbers from here on: a handful of next regions is too few for arrays to pay.
        least = np.minimum.reduceat(cost, ways.begins).tolist()
        open_ways = np.logical_or.reduceat(reached, ways.begins).tolist()
        returning = None  # next region of the fastest way of all, if that one comes back
        fastest = min(least, default=np.inf)
        of_all, gateway = ways.returning(here, target, min(fastest, most))
        if of_all < fastest:
            returning = int(np.searchsorted(ways.begins, gateway, side="right")) - 1
            least[returning], open_ways[returning] = of_all, True

        def way(n: int) -> list[int]:
            if n == returning:
                return ways.route(here, gateway, target, returning=True)
            return ways.route(
                here, int(ways.begins[n] + np.argmin(cost[ways.begins[n] : ways.ends[n]])), target
            )

        return least, open_ways, way

    def _shortened(
        self, told: _Options, true: _Options, limit: float, seen: PerEdge, time: PerEdge
    ) -> _Options:
        """Return ways within the limit [s] at `time` (E,) [s], with their times as `seen` (E,)
        [s]."""
        ways = [told[2](n) if cost < np.inf else [] for n, cost in enumerate(told[0])]
        for n, cost in enumerate(true[0]):
            if not ways[n] or self._takes(ways[n], time) > limit:
                ways[n] = true[2](n) if cost <= limit < np.inf else []
        least = [self._takes(way, seen) if way else np.inf for way in ways]
        return least, np.logical_or(told[1], true[1]).tolist(), ways.__getitem__

    def _next(
        self, event: Event, ways: Ways, least: list[float], open_ways: list[bool]
    ) -> int | None:
        """Return which of ways.neighbours a driver gets next; None if no share is left. least: [s],
        inf if too long"""
        fastest = min(least)
        self._wished[event.region, ways.neighbours[least.index(fastest)], event.destination] += 1.0
        wish, own, theta, assigned = (
            values[event.region, ways.neighbours, event.destination].tolist()
            for values in (self._wished, self._own, self._splits, self._assigned)
        )
        wishes = sum(wish)
        shares = shifted([w / wishes for w in wish], own, theta)
        shares = [share * is_open for share, is_open in zip(shares, open_ways, strict=True)]
        if (total := sum(shares)) <= 0:
            return None
        shares, count = [share / total for share in shares], sum(assigned) + 1.0
        allowed = [share > 1e-3 and c < np.inf for share, c in zip(shares, least, strict=True)]
        if not any(allowed):  # every region with a share is too long a detour
            allowed = [c <= fastest for c in least]
        price = [
            c - SHARE_PENALTY_S * (share * count - sent) if good else np.inf
            for c, share, sent, good in zip(least, shares, assigned, allowed, strict=True)
        ]
        return price.index(min(price))

    def _present(self, vehicle: str, here: int, time: PerEdge) -> _Present:
        """Return the present way of a driver on edge `here`, at `time` (E,) [s]."""
        route = self._session.route(vehicle)[self._session.route_index(vehicle) :]
        way = [self._city.number[edge] for edge in route if edge in self._city.number]
        if len(way) < len(route):
            return _Present(None)
        if way[0] != here:
            return _Present(way)
        moves = [self._move.get(pair) for pair in pairwise(way)]
        known = np.array([move for move in moves if move is not None], dtype=int)
        times, ahead = self._times, np.array(way[1:], dtype=int)
        takes = time.take(ahead).sum() + times.turns.take(known).sum()
        free = times.free.take(ahead).sum() + times.free_turns.take(known).sum()
        back = not self._ways_return and (regions := self._regions(way)).count(regions[0]) > 1
        return _Present(way, takes, max(takes - free, 0.0), len(known) == len(moves) and not back)

    def _takes(self, way: list[int], time: PerEdge) -> float:
        """Return the time [s] from the end of the first edge of a way, at `time` (E,) [s]."""
        return float(
            time[way[1:]].sum()
            + self._times.turns[[self._move[pair] for pair in pairwise(way)]].sum()
        )

    def _regions(self, way: list[int]) -> list[int]:
        return [region for region, _ in groupby(map(self._region.__getitem__, way))]

    def _keeps(self, present: _Present, cost: float, following: int | None = None) -> bool:
        """Return True if the way is about as good as `cost` [s] and leads into `following`, or is
        closed to cars."""
        if present.way is None:
            return True
        if math.isinf(present.takes) or (
            following is not None and self._next_region(present.way) != following
        ):
            return False
        return cost >= self._worth(present)

    def _worth(self, present: _Present) -> float:
        """Return the time [s] below which another way is worth a change."""
        if not self._lanes or math.isinf(present.takes):
            return present.takes / (1.0 + MESO_THRESHOLD)
        return present.takes - SWITCHING_THRESHOLD * present.delay**2 / max(present.takes, 1e-9)

    def _next_region(self, way: list[int]) -> int:
        """Return the region that a way enters first, or, if ways may return, after it leaves its
        own for good."""
        regions = self._regions(way)
        left = (
            max(n for n, region in enumerate(regions) if region == regions[0])
            if self._ways_return
            else 0
        )
        return regions[min(left + 1, len(regions) - 1)]

    def _send(self, vehicle: str, way: list[int]) -> bool:
        """Give a vehicle this way; return False if it is too late to change lanes or SUMO refuses
        it."""
        edges = [self._city.edges[n] for n in way]
        if self._lanes and self._lanes.too_late(vehicle, edges):
            self._late = True
            return False
        return self._session.set_route(vehicle, edges)

    def _free(self, destination: int) -> tuple[int, ...]:
        """Return the regions without a price for drivers to `destination`."""
        return tuple(r for r in self._unpriced if r == destination or not self._prices[r])

    def _seen(self, taste: int, free: tuple[int, ...]) -> PerEdge:
        """Return the times (E,) [s] that a class of drivers sees, with the prices of all regions
        but `free`."""
        prices = self._prices.copy()
        prices[list(free)] = 0.0
        return self._times.edges * (1.0 + prices)[self._region] * self._taste[taste]

    def _trees_from(self, n: int, taste: int, free: tuple[int, ...]) -> Trees:
        return Trees(self._homeward[n], self._seen(taste, free), self._times.turns, self._searches)

    def _ways_from(self, region: int, taste: int, free: tuple[int, ...]) -> Ways:
        first, second, move, following = self._gateways[region]
        leading, reached = self._leading(region)
        turns, everywhere = self._times.turns, None
        if self._ways_return:
            back = self._ahead(self._homeward[0], region, taste)[first]
            everywhere = self._trees(-1, taste, free), turns[move], back
        return Ways(
            first,
            second,
            following,
            inside=self._within[region],
            outside=self._without_back[region],
            crossing=turns[move] if self._lanes else np.zeros(len(move)),
            leading=leading,
            reached=reached,
            ahead=self._ahead(self._without_back[region], region, taste),
            time=self._seen(taste, free),
            turns=turns,
            searches=self._searches,
            everywhere=everywhere,
        )

    def _to_gateways(self, region: int) -> tuple[np.ndarray, np.ndarray]:
        """Return from where in the region its gateways can be reached, and what from behind
        them."""
        inside, outside = self._within[region], self._without_back[region]
        first, second, _, _ = self._gateways[region]
        return inside.leading_to(inside.number[first]), outside.leading_to(outside.number[second])

    def _to_nearest(self, back: Moves, region: int, taste: int) -> np.ndarray:
        """Return the time [s] in free flow, by moves `back`, from behind the nearest gateway of the
        region."""
        times, nodes = self._times, back.number[self._gateways[region][1]]
        return back.ahead(nodes, times.free * self._taste[taste], times.free_turns)
