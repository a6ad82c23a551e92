"""No-control runs of the imported city by SUMO's own program: densities of its streets, and who crossed what."""

import re
import subprocess
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import sumo
from jaxtyping import Float

from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeMask, EdgeNumbers, PerEdge
from cosim.sumo.xml_files import attribute, child, file_list, read_xml
from nmfd.arrays import PerRegion, PerTurn
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder

INTERVAL = 300.0  # s, of the densities
STEP = re.compile(r"Step #([\d.]+)")
PEAK = 3  # such intervals, one after the other: those with the most vehicles count for the partition


class Tell(Protocol):
    """Is called with what is going on, and the share of it [-] that is done."""

    def __call__(self, stage: str, share: float = 0.0) -> None: ...


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """What a no-control run showed.

    presence: (K, E) [veh s] on every edge during intervals of INTERVAL; production: (K, E) [veh m] driven there
    ways: the edges that vehicles drove to the end, one after the other, and the last edge of their route, alike ones
        together -> how many
    teleports; waiting: vehicles not inserted at the end; running: on the road at the end
    delay: of departures, all vehicles [veh s]
    dropped: vehicles of the demand that SUMO gave up without a word
    """

    presence: Float[np.ndarray, "K E"]
    production: Float[np.ndarray, "K E"]
    ways: Mapping[tuple[tuple[int, ...], int], int]
    teleports: int
    waiting: int
    running: int
    delay: float = 0.0
    dropped: int = 0

    def pace(self, streets: Streets) -> float:
        """Time that vehicles spent, running and waiting to enter, over what it takes at the speed limits [-]."""
        free = streets.length / streets.speed
        needed = sum(vehicles * free[list(way)].sum() for (way, _), vehicles in self.ways.items())
        return float(self.presence.sum() + self.delay) / max(float(needed), 1.0)

    def density(self, streets: Streets) -> PerEdge:
        """(E,) [veh/m of lane] in the quarter of an hour with the most vehicles; 0 on edges without car lanes."""
        mean = self.peak().mean(axis=0) / INTERVAL
        return np.where(streets.lane_metres > 0, mean / np.maximum(streets.lane_metres, 1.0), 0.0)

    def peak(self) -> Float[np.ndarray, "K E"]:
        """(up to PEAK, E): `presence` in the quarter of an hour with the most vehicles."""
        return self.presence[busiest(self.presence)]

    def concentration(self, edges: EdgeMask) -> tuple[int, int]:
        """(the fewest of some edges that hold half of all vehicles on these, how many edges) when there are most."""
        return len(self._crowded(edges)), int(edges.sum())

    def pace_of_crowded(self, streets: Streets, edges: EdgeMask) -> float:
        """Time that vehicles spend on these fewest edges over what it takes at the speed limits [-], when there are
        most: whether they stand there, or only many pass."""
        crowded, when = self._crowded(edges), busiest(self.presence[:, edges])
        driven = self.production[when][:, crowded].sum(axis=0)
        return float(self.presence[when][:, crowded].sum() / max((driven / streets.speed[crowded]).sum(), 1.0))

    def _crowded(self, edges: EdgeMask) -> np.ndarray:
        held = np.where(edges, self.presence[busiest(self.presence[:, edges])].sum(axis=0), 0.0)
        return np.argsort(-held, kind="stable")[: holding_half(held)]

    def moves(self) -> Counter[tuple[int, int]]:
        """(edge, next edge) -> vehicles that went from one to the other."""
        found: Counter[tuple[int, int]] = Counter()
        for (way, _), count in self.ways.items():
            for pair in zip(way, way[1:], strict=False):
                found[pair] += count
        return found

    def crossings(self, regions: EdgeNumbers) -> PerTurn:
        """(R, R, R) [veh], [i, h, j]: from region i to h on the way to j."""
        count = int(regions.max()) + 1
        found = np.zeros((count,) * 3)
        for (way, last), vehicles in self.ways.items():
            seen = regions[list(way)]
            for n in np.flatnonzero(np.diff(seen)):
                found[seen[n], seen[n + 1], regions[last]] += vehicles
        return found

    def metres_per_visit(self, streets: Streets, regions: EdgeNumbers) -> PerRegion:
        """(R,) [m] that a vehicle drives in a region from entry or departure to exit or arrival; NaN if none did."""
        count = int(regions.max()) + 1
        metres, visits = np.zeros(count), np.zeros(count)
        for (way, _), vehicles in self.ways.items():
            if way:
                seen = regions[list(way)]
                np.add.at(metres, seen, vehicles * streets.length[list(way)])
                np.add.at(visits, seen[np.flatnonzero(np.diff(seen, prepend=-1))], vehicles)
        return np.where(visits > 0, metres / np.maximum(visits, 1.0), np.nan)


def busiest(presence: Float[np.ndarray, "K E"]) -> slice:
    """Those PEAK intervals, one after the other, in which the edges hold most."""
    total = presence.sum(axis=1)
    first = int(np.argmax(np.convolve(total, np.ones(min(PEAK, len(total))), mode="valid")))
    return slice(first, first + PEAK)


