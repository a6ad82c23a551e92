"""Runs of the imported city without control by SUMO's own program: densities of its streets, routes
driven."""

import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cosim.importing.case import Progress
from cosim.importing.comparison import ALL_TRIPS, NEVER, Trip, read_trips
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers, PerEdge
from cosim.sumo.programs import run_sumo
from cosim.sumo.recorded_trips import (
    JITTER_S,
    MESOSCOPIC,
    draw,
    read_recorded_trips,
    run_files,
    write_recorded_trips,
)
from cosim.sumo.xml_files import attribute, child, file_list, read_xml
from nmfd.arrays import PerRegion, PerTurn
from nmfd.runs.files import temporary_folder

INTERVAL_S = 300.0  # of the densities
PEAK_INTERVALS = 3  # in a row: those with the most vehicles count for the partition
RECORDED = ("exit-times", "last-route", "write-unfinished")
SILENT = dict.fromkeys(
    ("no-step-log", "no-warnings", "ignore-route-errors", "duration-log.statistics"), "true"
)
SILENT |= ALL_TRIPS
SILENT |= {f"vehroute-output.{name}": "true" for name in RECORDED}


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Measurements of a run without control.

    presence: (K, E) [veh s] on every edge in intervals of INTERVAL_S
    ways: (edges that a vehicle drove to the end, last edge of its route) -> number of vehicles
    teleports: of all vehicles
    waiting: private vehicles not inserted at the end; running: those on the road at the end
    dropped: those that SUMO gave up before they departed; removed: those taken out on their way
    slowness: trip time over free-flow time of completed trips [-], NaN without any
    trips: of all vehicles
    """

    presence: Float[np.ndarray, "K E"]
    ways: Mapping[tuple[tuple[int, ...], int], int]
    teleports: int
    waiting: int
    running: int
    dropped: int = 0
    removed: int = 0
    slowness: float = np.nan
    trips: Mapping[str, Trip] = field(default_factory=dict)

    def density(self, streets: Streets) -> PerEdge:
        """Return the density (E,) [veh/m of lane] in the quarter of an hour with the most
        vehicles."""
        total = self.presence.sum(axis=1)
        first = int(
            np.argmax(np.convolve(total, np.ones(min(PEAK_INTERVALS, len(total))), mode="valid"))
        )
        mean = self.presence[first : first + PEAK_INTERVALS].mean(axis=0) / INTERVAL_S
        return np.where(streets.lane_metres > 0, mean / np.maximum(streets.lane_metres, 1.0), 0.0)

    def moves(self) -> Counter[tuple[int, int]]:
        """Count the vehicles that went from one edge to the next."""
        count: Counter[tuple[int, int]] = Counter()
        for (way, _), vehicles in self.ways.items():
            for pair in pairwise(way):
                count[pair] += vehicles
        return count

    def crossings(self, regions: EdgeNumbers) -> PerTurn:
        """Count the vehicles [i, h, j] that crossed from region i to h on the way to j."""
        count = np.zeros((int(regions.max()) + 1,) * 3)
        for (way, last), vehicles in self.ways.items():
            seen = regions[list(way)]
            for n in np.flatnonzero(np.diff(seen)):
                count[seen[n], seen[n + 1], regions[last]] += vehicles
        return count

    def metres_per_visit(self, streets: Streets, regions: EdgeNumbers) -> PerRegion:
        """Return the distance (R,) [m] driven in a region per visit; NaN without visits."""
        count = int(regions.max()) + 1
        metres, visits = np.zeros(count), np.zeros(count)
        for (way, _), vehicles in self.ways.items():
            if way:
                seen = regions[list(way)]
                np.add.at(metres, seen, vehicles * streets.length[list(way)])
                np.add.at(visits, seen[np.flatnonzero(np.diff(seen, prepend=-1))], vehicles)
        return np.where(visits > 0, metres / np.maximum(visits, 1.0), np.nan)


def averaged_runs(
    streets: Streets,
    folder: Path,
    files: Mapping[str, Sequence[str]],
    times: Mapping[str, str],
    factor: float,
    mesoscopic: bool,
    seeds: int,
    progress: Progress,
) -> Baseline:
    """Run the city with seeds 0, 1, ... and average the presence; all else is that of seed 0.

    files: routes of the demand, background and additional -> names of files in the folder
    times: SUMO's options begin, end [s], and all others that change the traffic
    factor: multiplies the demand [-]; seed 0 departs as recorded
    Raises: InputError with SUMO's own words if it refuses
    """
    begin, end = float(times["begin"]), float(times["end"])
    background, additional = (
        [folder / name for name in files[key]] for key in ("background", "additional")
    )
    original = read_recorded_trips([folder / name for name in files["routes"]])
    options: dict[str, object] = dict(times)
    # A vehicle with a new route by a rerouter makes SUMO fail when it writes the times of the edges
    # it has left.
    if any(next(read_xml(path).iter("routeProbReroute"), None) is not None for path in additional):
        options["vehroute-output.exit-times"] = "false"
    runs = []
    for seed in range(seeds):
        progress(f"simulating without control, {seed + 1} of {seeds}", seed / seeds)
        with temporary_folder() as scratch:
            jitter = JITTER_S if seed else 0.0
            drawn = draw(original, seed=seed, factor=factor, jitter=jitter, begin=begin)
            write_recorded_trips(original, drawn, scratch / "vehicles.rou.xml")
            route_files = run_files(scratch / "vehicles.rou.xml", background, seed)
            measure = scratch / "measure.add.xml"
            data = (
                f'<edgeData id="all" freq="{INTERVAL_S:g}" file="edges.xml" excludeEmpty="true"/>'
            )
            measure.write_text(f"<additional>{data}</additional>", encoding="utf-8")
            options |= {
                "net-file": file_list([streets.path]),
                "route-files": file_list(route_files),
                "additional-files": file_list([*additional, measure]),
                "seed": seed,
                "vehroute-output": scratch / "ways.xml",
                "statistic-output": scratch / "statistic.xml",
                "tripinfo-output": scratch / "trips.xml",
            }
            run_sumo(
                "sumo",
                SILENT | (MESOSCOPIC if mesoscopic else {}) | options,
                where=str(streets.path),
            )
            runs.append(_measured(scratch, streets, begin, end, {name for _, _, name in drawn}))
    return replace(runs[0], presence=np.mean([run.presence for run in runs], axis=0))


def _measured(
    folder: Path, streets: Streets, begin: float, end: float, vehicles: set[str]
) -> Baseline:
    """Read the outputs of a run with these vehicles of the demand."""
    statistic = ElementTree.parse(folder / "statistic.xml").getroot()
    totals = child(statistic, "vehicleTripStatistics")
    duration, loss = (float(attribute(totals, name)) for name in ("duration", "timeLoss"))
    trips = read_trips(folder / "trips.xml", end)
    private = [trips[name] for name in vehicles if name in trips]
    return Baseline(
        presence=_presence(folder / "edges.xml", streets, begin, end),
        ways=_ways(folder / "ways.xml", streets),
        teleports=int(attribute(child(statistic, "teleports"), "total")),
        waiting=sum(trip.depart == NEVER for trip in private),
        running=sum(trip.depart < NEVER and trip.arrival == NEVER for trip in private),
        dropped=len(vehicles) - len(private),
        removed=sum(trip.removed for trip in private),
        slowness=duration / (duration - loss) if duration > loss else np.nan,
        trips=trips,
    )


def _presence(path: Path, streets: Streets, begin: float, end: float) -> np.ndarray:
    """Read Baseline.presence from SUMO's edgeData."""
    presence = np.zeros((max(1, int(np.ceil((end - begin) / INTERVAL_S))), len(streets.edges)))
    for _, element in ElementTree.iterparse(path):
        if element.tag == "interval":
            k = int((float(attribute(element, "begin")) - begin) / INTERVAL_S + 0.5)
            for edge in element:
                if (n := streets.number.get(attribute(edge, "id"))) is not None and k < len(
                    presence
                ):
                    presence[k, n] += float(attribute(edge, "sampledSeconds"))
            element.clear()
    return presence


def _ways(path: Path, streets: Streets) -> Counter[tuple[tuple[int, ...], int]]:
    """Read Baseline.ways from SUMO's vehroute output."""
    ways: Counter[tuple[tuple[int, ...], int]] = Counter()
    for _, element in ElementTree.iterparse(path):
        if element.tag == "vehicle":
            route = element.find("route")
            if route is not None and (names := route.get("edges")):
                edges = [streets.number.get(edge, -1) for edge in names.split()]
                left = [float(time) >= 0 for time in route.get("exitTimes", "").split()] or (
                    [element.get("arrival") is not None] * len(edges)
                )
                driven = tuple(n for n, gone in zip(edges, left, strict=False) if gone and n >= 0)
                if edges[-1] >= 0:
                    ways[driven, edges[-1]] += 1
            element.clear()
    return ways
