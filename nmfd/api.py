"""Functions behind the commands of `nmfd`; exported by the package `nmfd`."""

import re
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nmfd import closed_loop
from nmfd.controllers import open_loop, training
from nmfd.controllers.dpc import rollout
from nmfd.controllers.strategy import (
    CONTROLLERS,
    Strategy,
    check_tables,
    city_words,
    parse,
    parse_many,
)
from nmfd.errors import InputError, did_you_mean
from nmfd.model.scenario import Scenario, read_scenario, with_demand
from nmfd.runs import shipped
from nmfd.runs.files import default_folder, file_name, run_name
from nmfd.runs.progress import Progress, watched
from nmfd.runs.run_many import Run, locked, run_many
from nmfd.runs.run_many import raise_failures as raise_failures
from nmfd.studies import benchmark as benchmark_study
from nmfd.studies import bound as bound_study
from nmfd.studies.benchmark import (
    PLANTS,
    REFERENCE,
    SIGMAS_VEH_S,
    SPREADS,
    closed_loop_of,
    key_of,
    workers_for,
)
from nmfd.studies.benchmark import improvement_table as improvement_table
from nmfd.studies.benchmark import summary_table as summary_table
from nmfd.studies.measured import identify as identify
from nmfd.types import Controller, Plant, Result

if TYPE_CHECKING:
    import pandas as pd
    import torch
    from torch import nn

    from nmfd.controllers.dpc.rollout import Trajectories


def load_scenario(folder: Path | str, settings: Mapping[str, Any] | None = None) -> Scenario:
    """Read a scenario and its network, and check the options of its controllers.

        >>> nmfd.load_scenario("economic_mpc").network.region_names
        ('north-west', 'north-east', 'west', 'centre', 'east', 'south-west', 'south-east')

    folder: folder of a scenario.toml, or the name of one (`nmfd show`), or of a network with a
        scenario of its name
    settings: changes by dotted key, such as {"steps": 12, "controllers.pi-gating.kp": 2.0}
    Raises: InputError if a file, key or value is wrong
    """
    folder = shipped.found(folder, shipped.SCENARIO, shipped.NETWORK)
    if (folder / "network.toml").is_file() and not (folder / "scenario.toml").is_file():
        folder = folder.resolve().parent.parent / "scenarios" / folder.name
    scenario = read_scenario(folder, settings)
    check_tables(scenario)
    return scenario


def controller(
    name: str, scenario: Scenario | Path | str, *, policy: Path | str | None = None
) -> Controller:
    """Return the controller `name` for `scenario`, with `reset` and `act`.

    name: as on the command line: "pi-gating", "dpc-pcrg", ..., or "path/to/file.py:Class"
    policy: the file of a policy or plan, if not SCENARIO/NAME.pt or .npz

        >>> nmfd.controller("pi-gating", "economic_mpc").regions  # protected ones
        array([3])

    Raises: InputError for an unknown name, a wrong option, or a policy that is missing or made for
    another network
    """
    return parse(name).make(_loaded(scenario), None if policy is None else Path(policy))


def run(
    scenario: Scenario | Path | str,
    controller: str | Controller,
    *,
    seed: int = 0,
    plant: str | Plant = "nmfd",
    steps: int | None = None,
    policy: Path | str | None = None,
    progress: Progress = None,
) -> Result:
    """Run one closed loop on a regional model.

        >>> result = nmfd.run("economic_mpc", "pi-gating", steps=20)
        >>> result.accumulation.shape  # states, regions, destinations
        (21, 7, 7)
        >>> bool(result.observed[20].sum() == result.accumulation[20].sum())  # observed with noise
        False

    scenario: a name of `nmfd show`, the folder of a scenario.toml, or a Scenario
    controller: a name as on the command line, or an object with `reset` and `act` (nmfd.Controller)
    seed: of the measurement noise
    plant: "nmfd", "acyclic", or an object with `reset`, `step` and `observe` as in nmfd.Plant
    steps: control intervals; the scenario's if None
    policy: as in `nmfd.controller`
    progress: None for a bar on a terminal or in a notebook, False for none, or a function of the
        steps done and all steps

    The same seed gives the same result but for wall times (Result.without_times). Raises
    InputError.
    """
    strategy, scenario = parse(controller).regional(), with_demand(_loaded(scenario), steps=steps)
    _check_plant(plant)
    acting, name = (
        strategy.make(scenario, None if policy is None else Path(policy)),
        type(plant).__name__,
    )
    if isinstance(plant, str):
        name, plant = plant, PLANTS[plant](scenario)
    with watched(strategy.name, progress) as show:
        result = closed_loop.run(plant, acting, scenario, seed=seed, progress=show)
    return result.assign(controller=strategy.name, plant=name)


