"""Functions behind the commands of `nmfd`; exported by the package `nmfd`.

What takes seconds to import, such as torch, is imported in the functions that need it.
"""

import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, overload

from nmfd import closed_loop
from nmfd.controllers import open_loop
from nmfd.controllers.base import Options
from nmfd.controllers.strategy import (
    CONTROLLERS,
    ControllerLike,
    Strategy,
    check_tables,
    parse,
    parse_many,
)
from nmfd.errors import InputError, did_you_mean
from nmfd.model.links.network import LINKS
from nmfd.model.scenario import Scenario, read_scenario, with_demand
from nmfd.runs import shipped
from nmfd.runs.files import default_folder, folder_of, path_of, run_name
from nmfd.runs.progress import Progress, watched
from nmfd.runs.run_many import Run, locked, run_many
from nmfd.runs.run_many import raise_failures as raise_failures
from nmfd.studies import benchmark as benchmark_study
from nmfd.studies.benchmark import (
    MODULES,
    PLANTS,
    REFERENCE,
    SIGMAS_VEH_S,
    SPREADS,
    closed_loop_of,
    key_of,
    plant_of,
    workers_for,
)
from nmfd.studies.benchmark import improvement_table as improvement_table
from nmfd.studies.benchmark import summary_table as summary_table
from nmfd.types import Controller, Plant, Result

if TYPE_CHECKING:
    import torch
    from torch import nn

    from nmfd.controllers.dpc.rollout import Trajectories
    from nmfd.runs.frame import Table

    Cost: TypeAlias = Callable[[Trajectories], torch.Tensor]
    Sample: TypeAlias = Callable[[torch.Generator, int], tuple]
    Module = TypeVar("Module", bound=nn.Module)

ScenarioLike: TypeAlias = Scenario | Path | str
Controllers: TypeAlias = ControllerLike | Sequence[ControllerLike]
MOST_DEMAND = 10.0  # factor of a scenario's demand


