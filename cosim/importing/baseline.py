"""Runs of the imported city without control by SUMO's own program.

They give the densities of its streets, and the routes driven.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cosim.importing.case import Progress
from cosim.importing.comparison import ALL_TRIPS, NEVER, QUIET, Trip, read_trips
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
from cosim.sumo.xml_files import attribute, child, elements_of, file_list, read_xml
from nmfd.arrays import PerRegion, PerTurn
from nmfd.runs.files import temporary_folder

INTERVAL_S = 300.0  # of the densities
PEAK_INTERVALS = 3  # in a row: those with the most vehicles count for the partition
# SUMO's options of all runs.
SILENT = {
    **QUIET,
    "ignore-route-errors": "true",
    "duration-log.statistics": "true",
    **ALL_TRIPS,
    "vehroute-output.exit-times": "true",
    "vehroute-output.last-route": "true",
    "vehroute-output.write-unfinished": "true",
}
MEASURE = (
    f'<additional><edgeData id="all" freq="{INTERVAL_S:g}" file="edges.xml" excludeEmpty="true"/>'
    "</additional>"
)
Way = tuple[tuple[int, ...], int]  # edges that a vehicle drove to the end, last edge of its route


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Measurements of a run without control.

    presence: (K, E) [veh s] on every edge in intervals of INTERVAL_S
    ways: way -> number of vehicles
    teleports: of all vehicles
    waiting: private vehicles not inserted at the end; running: those on the road at the end
    dropped: those that SUMO gave up before they departed; removed: those taken out on their way
    slowness: trip time over free-flow time of completed trips [-], NaN without any
    trips: of all vehicles
    """

    presence: Float[np.ndarray, "K E"]
    ways: Mapping[Way, int]
    teleports: int = 0
    waiting: int = 0
    running: int = 0
    dropped: int = 0
    removed: int = 0
    slowness: float = np.nan
    trips: Mapping[str, Trip] = field(default_factory=dict)

    def density(self, streets: Streets) -> PerEdge:
        """Return the density (E,) [veh/m of lane] at the peak.

        That is the quarter of an hour with the most vehicles.
        """
        total = self.presence.sum(axis=1)
        window = np.ones(min(PEAK_INTERVALS, len(total)))
        first = int(np.argmax(np.convolve(total, window, mode="valid")))
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
        """Count the vehicles [i, h, j] from region i to h on the way to j."""
        count = np.zeros((int(regions.max()) + 1,) * 3)
        for (way, last), vehicles in self.ways.items():
            seen = regions[list(way)]
            for n in np.flatnonzero(np.diff(seen)):
                count[seen[n], seen[n + 1], regions[last]] += vehicles
        return count

    def metres_per_visit(self, streets: Streets, regions: EdgeNumbers) -> PerRegion:
        """Return the distance (R,) [m] driven in a region per visit.

        NaN stands for no visits.
        """
        count = int(regions.max()) + 1
        metres = np.zeros(count)
        visits = np.zeros(count)
        for (way, _), vehicles in self.ways.items():
            if not way:
                continue
            seen = regions[list(way)]
            np.add.at(metres, seen, vehicles * streets.length[list(way)])
            entries = np.flatnonzero(np.diff(seen, prepend=-1))
            np.add.at(visits, seen[entries], vehicles)
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
    """Run the city with seeds 0, 1, ... and average the presence.

    All else is that of seed 0.
    files: routes of the demand, background and additional -> names of files in the folder
    times: SUMO's options begin, end [s], and all others that change the traffic
    factor: multiplies the demand [-]; seed 0 departs as recorded
    Raises: InputError with SUMO's own words if it refuses
    """
    begin = float(times["begin"])
    end = float(times["end"])
    background = [folder / name for name in files["background"]]
    additional = [folder / name for name in files["additional"]]
    original = read_recorded_trips([folder / name for name in files["routes"]])
    options: dict[str, object] = dict(SILENT)
    if mesoscopic:
        options |= MESOSCOPIC
    options |= times
    # A vehicle with a new route by a rerouter makes SUMO fail when it writes the times of the edges
    # it has left.
    if any(read_xml(path).find(".//routeProbReroute") is not None for path in additional):
        options["vehroute-output.exit-times"] = "false"
    runs = []
    for seed in range(seeds):
        progress(f"simulating without control, {seed + 1} of {seeds}", seed / seeds)
        with temporary_folder() as scratch:
            vehicles = scratch / "vehicles.rou.xml"
            measure = scratch / "measure.add.xml"
            jitter = JITTER_S if seed else 0.0
            drawn = draw(original, seed=seed, factor=factor, jitter=jitter, begin=begin)
            write_recorded_trips(original, drawn, vehicles)
            measure.write_text(MEASURE, encoding="utf-8")
            options |= {
                "net-file": file_list([streets.path]),
                "route-files": file_list(run_files(vehicles, background, seed)),
                "additional-files": file_list([*additional, measure]),
                "seed": seed,
                "vehroute-output": scratch / "ways.xml",
                "statistic-output": scratch / "statistic.xml",
                "tripinfo-output": scratch / "trips.xml",
            }
            run_sumo("sumo", options, where=str(streets.path))
            names = [name for _, _, name in drawn]
            runs.append(_measured(scratch, streets, begin, end, names))
    return replace(runs[0], presence=np.mean([run.presence for run in runs], axis=0))


