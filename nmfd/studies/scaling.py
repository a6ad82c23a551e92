"""Scaling: how the time of a decision and its memory grow with the number of regions.

As in Tumu et al.: fully connected networks, random MFDs around the benchmark's, random initial states, no demand, ten
control intervals. Besides: a plane family, because cities are not fully connected, and a congested load, because in
a fully connected network nearly empty of vehicles the best control is none. Policies are untrained: the time of a
decision does not depend on their weights.
"""

import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import torch

from nmfd.controllers import registry
from nmfd.controllers.dpc.policy import Architecture, DpcController, Policy
from nmfd.controllers.mpc import edge_model
from nmfd.controllers.mpc.controller import EconomicMpc
from nmfd.errors import InputError, did_you_mean
from nmfd.model.mfd import Mfd
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import files, run_folder
from nmfd.runs.tables import text_table
from nmfd.runs.workers import Failure, outcomes
from nmfd.studies import plots, plots_scaling
from nmfd.threads import one_thread
from nmfd.types import Controller, Observation, Status

BENCHMARK_MFD = Mfd(a=4.133e-11, b=-8.282e-7, c=0.0042, jam=10_000.0)
SPREAD = 0.2  # every region's speed and size is drawn from 1 +- SPREAD times the benchmark's
INTERVAL, INTERVALS = 30.0, 10  # s, and control intervals
REGIONS = {"complete": (2, 4, 8, 16, 32, 64), "hexagonal": (2, 4, 8, 16, 32, 64, 128, 256)}
LOADS = ("published", "congested")
LOCAL = "dpc-pc-local"  # dpc-pc with the option local, and as few units as do
CONTROLLERS = {  # name -> with route guidance
    "dpc-pc": False,
    "dpc-pcrg": True,
    "mpc-pc": False,
    "mpc-pcrg": True,
    LOCAL: False,
}
COLUMNS = {
    "family": str,
    "load": str,
    "regions": int,
    "controller": str,
    "status": str,
    "set_up_s": float,
    "first_decision_s": float,
    "median_decision_s": float,
    "longest_decision_s": float,
    "unsolved_decisions": int,
    "peak_memory_mib": float,
}
CAPTION = (
    "time per decision: median / longest of the decisions after the first; set-up: network, controller and policy; "
    "memory: peak of the whole process, Python and its libraries included; unsolved: decisions that were a "
    "failure or a fallback"
)


class Case(NamedTuple):
    """One controller on one network."""

    family: str
    load: str
    regions: int
    controller: str


def positions(family: str, regions: int) -> np.ndarray:
    """(R, 2): on a circle, or the points of a triangular lattice that lie nearest to one of them [lattice spacings]."""
    if family == "complete":
        angle = 2.0 * np.pi * np.arange(regions) / regions
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reach = np.arange(-int(regions**0.5) - 2, int(regions**0.5) + 3)
    column, row = (axis.ravel() for axis in np.meshgrid(reach, reach))
    points = np.stack([column + 0.5 * row, 0.75**0.5 * row], axis=1)
    around = np.round(np.arctan2(points[:, 1], points[:, 0]), 6)
    return points[np.lexsort((around, np.round((points**2).sum(axis=1), 6)))[:regions]]


def network(family: str, regions: int, seed: int = 0) -> RegionalModel:
    """A network of the family ("complete" or "hexagonal") with random MFDs."""
    random, where = np.random.default_rng([seed, regions]), positions(family, regions)
    apart = np.linalg.norm(where[:, None] - where, axis=2)
    near = apart < (np.inf if family == "complete" else 1.1)
    mfds = []
    for speed, size in random.uniform(1.0 - SPREAD, 1.0 + SPREAD, (regions, 2)):
        base = BENCHMARK_MFD
        mfds.append(Mfd(a=base.a * speed / size**2, b=base.b * speed / size, c=base.c * speed, jam=base.jam * size))
    return RegionalModel(
        name=f"{family}-{regions}",
        region_names=tuple(map(str, range(regions))),
        positions=where,
        adjacency=near & ~np.eye(regions, dtype=bool),
        mfds=tuple(mfds),
        u_min=0.1,
        u_max=0.9,
    )


