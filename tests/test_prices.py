"""Prices and metering as outputs of a trained network; their bounds are in test_dpc.py."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from commands import good, nmfd

from cosim.evaluation.model_validation import expected_splits
from cosim.plant.strategy import parse
from nmfd.api import load_scenario, run
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.model.answer import Answer
from nmfd.model.plant import NmfdPlant
from nmfd.studies.benchmark import lower_bound
from nmfd.types import Observation


def test_every_decoder_descends_the_total_time_spent():
    planning = parse("dpc-pcrg+max-pressure").own_planning(load_scenario("grid7_peak"))
    rollout = Rollout(planning, dtype=torch.float64)
    torch.manual_seed(0)
    made = Policy(
        planning.network, Architecture(width=16, guidance=True, prices=True, metering=True)
    ).double()
    x, demand = rollout.random_start(4, 0.2, 1.0, torch.Generator().manual_seed(1))

    def total():
        return rollout.total_time_spent(made, 2.0 * x, 2.0 * demand[:12], torch.Generator()).sum()

    total().backward()
    assert len(made.decoders) == 3
    for decoder in made.decoders:
        way, values = torch.randn_like(decoder.bias), []
        with torch.no_grad():
            for step in (1e-4, -2e-4):
                decoder.bias.add_(step * way)
                values.append(float(total()))
            decoder.bias.add_(1e-4 * way)
        expected = (values[0] - values[1]) / 2e-4
        assert float((decoder.bias.grad * way).sum()) == pytest.approx(expected, rel=1e-3)
        assert abs(expected) > 1.0


def test_a_trained_network_closes_the_loop_and_its_trips_wait(tmp_path):
    folder = tiny.write(tmp_path)
    options = "prices = true\nmetering = true\nsteps = 6\nfrom_no_control = true\n"
    table = f"\n[controllers.dpc-pcrg]\n{options}"
    (folder / "scenario.toml").write_text((folder / "scenario.toml").read_text() + table)
    good(nmfd("train", folder, "--controller dpc-pcrg"))
    scenario = load_scenario(folder)
    scenario = replace(scenario, demand=6.0 * scenario.demand)
    controller = parse("dpc-pcrg").make(scenario)
    result = run(scenario, controller)
    expected = (
        controller.policy.prices(torch.from_numpy(result["observed"][:-1]).float()).detach().numpy()
    )
    np.testing.assert_allclose(result["prices"], expected, rtol=1e-4)
    assert result["prices"].max() < 1.0
    assert result["backlog"].max() > 1.0


def test_the_lower_bound_without_metering_is_not_that_of_a_policy_that_meters():
    scenario, strategy = load_scenario("economic_mpc"), parse("dpc-pcrg")
    assert lower_bound(scenario, strategy, "nmfd") > 4e7
    metered = replace(scenario, controller_options={"dpc-pcrg": {"metering": True}})
    assert np.isnan(lower_bound(metered, strategy, "nmfd"))


@pytest.mark.slow
def test_mpc_of_grid7_has_the_outputs_of_the_policy():
    """The script prices the filling centre most, and meters by the room that every region has
    left."""
    scenario = load_scenario("grid7_peak", {"demand_factor": 2.0})
    strategy = parse(
        f"{scenario.folder}/price_mpc.py:PriceMpc+max-pressure+guidance-period-60+metering"
    )
    x = run(scenario, "no-control", steps=12)["accumulation"][12]
    controls = strategy.make(scenario).act(
        Observation(step=12, time=1080.0, accumulation=x, backlog=0.0 * x)
    )
    assert controls.prices.argmax() == 3
    assert controls.prices[3] > 0.5
    critical = strategy.own_planning(scenario).network.critical
    np.testing.assert_allclose(controls.metering, (1.2 * critical - x.sum(1)) / 90.0, rtol=1e-4)


class AnsweringPlant(NmfdPlant):
    guides_by_prices = True


def test_a_price_everywhere_diverts_nobody_from_ways_that_take_the_same_time():
    """Prices of all regions are proportional to times, so that only unequal times divert."""
    network = tiny.limited(load_scenario("economic_mpc").network)
    network = replace(network, exit_rates=np.ones((7, 7)))
    x = torch.zeros(7, 7)
    nominal = torch.tensor(network.nominal_splits, dtype=torch.float32)
    alike = Answer(network)(x, torch.full((7,), 1.4))
    other = Answer(network)(x, torch.tensor([0.0, 0.0, 0.0, 1.4, 0.0, 0.0, 0.0]))
    torch.testing.assert_close(alike, nominal, atol=1e-4, rtol=0.0)
    assert (other - nominal).abs().max() > 0.1


def test_expected_splits_are_written_as_commanded_only_where_they_are_obeyed():
    scenario = tiny.part(load_scenario("grid7_peak"), 0, 3)
    rule = parse("pricing-rule(numbers=[1.0,1.0,0.0,9.0,0.0,0.0,0.6,1.5])")
    x = np.where(scenario.network.split_mask.any(axis=1), 50.0, 0.0)
    scenario = replace(scenario, initial=x)
    obeyed = run(scenario, rule.make(scenario))
    assert "expected_splits" not in obeyed
    nominal = scenario.network.nominal_splits
    assert np.abs(obeyed["splits"][0] - nominal).max() > 0.1
    answered = run(scenario, rule.make(scenario), plant=AnsweringPlant(scenario))
    np.testing.assert_array_equal(answered["expected_splits"][0], obeyed["splits"][0])
    np.testing.assert_array_equal(answered["splits"][0], nominal)
    np.testing.assert_array_equal(expected_splits(answered), answered["expected_splits"])
    np.testing.assert_array_equal(expected_splits(obeyed), obeyed["splits"])


@pytest.fixture
def priced():
    """Return grid7, its accumulations, and a price of 5 for its centre."""
    network = parse("dpc-pcrg+max-pressure").own_planning(load_scenario("grid7_peak")).network
    return network, torch.full((7, 7), 20.0), 5.0 * torch.eye(7)[3]


def test_a_price_that_is_the_same_everywhere_changes_no_way(priced):
    network, x, centre = priced
    answer = Answer(network)
    assert torch.allclose(answer(x, torch.full_like(centre, 19.0)), answer.own, atol=1e-6)
    assert torch.allclose(answer(x, 2.0 * centre + 1.0), answer(x, centre), atol=1e-6)
    assert not torch.allclose(answer(x, centre), answer.own, atol=0.05)


def test_the_longest_delay_bounds_how_many_a_price_diverts(priced):
    network, x, centre = priced
    network = replace(network, dispersion=60.0)
    plain = Answer(replace(network, longest_delay=None))
    bounded = Answer(replace(network, longest_delay=30.0))
    own = plain.own[2, 3, 4]  # from west to east through the centre; others go around it
    assert plain(x, 10.0 * centre)[2, 3, 4] < 1e-6
    odds = np.exp(-30.0 / 60.0) * own  # if no other way were delayed
    assert odds / (odds + 1.0 - own) <= bounded(x, 10.0 * centre)[2, 3, 4] < own
    small = 1e-3 * centre
    torch.testing.assert_close(bounded(x, small), plain(x, small), atol=1e-3, rtol=0.0)


def test_drivers_answer_prices_by_the_dispersion_of_their_destination(priced):
    network, x, centre = priced
    dispersion = np.full((7, 7), 1e4)
    dispersion[2, 4] = 60.0
    answer = Answer(replace(network, dispersion=dispersion))
    through_centre = (answer(x, centre) / answer.own)[:, 3]
    assert through_centre[2, 4] < 0.5
    assert through_centre[4, 2] > 0.9
