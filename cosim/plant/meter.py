"""What the city is doing: the accumulations x_ij with an exact vehicle ledger, and every crossing of a boundary."""

from collections import Counter
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from cosim.sumo.arrays import PerGateway
from cosim.sumo.net import City
from cosim.sumo.session import REFUSALS, Session
from nmfd.arrays import PerPair
from nmfd.ledger import LedgerError
from nmfd.types import State


@dataclass
class _Vehicle:
    """origin, destination: regions; edge: the last edge of its route; announced: the region of its last Event (on a
    junction it may be ahead of that), its origin before the first; free: guidance may reroute it; region: where it is
    now, None before the departure."""

    origin: int
    destination: int
    edge: str
    announced: int
    free: bool = True
    region: int | None = None

    @property
    def here(self) -> int:
        """The region, of one that has departed."""
        if self.region is None:
            raise RuntimeError(f"a vehicle bound for {self.edge} is on the road, but was never seen to depart")
        return self.region


@dataclass(frozen=True, kw_only=True)
class Event:
    """A vehicle is in a region for the first time since it was elsewhere. source: None at the departure; free: its
    driver may choose another way (no public transport, no stops to make)."""

    vehicle: str
    source: int | None
    region: int
    destination: int
    edge: str
    free: bool = True


class Meter:
    """Follows every vehicle from loading to arrival.

    Regions change when a vehicle is seen on the first edge behind a gateway (polled), or at the latest when
    `accumulation` looks at every vehicle. A teleporting vehicle counts where it was last seen.

    departures (R, R), arrivals (R,), crossings (R, R, R) [i, h, j], teleports, and entry_flow, (source region, first
    edge behind the boundary) -> vehicles seen there: all since the beginning [veh]. probe_departures (R, R): those of
    the vehicles `probes`.
    """

    def __init__(self, session: Session, city: City, probes: frozenset[str] = frozenset()):
        """probes: vehicles that are counted apart, too"""
        self._session, self._city, self._probes = session, city, probes
        self._vehicles: dict[str, _Vehicle] = {}
        self._teleporting: set[str] = set()
        entries = sorted({g.to_edge for g in city.gateways})
        self._entries = {edge: city.region_of[edge] for edge in entries}
        # Polled often enough that no vehicle gets past the middle of an entry edge unseen.
        shortest = min((city.length[edge] / city.speed[edge] for edge in entries), default=2.0)
        self._poll_every = max(1, int(min(0.5 * shortest, 3.0) / session.step_length))
        self._steps = 0
        self._seen: dict[str, tuple[str, ...]] = dict.fromkeys(entries, ())
        self._running = np.zeros((city.regions, city.regions), dtype=int)
        self.teleports = 0
        self.departures, self.probe_departures = np.zeros((2, city.regions, city.regions), dtype=int)
        self.arrivals = np.zeros(city.regions, dtype=int)
        self.crossings = np.zeros((city.regions,) * 3, dtype=int)
        self.entry_flow: Counter[tuple[int, str]] = Counter()
        # Several movements may lead from one region to one edge: they share its flow.
        self._alike = Counter((g.source, g.to_edge) for g in city.gateways)

    def state(self, step: int, time: float) -> State:
        """What the city is in at `time` [s] since the start, when control step `step` begins. LedgerError."""
        return State(
            step=step, time=time, accumulation=self.accumulation(step), backlog=self.backlog(),
            completed=float(self.arrivals.sum()))

    def gateway_flow(self) -> PerGateway:
        """(G,) [veh] over each gateway of the city since the beginning."""
        return np.array([
            self.entry_flow[g.source, g.to_edge] / self._alike[g.source, g.to_edge] for g in self._city.gateways])

    def observe(self) -> list[Event]:
        """Account for the last simulation step; call after every one. Departures first, then entries."""
        session, events = self._session, []
        for vehicle in session.loaded():
            with suppress(*REFUSALS):  # gone already, where SUMO found no way for it when it was due
                self._load(vehicle)
        for vehicle in session.started_teleport():
            self.teleports += 1
            self._teleporting.add(vehicle)
        for vehicle in session.ended_teleport():
            self._teleporting.discard(vehicle)
        for vehicle in session.departed():
            known = self._load(vehicle)
            known.region = known.announced = known.origin
            self._running[known.origin, known.destination] += 1
            self.departures[known.origin, known.destination] += 1
            self.probe_departures[known.origin, known.destination] += vehicle in self._probes
            events.append(Event(
                vehicle=vehicle, source=None, region=known.origin, destination=known.destination, edge=known.edge,
                free=known.free))
        self._steps += 1
        for edge, region in self._entries.items() if self._steps % self._poll_every == 0 else ():
            present = session.vehicles_on(edge)
            if present != self._seen[edge]:
                for vehicle in set(present).difference(self._seen[edge]):
                    if (event := self._enter(vehicle, edge, region)) is not None:
                        events.append(event)
                self._seen[edge] = present
        for vehicle in session.arrived():
            self._teleporting.discard(vehicle)
            known = self._vehicles.pop(vehicle)
            if known.region is None:  # given up before it departed
                continue
            self._cross(known, known.destination)
            self._running[known.destination, known.destination] -= 1
            self.arrivals[known.destination] += 1
        events.sort(key=lambda event: (event.source is not None, event.vehicle))  # set order is not reproducible
        return events

    def accumulation(self, step: int = 0) -> PerPair:
        """x_ij (R, R) [veh]: every vehicle counted where it is now, on junctions too. LedgerError if the count differs
        from departures minus arrivals, in total or in any (i, j) as followed from crossing to crossing; it names the
        control step `step`."""
        counted = np.zeros_like(self._running)
        self.teleports = max(self.teleports, self._session.teleports())
        on_road = self._session.running()
        for vehicle in on_road:
            known = self._vehicles[vehicle]
            region = self._city.region_of.get(self._session.road(vehicle), known.here)
            self._cross(known, region)
            counted[region, known.destination] += 1
        for vehicle in self._teleporting.difference(on_road):
            known = self._vehicles[vehicle]
            counted[known.region, known.destination] += 1
        balance = int(self.departures.sum() - self.arrivals.sum())
        if counted.sum() < balance:
            for vehicle in self._held(on_road):
                known = self._vehicles[vehicle]
                counted[known.region, known.destination] += 1
        if counted.sum() != balance or (counted != self._running).any():
            i, j = np.unravel_index(int(np.abs(counted - self._running).argmax()), counted.shape)
            raise LedgerError(
                f"vehicle ledger broken at control step {step}, {self._session.time:g} s: {counted.sum()} vehicles are "
                f"in the city, but {self.departures.sum()} departures minus {self.arrivals.sum()} arrivals are "
                f"{balance}; in region {i} bound for {j} there are {counted[i, j]}, and {self._running[i, j]} were "
                "followed there")
        return counted.astype(float)

    def _held(self, on_road: Collection[str]) -> set[str]:
        """The vehicles that the mesoscopic model has taken off a jammed road without a word, until there is room for
        them further on: on their way, neither on the road nor teleporting, but still known to SUMO."""
        under_way = {vehicle for vehicle, known in self._vehicles.items() if known.region is not None}
        return under_way.difference(on_road, self._teleporting).intersection(self._session.known())

    def backlog(self) -> PerPair:
        """(R, R) [veh]: due to depart from i for j, but not inserted yet."""
        waiting = np.zeros(self._running.shape)
        for vehicle in self._session.pending():
            known = self._load(vehicle)
            waiting[known.origin, known.destination] += 1
        return waiting

    def probes(self) -> PerPair:
        """(R, R) [veh]: the probes among the accumulation, where it last counted them."""
        counted = np.zeros(self._running.shape)
        for vehicle in self._probes & self._vehicles.keys():
            known = self._vehicles[vehicle]
            if known.region is not None:
                counted[known.region, known.destination] += 1
        return counted

    def probe_backlog(self) -> PerPair:
        """(R, R) [veh]: the probes among the backlog."""
        waiting = np.zeros(self._running.shape)
        for vehicle in self._probes.intersection(self._session.pending()):
            known = self._load(vehicle)
            waiting[known.origin, known.destination] += 1
        return waiting

    def _load(self, vehicle: str) -> _Vehicle:
        if vehicle not in self._vehicles:
            route, region_of = self._session.route(vehicle), self._city.region_of
            origin = region_of.get(route[0], 0)
            self._vehicles[vehicle] = _Vehicle(
                origin=origin, destination=region_of.get(route[-1], 0), edge=route[-1], announced=origin,
                free=self._session.is_free(vehicle))
        return self._vehicles[vehicle]

    def _enter(self, vehicle: str, edge: str, region: int) -> Event | None:
        known = self._vehicles[vehicle]
        if vehicle in self._teleporting or known.region == known.announced == region:
            return None
        source = known.announced if known.region == region else known.here
        self._cross(known, region)
        known.announced = region
        self.entry_flow[source, edge] += 1
        return Event(
            vehicle=vehicle, source=source, region=region, destination=known.destination, edge=known.edge,
            free=known.free)

    def _cross(self, known: _Vehicle, region: int) -> None:
        if region != known.region:
            self.crossings[known.region, region, known.destination] += 1
            self._running[known.region, known.destination] -= 1
            self._running[region, known.destination] += 1
            known.region = region