def benchmark(
    scenario: Scenario | Path | str,
    controllers: str | Sequence[str],
    *,
    seeds: int | Sequence[int] = 1,
    plant: str = "nmfd",
    out: Path | str | None = None,
    policies: Mapping[str, Path | str] | None = None,
    workers: int = 1,
    progress: Progress = None,
) -> "pd.DataFrame":
    """Run controllers x seeds with a run folder, as `nmfd benchmark`; return one row per run.

        >>> rows = nmfd.benchmark("economic_mpc", ["no-control", "dpc-pc*"], out="runs/mine")
        >>> rows.groupby("controller")["completed_veh"].mean().round(-2).to_dict()
        {'dpc-pc': 31600.0, 'dpc-pcrg': 31700.0, 'no-control': 6200.0}

    controllers: a name, several, or patterns, which stand for the controllers that can be made for
        this scenario
    seeds: how many, from 0, or which
    out: the run folder, runs/<scenario>-<time> if None; finished runs in it are kept
    policies: controller -> file, if not SCENARIO/NAME.pt
    workers: runs at a time
    progress: as in `nmfd.run`; your own is called as progress(done, runs, name)

    The column `failure` is "" of a finished run, else its reason; `lower_bound_veh_s` is that of
    the total time spent with the same controls, where `nmfd bound` has found one. Raises
    InputError.
    """
    scenario, files = (
        _loaded(scenario),
        {name: Path(file) for name, file in (policies or {}).items()},
    )
    _check_plant(plant)
    strategies = parse_many(controllers, scenario, regional=True)
    check_policies(files, strategies)
    key = key_of(scenario, strategies, plant, files)
    runs = [
        Run(
            run_name(strategy.name, seed),
            key(strategy.name),
            partial(
                closed_loop_of,
                strategy,
                seed,
                scenario=scenario,
                plant=plant,
                policy=files.get(strategy.name),
            ),
        )
        for seed in (range(seeds) if isinstance(seeds, int) else seeds)
        for strategy in strategies
    ]
    out = default_folder(scenario.name) if out is None else Path(out)
    lower = {
        strategy.name: benchmark_study.lower_bound(scenario, strategy, plant)
        for strategy in strategies
    }
    with locked(out):
        rows = run_many(runs, out, workers=workers_for(strategies, workers), progress=progress)
        rows["lower_bound_veh_s"] = rows["controller"].map(lower)
        done = rows[rows["failure"] == ""]
        names = [
            run_name(name, seed)
            for name, seed in zip(done["controller"], done["seed"], strict=True)
        ]
        if names:
            benchmark_study.draw_accumulations(
                out, scenario, [Result.read(out / f"{name}.nc") for name in names]
            )
            benchmark_study.draw_scenario(out, scenario)
    return rows


def robustness(
    scenario: Scenario | Path | str,
    controllers: str | Sequence[str],
    *,
    kind: str = "demand",
    sigmas: Sequence[float] | None = None,
    scenarios: int = 20,
    out: Path | str | None = None,
    workers: int = 1,
    progress: Progress = None,
) -> "pd.DataFrame":
    """Run controllers, and no control, in perturbed scenarios in a folder, draw the improvement;
    return the runs.

    kind: "demand", "demand-total", "mfd-scale", "mfd-axis" or "trip-lengths"
        (nmfd.model.scenario.perturbed)
    sigmas: standard deviations of the demand noise (veh/s), or of the logarithms of MFDs or trip
        lengths (-)
    scenarios: draws for every sigma
    out, workers, progress: see `benchmark`
    """
    scenario = _loaded(scenario)
    others = [
        one for one in parse_many(controllers, scenario, regional=True) if one.name != REFERENCE
    ]
    strategies = [parse(REFERENCE), *others]
    key = key_of(scenario, strategies, benchmark_study.PERTURBED_PLANT, {})
    runs = [
        Run(
            run_name(strategy.name, number),
            {**key(strategy.name), "kind": kind, "sigma": sigma},
            partial(
                benchmark_study.run_perturbed,
                strategy,
                number,
                scenario=scenario,
                sigma=sigma,
                kind=kind,
            ),
            folder=f"{kind}-{sigma:g}",
        )
        for sigma in sigmas or (SIGMAS_VEH_S if kind.startswith("demand") else SPREADS)
        for number in range(scenarios)
        for strategy in strategies
    ]
    out = default_folder(scenario.name) if out is None else Path(out)
    with locked(out):
        rows = run_many(runs, out, workers=workers_for(strategies, workers), progress=progress)
        if (rows["failure"] == "").any():
            benchmark_study.draw_robustness(out, rows)
    return rows


