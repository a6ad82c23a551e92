"""Python interface of `cosim`: a function for every command, and single runs.

Bokeh and Optuna are imported in the functions that need them: they take a second.
"""

import os
import sys
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from cosim.evaluation import evaluate as evaluation
from cosim.evaluation import model_validation, results, statistics
from cosim.evaluation.identify import identify as identify
from cosim.evaluation.runs import runs_of
from cosim.evaluation.signal_proof import sheets
from cosim.evaluation.simulate import Simulation, simulate
from cosim.importing import get as cities
from cosim.importing.importer import import_city as import_city
from cosim.report import figures
from nmfd.api import check_policies, load_scenario
from nmfd.controllers.strategy import Strategy, parse, parse_many
from nmfd.errors import InputError, RunFailed
from nmfd.metrics import summary
from nmfd.model.scenario import Scenario, with_demand
from nmfd.runs.files import default_folder, file_name, write_table
from nmfd.runs.progress import Progress, watched
from nmfd.runs.run_many import locked, raise_failures, run_many
from nmfd.studies.benchmark import REFERENCE, draw_accumulations
from nmfd.types import Controller, Result

DEMO = "demo"  # a shipped scenario


def run(
    scenario: Scenario | Path | str,
    controller: str | Controller,
    *,
    seed: int = 0,
    steps: int | None = None,
    demand: float = 1.0,
    policy: Path | str | None = None,
    city: str = "",
    tripinfo: Path | str | None = None,
    progress: Progress = None,
) -> Result:
    """Run one closed loop in SUMO, in this process and without a run folder.

    scenario: shipped name, folder of a scenario.toml, or result of nmfd.load_scenario
    controller: strategy by name, or an object with `reset` and `act` (nmfd.Controller)
    seed: of trips, drivers and guidance; the same seed gives the same result, but for wall times
    steps: control intervals; the scenario's if None
    demand: multiple of the scenario's demand
    policy: policy file, if not SCENARIO/NAME.pt
    city: words of the strategy for a controller object, such as "max-pressure+rerouting-30"
    tripinfo: file for SUMO's own output of trips; all others are options of SUMO in [sumo.options]
    progress: None for a bar, False for none, or a function of done and total control intervals

    The result has the arrays of cosim.plant.record.RECORD, and the facts of
    cosim.evaluation.simulate as attributes.
    Raises: InputError for a wrong name, file or value, RuntimeError if another simulation is open
    in this process

        >>> result = cosim.run("grid7_peak", "pi-gating+rerouting-30", seed=3, steps=2)
        >>> result.accumulation.shape, result.crossings.shape
        ((3, 7, 7), (2, 7, 7, 7))
    """
    strategy = parse(controller, city)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    if not 0.0 < demand <= 10.0:
        raise InputError(f"demand: expected a number above 0 up to 10, got {demand:g} instead")
    policy, tripinfo = (None if file is None else Path(file) for file in (policy, tripinfo))
    with watched(strategy.name, progress) as show:
        job = Simulation(
            with_demand(scenario, steps=steps), strategy, seed, demand, policy, tripinfo
        )
        return simulate(job, progress=show)


def run_controllers(
    scenario: Path | str,
    controllers: Sequence[str],
    *,
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    steps: int | None = None,
    demand: float = 1.0,
    policy: Path | None = None,
    out: Path | None = None,
) -> str:
    """Run strategies on the same trips with a run folder, two at a time; return a report.

    settings: see nmfd.load_scenario; other arguments as in `run`
    policy: policy file of the first controller, if not SCENARIO/NAME.pt
    out: run folder, runs/SCENARIO-TIME if None
    Raises: InputError, and RunFailed if a run failed
    """
    loaded = with_demand(load_scenario(scenario, settings), steps=steps)
    strategies = _reference_first(controllers)
    policies = {} if policy is None else {parse(controllers[0]).name: policy}
    out = default_folder(loaded.name) if out is None else out
    runs = runs_of(loaded, strategies, [seed], demand=demand, policies=policies)
    with locked(out):
        raise_failures(run_many(runs, out, workers=2))
        finished = results.read(out)
        there = [run for level in finished.levels for run in level.results()]
        draw_accumulations(out, loaded, there)
        write_table(out / "signals.csv", sheets(there), float_format="%g")
    wrong = [
        f"{run.controller}: signals break their rules {run.signal_violations} times, see {out / 'signals.csv'}"
        for run in there
        if run.signal_violations
    ]
    return "\n".join(
        [
            statistics.text(finished.rows),
            *wrong,
            f"Written to {out}; a page about it: cosim report {out}",
        ]
    )


