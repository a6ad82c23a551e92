"""Ablations of what Tumu et al. claim: alternating training for route guidance, and the horizon of MPC.

Each is a list of independent runs whose rows are kept in a csv, with a figure over them.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from nmfd import closed_loop, rollout, runs, training
from nmfd.benchmarks import PLANTS, configuration, results
from nmfd.controllers import registry
from nmfd.errors import InputError
from nmfd.metrics import summary
from nmfd.scenario import Scenario
from nmfd.workers import Failure, RunFailed

TRAINING_COLUMNS = {"method": str, "seed": int, "adam_step": int, "total_time_spent_veh_s": float}
METHODS = {"alternating": True, "joint": False}
HORIZON_COLUMNS = {
    "controller": str, "horizon": int, "total_time_spent_veh_s": float, "final_accumulation_veh": float,
    "control_step_ms_median": float, "control_step_ms_max": float, "solver_failures": int}


def train_one(
    run: tuple[str, int], *, scenario: Scenario, controller: str, steps: int | None, compiled: bool,
    progress: Callable[[int, int], None] | None = None,
) -> list[dict]:
    """The validations of one training, `run` = (method, seed)."""
    method, seed = run
    table = {**scenario.controller_options.get(controller, {}), "alternating": METHODS[method]}
    changed = replace(scenario, controller_options={**scenario.controller_options, controller: table})
    rows: list[dict] = []

    def log(step: int, total: float) -> None:
        rows.append(dict(zip(TRAINING_COLUMNS, (method, seed, step, total), strict=True)))

    with tempfile.TemporaryDirectory() as folder:
        training.train(
            changed, controller, seed=seed, out=Path(folder) / "policy.pt", steps=steps, log=log, compiled=compiled,
            progress=progress and (lambda done, total, note: progress(done, total)))
    return rows


def drive_one(
    run: tuple[str, int], *, scenario: Scenario, plant: str, progress: Callable[[int, int], None] | None = None,
) -> list[dict]:
    """The closed loop of one MPC, `run` = (controller, horizon), as a single row."""
    torch.set_num_threads(1)
    controller = registry.make(run[0], with_horizon(scenario, *run))
    row = summary(closed_loop.run(PLANTS[plant](scenario), controller, scenario, seed=0, progress=progress))
    return [{**{name: row[name] for name in HORIZON_COLUMNS if name in row}, "controller": run[0], "horizon": run[1]}]


def with_horizon(scenario: Scenario, controller: str, horizon: int) -> Scenario:
    """`scenario` with another horizon [control intervals] for `controller`."""
    table = {**scenario.controller_options.get(controller, {}), "horizon": horizon}
    return replace(scenario, controller_options={**scenario.controller_options, controller: table})


def alternating_or_joint(
    scenario: Scenario, seeds: Sequence[int], *, out: Path, controller: str = "dpc-pcrg", steps: int | None = None,
    workers: int = 1, progress: Callable[[int, int, str], None] | None = None,
) -> list[dict]:
    """Train `controller` both ways with every seed; training.csv and training.png in `out`.

    Raises InputError for a controller without route guidance, RunFailed if trainings failed. Finished ones are kept.
    """
    chosen = training.settings(scenario, controller, steps)
    if not training.NAMES[controller]:
        raise InputError(f"--controller: {controller} has one decoder only; choose one with route guidance")
    common, _ = configuration(scenario, [], "nmfd", {})
    compiled = chosen.steps >= training.WORTH_COMPILING and rollout.can_compile()
    work = partial(train_one, scenario=scenario, controller=controller, steps=steps, compiled=compiled)
    todo = [(method, seed) for method in METHODS for seed in seeds]
    return _kept(
        out, "training", work, todo, columns=TRAINING_COLUMNS, workers=workers, length=chosen.steps,
        configuration={**common, "controller": controller, "adam_steps": chosen.steps}, progress=progress)


def horizons(
    scenario: Scenario, controllers: Sequence[str], lengths: Sequence[int], *, plant: str, out: Path,
    workers: int = 1, progress: Callable[[int, int, str], None] | None = None,
) -> list[dict]:
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
        out, "horizon", partial(drive_one, scenario=scenario, plant=plant), todo, columns=HORIZON_COLUMNS,
        workers=workers, length=scenario.steps, configuration=common, progress=progress)


def _kept(
    out: Path, name: str, work: Callable, todo: Sequence[tuple[str, int]], *, columns: Mapping[str, type],
    workers: int, length: int, configuration: Mapping, progress,
) -> list[dict]:
    """All rows of `out`/<name>.csv after the runs `todo` = (what, number); the first two columns tell the run."""
    file, failures = out / f"{name}.csv", []
    with runs.manifest(
            out, configuration={**configuration, "ablation": name}, results=file, session={"workers": workers}):
        rows = runs.read_rows(file, columns) if file.is_file() else []
        done = {tuple(row.values())[:2] for row in rows}
        missing = [run for run in todo if run not in done]
        for run, outcome in results(work, missing, workers, length, progress, label=lambda r: f"{r[0]} {r[1]}"):
            if isinstance(outcome, Failure):
                failures.append(f"{run[0]} {run[1]}: {outcome.reason}")
            else:
                rows = sorted([*rows, *outcome], key=lambda row: tuple(row.values())[:3])
                runs.write_rows(file, columns, rows)
        if rows:
            draw(out, name, rows)
    if failures:
        raise RunFailed("; ".join(failures))
    return rows


def draw(folder: Path, name: str, rows: Sequence[Mapping]) -> Path:
    """<name>.png of the rows of <name>.csv, in `folder`."""
    from nmfd import plots, plots_experiments  # workers import this module, and none of them draws

    if name == "training":
        drawing = plots.figure(7.0, 4.6)
        axes = [plots_experiments.training_curves(drawing.subplots(), rows)]
    else:
        drawing = plots.figure(10.0, 4.4)
        axes = list(drawing.subplots(1, 2))
        plots_experiments.over_horizon(axes[0], rows, "total_time_spent_veh_s", "total time spent [veh s]")
        plots_experiments.over_horizon(axes[1], rows, "control_step_ms_median", "median time of a decision [ms]")
        axes[1].set_yscale("log")
    plots.legend_below(drawing, axes)
    return plots.save(drawing, folder / f"{name}.png")


def table(what: str, rows: Sequence[Mapping]) -> str:
    """The result as text: the best validation of every training, or one line per horizon."""
    if what == "training":
        best: dict[tuple, float] = {}
        for row in rows:
            run = row["method"], row["seed"]
            best[run] = min(best.get(run, float("inf")), row["total_time_spent_veh_s"])
        return "\n".join(f"{method:<11}  seed {seed}  {total:.4e} veh s" for (method, seed), total in best.items())
    return "\n".join(
        f"{row['controller']:<8}  horizon {row['horizon']:>2}  {row['total_time_spent_veh_s']:.4e} veh s  final "
        f"{row['final_accumulation_veh']:>7,.0f} veh  {row['control_step_ms_median']:>6.0f} / "
        f"{row['control_step_ms_max']:.0f} ms median / longest  {row['solver_failures']} failures" for row in rows)
