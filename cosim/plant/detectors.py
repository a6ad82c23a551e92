"""Loop detectors on some links, some vehicles as probes, and the estimate.

Loops are SUMO's own, on every lane of an equipped link, at up to three places along it (Vigos,
Papageorgiou and Wang, "Real-time estimation of vehicle-count within signalized links",
Transportation Research C 16, 2008). The density of a lane is the mean occupancy of its loops over
the length of a vehicle. Vehicles over a boundary are counted at the gateways that lead into an
equipped link. Region and destination of probes are known at the end of every control interval, also
while they wait to enter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.plant.meter import Meter
from cosim.sumo.arrays import GatewayMask
from cosim.sumo.net import City
from cosim.sumo.session import Session
from nmfd.arrays import PerPair
from nmfd.model.instruments import Instruments, Readings
from nmfd.model.planning import PlanningModel
from nmfd.types import Controls

LAYOUT = 0x6C6F6F70  # seed of the places of the loops: a property of the city, not of a run
PROBES = 0x70726F62  # keeps the random numbers of the probes apart from others of the same seed
VEHICLE_LENGTH_M = 5.0  # SUMO's passenger car
STATIONS = 3  # largest number of loops along a lane
SPACING_M = 50.0  # lane length per loop
# Standard deviation over mean [-] of the density over the links of a region, and of the readings
# along one link, measured in a run of grid7 that locked.
SPREAD_OVER_LINKS = 1.3
SPREAD_ALONG_LINK = 1.0
READING_PERIOD_S = 3.0


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The places of the loops.

    edges: equipped links, as numbers in the city's edges
    positions: of the loops on each of their lanes [m]
    counted: (G,) bool, gateways at which vehicles are counted
    """

    edges: tuple[int, ...]
    positions: tuple[tuple[float, ...], ...]
    counted: GatewayMask


class _Loop(NamedTuple):
    """One loop.

    name: in SUMO; position: on its lane [m]; edge: number of its link
    """

    name: str
    lane: str
    position: float
    edge: int


def lay_out(city: City, share: float) -> Layout:
    """Return loops on a `share` of the links of every region.

    A larger share contains a smaller one.
    """
    random = np.random.default_rng(LAYOUT)
    # Place of the loop within the part of the link that it stands for, as a share.
    place = random.uniform(0.02, 0.98, len(city.edges))
    edges = []
    for region in range(city.regions):
        own = np.flatnonzero(city.edge_region == region)
        count = int(np.ceil(share * len(own) - 1e-9))
        edges += [int(n) for n in random.permutation(own)[:count]]
    edges.sort()
    names = {city.edges[n] for n in edges}
    return Layout(
        edges=tuple(edges),
        positions=tuple(_stations(city.length[city.edges[n]], place[n]) for n in edges),
        counted=np.array([gateway.to_edge in names for gateway in city.gateways], dtype=bool),
    )