def demo(out: Path, *, seed: int = 1000) -> str:
    """Run the demo city with and without gates, write a page and open it; return a report."""
    from cosim.report import html

    scenario, strategies = load_scenario(DEMO), [parse("no-control"), parse("pi-gating")]
    with locked(out):
        rows = run_many(runs_of(scenario, strategies, [seed]), out, workers=2)
        raise_failures(rows)
        lines = [
            f"{row['controller'] + ':':12} {row['completed_veh']:,.0f} of {row['trips']:,.0f} trips completed, "
            f"{row['mean_trip_time_s'] / 60:.1f} minutes per trip"
            for row in rows[rows["seed"] == seed].to_dict("records")
        ]
        page = html.write_page(out / "report.html", [results.read(out)], seed=seed).resolve()
    if _has_screen():
        webbrowser.open(page.as_uri())
    return "\n".join(
        [*lines, f"Both side by side: {page}; next: cosim watch {DEMO} --controller pi-gating"]
    )


def watch(
    scenario: Path | str,
    controllers: Sequence[str],
    *,
    settings: Mapping[str, Any] | None = None,
    seed: int = 0,
    demand: float = 1.0,
    port: int = 0,
    gui: bool = False,
) -> str:
    """Show runs on a live page, or one run in sumo-gui, until they end and the page is closed;
    return their outcomes.

    port: of the page, any that is free if 0; the other arguments as in `run_controllers`
    """
    from cosim.view import live

    loaded = load_scenario(scenario, settings)
    jobs = [
        Simulation(loaded, strategy, seed, demand) for strategy in _reference_first(controllers)
    ]
    if gui:
        try:
            with watched("watch", None) as show:
                rows = {jobs[0].strategy.name: summary(simulate(jobs[0], progress=show, gui=True))}
        except RunFailed:
            return "The window was closed before the end."
    else:
        runs = live.watch(jobs, port=port, browse=_has_screen())
        rows = {run.name: run.row for run in runs if run.row is not None}
    return "\n".join(
        f"{name}, seed {seed}: total time spent {row['total_time_spent_veh_s']:.4g} veh s, "
        f"{row['completed_veh']:,.0f} trips completed"
        for name, row in rows.items()
    )


def evaluate(
    scenario: Path | str,
    controllers: Sequence[str],
    *,
    seeds: Sequence[int] | None = None,
    settings: Mapping[str, Any] | None = None,
    levels: Sequence[float] = (1.0,),
    steps: int | None = None,
    policies: Mapping[str, Path] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    check: int | None = None,
    out: Path | None = None,
) -> str:
    """Run controllers x seeds x demand levels in SUMO, write tables and figures, and return the
    tables as text.

    scenario: a scenario, or the file of a suite (cosim.evaluation.evaluate), which has its own
        seeds and levels
    controllers: strategies, or patterns such as "dpc-*"
    seeds: 2000 to 2009 if None
    settings: see nmfd.load_scenario; of every scenario of a suite
    levels: multiples of the scenario's demand
    policies: files by controller, if not SCENARIO/NAME.pt
    workers: runs at a time on this machine
    scheduler: address of a Dask scheduler that does the runs instead
    check: do only so many random runs of `out` again, and compare
    out: folder, runs/SCENARIO-evaluate if None
    Raises: InputError, and RunFailed if runs failed
    """
    if Path(scenario).suffix == ".toml":
        chosen, seeds = evaluation.read_suite(Path(scenario), settings)
    else:
        chosen = [(load_scenario(scenario, settings), levels)]
    chosen = [(with_demand(loaded, steps=steps), each) for loaded, each in chosen]
    strategies = parse_many(controllers, chosen[0][0])
    check_policies(policies or {}, strategies)
    seeds = list(range(2000, 2010) if seeds is None else seeds)
    name = Path(scenario).stem if len(chosen) > 1 else chosen[0][0].name
    out = out or Path("runs") / f"{file_name(name)}-evaluate"
    runs = evaluation.plan(chosen, strategies, seeds, policies)
    if check is not None:
        lines = evaluation.check(runs, out, check, workers=workers)
        return (
            "\n".join(lines) or f"{min(check, len(runs))} runs of {out} done again: no difference"
        )
    with locked(out):
        rows = evaluation.evaluate(runs, out, workers=workers, scheduler=scheduler)
        text = []
        for each in dict.fromkeys(results.finished_rows(rows).get("scenario", ())):
            finished = results.read(out, each)
            figures.draw_all(finished)
            text += [each] * (len(chosen) > 1) + [statistics.text(finished.rows)]
    raise_failures(rows)
    return "\n".join(
        [*text, f"Written to {out}: see evaluate.md and the figures; a page: cosim report {out}"]
    )


