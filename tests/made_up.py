"""Made-up runs on grid7_peak in real folders: nothing is simulated, everything is drawn from the seed."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import trajectories

from cosim.evaluation import evaluate, experiment, statistics
from cosim.evaluation.simulate import FACTS, Result, scenario_of
from cosim.sumo.net import city_of
from nmfd.api import load_scenario
from nmfd.runs.run_folder import COLUMNS

SCENARIO = Path(__file__).parents[1] / "scenarios" / "grid7_peak"
STEPS = 5
SHARE = {"no-control": 1.0, "pi-gating": 0.8, "dpc-pcrg": 0.5}  # of the vehicles without control


def result(task, city) -> Result:
    scenario = scenario_of(task)
    network, steps = scenario.network, scenario.steps
    regions, random = network.regions, np.random.default_rng([task.seed, len(task.controller)])
    size = 40.0 * task.demand_factor * SHARE[task.controller]
    shape = np.minimum(np.arange(steps + 1), steps - np.arange(steps + 1)) + 0.0
    accumulation = size * shape[:, None, None] * random.uniform(0.9, 1.1, (steps + 1, regions, regions))
    acts, guides = task.controller != "no-control", "rg" in task.controller
    perimeter = random.uniform(0.3, 0.9, (steps, regions, regions)) if acts else np.full((steps, regions, regions), 0.9)
    crossings = random.integers(0, 9, (steps, regions, regions, regions)) * network.split_mask
    trajectory = trajectories.made(
        controller=task.controller,
        plant="sumo",
        seed=task.seed,
        step=scenario.step,
        accumulation=accumulation,
        backlog=np.zeros_like(accumulation),
        completed=100.0 * np.arange(steps + 1),
        perimeter=perimeter,
        splits=np.repeat(network.nominal_splits[None], steps, axis=0),
        decision_time=random.uniform(0.001, 0.01, steps),
        wall_time=1.0,
    )
    edges, gateways = len(city.edges), len(city.gateways)
    original = np.full((steps, gateways), 30.0)
    record = {
        "departures": random.integers(0, 9, (steps, regions, regions)),
        "crossings": crossings,
        "arrivals": random.integers(0, 50, (steps, regions)),
        **{name: np.zeros((steps, regions, regions), dtype=int) for name in ("removals", "given_up")},
        **{name: np.zeros((steps, *[regions] * 3), dtype=int) for name in ("jumps", "redirected")},
        "edge_vehicles": random.uniform(0.0, 20.0, (steps, edges)).astype(np.float16),
        "gateway_green": original * (0.7 if acts else 1.0),
        "gateway_original_green": original,
        "gateway_flow": random.uniform(0.0, 9.0, (steps, gateways)),
        "gateway_queue": random.uniform(0.0, 9.0, (steps, gateways)),
        "gateway_queue_max": np.full((steps, gateways), 9),
        "teleports": np.zeros(steps, dtype=int),
        "production": random.uniform(0.0, 9.0, (steps, regions)),
        "mean_accumulation": np.ones((steps, regions)),
        "guided": crossings * guides,
    }
    facts = {name: random.uniform(0.1, 100.0) for name in FACTS} | {
        "controller": task.controller,
        "seed": task.seed,
        "trips": 600,
        "outside_training": "",
        "teleports": 3 * (task.controller == "pi-gating"),
        "final_backlog_veh": 20,
    }
    return trajectories.recorded(trajectory, record, facts)


def folder(out: Path, *, controllers=tuple(SHARE), seeds=(2000, 2001), levels=(1.0,)) -> Path:
    """An evaluation whose runs are made up."""
    scenario = load_scenario(SCENARIO)
    city = city_of(scenario.network)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            experiment, "outcomes", lambda function, todo, workers, **_: ((task, result(task, city)) for task in todo)
        )
        evaluate.evaluate(
            evaluate.Evaluation(
                scenario=SCENARIO, controllers=controllers, seeds=seeds, levels=levels, steps=STEPS, out=out
            )
        )
    return out


def rows_of(values: dict[tuple[float, str], dict[int, float]]) -> pd.DataFrame:
    """(level, controller) -> seed -> TTS; everything else is 1 or empty."""
    blank = {name: 1.0 for name in (*COLUMNS, *FACTS)} | dict.fromkeys(("teleports", *statistics.COUNTED), 0)
    return pd.DataFrame(
        [
            blank | {"demand": level, "controller": name, "seed": seed, statistics.TTS: tts}
            for (level, name), seeds in values.items()
            for seed, tts in seeds.items()
        ]
    )
