"""Simulator forward, model backward: a policy descends along runs of the city itself.

A run x_0, x_1, ... of the city under the policy pi is replayed in the regional model with what the model did not
foresee of it:

    w_k = x_{k+1} - f(x_k, pi(x_k), d_k),        x_{k+1} = max(f(x_k, pi(x_k), d_k) + w_k, 0).

Under pi the replay is the run. The gradient of its TTS by the weights of pi is that of the model along the states that
the city went through, instead of those that the model would have led to (decoupled as in DMO, arXiv 2509.00215). The
further a policy is from pi the more is left to the model: a descent takes few steps, and then the city is asked again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from nmfd.arrays import PairsOverTime, StatesOverTime
from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.policy import Policy
from nmfd.controllers.dpc.rollout import Demands, Levels, Rollout, States


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of the city, of T control intervals.

    accumulation: (T+1, R, R) [veh]; demand: (T, R, R) [veh/s], what wanted to enter if the policy lets trips wait, else
    what entered
    """

    accumulation: StatesOverTime
    demand: PairsOverTime


class Replays:
    """Runs of the same length under one policy, as tensors."""

    def __init__(self, rollout: Rollout, policy: Policy, runs: Sequence[Run]):
        """policy: under which they were"""

        def stacked(arrays: Sequence[np.ndarray]) -> Demands:
            return torch.tensor(np.stack(arrays, axis=1), dtype=rollout.dtype, device=rollout.device)

        self._rollout, self._demand = rollout, stacked([run.demand for run in runs])
        self._states = stacked([run.accumulation for run in runs])
        backlog, unforeseen = torch.zeros_like(self._demand[0]), []
        with torch.no_grad():
            for k, demand in enumerate(self._demand):
                foreseen, backlog = self._next(policy, self._states[k], backlog, demand)
                unforeseen.append(self._states[k + 1] - foreseen)
        self._unforeseen = torch.stack(unforeseen)

    def total_time_spent(self, policy: Policy) -> Levels:
        """TTS (B,) [veh s] of the replays under `policy`, with detours and swings as in training."""
        states, waiting = [self._states[0]], [torch.zeros_like(self._demand[0])]
        for demand, unforeseen in zip(self._demand[:-1], self._unforeseen[:-1], strict=True):
            foreseen, backlog = self._next(policy, states[-1], waiting[-1], demand)
            states.append((foreseen + unforeseen).clamp(min=0.0))
            waiting.append(backlog)
        passed = torch.stack(states)
        return self._rollout.cost(policy, passed, passed, torch.stack(waiting).sum((-2, -1)))

    def _next(self, policy: Policy, x: States, backlog: States, demand: States) -> tuple[States, States]:
        """State and backlog (B, R, R) [veh] that the model foresees one control interval later."""
        entering, backlog = self._rollout.entering(policy, x, demand, backlog)
        return self._rollout.step(policy, x, entering, torch.zeros_like(x)), backlog


def descend(
    policy: Policy,
    replays: Replays,
    *,
    steps: int,
    learning_rate: float,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[float]:
    """Take `steps` Adam steps down the mean logarithm of the TTS of `replays`, in place; returns its geometric mean
    [veh s] before every one of them and at the end."""
    optimizer, path = torch.optim.Adam(policy.parameters(), lr=learning_rate), []
    for done in range(steps + 1):
        loss = torch.log(replays.total_time_spent(policy).clamp(min=1.0)).mean()
        path.append(loss.detach().exp().item())
        if progress:
            progress(done, steps, f"replayed {path[-1]:.4g} veh s")
        if done < steps:
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimizer.step()
            if isinstance(policy, CompactPolicy):
                policy.bound()
    return path
