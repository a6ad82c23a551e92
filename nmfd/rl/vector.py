"""Many scenarios at once on the regional model, in one batch of tensors."""

from dataclasses import replace

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float

from nmfd.controllers.dpc.rollout import Rollout
from nmfd.model import dynamics
from nmfd.model.planning import planning_model
from nmfd.model.scenario import Scenario
from nmfd.rl.interface import Interface

Observations = Float[np.ndarray, "N O"]
Ends = Bool[np.ndarray, " N"]


class NmfdVectorEnv(VectorEnv):
    """`num_envs` times RegionalEnv on the NMFD, as fast as one up to some dozens: it equals them, seeds s, s + 1, ...

    All episodes end at once and begin anew in the same step (AutoresetMode.SAME_STEP): `final_obs` is in the info.

    demand_spread, initial_share: for training, as of DPC policies: every flow is scaled by a factor from 1 +- spread,
        and this share of the episodes starts at a random time from a random state (Rollout.random_start)
    """

    def __init__(
        self,
        scenario: Scenario,
        num_envs: int,
        *,
        guidance: bool = False,
        metering: bool = False,
        demand_spread: float = 0.0,
        initial_share: float = 0.0,
    ):
        self.num_envs, self.scenario = num_envs, scenario
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self.interface = Interface(scenario.network, guidance=guidance, metering=metering)
        self.unit = sum(mfd.critical for mfd in scenario.network.mfds)
        self.single_observation_space = gymnasium.spaces.Box(*self.interface.bounds(scenario), dtype=np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.interface.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rollout = Rollout(planning_model(replace(scenario, forecast_error=0.0)), dtype=torch.float64)
        self._spread, self._share = demand_spread, initial_share
        self._backlog = np.zeros((num_envs, scenario.network.regions, scenario.network.regions))

    def reset(self, *, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[Observations, dict]:
        """All episodes anew: of seeds s, s + 1, ..., or of these; without, the next ones of the sequence."""
        if seed is not None:
            seeds = [seed + n for n in range(self.num_envs)] if isinstance(seed, int) else list(seed)
            self._np_random, self._np_random_seed = np.random.default_rng(seeds), seeds[0]
        else:
            seeds = self.np_random.integers(2**31, size=self.num_envs).tolist()
        self._random = [np.random.default_rng([seed, 0x6E6F6973]) for seed in seeds]
        if self._spread or self._share:
            generator = torch.Generator().manual_seed(int(self.np_random.integers(2**31)))
            self._x, self._demand = self._rollout.random_start(self.num_envs, self._spread, self._share, generator)
        else:
            self._demand = self._rollout.demand.unsqueeze(1).expand(-1, self.num_envs, -1, -1)
            self._x = self._rollout.start.expand_as(self._demand[0])
        self._k, self._spent = 0, np.zeros(self.num_envs)
        return self._observations(), self._info()

    def step(self, actions: Float[np.ndarray, "N A"]) -> tuple[Observations, Float[np.ndarray, " N"], Ends, Ends, dict]:
        """One control interval of all episodes; none is ever terminated, all are truncated at once."""
        scenario = self.scenario
        splits = self.interface.splits(actions)
        vehicles = self._x.sum((1, 2)).numpy()
        self._x = dynamics.advance(
            self._rollout.parameters,
            self._x,
            self._demand[self._k],
            torch.from_numpy(self.interface.perimeter(actions)),
            self._rollout.nominal_splits if splits is None else torch.from_numpy(splits),
            scenario.step,
            integrator=scenario.integrator,
            substeps=scenario.substeps,
        )
        self._k += 1
        self._spent = self._spent + scenario.step * vehicles
        observations, info = self._observations(), self._info()
        over = self._k >= scenario.steps
        if over:
            final, every = (observations, info), np.ones(self.num_envs, dtype=bool)
            observations, info = self.reset()
            rows = np.empty(self.num_envs, dtype=object)
            rows[:] = list(final[0])
            info |= {"final_obs": rows, "_final_obs": every, "final_info": final[1], "_final_info": every}
        return observations, -vehicles / self.unit, np.zeros(self.num_envs, bool), np.full(self.num_envs, over), info

    def _observations(self) -> Observations:
        shape = self._x.shape[1:]
        noise = np.stack([random.standard_normal(shape) for random in self._random])
        seen = self.interface.observation(self._x.numpy() + self.scenario.measurement_std * noise, self._backlog)
        return np.clip(seen, self.single_observation_space.low, self.single_observation_space.high)

    def _info(self) -> dict:
        every = np.ones(self.num_envs, dtype=bool)
        return {"total_time_spent_veh_s": self._spent, "_total_time_spent_veh_s": every}
