"""Compact policies: controls, gradients, training and files."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import tiny
import torch
from commands import good, nmfd

from nmfd.api import load_scenario
from nmfd.controllers import training
from nmfd.controllers.dpc.compact import FILL_TIME_S, CompactPolicy
from nmfd.controllers.dpc.first_policy import first_policy
from nmfd.controllers.dpc.numbers import Numbers
from nmfd.controllers.dpc.options import ConstantControl
from nmfd.controllers.dpc.policy import Architecture, DpcController
from nmfd.controllers.dpc.policy_file import load_policy
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.controllers.dpc.single_changes import (
    DOUBLED,
    GATE,
    HALVED,
    LOOSER,
    OPEN,
    STRICTER,
    UNMETERED,
    UNPRICED,
    UNPRICED_ELSEWHERE,
    changed_policies,
)
from nmfd.controllers.rules import scenario_gate
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError, RunFailed
from nmfd.model.planning import planning_model
from nmfd.types import Observation

NUMBERS = Numbers(
    set_point=1.1,
    gain=2.0,
    relief=0.5,
    price=3.0,
    price_from=0.7,
    elsewhere=0.4,
    elsewhere_from=1.2,
    metering=1.3,
)
CENTRE = 3
TABLE = """
[controllers.dpc-pcrg]
compact = true
numbers = [1.0, 2.0, 0.0, 0.0, 0.6, 0.0, 0.6, 1.5]
kept = ["gain"]
steps = 5
learning_rate = 0.05

