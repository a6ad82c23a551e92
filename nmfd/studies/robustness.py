"""Robustness: what controllers made for a scenario save when its demand comes out differently.

Every controller is made for the nominal scenario (MPC has its forecast, the policies their training) and meets
perturbed demand; its improvement is over no control in the same perturbed scenario.
"""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from nmfd.controllers import registry
from nmfd.metrics import percent_change, summary
from nmfd.model.scenario import Scenario
from nmfd.runs import files, run_folder
from nmfd.runs.tables import text_columns
from nmfd.runs.workers import Failure, ended
from nmfd.studies import benchmark, plots
from nmfd.studies.benchmark import REFERENCE, configuration, interval, results

COLUMNS = {
    "sigma_veh_per_s": float,
    "scenario": int,
    "controller": str,
    "trips_veh": float,
    "total_time_spent_veh_s": float,
    "final_accumulation_veh": float,
    "fallbacks": int,
}
CAPTION = (
    "improvement of total time spent over no-control in the same perturbed scenario [%], mean ± 95 % interval; "
    "trips: mean of all perturbed scenarios [veh]; sigma of the noise on the demand in veh/s"
)


class Run(NamedTuple):
    """One closed loop: `scenario` numbers the draw of the noise, on demand and measurements."""

    sigma: float
    scenario: int
    controller: str


def run_one(
    run: Run,
    *,
    scenario: Scenario,
    plant: str,
    where: str,
    policies: Mapping[str, Path],
    progress: Callable[[int, int], None] | None = None,
) -> dict:
    """The row of `run` in robustness.csv, on one thread."""
    noise = benchmark.Noise(run.sigma, where)
    row = summary(
        benchmark.run_one(
            (run.controller, run.scenario),
            scenario=scenario,
            plant=plant,
            policies=policies,
            noise=noise,
            progress=progress,
        )
    )
    actual = benchmark.happening(scenario, noise, run.scenario)
    return {
        "sigma_veh_per_s": run.sigma,
        "scenario": run.scenario,
        "controller": run.controller,
        "trips_veh": float(actual.step * actual.demand.sum()),
        "total_time_spent_veh_s": row["total_time_spent_veh_s"],
        "final_accumulation_veh": row["final_accumulation_veh"],
        "fallbacks": row["fallbacks"],
    }


def robustness(
    scenario: Scenario,
    controllers: Sequence[str],
    sigmas: Sequence[float],
    scenarios: int,
    *,
    where: str,
    out: Path,
    plant: str = "acyclic",
    policies: Mapping[str, Path] | None = None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[dict]:
    """Run what is not yet in `out`/robustness.csv, draw robustness.png, and return all rows.

    No control is run too, as the reference. Raises InputError, before anything is written, for a controller that
    cannot be made; RunFailed at the end if runs failed. Every finished run is kept.
    """
    policies, names = policies or {}, [REFERENCE, *(name for name in controllers if name != REFERENCE)]
    for name in names:
        registry.verify(name, scenario, policy=policies.get(name))
    common, settings = configuration(scenario, names, plant, policies)
    wanted = [Run(sigma, number, name) for sigma in sigmas for number in range(scenarios) for name in names]
    file, failures = out / "robustness.csv", []
    with run_folder.manifest(
        out,
        configuration={**common, "where": where},
        controllers=settings,
        results=file,
        session={
            "scenario_folder": str(scenario.folder),
            "workers": workers,
            "sigmas": list(sigmas),
            "scenarios": scenarios,
        },
    ):
        rows = {_run(row): row for row in (read(file) if file.is_file() else [])}
        todo = [run for run in wanted if run not in rows]
        work = partial(run_one, scenario=scenario, plant=plant, where=where, policies=policies)
        for run, outcome in results(work, todo, workers, scenario.steps, progress, label=_label):
            if isinstance(outcome, Failure):
                failures.append((_label(run), outcome))
            else:
                rows[run] = outcome
                files.write_rows(file, COLUMNS, [rows[run] for run in sorted(rows)])
        if rows:
            draw(out, [rows[run] for run in sorted(rows)])
    if failures:
        raise ended(failures)
    return [rows[run] for run in sorted(rows)]


def _label(run: Run) -> str:
    return f"sigma {run.sigma:g}, scenario {run.scenario}, {run.controller}"


def _run(row: Mapping) -> Run:
    return Run(row["sigma_veh_per_s"], row["scenario"], row["controller"])


def read(path: Path) -> list[dict]:
    """The rows of robustness.csv. Raises InputError."""
    return files.read_rows(path, COLUMNS)


def improvements(rows: Sequence[Mapping], controller: str) -> dict[float, tuple[float, float]]:
    """sigma -> mean and 95 % half interval of the improvement of `controller` over no control [%]."""
    reference = {_run(row)[:2]: row["total_time_spent_veh_s"] for row in rows if row["controller"] == REFERENCE}
    gains: dict[float, list[float]] = {}
    for row in rows:
        if row["controller"] == controller and _run(row)[:2] in reference:
            gain = -percent_change(row["total_time_spent_veh_s"], reference[_run(row)[:2]])
            gains.setdefault(row["sigma_veh_per_s"], []).append(gain)
    return {sigma: (statistics.fmean(values), interval(values)) for sigma, values in sorted(gains.items())}


def compared(rows: Sequence[Mapping]) -> list[str]:
    """The controllers in `rows` but no control, in the order of the registry, others behind."""
    there = dict.fromkeys(row["controller"] for row in rows)
    order = dict.fromkeys([*(name for name in registry.names() if name in there), *there])
    return [name for name in order if name != REFERENCE]


def trips(rows: Sequence[Mapping]) -> dict[float, float]:
    """sigma -> mean number of trips [veh]."""
    found: dict[float, list[float]] = {}
    for row in rows:
        if row["controller"] == REFERENCE:
            found.setdefault(row["sigma_veh_per_s"], []).append(row["trips_veh"])
    return {sigma: statistics.fmean(values) for sigma, values in sorted(found.items())}


def draw(folder: Path, rows: Sequence[Mapping]) -> Path:
    """Improvement and trips over sigma, as robustness.png in `folder`."""
    drawing = plots.figure(8.0, 6.4)
    upper, lower = drawing.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    plots.improvement(upper, {name: improvements(rows, name) for name in compared(rows)})
    plots.trips(lower, trips(rows))
    drawing.align_ylabels()
    plots.legend_below(drawing, [upper], columns=4)
    return plots.save(drawing, folder / "robustness.png")


def improvement_table(rows: Sequence[Mapping]) -> str:
    """Improvements as text: one line per controller, one column per sigma."""
    count = trips(rows)
    lines = [["trips", *(f"{total:,.0f}" for total in count.values())]]
    for name in compared(rows):
        gains = improvements(rows, name)
        defined = {s for s in gains if not math.isnan(gains[s][0])}
        lines.append([name, *("{:.1f} ± {:.1f}".format(*gains[s]) if s in defined else "-" for s in count)])
    return text_columns(["sigma", *(f"{sigma:g}" for sigma in count)], lines, CAPTION)
