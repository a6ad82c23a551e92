"""Environments for reinforcement learning: the libraries' own checks, and agreement with the closed
loop."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
import tiny
import tiny_city

from cosim import SumoPlant
from nmfd import api
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.metrics import total_time_spent
from nmfd.model.plant import AcyclicPlant
from nmfd.model.scenario import with_demand

gymnasium = pytest.importorskip("gymnasium", reason="the extra rl is not installed")
pytest.importorskip("pettingzoo")
rl = pytest.importorskip("nmfd.rl")


@pytest.fixture
def scenario(three_regions):
    return three_regions


@pytest.fixture(scope="module")
def hexagon():
    return load_scenario("economic_mpc")


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return tiny_city.imported(tmp_path_factory.mktemp("city"))


def gymnasium_check(env):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*not within.*|.*recommend.*")
        check_env(env, skip_render_check=True, skip_close_check=True)
    assert np.isfinite(env.observation_space.low).all()
    assert np.isfinite(env.observation_space.high).all()
    env.close()


def pettingzoo_check(env, cycles):
    from pettingzoo.test import parallel_api_test

    parallel_api_test(env, num_cycles=cycles)
    env.close()


@pytest.mark.parametrize("guidance", [False, True])
def test_gymnasium_and_pettingzoo_accept_the_regional_plants(scenario, hexagon, guidance):
    gymnasium_check(rl.RegionalEnv(scenario, guidance=guidance))
    gymnasium_check(rl.RegionalEnv(hexagon, AcyclicPlant(hexagon), guidance=guidance))
    pettingzoo_check(rl.RegionsEnv(scenario, guidance=guidance), 50)
    pettingzoo_check(rl.RegionsEnv(hexagon, guidance=guidance, cooperative=False), 10)


def test_gymnasium_and_pettingzoo_accept_sumo(city):
    short = with_demand(load_scenario(city), steps=2)
    gymnasium_check(rl.RegionalEnv(short, SumoPlant(short), guidance=True))
    pettingzoo_check(rl.RegionsEnv(short, SumoPlant(short)), 3)


def test_importing_nmfd_changes_nothing_outside():
    code = (
        "import sys, gymnasium\n"
        "def outside():\n"
        "    return [*sys.meta_path], [*sys.path_hooks], [*gymnasium.registry]\n"
        "before = outside()\n"
        "import nmfd, cosim\n"
        "assert outside() == before\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "before",
    [
        "",
        *(pytest.param(f"import {name}; ", marks=pytest.mark.slow) for name in ("nmfd", "nmfd.rl")),
    ],
)
def test_gymnasium_finds_an_environment_by_its_module(before):
    code = f"{before}import gymnasium; gymnasium.make('nmfd.rl:nmfd/Hexagon7-v0').reset(seed=1)"
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", code], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_environments_have_names(scenario):
    env = gymnasium.make("nmfd.rl:nmfd/Hexagon7-v0", guidance=True)
    assert env.reset(seed=1)[0] in env.observation_space
    assert env.unwrapped.interface.action_size > 24
    for _ in range(30):
        seen, *_ = env.step(env.action_space.sample())
        assert seen in env.observation_space
    own = gymnasium.make("nmfd.rl:nmfd/Scenario-v0", scenario=str(scenario.folder))
    assert own.reset(seed=0)[0] in own.observation_space


@pytest.mark.parametrize("guidance", [False, True])
def test_actions_reach_the_bounds(hexagon, guidance):
    interface, network = rl.Interface(hexagon.network, guidance=guidance), hexagon.network
    for sign, bound in ((-1.0, network.u_min), (1.0, network.u_max)):
        controls = interface.controls(np.full(interface.action_size, sign))
        assert (controls.perimeter[network.adjacency] == bound).all()
        assert (controls.splits is not None) == guidance


def test_return_is_the_total_time_spent_of_the_same_closed_loop(hexagon):
    env = rl.RegionalEnv(hexagon, guidance=True)
    action = np.random.default_rng(1).uniform(-1, 1, env.interface.action_size).astype(np.float32)
    trajectory = api.run(hexagon, tiny.Acting(lambda seen: env.interface.controls(action)), seed=5)
    env.reset(seed=5)
    total, over, steps = 0.0, False, 0
    while not over:
        _, reward, terminated, over, info = env.step(action)
        total, steps = total + reward, steps + 1
        assert not terminated
    assert steps == hexagon.steps
    assert -total * env.unit * hexagon.step == pytest.approx(total_time_spent(trajectory))
    assert info["total_time_spent_veh_s"] == pytest.approx(total_time_spent(trajectory))
    assert info["completed_veh"] == pytest.approx(trajectory["completed"][-1])


def test_agents_together_do_what_one_agent_does(hexagon):
    one, many = rl.RegionalEnv(hexagon, guidance=True), rl.RegionsEnv(hexagon, guidance=True)
    one.reset(seed=3), many.reset(seed=3)
    random = np.random.default_rng(0)
    for _ in range(30):
        actions = {
            agent: random.uniform(-1, 1, i.action_size) for agent, i in many.interfaces.items()
        }
        # The order of boundaries and ways goes by region: the joint action is that of the agents,
        # one after another.
        boundaries = [int(hexagon.network.adjacency[n].sum()) for n in range(7)]
        parts = [
            np.split(action, [count])
            for action, count in zip(actions.values(), boundaries, strict=True)
        ]
        joint = np.concatenate([*(first for first, _ in parts), *(second for _, second in parts)])
        seen, reward, *_ = one.step(joint)
        _, rewards, *_ = many.step(actions)
        np.testing.assert_allclose(many.state(), seen, rtol=1e-6)
        assert list(rewards.values()) == pytest.approx([reward] * 7)


def test_an_action_that_is_no_number_is_named(hexagon):
    one, many = rl.RegionalEnv(hexagon, guidance=True), rl.RegionsEnv(hexagon)
    one.reset(seed=3), many.reset(seed=3)
    action = np.zeros(one.interface.action_size)
    one.step(action)
    action[30] = np.nan
    with pytest.raises(
        InputError, match=r"^RegionalEnv: interval 1: action\[30\]: expected a finite number"
    ):
        one.step(action)
    with pytest.raises(
        InputError, match=r"^region_2: interval 0: action\[0\]: expected a finite number"
    ):
        many.step({"region_2": np.full(many.interfaces["region_2"].action_size, np.nan)})
