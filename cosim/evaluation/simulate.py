"""One closed-loop run in SUMO: a task that can be handed to another process, and all that came of it."""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from cosim.evaluation import estimation_errors, run_metrics
from cosim.plant.plant import SumoPlant
from cosim.plant.settings import settings
from cosim.plant.strategy import Strategy, configured, parse, planning_of
from cosim.sumo.outputs import check_whole
from nmfd import closed_loop, metrics
from nmfd.api import load_scenario
from nmfd.controllers import registry
from nmfd.model.planning import PlanningModel
from nmfd.model.scenario import Scenario, with_faults
from nmfd.runs import run_folder
from nmfd.runs.files import atomic
from nmfd.types import Controller, Trajectory

# Columns of sumo.csv, beside those of summary.csv.
FACTS = (
    "controller", "seed", "trips", "departed_veh", "final_backlog_veh", "total_backlog_veh_s", "teleports",
    "mean_trip_time_s", "mean_departure_delay_s", "co2_kg", "fuel_kg", "gateway_queue_mean_veh",
    "gateway_queue_max_veh", "gateway_full_share", "notes", "leaking_share",
    "estimate_rmse_share", "estimate_cell_rmse_veh", "wall_time_s", "sumo_time_s", "overhead_share", "setup_time_s",
    "signals_left_alone")


@dataclass(frozen=True, kw_only=True)
class Task:
    """scenario: its folder; controller: a strategy (cosim.plant.strategy); policy: of a DPC controller, instead of the
    scenario's own; steps: control intervals, all if None; demand_factor: multiplies all flows;
    options: of the controller, instead of those of the scenario; sumo_output: kind (cosim.sumo.outputs) and file of
    SUMO's own outputs; faults: besides those of the scenario."""

    scenario: Path
    controller: str
    seed: int
    policy: Path | None = None
    steps: int | None = None
    demand_factor: float = 1.0
    options: tuple[tuple[str, object], ...] = ()
    sumo_output: tuple[tuple[str, Path], ...] = ()
    faults: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Result:
    """trajectory; record: the fields of cosim.plant.record.Record; facts: a row of sumo.csv."""

    trajectory: Trajectory
    record: dict[str, np.ndarray]
    facts: dict[str, float | int | str]


def scenario_of(task: Task) -> Scenario:
    """The scenario with the horizon and demand of `task`. Raises InputError."""
    scenario = load_scenario(task.scenario)
    steps = scenario.steps if task.steps is None else min(task.steps, scenario.steps)
    scenario = with_faults(scenario, task.faults)
    scenario = replace(
        scenario, steps=steps, demand=task.demand_factor * scenario.demand[:steps],
        demand_factor=task.demand_factor * scenario.demand_factor)
    if not task.options:
        return scenario
    controller = parse(task.controller).controller
    options = {**scenario.controller_options.get(controller, {}), **dict(task.options)}
    return replace(scenario, controller_options={**scenario.controller_options, controller: options})


def simulate(task: Task, progress: Callable[[int, int], None] | None = None) -> Result:
    """Run `task` in this process, which must hold no other SUMO session. Raises InputError."""
    begin = time.perf_counter()
    scenario, strategy = scenario_of(task), parse(task.controller)
    controller = registry.make(configured(task.controller, scenario.controller_options), scenario, policy=task.policy)
    return drive(
        scenario, strategy, controller, seed=task.seed, progress=progress, begin=begin, outputs=dict(task.sumo_output),
        planning=planning_of(scenario, task.controller))


def drive(
    scenario: Scenario, strategy: Strategy, controller: Controller, *, seed: int,
    progress: Callable[[int, int], None] | None = None, begin: float | None = None,
    outputs: Mapping[str, Path] | None = None, planning: PlanningModel | None = None,
) -> Result:
    """The closed loop of `controller` in SUMO, filed under `strategy.name`, whose options the city takes.

    begin: when the setting up began (time.perf_counter); outputs: SUMO's own, kind (cosim.sumo.outputs) -> file, there
    only if all goes well; planning: what states are estimated with, if not the scenario itself.
    Raises InputError.
    """
    begin = time.perf_counter() if begin is None else begin
    with ExitStack() as stack:
        files = {kind: stack.enter_context(atomic(path)) for kind, path in (outputs or {}).items()}
        plant = SumoPlant(
            scenario, overrides=settings(scenario).changed(**strategy.overrides), outputs=files,
            planning=planning)
        stack.callback(plant.close)
        trajectory = run_folder.labelled(
            closed_loop.run(plant, controller, scenario, seed=seed, progress=progress),
            controller=strategy.name, plant="sumo")
        record = plant.record()
        departed = int(record.departures.sum())
        backlog = trajectory.backlog.sum(axis=(1, 2))
        sumo_time, leaks = plant.sumo_time, set(plant.leaks())
        row = {
            "controller": strategy.name, "seed": seed, "trips": plant.trips, "departed_veh": departed,
            "final_backlog_veh": int(backlog[-1]), "total_backlog_veh_s": float(scenario.step * backlog[:-1].sum()),
            "teleports": int(record.teleports.sum()), **run_metrics.trip_facts(plant.trip_facts()),
            **run_metrics.queue_facts(record, plant.city), "notes": metrics.notes(trajectory),
            "leaking_share": run_metrics.leaking_share(record, plant.city, leaks),
            **_estimation(scenario, trajectory), "wall_time_s": trajectory.wall_time, "sumo_time_s": sumo_time,
            "overhead_share": 1.0 - sumo_time / trajectory.wall_time,
            "setup_time_s": time.perf_counter() - begin - trajectory.wall_time,
            "signals_left_alone": len(plant.other_signals)}
        check_whole(files)
    return Result(trajectory=trajectory, record=asdict(record), facts=row)


def _estimation(scenario: Scenario, trajectory: Trajectory) -> dict[str, float]:
    """Errors of the estimate, over all regions; NaN where the controller saw the exact state."""
    if not trajectory.estimated:
        return {"estimate_rmse_share": math.nan, "estimate_cell_rmse_veh": math.nan}
    whole = estimation_errors.errors(scenario.network, trajectory)[-1]
    return {"estimate_rmse_share": whole["rmse_share"], "estimate_cell_rmse_veh": whole["cell_rmse_veh"]}