def _stations(length: float, place: float) -> tuple[float, ...]:
    """Return the positions [m] of the loops of a lane of this length [m]."""
    count = int(min(STATIONS, max(1, length // SPACING_M)))
    return tuple(float((n + place) / count * length) for n in range(count))


def instruments(city: City, layout: Layout, probe_share: float) -> Instruments:
    """Return shares and errors that follow from the layout."""
    lane_length = city.lane_metres
    region = city.edge_region
    equipped = np.isin(np.arange(len(region)), layout.edges)
    whole = np.bincount(region, lane_length, city.regions)
    seen = np.bincount(region, lane_length * equipped, city.regions)
    squares = np.bincount(region, lane_length**2 * equipped, city.regions)
    share = seen / whole
    boundary = np.zeros((city.regions, city.regions))
    counted = np.zeros((city.regions, city.regions))
    for gateway, there in zip(city.gateways, layout.counted, strict=True):
        boundary[gateway.source, gateway.target] += 1.0
        counted[gateway.source, gateway.target] += there
    # Samples of links are weighted by lane length. Which links hold the queues lasts; how far the
    # queues reach along them changes.
    spread = SPREAD_OVER_LINKS**2 * (1.0 - share) + SPREAD_ALONG_LINK**2
    return Instruments(
        detector_share=share,
        detector_error=np.sqrt(spread * squares) / np.maximum(seen, 1e-9),
        detector_noise=SPREAD_ALONG_LINK * np.sqrt(squares) / np.maximum(seen, 1e-9),
        counted_share=counted / np.maximum(boundary, 1.0),
        counted_gateways=counted,
        probe_share=probe_share,
    )


def write_loops(city: City, layout: Layout, period: float, path: Path) -> None:
    """Write the loops as an additional file for SUMO.

    period: SUMO's aggregation period [s]; its output is discarded
    """
    rows = []
    for loop in _loops(city, layout):
        place = f'lane="{loop.lane}" pos="{loop.position:.2f}"'
        rows.append(f'  <inductionLoop id="{loop.name}" {place} period="{period:g}" file="NUL"/>\n')
    path.write_text(f"<additional>\n{''.join(rows)}</additional>\n", encoding="utf-8")


def probes(vehicles: Sequence[str], share: float, seed: int) -> frozenset[str]:
    """Return the vehicles that are probes."""
    drawn = np.random.default_rng([seed, PROBES]).random(len(vehicles)) < share
    return frozenset(vehicles[n] for n in np.flatnonzero(drawn))


class Estimation:
    """Loops and probes of one run, and the filter that they feed.

    Call `sample` every READING_PERIOD_S, and `update` at the end of every control interval.
    accumulation: (R, R) [veh], the estimate
    """

    def __init__(
        self,
        session: Session,
        city: City,
        layout: Layout,
        meter: Meter,
        known: Instruments,
        planning: PlanningModel,
    ):
        """meter: follows the probes; known: of the layout (`instruments`)

        planning: model of the filter
        """
        self._session = session
        self._meter = meter
        self._known = known
        self._layout = layout
        self._city = city
        from nmfd.model.estimation import Estimator  # torch takes two seconds

        self._filter = Estimator(planning, known)
        self.accumulation = self._filter.accumulation
        loops = _loops(city, layout)
        self._loops = [loop.name for loop in loops]
        edges = [loop.edge for loop in loops]
        stations = dict(zip(layout.edges, map(len, layout.positions), strict=True))
        # The length of lane that a loop stands for.
        self._length = np.array([city.length[city.edges[edge]] / stations[edge] for edge in edges])
        self._region = city.edge_region[edges]
        self._begin()

    def _begin(self) -> None:
        """Begin the sums of a control interval."""
        self._occupancy = np.zeros(len(self._loops))
        self._samples = 0
        self._departed = self._meter.probe_departures.copy()
        self._flow = self._meter.gateway_flow()

    def sample(self) -> None:
        occupancy = self._session.loop_occupancy
        self._occupancy += [occupancy(loop) for loop in self._loops]
        self._samples += 1

    def update(self, controls: Controls) -> None:
        """Filter the readings of the interval that ended under `controls`."""
        self.accumulation = self._filter.step(controls, self.readings())

    def backlog(self) -> PerPair:
        """Return (R, R) [veh], the trips that wait.

        These are metered trips, and probes that wait to enter, scaled up.
        """
        return self._meter.held() + self._meter.probe_backlog() / max(self._known.probe_share, 1e-9)

    def readings(self) -> Readings:
        """Return the readings since the last call."""
        known = self._known
        regions = self._city.regions
        meter = self._meter
        density = self._occupancy / max(self._samples, 1) / 100.0 / VEHICLE_LENGTH_M
        lane_length = np.bincount(self._region, self._length, regions)
        share = known.detector_share * lane_length / np.maximum(lane_length, 1e-9)
        vehicles = np.bincount(self._region, density * self._length, regions)
        crossed = meter.gateway_flow() - self._flow
        counts = np.zeros((regions, regions))
        for n in np.flatnonzero(self._layout.counted):
            gateway = self._city.gateways[n]
            counts[gateway.source, gateway.target] += crossed[n]
        on_the_way = departed = np.full((regions, regions), np.nan)
        if known.probe_share > 0:
            on_the_way = meter.probes()
            departed = (meter.probe_departures - self._departed).astype(float)
        self._begin()
        with np.errstate(divide="ignore", invalid="ignore"):
            return Readings(
                accumulation=np.where(share > 0, vehicles / share, np.nan),
                crossings=np.where(known.counted_share > 0, counts / known.counted_share, np.nan),
                probes=on_the_way,
                probe_departures=departed,
            )


def _loops(city: City, layout: Layout) -> list[_Loop]:
    """Return all loops."""
    loops = []
    for edge, positions in zip(layout.edges, layout.positions, strict=True):
        for lane in city.lane_ids[city.edges[edge]]:
            for n, position in enumerate(positions):
                loops.append(_Loop(f"{lane}#{n}", lane, position, edge))
    return loops