def initial_state(network: RegionalModel, load: str, seed: int = 0) -> np.ndarray:
    """(R, R) [veh]: every x_ij from [0, 100), as published; or every region between empty and 20 % above its jam."""
    random = np.random.default_rng([seed, network.regions, 1])
    x = random.uniform(0.0, 100.0, (network.regions, network.regions))
    if load == "published":
        return x
    filled = random.uniform(0.0, 1.2, network.regions) * [mfd.jam for mfd in network.mfds]
    return x * (filled / x.sum(axis=1))[:, None]


def made(name: str, planning: PlanningModel) -> Controller:
    """The controller; an untrained policy is in the place of a trained one."""
    if name.startswith("mpc"):
        return EconomicMpc(planning, guidance=CONTROLLERS[name])
    torch.manual_seed(0)
    architecture = (
        Architecture(width=32, local=True) if name == LOCAL else Architecture(guidance=CONTROLLERS[name], sparse=True)
    )
    return DpcController(Policy(planning.network, architecture))


def known(name: str) -> None:
    """InputError for what is no controller at all."""
    if name not in CONTROLLERS:
        registry.check(name)


@one_thread()
def run_one(case: Case, *, memory_gib: float) -> dict:
    """The row of `case` in scaling.csv: ten control intervals on the regional model, on one thread.

    Raises MemoryError above `memory_gib`, which is set for the whole process, where the system can.
    """
    if hasattr(psutil, "RLIMIT_DATA"):  # only Linux has such a limit
        mine = psutil.Process()
        mine.rlimit(psutil.RLIMIT_DATA, (int(memory_gib * 2**30), mine.rlimit(psutil.RLIMIT_DATA)[1]))
    begin = time.perf_counter()
    city = network(case.family, case.regions)
    chosen = made(
        case.controller,
        PlanningModel(
            name=city.name,
            network=city,
            step=INTERVAL,
            steps=INTERVALS,
            forecast=np.zeros((INTERVALS, case.regions, case.regions)),
        ),
    )
    set_up = time.perf_counter() - begin
    # The model by its turns: with its dense splits a trajectory of 256 regions would take gigabytes.
    model = edge_model.build(city, np.arange(case.regions), guidance=True)
    x = initial_state(city, case.load)
    times, unsolved = [], 0
    chosen.reset()
    for k in range(INTERVALS):
        seen = Observation(step=k, time=INTERVAL * k, accumulation=x, backlog=np.zeros_like(x))
        begin = time.perf_counter()
        controls = chosen.act(seen)
        times.append(time.perf_counter() - begin)
        unsolved += controls.status != Status.OK
        splits = city.nominal_splits if controls.splits is None else controls.splits
        x = edge_model.advance(
            model,
            x.ravel(),
            np.zeros(x.size),
            controls.perimeter[tuple(model.edges.T)],
            splits[tuple(model.turns.T)],
            INTERVAL,
        )[0].reshape(x.shape)
    return {
        **case._asdict(),
        "status": "ok" if not unsolved else controls.note,
        "set_up_s": set_up,
        "first_decision_s": times[0],
        "median_decision_s": statistics.median(times[1:]),
        "longest_decision_s": max(times[1:]),
        "unsolved_decisions": unsolved,
        "peak_memory_mib": _peak_memory() / 2**20,
    }


def _peak_memory() -> int:
    """The most that this process has had at a time [bytes]."""
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset
    import resource  # noqa: TID251 (Windows, which has none, is done with)

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 2**10)


