"""What a city could really measure: loop detectors on a share of the links, and a share of the drivers as probes.

Loops are SUMO's own (inductionLoop), on every lane of an equipped link and at up to three places along it: a count of
the vehicles on a link with a signal needs one near its entry, one in the middle and one near the stop line (Vigos,
Papageorgiou and Wang, "Real-time estimation of vehicle-count within signalized links", Transportation Research C 16,
2008). A single one sees a queue or none: with one on every link, regions of grid7 came out at 30 to 110 % of their
accumulation. The density of a lane is the mean occupancy of its loops over the length of a vehicle, and a region's is
that of its equipped lanes; vehicles on junctions are not seen.

Vehicles over a boundary are counted at the gateways that lead into an equipped link. Of probes, the region and the
destination are known at the end of every control interval, and, since they are known from when they wish to set out,
whether they wait to enter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.plant.meter import Meter
from cosim.sumo.arrays import GatewayMask, PerGateway
from cosim.sumo.net import City
from cosim.sumo.session import Session
from nmfd.arrays import PerPair
from nmfd.model.estimation import Instruments, Readings

LAYOUT = 0x6C6F6F70  # seed of the places of the loops: a property of the city, not of a run
PROBES = 0x70726F62  # keeps the random numbers of the probes apart from others of the same seed
VEHICLE_LENGTH = 5.0  # m, SUMO's passenger car
STATIONS, SPACING = 3, 50.0  # loops of a lane at most; m, a shorter link has one, one of twice the length two
# Standard deviation over mean [-] of the density over the links of a region, and of what the loops of one link make of
# its density: a queue here and none there, and before or behind a loop. Measured in a run of grid7 that locked: over
# the links 1.3 that lasts and 1.1 that passes; with loops on all links, regions at 76 to 144 % of the truth.
SPREAD_OVER_LINKS, SPREAD_ALONG_LINK = 1.3, 1.0
EVERY = 3.0  # s, between two readings of a loop


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where the loops are.

    edges: the equipped links, as numbers in the city's edges
    positions: of the loops on every lane of these, from the beginning of the link [m]
    counted: (G,) bool, the gateways of the city at which vehicles are counted
    """

    edges: tuple[int, ...]
    positions: tuple[tuple[float, ...], ...]
    counted: GatewayMask


def lay_out(city: City, share: float) -> Layout:
    """Loops on a `share` of the links of every region, at least one if it is positive; a larger share keeps those of a
    smaller one."""
    random, chosen = np.random.default_rng(LAYOUT), []
    place = random.uniform(0.02, 0.98, len(city.edges))  # within the part of the link that a loop stands for
    for region in range(city.regions):
        own = [n for n, edge in enumerate(city.edges) if city.region_of[edge] == region]
        chosen += list(random.permutation(own)[: int(np.ceil(share * len(own) - 1e-9))])
    edges = sorted(int(n) for n in chosen)
    names = {city.edges[n] for n in edges}
    return Layout(
        edges=tuple(edges),
        positions=tuple(_stations(city.length[city.edges[n]], place[n]) for n in edges),
        counted=np.array([gateway.to_edge in names for gateway in city.gateways], dtype=bool),
    )


