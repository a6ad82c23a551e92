"""Python interface of `cosim`: a function for every command, and single runs."""

import os
import sys
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from cosim.evaluation import (
    estimation_errors,
    experiment,
    model_validation,
    results,
    statistics,
    tuning,
)
from cosim.evaluation import evaluate as evaluation
from cosim.evaluation import identify as identification
from cosim.evaluation.simulate import Result, Task, drive, scenario_of, simulate
from cosim.importing import get as cities
from cosim.importing import importer
from cosim.importing.case import parse_box, seconds
from cosim.report import card, figures, html
from cosim.sumo.outputs import check, paths
from cosim.sumo.session import LOST, Window
from cosim.view import live
from nmfd.api import check_policies, load_scenario
from nmfd.controllers.strategy import parse, parse_many
from nmfd.errors import InputError, RunFailed
from nmfd.metrics import summary
from nmfd.model.scenario import Scenario, with_demand
from nmfd.runs.files import default_folder, file_name, write_table
from nmfd.runs.progress import Progress, watched
from nmfd.types import Controller

DEMO = Path("demo")  # a shipped scenario


def run(
    scenario: Scenario | Path | str,
    controller: str | Controller,
    *,
    seed: int = 0,
    steps: int | None = None,
    demand_factor: float = 1.0,
    policy: Path | str | None = None,
    city: str = "",
    sumo_output: Mapping[str, Path | str] | None = None,
    progress: Progress = None,
) -> Result:
    """One closed loop in SUMO, in this process and without a run folder.

        >>> result = cosim.run("grid7_peak", "pi-gating+rerouting-30", seed=3, steps=2)
        >>> result.accumulation.shape, result.crossings.shape
        ((3, 7, 7), (2, 7, 7, 7))
        >>> int(result.teleports.sum())
        0

    scenario: a name of `cosim list`, the folder of a scenario.toml, or what nmfd.load_scenario made of it
    controller: a strategy as on the command line, or an object with `reset` and `act` (nmfd.Controller)
    seed: of the trips, the drivers and the guidance
    steps: control intervals; the scenario's if None
    demand_factor: multiplies all flows
    policy: of a DPC controller by name, if not SCENARIO/NAME.pt
    city: what else the city does, with a controller that is an object: "max-pressure+rerouting-30"
    sumo_output: files of SUMO's own outputs: {"tripinfo": "trips.xml"}, also summary, edgedata, emission
    progress: None for a bar in a notebook or on a terminal, False for none, or your own, which is called as
        progress(done, steps) after every control interval

    The result holds the arrays of cosim.plant.record.Record too, and the columns of sumo.csv as attributes. The same seed gives the same result, but for wall times. Raises InputError, and RuntimeError while
    another simulation is open in this process.
    """
    strategy = parse(controller, city)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    if steps is not None and steps < 1:
        raise InputError(f"steps: expected 1 or more control intervals, got {steps} instead")
    if not 0.0 < demand_factor <= 10.0:
        raise InputError(f"demand_factor: expected a number above 0 up to 10, got {demand_factor:g} instead")
    scenario = with_demand(scenario, steps=steps, factor=demand_factor)
    outputs = {kind: Path(file) for kind, file in (sumo_output or {}).items()}
    check(outputs)
    with watched(strategy.name, progress) as show:
        return drive(
            scenario,
            strategy,
            strategy.make(scenario, None if policy is None else Path(policy)),
            seed=seed,
            progress=show,
            outputs=outputs,
            planning=strategy.planning(scenario),
        )


