"""Python interface of `cosim`: functions for commands and single runs.

Studies return tables; the command line prints them. What takes a second to import, such as Bokeh,
Matplotlib, Optuna and torch, is imported in the functions that need it.
"""

import os
import sys
import webbrowser
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.evaluation import evaluate as evaluation
from cosim.evaluation import results
from cosim.evaluation.runs import runs_of
from cosim.evaluation.signal_proof import sheets
from cosim.evaluation.simulate import Simulation, simulate
from cosim.importing import get as cities
from cosim.plant import strategy as strategies_of
from cosim.plant.settings import PLAN, Settings
from cosim.plant.strategy import Strategy, parse
from cosim.sumo.trips import PLANNING_SEEDS
from nmfd.api import (
    Controllers,
    ScenarioLike,
    checked_factor,
    levels_of,
    loaded,
    policy_files,
    seeds_of,
)
from nmfd.api import catalogue as regional_catalogue
from nmfd.controllers.strategy import BuiltIn, ControllerLike, parse_many
from nmfd.errors import RunFailed
from nmfd.metrics import summary
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped
from nmfd.runs.files import default_folder, folder_of, path_of, write_table
from nmfd.runs.frame import Table
from nmfd.runs.progress import Progress, watched
from nmfd.runs.run_many import Run, locked, raise_failures, run_many
from nmfd.studies.benchmark import REFERENCE, draw_accumulations
from nmfd.types import Result

if TYPE_CHECKING:
    from cosim.evaluation.link_fit import Fit
    from cosim.importing.edge_mfds import EdgeMfds
    from cosim.studying.page import Study
    from nmfd.controllers.base import Options
    from nmfd.model.links.flows import Numbers

DEMO = "demo"  # a shipped scenario
FIRST_SEED = 2000  # of evaluations; those below are for development
TUNING_SEED = 1000


def run(
    scenario: ScenarioLike,
    controller: ControllerLike,
    *,
    city: Settings | str | None = None,
    seed: int = 0,
    demand: float = 1.0,
    steps: int | None = None,
    policy: Path | str | None = None,
    tripinfo: Path | str | None = None,
    progress: Progress = None,
) -> Result:
    """Run one closed loop in SUMO, in this process and without a run folder.

    scenario: shipped name, folder of a scenario.toml, or result of nmfd.load_scenario
    controller: strategy by name, options such as nmfd.PiGating(kp=2.0), or an object with `reset`
        and `act` (nmfd.Controller)
    city: what else the city does: cosim.Settings whose given fields replace the scenario's, or
        words such as "max-pressure+rerouting-30"
    seed: seed of trips, drivers and guidance; the same seed gives the same result, but for wall
        times
    demand: factor of the scenario's demand
    steps: control intervals; the scenario's if None
    policy: policy file, if not SCENARIO/NAME.pt
    tripinfo: file for SUMO's own output of trips; all others are options of SUMO in [sumo.options]
    progress: None for a bar, False for none, or a function of done and total control intervals

    The result has the arrays of cosim.plant.record.RECORD and the facts of
    cosim.evaluation.simulate.
    Raises: InputError for a wrong name, file or value, RuntimeError if another simulation is open
        in this process

        >>> city = cosim.Settings(rerouting=0.3)
        >>> result = cosim.run("grid7_peak", nmfd.PiGating(), city=city, seed=3, steps=2)
        >>> result.accumulation.shape, result.crossings.shape
        ((3, 7, 7), (2, 7, 7, 7))
    """
    strategy = parse(controller, city)
    shortened = loaded(scenario, steps=steps)
    factor = checked_factor(demand)
    with watched(strategy.name, progress) as show:
        job = Simulation(shortened, strategy, seed, factor, path_of(policy), path_of(tripinfo))
        return simulate(job, progress=show)


