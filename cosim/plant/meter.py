"""The exact vehicle ledger of a run: accumulations x_ij and crossings.

SUMO's tripinfo has the outcome of vehicles that have left (cosim.sumo.outputs): an arrival at the
last edge of the final route, else a removal.
"""

import math
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cosim.plant.metering import Metering
from cosim.sumo.arrays import PerGateway
from cosim.sumo.departures import original
from cosim.sumo.net import City
from cosim.sumo.outputs import End, TripReader
from cosim.sumo.session import REFUSALS, Session
from nmfd.arrays import PerPair
from nmfd.ledger import LedgerError
from nmfd.types import State

POLL_PERIOD_S = 3.0  # longest time between two looks at the entry edges
COMPLETED = "completed"
REMOVED = "removed"
UNDER_WAY = "under way"
WAITING = "waiting"
GIVEN_UP = "given up"


@dataclass
class _Vehicle:
    """A vehicle that SUMO has loaded."""

    origin: int
    destination: int
    edge: str  # last one of its route
    free: bool  # guidance may reroute it
    private: bool  # a trip of the demand
    public: bool  # `Session.is_public`
    due: float = 0.0  # [s]
    waited: float = 0.0  # departure delay [s]
    phantom: bool = False  # neither in the demand nor in the city's other files
    departed: bool = False
    region: int = 0  # the present one, since the departure
    announced: int = 0  # region of its last Event, perhaps ahead


class Event(NamedTuple):
    """A departure (source None), or an entry into another region.

    edge: last one of its route; free: the driver may take another route (no public transport, no
        stops)
    """

    vehicle: str
    source: int | None
    region: int
    destination: int
    edge: str
    free: bool = True


class Trip(NamedTuple):
    """A trip that was due.

    origin: region; public: public transport
    outcome: COMPLETED, REMOVED on the road, UNDER_WAY, WAITING to enter, or GIVEN_UP before that
    departure_delay: time spent waiting to enter [s]; time: in all, until its end or now [s]
    time_loss: against driving freely [s], NaN if it is not known yet
    """

    origin: int
    private: bool
    outcome: str
    departure_delay: float
    time: float
    time_loss: float = 0.0
    public: bool = False


