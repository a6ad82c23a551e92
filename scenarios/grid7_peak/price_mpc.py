r"""MPC with the outputs of the DPC policy over max-pressure: gates, prices and metering, on the
same regional model.

    cd scenarios/grid7_peak
    cosim evaluate grid7_peak --demand 1.6 \
        --controllers price_mpc.py:PriceMpc+max-pressure+guidance-period-60+metering

Every interval it lowers the mean total time spent of MODELS rollouts over HORIZON intervals, each
with a regional model of its own, by ITERATIONS of Adam on u and prices held over the horizon, from
those of the last interval. The costs are the best of six pairs in SUMO at twice the demand on seed
1100, found with an earlier regional model (reference/README.md).
"""

import time

import numpy as np
import torch
from torch import nn

from nmfd.controllers.dpc.policy import FILL_TIME_S
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.model.answer import Answer
from nmfd.model.planning import PlanningModel
from nmfd.types import Controls, Observation

HORIZON, MODELS, ITERATIONS = 20, 4, 10
PRICE_RATE, GATE_RATE = 0.3, 0.1  # steps of Adam
START, HIGHEST = 0.2, 10.0  # prices
SPREAD, SCALE = 0.3, 0.85  # of the drawn models, options mfd_spread and mfd_scale of DPC
METERING = 1.2  # critical accumulations
COSTS = {"detour_cost": 100.0, "holding_cost": 600.0}  # s, options of DPC, too


class Held(nn.Module):
    """Constant u (R, R) and prices (R,); departure rates by the room up to `level` critical
    accumulations."""

    def __init__(self, planning: PlanningModel, level: float):
        super().__init__()
        network = planning.network
        self.answer, self.bounds = Answer(network), (network.u_min, network.u_max)
        self.most = level * torch.tensor(network.critical, dtype=torch.float32)
        self.allowed = torch.tensor(network.adjacency).float()
        self.u = nn.Parameter(network.u_max * self.allowed)
        self.prices = nn.Parameter(torch.full((network.regions,), START))

    def forward(self, x):
        return self.u * self.allowed, self.answer(x, self.prices.expand(x.shape[:-1]))

    def metering(self, x):
        return (self.most - x.sum(-1)).clamp(min=0.0) / FILL_TIME_S

    def bound(self):
        with torch.no_grad():
            self.u.clamp_(*self.bounds)
            self.prices.clamp_(0.0, HIGHEST)


class PriceMpc:
    """Economic MPC by gradients; a decision stops at 80 % of the control interval."""

    name = "price-mpc"

    def __init__(self, planning: PlanningModel):
        self.planning = planning
        self.rollout = Rollout(planning, **COSTS)
        self.reset()

    def reset(self, seed: int = 0):
        self.policy = Held(self.planning, METERING)

    def act(self, observation: Observation) -> Controls:
        begin, k, policy = time.perf_counter(), observation.step, self.policy
        demand = torch.cat([self.rollout.demand[k:], torch.zeros_like(self.rollout.demand)])[
            :HORIZON
        ]
        demand[0] += torch.tensor(observation.backlog, dtype=demand.dtype) / self.planning.step
        x = torch.tensor(observation.accumulation, dtype=demand.dtype).clamp(min=0.0)
        batch = x.expand(MODELS, -1, -1), demand.unsqueeze(1).expand(-1, MODELS, -1, -1)
        adam = torch.optim.Adam(
            [{"params": [policy.prices], "lr": PRICE_RATE}, {"params": [policy.u], "lr": GATE_RATE}]
        )
        random, best, kept = torch.Generator(), np.inf, policy.state_dict()
        for n in range(ITERATIONS + 1):
            random.manual_seed(k)  # the same models in every iteration
            self.rollout.draw_model(MODELS, SPREAD, random, SCALE)
            spent = self.rollout.total_time_spent(policy, *batch, random).mean()
            if spent.item() < best:
                best, kept = (
                    spent.item(),
                    {name: value.clone() for name, value in policy.state_dict().items()},
                )
            if n == ITERATIONS or time.perf_counter() - begin > 0.8 * self.planning.step:
                break
            adam.zero_grad()
            spent.backward()
            adam.step()
            policy.bound()
        policy.load_state_dict(kept)
        with torch.no_grad():
            u, splits = policy(x)
        splits = splits.double().numpy()
        return Controls(
            perimeter=u.double().numpy().clip(0.0, self.planning.network.u_max),
            splits=splits / np.maximum(splits.sum(axis=1, keepdims=True), 1e-9),
            prices=policy.prices.detach().double().numpy(),
            metering=policy.metering(x).double().numpy(),
        )
