"""The terminal cost of MPC: the value function of a DPC policy, learned from rollouts of the
regional model.

    python scenarios/economic_mpc/terminal_cost.py mpc-pcrg-terminal

States are those that the scenario goes through under several controllers, mixed in pairs and
scattered. From each of them the policy is rolled out until the scenario ends, with automatic
differentiation: the sum of the vehicles, and how it changes with every x_ij (Czarnecki et al.,
    "Sobolev training for neural networks", 2017; on values alone the
derivatives that MPC goes by come out wrong). From the second round on MPC has driven with what was
learned before: it leads into states of its own.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from nmfd import closed_loop
from nmfd.api import load_scenario
from nmfd.arrays import StatesOverTime
from nmfd.controllers.dpc.policy import DpcController, Policy
from nmfd.controllers.dpc.policy_file import load_policy
from nmfd.controllers.dpc.rollout import Demands, Rollout
from nmfd.controllers.mpc.controller import EconomicMpc, MpcController
from nmfd.controllers.mpc.terminal import LATE, OFFSET, WEIGHTS, Terminal, clock
from nmfd.controllers.rules import NoControl, scenario_gate
from nmfd.controllers.strategy import parse
from nmfd.model.planning import PlanningModel
from nmfd.model.plant import NmfdPlant
from nmfd.model.scenario import Scenario
from nmfd.runs.files import atomic
from nmfd.tensors import one_thread
from nmfd.types import Controller

TERMINAL = {
    "mpc-pc-terminal": "dpc-pc",
    "mpc-pcrg-terminal": "dpc-pcrg",
}  # MPC -> policy of its value function
ROLLOUTS = 128  # at a time
MOST_SCATTER = 0.25  # of the logarithm of every x_ij
WIDTH = 128  # of both hidden layers
BATCH = 256  # states per Adam step
RATE, LAST = 2e-3, 0.02  # learning rate of Adam; what is left of it at the end
VALUES = 0.3  # weight of the squared error of values, beside the Huber loss of derivatives

Batch = tuple[
    torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor
]  # x (N, R, J), step (N,), value (N,), slope


def learn(
    scenario: Scenario,
    controller: str,
    *,
    seed: int = 0,
    samples: int = 12_000,
    rounds: int = 2,
    steps: int = 4000,
    policy: Path | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> Terminal:
    """Learn the terminal cost of `controller`, a key of TERMINAL; the same seed gives the same
    numbers.

    samples: states per round; steps: Adam steps per round; policy: file of the DPC policy that
        takes over after the
    horizon, the scenario's own if None
    """
    follows, guidance = parse(TERMINAL[controller]), parse(controller).guides
    planning = parse(controller).own_planning(scenario)
    file = follows.file(scenario, policy)
    assert file is not None  # every DPC controller has one
    with one_thread():
        torch.manual_seed(seed)
        generator = torch.Generator().manual_seed(seed)
        after, _ = load_policy(file, planning.network)
        after.requires_grad_(False)
        rollout, found, terminal = Rollout(planning), list[Batch](), None
        city, total = replace(scenario, network=planning.network), rounds * (samples + steps)

        def driven(driver: Controller) -> StatesOverTime:
            return closed_loop.run(NmfdPlant(city), driver, city, seed=seed)["accumulation"][:-1]

        mpc = EconomicMpc(guidance=guidance)
        both = [driven(DpcController(after)), driven(mpc.make(planning))]
        for number in range(rounds):
            begin = number * (samples + steps)

            def tell(done: int, note: str, begin: int = begin, number: int = number) -> None:
                if progress:
                    progress(begin + done, total, f"round {number + 1} of {rounds}: {note}")

            if terminal is not None:  # twice as often as the others
                own = 2 * [driven(MpcController(planning, mpc, terminal=terminal))]
            else:
                own = [
                    driven(NoControl().make(planning)),
                    *([driven(scenario_gate(planning))] if planning.protected else []),
                ]
            visited = torch.tensor(np.stack(both + own), dtype=rollout.dtype)
            seen = 0
            while seen < samples:
                found.append(_sampled(rollout, after, visited, generator))
                seen += ROLLOUTS
                tell(min(seen, samples), f"{seen} states")
            terminal = _fitted(
                planning, rollout, found, controller, steps, generator, tell, samples
            )
        assert terminal is not None  # there is a round
        return terminal


def _sampled(
    rollout: Rollout, policy: Policy, visited: Demands, generator: torch.Generator
) -> Batch:
    """ROLLOUTS states, when they are, and value and derivative of the policy there. visited: (C, T,
    R, R) [veh]"""
    drivers, steps = visited.shape[:2]
    step = torch.randint(steps, (ROLLOUTS,), generator=generator)
    one, other = (
        visited[torch.randint(drivers, (ROLLOUTS,), generator=generator), step] for _ in range(2)
    )
    share = torch.rand(ROLLOUTS, 1, 1, generator=generator)
    scatter = MOST_SCATTER * torch.rand(ROLLOUTS, 1, 1, generator=generator)
    begin = (share * one + (1.0 - share) * other) * torch.exp(
        scatter * torch.randn(one.shape, generator=generator)
    )
    begin.requires_grad_(True)
    demand = torch.cat([rollout.demand, torch.zeros_like(rollout.demand)])
    x, value, exact = begin, torch.zeros(ROLLOUTS), torch.zeros_like(begin)
    for k in range(steps - int(step.min()) - 1):
        x = rollout.step(policy, x, demand[step + k], exact)
        value = value + (step + k + 1 < steps) * x.sum((-2, -1))
    (slope,) = torch.autograd.grad(value.sum(), begin)
    used = rollout.bound.bool()
    return begin.detach()[:, :, used], step, value.detach(), slope[:, :, used]


def _fitted(
    planning: PlanningModel,
    rollout: Rollout,
    found: list[Batch],
    controller: str,
    steps: int,
    generator: torch.Generator,
    tell: Callable[[int, str], object],
    before: int,
) -> Terminal:
    """V, learned from all samples so far. before: what was done of this round, for `tell`"""
    x, step, value, slope = (torch.cat(parts) for parts in zip(*found, strict=True))
    cells, horizon = x[0].numel(), planning.steps
    critical = torch.tensor([[mfd.critical] for mfd in planning.network.mfds], dtype=x.dtype)
    scale = critical.expand(x.shape[1:]).flatten()
    times = torch.tensor(np.stack([clock(k / horizon) for k in range(horizon)]), dtype=x.dtype)
    network = torch.nn.Sequential(
        torch.nn.Linear(cells + times.shape[1], WIDTH),
        torch.nn.GELU(),
        torch.nn.Linear(WIDTH, WIDTH),
        torch.nn.GELU(),
        torch.nn.Linear(WIDTH, cells + 1),
    )

    def valued(x: Float[torch.Tensor, "B C"], step: torch.Tensor) -> Float[torch.Tensor, " B"]:
        out, left = network(torch.cat([x / scale, times[step]], dim=1)), 1.0 - step / horizon
        stays = (torch.sigmoid(out[:, :-1] - LATE) * x).sum(-1)
        return left * (horizon * stays + OFFSET * out[:, -1])

    of_values, of_slopes = (
        value.std(),
        slope.abs().mean(),
    )  # a few slopes are a hundred times as steep: before a lock
    optimizer = torch.optim.Adam(network.parameters(), lr=RATE)
    for done in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = RATE * (
                LAST + (1.0 - LAST) * 0.5 * (1.0 + math.cos(math.pi * done / steps))
            )
        chosen = torch.randint(len(x), (BATCH,), generator=generator)
        at = x[chosen].flatten(1).requires_grad_(True)
        foreseen = valued(at, step[chosen])
        (rises,) = torch.autograd.grad(foreseen.sum(), at, create_graph=True)
        missed = torch.nn.functional.smooth_l1_loss(
            rises / of_slopes, slope[chosen].flatten(1) / of_slopes
        )
        loss = missed + VALUES * ((foreseen - value[chosen]) / of_values).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        tell(before + done + 1, f"misfit {loss.item():.4f}")
    layers = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
    return Terminal(
        steps=horizon,
        used=planning.destinations,
        scale=scale.double().numpy(),
        weights=tuple(layer.weight.detach().double().numpy() for layer in layers),
        biases=tuple(layer.bias.detach().double().numpy() for layer in layers),
        network_hash=planning.network.hash,
        controller=controller,
    )


def write(terminal: Terminal, path: Path) -> None:
    """Write an .npz file."""
    layers = zip(WEIGHTS, terminal.weights, terminal.biases, strict=True)
    arrays = {
        f"{name}_{kind}": a.astype(np.float32)
        for name, w, b in layers
        for kind, a in (("weight", w), ("bias", b))
    }
    others = {
        name: getattr(terminal, name)
        for name in ("steps", "used", "scale", "network_hash", "controller")
    }
    with atomic(path) as temporary:
        np.savez_compressed(temporary, **others, **arrays)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("controller", choices=list(TERMINAL))
    parser.add_argument("--seed", type=int, default=0)
    options, folder = parser.parse_args(), Path(__file__).parent
    learned = learn(load_scenario(folder), options.controller, seed=options.seed)
    write(learned, folder / f"{options.controller}.npz")