class Meter:
    """Follows every vehicle from loading to its end.

    Regions change when a vehicle is seen on the first edge behind a gateway (polled), or at the
    latest when `accumulation` looks at every vehicle. A teleporting vehicle counts where it was
    last seen.

    Since the beginning [veh]:
    departures (R, R); probe_departures (R, R), of probes; arrivals (R,), completed trips
    private_arrivals (R,), of these the private ones
    removals (R, R) [i, j], vehicles taken out in i on their way to j
    given_up (R, R), trips dropped before they began
    crossings (R, R, R) [i, h, j], from i to h by a gateway; jumps (R, R, R), without one:
        teleports, streets closed to cars, vehicles moved by another program, or too fast to be seen
        in between
    redirected (R, R, R) [i, j, l], in i, bound for j and from now on for l
    teleports; entry_flow, (source region, first edge behind the boundary) -> vehicles
    """

    def __init__(
        self,
        session: Session,
        city: City,
        probes: frozenset[str] = frozenset(),
        trips: TripReader | None = None,
        metering: Metering | None = None,
        demand: Container[str] | None = None,
        beside: Container[str] = frozenset(),
    ):
        """probes: vehicles that are also counted apart

        metering: trips that wait outside
        trips: ends of trips; None if SUMO cannot write them at once: all are arrivals then
        demand: private trips; None: all vehicles but public transport and the like
        beside: other vehicles and flows of the city's files. All others are made, and perhaps
            dropped again, by calibrators and persons
        """
        self._session = session
        self._city = city
        self._probes = probes
        self._trips = trips
        self._demand = demand
        self._beside = beside
        self._metering = metering
        self._vehicles: dict[str, _Vehicle] = {}
        # Vehicles that are not in tripinfo yet; several if an id is used again.
        self._gone: dict[str, list[_Vehicle]] = {}
        self._teleporting: set[str] = set()
        self._ended: list[Trip] = []
        self._spent = np.zeros(2)  # by their trips [veh s]: other, private
        self._joined = {(g.source, g.target) for g in city.gateways}
        entries = sorted({g.to_edge for g in city.gateways})
        self._entries = {edge: city.region_of[edge] for edge in entries}
        # Polled often enough that no vehicle gets past the middle of an entry edge unseen.
        shortest = min((city.length[edge] / city.speed[edge] for edge in entries), default=2.0)
        self._poll_steps = max(1, int(min(0.5 * shortest, POLL_PERIOD_S) / session.step_length))
        self._steps = 0
        self._seen: dict[str, tuple[str, ...]] = dict.fromkeys(entries, ())
        regions = city.regions
        self._running = np.zeros((regions, regions), dtype=int)
        self.departures, self.probe_departures, self.removals, self.given_up = np.zeros(
            (4, regions, regions), dtype=int
        )
        self.arrivals, self.private_arrivals = np.zeros((2, regions), dtype=int)
        self.crossings, self.jumps, self.redirected = np.zeros(
            (3, regions, regions, regions), dtype=int
        )
        self._steps_inside = np.zeros((regions, regions), dtype=int)
        self.teleports = 0
        self.entry_flow: Counter[tuple[int, str]] = Counter()
        # Several movements may lead from one region to one edge: they share its flow.
        self._alike = Counter((g.source, g.to_edge) for g in city.gateways)

    def state(self, step: int, time: float) -> State:
        """Return the state when control step `step` begins.

        time: since the start [s]

        Raises LedgerError.
        """
        return State(
            step=step,
            time=time,
            accumulation=self.accumulation(step),
            backlog=self.backlog(),
            completed=float(self.private_arrivals.sum()),
            removed=(self.removals + self.given_up).astype(float),
        )

    def gateway_flow(self) -> PerGateway:
        """Return (G,) [veh] over each gateway since the beginning."""
        flows = []
        for gateway in self._city.gateways:
            entry = gateway.source, gateway.to_edge
            flows.append(self.entry_flow[entry] / self._alike[entry])
        return np.array(flows)

    @property
    def time_inside(self) -> PerPair:
        """Time that vehicles bound for j spent in i [veh s, (R, R)]."""
        return self._steps_inside * self._session.step_length

    def observe(self) -> list[Event]:
        """Account for the last simulation step; return departures, then entries."""
        session = self._session
        events = []
        arrived = list(session.arrived())
        for vehicle in session.loaded():
            try:
                self._load(vehicle)
            except REFUSALS:  # gone already: SUMO found no route when it was due
                self._give_up(vehicle)
        for vehicle in session.started_teleport():
            self.teleports += 1
            self._teleporting.add(vehicle)
        self._teleporting.difference_update(session.ended_teleport())
        for vehicle in session.departed():
            before = self._vehicles.get(vehicle)
            if before and before.departed:  # its id is used again
                self._leave(vehicle)
                if vehicle in arrived:
                    arrived.remove(vehicle)
            known = self._depart(vehicle)
            events.append(
                Event(vehicle, None, known.origin, known.destination, known.edge, known.free)
            )
        self._steps += 1
        if self._steps % self._poll_steps == 0:
            events += self._entered()
        for vehicle in arrived:
            self._leave(vehicle)
        self._steps_inside += self._running
        # The order of a set is not reproducible.
        events.sort(key=lambda event: (event.source is not None, event.vehicle))
        return events

    def _give_up(self, vehicle: str) -> None:
        """Book a vehicle that SUMO dropped before it could be looked at."""
        if self._is_phantom(vehicle):
            return
        self.given_up[0, 0] += 1
        private = self._demand is None or vehicle in self._demand
        self._end(Trip(0, private, GIVEN_UP, 0.0, 0.0))

    def _entered(self) -> list[Event]:
        """Return the entries since the last poll of the edges behind boundaries."""
        events = []
        for edge, region in self._entries.items():
            present = self._session.vehicles_on(edge)
            if present != self._seen[edge]:
                for vehicle in set(present).difference(self._seen[edge]):
                    events += self._enter(vehicle, edge, region)
                self._seen[edge] = present
        return events

    def accumulation(self, step: int = 0) -> PerPair:
        """Return x_ij (R, R) [veh], with every vehicle counted where it is now.

        Vehicles on junctions count, too.

        step: control step, for messages
        Raises LedgerError if the count differs from departures minus arrivals and removals, in
        total or in any (i, j) as followed from crossing to crossing, or if the end of a vehicle is
        unknown.
        """
        counted = np.zeros_like(self._running)
        self.teleports = max(self.teleports, self._session.teleports())
        on_road = self._session.running()
        if self._trips is not None:
            self._settle(self._trips.ends())
        for vehicle in on_road:
            known = self._under_way(vehicle)
            self._follow(vehicle, known)
            self._cross(known, self._city.region_of.get(self._session.road(vehicle), known.region))
            counted[known.region, known.destination] += 1
        away = self._teleporting.difference(on_road)
        if len(on_road) + len(away) < self._running.sum():
            # The mesoscopic model holds vehicles off a jammed road.
            under_way = {vehicle for vehicle, known in self._vehicles.items() if known.departed}
            held = under_way.difference(on_road)
            away |= held.intersection(self._session.known())  # the others have left
        for vehicle in away:
            known = self._vehicles[vehicle]
            counted[known.region, known.destination] += 1
        if self._gone:
            raise LedgerError(f"vehicle ledger broken at control step {step}{self._unknown_ends()}")
        balance = int(self.departures.sum() - self.arrivals.sum() - self.removals.sum())
        if counted.sum() != balance or (counted != self._running).any():
            raise LedgerError(self._difference(counted, balance, step))
        return counted.astype(float)

    def _difference(self, counted: np.ndarray, balance: int, step: int) -> str:
        """Return how the vehicles that were counted (R, R) differ from the books."""
        i, j = np.unravel_index(int(np.abs(counted - self._running).argmax()), counted.shape)
        removed = f" and {self.removals.sum()} removed" if self.removals.any() else ""
        return (
            f"vehicle ledger broken at control step {step}, {self._session.time:g} s: "
            f"{counted.sum()} vehicles are in the city, but {self.departures.sum()} departures "
            f"minus {self.arrivals.sum()} arrivals{removed} are {balance}; in region {i} bound for "
            f"{j} there are {counted[i, j]}, and {self._running[i, j]} were followed there"
        )

    def close_books(self) -> None:
        """Book the ends of the last vehicles after the simulation.

        Raises LedgerError if tripinfo misses a vehicle, or its sums differ from the books.
        """
        if self._trips is None:
            return
        self._settle(self._trips.finish(self._gone))
        trips = self._trips
        arrivals = int(self.arrivals.sum())
        removals = int(self.removals.sum())
        if self._gone or (trips.completed, trips.removed) != (arrivals, removals):
            raise LedgerError(
                f"vehicle ledger broken at the end: {arrivals} completed trips and {removals} "
                f"removed vehicles were booked, but SUMO's tripinfo has {trips.completed} and "
                f"{trips.removed}{self._unknown_ends()}"
            )

    def backlog(self) -> PerPair:
        """Return (R, R) [veh] due to depart from i for j, but not inserted yet.

        Trips that SUMO dropped meanwhile are booked.
        """
        pending = self._session.pending()
        waiting = self.held() + self._waiting(pending)
        ahead = {vehicle for vehicle, known in self._vehicles.items() if not known.departed}
        ahead.difference_update(pending)
        if ahead:
            for vehicle in sorted(ahead.difference(self._session.known())):
                self._leave(vehicle)
        for vehicle, known in self._vehicles.items():
            # A vehicle that waits for a person may be due later than it said.
            if not known.departed and known.due < self._session.time:
                self._time(vehicle, known)
        return waiting

    def time_spent(self) -> Float[np.ndarray, "2"]:
        """Return (2,) [veh s] spent so far, by other and by private vehicles."""
        spent = self._spent.copy()
        for trip in self._open():
            spent[int(trip.private)] += trip.time
        return spent

    def trips(self) -> list[Trip]:
        """Return all trips that were due.

        Time losses of those under way are known when the books are closed.
        """
        return [*self._ended, *self._open()]

    def _open(self) -> Iterator[Trip]:
        """Yield the trips that were due and have not ended."""
        now = self._session.time
        losses: Mapping[str, float] = {} if self._trips is None else self._trips.under_way
        for vehicle, known in self._vehicles.items():
            if known.departed:
                yield _trip(known, UNDER_WAY, now, losses.get(vehicle, math.nan))
            elif known.due < now:
                yield _trip(known, WAITING, now)
        if self._metering is not None:
            for origin, due in self._metering.waiting():
                yield Trip(origin, True, WAITING, now - due, now - due)

    def _end(self, trip: Trip) -> None:
        self._ended.append(trip)
        self._spent[int(trip.private)] += trip.time

    def held(self) -> PerPair:
        """Return (R, R) [veh] of the backlog: metered trips."""
        if self._metering is None:
            return np.zeros(self._running.shape)
        return self._metering.backlog()

    def probes(self) -> PerPair:
        """Return (R, R) [veh], the probes of the accumulation last counted."""
        counted = np.zeros(self._running.shape)
        for vehicle in self._probes & self._vehicles.keys():
            known = self._vehicles[vehicle]
            if known.departed:
                counted[known.region, known.destination] += 1
        return counted

    def probe_backlog(self) -> PerPair:
        """Return (R, R) [veh] of the backlog: probes."""
        return self._waiting(self._probes.intersection(self._session.pending()))

    def _waiting(self, vehicles: Iterable[str]) -> PerPair:
        waiting = np.zeros(self._running.shape)
        for vehicle in vehicles:
            known = self._load(vehicle)
            waiting[known.origin, known.destination] += 1
        return waiting

    def _settle(self, ends: Iterable[End]) -> None:
        """Book the ends of trips that tripinfo tells."""
        for end in ends:
            name = end.vehicle
            if name not in self._gone:  # removed by another program: SUMO does not call it arrived
                if name not in self._vehicles:
                    raise LedgerError(
                        f"vehicle ledger broken: {name} ended a trip, but was never seen to load"
                    )
                self._under_way(name)
                self._leave(name)
            self._book(self._gone[name].pop(0), end)
            if not self._gone[name]:
                del self._gone[name]

    def _unknown_ends(self) -> str:
        if not self._gone:
            return ""
        return (
            f": SUMO's tripinfo does not tell how the trips of {len(self._gone)} vehicles ended "
            f"(such as {min(self._gone)}): is the disk full? Or does their type have "
            "has.tripinfo.device = false? Remove that"
        )

    def _book(self, gone: _Vehicle, end: End) -> None:
        """Book the end of a vehicle that has left."""
        i = gone.region
        j = gone.destination
        if end.reason:
            self._end(_trip(gone, REMOVED, end.time, end.time_loss))
            h = self._city.region_of.get(end.edge, i)
            self.removals[h, j] += 1
        else:
            self._end(_trip(gone, COMPLETED, end.time, end.time_loss))
            h = self._city.region_of.get(end.edge, j)
            self.arrivals[h] += 1
            self.private_arrivals[h] += gone.private
            self.redirected[i, j, h] += h != j
            j = h
        if h != i:
            self._passages(i, h)[i, h, j] += 1

    def _passages(self, i: int, h: int) -> np.ndarray:
        """Return the book (R, R, R) of passages from i to h: crossings or jumps."""
        return self.crossings if (i, h) in self._joined else self.jumps

    def _load(self, vehicle: str) -> _Vehicle:
        """Return a vehicle, which may be new."""
        known = self._vehicles.get(vehicle)
        if known is None:
            session = self._session
            region_of = self._city.region_of
            route = session.route(vehicle)
            private = session.is_private(vehicle)
            if self._demand is not None:
                private = private and vehicle in self._demand
            known = _Vehicle(
                origin=region_of.get(route[0], 0),
                destination=region_of.get(route[-1], 0),
                edge=route[-1],
                free=session.is_free(vehicle),
                private=private,
                public=not private and session.is_public(vehicle),
            )
            known.phantom = self._is_phantom(vehicle)
            self._vehicles[vehicle] = known
            self._time(vehicle, known)
        return known

    def _is_phantom(self, vehicle: str) -> bool:
        """Return True for a vehicle that a calibrator or a person made."""
        if self._demand is None or vehicle in self._demand:
            return False
        return not original(vehicle, self._beside)

    def _time(self, vehicle: str, known: _Vehicle) -> None:
        """Note when a vehicle was due, and its departure delay until now."""
        departed, known.waited = self._session.departure(vehicle)
        if self._metering is not None:
            known.waited += self._metering.waited.get(vehicle, 0.0)
        known.due = departed - known.waited

    def _depart(self, vehicle: str) -> _Vehicle:
        """Record a departure from the vehicle's region to its destination.

        Both are the current ones.
        """
        known = self._load(vehicle)
        with suppress(REFUSALS):  # gone already
            self._time(vehicle, known)
            self._follow(vehicle, known)
            known.origin = self._city.region_of.get(self._session.road(vehicle), known.origin)
        known.departed = True
        known.region = known.origin
        known.announced = known.origin
        self._running[known.origin, known.destination] += 1
        self.departures[known.origin, known.destination] += 1
        self.probe_departures[known.origin, known.destination] += vehicle in self._probes
        return known

    def _under_way(self, vehicle: str) -> _Vehicle:
        """Return a vehicle on the road, even if another program put it there."""
        known = self._vehicles.get(vehicle)
        if known and known.departed:
            return known
        return self._depart(vehicle)

    def _follow(self, vehicle: str, known: _Vehicle) -> None:
        """Book a change of the destination."""
        edge = self._session.route(vehicle)[-1]
        if edge == known.edge:
            return
        before = known.destination
        known.edge = edge
        known.destination = self._city.region_of.get(edge, 0)
        if known.departed and known.destination != before:
            self.redirected[known.region, before, known.destination] += 1
            self._running[known.region, before] -= 1
            self._running[known.region, known.destination] += 1

    def _leave(self, vehicle: str) -> None:
        """Take a vehicle out; its end is booked when tripinfo has it."""
        self._teleporting.discard(vehicle)
        known = self._vehicles.pop(vehicle)
        ended = self._session.time - self._session.step_length
        if not known.departed:  # given up before it departed
            if known.phantom:
                return
            self.given_up[known.origin, known.destination] += 1
            self._end(_trip(known, GIVEN_UP, ended))
            return
        self._running[known.region, known.destination] -= 1
        if self._trips is None:
            self._book(known, End(vehicle=vehicle, time=ended))
        else:
            self._gone.setdefault(vehicle, []).append(known)

    def _enter(self, vehicle: str, edge: str, region: int) -> list[Event]:
        """Book a vehicle on the first edge behind a boundary; return its Event."""
        known = self._under_way(vehicle)
        if vehicle in self._teleporting or known.region == known.announced == region:
            return []
        source = known.announced if known.region == region else known.region
        self._follow(vehicle, known)
        self._cross(known, region)
        known.announced = region
        self.entry_flow[source, edge] += 1
        return [Event(vehicle, source, region, known.destination, known.edge, known.free)]

    def _cross(self, known: _Vehicle, region: int) -> None:
        """Book a vehicle that is in `region` now."""
        if region != known.region:
            passages = self._passages(known.region, region)
            passages[known.region, region, known.destination] += 1
            self._running[known.region, known.destination] -= 1
            self._running[region, known.destination] += 1
            known.region = region


def _trip(known: _Vehicle, outcome: str, end: float, time_loss: float = 0.0) -> Trip:
    """Return the trip of a vehicle until `end` [s]."""
    time = max(end - known.due, 0.0)
    waited = known.waited if known.departed else time
    return Trip(known.origin, known.private, outcome, waited, time, time_loss, known.public)
