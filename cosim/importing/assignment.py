"""Routes of a generated demand: an iterated assignment by SUMO's duaIterate.py.

Everybody starts on a fastest way at free flow. Then, again and again, the city is simulated, every driver is offered
the way that would have been fastest in it, and chooses among the ways known to them by Gawron's probabilities ("An
iterative algorithm to determine the dynamic user equilibrium in a traffic simulation model", 1998): towards a
stochastic user equilibrium of what SUMO simulates, queues and signals included. SUMO's mesoscopic model, a tenth of
the cost, finds most of it; but its queues are not those of the car-following model (measured on the streets of Bologna:
routes with a gap of 18 % in the one had 36 % in the other). Where a city is driven in the latter, some more iterations
follow in it.

How far from it the routes are is told by the relative gap: the time that drivers would have saved on the ways that were
fastest at their departures, over the time of these ways; every way at the times measured in the same simulation.
"""

import gzip
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import sumo

from cosim.importing.baseline import Tell, run_sumo
from cosim.sumo.xml_files import attribute, child, file_list, read_xml
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder

PERIOD = 300  # s, over which the times of the streets are averaged
ASKED = 2000  # drivers from whom the gap is estimated, at most
NAME = "peak"  # of the files that duaIterate.py makes
CAR_FOLLOWING = 0.5  # times the iterations that are allowed in the mesoscopic model


@dataclass(frozen=True, kw_only=True)
class Effort:
    """iterations: mesoscopic simulations, at most; 0 leaves everybody on their way at free flow
    gap: the relative gap [-] at which they end earlier
    """

    iterations: int = 20
    gap: float = 0.05

    @property
    def car_following(self) -> int:
        """Simulations in the car-following model, at most."""
        return int(np.ceil(CAR_FOLLOWING * self.iterations))


@dataclass(frozen=True, kw_only=True)
class Iteration:
    """What one simulation showed of the routes driven in it. gap [-]; trip_time: mean [s] of those who arrived."""

    mesoscopic: bool
    gap: float
    trip_time: float
    arrived: int


@dataclass(frozen=True, kw_only=True)
class Assigned:
    """routes: vehicle -> the edges of its route, those of the iteration with the smallest gap, `best`, in the model in
    which the city is driven."""

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
    net: Path,
    elements: Sequence[ElementTree.Element],
    *,
    begin: float,
    end: float,
    seed: int,
    effort: Effort,
    mesoscopic: bool = True,
    options: Sequence[str] = (),
    additional: Sequence[Path] = (),
    tell: Tell = lambda stage, share=0.0: None,
) -> Assigned:
    """Find routes for vehicles that have some already.

    net: an absolute path; elements: the `vehicle`s by departure, and the types before them; effort: at least one
    iteration; mesoscopic: in this model only; options: names and values of duaIterate.py's own.
    Raises InputError with SUMO's own words if it refuses. The same seed gives the same routes.
    """
    with temporary_folder() as folder:
        root = ElementTree.Element("routes")
        root.extend(elements)
        _step(folder, 0).mkdir()
        for kind in ("rou", "rou.alt"):  # as if step 0 had found them
            with gzip.open(_routes(folder, 0, kind), "wb") as stream:
                stream.write(ElementTree.tostring(root))
        found: list[Iteration] = []
        best, chosen = dict[str, list[str]](), 0
        for model, most in [(True, effort.iterations), *([] if mesoscopic else [(False, effort.car_following)])]:
            gaps: list[float] = []
            for n in range(len(found), len(found) + most):
                tell(
                    f"assignment{'' if model else ', car-following'}, at most {most} iterations"
                    + (f", gap {100 * found[-1].gap:.0f} %" if found else ""),
                    len(gaps) / most,
                )
                _iterate(
                    folder,
                    n,
                    [
                        "--net-file",
                        file_list([net]),
                        "--begin",
                        f"{begin:g}",
                        "--end",
                        f"{end:g}",
                        *options,
                        *(["--mesosim", "--meso-junctioncontrol"] if model else []),
                        *(["--additional", file_list(additional)] if additional else []),
                        "duarouter--seed",
                        str(seed),
                        "sumo--seed",
                        str(seed),
                    ],
                    where=str(net),
                )
                found.append(_judged(folder, net, n, begin=begin, seed=seed, mesoscopic=model))
                gaps.append(found[-1].gap)
                if gaps[-1] <= min(gaps):
                    best, chosen = _read_routes(_routes(folder, n)), n
                if gaps[-1] <= effort.gap:
                    break
        return Assigned(routes=best, iterations=tuple(found), best=chosen, effort=effort)