def run_controllers(
    scenario: ScenarioLike,
    controllers: Controllers,
    *,
    city: Settings | str | None = None,
    seed: int = 0,
    demand: float = 1.0,
    steps: int | None = None,
    policies: Mapping[str, Path | str] | None = None,
    out: Path | str | None = None,
    workers: int = 2,
    time_limit: float | None = None,
    overwrite: bool = False,
    progress: Progress = None,
) -> Table:
    """Run strategies on the same trips in a folder; return a row per run.

    policies: files by controller, if not SCENARIO/NAME.pt
    out: run folder, runs/SCENARIO-TIME if None; it is `table.attrs["folder"]`
    others: as in `run` and `evaluate`
    Raises: InputError, and RunFailed if a run failed
    """
    loaded_one = loaded(scenario, steps=steps)
    strategies = _reference_first(parse_many(controllers, loaded_one, lambda one: parse(one, city)))
    files = policy_files(policies, strategies)
    out = default_folder(loaded_one.name) if out is None else Path(out)
    runs = runs_of(loaded_one, strategies, [seed], demand=demand, policies=files)
    with locked(out):
        rows = run_many(
            runs,
            out,
            workers=workers,
            time_limit=time_limit,
            overwrite=overwrite,
            progress=progress,
        )
        raise_failures(rows)
        finished = results.read(out)
        there = [one for level in finished.levels for one in level.results()]
        draw_accumulations(out, loaded_one, there)
        write_table(out / "signals.csv", sheets(there), float_format="%g")
    table = Table(finished.rows)
    table.attrs["folder"] = str(out)
    return table


def demo(out: Path | str = "runs/demo", *, seed: int = 1000) -> Table:
    """Run the demo city with and without gates, and open a page about both.

    The page is `table.attrs["page"]`.
    """
    from cosim.reporting import html

    out = Path(out)
    scenario = loaded(DEMO)
    strategies = [parse("no-control"), parse("pi-gating")]
    with locked(out):
        rows = run_many(runs_of(scenario, strategies, [seed]), out, workers=2, overwrite=True)
        raise_failures(rows)
        page = html.write_page(out / "report.html", [results.read(out)], seed=seed).resolve()
    if _has_screen():
        webbrowser.open(page.as_uri())
    table = Table(rows[rows["seed"] == seed])
    table.attrs["page"] = str(page)
    return table


def watch(
    scenario: ScenarioLike,
    controllers: Controllers,
    *,
    city: Settings | str | None = None,
    seed: int = 0,
    demand: float = 1.0,
    port: int = 0,
    gui: bool = False,
) -> dict[str, dict]:
    """Show runs on a live page; return their figures by name.

    It returns when the runs have ended and the page is closed.

    port: port of the page, any that is free if 0
    gui: show the first run in sumo-gui instead; nothing is returned if its window is closed early
    others: as in `run`
    """
    from cosim.view import live

    loaded_one = loaded(scenario)
    factor = checked_factor(demand)
    strategies = _reference_first(parse_many(controllers, loaded_one, lambda one: parse(one, city)))
    jobs = [Simulation(loaded_one, strategy, seed, factor) for strategy in strategies]
    if gui:
        try:
            with watched("watch", None) as show:
                return {jobs[0].strategy.name: summary(simulate(jobs[0], progress=show, gui=True))}
        except RunFailed:
            return {}
    rows = {}
    for one in live.watch(jobs, port=port, browse=_has_screen()):
        if one.row is not None:
            rows[one.name] = one.row
    return rows


