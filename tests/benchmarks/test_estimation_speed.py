"""One step of the estimator, 7 regions: pytest -n0 tests/benchmarks --benchmark-only"""

from pathlib import Path

import numpy as np
import pytest
import torch

from nmfd.api import load_scenario
from nmfd.model.estimation import Estimator, Instruments, Readings
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.types import Controls

SCENARIO = load_scenario(Path(__file__).parents[2] / "scenarios" / "grid7_peak")


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_estimator_step(benchmark):
    network, plant = SCENARIO.network, NmfdPlant(SCENARIO)
    inner = network.adjacency
    estimator = Estimator(
        planning_model(SCENARIO),
        Instruments(
            detector_share=np.full(7, 0.3),
            detector_error=np.full(7, 0.3),
            detector_noise=np.full(7, 0.3),
            counted_share=np.where(inner, 0.3, 0.0),
            counted_gateways=np.where(inner, 2, 0),
            probe_share=0.1,
        ),
    )
    controls = Controls(perimeter=np.where(inner, network.u_max, 0.0), splits=None)
    plant.reset(0)
    for k in range(20):
        x = plant.step(controls).accumulation
        observation = Readings(
            accumulation=0.9 * x.sum(axis=1),
            crossings=np.full((7, 7), np.nan),
            probes=np.round(0.1 * x),
            probe_departures=np.round(0.1 * SCENARIO.step * SCENARIO.demand[k]),
        )
        estimator.step(controls, observation)
    benchmark(estimator.step, controls, observation)
    assert np.isfinite(estimator.accumulation).all()
