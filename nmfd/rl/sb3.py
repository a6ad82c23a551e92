"""The vectorised environment as Stable-Baselines3 wants it."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from nmfd.rl.vector import NmfdVectorEnv

Indices = int | Iterable[int] | None


class Sb3VecEnv(VecEnv):
    """`PPO("MlpPolicy", Sb3VecEnv(NmfdVectorEnv(scenario, 64)))`; episodes end by time limit and begin anew at once."""

    def __init__(self, env: NmfdVectorEnv):
        self.env, self.render_mode = env, None
        self._seed: int | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        seed, self._seed = self._seed, None
        return self.env.reset(seed=seed)[0]

    def seed(self, seed: int | None = None) -> list[int | None]:
        self._seed = seed
        return [seed] * self.num_envs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        observations, rewards, _, over, info = self.env.step(self._actions)
        infos: list[dict] = [{} for _ in range(self.num_envs)]
        if over.all():
            spent = info["final_info"]["total_time_spent_veh_s"]
            infos = [
                {"terminal_observation": final, "TimeLimit.truncated": True, "total_time_spent_veh_s": float(total)}
                for final, total in zip(info["final_obs"], spent, strict=True)
            ]
        return observations, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list:
        return [getattr(self.env, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any) -> list:
        return [getattr(self.env, method_name)(*method_args, **method_kwargs)]

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))