def load_scenario(folder: Path | str, settings: Mapping[str, Any] | None = None) -> Scenario:
    """Read a scenario and its network, and check all its options.

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


def loaded(
    scenario: ScenarioLike,
    *,
    steps: int | None = None,
    demand: float = 1.0,
    settings: Mapping[str, Any] | None = None,
) -> Scenario:
    """Return a scenario, shortened and with another demand.

    scenario: a Scenario, or as in `load_scenario`
    steps: control intervals; the scenario's if None
    demand: factor of the scenario's demand
    settings: as in `load_scenario`
    Raises: InputError
    """
    if not isinstance(scenario, Scenario):
        scenario = load_scenario(scenario, settings)
    return with_demand(scenario, steps=steps, factor=checked_factor(demand))


def checked_factor(demand: float) -> float:
    """Return a factor of the demand.

    Raises: InputError for one that no scenario takes
    """
    if not 0.0 < demand <= MOST_DEMAND:
        raise InputError(
            f"demand: expected a number above 0 up to {MOST_DEMAND:g}, got {demand:g} instead"
        )
    return float(demand)


def levels_of(demand: float | Iterable[float]) -> list[float]:
    """Return the factors of the demand of a study as a list.

    Raises: InputError for a wrong one
    """
    if isinstance(demand, int | float):
        return [checked_factor(demand)]
    return [checked_factor(one) for one in demand]


def seeds_of(seeds: int | Iterable[int], first: int = 0) -> list[int]:
    """Return the seeds of a study: so many from `first` on, or those given.

    Raises: InputError if there is none
    """
    if isinstance(seeds, int):
        seeds = range(first, first + seeds)
    chosen = list(seeds)
    if not chosen:
        raise InputError("seeds: expected a number from 1 up or a sequence, got none")
    return chosen


def options(controller: str, scenario: ScenarioLike) -> Options:
    """Return the options that a scenario gives a built-in controller.

        >>> nmfd.options("pi-gating", "grid7_peak").changed(kp=2.0).kp
        2.0

    Raises: InputError for an unknown name or a wrong option
    """
    found = parse(controller).options(loaded(scenario))
    if found is None:
        raise InputError(f"controller {controller!r}: is your own and has no declared options")
    return found


def controller(
    controller: ControllerLike, scenario: ScenarioLike, *, policy: Path | str | None = None
) -> Controller:
    """Return a controller for `scenario`, with `reset` and `act`.

    controller: options such as nmfd.PiGating(kp=2.0), a name as on the command line, such as
        "pi-gating", or "path/to/file.py:Class"
    policy: the file of a policy or plan, if not SCENARIO/NAME.pt or .npz

        >>> nmfd.controller("pi-gating", "economic_mpc").regions  # protected ones
        array([3])

    Raises: InputError for an unknown name, a wrong option, or a policy that is missing or made for
        another network
    """
    return parse(controller).make(loaded(scenario), path_of(policy))


def run(
    scenario: ScenarioLike,
    controller: ControllerLike,
    *,
    seed: int = 0,
    demand: float = 1.0,
    steps: int | None = None,
    plant: str | Plant = "nmfd",
    policy: Path | str | None = None,
    progress: Progress = None,
) -> Result:
    """Run one closed loop on a regional model.

        >>> result = nmfd.run("economic_mpc", nmfd.PiGating(kp=2.0), steps=20)
        >>> result.accumulation.dims, result.accumulation.shape
        (('time', 'region', 'destination'), (21, 7, 7))
        >>> bool(result.observed[20].sum() == result.accumulation[20].sum())  # observed with noise
        False

    scenario: a name of `nmfd show`, the folder of a scenario.toml, or a Scenario
    controller: options such as nmfd.PiGating(kp=2.0), a name as on the command line, or an object
        with `reset` and `act` (nmfd.Controller)
    seed: seed of the measurement noise
    demand: factor of the scenario's demand
    steps: control intervals; the scenario's if None
    plant: "nmfd", "acyclic", "links", or an object with `reset`, `step` and `observe` as in
        nmfd.Plant
    policy: as in `nmfd.controller`
    progress: None for a bar on a terminal or in a notebook, False for none, or a function of the
        steps done and all steps

    The same seed gives the same result but for wall times (Result.without_times). Raises InputError
    for a wrong argument, and for an inadmissible command before the plant sees it.
    """
    strategy = _parse_for(plant, controller)
    scenario = loaded(scenario, steps=steps, demand=demand)
    _check_plant(plant)
    acting = strategy.make(scenario, path_of(policy))
    name = type(plant).__name__
    if isinstance(plant, str):
        name = plant
        plant = plant_of(plant, scenario, strategy)
    with watched(strategy.name, progress) as show:
        result = closed_loop.run(plant, acting, scenario, seed=seed, progress=show)
    return result.assign(controller=strategy.name, plant=name, demand=float(demand))


def benchmark(
    scenario: ScenarioLike,
    controllers: Controllers,
    *,
    seeds: int | Iterable[int] = 1,
    demand: float | Iterable[float] = 1.0,
    steps: int | None = None,
    plant: str = "nmfd",
    policies: Mapping[str, Path | str] | None = None,
    out: Path | str | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    time_limit: float | None = None,
    overwrite: bool = False,
    progress: Progress = None,
) -> "Table":
    """Run controllers x seeds in a run folder, and return one row per run.

        >>> rows = nmfd.benchmark("economic_mpc", ["no-control", nmfd.PiGating()], out="runs/mine")
        >>> rows.groupby("controller")["completed_veh"].mean().round(-2).to_dict()
        {'no-control': 6200.0, 'pi-gating': 31600.0}

    scenario: as in `nmfd.run`
    controllers: one or several as in `nmfd.run`, or patterns, which stand for the controllers that
        can be made for this scenario
    seeds: how many, from 0, or which
    demand: factor or factors of the scenario's demand
    steps: control intervals; the scenario's if None
    plant: "nmfd", "acyclic" or "links"
    policies: controller -> file, if not SCENARIO/NAME.pt
    out: run folder, runs/SCENARIO-TIME if None; it is `table.attrs["folder"]`, and finished runs in
        it are kept
    workers: runs at a time
    scheduler: address of a Dask scheduler that does the runs instead
    time_limit: seconds after which a run is ended; see nmfd.runs.run_many
    overwrite: do finished runs again whose settings have changed
    progress: as in `nmfd.run`; your own is called as progress(done, runs, name)

    The column `failure` is "" of a finished run, else its reason. `lower_bound_veh_s` bounds the
    total time spent with the same controls, where `nmfd bound` has found one; `impossible` marks
    rows below it. Raises InputError.
    """
    levels = levels_of(demand)
    scenarios = {level: loaded(scenario, steps=steps, demand=level) for level in levels}
    first = scenarios[levels[0]]
    _check_plant(plant)
    strategies = parse_many(controllers, first, partial(_parse_for, plant))
    files = policy_files(policies, strategies)
    runs = []
    lower = {}
    for level, one in scenarios.items():
        key = key_of(one, strategies, plant, files)
        folder = f"demand-{level:g}" if len(levels) > 1 else ""
        for strategy in strategies:
            lower[strategy.name, level] = benchmark_study.lower_bound(one, strategy, plant)
        for seed in seeds_of(seeds):
            for strategy in strategies:
                policy = files.get(strategy.name)
                job = partial(
                    closed_loop_of,
                    strategy,
                    seed,
                    scenario=one,
                    plant=plant,
                    policy=policy,
                    demand=level,
                )
                name = run_name(strategy.name, seed)
                run = Run(name, key(strategy.name), job, folder, modules=MODULES)
                runs.append(run)
    out = default_folder(first.name) if out is None else Path(out)
    with locked(out):
        rows = run_many(
            runs,
            out,
            workers=workers_for(strategies, workers),
            scheduler=scheduler,
            time_limit=time_limit,
            overwrite=overwrite,
            progress=progress,
        )
        rows = benchmark_study.with_bounds(rows, lower, levels[0])
        benchmark_study.draw(out, scenarios, rows)
    return rows


def robustness(
    scenario: ScenarioLike,
    controllers: Controllers,
    *,
    kind: str = "demand",
    sigmas: Iterable[float] | None = None,
    seeds: int | Iterable[int] = 20,
    demand: float = 1.0,
    steps: int | None = None,
    out: Path | str | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    time_limit: float | None = None,
    overwrite: bool = False,
    progress: Progress = None,
) -> "Table":
    """Run controllers in perturbed scenarios, and return one row per run.

    No control runs as well; a figure shows the gain over it.

    kind: "demand", "demand-total", "mfd-scale", "mfd-axis" or "trip-lengths"
        (nmfd.model.scenario.perturbed)
    sigmas: standard deviations of the demand noise (veh/s), or of the logarithms of MFDs or trip
        lengths (-)
    seeds: draws of the perturbation for every sigma
    others: see `benchmark`
    """
    scenario = loaded(scenario, steps=steps, demand=demand)
    strategies: list[Strategy] = [parse(REFERENCE)]
    for strategy in parse_many(
        controllers, scenario, partial(_parse_for, benchmark_study.PERTURBED_PLANT)
    ):
        if strategy.name != REFERENCE:
            strategies.append(strategy)
    key = key_of(scenario, strategies, benchmark_study.PERTURBED_PLANT, {})
    if sigmas is None:
        sigmas = SIGMAS_VEH_S if kind.startswith("demand") else SPREADS
    runs = []
    for sigma in sigmas:
        for number in seeds_of(seeds):
            for strategy in strategies:
                job = partial(
                    benchmark_study.run_perturbed,
                    strategy,
                    number,
                    scenario=scenario,
                    sigma=sigma,
                    kind=kind,
                )
                own_key = {**key(strategy.name), "kind": kind, "sigma": sigma}
                name = run_name(strategy.name, number)
                folder = f"{kind}-{sigma:g}"
                runs.append(Run(name, own_key, job, folder, modules=MODULES))
    out = default_folder(scenario.name) if out is None else Path(out)
    with locked(out):
        rows = run_many(
            runs,
            out,
            workers=workers_for(strategies, workers),
            scheduler=scheduler,
            time_limit=time_limit,
            overwrite=overwrite,
            progress=progress,
        )
        if (rows["failure"] == "").any():
            benchmark_study.draw_robustness(out, rows)
    return rows


@overload
def train(
    scenario: ScenarioLike,
    controller: ControllerLike = ...,
    *,
    policy: None = ...,
    cost: "Cost | None" = ...,
    sample: "Sample | None" = ...,
    constraints: "Sequence[tuple[Cost, float]]" = ...,
    out: Path | str | None = ...,
    plant: str = ...,
    seed: int = ...,
    steps: int | None = ...,
    device: str = ...,
    resume: bool = ...,
    anyway: bool = ...,
    progress: Progress = ...,
) -> Path: ...
@overload
def train(
    scenario: ScenarioLike,
    controller: ControllerLike = ...,
    *,
    policy: "Module",
    cost: "Cost | None" = ...,
    sample: "Sample | None" = ...,
    constraints: "Sequence[tuple[Cost, float]]" = ...,
    out: Path | str | None = ...,
    plant: str = ...,
    seed: int = ...,
    steps: int | None = ...,
    device: str = ...,
    resume: bool = ...,
    anyway: bool = ...,
    progress: Progress = ...,
) -> "Module": ...
def train(
    scenario: ScenarioLike,
    controller: ControllerLike = "dpc-pcrg",
    *,
    policy: "nn.Module | None" = None,
    cost: "Cost | None" = None,
    sample: "Sample | None" = None,
    constraints: "Sequence[tuple[Cost, float]]" = (),
    out: Path | str | None = None,
    plant: str = "nmfd",
    seed: int = 0,
    steps: int | None = None,
    device: str = "cpu",
    resume: bool = False,
    anyway: bool = False,
    progress: Progress = None,
) -> "Path | nn.Module":
    """Train a DPC policy and return its file, or your own module.

    controller: its name or nmfd.Dpc(...); with `policy` the one whose settings and planning model
        are used
    policy: module as in nmfd.ModuleController, admissible by nmfd.PerimeterLayer and
        nmfd.SplitsLayer; trained in place
    cost: differentiable function, nmfd.Trajectories -> (B,); by default the total time spent
    sample: (torch.Generator, B) -> initial states (veh, (B, R, R)) and demand (veh/s,
        (T, B, R, R)); by default random
    constraints: pairs of a function, nmfd.Trajectories -> penalty >= 0 (B,), and its weight; their
        means are added
    out: policy file, SCENARIO/NAME.pt if None
    plant: "nmfd", the regional model, or "links", the streets of the scenario
    steps: Adam steps; those of scenario.toml, else 400, if None
    device: "cpu", which gives the same weights every time, "cuda" or "auto"
    resume: continue an interrupted training
    anyway: train even on placeholder MFDs, on a model that predicts worse than "as now", or if no
        gateway can be controlled
    progress: see `benchmark`
    """
    from nmfd.controllers import training
    from nmfd.controllers.dpc import rollout

    scenario = loaded(scenario)
    strategy = parse(controller)
    if policy is not None and (out or resume):
        raise InputError(
            "policy: a module is returned, not written; omit out and resume, keep its state_dict()"
        )
    if plant not in (training.REGIONAL, LINKS):
        names = f"{training.REGIONAL} and {LINKS}"
        raise InputError(f"plant {plant!r}: policies are trained through {names}; choose one")
    task = training.Task(cost=cost, sample=sample, constraints=constraints)
    chosen = training.settings(scenario, strategy, steps)
    device = training.available(device)
    file = None if policy is not None else _file(scenario, f"{strategy.name}.pt", out)
    regional = plant == training.REGIONAL
    believed = strategy.planning(scenario).network
    for region, doubts in zip(believed.region_names, believed.doubts, strict=False):
        if doubts and regional:
            problem = f"the model of region {region} is doubtful: {'; '.join(doubts)}"
            print(f"nmfd: {problem}", file=sys.stderr)
    worth = policy is None and regional and chosen.steps >= training.WORTH_COMPILING
    try:
        with watched(strategy.name, progress) as show:
            return training.train(
                scenario,
                strategy,
                seed=seed,
                out=file,
                plant=plant,
                module=policy,
                task=task,
                steps=steps,
                device=device,
                resume=resume,
                compiled=worth and rollout.can_compile(device),
                anyway=anyway,
                progress=show,
            )
    except KeyboardInterrupt:
        if file is None:
            raise
        kept = f"the best policy so far, if any, is {file}; add --resume to continue"
        raise KeyboardInterrupt(kept) from None


def bound(
    scenario: ScenarioLike,
    controller: str,
    *,
    out: Path | str | None = None,
    iterations: int | None = None,
    progress: Progress = None,
) -> open_loop.Plan:
    """Find the best plan for known demand, and a lower bound.

    controller: "bound-pc" or, with route guidance, "bound-pcrg"
    out: plan file, SCENARIO/NAME.npz if None
    iterations: Adam steps; those of nmfd.studies.bound if None
    """
    from nmfd.studies import bound as bound_study

    scenario = loaded(scenario)
    file = _file(scenario, f"{controller}.npz", out)
    if iterations is None:
        iterations = bound_study.ITERATIONS
    with watched(controller, progress) as show:
        plan = bound_study.compute(scenario, controller, iterations=iterations, progress=show)
    open_loop.write(plan, scenario, file)
    return plan


def bound_report(plan: open_loop.Plan) -> str:
    """Return the totals of all starts of a plan, and the lower bound."""
    totals = sorted(plan.totals.items(), key=lambda item: item[1])
    lines = []
    for name, total in totals:
        kept = " (kept)" if name == plan.start else ""
        lines.append(f"from {name}: {total:.5g} veh s{kept}")
    lines.append(f"lower bound: {plan.lower:.5g} veh s")
    if plan.lower > 0:
        above = benchmark_study.percent_change(totals[0][1], plan.lower)
        lines[-1] += f"; the best plan is at most {above:.1f} % above the optimum"
    return "\n".join(lines)


def show(scenario: ScenarioLike, *, out: Path | str | None = None) -> list[Path]:
    """Draw demand, region map and MFDs of a scenario; return the files.

    out: folder, runs/SCENARIO-show if None
    """
    scenario = loaded(scenario)
    folder = folder_of(scenario.name, "show", out)
    folder.mkdir(parents=True, exist_ok=True)
    return benchmark_study.draw_scenario(folder, scenario)


def described(scenario: Scenario) -> str:
    """Return a scenario in one line."""
    demand = scenario.demand
    pairs = int((demand.sum(axis=0) > 0).sum())
    return (
        f"{scenario.name}: {scenario.network.regions} regions, "
        f"{scenario.step * demand.sum():,.0f} trips between {pairs} pairs, peak "
        f"{demand.sum(axis=(1, 2)).max():.3g} veh/s, {scenario.steps} control intervals of "
        f"{scenario.step:g} s"
    )


def catalogue() -> dict[str, dict[str, str]]:
    """Return what is shipped, and all controllers, with a line each."""
    scenarios = shipped.folders(shipped.SCENARIO)
    networks = shipped.folders(shipped.NETWORK)
    policies = {}
    for folder in scenarios:
        for file in sorted(folder.glob("dpc-*.pt")):
            policies[f"{folder.name}/{file.name}"] = ""
    return {
        "Scenarios": {one.name: _first_sentence(one / "scenario.toml") for one in scenarios},
        "Networks": {one.name: _first_sentence(one / "network.toml") for one in networks},
        "Policies": policies,
        "Controllers": {kind.name: kind.text for kind in CONTROLLERS.values()},
    }


def listing(sections: Mapping[str, Mapping[str, str]]) -> str:
    """Return a catalogue as text."""
    parts = []
    for title, rows in sections.items():
        width = max(map(len, rows))
        lines = [f"  {name:{width}}  {text}".rstrip() for name, text in rows.items()]
        parts.append("\n".join([title, *lines]))
    return "\n\n".join(parts)


def _first_sentence(file: Path) -> str:
    """Return the first sentence of the comment at the top of a TOML file."""
    text = file.read_text(encoding="utf-8").splitlines()
    comment = takewhile(lambda line: line.startswith("#"), text)
    words = " ".join(line.lstrip("# ") for line in comment if not line.startswith("#:"))
    sentence = re.split(r"\.\s+(?=[A-Z\d])", words)[0]
    return textwrap.shorten(sentence.rstrip("."), 90, placeholder=" ...")


def _file(scenario: Scenario, name: str, out: Path | str | None) -> Path:
    """Return the file that `out` names, or `name` in the scenario's folder.

    Raises: InputError if its folder does not exist
    """
    if out is not None:
        file = Path(out)
    elif scenario.folder is not None:
        file = shipped.beside(scenario.folder, name, "--out FILE", scenario=True)
    else:
        raise InputError(f"{name}: expected a file to write to; give out")
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder; make it or choose another --out")
    return file


def _parse_for(plant: str | Plant, controller: ControllerLike) -> Strategy:
    """Return the strategy of a controller; only streets know labels."""
    strategy = parse(controller)
    if plant == LINKS:
        return strategy
    return strategy.regional()


def policy_files(
    policies: Mapping[str, Path | str] | None, strategies: Sequence[Strategy]
) -> dict[str, Path]:
    """Return the policy files by strategy.

    Raises: InputError for a file of none of the strategies
    """
    known = [strategy.name for strategy in strategies]
    files = {name: Path(file) for name, file in (policies or {}).items()}
    for name in files:
        if name not in known:
            near = did_you_mean(name, known)
            raise InputError(
                f"--policy: {name!r} is not among {', '.join(known)}{near}; add it there"
            )
    return files


def _check_plant(plant: str | Plant) -> None:
    if isinstance(plant, str):
        if plant not in PLANTS:
            near = did_you_mean(plant, PLANTS)
            names = ", ".join(PLANTS)
            raise InputError(f"plant {plant!r} is unknown{near}; choose from {names}")
        return
    for method in ("reset", "step", "observe"):
        if not callable(getattr(plant, method, None)):
            raise InputError(f"plant: {type(plant).__name__} has no {method}; see nmfd.Plant")
