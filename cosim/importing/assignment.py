"""Routes of a generated demand, assigned by SUMO's duaIterate.py.

All drivers start on a fastest route at free flow. Then, repeatedly, the city is simulated, and
drivers choose among the routes that were fastest so far by Gawron's probabilities (1998). The
mesoscopic model, a tenth of the cost, finds most of the equilibrium; a city in car-following gets
more iterations in that model, as queues differ.
"""

import gzip
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.importing.case import Progress
from cosim.sumo.programs import run_sumo, run_tool
from cosim.sumo.xml_files import attribute, child, file_list, read_xml
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder

ITERATIONS = 20  # mesoscopic simulations, at most
GAP = 0.05  # relative gap at which the assignment ends
CAR_FOLLOWING_SHARE = 0.5  # of the iterations, in the car-following model after the mesoscopic ones
GAP_SAMPLE = 2000  # drivers from whom the gap is estimated, at most
NAME = "peak"  # of the files that duaIterate.py makes
ALWAYS = ["--aggregation", "300", "--routing-algorithm", "CH"]
ALWAYS += ["--disable-warnings", "--disable-summary", "--continue-on-unbuild"]
MESOSCOPIC = ["--mesosim", "--meso-junctioncontrol"]


class _Model(NamedTuple):
    """Model of SUMO in which routes are assigned.

    iterations: at most
    """

    label: str
    iterations: int
    options: Sequence[str]


@dataclass(frozen=True, kw_only=True)
class Assigned:
    """Routes with the smallest gap in the model in which the city is driven.

    routes: vehicle -> edges; gaps: [-] of every iteration; best: the iteration they are from
    """

    routes: Mapping[str, Sequence[str]]
    gaps: Sequence[float]
    best: int


def assign(
    net: Path,
    elements: Sequence[ElementTree.Element],
    *,
    begin: float,
    end: float,
    seed: int,
    iterations: int = ITERATIONS,
    mesoscopic: bool = True,
    time_to_teleport: float = 300.0,
    additional: Sequence[Path] = (),
    progress: Progress = lambda stage, share=0.0: None,
) -> Assigned:
    """Assign routes to vehicles that have routes at free flow.

    The same seed gives the same routes.
    net: an absolute path; elements: the vehicle types, and the vehicles by departure
    iterations: at most, one or more; mesoscopic: the city is driven in the mesoscopic model
    Raises: InputError with SUMO's own words if it refuses
    """
    with temporary_folder() as folder:
        root = ElementTree.Element("routes")
        root.extend(elements)
        (folder / "000").mkdir()
        for kind in ("rou", "rou.alt"):  # as if step 0 had found them
            with gzip.open(_routes(folder, 0, kind), "wb") as stream:
                stream.write(ElementTree.tostring(root))
        options = ["--net-file", file_list([net]), "--begin", f"{begin:g}", "--end", f"{end:g}"]
        options += [f"--time-to-teleport={time_to_teleport:g}"]
        if additional:
            options += ["--additional", file_list(additional)]
        options += ["duarouter--seed", str(seed), "sumo--seed", str(seed)]
        models = [_Model("assignment", iterations, [*MESOSCOPIC, *options])]
        if not mesoscopic:
            fewer = int(np.ceil(CAR_FOLLOWING_SHARE * iterations))
            models.append(_Model("assignment, car-following", fewer, options))
        gaps: list[float] = []
        routes: dict[str, list[str]] = {}
        best = 0
        for model in models:
            least = np.inf
            for k in range(model.iterations):
                stage = f"{model.label}, at most {model.iterations} iterations"
                if gaps:
                    stage += f", gap {100 * gaps[-1]:.0f} %"
                progress(stage, k / model.iterations)
                n = len(gaps)
                _iterate(folder, n, model.options, where=str(net))
                gap = _relative_gap(folder, net, n, begin=begin, seed=seed)
                gaps.append(gap)
                if gap <= least:
                    least = gap
                    best = n
                    routes = {}
                    for vehicle in read_xml(_routes(folder, n)).iter("vehicle"):
                        edges = attribute(child(vehicle, "route"), "edges").split()
                        routes[attribute(vehicle, "id")] = edges
                if gap <= GAP:
                    break
        return Assigned(routes=routes, gaps=gaps, best=best)


def _iterate(folder: Path, n: int, options: Sequence[str], *, where: str) -> None:
    """Run step n of duaIterate.py: routes, except in step 0, and a simulation."""
    start = ["--trips", f"{NAME}.xml"]
    if n == 0:
        start = ["--skip-first-routing", "--routes", str(_routes(folder, 0))]
    steps = ["--first-step", str(n), "--last-step", str(n + 1)]
    done = run_tool("assign/duaIterate.py", *start, *steps, *ALWAYS, *options, folder=folder)
    if done.returncode:
        raise InputError(
            f"{where}: duaIterate.py cannot assign routes: {_reason(folder / 'dua.log')}; correct "
            "the input"
        )


def _reason(log: Path) -> str:
    """Return the first error in a log of duaIterate.py, in one line."""
    if log.exists():
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
            if "rror" in line:
                return " ".join(line.split())
    return "no reason given"


def _relative_gap(folder: Path, net: Path, n: int, *, begin: float, seed: int) -> float:
    """Return the relative gap [-] of iteration n.

    It is what drivers could save, over their least time, estimated from a sample.
    It is estimated from a sample.
    """
    (weights,) = (folder / f"{n:03d}").glob("dump_*.xml.gz")
    root = read_xml(_routes(folder, n))
    vehicles = root.findall("vehicle")
    for k in np.random.default_rng([seed, 0x676170]).permutation(len(vehicles))[GAP_SAMPLE:]:
        root.remove(vehicles[k])
    ElementTree.ElementTree(root).write(folder / "sample.rou.xml")
    # Every driver comes with one route; duarouter adds the fastest, and writes the costs of both.
    options = {
        "net-file": file_list([net]),
        "route-files": folder / "sample.rou.xml",
        "weight-files": weights,
        "gawron.beta": "1",
        "routing-algorithm": "astar",
        "begin": f"{begin:g}",
        "output-file": folder / "fastest.rou.xml",
        "alternatives-output": folder / "ways.xml",
    }
    flags = (
        "--weights.expand",
        "--keep-all-routes",
        "--no-warnings",
        "--no-step-log",
        "--ignore-errors",
    )
    run_sumo("duarouter", options, *flags, where=str(net))
    spent = least = 0.0
    for vehicle in read_xml(folder / "ways.xml").iter("vehicle"):
        costs = [float(attribute(route, "cost")) for route in vehicle.iter("route")]
        spent += costs[0]
        least += min(costs)
    return (spent - least) / least if least else 0.0


def _routes(folder: Path, n: int, kind: str = "rou") -> Path:
    return folder / f"{n:03d}" / f"{NAME}_{n:03d}.{kind}.xml.gz"
