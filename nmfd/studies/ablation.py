"""Ablations of what Tumu et al. claim: alternating training for route guidance, and the horizon of MPC.

Each is a list of independent runs whose rows are kept in csv files, with a figure over them.
"""

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from nmfd import closed_loop
from nmfd.controllers import registry
from nmfd.controllers.dpc import rollout, training
from nmfd.errors import InputError
from nmfd.metrics import summary
from nmfd.model.scenario import Scenario
from nmfd.runs import files, run_folder
from nmfd.runs.scratch import Scratch
from nmfd.runs.tables import text_table
from nmfd.runs.workers import Failure, ended
from nmfd.studies import plots, plots_studies
from nmfd.studies.benchmark import PLANTS, configuration, interval, results

METHODS = {"alternating": True, "joint": False}
VALIDATION_COLUMNS = {"method": str, "seed": int, "adam_step": int, "total_time_spent_veh_s": float}
TRAINING_COLUMNS = {
    "method": str,
    "seed": int,
    "adam_steps": int,
    "best_validation_veh_s": float,
    "total_time_spent_veh_s": float,
    "final_accumulation_veh": float,
}
HORIZON_COLUMNS = {
    "controller": str,
    "horizon": int,
    "total_time_spent_veh_s": float,
    "final_accumulation_veh": float,
    "control_step_ms_median": float,
    "control_step_ms_max": float,
    "solver_failures": int,
}


def train_one(
    run: tuple[str, int],
    *,
    scenario: Scenario,
    controller: str,
    plant: str,
    steps: int | None,
    compiled: bool,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, list[dict]]:
    """One training, `run` = (method, seed): its validations, and the closed loop of the best policy on `plant`."""
    method, seed = run
    table = {**scenario.controller_options.get(controller, {}), "alternating": METHODS[method]}
    changed = replace(scenario, controller_options={**scenario.controller_options, controller: table})
    curve: list[dict] = []

    def log(step: int, _: float, total: float) -> None:
        curve.append(dict(zip(VALIDATION_COLUMNS, (method, seed, step, total), strict=True)))

    with Scratch("nmfd-") as folder:
        policy = training.train(
            changed,
            controller,
            seed=seed,
            out=folder / "policy.pt",
            steps=steps,
            log=log,
            compiled=compiled,
            progress=progress and (lambda done, total, note: progress(done, total)),
        )
        driver = registry.make(controller, scenario, policy=policy)
        row = summary(closed_loop.run(PLANTS[plant](scenario), driver, scenario, seed=0))
    best = min(point["total_time_spent_veh_s"] for point in curve)
    return {
        "validation": curve,
        "training": [
            {
                "method": method,
                "seed": seed,
                "adam_steps": curve[-1]["adam_step"],
                "best_validation_veh_s": best,
                **{name: row[name] for name in ("total_time_spent_veh_s", "final_accumulation_veh")},
            }
        ],
    }


def drive_one(
    run: tuple[str, int], *, scenario: Scenario, plant: str, progress: Callable[[int, int], None] | None = None
) -> dict[str, list[dict]]:
    """The closed loop of one MPC, `run` = (controller, horizon), as a single row."""
    controller = registry.make(run[0], with_horizon(scenario, *run))
    row = summary(closed_loop.run(PLANTS[plant](scenario), controller, scenario, seed=0, progress=progress))
    known = {**row, "controller": run[0], "horizon": run[1]}
    return {"horizon": [{name: known[name] for name in HORIZON_COLUMNS}]}


def with_horizon(scenario: Scenario, controller: str, horizon: int) -> Scenario:
    """`scenario` with another horizon [control intervals] for `controller`."""
    table = {**scenario.controller_options.get(controller, {}), "horizon": horizon}
    return replace(scenario, controller_options={**scenario.controller_options, controller: table})


def alternating_or_joint(
    scenario: Scenario,
    seeds: Sequence[int],
    *,
    plant: str,
    out: Path,
    controller: str = "dpc-pcrg",
    steps: int | None = None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, list[dict]]:
    """Train `controller` both ways with every seed and drive `plant`; validation.csv, training.csv, training.png.

    Raises InputError for a controller without route guidance, RunFailed if trainings failed. Finished ones are kept.
    """
    chosen = training.settings(scenario, controller, steps)
    if not training.NAMES[controller]:
        raise InputError(f"--controller: {controller} has one decoder only; choose one with route guidance")
    training.check(scenario, controller)
    common, _ = configuration(scenario, [], plant, {})
    compiled = chosen.steps >= training.WORTH_COMPILING and rollout.can_compile()
    work = partial(train_one, scenario=scenario, controller=controller, plant=plant, steps=steps, compiled=compiled)
    todo = [(method, seed) for method in METHODS for seed in seeds]
    return _kept(
        out,
        work,
        todo,
        columns={"validation": VALIDATION_COLUMNS, "training": TRAINING_COLUMNS},
        workers=workers,
        length=chosen.steps,
        progress=progress,
        configuration={**common, "controller": controller, "adam_steps": chosen.steps, "compiled": compiled},
    )


