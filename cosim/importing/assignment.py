"""Routes of a generated demand: an iterated assignment by SUMO's duaIterate.py, in its mesoscopic model.

Everybody starts on a fastest way at free flow. Then, again and again, the city is simulated, every driver is offered
the way that would have been fastest in it, and chooses among the ways known to them by Gawron's probabilities ("An
iterative algorithm to determine the dynamic user equilibrium in a traffic simulation model", 1998): towards a
stochastic user equilibrium of what SUMO simulates, queues and signals included.

How far from it the routes are is told by the relative gap: the time that drivers would have saved on the ways that were
fastest at their departures, over the time of these ways; every way at the times measured in the same simulation.
"""

import gzip
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import sumo

from cosim.importing.baseline import run_sumo
from cosim.sumo.xml_files import attribute, child, file_list, read_xml
from nmfd.errors import InputError
from nmfd.runs.scratch import Scratch

PERIOD = 300        # s, over which the times of the streets are averaged
ASKED = 2000        # drivers from whom the gap is estimated, at most
NAME = "peak"       # of the files that duaIterate.py makes


@dataclass(frozen=True, kw_only=True)
class Effort:
    """iterations: simulations, at most; 0 leaves everybody on their way at free flow
    gap: the relative gap [-] at which they end earlier
    """

    iterations: int = 20
    gap: float = 0.05


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """What one simulation showed of the routes driven in it. gap [-]; trip_time: mean [s] of those who arrived."""

    gap: float
    trip_time: float
    arrived: int


@dataclass(frozen=True, kw_only=True)
class Assigned:
    """routes: vehicle -> the edges of its route, those of the iteration with the smallest gap, `best`."""

    routes: Mapping[str, Sequence[str]]
    iterations: Sequence[Iteration]
    best: int
    effort: Effort

    @property
    def gap(self) -> float:
        """[-] of `routes`."""
        return self.iterations[self.best].gap

    @property
    def reached(self) -> bool:
        """Whether the gap is as small as it was asked for."""
        return self.gap <= self.effort.gap


def assign(
    net: Path, elements: Sequence[ElementTree.Element], *, begin: float, end: float, seed: int, effort: Effort,
    time_to_teleport: float = -1.0, additional: Sequence[Path] = (),
    tell: Callable[[str], None] = lambda line: None,
) -> Assigned:
    """Find routes for vehicles that have some already.

    net: an absolute path; elements: the `vehicle`s by departure, and the types before them; effort: at least one
    iteration; time_to_teleport [s]: of the simulation, -1 for never.
    Raises InputError with SUMO's own words if it refuses. The same seed gives the same routes.
    """
    with Scratch("cosim-") as folder:
        root = ElementTree.Element("routes")
        root.extend(elements)
        _step(folder, 0).mkdir()
        for kind in ("rou", "rou.alt"):  # as if step 0 had found them
            with gzip.open(_routes(folder, 0, kind), "wb") as stream:
                stream.write(ElementTree.tostring(root))
        found: list[Iteration] = []
        best: dict[str, list[str]] = {}
        for n in range(effort.iterations):
            tell(f"assignment {n + 1} of {effort.iterations}" + (f", gap {100 * found[-1].gap:.0f} %" if found else ""))
            _iterate(folder, n, [
                "--net-file", file_list([net]), "--begin", f"{begin:g}", "--end", f"{end:g}",
                f"--time-to-teleport={time_to_teleport:g}",
                *(["--additional", file_list(additional)] if additional else []),
                "duarouter--seed", str(seed), "sumo--seed", str(seed)], where=str(net))
            found.append(_judged(folder, net, n, begin=begin, seed=seed))
            if found[-1].gap <= min(iteration.gap for iteration in found):
                best, chosen = _read_routes(_routes(folder, n)), n
            if found[-1].gap <= effort.gap:
                break
        return Assigned(routes=best, iterations=tuple(found), best=chosen, effort=effort)


