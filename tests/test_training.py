"""What a training draws, descends and keeps: every number from its definition, on a scenario of two
regions."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch

from nmfd.api import load_scenario
from nmfd.controllers import training
from nmfd.controllers.dpc import rollout as rollout_module
from nmfd.controllers.dpc.options import Dpc
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import load_policy
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError, RunFailed
from nmfd.model.planning import planning_model


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


@pytest.fixture
def rollout(scenario):
    return Rollout(planning_model(scenario), dtype=torch.float64)


def made(scenario, *, guidance=False):
    torch.manual_seed(0)
    return Policy(scenario.network, Architecture(width=8, guidance=guidance))


def test_starts_without_a_spread_are_those_of_the_scenario(scenario, rollout, generator):
    x, demand = rollout.random_start(3, 0.0, 0.0, generator)
    assert x.shape == (3, 2, 2)
    assert not x.any()
    for n in range(3):
        np.testing.assert_array_equal(demand[:, n], scenario.demand)


def test_spread_and_level_scale_the_flows(scenario, rollout, generator):
    """Every flow for itself by 1 +- 0.3, evenly and the same at all times; all of a rollout by 0.5
    to 2."""
    _, demand = rollout.random_start(4000, 0.3, 0.0, generator)
    busy = int(scenario.demand[:, 0, 1].argmax())
    factor = demand[busy, :, 0, 1] / scenario.demand[busy, 0, 1]
    assert 0.7 <= factor.min() < 0.71
    assert 1.29 < factor.max() <= 1.3
    assert factor.mean() == pytest.approx(1.0, abs=0.01)
    torch.testing.assert_close(
        demand, factor[:, None, None] * torch.tensor(scenario.demand)[:, None]
    )
    _, demand = rollout.random_start(4000, 0.0, 0.0, generator, (0.5, 2.0))
    level = demand[busy, :, 0, 1] / scenario.demand[busy, 0, 1]
    assert 0.5 <= level.min() < 0.51
    assert 1.99 < level.max() <= 2.0
    assert level.mean() == pytest.approx(1.25, abs=0.03)


def test_a_share_of_the_rollouts_starts_later_in_a_random_state(scenario, rollout, generator):
    """Three quarters of them: up to 80 % of the jam, only for destinations in use; the demand goes
    on from there."""
    x, demand = rollout.random_start(4000, 0.0, 0.75, generator)
    assert not x[3000:].any()
    assert (x[:3000].sum((1, 2)) > 0).all()
    assert not x[:, :, 0].any()  # nobody is bound for region 0
    filling = x[:3000].sum(-1) / 1000.0
    assert filling.min() >= 0.0
    assert 0.7 < filling.max() <= 0.8
    assert filling.mean() == pytest.approx(0.2, abs=0.01)
    padded = np.concatenate([scenario.demand, np.zeros_like(scenario.demand)])
    later = {
        n: [k for k in range(11) if (demand[:, n].numpy() == padded[k : k + 20]).all()]
        for n in (*range(50), 3500)
    }
    assert later[3500] == [0]
    assert all(later.values())
    assert {0, 1, 2, 3} <= {shift for shifts in later.values() for shift in shifts}
    assert max(map(min, later.values())) < 10  # at most half of the time


def test_every_destination_in_use_gets_its_part(scenario, generator):
    both = replace(scenario, demand=scenario.demand + scenario.demand.transpose(0, 2, 1))
    x, _ = Rollout(planning_model(both), dtype=torch.float64).random_start(
        2000, 0.0, 1.0, generator
    )
    assert (x > 0).all()
    assert (x[:, 0, 0] > x[:, 0, 1]).double().mean() == pytest.approx(0.5, abs=0.05)


def test_noise_on_the_demand(rollout, generator):
    """Of the pairs that have any, with the sigma of the rollout."""
    demand = torch.full((20, 4000, 2, 2), 50.0, dtype=torch.float64)
    assert rollout.perturb(demand, torch.ones(4000), 0.0, generator) is demand
    level = torch.linspace(0.0, 1.0, 4000, dtype=torch.float64)
    off = rollout.perturb(demand, level, 2.0, generator) - 50.0
    assert not off[:, :, 1, 0].any()
    assert not off[:, 0].any()
    for n in (1000, 2500, 3999):
        around = off[:, n - 100 : n + 1, 0, 1]
        assert around.std().item() == pytest.approx(2.0 * level[n - 50].item(), rel=0.1)
    empty = rollout.perturb(0.0 * demand, torch.ones(4000, dtype=torch.float64), 2.0, generator)
    assert empty.min() == 0.0
    assert empty.max() > 0.0


@pytest.mark.parametrize("rates", [None, 1.5], ids=["one rate", "exit rates"])
def test_no_drawn_model_is_too_fast_for_the_step(scenario, generator, rates):
    """A free rate of 0.9 per integration step, half of the draws above it: all above 1 are cut down
    to 1."""
    fastest = 0.9 / scenario.step * scenario.substeps
    network = replace(
        scenario.network,
        exit_rates=None if rates is None else np.array([[1.0, rates], [rates, 0.5]]),
        mfds=tuple(replace(m, c=fastest / (rates or 1.0)) for m in scenario.network.mfds),
    )
    rollout = Rollout(planning_model(replace(scenario, network=network)), dtype=torch.float64)
    rollout.draw_model(500, 0.8, generator)
    drawn = rollout.parameters.mfd.c * (rates or 1.0) * scenario.step / scenario.substeps
    assert drawn.max().item() == pytest.approx(1.0)
    assert drawn.min() < 0.6
    assert 0.2 < (drawn > 0.999).double().mean() < 0.6


def test_compilation_is_tried_out_where_there_is_a_compiler(monkeypatch):
    asked = []
    monkeypatch.setattr(
        rollout_module, "compiled_step", lambda step: lambda x: asked.append(step(x).tolist())
    )
    monkeypatch.setenv("CXX", "my-compiler")
    monkeypatch.setattr(shutil, "which", lambda name: name if name == "my-compiler" else None)
    assert rollout_module.can_compile()
    assert asked == [[-1.0]]
    monkeypatch.delenv("CXX")
    assert not rollout_module.can_compile()
    assert len(asked) == 1
    monkeypatch.setattr(shutil, "which", lambda name: name)
    monkeypatch.setattr(rollout_module, "compiled_step", lambda step: step / 0)
    assert not rollout_module.can_compile()


def test_the_total_time_spent_is_that_of_the_states(scenario, generator):
    """Vehicles at every beginning of an interval, times its length."""
    rollout, policy = Rollout(planning_model(scenario), dtype=torch.float32), made(scenario)
    x, demand = rollout.random_start(5, 0.2, 0.5, generator)
    exact, seen, _ = rollout.states(policy, x, demand, generator.manual_seed(1))
    assert torch.equal(exact[0], x)
    assert exact.shape == (20, 5, 2, 2)
    assert (seen - exact).std().item() == pytest.approx(scenario.measurement_std, rel=0.1)
    again = torch.stack(
        [rollout.step(policy, exact[k], demand[k], seen[k] - exact[k]) for k in range(19)]
    )
    torch.testing.assert_close(again, exact[1:], rtol=1e-4, atol=1e-3)
    total = rollout.total_time_spent(policy, x, demand, generator.manual_seed(1))
    torch.testing.assert_close(total, scenario.step * sum(state.sum((1, 2)) for state in exact))


def test_a_validation_is_the_scenario_itself(scenario):
    """Without noise: the TTS from its own start, whatever the seed."""
    quiet, policy = replace(scenario, measurement_std=0.0), made(scenario)
    rollout = Rollout(planning_model(quiet))
    with torch.no_grad():
        expected = rollout.total_time_spent(
            policy, torch.zeros(1, 2, 2), rollout.demand[:, None], torch.Generator()
        ).item()
    for seed in (0, 1):
        assert training.validate(policy, rollout, seed, Dpc()) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    "chosen",
    [{"noise": 1.0}, {"mfd_spread": 0.3}, {"demand_high": 2.0}, {"demand_low": 0.5}],
    ids=lambda chosen: next(iter(chosen)),
)
def test_a_validation_is_perturbed_as_the_training(scenario, chosen):
    """18 rollouts instead of 2; the same seed gives the same number, and more demand or noise means
    more vehicles."""
    quiet, policy = replace(scenario, measurement_std=0.0), made(scenario)
    rollout, asked = Rollout(planning_model(quiet)), []
    total = rollout.total_time_spent
    rollout.total_time_spent = lambda policy, x, demand, generator: (
        asked.append(demand) or total(policy, x, demand, generator)
    )
    plain = training.validate(policy, rollout, 0, Dpc())
    values = [training.validate(policy, rollout, seed, Dpc(**chosen)) for seed in (0, 0, 1)]
    assert [demand.shape[1] for demand in asked] == [2, 18, 18, 18]
    assert values[0] == values[1] != plain
    sums = asked[1].sum((0, 2, 3)) / quiet.demand.sum()
    if "mfd_spread" in chosen:
        assert sums.tolist() == pytest.approx([1.0] * 18)
    elif "demand_low" in chosen or "demand_high" in chosen:
        end = (
            0.5 if "demand_low" in chosen else 2.0
        )  # nine levels from 1 to the end, two rollouts of each
        low, high = sorted((1.0, end))
        assert sorted(sums.tolist()) == pytest.approx(
            np.repeat(np.linspace(low, high, 9), 2).tolist(), rel=1e-4
        )
    else:  # sigma rises from none to that of the training
        assert sums[0] == pytest.approx(1.0)
        assert sums[-2:].mean() > 1.05


def test_a_training_above_the_demand_of_the_scenario(scenario, rollout, generator):
    """Starts and validation have only these levels."""
    levels = {"demand_low": 1.5, "demand_high": 1.5}
    quiet = replace(scenario, measurement_std=0.0)
    higher = replace(quiet, demand=1.5 * quiet.demand)
    policy = made(scenario)
    by_levels = training.validate(policy, Rollout(planning_model(quiet)), 0, Dpc(**levels))
    expected = training.validate(policy, Rollout(planning_model(higher)), 0, Dpc())
    assert by_levels == pytest.approx(expected, rel=1e-5)
    _, demand = rollout.random_start(3, 0.0, 0.0, generator, (1.5, 1.5))
    np.testing.assert_allclose(demand[:, 0], higher.demand)


@pytest.fixture
def steps(monkeypatch):
    """The learning rate of every Adam step, and the gradients it saw (None for what it leaves
    alone)."""
    seen = []

    class Noted(torch.optim.Adam):
        def step(self):
            [group] = self.param_groups
            given = [weights.grad is not None for weights in group["params"]]
            norm = math.sqrt(
                sum((w.grad**2).sum().item() for w in group["params"] if w.grad is not None)
            )
            seen.append((group["lr"], given, norm))
            super().step()

    monkeypatch.setattr(training, "Adam", Noted)
    return seen


def test_the_learning_rate_falls_to_a_tenth_along_a_cosine(train, scenario, steps):
    chosen = replace(scenario, controller_options={"dpc-pc": {"learning_rate": 0.5}})
    train(on=chosen, steps=4)
    expected = [0.5 * (0.1 + 0.45 * (1.0 + math.cos(math.pi * k / 4))) for k in range(4)]
    assert [rate for rate, _, _ in steps] == pytest.approx(expected)
    assert expected[0] == 0.5
    assert expected[2] == pytest.approx(0.275)
    assert max(norm for _, _, norm in steps) <= 1.0 + 1e-5  # clipped


def test_decoders_are_trained_in_turn(train, scenario, steps):
    """First the perimeter's, then that of the split ratios; the backbone always."""
    train("dpc-pcrg", steps=2)
    names = [name for name, _ in made(scenario, guidance=True).named_parameters()]
    for (_, given, _), left in zip(steps, ("splits_decoder", "perimeter_decoder"), strict=True):
        for name, has in zip(names, given, strict=True):
            assert has == (not name.startswith(left)), name


