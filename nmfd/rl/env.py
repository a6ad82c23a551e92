"""Scenarios as environments of Gymnasium and of PettingZoo.

The first has one agent for the whole network, the second one agent per region.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float
from pettingzoo import ParallelEnv

from nmfd.arrays import PerPair, PerRegion
from nmfd.closed_loop import measurement, noise_of
from nmfd.model.commands import admissible, within
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario, read_scenario
from nmfd.types import Controls, Observation, Plant

Vector = Float[np.ndarray, " N"]
Action = Float[np.ndarray, " A"]

NOISE_RANGE = 10.0  # standard deviations of measurement noise that the observation space holds
# Times an action in [-1, 1]: the logit of a split ratio. Two next regions differ by up to e^10.
LOGIT_SCALE = 5.0


class Interface:
    """Observations and actions of an agent for some regions of a network.

    Observation (float32): x_ij and the backlog of these regions, divided by the region's critical
    accumulation. Unless they are all regions, also the accumulation of every region, divided alike.

    Action in [-1, 1]: u_ih of each boundary out of these regions, from u_min to u_max. With
    `guidance` also a logit for each next region h of theta_ihj where there is a choice. Every
    action of the space is admissible.
    """

    def __init__(
        self,
        network: RegionalModel,
        *,
        guidance: bool = False,
        regions: Sequence[int] | None = None,
    ):
        """regions: of the agent; all if None"""
        self._network = network
        self._all = regions is None
        every = np.arange(network.regions)
        self._own = every if regions is None else np.array(regions)
        own = np.isin(every, self._own)
        self._boundaries = np.nonzero(network.adjacency & own[:, None])
        self._gates = len(self._boundaries[0])
        self.action_size = self._gates
        allowed = network.split_mask & own[:, None, None]
        choice = allowed & (network.split_mask.sum(axis=1, keepdims=True) > 1)
        self._turns = None
        if guidance:
            self._turns = np.nonzero(choice)
            self.action_size += len(self._turns[0])
        self._open = network.open_perimeter
        # Split ratios of these regions where there is no choice.
        self._fixed = np.where(allowed & ~choice, network.nominal_splits, 0.0)

    def vector(self, accumulation: PerPair, backlog: PerPair) -> Vector:
        """Return the observation (N,) of accumulation and backlog (R, R) [veh]."""
        critical = self._network.critical
        inside = accumulation / critical[:, None]
        waiting = backlog.sum(axis=1) / critical
        parts = [inside[self._own].ravel(), waiting[self._own]]
        if not self._all:
            parts.append(accumulation.sum(axis=1) / critical)
        return np.concatenate(parts, dtype=np.float32)

    def observed(self, observation: Observation) -> Vector:
        """Return the observation (N,) of what a controller receives."""
        return self.vector(observation.accumulation, observation.backlog)

    def observation_space(self, scenario: Scenario) -> Box:
        """Return the bounds of the observation.

        Lower: an empty city. Upper: in each cell twice all trips plus full regions. Both with
        noise.
        """
        trips = scenario.step * scenario.demand.sum() + scenario.start.sum()
        most = 2.0 * trips + sum(mfd.jam for mfd in scenario.network.mfds)
        noise = NOISE_RANGE * scenario.measurement_std
        none = np.zeros_like(self._open)
        low = self.vector(none - noise, none)
        high = self.vector(none + most + noise, none + most)
        return Box(low, high, dtype=np.float32)

    @property
    def action_space(self) -> Box:
        return Box(-1.0, 1.0, (self.action_size,), np.float32)

    def controls(self, action: Action, where: str = "") -> Controls:
        """Return the controls of an action.

        Boundaries of other regions are at u_max, and split ratios of other regions are 0.

        Raises: InputError, which begins with `where`, for an action outside of the space
        """
        most = np.ones(self.action_size)
        action = within(action, -most, most, f"{where}action")
        low = self._network.u_min
        high = self._network.u_max
        opening = 0.5 * (action[: self._gates] + 1.0)
        perimeter = self._open.copy()
        perimeter[self._boundaries] = low + (high - low) * opening
        if self._turns is None:
            return Controls(perimeter=perimeter)
        weight = np.zeros_like(self._fixed)
        weight[self._turns] = np.exp(LOGIT_SCALE * action[self._gates :])
        sums = weight.sum(axis=1, keepdims=True)
        chosen = weight / np.where(sums > 0, sums, 1.0)
        return Controls(perimeter=perimeter, splits=self._fixed + chosen)


class RegionalEnv(gymnasium.Env):
    """One agent for all regions.

        >>> env = nmfd.rl.RegionalEnv("economic_mpc", guidance=True)
        >>> observation, info = env.reset(seed=1)
        >>> observation, reward, _, over, info = env.step(env.action_space.sample())
        >>> env = gymnasium.make("nmfd.rl:nmfd/Hexagon7-v0", guidance=True)

    In SUMO, one simulation per process:

        >>> scenario = nmfd.load_scenario("demo")
        >>> env = nmfd.rl.RegionalEnv(scenario, cosim.SumoPlant(scenario))

    An episode is the whole scenario and ends by truncation. The same seed gives the closed loop of
    `nmfd.run`.

    The reward of an interval is minus the unfinished trips when it begins, in `unit` (the sum of
    the critical accumulations): total time spent = - sum of rewards * unit * scenario.step. `info`
    holds time_s, total_time_spent_veh_s (in SUMO sampled per interval) and completed_veh.

    scenario: loaded scenario, its folder or its name
    plant: the NMFD if None; it is closed with the environment
    guidance: see Interface
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self, scenario: Scenario | Path | str, plant: Plant | None = None, *, guidance: bool = False
    ):
        self.scenario = scenario if isinstance(scenario, Scenario) else read_scenario(scenario)
        self.plant = NmfdPlant(self.scenario) if plant is None else plant
        self.interface = Interface(self.scenario.network, guidance=guidance)
        self.interval = 0  # number of the next control interval
        self.unit = sum(mfd.critical for mfd in self.scenario.network.mfds)
        self.observation_space = self.interface.observation_space(self.scenario)
        self.action_space = self.interface.action_space

    def begin(self, seed: int | None) -> Observation:
        """Reset the plant, and return what a controller observes.

        Without a seed, this is the next episode of the sequence that the last seed began.
        """
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        self._random = noise_of(seed)
        self.interval = 0
        self._spent = 0.0
        self._state = self.plant.reset(seed)
        return self._observe()

    def advance(self, controls: Controls) -> tuple[Observation, PerRegion, bool]:
        """Advance by one control interval.

        Return the observation, the unfinished trips (R,) [veh] by region before the interval, and
        True if the episode has ended.
        """
        where = f"{type(self).__name__}: interval {self.interval}"
        controls = admissible(controls, self.scenario.network, where)
        unfinished = self._state.unfinished.sum(axis=1)
        self._spent += self.scenario.step * float(unfinished.sum())
        self._state = self.plant.step(controls)
        self.interval += 1
        return self._observe(), unfinished, self.interval >= self.scenario.steps

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Vector, dict]:
        """Begin an episode; seed: see `begin`."""
        return self._clipped(self.begin(seed)), self._info()

    def step(self, action: Action) -> tuple[Vector, float, bool, bool, dict]:
        controls = self.interface.controls(action, f"RegionalEnv: interval {self.interval}: ")
        observation, unfinished, over = self.advance(controls)
        reward = -float(unfinished.sum()) / self.unit
        return self._clipped(observation), reward, False, over, self._info()

    def close(self) -> None:
        """Close the plant, if it holds anything."""
        if hasattr(self.plant, "close"):
            self.plant.close()

    def _observe(self) -> Observation:
        return measurement(self.plant, self._state, self.scenario.measurement_std, self._random)

    def _clipped(self, observation: Observation) -> Vector:
        space = self.observation_space
        return np.clip(self.interface.observed(observation), space.low, space.high)

    def _info(self) -> dict:
        return {
            "time_s": self._state.time,
            "total_time_spent_veh_s": self._spent,
            "completed_veh": self._state.completed,
        }


