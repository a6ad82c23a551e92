"""Route guidance of drivers by commanded split ratios, or by prices.

Every vehicle gets its next region when it enters a region, in shares theta (cosim.plant.shares).
Prices lengthen the travel times through a region for drivers with another destination. Then no
share is commanded.

A guided vehicle in region i bound for edge d takes the fastest route inside i to a gateway i -> h,
and from there to d without coming back to i, at recent travel times (cosim.plant.routes) as its
class of drivers sees them. With a period, it is guided again in i. No driver takes a much longer
detour, by times without prices. Drivers keep their route unless the gain is large
(cosim.plant.drivers). If `ways_return` is set, a route may leave region i and come back (needed
where boundaries are ragged). Its next region is the one it enters on its last exit from i.
"""

import math
from collections import defaultdict
from collections.abc import Container
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.plant.drivers import Drivers, Itinerary, Present
from cosim.plant.meter import Event
from cosim.plant.routes import Choices, RegionRoutes, Route, TravelTimes, Ways
from cosim.plant.sampling import StreetMeans
from cosim.plant.shares import Shares
from cosim.plant.stuck import QUEUE_END_M, Lanes
from cosim.sumo.net import City
from cosim.sumo.session import REFUSALS, Session
from nmfd.arrays import PerRegion, PerTurn

DRIVER_CLASSES = 4  # groups of drivers who see different travel times: all on one way would jam it
SPREAD = 0.05  # standard deviation of the logarithm of these times, with lanes
MESO_SPREAD = 0.15  # the same without lanes
MOST_DETOUR_S = 60.0  # that a commanded next region, or a price, may cost a driver
RETRY_S = 10.0  # after which a driver is guided again who could not change lanes


@dataclass(eq=False)
class _Visit:
    """A compliant driver in one region.

    following: next region assigned to the driver in control interval `interval`; None if none yet
    """

    event: Event
    driver_class: int
    following: int | None = None
    interval: int = 0


class _Trip(NamedTuple):
    """The rest of a driver's trip.

    here, target: present and last edge, by number; place: of the present edge in the itinerary
    """

    region: int
    destination: int
    driver_class: int
    here: int
    target: int
    itinerary: Itinerary
    place: int


class _Plan(NamedTuple):
    """A route for a driver, and the next region that it counts for.

    route: edges by number; None: the present route
    following: next region; None in the region of destination
    """

    route: Route | None
    following: int | None = None


class _Visits:
    """Visits of all compliant drivers, and when each is guided again."""

    def __init__(self) -> None:
        self._step = 0
        self._present: dict[str, _Visit] = {}
        self._due = defaultdict[int, list[_Visit]](list)  # simulation step -> visits

    def begin_step(self) -> None:
        self._step += 1

    def end(self, vehicle: str) -> None:
        """Forget a vehicle that has left the region, or arrived."""
        self._present.pop(vehicle, None)

    def again(self, visit: _Visit, steps: int) -> None:
        """Let a driver be guided again after so many simulation steps; 0: never."""
        if steps:
            self._present[visit.event.vehicle] = visit
            self._due[self._step + steps].append(visit)

    def due(self) -> list[_Visit]:
        """Return the drivers to guide again in this step."""
        visits = self._due.pop(self._step, [])
        return [visit for visit in visits if self._present.get(visit.event.vehicle) is visit]