def test_the_best_validation_is_kept(train, monkeypatch):
    scores, notes = iter([7.0, 5.0, 6.0]), []
    monkeypatch.setattr(training, "VALIDATION_PERIOD", 2)
    monkeypatch.setattr(training, "validate", lambda *_: next(scores))
    monkeypatch.setattr(training, "changed_policies", lambda *_: [])
    out = train(seed=3, steps=5, progress=lambda *note: notes.append(note))
    bests = ["no validation yet", "best 7 veh s", "best 7 veh s", "best 5 veh s", "best 5 veh s"]
    assert notes == [(k, 5, best) for k, best in enumerate(bests, 1)]
    expected = {
        "controller": "dpc-pc",
        "scenario": "tiny",
        "seed": 3,
        "compiled": False,
        "steps": 5,
    }
    expected["validation_veh_s"] = 5.0
    assert expected.items() <= torch.load(out, weights_only=True)["configuration"].items()


def test_a_resumed_training_ends_as_if_it_had_never_stopped(tmp_path, train, monkeypatch):
    monkeypatch.setattr(training, "VALIDATION_PERIOD", 1)

    def stop(done, steps, note):
        if done == 3:
            raise KeyboardInterrupt

    whole = train(steps=6, out=tmp_path / "whole.pt")
    with pytest.raises(KeyboardInterrupt):
        train(steps=6, progress=stop)
    resumed = train(steps=6, resume=True)
    expected = torch.load(whole, weights_only=True)["weights"]
    for name, weight in torch.load(resumed, weights_only=True)["weights"].items():
        assert torch.equal(weight, expected[name]), name


