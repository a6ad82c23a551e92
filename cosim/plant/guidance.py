"""Route guidance of drivers by commanded split ratios, or by prices.

Every vehicle gets its next region when it enters a region, in shares theta (cosim.plant.shares).
Prices lengthen the travel times through a region for drivers with another destination. Then no
share is commanded.

A guided vehicle in region i bound for edge d takes the fastest route inside i to a gateway i -> h,
and from there to d without coming back to i, at recent travel times (cosim.plant.routes) as its
class of drivers sees them. With a period, it is guided again in i. No driver takes a much longer
detour, by times without prices. Drivers keep their route unless the gain is large
(cosim.plant.fastest). If `ways_return` is set, a route may leave region i and come back (needed
where boundaries are ragged). Its next region is the one it enters on its last exit from i.
"""

import math
from collections import defaultdict
from collections.abc import Container, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from cosim.plant import fastest
from cosim.plant.fastest import UNKNOWN
from cosim.plant.meter import Event
from cosim.plant.routes import Searches, TravelTimes
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


class _Visit(NamedTuple):
    """A compliant driver in one region.

    edge: last one of the route; slot: of the visit in `_Visits.table`
    """

    vehicle: str
    region: int
    edge: str
    slot: int


class _Itinerary(NamedTuple):
    """A route as SUMO has it.

    names: of its edges; edges: their numbers, UNKNOWN on roads closed to cars
    known_from: place of the first edge after these roads
    """

    names: tuple[str, ...]
    edges: Int[np.ndarray, " edges"]
    known_from: int


