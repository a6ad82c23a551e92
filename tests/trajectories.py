"""Trajectories that nobody drove, for tests of what is made of them."""

import numpy as np
import torch
from tiny import made

from cosim.evaluation.signal_proof import SHEET
from cosim.evaluation.simulate import FACTS
from cosim.plant.record import RECORD, TOTALS
from nmfd.model import dynamics
from nmfd.model.scenario import Scenario
from nmfd.types import Result, Status


def recorded(run: Result, arrays: dict[str, np.ndarray], facts: dict) -> Result:
    """`run` in a city, with the arrays of a Record and its facts, and one signal that kept its
    rules."""
    sheet = {name: np.zeros(1) for name in SHEET} | {"signal": np.array(["J"])}
    return run.add(facts, {**RECORD, **SHEET, **TOTALS}, **sheet, **arrays)


def flows(scenario: Scenario, run: Result) -> list[np.ndarray]:
    """Completions (T, R) and transfers (T, R, R, R) at the beginning of every interval [veh/s]."""
    inputs = run["accumulation"][:-1], run["perimeter"], run["splits"]
    found = dynamics.flows(dynamics.parameters(scenario.network), *map(torch.from_numpy, inputs))
    return [values.numpy() for values in found]


def record(steps: int, *, regions: int, gateways: int = 3, edges: int = 5) -> dict[str, np.ndarray]:
    """The arrays of a Record, at random."""
    sizes, random = (
        {"interval": steps, "gateway": gateways, "edge": edges},
        np.random.default_rng(0),
    )
    return {
        name: random.random([sizes.get(axis, regions) for axis in about.dimensions])
        for name, about in RECORD.items()
    }


def trajectory(controller="no-control", seed=0, steps=4):
    rng = np.random.default_rng(seed)
    return made(
        controller=controller,
        plant="nmfd",
        seed=seed,
        step=30.0,
        accumulation=rng.random((steps + 1, 2, 2)),
        backlog=np.zeros((steps + 1, 2, 2)),
        completed=np.arange(steps + 1.0),
        perimeter=rng.random((steps, 2, 2)),
        splits=rng.random((steps, 2, 2, 2)),
        decision_time=rng.random(steps),
        note=("",) * (steps - 1) + ("no",),
        status=np.array([0] * (steps - 1) + [(Status.SOLVER_FAILURE | Status.FALLBACK).value]),
    )


def in_city(
    scenario, strategy, seed: int, demand: float, *, tts: float, trips: int = 9, completed: int = 9
) -> Result:
    """A run of one interval; tts: its total time spent [veh s]."""
    regions = scenario.network.regions
    accumulation = np.zeros((2, regions, regions))
    accumulation[0, 0, 0] = tts / 90.0
    run = made(
        controller=strategy.name,
        plant="sumo",
        seed=seed,
        step=90.0,
        accumulation=accumulation,
        backlog=np.zeros((2, regions, regions)),
        completed=np.array([0.0, completed]),
        perimeter=np.ones((1, regions, regions)),
        splits=np.zeros((1, regions, regions, regions)),
    )
    facts = dict.fromkeys(FACTS, 0) | {
        "outside_training": "",
        "model_warning": "",
        "trips": trips,
        "scenario": scenario.name,
        "scenario_folder": str(scenario.folder),
        "demand": demand,
    }
    return recorded(run, record(1, regions=regions) | {"time_spent": np.array([tts])}, facts)
