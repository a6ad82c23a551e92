"""One closed-loop run in SUMO: a task that can be handed to another process, and all that came of it."""

import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cosim.evaluation import estimation_errors, run_metrics
from cosim.plant.max_pressure import FACTS as PRESSURE_FACTS
from cosim.plant.observer import Observer
from cosim.plant.plant import SumoPlant
from cosim.plant.record import Record, settled
from cosim.plant.settings import settings
from cosim.sumo.outputs import check_whole
from cosim.sumo.session import Window
from nmfd import closed_loop, metrics
from nmfd.api import load_scenario
from nmfd.controllers.strategy import Strategy, parse
from nmfd.model.planning import PlanningModel
from nmfd.model.scenario import Scenario, with_demand, with_faults
from nmfd.quantities import variables
from nmfd.runs import run_folder
from nmfd.runs.files import atomic
from nmfd.types import Controller, Result

# Columns of sumo.csv, beside those of summary.csv, and what they say.
FACTS = {
    "controller": "the strategy",
    "seed": "of trips, drivers and guidance",
    "trips": "that were due",
    "departed_veh": "trips that could enter",
    "final_backlog_veh": "waiting to enter at the end",
    "total_backlog_veh_s": "time integral of those who wait to enter",
    "teleports": "out of jams, by SUMO",
    "mean_trip_time_s": "on the road, of all trips, unfinished ones with what they had spent at the end",
    "mean_departure_delay_s": "between the wanted and the real departure, of all trips",
    "mean_time_loss_s": "lost on the road against driving freely, of all trips (SUMO's timeLoss)",
    "delay_gini": "Gini coefficient of the mean delays of regions of origin (run_metrics.delay_gini)",
    "co2_kg": "of all vehicles, by SUMO's HBEFA4 petrol car",
    "fuel_kg": "of all vehicles, by the same model",
    "gateway_queue_mean_veh": "halting on the edges before gateways, mean over edges and time",
    "gateway_queue_max_veh": "the longest of these queues",
    "gateway_full_share": "share of these edges and intervals that were full",
    "notes": "what was said most often of decisions that were not as they should be",
    "outside_training": "where this is beyond what the policy was trained for",
    "leaking_share": "share of the flow over the boundaries that passes no signal under control",
    "estimate_rmse_share": "error of estimated accumulations, as a share of the critical ones",
    "estimate_cell_rmse_veh": "error of estimated accumulations by destination",
    "sumo_time_s": "of it, SUMO's own steps",
    "overhead_share": "of it, the share outside SUMO",
    "setup_time_s": "before the first interval",
    "signals_left_alone": "signals that keep their own programmes",
    "removed_veh": "taken out before the end of their trips",
    "removed_waiting_veh": "of these, before they could enter",
    "freed_veh": "vehicles that waited for each other on a junction with free streets behind it, and were set down",
    "led_on_veh": "guided drivers who could not change lanes and went on where theirs led",
    "jumps": "vehicles that came into another region where no gateway leads there",
    **PRESSURE_FACTS,
}


@dataclass(frozen=True, kw_only=True)
class Task:
    """scenario: its folder; controller: the name of a strategy (nmfd.controllers.strategy); policy: of a DPC controller, instead of the
    scenario's own; steps: control intervals, all if None; demand_factor: multiplies all flows;
    options: of the controller, instead of those of the scenario; sumo_output: kind (cosim.sumo.outputs) and file of
    SUMO's own outputs; faults: besides those of the scenario; time_limit: of a controller of the user's own
    [s], instead of that of the scenario."""

    scenario: Path
    controller: str
    seed: int
    policy: Path | None = None
    steps: int | None = None
    demand_factor: float = 1.0
    settings: tuple[tuple[str, Any], ...] = ()
    options: tuple[tuple[str, object], ...] = ()
    sumo_output: tuple[tuple[str, Path], ...] = ()
    faults: tuple[str, ...] = ()
    time_limit: float | None = None

    def __post_init__(self) -> None:
        """A text will do for the scenario's folder."""
        object.__setattr__(self, "scenario", Path(self.scenario))


def scenario_of(task: Task) -> Scenario:
    """The scenario with the horizon and demand of `task`. Raises InputError."""
    scenario = with_faults(load_scenario(task.scenario, dict(task.settings)), task.faults)
    scenario = with_demand(scenario, steps=task.steps, factor=task.demand_factor)
    if not task.options:
        return scenario
    tables = scenario.controller_options
    table = parse(task.controller).table(scenario)
    return replace(scenario, controller_options={**tables, table: {**tables.get(table, {}), **dict(task.options)}})