def _iterate(folder: Path, n: int, options: Sequence[str], *, where: str) -> None:
    """Let duaIterate.py do its step n: routes (but in step 0) and a simulation."""
    start = ["--skip-first-routing", "--routes", str(_routes(folder, 0))] if n == 0 else ["--trips", f"{NAME}.xml"]
    failed = _run(
        folder,
        [
            *start,
            "--first-step",
            str(n),
            "--last-step",
            str(n + 1),
            "--aggregation",
            str(PERIOD),
            "--routing-algorithm",
            "CH",
            "--disable-warnings",
            "--disable-summary",
            "--continue-on-unbuild",
            *options,
        ],
    )
    if failed or not _tripinfo(folder, n).exists():
        log = folder / "dua.log"
        said = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.exists() else []
        reason = " ".join(next((line for line in said if "rror" in line), "no reason given").split())
        raise InputError(
            f"{where}: duaIterate.py cannot assign routes: {reason}; correct the input, or add --iterations 0"
        )


def _run(folder: Path, arguments: Sequence[str]) -> int:
    """Run duaIterate.py; the programs that it started end with it, however this ends."""
    program = Path(sumo.SUMO_HOME) / "tools" / "assign" / "duaIterate.py"
    with (
        (folder / "console.log").open("ab") as log,
        subprocess.Popen(
            [sys.executable, str(program), *arguments],
            cwd=folder,
            stdout=log,
            stderr=log,
            stdin=subprocess.DEVNULL,
            env=os.environ | {"SUMO_HOME": sumo.SUMO_HOME, "PYTHONHASHSEED": "0"},
        ) as process,
    ):
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


def relative_gap(
    net: Path, elements: Sequence[ElementTree.Element], weights: Path, *, begin: float, seed: int
) -> float:
    """[-], of at most ASKED of the drivers among `elements`, at the times of the edges in `weights`, an edgeData file.

    (sum of the times on their routes - sum of those on the ways that are fastest then) / the latter sum. Both are
    duarouter's, for their departures. elements: as in `assign`."""
    with temporary_folder() as folder:
        vehicles = [n for n, element in enumerate(elements) if element.tag == "vehicle"]
        order = np.random.default_rng([seed, 0x676170]).permutation(len(vehicles))
        left_out = {vehicles[n] for n in order[ASKED:]}
        root = ElementTree.Element("routes")
        root.extend(element for n, element in enumerate(elements) if n not in left_out)
        ElementTree.ElementTree(root).write(folder / "asked.rou.xml")
        # Every driver comes with one way, their own; duarouter adds the fastest, and writes the costs of both.
        run_sumo(
            "duarouter",
            "--net-file",
            file_list([net]),
            "--route-files",
            str(folder / "asked.rou.xml"),
            "--weight-files",
            str(weights),
            "--weights.expand",
            "true",
            "--gawron.beta",
            "1",
            "--keep-all-routes",
            "true",
            "--routing-algorithm",
            "astar",
            "--begin",
            f"{begin:g}",
            "--output-file",
            str(folder / "fastest.rou.xml"),
            "--alternatives-output",
            str(folder / "ways.xml"),
            "--no-warnings",
            "true",
            "--no-step-log",
            "true",
            "--ignore-errors",
            "true",
            where=str(net),
        )
        spent = least = 0.0
        for vehicle in read_xml(folder / "ways.xml").iter("vehicle"):
            costs = [float(attribute(route, "cost")) for route in vehicle.iter("route")]
            spent, least = spent + costs[0], least + min(costs)
    return (spent - least) / least if least else 0.0


def _judged(folder: Path, net: Path, n: int, *, begin: float, seed: int, mesoscopic: bool) -> Iteration:
    """Iteration n, by what it left behind."""
    durations = [float(attribute(trip, "duration")) for trip in read_xml(_tripinfo(folder, n)).iter("tripinfo")]
    (weights,) = _step(folder, n).glob("dump_*.xml.gz")
    return Iteration(
        mesoscopic=mesoscopic,
        gap=relative_gap(net, list(read_xml(_routes(folder, n))), weights, begin=begin, seed=seed),
        trip_time=float(np.mean(durations)) if durations else np.nan,
        arrived=len(durations),
    )


def _read_routes(path: Path) -> dict[str, list[str]]:
    return {
        attribute(vehicle, "id"): attribute(child(vehicle, "route"), "edges").split()
        for vehicle in read_xml(path).iter("vehicle")
    }


def _step(folder: Path, n: int) -> Path:
    return folder / f"{n:03d}"


def _routes(folder: Path, n: int, kind: str = "rou") -> Path:
    return _step(folder, n) / f"{NAME}_{n:03d}.{kind}.xml.gz"


def _tripinfo(folder: Path, n: int) -> Path:
    return _step(folder, n) / f"tripinfo_{n:03d}.xml"
