"""Identification on runs whose truth is known: made by the regional model itself, under the probing controller."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny

from nmfd import closed_loop
from nmfd.api import load_scenario
from nmfd.controllers.excitation import Probing
from nmfd.model import identification
from nmfd.model.identification import Observed
from nmfd.model.mfd import Mfd
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def scenario():
    """The benchmark with a third of its demand and limited boundaries."""
    loaded = load_scenario(ROOT / "scenarios" / "economic_mpc")
    return replace(
        loaded, network=tiny.limited(loaded.network), demand=0.4 * loaded.demand, steps=120, protected=(3,),
        controller_options={}, measurement_std=0.0)


def observe(scenario, seed, factor):
    demanded = replace(scenario, demand=factor * scenario.demand)
    controller = Probing(planning_model(demanded), guidance=False)
    trajectory = closed_loop.run(NmfdPlant(demanded), controller, demanded, seed=seed)
    return Observed(
        accumulation=trajectory.accumulation, demand=demanded.demand[:demanded.steps],
        perimeter=trajectory.perimeter, splits=trajectory.splits,
        crossings=np.full((demanded.steps, 7, 7), 60.0))


@pytest.fixture(scope="module")
def runs(scenario):
    return [observe(scenario, seed, factor) for seed, factor in enumerate((0.7, 1.0, 1.3, 1.0))]


def error(network, runs, intervals):
    return np.sqrt((identification.prediction_errors(network, runs, intervals, step=30.0) ** 2).mean())


def test_the_true_model_predicts_without_error(scenario, runs):
    assert error(scenario.network, runs, 10) < 0.05  # single precision


def test_the_fit_predicts_a_run_that_it_has_not_seen(scenario, runs):
    start = replace(
        scenario.network, exit_rates=None, capacity=None, storage=None,
        mfds=(Mfd(a=0.0, b=-2e-7, c=0.004, jam=9000.0),) * 7)
    fitted = identification.fit(start, runs[:3], step=30.0, iterations=250)
    assert all(mfd.problem() is None for mfd in fitted.mfds)
    assert error(fitted, runs[3:], 10) < 0.35 * error(start, runs[3:], 10)
    again = identification.fit(start, runs[:3], step=30.0, iterations=250)
    assert again.hash == fitted.hash  # the same seed gives the same model
    used = sum(run.accumulation.sum(axis=0) for run in runs[:3])
    mean = (used * fitted.exit_rates).sum(axis=1) / used.sum(axis=1)
    np.testing.assert_allclose(mean, 1.0)  # the MFD is that of the mean vehicle


def test_windows_are_the_intervals_in_order(runs):
    states, demand, perimeter, splits = identification.windows(runs[:1], 5)
    assert states.shape == (116, 6, 7, 7) and demand.shape == perimeter.shape == (116, 5, 7, 7)
    np.testing.assert_array_equal(states[3, 2], runs[0].accumulation[5].astype(np.float32))
    np.testing.assert_array_equal(splits[7, 4], runs[0].splits[11].astype(np.float32))


def test_probing_moves_every_gate_and_repeats_itself(scenario):
    def trajectory(seed, guidance=True):
        controller = Probing(planning_model(scenario), guidance=guidance)
        return closed_loop.run(NmfdPlant(scenario), controller, scenario, seed=seed)

    first, again, other = trajectory(0), trajectory(0), trajectory(1)
    np.testing.assert_array_equal(first.perimeter, again.perimeter)
    assert (first.perimeter != other.perimeter).any()
    gates = first.perimeter[:, scenario.network.adjacency]
    assert (np.ptp(gates, axis=0) > 0.2).all()
    assert gates.min() >= scenario.network.u_min and gates.max() <= scenario.network.u_max
    sums = first.splits.sum(axis=2)
    assert np.isclose(sums, 1.0).sum() == np.isclose(sums, 0.0).sum() * 6  # all but j = i
    assert not first.splits[:, ~scenario.network.split_mask].any()
    assert (trajectory(0, guidance=False).splits == scenario.network.nominal_splits).all()
