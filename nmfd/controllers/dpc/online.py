"""A DPC policy that goes on learning while it drives: fine-tuned between control steps on what it has seen so far.

The future work of Tumu et al. After every control interval (1) the demand and the MFDs are estimated by how far the
regional model missed the new state, and (2) a few Adam steps descend the total time spent of rollouts from that state
in the corrected model. What is fine-tuned is dropped at the end of a run.
"""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from nmfd.arrays import PerPair, PerRegion
from nmfd.controllers.dpc.options import Online
from nmfd.controllers.dpc.policy import DpcController, Policy
from nmfd.controllers.dpc.policy_file import check_guidance, load_policy
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.controllers.options import options
from nmfd.model import dynamics
from nmfd.model.planning import PlanningModel
from nmfd.types import Controls, Observation

MEMORY = 0.97  # of what was seen, per control interval: half is forgotten after 23
TRUST = 1.0  # how much the nominal model weighs: as one interval with 1 % of the critical accumulations flowing
LIMITS = (0.5, 2.0)  # of demand and outflow, times their nominal values


class ModelEstimate:
    """How the demand of every origin and the outflow of every region differ from the scenario's, as factors.

    The regional model is linear in them: x(k+1) - x(k) = dt (sum_o f_o d_o + sum_i g_i q_i), where d_o is the demand
    from origin o and q_i what the outflow of region i does to all x. Fitted by least squares that forgets (MEMORY),
    with the nominal model as prior (TRUST).

    demand, outflow: (R,) [-]
    """

    def __init__(self, planning: PlanningModel):
        self._planning, self._regions = planning, planning.network.regions
        self._parameters = dynamics.parameters(planning.network)
        self._splits = torch.from_numpy(planning.network.nominal_splits)
        flowing = 0.01 * np.mean([mfd.critical for mfd in planning.network.mfds])
        self._prior = TRUST * flowing**2 * np.eye(2 * self._regions)
        self.reset()

    def reset(self) -> None:
        """Back to the nominal model."""
        self._squares = np.zeros((2 * self._regions,) * 2)
        self._misses = np.zeros(2 * self._regions)
        self.demand, self.outflow = np.ones(self._regions), np.ones(self._regions)

    def update(self, before: PerPair, after: PerPair, planned: PerPair, controls: Controls) -> None:
        """before, after: accumulation (R, R) [veh] at two steps, between them `controls` and the demand `planned`."""
        parts = self._contributions(before, planned, controls)
        miss = (after - before - parts.sum(axis=0)).ravel()
        rows = parts.reshape(len(parts), -1)
        self._squares = MEMORY * self._squares + rows @ rows.T
        self._misses = MEMORY * self._misses + rows @ miss
        factors = 1.0 + np.linalg.solve(self._squares + self._prior, self._misses)
        self.demand, self.outflow = np.split(np.clip(factors, *LIMITS), 2)

    def _contributions(self, before: PerPair, planned: PerPair, controls: Controls) -> Float[np.ndarray, "M R R"]:
        """(2 R, R, R) [veh]: what the demand of each origin and the outflow of each region add to x in an interval."""
        step, regions = self._planning.step, self._regions
        x = torch.from_numpy(np.maximum(before, 0.0))
        splits = self._splits if controls.splits is None else torch.from_numpy(controls.splits)
        completions, transfers = (
            flow.numpy() for flow in dynamics.flows(self._parameters, x, torch.from_numpy(controls.perimeter), splits)
        )
        parts = np.zeros((2 * regions, regions, regions))
        for i in range(regions):
            parts[i, i] = step * planned[i]
            parts[regions + i] = step * transfers[i]
            parts[regions + i, i] -= step * transfers[i].sum(axis=0)
            parts[regions + i, i, i] -= step * completions[i]
        return parts