def scaling(
    controllers: Sequence[str],
    *,
    out: Path,
    family: str = "complete",
    load: str = "published",
    regions: Sequence[int] = (),
    workers: int = 1,
    memory_gib: float = 16.0,
    time_limit: float = 600.0,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[dict]:
    """Run what is not yet in `out`/scaling.csv, each case in a process of its own, and return the rows asked for.

    scaling.png is drawn of all that is there.

    regions: default those of REGIONS for the family
    memory_gib, time_limit [s]: of a case; one that needs more gets a row with that as its status

    Families, loads, regions and controllers can be added to a folder. Raises InputError, before anything is written,
    for an unknown controller, family or load, or for less than two regions.
    """
    cases = [Case(family, load, count, name) for count in regions or REGIONS.get(family, ()) for name in controllers]
    _check(controllers, family, load, regions)
    file = out / "scaling.csv"
    configuration = {
        "experiment": "scaling",
        "step_s": INTERVAL,
        "steps": INTERVALS,
        "memory_gib": memory_gib,
        "time_limit_s": time_limit,
    }
    with run_folder.manifest(out, configuration=configuration, results=file, session={"workers": workers}):
        rows = {_case(row): row for row in (files.read_rows(file, COLUMNS) if file.is_file() else [])}
        todo = [case for case in cases if case not in rows]
        work = partial(run_one, memory_gib=memory_gib)
        for done, (case, outcome) in enumerate(outcomes(work, todo, workers, fresh=True, seconds=time_limit), start=1):
            rows[case] = failed(case, outcome.reason) if isinstance(outcome, Failure) else outcome
            files.write_rows(file, COLUMNS, ordered(rows))
            if progress:
                progress(done, len(todo), f"last {case.controller}, {case.regions} regions")
        draw(out, ordered(rows))
    return ordered({case: rows[case] for case in cases})


def failed(case: Case, reason: str) -> dict:
    """The row of a case that came to nothing."""
    numbers = {name: float("nan") for name, kind in COLUMNS.items() if kind is float}
    return {**case._asdict(), "status": reason, **numbers, "unsolved_decisions": INTERVALS}


def ordered(rows: Mapping[Case, dict]) -> list[dict]:
    """The rows by family, load, controller and regions."""
    return [
        rows[case]
        for case in sorted(
            rows,
            key=lambda case: (
                list(REGIONS).index(case.family),
                LOADS.index(case.load),
                list(CONTROLLERS).index(case.controller),
                case.regions,
            ),
        )
    ]


def _case(row: Mapping) -> Case:
    return Case(*(row[name] for name in Case._fields))


def _check(controllers: Sequence[str], family: str, load: str, regions: Sequence[int]) -> None:
    for name in controllers:
        if name not in CONTROLLERS:
            raise InputError(
                f"--controllers: {name!r} is not measured{did_you_mean(name, CONTROLLERS)}; choose from "
                f"{', '.join(CONTROLLERS)}"
            )
    if family not in REGIONS:
        raise InputError(f"--family: expected one of {', '.join(REGIONS)}, got {family!r} instead")
    if load not in LOADS:
        raise InputError(f"--load: expected one of {', '.join(LOADS)}, got {load!r} instead")
    for count in regions:
        if count < 2:
            raise InputError(f"--regions: expected whole numbers from 2 up, such as 2,4,8, got {count} instead")


def draw(folder: Path, rows: Sequence[Mapping]) -> Path:
    """Time per decision and memory over the regions, one column per family and load, as scaling.png in `folder`."""
    kinds = list(dict.fromkeys((row["family"], row["load"]) for row in rows))
    drawing = plots.figure(1.2 + 4.4 * len(kinds), 6.4)
    axes = drawing.subplots(2, len(kinds), squeeze=False, sharex="col", sharey="row", height_ratios=(3, 2))
    for column, (family, load) in enumerate(kinds):
        members = [row for row in rows if (row["family"], row["load"]) == (family, load)]
        plots_scaling.decision_times(
            axes[0, column], members, interval=INTERVAL, published=(family, load) == ("complete", "published")
        )
        plots_scaling.memory(axes[1, column], members)
        axes[0, column].set_title(f"{family} networks, {load} load", fontsize="medium")
    for ax in axes[:, 1:].ravel():
        ax.set_ylabel("")
    plots.legend_below(drawing, list(axes[0]), columns=5)
    return plots.save(drawing, folder / "scaling.png")


def scaling_table(rows: Sequence[Mapping]) -> str:
    """The rows as text."""
    return text_table(
        [
            {
                "family": row["family"],
                "load": row["load"],
                "controller": row["controller"],
                "regions": row["regions"],
                "set-up [s]": f"{row['set_up_s']:.3g}",
                "first [s]": f"{row['first_decision_s']:.3g}",
                "decision [ms]": f"{1e3 * row['median_decision_s']:.3g} / {1e3 * row['longest_decision_s']:.3g}",
                "memory [MiB]": f"{row['peak_memory_mib']:.0f}",
                "unsolved": row["unsolved_decisions"],
                "status": row["status"],
            }
            for row in rows
        ],
        CAPTION,
    )