class _Visits:
    """Visits of all compliant drivers, and when each is guided again.

    present: vehicle -> its visit
    table: of all visits (fastest.VISIT, (slots,))
    """

    def __init__(self) -> None:
        self.present: dict[str, _Visit] = {}
        self.table = np.zeros(0, fastest.VISIT)
        self._free: list[int] = []  # slots
        self._step = 0
        self._due = defaultdict[int, list[_Visit]](list)  # simulation step -> visits

    def begin_step(self) -> None:
        self._step += 1

    def begin(self, event: Event, driver_class: int, target: int) -> _Visit:
        """Return a new visit. target: number of the last edge"""
        if not self._free:
            slots = len(self.table)
            self.table = np.concatenate([self.table, np.zeros(slots + 1, fastest.VISIT)])
            self._free += range(slots, len(self.table))
        visit = _Visit(event.vehicle, event.region, event.edge, self._free.pop())
        row = (event.region, event.destination, driver_class, target, UNKNOWN, 0)
        self.table[visit.slot] = row
        self.present[event.vehicle] = visit
        return visit

    def end(self, vehicle: str) -> None:
        """Forget a vehicle that has left the region, or arrived."""
        visit = self.present.pop(vehicle, None)
        if visit is not None:
            self._free.append(visit.slot)

    def again(self, visits: Iterable[_Visit], steps: int) -> None:
        """Let drivers be guided again after so many simulation steps.

        steps: 0: never
        """
        if steps:
            self._due[self._step + steps] += visits

    def due(self) -> list[_Visit]:
        """Return the drivers to guide again in this step."""
        return self._due.pop(self._step, [])


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
        self._period = _steps(period, session)
        self._retry = _steps(RETRY_S, session)
        self._lanes = None
        if lanes:
            self._lanes = Lanes(session, 0.0 if turn_late and period else QUEUE_END_M)
        spread = SPREAD if lanes else MESO_SPREAD
        taste = np.exp(spread * random.standard_normal((DRIVER_CLASSES, len(city.edges))))
        self._times = TravelTimes(city, lanes=lanes)
        self._searches = Searches(
            city,
            self._times,
            taste,
            most_detour=most_detour,
            ways_return=ways_return,
            lanes=lanes,
        )
        self._visits = _Visits()
        self._itineraries: dict[str, _Itinerary] = {}  # of drivers when they were guided last
        self._shares = Shares(own)
        self.realised = self._shares.counts.realised
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
        self._searches.command(prices)
        self._shares.command(splits)

    def apply(self, events: list[Event]) -> None:
        """Guide vehicles that are new in a region, and those that are due again.

        events: departures and entries of the last simulation step
        """
        if not self._guides:
            return
        visits = self._visits
        visits.begin_step()
        for vehicle in self._session.arrived():
            visits.end(vehicle)
            self._itineraries.pop(vehicle, None)
        guided = []
        for event in events:
            visits.end(event.vehicle)
            guidable = event.free and event.vehicle not in self._planned
            if guidable and self._random.random() < self._compliance:
                driver_class = int(self._random.integers(DRIVER_CLASSES))
                # The routes of some, such as taxis, end on roads closed to cars.
                target = self._city.number.get(event.edge)
                if target is not None:
                    guided.append(visits.begin(event, driver_class, target))
        guided += visits.due()
        if guided:
            self._guide(guided)

    def _guide(self, visits: list[_Visit]) -> None:
        """Reroute drivers.

        If a vehicle is on a junction, has left the region, or can no longer change lanes, try again
        after a few steps.
        """
        soon = []
        ready = []
        present = self._visits.present
        number = self._city.number
        road = self._session.road
        for visit in visits:
            if present.get(visit.vehicle) is not visit:
                continue  # the vehicle has left the region, or arrived
            try:
                here = number.get(road(visit.vehicle))
            except REFUSALS:  # the vehicle was removed, or arrived at once
                self._visits.end(visit.vehicle)
                continue
            if here is None or self._region[here] != visit.region:
                soon.append(visit)
            else:
                ready.append((visit, here))
        late = self._plan(self._led(ready))
        in_time = [visit for visit, _ in ready if visit not in late]
        self._visits.again(soon, min(self._period, 1))
        self._visits.again(in_time, self._period)
        self._visits.again(late, self._retry)

    def _led(self, ready: list[tuple[_Visit, int]]) -> list[tuple[_Visit, int]]:
        """Lead on drivers at the end of a wrong lane; return the others.

        ready: drivers, and numbers of their present edges
        """
        if self._lanes is None:
            return ready
        others = []
        for visit, here in ready:
            way_out = self._lanes.way_out(visit.vehicle, visit.edge)
            if way_out:
                self.led_on += self._session.set_route(visit.vehicle, way_out)
            else:
                others.append((visit, here))
        return others

    def _plan(self, ready: Sequence[tuple[_Visit, int]]) -> list[_Visit]:
        """Give drivers their routes.

        Returns those who cannot change lanes any more.

        ready: as in `_led`
        """
        late: list[_Visit] = []
        if not ready:
            return late
        rows = []
        routes = []
        end = 0
        for visit, here in ready:
            itinerary = self._itinerary(visit.vehicle)
            place = self._session.route_index(visit.vehicle)
            begin = end + place
            end += len(itinerary.edges)
            rows.append((visit.slot, here, begin, end, place >= itinerary.known_from))
            routes.append(itinerary.edges)
        drivers = np.array(rows, fastest.DRIVER)
        all_routes = np.concatenate(routes)
        scene = self._searches.scene
        counts = self._shares.counts
        visits = self._visits.table
        n = -1
        while True:
            n, following, route = fastest.next_change(
                scene, counts, visits, drivers, all_routes, n + 1
            )
            if n == len(ready):
                return late
            visit, _ = ready[n]
            edges = [self._city.edges[edge] for edge in route.tolist()]
            if self._lanes and self._lanes.too_late(visit.vehicle, edges):
                late.append(visit)
            # If SUMO refuses the route, nothing changes.
            elif self._session.set_route(visit.vehicle, edges) and following != UNKNOWN:
                fastest.assign(counts, visits, visit.slot, following)

    def _itinerary(self, vehicle: str) -> _Itinerary:
        """Return the present route of a driver."""
        names = self._session.route(vehicle)
        known = self._itineraries.get(vehicle)
        if known is None or known.names != names:
            number = self._city.number
            edges = [number.get(edge, UNKNOWN) for edge in names]
            known_from = 0
            if UNKNOWN in edges:
                known_from = len(edges) - edges[::-1].index(UNKNOWN)
            known = _Itinerary(names, np.array(edges), known_from)
            self._itineraries[vehicle] = known
        return known


def _steps(seconds: float, session: Session) -> int:
    """Return the number of simulation steps that a time takes."""
    return math.ceil(seconds / session.step_length - 1e-6)