def horizons(
    scenario: Scenario,
    controllers: Sequence[str],
    lengths: Sequence[int],
    *,
    plant: str,
    out: Path,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, list[dict]]:
    """Run MPC `controllers` with horizons of `lengths` control intervals; horizon.csv and horizon.png in `out`.

    Raises InputError for a controller without a horizon, RunFailed if runs failed. Finished runs are kept.
    """
    for name in controllers:
        if not name.startswith("mpc-"):
            raise InputError(f"--controllers: {name} has no horizon; choose from mpc-pc, mpc-pcrg")
    common, _ = configuration(scenario, [], plant, {})
    todo = [(name, length) for name in controllers for length in lengths]
    for run in todo:
        registry.make(run[0], with_horizon(scenario, *run))
    return _kept(
        out,
        partial(drive_one, scenario=scenario, plant=plant),
        todo,
        columns={"horizon": HORIZON_COLUMNS},
        workers=workers,
        length=scenario.steps,
        configuration=common,
        progress=progress,
    )


def _kept(
    out: Path,
    work: Callable,
    todo: Sequence[tuple[str, int]],
    *,
    columns: Mapping[str, Mapping[str, type]],
    workers: int,
    length: int,
    configuration: Mapping,
    progress: Callable[[int, int, str], None] | None,
) -> dict[str, list[dict]]:
    """All rows of `out`/<name>.csv, each of `columns`, after the runs `todo` = (what, number).

    The first two columns tell the run. The last file names the ablation, and what is in it is not run again.
    """
    *_, name = columns
    failures = []
    with run_folder.manifest(
        out,
        configuration={**configuration, "ablation": name},
        results=out / f"{name}.csv",
        session={"workers": workers},
    ):
        rows = {
            file: files.read_rows(out / f"{file}.csv", kinds) if (out / f"{file}.csv").is_file() else []
            for file, kinds in columns.items()
        }
        done = {_run(row) for row in rows[name]}
        missing = [run for run in todo if run not in done]
        for run, outcome in results(work, missing, workers, length, progress, label=lambda r: f"{r[0]} {r[1]}"):
            if isinstance(outcome, Failure):
                failures.append((f"{run[0]} {run[1]}", outcome))
                continue
            for file, kinds in columns.items():  # the last makes the run count: others may be there already
                kept = [row for row in rows[file] if _run(row) != run]
                rows[file] = sorted([*kept, *outcome[file]], key=lambda row: tuple(row.values())[:3])
                files.write_rows(out / f"{file}.csv", kinds, rows[file])
        if rows[name]:
            draw(out, rows)
    if failures:
        raise ended(failures)
    return rows


def _run(row: Mapping) -> tuple[str, int]:
    return tuple(row.values())[:2]


def draw(folder: Path, rows: Mapping[str, Sequence[Mapping]]) -> Path:
    """training.png or horizon.png in `folder`, of the rows by csv file."""
    drawing = plots.figure(10.0, 4.4)
    if "training" in rows:
        left, right = drawing.subplots(1, 2, width_ratios=(2, 1))
        plots_studies.training_curves(left, rows["validation"])
        plots_studies.trained(right, rows["training"])
        plots.legend_below(drawing, [left, right])
        return plots.save(drawing, folder / "training.png")
    left, right = drawing.subplots(1, 2)
    plots_studies.over_horizon(left, rows["horizon"], "total_time_spent_veh_s", "total time spent [veh s]")
    plots_studies.over_horizon(right, rows["horizon"], "control_step_ms_median", "median time of a decision [ms]")
    right.set_yscale("log")
    plots.legend_below(drawing, [left, right])
    return plots.save(drawing, folder / "horizon.png")


def ablation_table(rows: Mapping[str, Sequence[Mapping]]) -> str:
    """The result as text: one line per training and one per method, or one line per horizon."""
    if "training" in rows:
        return text_table([*map(_training_line, rows["training"]), *_method_lines(rows["training"])])
    return text_table(
        [
            {
                "controller": row["controller"],
                "horizon": row["horizon"],
                **_totals(row),
                "decision [ms]": f"{row['control_step_ms_median']:.0f} / {row['control_step_ms_max']:.0f}",
                "failures": row["solver_failures"],
            }
            for row in rows["horizon"]
        ],
        "decision: median / longest",
    )


def _totals(row: Mapping) -> dict:
    return {
        "TTS [veh s]": f"{row['total_time_spent_veh_s']:.4e}",
        "final [veh]": f"{row['final_accumulation_veh']:,.0f}",
    }


def _training_line(row: Mapping) -> dict:
    return {
        "method": row["method"],
        "seed": row["seed"],
        **_totals(row),
        "best validation [veh s]": f"{row['best_validation_veh_s']:.4e}",
    }


def _method_lines(rows: Sequence[Mapping]) -> list[dict]:
    """The mean total time spent of each method, with its 95 % interval from two seeds up."""
    lines = []
    for method in dict.fromkeys(row["method"] for row in rows):
        totals = [row["total_time_spent_veh_s"] for row in rows if row["method"] == method]
        spread = f" ± {interval(totals):.1e}" if len(totals) > 1 else ""
        lines.append(
            {
                "method": method,
                "seed": "mean",
                "TTS [veh s]": f"{statistics.fmean(totals):.4e}{spread}",
                "final [veh]": "",
                "best validation [veh s]": "",
            }
        )
    return lines
