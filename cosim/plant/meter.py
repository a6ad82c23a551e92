"""What the city is doing: the accumulations x_ij with an exact vehicle ledger, and every crossing of a boundary.

Vehicles that have left are booked when `accumulation` counts, as SUMO's tripinfo tells it (cosim.sumo.tripinfo): as
arrivals those that reached the last edge of their route, as it was in the end; as removed all others, whoever took them
out. Where SUMO cannot be made to write its tripinfo at once (in the window), what it has not told of yet is taken for
granted, an arrival for an arrival, and booked anew when it tells; `close_books` is the last word.
"""

from collections import Counter
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from cosim.plant.metering import Metering
from cosim.sumo.arrays import PerGateway
from cosim.sumo.net import City
from cosim.sumo.session import REFUSALS, Session
from cosim.sumo.tripinfo import End, TripReader
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


@dataclass
class _Gone:
    """A vehicle that has left from `region`; guess: how it was booked as long as SUMO had not told."""

    vehicle: _Vehicle
    region: int
    guess: End | None = None


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
    """Follows every vehicle from loading to its end.

    Regions change when a vehicle is seen on the first edge behind a gateway (polled), or at the latest when
    `accumulation` looks at every vehicle. A teleporting vehicle counts where it was last seen.

    Since the beginning [veh]:
    departures (R, R); probe_departures (R, R), those of the vehicles `probes`
    arrivals (R,), trips that were completed; removals (R, R) [i, j], vehicles that were taken out on their way, in i
    given_up (R, R), trips that SUMO dropped before they began
    crossings (R, R, R) [i, h, j] from i to h where a gateway leads there; jumps, the same where none does: by teleport,
        by a street closed to cars, moved by another program, or past a region so fast that nobody saw it there
    redirected (R, R, R) [i, j, l], in i, bound for j and from now on for l
    time_loss (R,) [s], lost on the road against driving freely, by the region where trips began; complete when the
        books are closed
    teleports, and entry_flow, (source region, first edge behind the boundary) -> vehicles seen there
    """

    def __init__(
        self,
        session: Session,
        city: City,
        probes: frozenset[str] = frozenset(),
        trips: TripReader | None = None,
        metering: Metering | None = None,
    ):
        """probes: vehicles that are counted apart, too; trips: what SUMO tells of those that have left, None to take
        all that it calls arrived for arrivals; metering: who has trips wait, of whom SUMO does not know yet"""
        self._metering = metering
        self._session, self._city, self._probes, self._trips = session, city, probes, trips
        self._vehicles: dict[str, _Vehicle] = {}
        self._gone: dict[str, list[_Gone]] = {}  # whose end SUMO has not told of: several where an id is used again
        self._teleporting: set[str] = set()
        self._joined = {(g.source, g.target) for g in city.gateways}
        entries = sorted({g.to_edge for g in city.gateways})
        self._entries = {edge: city.region_of[edge] for edge in entries}
        # Polled often enough that no vehicle gets past the middle of an entry edge unseen.
        shortest = min((city.length[edge] / city.speed[edge] for edge in entries), default=2.0)
        self._poll_every = max(1, int(min(0.5 * shortest, 3.0) / session.step_length))
        self._steps = 0
        self._seen: dict[str, tuple[str, ...]] = dict.fromkeys(entries, ())
        self.teleports, regions = 0, city.regions
        self._running, self.departures, self.probe_departures, self.removals, self.given_up = np.zeros(
            (5, regions, regions), dtype=int
        )
        self.arrivals, self.time_loss = np.zeros(regions, dtype=int), np.zeros(regions)
        self.crossings, self.jumps, self.redirected = np.zeros((3, regions, regions, regions), dtype=int)
        self.entry_flow: Counter[tuple[int, str]] = Counter()
        # Several movements may lead from one region to one edge: they share its flow.
        self._alike = Counter((g.source, g.to_edge) for g in city.gateways)

    def state(self, step: int, time: float) -> State:
        """What the city is in at `time` [s] since the start, when control step `step` begins. LedgerError."""
        accumulation, backlog = self.accumulation(step), self.backlog()
        return State(
            step=step,
            time=time,
            accumulation=accumulation,
            backlog=backlog,
            completed=float(self.arrivals.sum()),
            removed=(self.removals + self.given_up).astype(float),
        )

    def gateway_flow(self) -> PerGateway:
        """(G,) [veh] over each gateway of the city since the beginning."""
        return np.array(
            [self.entry_flow[g.source, g.to_edge] / self._alike[g.source, g.to_edge] for g in self._city.gateways]
        )

    def observe(self) -> list[Event]:
        """Account for the last simulation step; call after every one. Departures first, then entries."""
        session, events = self._session, []
        arrived = list(session.arrived())
        for vehicle in session.loaded():
            try:
                self._load(vehicle)
            except REFUSALS:  # gone already, where SUMO found no way for it when it was due
                self.given_up[0, 0] += 1
        for vehicle in session.started_teleport():
            self.teleports += 1
            self._teleporting.add(vehicle)
        for vehicle in session.ended_teleport():
            self._teleporting.discard(vehicle)
        for vehicle in session.departed():
            if vehicle in self._vehicles and self._vehicles[vehicle].region is not None:  # its id is used again
                self._leave(vehicle)
                if vehicle in arrived:
                    arrived.remove(vehicle)
            known = self._depart(vehicle)
            events.append(
                Event(
                    vehicle=vehicle,
                    source=None,
                    region=known.origin,
                    destination=known.destination,
                    edge=known.edge,
                    free=known.free,
                )
            )
        self._steps += 1
        for edge, region in self._entries.items() if self._steps % self._poll_every == 0 else ():
            present = session.vehicles_on(edge)
            if present != self._seen[edge]:
                for vehicle in set(present).difference(self._seen[edge]):
                    if (event := self._enter(vehicle, edge, region)) is not None:
                        events.append(event)
                self._seen[edge] = present
        for vehicle in arrived:
            self._leave(vehicle)
        events.sort(key=lambda event: (event.source is not None, event.vehicle))  # set order is not reproducible
        return events

    def accumulation(self, step: int = 0) -> PerPair:
        """x_ij (R, R) [veh]: every vehicle counted where it is now, on junctions too. LedgerError if the count differs
        from departures minus arrivals and removed ones, in total or in any (i, j) as followed from crossing to
        crossing, or if SUMO does not tell what became of a vehicle; it names the control step `step`."""
        counted = np.zeros_like(self._running)
        self.teleports = max(self.teleports, self._session.teleports())
        on_road = self._session.running()
        if self._trips is not None:
            self._settle(self._trips.ends())
        for vehicle in on_road:
            known = self._under_way(vehicle)
            region = self._city.region_of.get(self._session.road(vehicle), known.here)
            self._follow(vehicle, known)
            self._cross(known, region)
            counted[region, known.destination] += 1
        away = self._teleporting.difference(on_road)
        if len(on_road) + len(away) < self._running.sum():
            away |= self._held(on_road)
        for vehicle in away:
            known = self._vehicles[vehicle]
            counted[known.region, known.destination] += 1
        self._guess(step)
        balance = int(self.departures.sum() - self.arrivals.sum() - self.removals.sum())
        if counted.sum() != balance or (counted != self._running).any():
            i, j = np.unravel_index(int(np.abs(counted - self._running).argmax()), counted.shape)
            raise LedgerError(
                f"vehicle ledger broken at control step {step}, {self._session.time:g} s: {counted.sum()} vehicles are "
                f"in the city, but {self.departures.sum()} departures minus {self.arrivals.sum()} arrivals"
                f"{f' and {self.removals.sum()} removed' if self.removals.any() else ''} are {balance}; in region {i} "
                f"bound for {j} there are {counted[i, j]}, and {self._running[i, j]} were followed there"
            )
        return counted.astype(float)

    def close_books(self) -> None:
        """When the simulation has ended: what became of the last vehicles. LedgerError if SUMO's tripinfo does not tell
        of every one, or sums up to something else."""
        if self._trips is None:
            return
        self._settle(self._trips.finish(self._gone))
        for vehicle, lost in self._trips.under_way.items():
            if vehicle in self._vehicles:
                self.time_loss[self._vehicles[vehicle].origin] += lost
        facts, booked = self._trips.facts, (int(self.arrivals.sum()), int(self.removals.sum()))
        if self._gone or (facts.completed, facts.removed) != booked:
            raise LedgerError(
                f"vehicle ledger broken at the end: {booked[0]} completed trips and {booked[1]} removed vehicles were "
                f"booked, but SUMO's tripinfo has {facts.completed} and {facts.removed}{self._untold()}"
            )

    def _held(self, on_road: Collection[str]) -> set[str]:
        """The vehicles that the mesoscopic model has taken off a jammed road without a word, until there is room for
        them further on: on their way, neither on the road nor teleporting, but still known to SUMO. Those that it does
        not know any more have left; where SUMO may tell so later."""
        under_way = {vehicle for vehicle, known in self._vehicles.items() if known.region is not None}
        lost = under_way.difference(on_road, self._teleporting)
        held = lost.intersection(self._session.known())
        if self._trips is not None and not self._trips.prompt:
            for vehicle in lost - held:
                self._leave(vehicle, End(vehicle=vehicle, reason="unknown"))
        return held

    def _settle(self, ends: Iterable[End]) -> None:
        """Book the vehicles that SUMO tells of."""
        for end in ends:
            if end.vehicle not in self._gone:  # removed by another program, which SUMO does not call arrived
                if end.vehicle not in self._vehicles:
                    raise LedgerError(f"vehicle ledger broken: {end.vehicle} ended a trip, but was never seen to load")
                self._under_way(end.vehicle)
                self._leave(end.vehicle)
            gone = self._gone[end.vehicle].pop(0)
            self.time_loss[gone.vehicle.origin] += end.time_loss
            if not self._gone[end.vehicle]:
                del self._gone[end.vehicle]
            if gone.guess is not None:
                self._book(gone, gone.guess, -1)
            self._book(gone, end)

    def _guess(self, step: int) -> None:
        """Book those of whom SUMO has not told yet as what they seem to be. LedgerError if it would have told."""
        if self._gone and self._trips is not None and self._trips.prompt:
            raise LedgerError(f"vehicle ledger broken at control step {step}{self._untold()}")
        for vehicle, left in self._gone.items():
            for gone in left:
                if gone.guess is None:
                    gone.guess = End(vehicle=vehicle)
                    self._book(gone, gone.guess)
        if self._trips is None:
            self._gone.clear()

    def _untold(self) -> str:
        if not self._gone:
            return ""
        return (
            f": SUMO's tripinfo does not tell how the trips of {len(self._gone)} vehicles ended (such as "
            f"{min(self._gone)}): is the disk full? Or does their type have has.tripinfo.device = false? Remove that"
        )

    def _book(self, gone: _Gone, end: End, sign: int = 1) -> None:
        """In the books of a vehicle that is in no region any more; sign: -1 to take it back."""
        i, j = gone.region, gone.vehicle.destination
        if not end.reason and (to := self._city.region_of.get(end.edge, j)) != j:
            self.redirected[i, j, to] += sign
            j = to
        h = self._city.region_of.get(end.edge, i if end.reason else j)
        if h != i:
            (self.crossings if (i, h) in self._joined else self.jumps)[i, h, j] += sign
        if end.reason:
            self.removals[h, j] += sign
        else:
            self.arrivals[h] += sign

    def backlog(self) -> PerPair:
        """(R, R) [veh]: due to depart from i for j, but not inserted yet. Books those that SUMO has given up."""
        waiting, pending = self.held(), self._session.pending()
        for vehicle in pending:
            known = self._load(vehicle)
            waiting[known.origin, known.destination] += 1
        ahead = {vehicle for vehicle, known in self._vehicles.items() if known.region is None}.difference(pending)
        for vehicle in ahead.difference(self._session.known()) if ahead else ():
            self._leave(vehicle)
        return waiting

    def held(self) -> PerPair:
        """(R, R) [veh]: those of the backlog who are made to wait."""
        return np.zeros(self._running.shape) if self._metering is None else self._metering.backlog()

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
                origin=origin,
                destination=region_of.get(route[-1], 0),
                edge=route[-1],
                announced=origin,
                free=self._session.is_free(vehicle),
            )
        return self._vehicles[vehicle]

    def _depart(self, vehicle: str) -> _Vehicle:
        """Where it is seen first, which its route need not begin with, bound for where it leads by now."""
        known = self._load(vehicle)
        with suppress(*REFUSALS):  # gone already
            self._follow(vehicle, known)
            known.origin = self._city.region_of.get(self._session.road(vehicle), known.origin)
        known.region = known.announced = known.origin
        self._running[known.origin, known.destination] += 1
        self.departures[known.origin, known.destination] += 1
        self.probe_departures[known.origin, known.destination] += vehicle in self._probes
        return known

    def _under_way(self, vehicle: str) -> _Vehicle:
        """One that is on the road, even if SUMO did not say that it departed: put there by another program."""
        known = self._vehicles.get(vehicle)
        return self._depart(vehicle) if known is None or known.region is None else known

    def _follow(self, vehicle: str, known: _Vehicle) -> None:
        """Whoever has changed its route: to where does it lead?"""
        edge = self._session.route(vehicle)[-1]
        if edge == known.edge:
            return
        before, known.edge, known.destination = known.destination, edge, self._city.region_of.get(edge, 0)
        if known.region is not None and known.destination != before:
            self.redirected[known.region, before, known.destination] += 1
            self._running[known.region, before] -= 1
            self._running[known.region, known.destination] += 1

    def _leave(self, vehicle: str, guess: End | None = None) -> None:
        """It is not there any more; what became of it is booked when SUMO tells."""
        self._teleporting.discard(vehicle)
        known = self._vehicles.pop(vehicle)
        if known.region is None:  # given up before it departed
            self.given_up[known.origin, known.destination] += 1
            return
        self._running[known.region, known.destination] -= 1
        gone = _Gone(known, known.region, guess)
        self._gone.setdefault(vehicle, []).append(gone)
        if guess is not None:
            self._book(gone, guess)

    def _enter(self, vehicle: str, edge: str, region: int) -> Event | None:
        known = self._under_way(vehicle)
        if vehicle in self._teleporting or known.region == known.announced == region:
            return None
        source = known.announced if known.region == region else known.here
        self._follow(vehicle, known)
        self._cross(known, region)
        known.announced = region
        self.entry_flow[source, edge] += 1
        return Event(
            vehicle=vehicle,
            source=source,
            region=region,
            destination=known.destination,
            edge=known.edge,
            free=known.free,
        )

    def _cross(self, known: _Vehicle, region: int) -> None:
        if region != known.region:
            joined = (known.region, region) in self._joined
            (self.crossings if joined else self.jumps)[known.region, region, known.destination] += 1
            self._running[known.region, known.destination] -= 1
            self._running[region, known.destination] += 1
            known.region = region
