"""A scenario as a Gymnasium environment, and with one agent per region as a PettingZoo
environment."""

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
from nmfd.errors import InputError
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario, read_scenario
from nmfd.types import Controls, Observation, Plant

Vector = Float[np.ndarray, " N"]
Action = Float[np.ndarray, " A"]

NOISE_RANGE = 10.0  # standard deviations of the measurement noise within the observation space
LOGIT_SCALE = 5.0  # times an action in [-1, 1]: logits of split ratios, up to a factor e^10 between two next regions


class Interface:
    """Observations and actions of an agent for some regions of a network, by default for all.

    Observation (float32): x_ij and the backlog of these regions and, unless they are all, the
    accumulation of every region; each divided by the region's critical accumulation.

    Action in [-1, 1]: u_ih of each boundary out of these regions, from u_min to u_max; with
    `guidance` also a logit for each next region h of theta_ihj where there is a choice. Every
    action is admissible.
    """

    def __init__(
        self,
        network: RegionalModel,
        *,
        guidance: bool = False,
        regions: Sequence[int] | None = None,
    ):
        self._network, self._all = network, regions is None
        self._own = np.arange(network.regions) if regions is None else np.array(regions)
        own = np.isin(np.arange(network.regions), self._own)
        self._boundaries = np.nonzero(network.adjacency & own[:, None])
        choice = (
            network.split_mask
            & (network.split_mask.sum(axis=1, keepdims=True) > 1)
            & own[:, None, None]
        )
        self._turns = np.nonzero(choice) if guidance else None
        self._gates = len(self._boundaries[0])
        self.action_size = self._gates + (0 if self._turns is None else len(self._turns[0]))
        self._open = network.open_perimeter
        # Split ratios of these regions without a choice.
        self._fixed = np.where(
            network.split_mask & ~choice & own[:, None, None], network.nominal_splits, 0.0
        )

    def vector(self, accumulation: PerPair, backlog: PerPair) -> Vector:
        """Return the observation (N,) of accumulation and backlog (R, R) [veh]."""
        critical = self._network.critical
        own = (
            (accumulation / critical[:, None])[self._own].ravel(),
            (backlog.sum(axis=1) / critical)[self._own],
        )
        other = () if self._all else (accumulation.sum(axis=1) / critical,)
        return np.concatenate([*own, *other], dtype=np.float32)

    def observed(self, observation: Observation) -> Vector:
        """Return the observation (N,) of what a controller receives."""
        return self.vector(observation.accumulation, observation.backlog)

    def observation_space(self, scenario: Scenario) -> Box:
        """Return bounds: an empty city, and in each cell twice all trips plus full regions; both
        with noise."""
        trips = scenario.step * scenario.demand.sum() + scenario.start.sum()
        most = 2.0 * trips + sum(mfd.jam for mfd in scenario.network.mfds)
        noise, none = NOISE_RANGE * scenario.measurement_std, np.zeros_like(self._open)
        return Box(
            self.vector(none - noise, none),
            self.vector(none + most + noise, none + most),
            dtype=np.float32,
        )

    @property
    def action_space(self) -> Box:
        return Box(-1.0, 1.0, (self.action_size,), np.float32)

    def controls(self, action: Action, where: str = "") -> Controls:
        """Return the controls of an action: u_max at the boundaries and theta = 0 in the other
        regions.

        Raises: InputError, which begins with `where`, for NaN
        """
        low, high = self._network.u_min, self._network.u_max
        action = np.clip(np.asarray(action, dtype=float), -1.0, 1.0)
        if (wrong := np.flatnonzero(np.isnan(action))).size:
            raise InputError(
                f"{where}action[{wrong[0]}]: expected a number from -1 to 1, got nan instead"
            )
        perimeter = self._open.copy()
        perimeter[self._boundaries] = low + (high - low) * 0.5 * (action[: self._gates] + 1.0)
        if self._turns is None:
            return Controls(perimeter=perimeter, splits=None)
        weight = np.zeros_like(self._fixed)
        weight[self._turns] = np.exp(LOGIT_SCALE * action[self._gates :])
        sums = weight.sum(axis=1, keepdims=True)
        return Controls(
            perimeter=perimeter, splits=self._fixed + weight / np.where(sums > 0, sums, 1.0)
        )