def _stations(length: float, place: float) -> tuple[float, ...]:
    count = int(min(STATIONS, max(1, length // SPACING)))
    return tuple(float((n + place) / count * length) for n in range(count))


def instruments(city: City, layout: Layout, probe_share: float) -> Instruments:
    """What follows from the layout: shares, and how far the equipped links may be from the average link."""
    lane_length = np.array([city.length[edge] * city.lanes[edge] for edge in city.edges])
    region = np.array([city.region_of[edge] for edge in city.edges])
    equipped = np.isin(np.arange(len(region)), layout.edges)
    whole, seen, squares = (
        np.bincount(region, weights, city.regions)
        for weights in (lane_length, lane_length * equipped, lane_length**2 * equipped)
    )
    share = seen / whole
    boundary, counted, number = np.zeros((3, city.regions, city.regions))
    for gateway, there in zip(city.gateways, layout.counted, strict=True):
        pair = gateway.source, gateway.target
        boundary[pair] += 1.0
        counted[pair] += there
        number[pair] += there
    return Instruments(
        detector_share=share,
        # Of samples of links, weighted by lane length; a sample of all links is none. Where the queues mostly are
        # lasts, how far they reach changes with every cycle.
        detector_error=np.sqrt((SPREAD_OVER_LINKS**2 * (1.0 - share) + SPREAD_ALONG_LINK**2) * squares)
        / np.maximum(seen, 1e-9),
        detector_noise=SPREAD_ALONG_LINK * np.sqrt(squares) / np.maximum(seen, 1e-9),
        counted_share=counted / np.maximum(boundary, 1.0),
        counted_gateways=number,
        probe_share=probe_share,
    )


def write_loops(city: City, layout: Layout, period: float, path: Path) -> None:
    """The loops as an additional file for SUMO."""
    rows = [
        f'  <inductionLoop id="{loop}" lane="{lane}" pos="{position:.2f}" period="{period:g}" file="NUL"/>\n'
        for loop, lane, position, _ in _loops(city, layout)
    ]
    path.write_text(f"<additional>\n{''.join(rows)}</additional>\n", encoding="utf-8")


def probes(vehicles: Sequence[str], share: float, seed: int) -> frozenset[str]:
    """Those of the vehicles that are probes."""
    drawn = np.random.default_rng([seed, PROBES]).random(len(vehicles)) < share
    return frozenset(vehicles[n] for n in np.flatnonzero(drawn))


class Detectors:
    """The readings of one run. `sample` after every EVERY seconds; `readings` at the end of a control interval."""

    def __init__(self, session: Session, city: City, layout: Layout, meter: Meter, known: Instruments):
        """meter: follows the probes; known: what follows from the layout (`instruments`)"""
        self._session, self._meter, self._known, self._layout, self._city = session, meter, known, layout, city
        loops = _loops(city, layout)
        self._loops, edges = [name for name, *_ in loops], [edge for *_, edge in loops]
        each = dict(zip(layout.edges, map(len, layout.positions), strict=True))
        # The length of lane that a loop stands for.
        self._length = np.array([city.length[city.edges[edge]] / each[edge] for edge in edges])
        self._region = np.array([city.region_of[city.edges[edge]] for edge in edges], dtype=int)
        self._occupancy, self._samples = np.zeros(len(self._loops)), 0
        self._departed = meter.probe_departures.copy()

    def sample(self) -> None:
        """Read the loops once."""
        occupancy = self._session.loop_occupancy
        self._occupancy += [occupancy(loop) for loop in self._loops]
        self._samples += 1

    def readings(self, gateway_flow: PerGateway) -> Readings:
        """Of the time since the last one. gateway_flow: (G,) [veh] over the city's gateways since then, of which only
        the counted ones are looked at."""
        regions, share = self._city.regions, self._known.detector_share
        density = self._occupancy / max(self._samples, 1) / 100.0 / VEHICLE_LENGTH
        vehicles = np.bincount(self._region, density * self._length, regions)
        counts = np.zeros((regions, regions))
        for gateway, there, flow in zip(self._city.gateways, self._layout.counted, gateway_flow, strict=True):
            counts[gateway.source, gateway.target] += flow if there else 0.0
        departed = self._meter.probe_departures - self._departed
        self._occupancy, self._samples = np.zeros(len(self._loops)), 0
        self._departed = self._meter.probe_departures.copy()
        unknown = np.full((regions, regions), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            return Readings(
                accumulation=np.where(share > 0, vehicles / share, np.nan),
                crossings=np.where(self._known.counted_share > 0, counts / self._known.counted_share, np.nan),
                probes=self._meter.probes() if self._known.probe_share > 0 else unknown,
                probe_departures=departed.astype(float) if self._known.probe_share > 0 else unknown,
            )

    def backlog(self) -> PerPair:
        """(R, R) [veh]: the probes that wait to enter, expanded; zero without probes. Who is made to wait is known."""
        return self._meter.held() + self._meter.probe_backlog() / max(self._known.probe_share, 1e-9)


def _loops(city: City, layout: Layout) -> list[tuple[str, str, float, int]]:
    """Name, lane, position [m] and link (its number) of every loop."""
    return [
        (f"{lane}#{n}", lane, position, edge)
        for edge, positions in zip(layout.edges, layout.positions, strict=True)
        for lane in city.lane_ids[city.edges[edge]]
        for n, position in enumerate(positions)
    ]