def evaluate(
    scenario: ScenarioLike,
    controllers: Controllers,
    *,
    city: Settings | str | None = None,
    seeds: int | Iterable[int] | None = None,
    demand: float | Iterable[float] = 1.0,
    steps: int | None = None,
    settings: Mapping[str, Any] | None = None,
    policies: Mapping[str, Path | str] | None = None,
    out: Path | str | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    time_limit: float | None = None,
    overwrite: bool = False,
    progress: Progress = None,
) -> Table:
    """Run controllers x seeds x demand levels; return a row per run.

    Tables and figures are written to the folder.

    scenario: as in `run`, or the file of a suite (cosim.evaluation.evaluate), which has its own
        seeds and levels
    controllers: one or several as in `run`, or patterns such as "dpc-*"
    city: as in `run`, for all controllers
    seeds: how many, from 2000, or which; ten if None
    demand: factor or factors of the scenario's demand
    settings: see nmfd.load_scenario; of every scenario of a suite
    policies: files by controller, if not SCENARIO/NAME.pt
    out: folder, runs/SCENARIO-evaluate if None; it is `table.attrs["folder"]`
    workers: runs at a time on this machine
    scheduler: address of a Dask scheduler that does the runs instead
    time_limit: seconds after which a run is ended; see nmfd.runs.run_many
    overwrite: do finished runs again whose settings have changed
    progress: None for a bar, False for none, or a function called as progress(done, runs, name)

    The column `failure` is "" of a finished run, else its reason. Raises InputError.

        >>> controllers = ["no-control", nmfd.PiGating(kp=0.4)]
        >>> table = cosim.evaluate("demo", controllers, seeds=3, steps=16, workers=2)
        >>> means = table.groupby("controller")["total_time_spent_veh_s"].mean()
        >>> bool(means["pi-gating(kp=0.4)"] < means["no-control"])
        True
    """
    runs, out = planned(
        scenario,
        controllers,
        city=city,
        seeds=seeds,
        demand=demand,
        steps=steps,
        settings=settings,
        policies=policies,
        out=out,
    )
    with locked(out):
        return evaluation.evaluate(
            runs,
            out,
            _draw_all,
            workers=workers,
            scheduler=scheduler,
            time_limit=time_limit,
            overwrite=overwrite,
            progress=progress,
        )


def _draw_all(finished: results.Finished) -> None:
    from cosim.reporting import figures  # after the runs: matplotlib takes a second

    figures.draw_all(finished)


def planned(
    scenario: ScenarioLike,
    controllers: Controllers,
    *,
    city: Settings | str | None = None,
    seeds: int | Iterable[int] | None = None,
    demand: float | Iterable[float] = 1.0,
    steps: int | None = None,
    settings: Mapping[str, Any] | None = None,
    policies: Mapping[str, Path | str] | None = None,
    out: Path | str | None = None,
) -> tuple[list[Run], Path]:
    """Return the runs of `evaluate` with these arguments, and their folder.

    Raises: InputError
    """
    name = ""
    suite: list[tuple[Scenario, Sequence[float]]]
    if not isinstance(scenario, Scenario) and Path(scenario).suffix == ".toml":
        name = Path(scenario).stem
        suite, seeds = evaluation.read_suite(Path(scenario), settings)
    else:
        levels = levels_of(demand)
        suite = [(loaded(scenario, settings=settings), levels)]
    suite = [(loaded(one, steps=steps), levels) for one, levels in suite]
    first = suite[0][0]
    strategies = parse_many(controllers, first, lambda one: parse(one, city))
    files = policy_files(policies, strategies)
    chosen = seeds_of(10 if seeds is None else seeds, FIRST_SEED)
    folder = folder_of(name if len(suite) > 1 else first.name, "evaluate", out)
    return evaluation.plan(suite, strategies, chosen, files), folder


def compare(folder: Path | str) -> Table:
    """Compare finished runs with the regional model; return a row per run.

    A table and figures are written beside the runs.
    """
    from cosim.evaluation import model_validation

    folder = Path(folder)
    finished = results.read(folder)
    with locked(folder):
        rows = Table(model_validation.compare(finished))
        write_table(folder / "foresight.csv", rows, float_format="%.6g")
    rows.attrs["scenario"] = finished.scenario.name
    return rows


def report(
    folders: Path | str | Sequence[Path | str],
    *,
    seed: int | None = None,
    out: Path | str | None = None,
) -> Path:
    """Write one HTML page about finished runs and return its path.

    seed: seed of the runs on the map
    """
    from cosim.reporting import html

    paths = _paths(folders)
    runs = [results.read(path) for path in paths]
    with locked(paths[0]) if out is None else nullcontext():
        page = paths[0] / "report.html" if out is None else Path(out)
        return html.write_page(page, runs, seed=seed)