def _measured(
    folder: Path, streets: Streets, begin: float, end: float, vehicles: Collection[str]
) -> Baseline:
    """Read the outputs of a run with these vehicles of the demand."""
    statistic = read_xml(folder / "statistic.xml")
    totals = child(statistic, "vehicleTripStatistics")
    duration = float(attribute(totals, "duration"))
    loss = float(attribute(totals, "timeLoss"))
    slowness = duration / (duration - loss) if duration > loss else np.nan
    trips = read_trips(folder / "trips.xml", end)
    private = [trips[name] for name in vehicles if name in trips]
    waiting = running = removed = 0
    for trip in private:
        waiting += trip.depart == NEVER
        running += trip.depart < NEVER and trip.arrival == NEVER
        removed += trip.removed
    return Baseline(
        presence=_presence(folder / "edges.xml", streets, begin, end),
        ways=_ways(folder / "ways.xml", streets),
        teleports=int(attribute(child(statistic, "teleports"), "total")),
        waiting=waiting,
        running=running,
        dropped=len(vehicles) - len(private),
        removed=removed,
        slowness=slowness,
        trips=trips,
    )


def _presence(path: Path, streets: Streets, begin: float, end: float) -> np.ndarray:
    """Read Baseline.presence from SUMO's edgeData."""
    intervals = max(1, int(np.ceil((end - begin) / INTERVAL_S)))
    presence = np.zeros((intervals, len(streets.edges)))
    for element in elements_of(path, "interval"):
        k = int((float(attribute(element, "begin")) - begin) / INTERVAL_S + 0.5)
        if k < intervals:
            for edge in element:
                n = streets.number.get(attribute(edge, "id"))
                if n is not None:
                    presence[k, n] += float(attribute(edge, "sampledSeconds"))
    return presence


def _ways(path: Path, streets: Streets) -> Counter[Way]:
    """Read Baseline.ways from SUMO's vehroute output."""
    ways: Counter[Way] = Counter()
    for element in elements_of(path, "vehicle"):
        route = element.find("route")
        if route is None or not route.get("edges"):
            continue
        edges = [streets.number.get(edge, -1) for edge in attribute(route, "edges").split()]
        left = [float(time) >= 0 for time in route.get("exitTimes", "").split()]
        if not left:
            left = [element.get("arrival") is not None] * len(edges)
        driven = tuple(n for n, gone in zip(edges, left, strict=False) if gone and n >= 0)
        if edges[-1] >= 0:
            ways[driven, edges[-1]] += 1
    return ways
