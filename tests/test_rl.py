"""Environments for reinforcement learning: the libraries' own checks, and agreement with the closed loop."""

import warnings
from pathlib import Path

import copies
import numpy as np
import pytest
import tiny

from nmfd import api
from nmfd.api import load_scenario
from nmfd.controllers import custom
from nmfd.metrics import total_time_spent
from nmfd.model.plant import AcyclicPlant

ROOT = Path(__file__).parents[1]
gymnasium = pytest.importorskip("gymnasium", reason="the extra rl is not installed")
pytest.importorskip("pettingzoo")
rl = pytest.importorskip("nmfd.rl")


@pytest.fixture
def scenario(tmp_path):
    return load_scenario(tiny.write(tmp_path, network=tiny.row_network(3)))


@pytest.fixture(scope="module")
def hexagon():
    return load_scenario(ROOT / "scenarios" / "economic_mpc")


@pytest.fixture(scope="module")
def peak(tmp_path_factory):
    return copies.peak(tmp_path_factory.mktemp("city"))


def gymnasium_check(env):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*not within.*|.*recommend.*")
        check_env(env, skip_render_check=True)  # which wants to make another one beside it
    assert np.isfinite(env.observation_space.low).all() and np.isfinite(env.observation_space.high).all()
    assert drawn(env).shape == drawn(env).shape
    env.close()


def drawn(env):
    """What it renders, which is a picture of something."""
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape[2] == 3 and min(picture.shape[:2]) > 300
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    return picture


def pettingzoo_check(env, cycles):
    from pettingzoo.test import parallel_api_test

    parallel_api_test(env, num_cycles=cycles)
    env.close()


@pytest.mark.parametrize("guidance", [False, True])
def test_gymnasium_and_pettingzoo_accept_the_regional_plants(scenario, hexagon, guidance):
    gymnasium_check(rl.RegionalEnv(scenario, guidance=guidance, render_mode="rgb_array"))
    gymnasium_check(rl.RegionalEnv(hexagon, AcyclicPlant(hexagon), guidance=guidance, render_mode="rgb_array"))
    pettingzoo_check(rl.RegionsEnv(scenario, guidance=guidance), 50)
    pettingzoo_check(rl.RegionsEnv(hexagon, guidance=guidance, cooperative=False), 10)


def test_gymnasium_and_pettingzoo_accept_sumo(peak):
    from cosim.plant.env import gymnasium_env, pettingzoo_env

    gymnasium_check(gymnasium_env(peak, steps=2, guidance=True, render_mode="rgb_array"))
    pettingzoo_check(pettingzoo_env(peak, steps=2, city="actuated"), 3)


def test_environments_have_names(scenario, tmp_path):
    env = gymnasium.make("nmfd/Hexagon7-v0", guidance=True, render_mode="rgb_array")
    assert env.reset(seed=1)[0] in env.observation_space and env.unwrapped.interface.action_size > 24
    empty = drawn(env)
    for _ in range(30):
        seen, *_ = env.step(env.action_space.sample())
        assert seen in env.observation_space
    assert (drawn(env) != empty).any()
    env.close()
    own = gymnasium.make("nmfd/Scenario-v0", scenario=str(scenario.folder))
    assert own.reset(seed=0)[0] in own.observation_space and own.render() is None
    other = rl.RegionsEnv(scenario.folder, render_mode="rgb_array")
    other.reset(seed=0)
    drawn(other)


def test_the_city_has_a_name(peak):
    import cosim.plant.env as city

    assert city.gymnasium_env.__name__ in gymnasium.spec("cosim/Grid7-v0").entry_point
    env = gymnasium.make("cosim/Scenario-v0", scenario=peak, steps=2, render_mode="rgb_array")
    env.reset(seed=1)
    empty = drawn(env)
    env.step(env.action_space.sample())
    assert (drawn(env) != empty).any()
    env.close()


@pytest.mark.parametrize("guidance", [False, True])
def test_every_action_is_admissible_and_reaches_the_bounds(hexagon, guidance):
    interface, network = rl.Interface(hexagon.network, guidance=guidance), hexagon.network
    random = np.random.default_rng(0)
    for action in (random.uniform(-1.3, 1.3, (4, interface.action_size)), np.ones((1, interface.action_size))):
        perimeter, splits = interface.perimeter(action), interface.splits(action)
        assert (perimeter[:, ~network.adjacency] == 0).all()
        assert perimeter[:, network.adjacency].min() >= network.u_min
        assert perimeter[:, network.adjacency].max() <= network.u_max
        if guidance:
            assert (splits[:, ~network.split_mask] == 0).all()
            np.testing.assert_allclose(splits.sum(axis=2)[:, network.split_mask.any(axis=1)], 1.0)
    assert (perimeter[:, network.adjacency] == network.u_max).all()
    assert guidance or splits is None


def test_metering_closes_all_entries_of_a_region_alike(hexagon):
    interface, network = rl.Interface(hexagon.network, metering=True), hexagon.network
    assert interface.action_size == network.regions
    action = np.ones(7)
    action[3] = -1.0
    perimeter = interface.perimeter(action)
    assert (perimeter[network.adjacency[:, 3], 3] == network.u_min).all()
    assert (perimeter[network.adjacency & (np.arange(7) != 3)] == network.u_max).all()