@dataclass(frozen=True, kw_only=True)
class Tuned:
    """Result of `tune`.

    table: one row per candidate: options, score (veh s), total time spent of every run
    best: the best options, to be used as a controller; None for the user's own code
    text: the same as a table of scenario.toml
    folder: where both were written
    """

    table: Table
    best: "Options | None"
    text: str
    folder: Path


def tune(
    scenario: ScenarioLike,
    controller: ControllerLike,
    *,
    options: Mapping[str, tuple[float, float]],
    city: Settings | str | None = None,
    candidates: int = 40,
    seeds: int | Iterable[int] = 2,
    demand: float | Iterable[float] = 1.0,
    steps: int | None = None,
    search_seed: int = 0,
    out: Path | str | None = None,
    workers: int = 1,
    time_limit: float | None = None,
    progress: Progress = None,
) -> Tuned:
    """Search the options of a controller in SUMO by CMA-ES, as `cosim tune`.

    options: KEY, or KEY[N] for one number of a list, -> (low, high)
    candidates: how many; the first has the given or the scenario's values
    seeds: runs per candidate and demand level, from seed 1000, or the seeds
    demand: factor or factors of the scenario's demand
    search_seed: seed of the search and of training
    others: as in `evaluate`
    """
    from cosim.evaluation import tuning

    one = loaded(scenario, steps=steps)
    strategy = parse(controller, city)
    kind = strategy.controller
    if isinstance(kind, BuiltIn) and kind.given is not None:
        plain = replace(kind, name=kind.name.partition("(")[0], given=None)
        given = kind.given.model_dump(exclude_unset=True, exclude=set(kind.fixed))
        tables = {**one.controller_options, plain.name: given}
        one = replace(one, controller_options=tables)
        strategy = replace(strategy, controller=plain)
    order = tuning.Tuning(
        scenario=one,
        strategy=strategy,
        options=options,
        seeds=seeds_of(seeds, TUNING_SEED),
        levels=levels_of(demand),
        trials=candidates,
        search_seed=search_seed,
        out=folder_of(one.name, "tune", out),
    )
    table = tuning.tune(order, workers=workers, time_limit=time_limit, progress=progress)
    best = strategy.options(tuning.best_of(order, table))
    text = (order.out / "tune.toml").read_text(encoding="utf-8")
    return Tuned(table=Table(table), best=best, text=text, folder=order.out)


def plan(
    scenario: ScenarioLike,
    controller: ControllerLike,
    *,
    city: Settings | str | None = None,
    seed: int = TUNING_SEED,
    demand: float = 1.0,
    iterations: int = 9,
    plan_file: Path | str | None = None,
    out: Path | str | None = None,
    time_limit: float | None = None,
    overwrite: bool = False,
    progress: Progress = None,
) -> Table:
    """Plan the routes of drivers by iterated marginal costs, as `cosim plan`.

    controller: signals and whatever else acts besides, such as "max-pressure"
    iterations: SUMO runs with a plan, after one with guidance every minute
    plan_file: SCENARIO/plan.csv.gz if None; it is `table.attrs["plan"]`
    out: run folder, runs/SCENARIO-plan if None; it is `table.attrs["folder"]`
    others: as in `run` and `evaluate`

    The table has a row per iteration (cosim.evaluation.plan_routes). The same call continues after
    an interruption. Raises: InputError, and RunFailed if a run failed
    """
    from cosim.evaluation import plan_routes

    one = loaded(scenario)
    if plan_file is None:
        folder = one.folder or Path()
        plan_file = shipped.beside(folder, PLAN, "--plan-file FILE", scenario=True)
    order = plan_routes.Planning(
        scenario=one,
        strategy=parse(controller, city),
        out=folder_of(one.name, "plan", out),
        demand=checked_factor(demand),
        seed=seed,
        iterations=iterations,
    )
    table = plan_routes.plan_routes(
        order, Path(plan_file), time_limit=time_limit, overwrite=overwrite, progress=progress
    )
    table.attrs["plan"] = str(plan_file)
    table.attrs["folder"] = str(order.out)
    return table