class OnlineDpc:
    """A policy that is fine-tuned between control steps (nmfd.types.Controller).

    The frozen policy stays at hand: an interval is left to whichever of the two spends less time in the corrected
    model. Options (nmfd.controllers.dpc.options.Online) are in [controllers.dpc-pc-online] or
    [controllers.dpc-pcrg-online].

    demand, outflow: (R,) [-], the present estimate
    """

    def __init__(self, policy: Policy, planning: PlanningModel):
        self.name = f"dpc-{'pcrg' if policy.architecture.guidance else 'pc'}-online"
        chosen = options(Online, planning, self.name)
        self._look_ahead, self._iterations = chosen.look_ahead, chosen.iterations
        self._learning_rate, self._count = chosen.learning_rate, chosen.rollouts
        self._planning, self._frozen = planning, policy.eval()
        self._rollout = Rollout(planning)
        self._nominal = self._rollout.parameters
        self._estimate = ModelEstimate(planning)
        self._spread = 0.02 * np.array([[mfd.critical] for mfd in planning.network.mfds])
        self.reset()

    @property
    def demand(self) -> PerRegion:
        """Of every origin, times its nominal value."""
        return self._estimate.demand

    @property
    def outflow(self) -> PerRegion:
        """Of every region, times its nominal value."""
        return self._estimate.outflow

    def reset(self, seed: int = 0) -> None:
        """Back to the trained policy and the nominal model."""
        self._estimate.reset()
        self._tuned = copy.deepcopy(self._frozen)
        self._controllers = [DpcController(self._tuned), DpcController(self._frozen)]
        self._optimizer = torch.optim.Adam(self._tuned.parameters(), lr=self._learning_rate)
        self._random = np.random.default_rng([seed, 0x6F6E6C69])
        self._generator = torch.Generator().manual_seed(seed)
        self._last: tuple[np.ndarray, Controls, int] | None = None

    def act(self, observation: Observation) -> Controls:
        seen, k = observation.accumulation, observation.step
        if self._last is not None:
            before, controls, step = self._last
            self._estimate.update(before, seen, self._planned(step), controls)
        self._correct()
        demand = self._forecast(k)
        for _ in range(self._iterations):
            self._tune(seen, demand)
        with torch.no_grad():
            start = torch.from_numpy(np.maximum(seen, 0.0)).float().unsqueeze(0)
            spent = [
                float(self._rollout.total_time_spent(policy, start, demand[:, :1], self._generator))
                for policy in (self._tuned, self._frozen)
            ]
        controls = self._controllers[0 if spent[0] <= spent[1] else 1].act(observation)
        self._last = seen, controls, k
        return controls

    def _tune(self, seen: np.ndarray, demand: torch.Tensor) -> None:
        states = seen + self._spread * self._random.standard_normal((self._count, *seen.shape)) * (seen > 0)
        start = torch.from_numpy(np.maximum(states, 0.0)).float()
        spent = self._rollout.total_time_spent(self._tuned, start, demand, self._generator)
        loss = torch.log(spent.clamp(min=1.0)).mean()
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._tuned.parameters(), 1.0)
        self._optimizer.step()

    def _planned(self, step: int) -> PerPair:
        """(R, R) [veh/s] in interval `step`; nothing after the end."""
        forecast = self._planning.forecast
        return forecast[step] if step < len(forecast) else np.zeros_like(forecast[0])

    def _forecast(self, step: int) -> torch.Tensor:
        """(H, B, R, R) [veh/s]: the planned demand from `step` on, times what was seen of it."""
        planned = np.stack([self._planned(k) for k in range(step, step + self._look_ahead)])
        corrected = torch.from_numpy(planned * self._estimate.demand[:, None]).float()
        return corrected.unsqueeze(1).expand(-1, self._count, -1, -1)

    def _correct(self) -> None:
        """The rollouts follow the estimated outflows, as far as the integration step allows."""
        p = self._nominal
        fastest = p.c if p.exit_rates is None else p.c * p.exit_rates.amax(-1)
        most = 1.0 / (fastest * self._planning.step / self._planning.substeps)
        factor = torch.minimum(torch.from_numpy(self._estimate.outflow).float(), most)
        self._rollout.parameters = replace(p, a=factor * p.a, b=factor * p.b, c=factor * p.c)


def load(path: Path, planning: PlanningModel, *, guidance: bool) -> OnlineDpc:
    """The policy in `path`, fine-tuned as it drives. InputError as dpc.load."""
    policy, _ = load_policy(path, planning.network)
    check_guidance(policy, path, guidance)
    return OnlineDpc(policy, planning)