class Guide:
    """Route guidance of one run.

    Call `command` once per control interval, and `apply` after every simulation step.

    realised: drivers by region, next region and destination (cosim.plant.shares) (veh, (R, R, R))
    led_on: drivers who could not change lanes and were sent where these lead
    """

    def __init__(
        self,
        session: Session,
        city: City,
        own: PerTurn,
        *,
        compliance: float,
        random: np.random.Generator,
        planned: Container[str] = frozenset(),
        most_detour: float = MOST_DETOUR_S,
        ways_return: bool = False,
        period: float = 0.0,
        lanes: bool = True,
        turn_late: bool = False,
    ):
        """own: split ratios without guidance (-, (R, R, R))
        compliance: probability that a driver follows in a region (-)
        planned: vehicles that are not guided, because a plan has routes for them
        most_detour: see MOST_DETOUR_S (s)
        ways_return: routes may leave a region and come back
        period: after which a driver is guided again in the same region (s); 0: never
        lanes: False in the mesoscopic model
        turn_late: drivers who are guided again may turn elsewhere from a wrong lane before the stop
            line
        """
        self._session = session
        self._city = city
        self._region = city.edge_region.tolist()
        self._compliance = compliance
        self._random = random
        self._planned = planned
        self._most_detour = most_detour
        self._period = _steps(period, session)
        self._retry = _steps(RETRY_S, session)
        self._lanes = None
        if lanes:
            self._lanes = Lanes(session, 0.0 if turn_late and period else QUEUE_END_M)
        spread = SPREAD if lanes else MESO_SPREAD
        taste = np.exp(spread * random.standard_normal((DRIVER_CLASSES, len(city.edges))))
        self._times = TravelTimes(city, lanes=lanes)
        self._routes = RegionRoutes(city, self._times, taste, ways_return=ways_return, lanes=lanes)
        self._drivers = Drivers(city, self._times, ways_return=ways_return, lanes=lanes)
        self._visits = _Visits()
        self._itineraries: dict[str, Itinerary] = {}  # of drivers when they were guided last
        self._shares = Shares(own)
        self.realised = self._shares.realised
        self._guides = False
        self.led_on = 0

    def command(
        self, splits: PerTurn | None, seen: StreetMeans | None, prices: PerRegion | None = None
    ) -> None:
        """Set theta of the control interval that begins.

        splits: theta (-, (R, R, R)); None: no guidance
        seen: means of the last interval; None before the first has ended
        prices: share by which drivers with another destination are told longer times through each
            region (-, (R,))
        """
        self._guides = splits is not None
        if splits is None:
            return
        if seen is not None:
            self._times.learn(seen)
        self._routes.command(prices)
        self._shares.command(splits)

    def apply(self, events: list[Event]) -> None:
        """Guide vehicles that are new in a region, and those that are due again.

        events: departures and entries of the last simulation step
        """
        if not self._guides:
            return
        self._visits.begin_step()
        for vehicle in self._session.arrived():
            self._visits.end(vehicle)
            self._itineraries.pop(vehicle, None)
        for event in events:
            self._visits.end(event.vehicle)
            guidable = event.free and event.vehicle not in self._planned
            if guidable and self._random.random() < self._compliance:
                visit = _Visit(event, int(self._random.integers(DRIVER_CLASSES)))
                # The routes of some, such as taxis, end on roads closed to cars.
                if event.edge in self._city.number:
                    self._guide(visit)
        for visit in self._visits.due():
            self._guide(visit)

    def _guide(self, visit: _Visit) -> None:
        """Reroute one driver.

        If the vehicle is on a junction, has left the region, or can no longer change lanes, try
        again after a few steps.
        """
        event = visit.event
        try:
            here = self._city.number.get(self._session.road(event.vehicle))
        except REFUSALS:  # the vehicle was removed, or arrived at once
            self._visits.end(event.vehicle)
            return
        if here is None or self._region[here] != event.region:
            self._visits.again(visit, min(self._period, 1))
            return
        after = self._period
        way_out = []
        if self._lanes:
            way_out = self._lanes.way_out(event.vehicle, event.edge)
        if way_out:
            self.led_on += self._session.set_route(event.vehicle, way_out)
        else:
            plan = self._plan(visit, here)
            if plan and not self._follow(visit, plan):
                after = self._retry
        self._visits.again(visit, after)

    def _follow(self, visit: _Visit, plan: _Plan) -> bool:
        """Give a driver a plan; return False if it is too late to change lanes."""
        event = visit.event
        if plan.route is not None:
            edges = [self._city.edges[n] for n in plan.route.tolist()]
            if self._lanes and self._lanes.too_late(event.vehicle, edges):
                return False
            if not self._session.set_route(event.vehicle, edges):
                return True  # SUMO refuses it: nothing changes
        if plan.following is not None:
            if visit.following is not None:  # the region given before does not count any more
                before = (event.region, visit.following, event.destination)
                self._shares.withdraw(before, visit.interval)
            self._shares.assign((event.region, plan.following, event.destination))
            visit.following = plan.following
            visit.interval = self._shares.interval
        return True

    def _plan(self, visit: _Visit, here: int) -> _Plan | None:
        """Return the plan for a driver; None if there is nothing to change.

        here: present edge
        """
        event = visit.event
        trip = _Trip(
            region=event.region,
            destination=event.destination,
            driver_class=visit.driver_class,
            here=here,
            target=self._city.number[event.edge],
            itinerary=self._itinerary(event.vehicle),
            place=self._session.route_index(event.vehicle),
        )
        if event.region == event.destination:
            return self._plan_home(trip)
        return self._plan_on(trip)

    def _itinerary(self, vehicle: str) -> Itinerary:
        """Return the present route of a driver."""
        names = self._session.route(vehicle)
        known = self._itineraries.get(vehicle)
        if known is None or known.names != names:
            known = self._drivers.itinerary(names)
            self._itineraries[vehicle] = known
        return known

    def _plan_home(self, trip: _Trip) -> _Plan | None:
        """Return the fastest route inside the region of destination.

        If routes may return, it is the fastest of all.
        """
        here = trip.here
        target = trip.target
        free = self._routes.free(trip.destination)
        seen = self._routes.home(trip.region, trip.driver_class, free)
        present = self._present(trip, free)
        longest = self._drivers.worth(present) + 1.0
        time, before = seen.time(target, here, longest)
        if here == target or math.isinf(time) or self._drivers.keeps(present, time):
            return None
        route = seen.back(before, target, here)
        if free != self._routes.regions:  # prices may have made the route a long detour
            unpriced = self._routes.home(trip.region, trip.driver_class, self._routes.regions)
            takes = self._time(trip, route, self._routes.regions)
            fastest, before = unpriced.time(target, here, takes)
            if fastest < takes - self._most_detour:
                route = unpriced.back(before, target, here)
        return _Plan(route)

    def _plan_on(self, trip: _Trip) -> _Plan | None:
        """Return the next region of a driver, and the fastest route by it."""
        free = self._routes.free(trip.destination)
        ways = self._routes.ways(trip.region, trip.driver_class, free)
        present = self._present(trip, free)
        choices = ways.choices(trip.here, trip.target, present.longest, self._most_detour)
        if choices.fastest == math.inf:
            return None
        if free != self._routes.regions:
            return self._plan_priced(trip, ways, present, choices)
        limit = choices.fastest + self._most_detour
        n = self._next_region(trip, ways, choices, limit)
        if n is None:
            return None
        return self._change(present, choices.times[n], choices, n, ways)

    def _plan_priced(
        self, trip: _Trip, ways: Ways, present: Present, choices: Choices
    ) -> _Plan | None:
        """Return the plan of a driver who sees prices.

        choices: the fastest routes with prices
        """
        free = self._routes.free(trip.destination)
        all_free = self._routes.regions
        unpriced = self._routes.ways(trip.region, trip.driver_class, all_free)
        present_unpriced = self._present(trip, all_free)
        longest = present_unpriced.longest
        shortest = unpriced.choices(trip.here, trip.target, longest, self._most_detour)
        limit = shortest.fastest + self._most_detour
        routes = []
        times = np.full(len(choices.times), math.inf)
        for way in range(len(times)):
            route = self._shortened(trip, choices, shortest, way, limit)
            routes.append(route)
            if route is not None:
                times[way] = self._time(trip, route, free)
        exist = choices.exist | shortest.exist
        within = Choices(times, float(times.min()), exist, routes.__getitem__)
        n = self._next_region(trip, ways, within, math.inf)
        if n is None:
            return None
        time = times[n]
        if present_unpriced.time > limit:
            # Prices do not justify so long a detour: the present route is judged without them.
            present = present_unpriced
            time = self._time(trip, routes[n], all_free)
        return self._change(present, time, within, n, ways)

    def _shortened(
        self, trip: _Trip, choices: Choices, shortest: Choices, n: int, limit: float
    ) -> Route | None:
        """Return the n-th route within the limit; None if there is none.

        choices: the fastest routes with prices; shortest: without prices
        limit: of the time without prices (s)
        """
        if choices.times[n] < math.inf:
            route = choices.route(n)
            if self._time(trip, route, self._routes.regions) <= limit:
                return route
        if shortest.times[n] <= limit < math.inf:
            return shortest.route(n)
        return None

    def _present(self, trip: _Trip, free: tuple[int, ...]) -> Present:
        """Return the present route of a driver.

        free: regions without a price
        """
        time = self._routes.seen(trip.driver_class, free)
        return self._drivers.present(trip.itinerary, trip.place, trip.here, time)

    def _time(self, trip: _Trip, route: Route, free: tuple[int, ...]) -> float:
        """Return the time of a route for a driver (s).

        free: regions without a price
        """
        return self._drivers.time(route, self._routes.seen(trip.driver_class, free))

    def _next_region(self, trip: _Trip, ways: Ways, choices: Choices, limit: float) -> int | None:
        """Return which choice a driver gets; None if no share is left."""
        neighbours = ways.exits.neighbours
        return self._shares.next_region(trip.region, neighbours, trip.destination, choices, limit)

    def _change(self, present: Present, time: float, choices: Choices, n: int, ways: Ways) -> _Plan:
        """Return the plan to change to the n-th choice, which takes `time` (s).

        The driver keeps the present route if it is about as good.
        """
        following = int(ways.exits.neighbours[n])
        if self._drivers.keeps(present, time, following):
            return _Plan(None, following)
        return _Plan(choices.route(n), following)


def _steps(seconds: float, session: Session) -> int:
    """Return the number of simulation steps that a time takes."""
    return math.ceil(seconds / session.step_length - 1e-6)