def test_a_network_that_misses_a_single_change_says_so(train, monkeypatch, capsys):
    """After two steps its gates are half open, on roads that never fill."""
    train(steps=2)
    assert "misses a single change: gates" in capsys.readouterr().err
    monkeypatch.setattr(training, "CHANGE_WORTH", 0.5)
    train(steps=2)
    assert "single change" not in capsys.readouterr().err


def test_a_training_that_diverges_is_an_error(train, monkeypatch):
    monkeypatch.setattr(training, "validate", lambda *_: math.nan)
    with pytest.raises(
        RunFailed, match="dpc-pc: every validation of 2 steps diverged; lower the learning rate"
    ):
        train(steps=2)


def test_what_cannot_be_trained_is_named(scenario):
    with pytest.raises(InputError, match="'pi-gating' cannot be trained; choose dpc-pc"):
        training.settings(scenario, parse("pi-gating"))
    with pytest.raises(InputError, match=r"'dpc-pc\+webster' needs a table .*dpc-pc\+webster"):
        training.settings(scenario, parse("dpc-pc+webster"))


def test_the_model_that_a_controller_is_trained_on_must_be_measured(scenario):
    """Its own one, whatever the city's is; and somewhere something must be controllable."""
    own = replace(scenario.network, placeholder=True)
    city = replace(scenario, network=own)
    with pytest.raises(InputError, match="placeholder: is true.*anyway=True"):
        training.check(city, parse("dpc-pc"))
    training.check(scenario, parse("dpc-pc"))
    shut = replace(
        scenario.network, controllable=np.zeros_like(scenario.network.adjacency, dtype=float)
    )
    with pytest.raises(InputError, match="controllable: is 0 at every boundary.*anyway=True"):
        training.check(replace(scenario, network=shut), parse("dpc-pcrg"))


