"""Samples of the streets every few seconds, and means over an interval."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Real

from cosim.sumo.arrays import EdgeMask, PerEdge, PerGateway, PerInside
from cosim.sumo.net import City
from cosim.sumo.session import Session
from nmfd.arrays import PerRegion

SAMPLE_PERIOD_S = 10.0
STANDING_M_S = 0.1  # lowest speed of a travel time


@dataclass(frozen=True, kw_only=True)
class StreetMeans:
    """Means over the samples of one control interval.

    duration: [s], of the interval; vehicles: (E,) [veh]
    speed: (E,) [m/s], that routing goes by (`Session.speeds`); NaN without vehicles, 0 on closed
        streets
    timed: (E,) [veh], those whose mean is `speed`: all vehicles, or probes, which leave `crossing`
        and `crossed` at 0
    accumulation: (R,) [veh]; production: (R,) [veh m/s]
    queue, queue_max: (G,) [veh] halting on the edge before a gateway, mean and largest
    crossing: (I,) [veh] on the internal edges of `City.inside`; crossed: (I,) [veh/s] that passed
        them; both 0 if turns are not sampled
    """

    duration: float
    vehicles: PerEdge
    speed: PerEdge
    timed: PerEdge
    accumulation: PerRegion
    production: PerRegion
    queue: PerGateway
    queue_max: Real[np.ndarray, " G"]
    crossing: PerInside
    crossed: PerInside


class StreetSampler:
    """Sums over the samples of one control interval.

    probes: vehicles that travel times come from; all if None
    last: vehicles (E,) and their mean speed (E,) [m/s] in the last sample
    longest_queue: (E,) [veh] halting, the most in all samples so far
    """

    def __init__(
        self,
        session: Session,
        city: City,
        probes: frozenset[str] | None = None,
        *,
        turns: bool = True,
    ):
        """turns: vehicles on junctions are sampled, too"""
        self._session = session
        self._city = city
        self._probes = probes
        self._turns = turns
        self._inside = {edge: n for n, edge in enumerate(city.inside)}
        # Gateways may share the edge before them.
        self._upstream = sorted({gateway.from_edge for gateway in city.gateways})
        place = {edge: n for n, edge in enumerate(self._upstream)}
        self._upstream_of = np.array([place[g.from_edge] for g in city.gateways], dtype=int)
        self.last = np.zeros(len(city.edges)), np.zeros(len(city.edges))
        self.longest_queue = np.zeros(len(city.edges))
        self._begin()

    def _begin(self) -> None:
        """Begin the sums over the samples of a control interval."""
        edges = len(self._city.edges)
        self._start = self._session.time
        self._vehicles = np.zeros(edges)
        self._metres = np.zeros(edges)  # vehicles times their speed
        self._timed = np.zeros(edges)
        self._routed = np.zeros(edges)  # timed vehicles times their routing speed
        self._crossing = np.zeros(len(self._inside))
        self._crossed = np.zeros(len(self._inside))
        self._queues: list[list[int]] = []

    def sample(self) -> None:
        """Add a sample."""
        streets, crossed = self._travelled()
        session = self._session
        edges = self._city.edges
        counts, speeds, routing = np.zeros((3, len(edges)))
        counts[streets] = [session.vehicle_count(edges[n]) for n in streets]
        used = np.flatnonzero(counts).tolist()
        if used:
            means = [session.speeds(edges[n]) for n in used]
            speeds[used], routing[used] = zip(*means, strict=True)
        self.last = counts, speeds
        for n in np.flatnonzero(counts > self.longest_queue):  # only these can have a longer queue
            self.longest_queue[n] = max(self.longest_queue[n], session.halting(edges[n]))
        self._vehicles = self._vehicles + counts
        self._metres = self._metres + counts * speeds
        if self._probes is None:
            self._timed = self._timed + counts
            self._routed = self._routed + counts * routing
            if self._turns:
                self._sample_turns(crossed)
        else:
            self._sample_probes(self._probes)
        self._queues.append([session.halting(edge) for edge in self._upstream])

    def _sample_turns(self, crossed: Iterable[str]) -> None:
        """Add the vehicles on internal edges. crossed: those that may hold some"""
        session = self._session
        for edge in crossed:
            count = session.vehicle_count(edge)
            if count:
                n = self._inside[edge]
                (speed, _) = session.speeds(edge)
                self._crossing[n] += count
                self._crossed[n] += count * speed / self._city.inside[edge]

    def _sample_probes(self, probes: frozenset[str]) -> None:
        """Add the probes on streets; on junctions there are too few."""
        session = self._session
        for vehicle in session.running():
            if vehicle not in probes:
                continue
            n = self._city.number.get(session.road(vehicle))
            if n is not None:
                self._timed[n] += 1.0
                # A speed of 0 is for closed streets.
                self._routed[n] += max(session.vehicle_speed(vehicle), STANDING_M_S)

    def finish(self, closed: EdgeMask) -> StreetMeans:
        """Return the means since the last call.

        closed: (E,) bool, streets without traffic
        """
        samples = len(self._queues)
        city = self._city
        queues = np.array(self._queues).reshape(samples, len(self._upstream))[:, self._upstream_of]
        with np.errstate(invalid="ignore"):
            speed = self._routed / self._timed
        speed[closed] = 0.0  # so that guidance does not take an empty street for a free one
        accumulation = np.bincount(city.edge_region, self._vehicles, city.regions)
        production = np.bincount(city.edge_region, self._metres, city.regions)
        means = StreetMeans(
            duration=self._session.time - self._start,
            vehicles=self._vehicles / samples,
            speed=speed,
            timed=self._timed / samples,
            accumulation=accumulation / samples,
            production=production / samples,
            queue=queues.mean(axis=0),
            queue_max=queues.max(axis=0),
            crossing=self._crossing / samples,
            crossed=self._crossed / samples,
        )
        self._begin()
        return means

    def _travelled(self) -> tuple[list[int], list[str]]:
        """Return edges (numbers) and internal edges that hold all vehicles.

        A large city has more edges than vehicles, so most of its edges are empty.
        """
        if 2 * self._session.running_count() > len(self._city.edges):
            return list(range(len(self._city.edges))), list(self._inside)
        roads = set(map(self._session.road, self._session.running()))  # some may be closed to cars
        streets = [self._city.number[road] for road in roads & self._city.number.keys()]
        return streets, sorted(roads & self._inside.keys())
