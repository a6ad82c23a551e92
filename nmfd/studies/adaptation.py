"""Adaptation: a city that is not the one that controllers were made for, and who copes with it.

Every controller is made for the nominal scenario and then meets, on the regional model, another demand or other MFDs,
which nobody tells it of.
"""

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nmfd import closed_loop
from nmfd.controllers import registry
from nmfd.errors import InputError, did_you_mean
from nmfd.metrics import summary
from nmfd.model.scenario import Scenario
from nmfd.runs import files, run_folder
from nmfd.runs.tables import text_table
from nmfd.runs.workers import Failure, ended
from nmfd.studies.benchmark import PLANTS, REFERENCE, configuration, results

RAIN = 0.8  # of the outflow at every accumulation
MORE = 1.2  # times the demand
LATER = 600.0  # s
CASES = {
    "nominal": "as planned",
    "more": "20 % more demand",
    "one-origin": "50 % more demand from the busiest origin",
    "later": "all demand ten minutes later",
    "rain": "capacity minus 20 % in every region",
}
COLUMNS = {
    "case": str,
    "seed": int,
    "controller": str,
    "total_time_spent_veh_s": float,
    "final_accumulation_veh": float,
    "control_step_ms_median": float,
    "control_step_ms_max": float,
    "fallbacks": int,
}
CAPTION = (
    "TTS: total time spent, mean over seeds; change: against the first controller but no-control; decision: median / "
    "longest; nothing of a case is told to a controller:\n"
    + "\n".join(f"  {name}: {what}" for name, what in CASES.items())
)


class Run(NamedTuple):
    """One closed loop; `seed` of the measurement noise."""

    case: str
    seed: int
    controller: str


def changed(scenario: Scenario, case: str) -> Scenario:
    """`scenario` as it comes in `case`, one of CASES."""
    demand = scenario.demand
    if case == "more":
        return replace(scenario, demand=MORE * demand)
    if case == "one-origin":
        factor = np.ones((1, scenario.network.regions, 1))
        factor[0, demand.sum(axis=(0, 2)).argmax()] = 1.5
        return replace(scenario, demand=factor * demand)
    if case == "later":
        late = min(round(LATER / scenario.step), scenario.steps)
        return replace(scenario, demand=np.concatenate([np.zeros_like(demand[:late]), demand[: len(demand) - late]]))
    if case == "rain":
        network = scenario.network
        wet = tuple(replace(m, a=RAIN * m.a, b=RAIN * m.b, c=RAIN * m.c) for m in network.mfds)
        capacity = None if network.capacity is None else RAIN * network.capacity
        return replace(scenario, network=replace(network, mfds=wet, capacity=capacity))
    return scenario


def run_one(
    run: Run,
    *,
    scenario: Scenario,
    plant: str,
    policies: Mapping[str, Path],
    progress: Callable[[int, int], None] | None = None,
) -> dict:
    """The row of `run` in adaptation.csv, on one thread."""
    actual = changed(scenario, run.case)
    controller = registry.make(run.controller, scenario, policy=policies.get(run.controller))
    row = summary(closed_loop.run(PLANTS[plant](actual), controller, actual, seed=run.seed, progress=progress))
    return {
        "case": run.case,
        "seed": run.seed,
        "controller": run.controller,
        "fallbacks": row["fallbacks"],
        **{name: row[name] for name in COLUMNS if name in row and name not in ("seed", "controller")},
    }


def adaptation(
    scenario: Scenario,
    controllers: Sequence[str],
    cases: Sequence[str],
    seeds: Sequence[int],
    *,
    out: Path,
    plant: str = "nmfd",
    policies: Mapping[str, Path] | None = None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[dict]:
    """Run what is not yet in `out`/adaptation.csv, and return all its rows, which are kept as they come.

    Raises InputError, before anything is written, for an unknown case and a controller that cannot be made; RunFailed
    at the end if runs failed.
    """
    policies = policies or {}
    for case in cases:
        if case not in CASES:
            raise InputError(f"--cases: {case!r} is unknown{did_you_mean(case, CASES)}; choose from {', '.join(CASES)}")
    for name in controllers:
        registry.verify(name, scenario, policy=policies.get(name))
    common, settings = configuration(scenario, controllers, plant, policies)
    wanted = [Run(case, seed, name) for case in cases for seed in seeds for name in controllers]
    file, failures = out / "adaptation.csv", []
    with run_folder.manifest(
        out,
        configuration=common,
        controllers=settings,
        results=file,
        session={"scenario_folder": str(scenario.folder), "workers": workers},
    ):
        rows = {_run(row): row for row in (files.read_rows(file, COLUMNS) if file.is_file() else [])}
        todo = [run for run in wanted if run not in rows]
        work = partial(run_one, scenario=scenario, plant=plant, policies=policies)
        for run, outcome in results(work, todo, workers, scenario.steps, progress, label=_label):
            if isinstance(outcome, Failure):
                failures.append((_label(run), outcome))
            else:
                rows[run] = outcome
                files.write_rows(file, COLUMNS, list(rows.values()))
    if failures:
        raise ended(failures)
    return list(rows.values())


def _label(run: Run) -> str:
    return f"{run.case}, seed {run.seed}, {run.controller}"


def _run(row: Mapping) -> Run:
    return Run(row["case"], row["seed"], row["controller"])


def adaptation_table(rows: Sequence[Mapping]) -> str:
    """Means over the seeds as text: one line per case and controller."""
    groups: dict[tuple[str, str], list[Mapping]] = {}
    for row in rows:
        groups.setdefault((row["case"], row["controller"]), []).append(row)
    lines = []
    for case in dict.fromkeys(case for case, _ in groups):
        names = [name for there, name in groups if there == case]
        mean = {name: statistics.fmean(r["total_time_spent_veh_s"] for r in groups[case, name]) for name in names}
        first = next((name for name in names if name != REFERENCE), names[0])
        for name in names:
            group = groups[case, name]
            change = "" if name == first or not mean[first] else f"{100 * (mean[name] / mean[first] - 1):+.1f} %"
            lines.append(
                {
                    "case": case,
                    "controller": name,
                    "seeds": len(group),
                    "TTS [veh s]": f"{mean[name]:.4g}",
                    "change": change,
                    "final [veh]": f"{statistics.fmean(r['final_accumulation_veh'] for r in group):,.0f}",
                    "decision [ms]": f"{statistics.fmean(r['control_step_ms_median'] for r in group):.3g} / "
                    f"{max(r['control_step_ms_max'] for r in group):.3g}",
                }
            )
    return text_table(lines, CAPTION)