def test_nothing_is_trained_on_a_guess_unless_anyway(scenario, train):
    city = replace(scenario, network=replace(scenario.network, placeholder=True))
    with pytest.raises(InputError, match="placeholder: is true"):
        train(on=city, steps=1)
    assert train(on=city, steps=1, anyway=True).is_file()


def test_a_policy_that_begins_as_no_control_and_gains_nothing_stays_open(scenario, train, capsys):
    table = {"from_no_control": True, "learning_rate": 1e-6, "holding_cost": 30.0}
    chosen = replace(scenario, controller_options={"dpc-pcrg": table})
    file = train("dpc-pcrg", on=chosen, steps=1)
    assert "its gates stay open" in capsys.readouterr().err
    perimeter, splits = load_policy(file, scenario.network)[0](
        torch.rand(2, 2, generator=torch.manual_seed(0)) * 100.0
    )
    assert perimeter[0, 1].item() == pytest.approx(scenario.network.u_max, abs=1e-4)
    assert np.allclose(splits.detach(), scenario.network.nominal_splits, atol=0.05)


def test_holding_costs_by_the_vehicle(scenario):
    """Vehicles that would leave per second, times the mean closed share of their boundaries, times
    the cost."""
    rollout, costly = (
        Rollout(parse("dpc-pc").own_planning(scenario), holding_cost=cost) for cost in (0.0, 30.0)
    )
    x, generator = rollout.start[None], torch.manual_seed(0)
    network = scenario.network

    class Half(torch.nn.Module):
        def forward(self, x):
            return (
                torch.full_like(x, 0.5 * (network.u_min + network.u_max))
                * rollout.parameters.adjacency
            )

    free, paid = (
        r.total_time_spent(Half(), x, r.demand[:, None], generator) for r in (rollout, costly)
    )
    states = rollout.states(Half(), x, rollout.demand[:, None], generator)[0].sum(-1)
    leaving = torch.tensor(
        np.array(
            [
                mfd.outflow(n)
                for mfd, n in zip(network.mfds, states.squeeze(1).numpy().T, strict=True)
            ]
        )
    )
    assert (paid - free).item() == pytest.approx(
        30.0 * scenario.step * 0.5 * leaving.sum().item(), rel=1e-3
    )


def test_a_model_of_its_own_counts(tmp_path):
    folder = tiny.write(tmp_path)
    shutil.copytree(tmp_path / "network", tmp_path / "guessed")
    file = tmp_path / "guessed" / "network.toml"
    file.write_text(file.read_text().replace("[perimeter]", "placeholder = true\n\n[perimeter]"))
    with (folder / "scenario.toml").open("a") as stream:
        stream.write('\n[controllers.dpc-pc]\nmodel = "../guessed"\n')
    scenario = load_scenario(folder)
    training.check(scenario, parse("dpc-pcrg"))
    with pytest.raises(InputError, match="guessed/network.toml: placeholder"):
        training.check(scenario, parse("dpc-pc"))
