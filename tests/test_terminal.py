"""MPC's terminal cost: its derivatives, what MPC gains by it, its file."""

import runpy
from dataclasses import replace

import numpy as np
import pytest
from copies import ROOT

import nmfd
from nmfd.api import load_scenario
from nmfd.controllers.mpc import edge_model, terminal
from nmfd.controllers.mpc.controller import EconomicMpc, MpcController
from nmfd.controllers.strategy import check_tables, parse
from nmfd.errors import InputError
from nmfd.model.planning import planning_model

NAME = "mpc-pc-terminal"
SCRIPT = ROOT / "scenarios" / "economic_mpc" / "terminal_cost.py"
script = runpy.run_path(str(SCRIPT))
learn, write = script["learn"], script["write"]


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("economic_mpc")


@pytest.fixture(scope="module")
def learned(scenario):
    """Not much, but something."""
    return learn(scenario, NAME, seed=0, samples=256, rounds=1, steps=150)


def crowded(scenario, seed=0):
    """Cells (C,) [veh]."""
    planning = planning_model(scenario)
    return np.random.default_rng(seed).uniform(
        0.0, 400.0, planning.network.regions * planning.destinations.sum()
    )


def test_the_slope_is_that_of_the_value(scenario, learned):
    x = crowded(scenario)
    for step in (3, 120, 239):
        value, slope = learned(x, step)
        for cell in range(0, len(x), 10):
            moved = x.copy()
            moved[cell] += 1e-3
            assert (learned(moved, step)[0] - value) / 1e-3 == pytest.approx(
                slope[cell], rel=1e-3, abs=1e-4
            )
    assert learned(x, 240)[0] == learned(x, 300)[0] == 0.0
    assert not learned(x, 240)[1].any()


def test_more_vehicles_cost_more_and_the_later_the_less(scenario, learned):
    x = crowded(scenario)
    values = [
        learned(share * x, step)[0] for share, step in ((1.5, 60), (1.0, 60), (0.5, 60), (0.5, 230))
    ]
    assert values == sorted(values, reverse=True)


def test_the_plan_descends_on_both_sums(scenario, learned):
    """The gradient of edge_model with what lies beyond, by finite differences."""
    planning = parse(NAME).own_planning(scenario)
    mpc = MpcController(planning, EconomicMpc(), terminal=learned)
    used = np.flatnonzero(planning.destinations)
    model = edge_model.build(planning.network, used, guidance=False, step=planning.step)
    start, demand = (
        crowded(scenario),
        planning.forecast[:8][:, :, planning.destinations].reshape(8, -1),
    )
    plan = 0.8 * mpc.admissible.open(8)

    def total(plan, **chosen):
        return edge_model.vehicle_steps(
            model, start, demand, plan, beyond=lambda x: learned(x, 100), **chosen
        )

    without = edge_model.vehicle_steps(model, start, demand, plan)[0]
    value, slope = total(plan, gradient=True)
    assert value > without
    for k, edge in ((0, 0), (4, 7), (7, 11)):
        moved = plan.copy()
        moved[k, edge] += 1e-4
        assert (total(moved)[0] - value) / 1e-4 == pytest.approx(slope[k, edge], rel=1e-3, abs=1e-2)
    assert slope[7].any(), "the last controls matter"


@pytest.mark.slow
def test_mpc_looks_beyond_its_horizon(scenario, learned):
    """Even with what little was learned here."""
    planning = parse(NAME).own_planning(scenario)
    plain, far = (
        nmfd.run(scenario, MpcController(planning, EconomicMpc(), terminal=known), seed=1)
        for known in (None, learned)
    )
    assert far["accumulation"].sum() < 0.9 * plain["accumulation"].sum()
    assert (plain.controller, far.controller) == ("mpc-pc", NAME)
    assert not far["status"].any()


@pytest.mark.parametrize(
    "name, most", [("mpc-pc-terminal", 8.787e7), ("mpc-pcrg-terminal", 5.475e7)]
)
def test_the_committed_ones_come_within_five_percent_of_the_bound(scenario, name, most):
    run = nmfd.run(scenario, name, seed=1)
    assert most < 30.0 * run.accumulation[:-1].sum() < 1.05 * most


@pytest.mark.slow
def test_the_same_seed_learns_the_same_and_the_file_keeps_it(scenario, learned, tmp_path):
    again = learn(scenario, NAME, seed=0, samples=256, rounds=1, steps=150)
    other = learn(scenario, NAME, seed=1, samples=256, rounds=1, steps=150)
    x, planning = crowded(scenario), planning_model(scenario)
    assert again(x, 50)[0] == learned(x, 50)[0] != other(x, 50)[0]
    write(learned, tmp_path / "value.npz")
    read = terminal.read(tmp_path / "value.npz", planning, NAME)
    np.testing.assert_allclose(read(x, 50)[1], learned(x, 50)[1])
    for wrong, expected in (
        (replace(planning, network=replace(planning.network, u_min=0.2)), "network_hash"),
        (replace(planning, forecast=planning.forecast + 1.0), "other destinations"),
    ):
        with pytest.raises(InputError, match=expected):
            terminal.read(tmp_path / "value.npz", wrong, NAME)
    with pytest.raises(InputError, match="of mpc-pc-terminal, not of mpc-pcrg-terminal"):
        terminal.read(tmp_path / "value.npz", planning, "mpc-pcrg-terminal")
    (tmp_path / "value.npz").write_bytes(b"PK nothing")
    with pytest.raises(InputError, match="is no value function"):
        terminal.read(tmp_path / "value.npz", planning, NAME)


def test_ipopt_knows_none(scenario):
    ordered = replace(scenario, controller_options={NAME: {"solver": "ipopt"}})
    with pytest.raises(InputError, match="ipopt has no terminal cost"):
        check_tables(ordered)
