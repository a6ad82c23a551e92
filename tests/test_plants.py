"""The two regional plants: conservation, what the acyclic one forbids, and their agreement without
control."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
from tiny import random_controls

from nmfd import api
from nmfd.api import load_scenario
from nmfd.metrics import total_time_spent
from nmfd.model import acyclic
from nmfd.model.plant import AcyclicPlant, NmfdPlant
from nmfd.types import Controls

SCENARIO = load_scenario("economic_mpc")
LIMITED = tiny.limited(SCENARIO.network)
KINDS = pytest.mark.parametrize(
    "network",
    [SCENARIO.network, LIMITED, tiny.mixed(LIMITED)],
    ids=["published", "limited", "mixed"],
)


def busy(seed, **changes):
    """The benchmark with random demand between all regions, and beyond the jam."""
    demand = np.random.default_rng(seed).uniform(0.0, 0.8, SCENARIO.demand.shape)
    demand[160:] = 0.0
    return replace(SCENARIO, demand=demand, **changes)


def completions(network, accumulation):
    rates = np.ones((7, 7)) if network.exit_rates is None else network.exit_rates
    return sum(
        rates[i, i] * mfd.rate(row.sum()) * row[i]
        for i, (mfd, row) in enumerate(zip(network.mfds, accumulation, strict=True))
    )


@KINDS
@pytest.mark.parametrize("make", [NmfdPlant, AcyclicPlant])
def test_conservation_and_non_negativity_under_random_controls(make, network):
    """Trip ends, integrated here from the states, account for every vehicle that is no longer
    there."""
    scenario, random = busy(0, network=network), np.random.default_rng(1)
    plant = make(scenario)
    measured, ended, entered = plant.reset(0), 0.0, 0.0
    for k in range(scenario.steps):
        ended += scenario.step * completions(network, measured.accumulation)
        entered += scenario.step * scenario.demand[k].sum()
        perimeter, splits = random_controls(random, network)
        measured = plant.step(Controls(perimeter=perimeter, splits=splits))
        assert measured.accumulation.min() >= 0.0
        assert abs(entered - ended - measured.accumulation.sum()) <= 1e-6
        assert abs(measured.completed - ended) <= 1e-6
    assert ended > 10_000.0


@KINDS
def test_without_control_both_plants_are_the_same(network):
    """Shortest ways never turn back."""
    scenario = replace(SCENARIO, network=network)
    nmfd, anmfd = (api.run(scenario, "no-control", plant=name) for name in ("nmfd", "acyclic"))
    assert total_time_spent(anmfd) == pytest.approx(total_time_spent(nmfd), rel=1e-3)
    np.testing.assert_allclose(anmfd.accumulation, nmfd.accumulation, rtol=0.0, atol=1e-6)


def test_no_control_forces_no_move():
    plant = AcyclicPlant(SCENARIO)
    api.run(SCENARIO, "no-control", plant=plant)
    assert plant.forced_moves == 0.0


def test_no_way_leads_back_to_the_origin_or_the_previous_region():
    model = acyclic.build(SCENARIO.network)
    onward, cell = model.move_onward, model.move_from
    assert (model.move_next != model.origin[cell])[onward].all()
    assert (model.move_next != model.previous[cell])[onward].all()
    assert SCENARIO.network.adjacency[model.region[cell], model.move_next].all()
    assert (model.previous[model.move_to] == model.region[cell]).all()
    assert (model.origin[model.move_to] == model.origin[cell]).all()
    assert (model.destination[model.move_to] == model.destination[cell]).all()


def test_shares_sum_to_one_and_are_theta_renormalised():
    model = acyclic.build(SCENARIO.network)
    _, splits = random_controls(np.random.default_rng(5), SCENARIO.network)
    theta, forced = acyclic.shares(model, splits)
    sums = np.bincount(model.move_from, theta, minlength=len(model.region))
    np.testing.assert_allclose(sums, model.region != model.destination, atol=1e-12)
    # From 0 by way of 3 (o = g = 0, i = 3) to 6: 1, 2, 4, 5 and 6 are left, 0 is not.
    here = (
        (model.origin == 0) & (model.previous == 0) & (model.region == 3) & (model.destination == 6)
    )
    moves = here[model.move_from]
    expected = splits[3, model.move_next[moves], 6]
    assert sorted(model.move_next[moves]) == [1, 2, 4, 5, 6]
    np.testing.assert_allclose(theta[moves], expected / expected.sum(), atol=1e-12)
    assert not forced[here].any()


def test_what_theta_leaves_no_way_on_is_forced_and_counted(tmp_path):
    """In a row of regions 0-1-2, trips from 1 to 0 that are sent into the dead end 2 must turn back
    there."""
    scenario = load_scenario(
        tiny.write(
            tmp_path,
            network=tiny.row_network(3),
            scenario=tiny.SCENARIO.replace("from = 0\nto = 1", "from = 1\nto = 0"),
        )
    )
    splits = scenario.network.nominal_splits.copy()
    splits[1, :, 0] = [0.0, 0.0, 1.0]
    controls = Controls(perimeter=scenario.network.adjacency * 0.9, splits=splits)
    plant = AcyclicPlant(scenario)
    states = [plant.reset(0)] + [plant.step(controls) for _ in range(scenario.steps)]
    entered = scenario.step * scenario.demand.sum()
    assert states[-1].accumulation[2, 0] > 0.0
    assert 0.0 < plant.forced_moves < 2.0 * entered
    assert states[-1].completed + states[-1].accumulation.sum() == pytest.approx(entered, abs=1e-6)
    plant.reset(0)
    assert plant.forced_moves == 0.0
