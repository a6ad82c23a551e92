"""Made-up runs on grid7_peak in real folders: nothing is simulated, everything is drawn from the
seed."""

from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trajectories

from cosim.evaluation import evaluate, statistics
from cosim.evaluation.simulate import FACTS
from cosim.plant.strategy import parse
from cosim.sumo.net import city_of
from nmfd.api import load_scenario
from nmfd.metrics import COUNTED
from nmfd.model.scenario import with_demand
from nmfd.runs import run_many
from nmfd.types import Result

SCENARIO = "grid7_peak"
STEPS = 5
SHARE = {"no-control": 1.0, "pi-gating": 0.8, "dpc-pcrg": 0.5}  # of the vehicles without control


def instead_of_sumo(patch, result) -> None:
    """Let `result(scenario, strategy, seed=, demand=)` make every run of `run_many`: a Result, or
    why it failed."""

    def outcomes(todo, *_):
        for run in todo:
            job = run.job
            yield run, result(job.scenario, job.strategy, seed=job.seed, demand=job.demand)

    patch.setattr(run_many, "_outcomes", outcomes)


def result(scenario, strategy, *, seed, demand, city) -> Result:
    network, steps = scenario.network, scenario.steps
    regions, random = network.regions, np.random.default_rng([seed, len(strategy.name)])
    size = 40.0 * demand * SHARE[strategy.name]
    shape = np.minimum(np.arange(steps + 1), steps - np.arange(steps + 1)) + 0.0
    accumulation = (
        size * shape[:, None, None] * random.uniform(0.9, 1.1, (steps + 1, regions, regions))
    )
    acts, guides = strategy.name != "no-control", "rg" in strategy.name
    perimeter = (
        random.uniform(0.3, 0.9, (steps, regions, regions))
        if acts
        else np.full((steps, regions, regions), 0.9)
    )
    crossings = random.integers(0, 9, (steps, regions, regions, regions)) * network.split_mask
    trajectory = trajectories.made(
        controller=strategy.name,
        plant="sumo",
        seed=seed,
        step=scenario.step,
        accumulation=accumulation,
        backlog=np.zeros_like(accumulation),
        completed=100.0 * np.arange(steps + 1),
        perimeter=perimeter,
        splits=np.repeat(network.nominal_splits[None], steps, axis=0),
        decision_time=random.uniform(0.001, 0.01, steps),
    )
    edges, gateways = len(city.edges), len(city.gateways)
    original = np.full((steps, gateways), 30.0)
    record = {
        "departures": random.integers(0, 9, (steps, regions, regions)),
        "crossings": crossings,
        "arrivals": random.integers(0, 50, (steps, regions)),
        **{
            name: np.zeros((steps, regions, regions), dtype=int)
            for name in ("removals", "given_up")
        },
        **{name: np.zeros((steps, *[regions] * 3), dtype=int) for name in ("jumps", "redirected")},
        "edge_vehicles": random.uniform(0.0, 20.0, (steps, edges)).astype(np.float16),
        "gateway_green": original * (0.7 if acts else 1.0),
        "gateway_original_green": original,
        "gateway_flow": random.uniform(0.0, 9.0, (steps, gateways)),
        "gateway_queue": random.uniform(0.0, 9.0, (steps, gateways)),
        "gateway_queue_max": np.full((steps, gateways), 9),
        "teleports": np.zeros(steps, dtype=int),
        "time_spent": scenario.step * accumulation[:-1].sum(axis=(1, 2)),
        "production": random.uniform(0.0, 9.0, (steps, regions)),
        "mean_accumulation": np.ones((steps, regions)),
        "guided": crossings * guides,
        "co2": random.uniform(0.0, 90.0, edges).astype(np.float32),
        "queue_max": random.integers(0, 30, edges),
        "time_loss": np.full(edges, 3600.0, np.float32),
        "passed": np.full(edges, 80.0 if acts else 60.0, np.float32),
        "trip_time_by_origin": np.where(np.arange(regions) == 2, 1300.0, 900.0)
        if guides
        else np.full(regions, 1000.0),
    }
    facts = {name: random.uniform(0.1, 100.0) for name in FACTS} | {
        "scenario": scenario.name,
        "scenario_folder": str(scenario.folder),
        "demand": demand,
        "trips": 600,
        "outside_training": "",
        "model_warning": "",
        "teleports": 3 * (strategy.name == "pi-gating"),
        "final_backlog_veh": 20,
        "signal_violations": 0,
    }
    return trajectories.recorded(trajectory, record, facts)


def folder(out: Path, *, controllers=tuple(SHARE), seeds=(2000, 2001), levels=(1.0,)) -> Path:
    """An evaluation whose runs are made up."""
    scenario = with_demand(load_scenario(SCENARIO), steps=STEPS)
    with pytest.MonkeyPatch.context() as patch:
        instead_of_sumo(patch, partial(result, city=city_of(scenario.network)))
        runs = evaluate.plan([(scenario, levels)], [parse(name) for name in controllers], seeds)
        evaluate.evaluate(runs, out, progress=False)
    return out


def rows_of(values: dict[tuple[float, str], dict[int, float]]) -> pd.DataFrame:
    """(level, controller) -> seed -> TTS; everything else is 1 or empty."""
    figures = (
        "completed_veh",
        *(f"control_step_ms_{which}" for which in ("first", "median", "max")),
    )
    blank = dict.fromkeys((*figures, *FACTS), 1.0) | dict.fromkeys(("teleports", *COUNTED), 0)
    return pd.DataFrame(
        [
            blank | {"demand": level, "controller": name, "seed": seed, statistics.TTS: tts}
            for (level, name), seeds in values.items()
            for seed, tts in seeds.items()
        ]
    )
