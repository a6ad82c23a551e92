"""PPO (Stable-Baselines3) on the benchmark, as a rival for DPC, MPC and gating. Needs the extra `rl`.

Train it, a few minutes on one core (writes ppo.pt beside this file), and put it into the benchmark's table:

    python scenarios/economic_mpc/ppo.py
    nmfd benchmark scenarios/economic_mpc \
        --controllers no-control,pi-gating,mpc-pc,dpc-pc,scenarios/economic_mpc/ppo.py:Ppo

Like dpc-pc it controls the perimeter alone, sees the same state, and is trained on the same random starts and demand;
it does not get the gradient of the model, and meters all entries of a region alike: with a gate for every boundary it
had learnt nothing after 25 rounds.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

import nmfd
from nmfd.rl import Interface, NmfdVectorEnv, Sb3VecEnv

HERE = Path(__file__).parent
WEIGHTS = HERE / "ppo.pt"
NETWORK = {"net_arch": [128, 128], "log_std_init": -1.0}
ENVS = 64
ROUNDS = 50  # of ENVS episodes each


class Ppo:
    """The trained agent as a controller."""

    name = "ppo"
    files = ("ppo.pt",)

    def __init__(self, planning: nmfd.PlanningModel):
        if not WEIGHTS.is_file():
            raise nmfd.InputError(f"{WEIGHTS}: no such file; train it with: python {HERE / 'ppo.py'}")
        self._interface = Interface(planning.network, metering=True)
        observations = Box(-np.inf, np.inf, (self._interface.observation_size,), np.float32)
        actions = Box(-1.0, 1.0, (self._interface.action_size,), np.float32)
        self._policy = ActorCriticPolicy(observations, actions, lambda _: 0.0, use_sde=True, **NETWORK)
        self._policy.load_state_dict(torch.load(WEIGHTS, weights_only=True))

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: nmfd.Observation) -> nmfd.Controls:
        action, _ = self._policy.predict(self._interface.observed(observation), deterministic=True)
        return self._interface.controls(action)


class Best(BaseCallback):
    """Keeps the agent that does best, without exploring, on the scenario itself: as the training of DPC does."""

    def __init__(self, scenario: nmfd.Scenario, every: int, out: Path):
        super().__init__()
        self._out = out
        self._env, self._every, self._round = NmfdVectorEnv(scenario, 2, metering=True), every, 0
        self._best, self._exploring = float("inf"), float("nan")

    def _on_step(self) -> bool:
        spent = [info["total_time_spent_veh_s"] for info in self.locals["infos"] if info]
        self._exploring = sum(spent) / len(spent) if spent else self._exploring
        return True

    def _on_rollout_end(self) -> None:
        self._round += 1
        if self._round % self._every == 0:
            self.validate()

    def validate(self) -> None:
        seen, _ = self._env.reset(seed=1000)
        for _ in range(self._env.scenario.steps):
            seen, _, _, _, info = self._env.step(self.model.predict(seen, deterministic=True)[0])
        spent = float(info["final_info"]["total_time_spent_veh_s"].mean())
        if spent < self._best:
            self._best = spent
            torch.save(self.model.policy.state_dict(), self._out)
        print(
            f"round {self._round}: {spent:.4g} veh s, best {self._best:.4g}, exploring {self._exploring:.4g}",
            flush=True,
        )


def train(rounds: int, seed: int, out: Path = WEIGHTS) -> None:
    """`rounds` of ENVS episodes each; the best agent so far is in `out`."""
    torch.set_num_threads(1)
    scenario = nmfd.load_scenario(HERE)
    env = Sb3VecEnv(NmfdVectorEnv(scenario, ENVS, metering=True, demand_spread=0.2, initial_share=0.5))
    # Returns of a hundred and more would leave the gradient to the critic: rewards are scaled by their spread.
    env = VecNormalize(env, norm_obs=False, gamma=0.99)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=scenario.steps,
        batch_size=1024,
        n_epochs=6,
        gamma=0.99,
        gae_lambda=0.95,
        learning_rate=lambda left: 1e-3 * (0.1 + 0.9 * left),
        target_kl=0.05,
        # Exploration that keeps its direction for half an hour: noise that is new every interval averages out.
        use_sde=True,
        sde_sample_freq=60,
        policy_kwargs=NETWORK,
        seed=seed,
        device="cpu",
    )
    best = Best(scenario, every=5, out=out)
    model.learn(rounds * ENVS * scenario.steps, callback=best)
    best.validate()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="of 64 episodes each (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="the weights (default: %(default)s)")
    arguments = parser.parse_args()
    train(arguments.rounds, arguments.seed, arguments.out)
