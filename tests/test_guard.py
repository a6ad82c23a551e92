"""No inadmissible command reaches a plant, and no admissible one is refused, whoever gives it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from commands import problem
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import nn

import nmfd
from nmfd import closed_loop
from nmfd.controllers import custom
from nmfd.controllers.rules import Constant
from nmfd.model.commands import admissible
from nmfd.model.plant import AcyclicPlant, NmfdPlant
from nmfd.types import Controls

SCENARIO = nmfd.load_scenario("economic_mpc")
NETWORK = SCENARIO.network
GATES = np.argwhere(NETWORK.adjacency)
TURNS = np.argwhere(NETWORK.split_mask)
KINDS = ("name", "file", "object", "module")
RANDOM = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@st.composite
def commands(draw):
    """Admissible arrays of a command."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    arrays = {"perimeter": random.uniform(0.1, 0.9, NETWORK.adjacency.shape)}
    if draw(st.booleans()):
        shares = random.random(NETWORK.split_mask.shape) * NETWORK.split_mask
        arrays["splits"] = shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-12)
    if draw(st.booleans()):
        arrays["prices"] = random.uniform(0.0, 3.0, NETWORK.regions)
    if draw(st.booleans()):
        arrays["metering"] = random.uniform(0.0, 5.0, NETWORK.regions)
    return arrays


@st.composite
def spoiled(draw):
    """Arrays of a command with one wrong entry, sum, shape or type, and the name of the array."""
    arrays = draw(commands())
    name = draw(st.sampled_from(sorted(arrays)))
    values = arrays[name].copy()
    if name == "perimeter":
        entry = tuple(GATES[draw(st.integers(0, len(GATES) - 1))])
    elif name == "splits":
        entry = tuple(TURNS[draw(st.integers(0, len(TURNS) - 1))])
    else:
        entry = (draw(st.integers(0, NETWORK.regions - 1)),)
    how = draw(st.sampled_from(["below", "above", "nan", "infinite", "shape"]))
    if how == "below":
        values[entry] = -draw(st.floats(0.001, 1e6))
    elif how == "above":
        values[entry] = draw(st.floats(1e7, 1e12)) if name == "metering" else 100.0
        values[entry] += draw(st.floats(0.001, 1e6))
    elif how == "nan":
        values[entry] = np.nan
    elif how == "infinite":
        values[entry] = np.inf
    else:
        values = values[..., :-1]
    arrays[name] = values
    return arrays, name


class Module(nn.Module):
    """A module that returns given arrays."""

    def __init__(self, arrays):
        super().__init__()
        tensors = {name: torch.from_numpy(values) for name, values in arrays.items()}
        for name in ("prices", "metering"):
            if name in tensors:
                setattr(self, name, lambda x, values=tensors[name]: values)
        self.given = tensors["perimeter"], tensors.get("splits")

    def forward(self, x):
        return self.given


def controller_of(kind, arrays, monkeypatch):
    """What a user would give: a controller of this kind that commands the arrays."""

    def constant(*_):
        return Constant("given", Controls(**arrays))

    if kind == "object":
        return constant()
    if kind == "module":
        return nmfd.ModuleController(Module(arrays), SCENARIO)
    if kind == "name":
        monkeypatch.setattr("nmfd.controllers.rules.NoControl.make", constant)
        return "no-control"
    monkeypatch.setattr(custom, "load", lambda name: constant)
    return "given.py:Given"


class Untouched(NmfdPlant):
    """A plant that no command may reach."""

    def step(self, controls):
        raise AssertionError("the plant has stepped")


@pytest.mark.parametrize("kind", KINDS)
@RANDOM
@given(given=spoiled())
def test_a_wrong_command_is_an_input_error_before_the_plant_steps(kind, given, monkeypatch):
    arrays, name = given
    with monkeypatch.context() as patch:
        controller = controller_of(kind, arrays, patch)
        line = problem(nmfd.run, SCENARIO, controller, plant=Untouched(SCENARIO))
    assert f"interval 0: {name}" in line


@pytest.mark.parametrize("kind", KINDS)
@RANDOM
@given(arrays=commands())
def test_an_admissible_command_is_never_refused(kind, arrays, monkeypatch):
    with monkeypatch.context() as patch:
        result = nmfd.run(
            SCENARIO, controller_of(kind, arrays, patch), plant=AcyclicPlant(SCENARIO), steps=1
        )
    shown = np.where(NETWORK.adjacency, arrays["perimeter"], 0.0)
    np.testing.assert_array_equal(result["perimeter"][0], shown)


@RANDOM
@given(arrays=commands())
def test_the_guard_changes_nothing_but_rounding_errors(arrays):
    once = admissible(Controls(**arrays), NETWORK, "here")
    twice = admissible(once, NETWORK, "here")
    assert (
        once.perimeter[NETWORK.adjacency].tolist()
        == arrays["perimeter"][NETWORK.adjacency].tolist()
    )
    for name, values in arrays.items():
        np.testing.assert_array_equal(getattr(once, name), getattr(twice, name))
        if name != "perimeter":
            np.testing.assert_allclose(getattr(once, name), values, rtol=1e-9)


@pytest.mark.parametrize("value", [np.full((7, 7), 0.5), None, 0.5, {"perimeter": 0.5}], ids=str)
def test_what_is_no_command_is_named(value):
    silent = SimpleNamespace(name="mine", reset=lambda seed: None, act=lambda seen: value)
    with pytest.raises(nmfd.InputError, match=r"^mine: interval 0: expected nmfd.Controls, got "):
        closed_loop.run(Untouched(SCENARIO), silent, SCENARIO, seed=0)


@pytest.mark.parametrize("action", [np.nan, 1.5, -7.0, "short", "text"], ids=str)
def test_a_wrong_action_is_an_input_error_before_the_plant_steps(action):
    rl = pytest.importorskip("nmfd.rl")
    env = rl.RegionalEnv(SCENARIO, Untouched(SCENARIO))
    env.reset(seed=0)
    wrong = np.zeros(env.action_space.shape)
    if action == "short":
        wrong = wrong[:-1]
    elif action == "text":
        wrong = "left"
    else:
        wrong[3] = action
    with pytest.raises(nmfd.InputError, match="RegionalEnv: interval 0: action"):
        env.step(wrong)


@RANDOM
@given(seed=st.integers(0, 2**32 - 1))
def test_every_action_of_the_space_is_admissible(seed):
    rl = pytest.importorskip("nmfd.rl")
    env = rl.RegionalEnv(SCENARIO, guidance=True)
    env.reset(seed=0)
    env.action_space.seed(seed)
    env.step(env.action_space.sample())


def test_a_demand_of_a_wrong_shape_is_refused_when_the_scenario_is_made(tmp_path):
    scenario = nmfd.load_scenario(tiny.write(tmp_path))
    for demand in (scenario.demand[:-1], scenario.demand[:, :1], -scenario.demand):
        with pytest.raises(nmfd.InputError, match=r"scenario.toml: demand: expected"):
            replace(scenario, demand=demand)
