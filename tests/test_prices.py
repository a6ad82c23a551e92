"""Prices and metering as outputs of a trained network."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from commands import good, nmfd

from nmfd import closed_loop
from nmfd.api import load_scenario
from nmfd.controllers.dpc.policy import FILL_TIME_S, MOST_PRICE, Architecture, DpcController, Policy
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.controllers.strategy import parse
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import load_network
from nmfd.types import Observation

NETWORK = load_network("grid7_max_pressure")


def policy(network=NETWORK, sparse=False):
    torch.manual_seed(0)
    return Policy(network, Architecture(width=16, guidance=True, prices=True, metering=True, sparse=sparse))


@pytest.mark.parametrize("sparse", [False, True])
def test_any_weights_and_any_state_give_admissible_controls(sparse):
    made, random = policy(sparse=sparse), np.random.default_rng(0)
    with torch.no_grad():
        for weights in made.parameters():
            weights.add_(torch.randn_like(weights))
    network, found = NETWORK, []
    for scale in (0.0, 1.0, 1e2, 1e4):
        x = scale * random.random((7, 7))
        controls = DpcController(made).act(Observation(step=0, time=0.0, accumulation=x, backlog=0.0 * x))
        assert (controls.prices >= 0.0).all() and (controls.prices <= MOST_PRICE).all()
        assert (controls.metering >= 0.0).all() and (controls.metering <= network.critical / FILL_TIME_S + 1e-5).all()
        u = controls.perimeter[network.adjacency]
        assert network.u_min - 1e-6 <= u.min() and u.max() <= network.u_max + 1e-6
        assert (controls.splits[~network.split_mask] == 0.0).all() and controls.splits.min() >= 0.0
        np.testing.assert_allclose(controls.splits.sum(axis=1), 1.0 - np.eye(7), rtol=0.0, atol=1e-9)
        found.append(controls.prices)
    assert np.ptp(found) > 0.5 * MOST_PRICE


def test_every_decoder_descends_the_total_time_spent():
    scenario = load_scenario("grid7_peak")
    planning = replace(planning_model(scenario, "dpc-pcrg", "dpc-pcrg+max-pressure"), measurement_std=0.0)
    made, rollout = policy(planning.network).double(), Rollout(planning, dtype=torch.float64)
    x, demand = rollout.random_start(4, 0.2, 1.0, torch.Generator().manual_seed(1))

    def total():
        return rollout.total_time_spent(made, 2.0 * x, 2.0 * demand[:12], torch.Generator()).sum()

    total().backward()
    assert len(made.decoders) == 3
    for decoder in made.decoders:
        weights, way = decoder.bias, torch.randn_like(decoder.bias)
        with torch.no_grad():
            values = []
            for step in (1e-4, -1e-4):
                weights.add_(step * way)
                values.append(total())
                weights.sub_(step * way)
        expected = float(values[0] - values[1]) / 2e-4
        assert float((weights.grad * way).sum()) == pytest.approx(expected, rel=1e-3) and abs(expected) > 1.0


def test_a_trained_network_closes_the_loop_and_its_trips_wait(tmp_path):
    folder = tiny.write(tmp_path)
    table = "\n[controllers.dpc-pcrg]\nprices = true\nmetering = true\nsteps = 6\nfrom_no_control = true\n"
    (folder / "scenario.toml").write_text((folder / "scenario.toml").read_text() + table)
    good(nmfd("train", folder, "--controller", "dpc-pcrg"))
    scenario = load_scenario(folder)
    scenario = replace(scenario, demand=6.0 * scenario.demand)
    controller = parse("dpc-pcrg").make(scenario)
    run = closed_loop.run(NmfdPlant(scenario), controller, scenario, seed=0)
    x = torch.from_numpy(run.observed[:-1]).float()
    np.testing.assert_allclose(run.prices, controller.policy.prices(x).detach().numpy(), rtol=1e-4)
    assert run.prices.max() < 1.0 and run.backlog.max() > 1.0
