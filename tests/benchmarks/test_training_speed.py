"""One Adam step's rollout and gradient, 240 control intervals and 16 rollouts, plain and compiled:

pytest -n0 tests/benchmarks/test_training_speed.py --benchmark-only
"""

from pathlib import Path

import pytest
import torch

from nmfd.api import load_scenario
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.rollout import Rollout, compiled_step
from nmfd.model.planning import planning_model

SCENARIO = Path(__file__).parents[2] / "scenarios" / "economic_mpc"


@pytest.mark.parametrize("compiled", [False, True], ids=["plain", "compiled"])
def test_gradient_of_a_rollout(benchmark, compiled):
    torch.set_num_threads(1)
    torch.manual_seed(0)
    scenario = load_scenario(SCENARIO)
    rollout, policy = Rollout(planning_model(scenario)), Policy(scenario.network, Architecture(guidance=True))
    step = compiled_step(rollout.step) if compiled else None

    def gradient():
        generator = torch.Generator().manual_seed(0)
        x, demand = rollout.random_start(16, 0.2, 0.5, generator)
        policy.zero_grad()
        total = rollout.total_time_spent(policy, x, demand, generator, step)
        torch.log(total).mean().backward()
        return total.detach()

    total = benchmark.pedantic(gradient, rounds=5, warmup_rounds=2)
    generator = torch.Generator().manual_seed(0)
    plain = rollout.total_time_spent(policy, *rollout.random_start(16, 0.2, 0.5, generator), generator)
    torch.testing.assert_close(total, plain.detach(), rtol=1e-4, atol=0.0)
