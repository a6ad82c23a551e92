"""PPO (Stable-Baselines3) on the benchmark, as a rival for DPC, MPC and gating. Needs the extra `rl`.

Train it, about 8 minutes on one core (writes ppo.zip beside this file), and put it into the benchmark's table:

    python scenarios/economic_mpc/ppo.py
    nmfd benchmark scenarios/economic_mpc \
        --controllers no-control,pi-gating,mpc-pc,dpc-pc,scenarios/economic_mpc/ppo.py:Ppo

Like dpc-pc it controls the perimeter alone, sees the same state, and is trained on the same random starts and demand;
it does not get the gradient of the model.
"""

import argparse
from pathlib import Path

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import nmfd
from nmfd.rl import Interface, NmfdVectorEnv, Sb3VecEnv

HERE = Path(__file__).parent
WEIGHTS = HERE / "ppo.zip"
ENVS = 64
ROUNDS = 150  # of ENVS episodes each


class Ppo:
    """The trained agent as a controller."""

    name = "ppo"
    files = ("ppo.zip",)

    def __init__(self, scenario: nmfd.Scenario):
        if not WEIGHTS.is_file():
            raise nmfd.InputError(f"{WEIGHTS}: no such file; train it with: python {HERE / 'ppo.py'}")
        self._interface, self._model = Interface(scenario.network), PPO.load(WEIGHTS, device="cpu")

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, measurement: nmfd.Measurement) -> nmfd.Controls:
        action, _ = self._model.predict(self._interface.observed(measurement), deterministic=True)
        return self._interface.controls(action)


class Best(BaseCallback):
    """Keeps the agent that does best, without exploring, on the scenario itself: as the training of DPC does."""

    def __init__(self, scenario: nmfd.Scenario, every: int):
        super().__init__()
        self._env, self._every, self._round, self._best = NmfdVectorEnv(scenario, 2), every, 0, float("inf")

    def _on_step(self) -> bool:
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
            self.model.save(WEIGHTS)
        print(f"round {self._round}: {spent:.4g} veh s, best {self._best:.4g}", flush=True)


def train(rounds: int, seed: int) -> None:
    torch.set_num_threads(1)
    scenario = nmfd.load_scenario(HERE)
    env = Sb3VecEnv(NmfdVectorEnv(scenario, ENVS, demand_spread=0.2, initial_share=0.5))
    model = PPO(
        "MlpPolicy", env, n_steps=scenario.steps, batch_size=1024, n_epochs=6, gamma=0.99, gae_lambda=0.95,
        learning_rate=lambda left: 3e-4 * (0.1 + 0.9 * left),
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -0.5},
        seed=seed, device="cpu")
    best = Best(scenario, every=5)
    model.learn(rounds * ENVS * scenario.steps, callback=best)
    best.validate()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="of 64 episodes each (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    train(arguments.rounds, arguments.seed)