def compare(folder: Path) -> str:
    """Compare finished runs with what the regional model predicts; write a table and figures beside
    them."""
    finished = results.read(folder)
    with locked(folder):
        rows = model_validation.compare(finished)
        write_table(folder / "foresight.csv", rows, float_format="%.6g")
    where = f"Written to {folder}: see foresight.csv and the figures"
    return f"{model_validation.prediction_table(rows)}\n{where}; large errors: cosim identify {finished.scenario.name}"


def report(folders: Sequence[Path], *, seed: int | None = None, out: Path | None = None) -> Path:
    """Write one HTML page about finished runs and return its path; seed: of the runs on the map."""
    from cosim.report import html

    runs = [results.read(folder) for folder in folders]
    with locked(folders[0]) if out is None else nullcontext():
        return html.write_page(out or folders[0] / "report.html", runs, seed=seed)


def tune(
    scenario: Path | str,
    controller: str,
    *,
    options: Mapping[str, tuple[float, float]],
    settings: Mapping[str, Any] | None = None,
    seeds: int | Sequence[int] = 2,
    steps: int | None = None,
    workers: int = 1,
    out: Path | None = None,
    **how: Any,
) -> str:
    """Search the options of a controller in SUMO by CMA-ES; return the best ones as text.

    options: KEY, or KEY[N] for one number of a list, -> (low, high)
    seeds: runs per candidate and demand level, from seed 1000, or the seeds
    how: trials, levels and search_seed of cosim.evaluation.tuning.Tuning
    """
    from cosim.evaluation import tuning

    loaded = with_demand(load_scenario(scenario, settings), steps=steps)
    numbers = range(1000, 1000 + seeds) if isinstance(seeds, int) else list(seeds)
    out = out or Path("runs") / f"{file_name(loaded.name)}-tune"
    order = tuning.Tuning(
        scenario=loaded, strategy=parse(controller), options=options, seeds=numbers, out=out, **how
    )
    tuning.tune(order, workers=workers)
    best = (out / "tune.toml").read_text(encoding="utf-8")
    return f"{best}Written to {out}: see tune.csv; to use the options, copy tune.toml into the scenario.toml"


def get(name: str | None, out: Path | None = None) -> str:
    """Download a published city to a folder, cities/NAME if None; without a name list the
    cities."""
    return cities.listed() if name is None else cities.get(name, out or Path("cities") / name)


def _reference_first(controllers: Sequence[str]) -> list[Strategy]:
    """Return the strategies, first no control, else the last one: the others are compared with
    it."""
    strategies = [parse(name) for name in reversed(dict.fromkeys(controllers))]
    return sorted(strategies, key=lambda strategy: strategy.name != REFERENCE)


def _has_screen() -> bool:
    """Return True if a browser may be opened: there is a screen and a terminal."""
    screen = (
        not sys.platform.startswith("linux")
        or "DISPLAY" in os.environ
        or "WAYLAND_DISPLAY" in os.environ
    )
    return screen and sys.stdout.isatty()
