"""A policy that is watched: where the state has left what it was trained on, PI gating takes over."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from nmfd.controllers.dpc import DpcController, Policy, check_guidance, load_policy
from nmfd.controllers.gating import PiGating
from nmfd.errors import InputError
from nmfd.scenario import Scenario
from nmfd.types import Controls, Measurement

# Added to the variance of every normalised state: 2 % of the critical accumulation is no departure, even in an entry
# that was always empty in training.
TOLERANCE = 0.02
QUANTILE = 0.999    # of the training states that count as inside
PATIENCE = 4        # control intervals in a row inside before the policy is trusted again


def statistics(states: np.ndarray) -> dict[str, torch.Tensor]:
    """What a checkpoint keeps of the training states (N, R*R) [-], each divided by the policy's scale.

    mean (R*R,), precision (R*R, R*R): of the Mahalanobis distance; limit: the QUANTILE of it in training.
    """
    mean = states.mean(axis=0)
    precision = np.linalg.inv(np.cov(states, rowvar=False) + TOLERANCE**2 * np.eye(states.shape[1]))
    far = states - mean
    squares = ((far @ precision) * far).sum(axis=1)
    return {"mean": torch.from_numpy(mean), "precision": torch.from_numpy(precision),
            "limit": torch.tensor(float(np.sqrt(np.quantile(squares, QUANTILE))), dtype=torch.float64)}


class Guarded:
    """A policy with PI gating behind it (nmfd.types.Controller).

    Outside: the Mahalanobis distance of the measured state from the training states is beyond its limit. PI gating
    starts anew with an open perimeter when it takes over, and hands back after PATIENCE intervals inside.
    """

    def __init__(self, policy: Policy, states: dict[str, torch.Tensor], scenario: Scenario):
        self._policy, self._fallback = DpcController(policy), PiGating(scenario)
        self.name = f"{self._policy.name}-guarded"
        self._scale = policy.scale.numpy().astype(float)
        self._mean, self._precision = states["mean"].numpy(), states["precision"].numpy()
        self._limit = float(states["limit"])
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._policy.reset()
        self._left = 0  # intervals that PI gating keeps the control for

    def distance(self, accumulation: np.ndarray) -> float:
        """Mahalanobis distance of accumulation (R, R) [veh] from the training states, as a share of its limit."""
        far = (accumulation / self._scale).ravel() - self._mean
        return float(np.sqrt(far @ self._precision @ far)) / self._limit

    def act(self, measurement: Measurement) -> Controls:
        distance = self.distance(measurement.accumulation)
        if distance > 1.0:
            if self._left == 0:
                self._fallback.reset()
            self._left = PATIENCE
        elif self._left > 0:
            self._left -= 1
        if self._left == 0:
            return self._policy.act(measurement)
        return replace(
            self._fallback.act(measurement), status=f"guard: {distance:.2f} of the limit, pi-gating in control")


def load(path: Path, scenario: Scenario, *, guidance: bool) -> Guarded:
    """The policy in `path`, guarded. InputError as dpc.load, and if the file holds no statistics of its training."""
    policy, content = load_policy(path, scenario.network)
    check_guidance(policy, path, guidance)
    if "states" not in content:
        raise InputError(f"{path}: holds no statistics of its training states; train it again with 'nmfd train'")
    return Guarded(policy, content["states"], scenario)