def _iterate(folder: Path, n: int, options: Sequence[str], *, where: str) -> None:
    """Let duaIterate.py do its step n: routes (but in step 0) and a simulation."""
    start = ["--skip-first-routing", "--routes", str(_routes(folder, 0))] if n == 0 else ["--trips", f"{NAME}.xml"]
    failed = _run(folder, [
        *start, "--first-step", str(n), "--last-step", str(n + 1), "--aggregation", str(PERIOD), "--mesosim",
        "--meso-junctioncontrol", "--routing-algorithm", "CH", "--disable-warnings", "--disable-summary",
        "--continue-on-unbuild", *options])
    if failed or not _tripinfo(folder, n).exists():
        log = folder / "dua.log"
        said = log.read_text(errors="replace").splitlines() if log.exists() else []
        reason = " ".join(next((line for line in said if "rror" in line), "no reason given").split())
        raise InputError(f"{where}: duaIterate.py cannot assign routes: {reason}; correct the input, or add "
                         "--iterations 0")


def _run(folder: Path, arguments: Sequence[str]) -> int:
    """Run duaIterate.py; the programs that it started end with it, however this ends."""
    program = Path(sumo.SUMO_HOME) / "tools" / "assign" / "duaIterate.py"
    with (folder / "console.log").open("ab") as log, subprocess.Popen(
            [sys.executable, str(program), *arguments], cwd=folder, stdout=log, stderr=log, stdin=subprocess.DEVNULL,
            env=os.environ | {"SUMO_HOME": sumo.SUMO_HOME, "PYTHONHASHSEED": "0"}) as process:
        try:
            return process.wait()
        except BaseException:
            _end(process.pid)
            raise


def _end(pid: int) -> None:
    """Kill a process and those that it started."""
    try:
        parent = psutil.Process(pid)
        family = [*parent.children(recursive=True), parent]
    except psutil.NoSuchProcess:
        return
    for process in family:
        try:
            process.kill()
        except psutil.NoSuchProcess:
            continue


def relative_gap(net: Path, routes: Path, weights: Path, *, begin: float, seed: int) -> float:
    """[-], of at most ASKED of the drivers of a route file, at the times of the edges in `weights`, an edgeData file.

    (sum of the times on their routes - sum of those on the ways that are fastest then) / the latter sum. Both are
    duarouter's, for their departures."""
    with Scratch("cosim-") as folder:
        root = read_xml(routes)
        vehicles = root.findall("vehicle")
        left_out = np.random.default_rng([seed, 0x676170]).permutation(len(vehicles))[ASKED:]
        for n in left_out:
            root.remove(vehicles[n])
        ElementTree.ElementTree(root).write(folder / "asked.rou.xml")
        # Every driver comes with one way, their own; duarouter adds the fastest, and writes the costs of both.
        run_sumo(
            "duarouter", "--net-file", file_list([net]), "--route-files", str(folder / "asked.rou.xml"),
            "--weight-files", str(weights), "--weights.expand", "true", "--gawron.beta", "1", "--keep-all-routes",
            "true", "--routing-algorithm", "astar", "--begin", f"{begin:g}",
            "--output-file", str(folder / "fastest.rou.xml"), "--alternatives-output", str(folder / "ways.xml"),
            "--no-warnings", "true", "--no-step-log", "true", "--ignore-errors", "true", where=str(net))
        spent = least = 0.0
        for vehicle in read_xml(folder / "ways.xml").iter("vehicle"):
            costs = [float(attribute(route, "cost")) for route in vehicle.iter("route")]
            spent, least = spent + costs[0], least + min(costs)
    return (spent - least) / least if least else 0.0


def _judged(folder: Path, net: Path, n: int, *, begin: float, seed: int) -> Iteration:
    """Iteration n, by what it left behind."""
    durations = [float(attribute(trip, "duration")) for trip in read_xml(_tripinfo(folder, n)).iter("tripinfo")]
    (weights,) = _step(folder, n).glob("dump_*.xml.gz")
    return Iteration(
        gap=relative_gap(net, _routes(folder, n), weights, begin=begin, seed=seed),
        trip_time=float(np.mean(durations)) if durations else np.nan, arrived=len(durations))


def _read_routes(path: Path) -> dict[str, list[str]]:
    return {attribute(vehicle, "id"): attribute(child(vehicle, "route"), "edges").split()
            for vehicle in read_xml(path).iter("vehicle")}


def _step(folder: Path, n: int) -> Path:
    return folder / f"{n:03d}"


def _routes(folder: Path, n: int, kind: str = "rou") -> Path:
    return _step(folder, n) / f"{NAME}_{n:03d}.{kind}.xml.gz"


def _tripinfo(folder: Path, n: int) -> Path:
    return _step(folder, n) / f"tripinfo_{n:03d}.xml"
