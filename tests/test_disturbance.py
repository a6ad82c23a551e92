"""What the model got wrong lately: estimated, faded, identified, and used by offset-free MPC."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nmfd import closed_loop
from nmfd.api import load_scenario
from nmfd.controllers.no_control import NoControl
from nmfd.model import disturbance, identification
from nmfd.model.disturbance import LOOK, Disturbance
from nmfd.model.identification import Observed
from nmfd.model.model_file import network_toml
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import load_network

LAW = Disturbance(gain=0.8, memory=0.5, fade_critical=2.0, fade_slope=1.5)


def slower(network, share):
    """The same network, whose vehicles leave at `share` of the rate."""
    return replace(network, mfds=tuple(replace(m, a=share * m.a, b=share * m.b, c=share * m.c) for m in network.mfds))


@pytest.fixture(scope="module")
def believed():
    """The benchmark with a part of its demand, as it is believed in."""
    loaded = load_scenario("economic_mpc")
    return replace(
        loaded,
        network=replace(loaded.network, disturbance=LAW),
        demand=0.4 * loaded.demand,
        steps=80,
        controller_options={},
        measurement_std=0.0,
    )


@pytest.fixture(scope="module")
def slow(believed):
    """The city that it is: vehicles need 20 % longer."""
    return replace(believed, network=slower(believed.network, 0.8))


@pytest.fixture(scope="module")
def run(slow):
    trajectory = closed_loop.run(NmfdPlant(slow), NoControl(planning_model(slow)), slow, seed=0)
    return Observed(
        accumulation=trajectory.accumulation,
        demand=slow.demand[: slow.steps],
        perimeter=trajectory.perimeter,
        splits=trajectory.splits,
        crossings=np.full((slow.steps, 7, 7), 60.0),
    )


def test_the_newest_counts_most_and_a_constant_error_counts_in_full():
    innovations = torch.zeros(LOOK, 2, 2)
    innovations[-1, 0, 1] = 1.0
    newest = disturbance.estimated(LAW, innovations)[0, 1]
    oldest = disturbance.estimated(LAW, innovations.flip(0))[0, 1]
    assert newest == pytest.approx(0.8 / 1.75) and oldest == pytest.approx(newest / 4.0)
    assert disturbance.estimated(LAW, torch.ones(LOOK, 2, 2)) == pytest.approx(0.8)
    assert disturbance.estimated(LAW, torch.ones(1, 2, 2)) == pytest.approx(0.8)


def test_what_is_wrong_stays_where_it_is_full_and_passes_elsewhere():
    x = torch.tensor([[10.0, 10.0], [150.0, 150.0]])
    added = disturbance.ahead(LAW, torch.full((2, 2), 0.01), x, torch.tensor([100.0, 100.0]), 5, 90.0)
    kept = added[1:] / added[:-1]
    assert added[0] == pytest.approx(0.01)
    assert kept[:, 0] == pytest.approx(float(torch.sigmoid(torch.tensor(2.0 - 1.5 * 0.8))))
    assert kept[:, 1] == pytest.approx(float(torch.sigmoid(torch.tensor(2.0 + 1.5 * 2.0))))


def test_no_more_leaves_than_is_there():
    x, law = torch.tensor([[4.0, 0.0], [0.0, 50.0]]), LAW._replace(fade_critical=50.0)
    added = disturbance.ahead(law, torch.full((2, 2), -1.0), x, torch.tensor([100.0, 100.0]), 10, 90.0)
    assert 90.0 * added.sum(0) == pytest.approx(-x, abs=1e-4)


def test_corrected_predictions_of_another_city_are_better(believed, run):
    """And the more so with the law that was fitted to it."""
    network = identification.fit_disturbance(believed.network, [run], step=believed.step, iterations=60)

    def misses(intervals, law):
        found = identification.prediction_errors(network, [run], intervals, step=believed.step, law=law)
        return np.sqrt((found**2).mean())

    assert network.disturbance is not None
    for intervals, least in ((1, 0.3), (8, 0.6)):
        assert misses(intervals, LAW) < 0.8 * misses(intervals, None)
        assert misses(intervals, network.disturbance) < least * misses(intervals, None)


def test_a_model_that_is_right_needs_no_correction(slow, run):
    found = identification.prediction_errors(slow.network, [run], 8, step=slow.step, law=LAW)
    assert np.abs(found).max() < 0.05  # single precision


def test_runs_too_short_tell_nothing(believed, run):
    short = Observed(**{name: values[: LOOK + (name == "accumulation")] for name, values in vars(run).items()})
    assert identification.fit_disturbance(believed.network, [short], step=believed.step) is believed.network


def test_it_is_written_and_read(believed, tmp_path):
    (tmp_path / "network.toml").write_text(network_toml(believed.network, {}, "a test"))
    read = load_network(tmp_path)
    assert read.disturbance == LAW
    assert read.hash == load_network("hexagon7").hash  # of what policies depend on