def simulate(
    task: Task,
    progress: Callable[[int, int], None] | None = None,
    observer: Observer | None = None,
    window: Window | None = None,
) -> Result:
    """Run `task` in this process, which must hold no other SUMO session. Raises InputError.

    observer: is shown the run while it goes on, which stays the same
    """
    begin = time.perf_counter()
    scenario, strategy = scenario_of(task), parse(task.controller)
    result = drive(
        scenario,
        strategy,
        strategy.make(scenario, task.policy),
        seed=task.seed,
        progress=progress,
        begin=begin,
        outputs=dict(task.sumo_output),
        planning=strategy.planning(scenario),
        observer=observer,
        window=window,
    )
    outside = strategy.outside_training(scenario, task.demand_factor, task.policy)
    return result.assign(outside_training=outside)


def drive(
    scenario: Scenario,
    strategy: Strategy,
    controller: Controller,
    *,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
    begin: float | None = None,
    outputs: Mapping[str, Path] | None = None,
    planning: PlanningModel | None = None,
    observer: Observer | None = None,
    window: Window | None = None,
) -> Result:
    """The closed loop of `controller` in SUMO, filed under `strategy.name`, whose options the city takes.

    begin: when the setting up began (time.perf_counter); outputs: SUMO's own, kind (cosim.sumo.outputs) -> file, there
    only if all goes well; planning: what states are estimated with, if not the scenario itself; observer: is shown the
    run while it goes on.
    Raises InputError.
    """
    begin = time.perf_counter() if begin is None else begin
    with ExitStack() as stack:
        files = {kind: stack.enter_context(atomic(path)) for kind, path in (outputs or {}).items()}
        plant = SumoPlant(
            scenario,
            overrides=settings(scenario).changed(**strategy.city),
            outputs=files,
            planning=planning,
            observer=observer,
            window=window,
        )
        stack.callback(plant.close)
        trajectory = run_folder.labelled(
            closed_loop.run(plant, controller, scenario, seed=seed, progress=progress),
            controller=strategy.name,
            plant="sumo",
        )
        trips, sumo_time, leaks, facts = plant.trips, plant.sumo_time, set(plant.leaks()), plant.trip_facts()
        record = plant.record()
        trajectory = settled(trajectory, record)
        backlog = trajectory.backlog.sum(axis=(1, 2))
        row = {
            "trips": trips,
            "departed_veh": int(record.departures.sum()),
            "final_backlog_veh": int(backlog[-1]),
            "total_backlog_veh_s": float(scenario.step * backlog[:-1].sum()),
            "teleports": int(record.teleports.sum()),
            **run_metrics.trip_facts(facts),
            "delay_gini": run_metrics.delay_gini(trajectory, record, plant.time_loss()),
            **run_metrics.queue_facts(record, plant.city),
            "notes": metrics.notes(trajectory),
            "outside_training": "",
            "leaking_share": run_metrics.leaking_share(record, plant.city, leaks),
            **_estimation(scenario, trajectory),
            "sumo_time_s": sumo_time,
            "overhead_share": 1.0 - sumo_time / trajectory.wall_time,
            "setup_time_s": time.perf_counter() - begin - trajectory.wall_time,
            "signals_left_alone": len(plant.other_signals),
            "removed_veh": int(record.removals.sum() + record.given_up.sum()),
            "removed_waiting_veh": int(record.given_up.sum()),
            "jumps": int(record.jumps.sum()),
            **plant.helped(),
            **plant.pressure_facts(),
        }
        check_whole(files)
    return trajectory.add(variables(Record, asdict(record)), row)


def _estimation(scenario: Scenario, trajectory: Result) -> dict[str, float]:
    """Errors of the estimate, over all regions; NaN where the controller saw the exact state."""
    if not trajectory.estimated:
        return {"estimate_rmse_share": math.nan, "estimate_cell_rmse_veh": math.nan}
    whole = estimation_errors.errors(scenario.network, trajectory)[-1]
    return {"estimate_rmse_share": whole["rmse_share"], "estimate_cell_rmse_veh": whole["cell_rmse_veh"]}