def study(
    source: Path | str,
    *,
    regions: int | Path | str = "auto",
    routes: Sequence[Path | str] = (),
    counts: Path | str | None = None,
    most_seeds: int = 10,
    out: Path | str | None = None,
    workers: int = 1,
) -> "Study":
    """Study whether gates, guidance or other signals would help in a city.

    source: sumocfg, net.xml or file of OpenStreetMap; or a scenario, by name or folder
    regions: number of regions of an import, "auto", or a table edge,region
    routes: files with vehicles beside those of the source
    counts: edgeData of SUMO, of which trips are made for a source without demand
    most_seeds: seeds of a strategy whose verdict is open; all have three
    out: folder of import, runs and page, runs/NAME-study if None
    workers: runs at a time

    The same call continues after an interruption. Raises: InputError, and RunFailed if a run failed
    """
    from cosim.studying.conduct import conducted

    return conducted(
        Path(source),
        regions=str(regions),
        routes=[Path(file) for file in routes],
        counts=path_of(counts),
        most_seeds=most_seeds,
        out=path_of(out),
        workers=workers,
    )


def get(name: str | None, out: Path | str | None = None) -> str:
    """Download a published city; without a name list them.

    out: folder, cities/NAME if None
    """
    if name is None:
        return cities.listed()
    return cities.get(name, Path("cities", name) if out is None else Path(out))


def mfd(
    net: Path | str,
    edge_data: Path | str | Sequence[Path | str],
    *,
    regions: int | Path | str = "auto",
    out: Path | str | None = None,
) -> "EdgeMfds":
    """Fit MFDs of regions to SUMO's edgeData, and write them.

    net: network of SUMO
    edge_data: what SUMO wrote, one file for each run
    regions: their number, "auto", or a table edge,region
    out: folder of regions, samples, fits and picture, runs/NAME-mfd if None

    Raises: InputError
    """
    from cosim.importing.edge_mfds import edge_mfds

    net = Path(net)
    folder = folder_of(net.name.partition(".")[0], "mfd", out)
    return edge_mfds(net, _paths(edge_data), str(regions), folder)


def links(
    scenario: ScenarioLike,
    out: Path | str | None = None,
    *,
    seeds: Sequence[int] = PLANNING_SEEDS,
    numbers: "Numbers | None" = None,
) -> Path:
    """Write the streets of a city for nmfd.LinkPlant; return the file.

    out: file, SCENARIO/links.npz if None
    seeds: of the draws of trips, if these are not recorded
    numbers: calibration, such as those of `fit_links`
    """
    from cosim.evaluation.links import write_links

    return write_links(loaded(scenario), path_of(out), seeds, numbers)


def fit_links(runs: Path | str, *, progress: Progress = None) -> "Fit":
    """Fit the numbers of the link model to finished runs in SUMO.

    runs: folder of `cosim run` or `cosim evaluate`
    Raises: InputError if the model can repeat none of them
    """
    from cosim.evaluation.link_fit import fit
    from cosim.evaluation.results import read

    return fit(read(Path(runs)), progress)


def catalogue() -> dict[str, dict[str, str]]:
    """Return what is shipped, controllers, and words, with a line each."""
    words = strategies_of.vocabulary()
    return regional_catalogue() | {"Words behind a controller, for a city": words}


def _paths(files: Path | str | Sequence[Path | str]) -> list[Path]:
    given = [files] if isinstance(files, str | Path) else files
    return [Path(file) for file in given]


def _reference_first(strategies: Sequence[Strategy]) -> list[Strategy]:
    """Return the strategies, the one that others are compared with first.

    It is no control, else the last one.
    """
    turned = list(reversed(strategies))
    return sorted(turned, key=lambda strategy: strategy.name != REFERENCE)


def _has_screen() -> bool:
    """Return True if there are a screen for a browser and a terminal."""
    screen = not sys.platform.startswith("linux")
    screen |= "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    return screen and sys.stdout.isatty()
