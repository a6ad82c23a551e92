"""Identification on runs whose truth is known: made by the regional model itself, under the probing
controller."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch

from nmfd import api
from nmfd.api import load_scenario
from nmfd.model import dynamics, identification
from nmfd.model.identification import Observed, Windows
from nmfd.model.mfd import Cubic


@pytest.fixture(scope="module")
def scenario():
    """The benchmark with a third of its demand and limited boundaries."""
    loaded = load_scenario("economic_mpc")
    return replace(
        loaded,
        network=tiny.limited(loaded.network),
        demand=0.4 * loaded.demand[:120],
        steps=120,
        protected=(3,),
        controller_options={},
        measurement_std=0.0,
    )


def observe(scenario, seed, factor):
    demanded = replace(scenario, demand=factor * scenario.demand)
    trajectory = api.run(demanded, "probing-pc", seed=seed)
    return Observed(
        accumulation=trajectory["accumulation"],
        inside=trajectory["accumulation"][1:],
        demand=demanded.demand[: demanded.steps],
        perimeter=trajectory["perimeter"],
        splits=trajectory["splits"],
        crossings=np.full((demanded.steps, 7, 7), 60.0),
    )


@pytest.fixture(scope="module")
def runs(scenario):
    return [observe(scenario, seed, factor) for seed, factor in enumerate((0.7, 1.0, 1.3, 1.0))]


def error(network, runs, intervals):
    return np.sqrt(
        (identification.prediction_errors(network, runs, intervals, step=30.0) ** 2).mean()
    )


def test_the_true_model_predicts_without_error(scenario, runs):
    assert error(scenario.network, runs, 10) < 0.05  # single precision


@pytest.mark.slow
def test_the_fit_predicts_a_run_that_it_has_not_seen(scenario, runs):
    line = (Cubic(a=0.0, b=-2e-7, c=0.004, jam=9000.0),) * 7
    start = replace(scenario.network, exit_rates=None, capacity=None, storage=None, mfds=line)
    fitted = identification.fit(start, runs[:3], step=30.0, iterations=50)
    assert all(mfd.problem() is None for mfd in fitted.mfds)
    assert error(fitted, runs[3:], 10) < 0.35 * error(start, runs[3:], 10)
    first, again, other = (
        identification.fit(start, runs[:1], step=30.0, iterations=2, seed=seed).hash
        for seed in (0, 0, 1)
    )
    assert first == again != other  # the same seed gives the same model
    used = sum(run.accumulation.sum(axis=0) for run in runs[:3])
    mean = (used * fitted.exit_rates).sum(axis=1) / used.sum(axis=1)
    np.testing.assert_allclose(mean, 1.0)  # the MFD is that of the mean vehicle


def test_windows_are_the_intervals_in_order(runs):
    states, demand, perimeter, splits = identification.windows(runs[:1], 5)
    assert states.shape == (116, 6, 7, 7)
    assert demand.shape == perimeter.shape == (116, 5, 7, 7)
    np.testing.assert_array_equal(states[3, 2], runs[0].accumulation[5].astype(np.float32))
    np.testing.assert_array_equal(splits[7, 4], runs[0].splits[11].astype(np.float32))


def test_probing_moves_every_gate_and_repeats_itself(scenario):
    def trajectory(seed, guidance=True):
        return api.run(scenario, "probing-pcrg" if guidance else "probing-pc", seed=seed)

    first, again, other = trajectory(0), trajectory(0), trajectory(1)
    np.testing.assert_array_equal(first["perimeter"], again["perimeter"])
    assert (first["perimeter"] != other["perimeter"]).any()
    gates = first["perimeter"][:, scenario.network.adjacency]
    assert (np.ptp(gates, axis=0) > 0.2).all()
    assert gates.min() >= scenario.network.u_min
    assert gates.max() <= scenario.network.u_max
    sums = first["splits"].sum(axis=2)
    assert np.isclose(sums, 1.0).sum() == np.isclose(sums, 0.0).sum() * 6  # all but j = i
    assert not first["splits"][:, ~scenario.network.split_mask].any()
    assert (trajectory(0, guidance=False).splits == scenario.network.nominal_splits).all()


def test_a_fit_begins_at_the_largest_accumulations_and_flows(scenario, runs):
    made = identification._Model(scenario.network, runs, 30.0, 1.0 / 30.0)
    largest = np.max([run.accumulation.sum(axis=2).max(axis=0) for run in runs], axis=0)
    with torch.no_grad():
        p = made.regional()
        assert made.penalty().item() == 0.0
    u_max, adjacency = scenario.network.u_max, scenario.network.adjacency
    np.testing.assert_allclose(p.mfd.jam, 0.7 * largest, rtol=1e-5)
    np.testing.assert_allclose(p.storage, 2.0 * largest, rtol=1e-5)
    np.testing.assert_allclose(u_max * p.capacity, 1.2 * 60.0 / 30.0 * adjacency, rtol=1e-5)
    assert (p.exit_rates == 1.0).all()


def test_a_fit_reports_its_progress(scenario, runs):
    notes = []
    identification.fit(
        scenario.network, runs[:1], step=30.0, iterations=2, progress=lambda *n: notes.append(n)
    )
    assert [note[:2] for note in notes] == [(1, 2), (2, 2)]
    assert all(note[2].startswith("misfit 0.") for note in notes)


@pytest.fixture
def model(scenario, runs):
    """Free numbers far from where a fit begins."""
    made = identification._Model(scenario.network, runs, 30.0, 1.0 / 30.0)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for numbers in made.parameters():
            numbers += torch.randn(numbers.shape, generator=generator)
    return made


def test_any_free_numbers_are_a_valid_model(model):
    """q = c (1 - first y - second y^2) falls from c, to a hundredth at the least; y = x / jam."""
    p = model.regional()
    c, first, second, jam = model.shape()
    assert (first >= 0).all()
    assert (first + 2.0 * second >= 0).all()
    assert (first + second <= 0.99).all()
    for y in (0.0, 0.3, 1.0):
        torch.testing.assert_close(dynamics.rate(p, y * jam), c * (1.0 - first * y - second * y**2))
    torch.testing.assert_close(dynamics.rate(p, 2.0 * jam), 0.5 * c * (1.0 - first - second))
    fastest = (p.mfd.c[:, None] * p.exit_rates).max().item()
    assert fastest <= 1.0 / 30.0
    assert p.exit_rates.max() <= 8.0
    assert p.exit_rates.min() >= 1.0 / 8.0
    assert model.penalty().item() > 0.0


def test_the_network_flows_as_the_free_numbers_do(scenario, runs, model):
    """Its exit rates are scaled, and its capacities are those at u_max: the flows stay what they
    were."""
    network = identification._network(scenario.network, model, runs)
    random = np.random.default_rng(2)
    x = torch.from_numpy(random.uniform(0.0, 400.0, (7, 7)))
    perimeter, splits = map(torch.from_numpy, tiny.random_controls(random, network))
    expected = dynamics.flows(model.regional(), x.float(), perimeter.float(), splits.float())
    for mine, free in zip(
        dynamics.flows(dynamics.parameters(network), x, perimeter, splits), expected, strict=True
    ):
        assert free.abs().max() > 0.0
        torch.testing.assert_close(mine, free.detach().double(), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("by_origin", [True, False])
def test_what_a_fit_makes_small(scenario, runs, by_origin):
    """Errors that cancel out in their regions count by destination only; far ones linearly."""
    p, scheme = dynamics.parameters(scenario.network, dtype=torch.float32), {"step": 30.0}
    observed, *rest = identification.windows(runs[:1], 2)
    scale = torch.full((7,), 50.0)
    missed = torch.zeros(7, 7)
    missed[1, 3] = 100.0
    missed[(1, 5) if by_origin else (5, 3)] = -100.0
    wrong = observed.clone()
    wrong[:, 1:] += missed
    far = (2.0 - 0.5 * identification.OUTLIER) * 2.0  # two errors of twice the scale
    found = identification._misfit(p, Windows(wrong, *rest), scale, scheme)
    assert found == pytest.approx(
        identification.BY_DESTINATION * far / 49 + (0.0 if by_origin else far / 7), rel=1e-3
    )


def test_a_run_shorter_than_the_horizon_is_left_out(runs):
    short = replace(runs[0], accumulation=runs[0].accumulation[:4], demand=runs[0].demand[:3])
    assert len(identification.windows([short, runs[0]], 5)[0]) == len(
        identification.windows(runs[:1], 5)[0]
    )


def test_the_learning_rate_falls_from_first_to_last():
    rates = [identification._learning_rate(k, 100) for k in range(101)]
    assert (np.diff(rates) < 0.0).all()
    assert rates[::50] == pytest.approx([0.03, 0.03 * 0.525, 0.03 * 0.05])


def test_split_ratios_are_the_shares_of_crossings(scenario):
    """Of turns that are allowed; rare ones count as none, and few vehicles give no ratio."""
    crossings = np.zeros((7, 7, 7))
    crossings[0, [1, 3, 2, 5], 2] = 60.0, 39.6, 0.4, 900.0  # 5 is not beside 0
    crossings[0, 1, 6] = 29.0
    crossings[0, 3, 5] = 30.0
    ratios = identification.observed_split_ratios(scenario.network, crossings)
    assert ratios == {
        (0, 2): {1: pytest.approx(0.6024, abs=1e-4), 3: pytest.approx(0.3976, abs=1e-4)},
        (0, 5): {3: 1.0},
    }