class RegionsEnv(ParallelEnv):
    """One agent per region, which controls what leaves it.

    Each agent sees its own region by destination and the accumulation of every region. With
    `cooperative` all get the reward of RegionalEnv, otherwise that of their own region. All else is
    as in RegionalEnv.
    """

    metadata = {"name": "nmfd_regions_v0", "render_modes": [], "is_parallelizable": True}

    def __init__(
        self,
        scenario: Scenario | Path | str,
        plant: Plant | None = None,
        *,
        guidance: bool = False,
        cooperative: bool = True,
    ):
        self._env = RegionalEnv(scenario, plant)
        self._cooperative = cooperative
        self._guidance = guidance
        loaded = self._env.scenario
        self.agents: list[str] = []
        self.interfaces = {}
        for region in range(loaded.network.regions):
            interface = Interface(loaded.network, guidance=guidance, regions=[region])
            self.interfaces[f"region_{region}"] = interface
        self.possible_agents = list(self.interfaces)
        agents = self.interfaces.items()
        self.observation_spaces = {agent: one.observation_space(loaded) for agent, one in agents}
        self.action_spaces = {agent: one.action_space for agent, one in agents}

    def observation_space(self, agent: str) -> Box:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Begin an episode; seed: see RegionalEnv."""
        self.agents = list(self.possible_agents)
        self._seen = self._env.begin(seed)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        """Advance by one control interval; without an action, a region is open."""
        network = self._env.scenario.network
        perimeter = network.open_perimeter
        splits = network.nominal_splits.copy()
        for agent, action in actions.items():
            where = f"{agent}: interval {self._env.interval}: "
            controls = self.interfaces[agent].controls(action, where)
            region = self.possible_agents.index(agent)
            perimeter[region] = controls.perimeter[region]
            if controls.splits is not None:
                splits[region] = controls.splits[region]
        theta = splits if self._guidance else None
        self._seen, unfinished, over = self._env.advance(
            Controls(perimeter=perimeter, splits=theta)
        )
        if self._cooperative:
            unfinished = np.full(len(unfinished), unfinished.sum())
        rewards = (-unfinished / self._env.unit).tolist()
        agents = self.agents
        if over:
            self.agents = []
        return (
            self._observations(),
            dict(zip(agents, rewards, strict=True)),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            {agent: {"time_s": self._seen.time} for agent in agents},
        )

    def state(self) -> Vector:
        """Return the observation of all regions together."""
        return self._env.interface.observed(self._seen)

    def close(self) -> None:
        """Close the plant, if it holds anything."""
        self._env.close()

    def _observations(self) -> dict:
        observations = {}
        for agent, space in self.observation_spaces.items():
            seen = self.interfaces[agent].observed(self._seen)
            observations[agent] = np.clip(seen, space.low, space.high)
        return observations