def holding_half(held: Float[np.ndarray, " E"]) -> int:
    """The fewest edges that hold half of what all hold; 0 if they hold nothing."""
    return int(np.searchsorted(np.cumsum(np.sort(held)[::-1]), held.sum() / 2) + 1) if held.sum() > 0 else 0


def run_baseline(
    streets: Streets,
    *,
    routes: Sequence[Path],
    additional: Sequence[Path],
    begin: float,
    end: float,
    vehicles: Collection[str] = (),
    options: Sequence[str] = (),
    seed: int = 0,
    look: Callable[[Path], None] = lambda edges: None,
    reached: Callable[[float], None] = lambda time: None,
) -> Baseline:
    """Simulate without control; vehicles: ids of the demand; look: is called with SUMO's edgeData, which goes then;
    reached: now and then with SUMO's time [s]. Raises InputError with SUMO's own words if it refuses."""
    # A vehicle that a rerouter gives another route makes SUMO fail when it writes the times of the edges it has left.
    rerouted = any(next(read_xml(path).iter("routeProbReroute"), None) is not None for path in additional)
    with temporary_folder() as folder:
        edges = folder / "edges.xml"
        (folder / "measure.add.xml").write_text(
            f'<additional><edgeData id="all" freq="{INTERVAL:g}" file="{edges}" excludeEmpty="true"/></additional>',
            encoding="utf-8",
        )
        run_sumo(
            "sumo",
            "--net-file",
            file_list([streets.path]),
            "--route-files",
            file_list(routes),
            "--additional-files",
            file_list([*additional, folder / "measure.add.xml"]),
            "--begin",
            str(begin),
            "--end",
            str(end),
            "--seed",
            str(seed),
            "--step-log.period",
            "10",
            "--no-warnings",
            "true",
            "--ignore-route-errors",
            "true",
            "--vehroute-output",
            str(folder / "ways.xml"),
            "--vehroute-output.exit-times",
            str(not rerouted).lower(),
            "--vehroute-output.last-route",
            "true",
            "--vehroute-output.write-unfinished",
            "true",
            "--statistic-output",
            str(folder / "statistic.xml"),
            "--duration-log.statistics",
            "true",
            *options,
            where=str(streets.path),
            reached=reached,
        )
        statistic = ElementTree.parse(folder / "statistic.xml").getroot()
        counts, trips = child(statistic, "vehicles"), child(statistic, "vehicleTripStatistics")
        waiting = int(attribute(counts, "waiting"))
        ways, driven = _ways(folder / "ways.xml", streets)
        look(edges)
        presence, production = _measured(edges, streets, begin, end)
        return Baseline(
            presence=presence,
            production=production,
            ways=ways,
            teleports=int(attribute(child(statistic, "teleports"), "total")),
            waiting=waiting,
            running=int(attribute(counts, "running")),
            dropped=max(len(set(vehicles) - driven) - waiting, 0),
            delay=float(attribute(trips, "totalDepartDelay"))
            + waiting * max(float(attribute(trips, "departDelayWaiting")), 0.0),
        )


def run_sumo(program: str, *arguments: str, where: str, reached: Callable[[float], None] = lambda time: None) -> None:
    """Run one of SUMO's programs. reached: is called with the times of its step log [s], if it writes one. Raises
    InputError with the first line of its complaint."""
    said = []
    with subprocess.Popen(
        [str(Path(sumo.SUMO_HOME) / "bin" / program), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout is not None  # it is a pipe
        try:
            for line in process.stdout:  # universal newlines: the step log ends its lines with \r
                if step := STEP.match(line):
                    reached(float(step[1]))
                else:
                    said.append(line)
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        lines = [line for line in said if "rror" in line] or ["no reason given"]
        raise InputError(f"{where}: {program} cannot run it: {' '.join(lines[0].split())}; correct the input")


def averaged(runs: Sequence[Baseline]) -> Baseline:
    """The first run, with the presence and the production of all on average."""
    return replace(
        runs[0],
        presence=np.mean([run.presence for run in runs], axis=0),
        production=np.mean([run.production for run in runs], axis=0),
    )


def _measured(path: Path, streets: Streets, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """(Baseline.presence, Baseline.production)"""
    presence = np.zeros((max(1, int(np.ceil((end - begin) / INTERVAL))), len(streets.edges)))
    production = np.zeros_like(presence)
    for _, element in ElementTree.iterparse(path):
        if element.tag == "interval":
            k = int((float(attribute(element, "begin")) - begin) / INTERVAL + 0.5)
            for edge in element:
                if (n := streets.number.get(attribute(edge, "id"))) is not None and k < len(presence):
                    spent = float(attribute(edge, "sampledSeconds"))
                    presence[k, n] += spent
                    production[k, n] += spent * float(edge.get("speed", 0.0))
            element.clear()
    return presence, production


def _ways(path: Path, streets: Streets) -> tuple[Counter[tuple[tuple[int, ...], int]], set[str]]:
    """(Baseline.ways, the vehicles that drove)"""
    ways: Counter[tuple[tuple[int, ...], int]] = Counter()
    driven_by = set()
    for _, element in ElementTree.iterparse(path):
        if element.tag == "vehicle":
            driven_by.add(attribute(element, "id"))
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
    return ways, driven_by