[controllers.gating-rule]
numbers = [1.0, 2.0, 0.0, 0.0, 0.6, 0.0, 0.6, 1.5]
"""


@pytest.fixture(scope="module")
def network():
    return load_scenario("economic_mpc").network


def policy(network, numbers=NUMBERS, guidance=True, metering=False):
    made = CompactPolicy(
        network, Architecture(guidance=guidance, compact=(CENTRE,), metering=metering)
    )
    with torch.no_grad():
        made.numbers.copy_(torch.tensor(numbers))
    return made


def crowded(network, seed=0):
    """(R, R) [veh], regions from half to twice their critical accumulation."""
    random = np.random.default_rng(seed)
    full = 2.0 * network.critical[:, None] * random.uniform(0.25, 1.0, (network.regions, 1))
    return full * random.dirichlet(np.ones(network.regions), network.regions)


def test_gates_and_prices_are_those_of_the_formula(network):
    x = crowded(network)
    seen = tiny.seen(x)
    controls = DpcController(policy(network)).act(seen)
    full = x.sum(axis=1) / network.critical
    for i, h in np.argwhere(network.adjacency):
        wanted = 4.0 * (2.0 * (1.1 - full[h]) + 0.5 * max(full[i] - 1.0, 0.0))
        share = 1.0 / (1.0 + np.exp(-wanted)) if h == CENTRE else 1.0
        expected = network.u_min + (network.u_max - network.u_min) * share
        assert controls.perimeter[i, h] == pytest.approx(expected, abs=1e-5)
    expected = np.where(
        np.arange(network.regions) == CENTRE,
        3.0 * np.maximum(full - 0.7, 0.0),
        0.4 * np.maximum(full - 1.2, 0.0),
    )
    np.testing.assert_allclose(controls.prices, expected, atol=1e-5)
    assert controls.metering is None
    controls = DpcController(policy(network, metering=True)).act(seen)
    expected = np.maximum(1.3 - full, 0.0) * network.critical / FILL_TIME_S
    np.testing.assert_allclose(controls.metering, expected, rtol=1e-5, atol=1e-5)
    assert (controls.prices > 0.0).any()
    assert (controls.prices == 0.0).any()


def test_trips_wait_for_the_protected_regions_wherever_they_begin(network):
    critical, seen = network.critical, set()
    for seed, gain in product(range(6), (1.0, 2.5)):
        numbers = NUMBERS._replace(metering=1.4, metering_protected=1.1, metering_gain=gain)
        made = policy(network, numbers, metering=True)
        x = crowded(network, seed)
        full = x.sum(axis=1) / critical
        centre = gain * (1.1 - full[CENTRE])
        room = np.maximum(np.minimum(1.4 - full, centre), 0.0)
        found = made.metering(torch.from_numpy(x)).detach().numpy()
        np.testing.assert_allclose(found, room * critical / FILL_TIME_S, rtol=1e-4, atol=1e-5)
        seen |= {(gain, "own" if a < centre else "protected" if a > 0.0 else "none") for a in room}
    assert seen == set(product((1.0, 2.5), ("own", "protected", "none")))


def test_with_an_integral_it_contains_the_pi_gate_and_relief_comes_on_top(network):
    scenario = load_scenario("economic_mpc")
    critical, span, ki = network.mfds[CENTRE].critical, network.u_max - network.u_min, 0.005
    planning = replace(
        planning_model(scenario),
        protected=(CENTRE,),
        controller_options={"pi-gating": {"set_point": [0.8 * critical], "kp": 1.2, "ki": ki}},
    )
    gate = scenario_gate(planning)
    numbers = Numbers(set_point=0.8, gain=1.2 / span, integral=ki * planning.step / span)
    alone, relieved = (
        DpcController(policy(network, numbers._replace(relief=relief), guidance=False))
        for relief in (0.0, 0.25)
    )
    before = int(np.flatnonzero(network.adjacency[:, CENTRE])[0])
    x, seen = np.zeros((network.regions,) * 2), []
    x[before, before] = 1.4 * network.mfds[before].critical
    for seed in range(2):
        for controller in (gate, alone, relieved):
            controller.reset(seed)
        for k, full in enumerate((0.2, 0.7, 0.9, 1.0, 0.8, 0.8, 0.4, 3.2, 3.0, 0.7)):
            x[CENTRE, CENTRE] = full * critical
            expected, found, more = (
                controller.act(tiny.seen(x, k)).perimeter for controller in (gate, alone, relieved)
            )
            np.testing.assert_allclose(found, expected, atol=1e-5)
            np.testing.assert_allclose(
                np.delete(more, before, axis=0), np.delete(expected, before, axis=0), atol=1e-5
            )
            relieved_u = min(expected[before, CENTRE] + 0.25 * 0.4 * span, network.u_max)
            assert more[before, CENTRE] == pytest.approx(relieved_u, abs=1e-5)
            seen.append(expected[before, CENTRE])
    assert max(seen) == network.u_max
    assert min(seen) == network.u_min
    assert len(set(seen)) >= 5


def test_the_regional_model_sends_fewer_through_a_dear_region_and_nobody_where_there_is_no_way(
    network,
):
    x = torch.from_numpy(crowded(network)).float()
    own = network.nominal_splits
    free = policy(network, NUMBERS._replace(price=0.0, elsewhere=0.0))(x)[1].detach().numpy()
    np.testing.assert_allclose(free, own, atol=1e-6)
    x[CENTRE] *= 1.5 * network.mfds[CENTRE].critical / x[CENTRE].sum()
    splits = policy(network, NUMBERS._replace(elsewhere=0.0))(x)[1].detach().numpy()
    np.testing.assert_allclose(splits.sum(axis=1), own.sum(axis=1), atol=1e-6)
    assert (splits[~network.split_mask] == 0.0).all()
    others = [j for j in range(network.regions) if j != CENTRE]
    through = np.array(
        [[splits[i, CENTRE, j] - own[i, CENTRE, j] for j in others if j != i] for i in others]
    )
    assert (through < 1e-6).all()
    assert through.min() < -0.05
    np.testing.assert_allclose(
        splits[:, :, CENTRE], own[:, :, CENTRE], atol=1e-6
    )  # a price is paid on any way there


def test_every_number_has_a_gradient_and_perimeter_control_alone_has_no_prices(network):
    x = torch.from_numpy(np.stack([crowded(network, seed) for seed in range(4)])).float()
    made = policy(network, NUMBERS._replace(metering_protected=1.1), metering=True)
    perimeter, splits = made(x)
    drawn = [(part * torch.rand_like(part)).sum() for part in (perimeter, splits)]
    (sum(drawn) + made.metering(x).sum()).backward()
    grad = Numbers(*made.numbers.grad.abs())
    assert grad.integral == 0.0  # which no rollout has
    assert min(grad._replace(integral=1.0)) > 0.0
    alone = policy(network, guidance=False)
    assert alone.prices(x) is None
    assert alone(x)[1] is None


def test_it_is_trained_and_kept_in_a_file(tmp_path):
    scenario = tiny.write(tmp_path, scenario=tiny.SCENARIO + TABLE)
    good(nmfd("train", scenario, "--controller dpc-pcrg"))
    loaded = load_scenario(scenario)
    trained, content = load_policy(scenario / "dpc-pcrg.pt", loaded.network)
    rule = parse("gating-rule").make(loaded)
    assert rule.policy.numbers.tolist() == pytest.approx(
        [1.0, 2.0, 0.0, 0.0, 0.6, 0.0, 0.6, 1.5, 0.0, 0.0, 1.0, 1.0]
    )
    assert isinstance(trained, CompactPolicy)
    assert (trained.numbers != rule.policy.numbers).any()
    assert trained.numbers[1] == rule.policy.numbers[1]  # kept
    setup = training.settings(loaded, parse("dpc-pcrg"))
    untrained = training.validate(
        rule.policy, Rollout(parse("dpc-pcrg").own_planning(loaded)), 0, setup
    )
    assert content["configuration"]["validation_veh_s"] < untrained
    good(nmfd("benchmark", scenario, "--controllers dpc-pcrg,gating-rule --out", tmp_path / "out"))


def test_each_region_has_its_own_accumulation_that_counts_as_full(network):
    seen = replace(network, critical_above={0: 100.0})
    shape = Architecture(guidance=True, compact=(CENTRE,), per_region=True, metering=True)
    own = CompactPolicy(seen, shape)
    with torch.no_grad():
        own.numbers.copy_(torch.tensor(NUMBERS))
        own.log_full[1] = np.log(2.0)
    full = network.critical
    full[:2] = 100.0, 2.0 * full[1]
    state = crowded(network)
    rates = full * np.maximum(NUMBERS.metering - state.sum(axis=1) / full, 0.0) / FILL_TIME_S
    assert own.metering(torch.tensor(state)).detach().numpy() == pytest.approx(rates, rel=1e-4)


def test_training_finds_what_counts_as_full(tmp_path):
    table = TABLE.replace("compact = true", "compact = true\nper_region = true")
    scenario = tiny.write(tmp_path, scenario=tiny.SCENARIO + table)
    good(nmfd("train", scenario, "--controller dpc-pcrg"))
    loaded = load_scenario(scenario)
    trained, _ = load_policy(scenario / "dpc-pcrg.pt", loaded.network)
    assert (trained.log_full[list(loaded.protected)] != 0.0).all()


def test_training_begins_with_the_policy_of_a_file(tmp_path):
    scenario = load_scenario(tiny.write(tmp_path, scenario=tiny.SCENARIO + TABLE))
    strategy = parse("dpc-pcrg")
    file = training.train(scenario, strategy, seed=0, out=tmp_path / "first.pt")
    setup = training.settings(scenario, strategy).changed(numbers=None, start=file)
    planning = strategy.own_planning(scenario)
    begun = first_policy(setup, planning, guidance=True)
    trained, _ = load_policy(file, scenario.network)
    assert begun.numbers.tolist() == trained.numbers.tolist()
    with pytest.raises(InputError, match="first.pt: per_region: is False, but the settings train"):
        first_policy(setup.changed(per_region=True), planning, guidance=True)


def test_prices_that_gain_nothing_are_left_out(tmp_path):
    priced = TABLE.replace("0.0, 0.6, 0.0, 0.6, 1.5]\nkept", "1.0, 0.0, 1.0, 0.0, 1.5]\nkept")
    scenario = tiny.write(tmp_path, scenario=tiny.SCENARIO + priced)
    good(nmfd("train", scenario, "--controller dpc-pcrg"))
    trained, _ = load_policy(scenario / "dpc-pcrg.pt", load_scenario(scenario).network)
    numbers = Numbers(*trained.numbers.tolist())
    assert (numbers.price, numbers.elsewhere) == (0.0, 0.0)


def test_a_compact_policy_that_diverges_is_an_error(tmp_path, monkeypatch):
    scenario = load_scenario(tiny.write(tmp_path, scenario=tiny.SCENARIO + TABLE))
    monkeypatch.setattr(training, "validate", lambda *_: np.nan)
    with pytest.raises(RunFailed, match="lower the learning rate"):
        training.train(scenario, parse("dpc-pcrg"), seed=0, out=tmp_path / "p.pt")


def test_descent_from_a_saturated_gate_takes_the_single_change_that_gains(tmp_path):
    """A gate far above the critical accumulation has no gradient, and one there would gain."""
    scenario = load_scenario("economic_mpc")
    table = {"compact": True, "numbers": [50.0, 2.0, 0.0, 0.0, 0.6, 0.0, 0.6, 1.5], "steps": 2}
    scenario = replace(scenario, protected=(CENTRE,), controller_options={"dpc-pc": table})
    out = training.train(scenario, parse("dpc-pc"), seed=0, out=tmp_path / "p.pt")
    policy, content = load_policy(out, scenario.network)
    assert policy.numbers.tolist()[0] == pytest.approx(1.0, abs=0.01)
    planning = planning_model(scenario)
    rollout = Rollout(planning)
    setup = training.settings(scenario, parse("dpc-pc"))
    best = content["configuration"]["validation_veh_s"]
    scores = {}
    for name, changed in changed_policies(policy, planning):
        scores[name] = training.validate(changed, rollout, 0, setup)
    assert min(scores.values()) > (1.0 - training.CHANGE_WORTH) * best
    assert scores[OPEN] > 1.1 * best


def test_a_kept_number_is_not_changed():
    planning = planning_model(load_scenario("grid7_peak"))
    policy = CompactPolicy(
        planning.network, Architecture(guidance=True, compact=(CENTRE,), metering=True)
    )
    names = [name for name, _ in changed_policies(policy, planning)]
    prices = [UNPRICED, UNPRICED_ELSEWHERE]
    assert names == [STRICTER, LOOSER, UNMETERED, GATE, OPEN, HALVED, DOUBLED, *prices]
    left = [name for name, _ in changed_policies(policy, planning, ["set_point", "metering"])]
    assert left == [HALVED, DOUBLED, *prices]


def test_constant_control_measures_nothing():
    scenario = load_scenario("grid7_peak")
    options = ConstantControl(numbers=(0.5, 1.0, 0.25, 0.8), metering=True)
    controller = options.make(planning_model(scenario))
    network = scenario.network
    others = np.arange(network.regions) != 3
    for vehicles in (0.0, 500.0):
        full = np.full(network.adjacency.shape, vehicles)
        controls = controller.act(Observation(step=0, time=0.0, accumulation=full, backlog=full))
        middle = 0.5 * (network.u_min + network.u_max)
        assert controls.perimeter[0, 3] == pytest.approx(middle)
        opened = network.open_perimeter[:, others]
        assert controls.perimeter[:, others] == pytest.approx(opened)
        assert controls.prices == pytest.approx(np.where(others, 0.25, 1.0))
        assert controls.metering == pytest.approx(0.8 * network.critical / FILL_TIME_S)


@pytest.mark.parametrize(
    "controller, numbers, protected, problem",
    [
        ("constant", [1.2, 0.0, 0.0, 1.0], (3,), "expected 4 numbers >= 0, the first at most 1"),
        ("constant", [0.5] * 3, (3,), "should have at least 4"),
        ("constant", [0.5] * 4, (), "expected a scenario with protected regions"),
        ("pricing-rule", [-1.0] * 8, (3,), "expected 8 to 12 numbers >= 0"),
        ("pricing-rule", [1.0] * 7, (3,), "should have at least 8"),
        ("pricing-rule", [1.0] * 8, (), "expected a scenario with protected regions"),
    ],
)
def test_wrong_numbers(controller, numbers, protected, problem):
    options = {controller: {"numbers": numbers}}
    scenario = replace(
        load_scenario("economic_mpc"), protected=protected, controller_options=options
    )
    with pytest.raises(InputError, match=f"controllers.{controller}.numbers: {problem}"):
        parse(controller).make(scenario)