def train(
    scenario: Scenario | Path | str,
    controller: str = "dpc-pcrg",
    *,
    policy: "nn.Module | None" = None,
    cost: "Callable[[Trajectories], torch.Tensor] | None" = None,
    sample: "Callable[[torch.Generator, int], tuple] | None" = None,
    constraints: "Sequence[tuple[Callable[[Trajectories], torch.Tensor], float]]" = (),
    out: Path | str | None = None,
    seed: int = 0,
    steps: int | None = None,
    device: str = "cpu",
    resume: bool = False,
    anyway: bool = False,
    progress: Progress = None,
) -> Any:
    """Train a DPC policy and return its file; or a module of your own, which is returned.

    controller: its name; with `policy` the one whose settings and planning model are used
    policy: module as in nmfd.ModuleController, admissible by nmfd.PerimeterLayer and
        nmfd.SplitsLayer; trained in place
    cost: differentiable function, nmfd.Trajectories -> (B,); by default the total time spent
    sample: (torch.Generator, B) -> initial states (veh, (B, R, R)) and demand (veh/s, (T, B, R,
        R)); by default random
    constraints: pairs of a function, nmfd.Trajectories -> penalty >= 0 (B,), and its weight; their
        means are added
    out: policy file, SCENARIO/NAME.pt if None
    steps: Adam steps; those of scenario.toml, else 400, if None
    device: "cpu", which gives the same weights every time, "cuda" or "auto"
    resume: continue an interrupted training
    anyway: train even on placeholder MFDs or if no gateway can be controlled
    progress: see `benchmark`
    """
    scenario, strategy = _loaded(scenario), parse(controller)
    if policy is not None and (out or resume):
        raise InputError(
            "policy: a module is returned, not written; omit out and resume, keep its state_dict()"
        )
    task = training.Task(cost=cost, sample=sample, constraints=constraints)
    options: dict[str, Any] = {
        "seed": seed,
        "steps": steps,
        "device": training.available(device),
        "resume": resume,
    }
    chosen = training.settings(scenario, strategy, steps)
    file = _file(scenario, f"{controller}.pt", out) if policy is None else None
    believed = strategy.planning(scenario).network
    for region, doubts in zip(believed.region_names, believed.doubts, strict=False):
        if doubts:
            print(
                f"nmfd: the model of region {region} is doubtful: {'; '.join(doubts)}",
                file=sys.stderr,
            )
    worth = policy is None and chosen.steps >= training.WORTH_COMPILING
    options |= {"compiled": worth and rollout.can_compile(options["device"])}
    options |= {"module": policy, "task": task, "anyway": anyway}
    try:
        with watched(controller, progress) as show:
            return training.train(scenario, strategy, out=file, progress=show, **options)
    except KeyboardInterrupt:
        if file is None:
            raise
        raise KeyboardInterrupt(
            f"the best policy so far, if any, is {file}; add --resume to continue"
        ) from None


def bound(
    scenario: Scenario | Path | str,
    controller: str,
    *,
    out: Path | str | None = None,
    iterations: int = bound_study.ITERATIONS,
    progress: Progress = None,
) -> str:
    """Find the best plan "bound-pc" or "bound-pcrg" for known demand, and a lower bound; return a
    report.

    out: plan file, SCENARIO/NAME.npz if None
    iterations: Adam steps
    """
    scenario = _loaded(scenario)
    file = _file(scenario, f"{controller}.npz", out)
    with watched(controller, progress) as show:
        plan = bound_study.compute(scenario, controller, iterations=iterations, progress=show)
    open_loop.write(plan, scenario, file)
    totals = sorted(plan.totals.items(), key=lambda item: item[1])
    lines = [
        f"from {name}: {total:.5g} veh s" + (" (kept)" if name == plan.start else "")
        for name, total in totals
    ]
    lines += [f"lower bound: {plan.lower:.5g} veh s"]
    if plan.lower > 0:
        above = benchmark_study.percent_change(totals[0][1], plan.lower)
        lines[-1] += f"; the best plan is at most {above:.1f} % above the optimum"
    return "\n".join([*lines, f"Written to {file}"])