class RegionalEnv(gymnasium.Env):
    """One agent for all regions; an episode is the whole scenario and ends by truncation.

        >>> env = nmfd.rl.RegionalEnv("economic_mpc", guidance=True)
        >>> observation, info = env.reset(seed=1)
        >>> observation, reward, _, over, info = env.step(env.action_space.sample())
        >>> env = gymnasium.make("nmfd/Hexagon7-v0", guidance=True)
        >>> scenario = nmfd.load_scenario("demo")
        >>> env = nmfd.rl.RegionalEnv(scenario, cosim.SumoPlant(scenario))  # in SUMO; one simulation per process

    The reward of an interval is minus the unfinished trips when it begins, in `unit` (the sum of
    the critical accumulations): total time spent = - sum of rewards * unit * scenario.step. `info`
    holds time_s, total_time_spent_veh_s (in SUMO sampled per interval) and completed_veh. A seed
    gives the closed loop of nmfd.run.

    scenario: or its folder; plant: the NMFD if None, closed with the environment; guidance: see
        Interface
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self, scenario: Scenario | Path | str, plant: Plant | None = None, *, guidance: bool = False
    ):
        self.scenario = scenario if isinstance(scenario, Scenario) else read_scenario(scenario)
        self.plant = NmfdPlant(self.scenario) if plant is None else plant
        self.interface = Interface(self.scenario.network, guidance=guidance)
        self.unit = sum(mfd.critical for mfd in self.scenario.network.mfds)
        self.observation_space = self.interface.observation_space(self.scenario)
        self.action_space = self.interface.action_space

    def begin(self, seed: int | None) -> Observation:
        """Reset the plant, without a seed by the next of the sequence; return what a controller
        observes."""
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self._random, self._k, self._spent = noise_of(seed), 0, 0.0
        self._state = self.plant.reset(seed)
        return self._observe()

    def advance(self, controls: Controls) -> tuple[Observation, PerRegion, bool]:
        """Return the observation, unfinished trips (R,) [veh] before the interval by region, and
        whether it ends."""
        unfinished, self._k = self._state.unfinished.sum(axis=1), self._k + 1
        self._spent += self.scenario.step * float(unfinished.sum())
        self._state = self.plant.step(controls)
        return self._observe(), unfinished, self._k >= self.scenario.steps

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Vector, dict]:
        """Begin an episode; without a seed, the next one of the sequence begun by the last seed."""
        return self._clipped(self.begin(seed)), self._info()

    def step(self, action: Action) -> tuple[Vector, float, bool, bool, dict]:
        controls = self.interface.controls(action, f"RegionalEnv: interval {self._k}: ")
        observation, vehicles, over = self.advance(controls)
        return (
            self._clipped(observation),
            -float(vehicles.sum()) / self.unit,
            False,
            over,
            self._info(),
        )

    def close(self) -> None:
        """Close the plant, if it holds anything."""
        getattr(self.plant, "close", lambda: None)()

    def _observe(self) -> Observation:
        return measurement(self.plant, self._state, self.scenario.measurement_std, self._random)

    def _clipped(self, observation: Observation) -> Vector:
        return np.clip(
            self.interface.observed(observation),
            self.observation_space.low,
            self.observation_space.high,
        )

    def _info(self) -> dict:
        state = self._state
        return {
            "time_s": state.time,
            "total_time_spent_veh_s": self._spent,
            "completed_veh": state.completed,
        }


class RegionsEnv(ParallelEnv):
    """One agent per region, which controls what leaves it; otherwise as RegionalEnv.

    Each agent sees its own region by destination and the accumulation of every region. With
    `cooperative` all get the reward of RegionalEnv, otherwise that of their own region.
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
        self._env, self._cooperative, self._guidance = (
            RegionalEnv(scenario, plant),
            cooperative,
            guidance,
        )
        loaded = self._env.scenario
        self.possible_agents = [f"region_{region}" for region in range(loaded.network.regions)]
        self.agents: list[str] = []
        self.interfaces = {
            agent: Interface(loaded.network, guidance=guidance, regions=[region])
            for region, agent in enumerate(self.possible_agents)
        }
        self.observation_spaces = {
            agent: part.observation_space(loaded) for agent, part in self.interfaces.items()
        }
        self.action_spaces = {agent: part.action_space for agent, part in self.interfaces.items()}
        self.observation_space, self.action_space = (
            self.observation_spaces.get,
            self.action_spaces.get,
        )
        self.close = self._env.close

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Begin an episode; without a seed, the next one of the sequence begun by the last seed."""
        self.agents = list(self.possible_agents)
        self._seen = self._env.begin(seed)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        """Advance by one control interval; the region of an agent without an action is open."""
        network = self._env.scenario.network
        perimeter, splits = network.open_perimeter, network.nominal_splits.copy()
        for agent, action in actions.items():
            region, where = self.possible_agents.index(agent), f"{agent}: interval {self._env._k}: "
            controls = self.interfaces[agent].controls(action, where)
            perimeter[region] = controls.perimeter[region]
            if controls.splits is not None:
                splits[region] = controls.splits[region]
        theta = splits if self._guidance else None
        self._seen, vehicles, over = self._env.advance(Controls(perimeter=perimeter, splits=theta))
        amounts = np.full(len(vehicles), vehicles.sum()) if self._cooperative else vehicles
        agents, self.agents = self.agents, [] if over else self.agents
        rewards = dict(zip(agents, (-amounts / self._env.unit).tolist(), strict=True))
        info = {agent: {"time_s": self._seen.time} for agent in agents}
        return (
            self._observations(),
            rewards,
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, over),
            info,
        )

    def state(self) -> Vector:
        """Return the observation of all regions together."""
        return self._env.interface.observed(self._seen)

    def _observations(self) -> dict:
        return {
            agent: np.clip(self.interfaces[agent].observed(self._seen), space.low, space.high)
            for agent, space in self.observation_spaces.items()
        }