class Constant:
    """Plays one action."""

    name = "constant"

    def __init__(self, interface, action):
        self.controls = interface.controls(action)

    def reset(self, seed=0):
        pass

    def act(self, measurement):
        return self.controls


def test_return_is_the_total_time_spent_of_the_same_closed_loop(hexagon):
    env = rl.RegionalEnv(hexagon, guidance=True)
    action = np.random.default_rng(1).uniform(-1, 1, env.interface.action_size).astype(np.float32)
    trajectory = api.run(hexagon, Constant(env.interface, action), seed=5)
    env.reset(seed=5)
    total, over, steps = 0.0, False, 0
    while not over:
        _, reward, terminated, over, info = env.step(action)
        total, steps = total + reward, steps + 1
        assert not terminated
    assert steps == hexagon.steps
    assert -total * env.unit * hexagon.step == pytest.approx(total_time_spent(trajectory))
    assert info["total_time_spent_veh_s"] == pytest.approx(total_time_spent(trajectory))
    assert info["completed_veh"] == pytest.approx(trajectory.completed[-1])


def test_agents_together_do_what_one_agent_does(hexagon):
    one, many = rl.RegionalEnv(hexagon, guidance=True), rl.RegionsEnv(hexagon, guidance=True)
    one.reset(seed=3), many.reset(seed=3)
    random = np.random.default_rng(0)
    for _ in range(30):
        actions = {agent: random.uniform(-1, 1, i.action_size) for agent, i in many.interfaces.items()}
        # The order of boundaries and ways goes by region: the joint action is that of the agents, one after another.
        boundaries = [int(hexagon.network.adjacency[n].sum()) for n in range(7)]
        parts = [np.split(action, [count]) for action, count in zip(actions.values(), boundaries, strict=True)]
        joint = np.concatenate([*(first for first, _ in parts), *(second for _, second in parts)])
        seen, reward, *_ = one.step(joint)
        _, rewards, *_ = many.step(actions)
        np.testing.assert_allclose(many.state(), seen, rtol=1e-6)
        assert list(rewards.values()) == pytest.approx([reward] * 7)


def test_vectorised_equals_single_ones_and_begins_anew(scenario):
    many = rl.NmfdVectorEnv(scenario, 3, guidance=True)
    singles = [rl.RegionalEnv(scenario, guidance=True) for _ in range(3)]
    seen, _ = many.reset(seed=4)
    for n, env in enumerate(singles):
        np.testing.assert_allclose(seen[n], env.reset(seed=4 + n)[0])
    many.action_space.seed(0)
    for k in range(scenario.steps):
        actions = many.action_space.sample()
        seen, rewards, terminated, truncated, info = many.step(actions)
        alone = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        last = k + 1 == scenario.steps
        assert truncated.tolist() == [last] * 3 and not terminated.any() and many.observation_space.contains(seen)
        shown = np.stack(list(info["final_obs"])) if last else seen
        np.testing.assert_allclose(shown, np.stack([step[0] for step in alone]), atol=1e-6)
        np.testing.assert_allclose(rewards, [step[1] for step in alone], atol=1e-9)
    assert abs(seen).max() < 0.1 and many.step(actions)[1].max() == 0.0  # empty again


def test_random_starts_follow_the_seed(scenario):
    def first():
        env = rl.NmfdVectorEnv(scenario, 4, demand_spread=0.3, initial_share=0.5)
        return env.reset(seed=1)[0], env.step(env.action_space.sample() * 0)[0]

    np.testing.assert_array_equal(first(), first())
    assert first()[0][0].sum() > 0.05 > first()[0][3].sum()


def test_ppo_learns_with_the_adapter(scenario):
    sb3 = pytest.importorskip("stable_baselines3")
    env = rl.Sb3VecEnv(rl.NmfdVectorEnv(scenario, 4))
    model = sb3.PPO("MlpPolicy", env, n_steps=20, batch_size=40, n_epochs=1, seed=0, device="cpu")
    model.learn(160)
    action, _ = model.predict(env.reset(), deterministic=True)
    assert action.shape == (4, env.env.interface.action_size)


def test_the_ppo_example_is_a_controller_like_any_other_and_can_be_trained(hexagon, tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    name = f"{ROOT}/scenarios/economic_mpc/ppo.py:Ppo"
    totals = {each: total_time_spent(api.run(hexagon, each, seed=7)) for each in (name, "no-control")}
    assert totals[name] < 0.9 * totals["no-control"]
    example = custom._module(Path(name.removesuffix(":Ppo")), name)
    monkeypatch.setattr(example, "ENVS", 2)
    with pytest.warns(UserWarning, match="mini-batch"):  # two scenarios at once are fewer than it is made for
        example.train(1, 0, tmp_path / "weights.pt")
    monkeypatch.setattr(example, "WEIGHTS", tmp_path / "weights.pt")
    perimeter = api.run(hexagon, name, steps=3).perimeter
    assert ((perimeter >= 0.0) & (perimeter <= hexagon.network.u_max)).all()