def show(scenario: Scenario | Path | str, *, out: Path | str | None = None) -> str:
    """Draw demand, region map and MFDs of a scenario; return a summary with the files."""
    scenario = _loaded(scenario)
    folder = Path("runs") / f"{file_name(scenario.name)}-show" if out is None else Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    files = benchmark_study.draw_scenario(folder, scenario)
    total = scenario.step * scenario.demand.sum()
    line = (
        f"{scenario.name}: {scenario.network.regions} regions, {total:,.0f} trips between "
        f"{int((scenario.demand.sum(axis=0) > 0).sum())} pairs, peak {scenario.demand.sum(axis=(1, 2)).max():.3g} "
        f"veh/s, {scenario.steps} control intervals of {scenario.step:g} s"
    )
    return "\n".join([line, *(f"Written to {file}" for file in files)])


def catalogue() -> str:
    """List the shipped scenarios, networks and policies, and all controllers, one line each."""
    scenarios, networks = shipped.folders(shipped.SCENARIO), shipped.folders(shipped.NETWORK)
    sections = {
        "Scenarios": {
            folder.name: _first_sentence(folder / "scenario.toml") for folder in scenarios
        },
        "Networks": {folder.name: _first_sentence(folder / "network.toml") for folder in networks},
        "Policies": {
            f"{folder.name}/{file.name}": ""
            for folder in scenarios
            for file in sorted(folder.glob("dpc-*.pt"))
        },
        "Controllers": {kind.name: kind.text for kind in CONTROLLERS.values()},
        "Words for a city in SUMO, behind a controller": dict(city_words()),
    }
    return "\n\n".join(
        "\n".join(
            [
                title,
                *(
                    f"  {name:{max(map(len, rows))}}  {text}".rstrip()
                    for name, text in rows.items()
                ),
            ]
        )
        for title, rows in sections.items()
    )


def _first_sentence(file: Path) -> str:
    """Return the first sentence of the comment at the top of a TOML file."""
    lines = takewhile(
        lambda line: line.startswith("#"), file.read_text(encoding="utf-8").splitlines()
    )
    words = " ".join(line.lstrip("# ") for line in lines if not line.startswith("#:"))
    return textwrap.shorten(
        re.split(r"\.\s+(?=[A-Z\d])", words)[0].rstrip("."), 90, placeholder=" ..."
    )


def _file(scenario: Scenario, name: str, out: Path | str | None) -> Path:
    """Return the file that `out` names, or `name` in the scenario's folder; check that its folder
    exists."""
    if out is not None:
        file = Path(out)
    elif scenario.folder is not None:
        file = shipped.beside(scenario.folder, name, "--out FILE", scenario=True)
    else:
        raise InputError(f"{name}: expected a file to write to; give out")
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder; make it or choose another --out")
    return file


def check_policies(policies: Mapping[str, Path], strategies: Sequence[Strategy]) -> None:
    """Raise InputError for a policy file of a controller that is not among the strategies."""
    known = [strategy.name for strategy in strategies]
    for name in policies:
        if name not in known:
            near = did_you_mean(name, known)
            raise InputError(
                f"--policy: {name!r} is not among {', '.join(known)}{near}; add it there"
            )


def _check_plant(plant: str | Plant) -> None:
    lacking = [
        method
        for method in ("reset", "step", "observe")
        if not callable(getattr(plant, method, None))
    ]
    if lacking and not isinstance(plant, str):
        raise InputError(f"plant: {type(plant).__name__} has no {lacking[0]}; see nmfd.Plant")
    if isinstance(plant, str) and plant not in PLANTS:
        raise InputError(
            f"plant {plant!r} is unknown{did_you_mean(plant, PLANTS)}; choose from {', '.join(PLANTS)}"
        )


def _loaded(scenario: Scenario | Path | str) -> Scenario:
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