def run_tasks(
    tasks: Task | Sequence[Task],
    *,
    out: Path | str,
    workers: int = 1,
    progress: Progress = None,
    tell: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Closed loops in SUMO with a run folder: those that are not yet in `out`; returns a row for every run there.

    Columns: those of summary.csv and sumo.csv, with units in their names; progress: as in `run`, and called as
    progress(done, tasks, what); tell: takes one line where the runs of a controller do not count any more because it
    changed, None: an InputError. Raises InputError, and nmfd.runs.workers.RunFailed at the end if runs failed.
    """
    with watched("cosim", progress) as show:
        return experiment.experiment(
            [tasks] if isinstance(tasks, Task) else list(tasks),
            out=Path(out),
            workers=workers,
            progress=show,
            tell=tell,
        )


def read_run(folder: Path | str, controller: str, seed: int) -> Result:
    """Return a finished run of a run folder. Raises InputError."""
    return experiment.read_run(Path(folder), controller, seed)


def run_controllers(
    scenario: Path,
    controllers: Sequence[str],
    *,
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    steps: int | None = None,
    demand: float = 1.0,
    policy: Path | None = None,
    sumo_output: Sequence[str] | None = None,
    out: Path | None = None,
) -> str:
    """Run strategies on the same trips with a run folder, two at a time; return a report.

    settings: see nmfd.load_scenario
    seed: of trips, drivers and guidance
    steps: control intervals; the scenario's if None
    demand: factor on the demand
    policy: policy file of the first controller, if not SCENARIO/NAME.pt
    sumo_output: kinds of SUMO's own outputs to write (cosim.sumo.outputs)
    out: run folder, runs/SCENARIO-TIME if None

    Raises:
        InputError: if a file, name or value is wrong
        RunFailed: if a run failed
    """
    names = list(dict.fromkeys(controllers))
    if "no-control" not in names:
        names.reverse()  # the other controllers are compared with the first one
    for name in names:
        parse(name)
    folder = default_folder(load_scenario(scenario, settings).name) if out is None else out
    tasks = [
        Task(
            scenario=scenario,
            settings=tuple((settings or {}).items()),
            controller=name,
            seed=seed,
            policy=policy if name == controllers[0] else None,
            steps=steps,
            demand_factor=demand,
            sumo_output=paths(tuple(sumo_output or ()), folder, name, seed),
        )
        for name in names
    ]
    rows = run_tasks(tasks, out=folder, workers=2, tell=_say)
    lines = [experiment.overview_table(rows)]
    if (folder / "estimation.csv").is_file():
        lines.append(estimation_errors.error_table(pd.read_csv(folder / "estimation.csv")))
    return "\n".join([*lines, f"Written to {folder}"])


def demo(out: Path, *, seed: int = 1000) -> str:
    """Run the demo city with and without gates, write a page and open it; return a report."""
    names = ("no-control", "pi-gating")
    rows = run_tasks([Task(scenario=DEMO, controller=name, seed=seed) for name in names], out=out, workers=2, tell=_say)
    lines = []
    for name in names:
        [row] = rows[(rows["controller"] == name) & (rows["seed"] == seed)].to_dict("records")
        lines.append(
            f"{name + ':':12} {row['completed_veh']:,.0f} of {row['trips']:,.0f} trips completed, "
            f"{card.minutes_per_trip(row):.1f} minutes per trip"
        )
    page = html.write_page(out / "report.html", [results.read(out)], seed=seed)
    if _has_screen():
        webbrowser.open(page.resolve().as_uri())
    return "\n".join([*lines, f"Both side by side: {page.resolve()}"])


def watch(
    scenario: Path,
    controllers: Sequence[str],
    *,
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    demand: float = 1.0,
    port: int = 0,
    gui: bool = False,
) -> str:
    """Show runs on a live page, or one run in sumo-gui, until they end and nobody looks; return their outcomes.

    port: of the page, any that is free if 0; the other arguments as in `run_controllers`
    """
    tasks = [
        Task(
            scenario=scenario,
            settings=tuple((settings or {}).items()),
            controller=name,
            seed=seed,
            demand_factor=demand,
        )
        for name in dict.fromkeys(controllers)
    ]
    for task in tasks:
        parse(task.controller)  # reports mistakes before anything starts
    scenario_of(tasks[0])
    if gui:
        window = Window(options=("--start", "true", "--quit-on-end", "true", "--delay", "20"))
        try:
            with watched("watch", None) as show:
                rows = {tasks[0].controller: summary(simulate(tasks[0], show, window=window))}
        except LOST:
            return "The window was closed before the end."
    else:
        rows = {run.name: run.row for run in live.watch(tasks, port=port, browse=_has_screen(), tell=_say)}
    return "\n".join(
        f"{name}, seed {seed}: total time spent {row['total_time_spent_veh_s']:.4g} veh s, "
        f"{row['completed_veh']:,.0f} trips completed"
        for name, row in rows.items()
    )


def evaluate(
    scenario: Path,
    controllers: Sequence[str],
    *,
    seeds: Sequence[int],
    settings: Mapping[str, Any] | None = None,
    levels: Sequence[float] = (1.0,),
    steps: int | None = None,
    policies: Mapping[str, Path] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    out: Path | None = None,
) -> str:
    """Run controllers x seeds x demand levels in SUMO, write tables and figures, and return the table as text.

    controllers: strategies, or patterns such as "dpc-*"
    levels: factors on the demand
    policies: files by controller, if not SCENARIO/NAME.pt
    workers: runs at a time on this machine
    scheduler: address of a Dask scheduler that does the runs instead
    out: folder, runs/SCENARIO-evaluate if None

    Raises:
        InputError: if a file, name or value is wrong
        RunFailed: if runs failed
    """
    loaded = load_scenario(scenario, settings)
    strategies = parse_many(controllers, loaded, regional=False)
    check_policies(policies or {}, strategies)
    order = evaluation.Evaluation(
        scenario=scenario,
        settings=tuple((settings or {}).items()),
        controllers=tuple(strategy.name for strategy in strategies),
        seeds=seeds,
        levels=tuple(levels),
        steps=steps,
        policies=policies or {},
        out=Path("runs") / f"{file_name(loaded.name)}-evaluate" if out is None else out,
    )
    with watched("evaluate", None) as show:
        table, failures = evaluation.evaluate(order, workers=workers, scheduler=scheduler, progress=show, tell=_say)
        if len(table):
            figures.draw_all(results.read(order.out, scenario))
    if failures:
        raise RunFailed(f"{len(failures)} runs failed, and the same command tries them again: {'; '.join(failures)}")
    return f"{statistics.text(table)}\nWritten to {order.out}: see evaluate.md, pairs.csv and the figures"


def compare(folder: Path, *, controller: str | None = None, seed: int | None = None, model: Path | None = None) -> str:
    """Compare finished runs with what the regional model predicts; write tables and figures beside them.

    controller, seed: of one run; all runs of the folder if None
    model: folder of the network that predicts, the controller's model if None
    """
    if controller is None:
        rows = model_validation.prediction_errors(results.read(folder), model)
        write_table(folder / "foresight.csv", rows, float_format="%.6g")
        return f"{model_validation.prediction_table(rows)}\nWritten to {folder / 'foresight.csv'}"
    found = results.read(folder)
    if found.evaluation:
        raise InputError(f"{folder}: has a run folder for every demand level; give one of them, or omit --controller")
    result = experiment.read_run(folder, controller, seed or 0)
    steps, factor = (found.levels[0].manifest["configuration"][key] for key in ("steps", "demand_factor"))
    scenario = with_demand(found.scenario, steps=steps, factor=factor)
    scenario = replace(scenario, network=parse(controller).planning(scenario, model).network)
    rows = model_validation.write_comparison(folder, scenario, result)
    return f"{model_validation.error_table(rows)}\nWritten to {folder}"


def report(folders: Sequence[Path], *, seed: int | None = None, out: Path | None = None) -> Path:
    """Write one HTML page about finished runs and return its path.

    seed: of the runs on the map, the first of both if None
    """
    found = [results.read(folder) for folder in folders]
    with watched("report", None) as show:
        return html.write_page(out or folders[0] / "report.html", found, seed=seed, progress=show)


def tune(
    scenario: Path,
    controller: str,
    *,
    knobs: Sequence[str],
    settings: Mapping[str, Any] | None = None,
    candidates: int = 40,
    seeds: int = 2,
    levels: Sequence[float] = (1.0,),
    workers: int = 1,
    scheduler: str | None = None,
    out: Path | None = None,
) -> str:
    """Search the options of a controller in SUMO; return the best ones as text.

    knobs: KEY=LOW:HIGH, an option and its range
    candidates: how many are tried, the scenario's own options first
    seeds: runs per candidate and demand level, from seed 1000
    """
    order = tuning.Tuning(
        scenario=scenario,
        settings=tuple((settings or {}).items()),
        controller=controller,
        knobs=tuple(tuning.knob(text) for text in knobs),
        candidates=candidates,
        seeds=range(1000, 1000 + seeds),
        levels=tuple(levels),
        out=Path("runs") / f"{file_name(load_scenario(scenario, settings).name)}-tune" if out is None else out,
    )
    with watched("tune", None) as show:
        table = tuning.tune(order, workers=workers, scheduler=scheduler, progress=show, tell=_say)
    return f"{tuning.text(order, table)}\nWritten to {order.out}: see tune.toml and tune.csv"


def get(name: str | None, out: Path | None = None) -> str:
    """Download a published city to a folder, cities/NAME if None; without a name list the cities."""
    return cities.listed() if name is None else cities.get(name, out or Path("cities") / name)


def import_city(
    source: Path | str,
    *,
    out: Path,
    regions: int | str,
    left_hand: bool = False,
    routes: Sequence[Path] = (),
    demand: str | None = None,
    level: float = 1.0,
    mesoscopic: bool = False,
    begin: str | None = None,
    end: str | None = None,
    seed: int = 0,
    force: bool = False,
) -> str:
    """Write network and scenario of a SUMO city; return a report.

    source: a sumocfg, a net, a file of OpenStreetMap, or a box "W,S,E,N" of it as text
    regions: number of regions to find, or the file of a table edge,region
    demand: "peak" generates a morning peak
    level: factor on the vehicles, or on the peak
    begin, end: time window, in seconds or as h:m:s
    """
    number = int(regions) if str(regions).isdecimal() else None
    if number is not None and number < 2:
        raise InputError(f"--regions: expected 2 or more regions, or a file, got {regions} instead")
    scenario = out.parent.parent / "scenarios" / out.name
    with watched("import", None) as show:
        text = importer.import_city(
            parse_box(source) if isinstance(source, str) else source,
            out,
            scenario,
            regions=number or Path(regions),
            left_hand=left_hand,
            routes=tuple(routes),
            peak=demand is not None,
            level=level,
            mesoscopic=mesoscopic,
            begin=None if begin is None else seconds(begin, "--begin"),
            end=None if end is None else seconds(end, "--end"),
            seed=seed,
            force=force,
            progress=lambda stage, share=0.0: show and show(round(100 * share), 100, stage),
        )
    return f"{text}\nWritten to {out} (see map.png, quality.csv, gateways.csv) and {scenario}"


def identify(
    scenario: Path,
    *,
    settings: Mapping[str, Any] | None = None,
    levels: Sequence[float] = (0.6, 0.8, 1.0),
    seeds: int = 2,
    city: str | None = None,
    network: Path | None = None,
    runs: Sequence[Path] = (),
    iterations: int = 600,
    workers: int = 1,
    scheduler: str | None = None,
    out: Path | None = None,
) -> str:
    """Fit the regional model of a SUMO city to loading runs and write its network.toml; return a report.

    scenario: a scenario or the folder of an imported network
    levels: factors on the demand of the loading runs
    seeds: loading runs per level, from seed 1000
    city: strategy options of the loading runs, such as "guided+max-pressure" or "own"; own, then guided, if None
    network: folder of the model, the scenario's network if None
    runs: folders of finished runs to fit as well
    """
    if (scenario / "network.toml").exists():
        scenario = scenario.resolve().parent.parent / "scenarios" / scenario.name
    loaded = load_scenario(scenario, settings)
    words = (city or "own").split("+")
    options = [word for word in words if word not in ("own", "guided")]
    kinds = [False, True] if city is None and network is None and identification.without_model(loaded) else []
    if len(kinds) > 1 and runs:
        raise InputError("--runs: fits one model; say which, by --with own or --with guided")
    report = []
    for guided in kinds or ["guided" in words]:
        suffix = "-guided" if guided else ""
        folder = Path("runs") / f"{file_name(loaded.name)}-identify{suffix}" if out is None else out
        if out is not None and len(kinds) > 1 and guided:
            folder = out / "guided"
        loading = identification.Loading(
            levels=levels,
            seeds=range(1000, 1000 + seeds),
            guided=guided,
            options=options,
            network=network,
            iterations=iterations,
            runs=runs,
        )
        with watched("identify", None) as show:
            text = identification.identify(
                scenario, loading, out=folder, workers=workers, scheduler=scheduler, progress=show, tell=_say
            )
        target = os.path.normpath(loading.target(loaded) / "network.toml")
        report += [text, f"Written to {target}; samples and figures to {folder}"]
    return "\n".join(report)


def _say(line: str) -> None:
    """Print a line on stderr, apart from results."""
    print(f"cosim: {line}", file=sys.stderr)


def _has_screen() -> bool:
    """Return whether a browser may be opened: there is a screen and a terminal."""
    screen = not sys.platform.startswith("linux") or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    return screen and sys.stdout.isatty()
