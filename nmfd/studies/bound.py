"""The bound: full-horizon optimal control of the regional model with perfect knowledge of the demand.

Gradient descent (Adam) on all controls of all intervals at once, through `dynamics`, from several starts. The problem
is not convex: the result is the least total time spent known to be possible, not a proven minimum.
"""

import math
from collections.abc import Callable, Iterable, Mapping

import numpy as np
import torch
from jaxtyping import Float

from nmfd import closed_loop
from nmfd.controllers.open_loop import NAMES, Plan
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model import dynamics
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.tensors import one_thread

ITERATIONS = 1500
LEARNING_RATE = 0.15  # of Adam, on logits; decays along a cosine
Note = Callable[[int, int, str], None]  # takes done, all, note
INSIDE = 0.02  # distance of starts from the edge of the admissible set, where the gradient is zero


def compute(scenario: Scenario, name: str, *, iterations: int = ITERATIONS, progress: Note | None = None) -> Plan:
    """Return the bound `name` ("bound-pc" or "bound-pcrg"), from neutral starts, PI gating and trained policies."""
    if name not in NAMES:
        raise InputError(f"--controller: {name!r} is no bound; choose one of {', '.join(NAMES)}")
    guidance, steps = NAMES[name], scenario.steps
    begin = neutral_starts(scenario.network, steps, guidance=guidance)
    policies = ["dpc-pc", "dpc-pcrg"] if guidance else ["dpc-pc"]
    trained = [policy for policy in policies if scenario.folder and (scenario.folder / f"{policy}.pt").is_file()]
    for start in [*(["pi-gating"] if scenario.protected else []), *trained]:
        if progress:
            progress(0, steps, f"closed loop {start}")
        result = closed_loop.run(NmfdPlant(scenario), parse(start).make(scenario), scenario, seed=0)
        begin[start] = result.perimeter, result.splits
    return solve(scenario, begin, guidance=guidance, iterations=iterations, progress=progress)


def neutral_starts(network: RegionalModel, steps: int, *, guidance: bool) -> dict[str, tuple]:
    """Return perimeter (T, R, R) and splits (T, R, R, R) of open boundaries, and of mean controls."""
    mask, nominal = network.split_mask, network.nominal_splits
    even = mask / np.maximum(mask.sum(axis=1, keepdims=True), 1) if guidance else nominal

    def constant(u: float, splits: np.ndarray) -> tuple:
        perimeter = np.where(network.adjacency, u, 0.0)
        return np.broadcast_to(perimeter, (steps, *perimeter.shape)), np.broadcast_to(splits, (steps, *splits.shape))

    middle = 0.5 * (network.u_min + network.u_max)
    return {"open": constant(network.u_max, nominal), "middle": constant(middle, even)}


@one_thread()
def solve(
    scenario: Scenario,
    starts: Mapping[str, tuple],
    *,
    guidance: bool,
    iterations: int = ITERATIONS,
    progress: Note | None = None,
) -> Plan:
    """Return the best plan by separate descents from `starts`: name -> perimeter (T, R, R) and splits (T, R, R, R).

    A KeyboardInterrupt ends them early and returns the best plan so far.
    """
    network = scenario.network
    parameters = dynamics.parameters(network)
    controls = _Controls(network, scenario.steps, starts.values(), guidance=guidance)
    optimizer = torch.optim.Adam(controls.logits, lr=LEARNING_RATE)
    best = np.full(len(starts), math.inf)
    kept: list[tuple] = [()] * len(starts)
    try:
        for iteration in range(iterations + 1):  # the last only evaluates
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * iteration / (iterations + 1)))
            perimeter, splits = controls()
            totals = _total_time_spent(scenario, parameters, perimeter, splits)
            for n in np.flatnonzero(totals.detach().numpy() < best):
                best[n] = totals[n].item()
                kept[n] = tuple(logits[:, n].detach().clone() for logits in controls.logits)
            if iteration < iterations:
                optimizer.zero_grad()
                torch.log(totals.clamp(min=1.0)).sum().backward()  # each at its own scale
                optimizer.step()
                if progress:
                    progress(iteration + 1, iterations, f"best {best.min():.4g} veh s")
    except KeyboardInterrupt:
        if not np.isfinite(best).all():
            raise
    winner = int(best.argmin())
    with torch.no_grad():
        for logits, best_logits in zip(controls.logits, kept[winner], strict=True):
            logits[:, 0] = best_logits
        perimeter, splits = (value[:, 0].numpy() for value in controls())
    names = list(starts)
    return Plan(
        perimeter=perimeter,
        splits=splits if guidance else None,
        start=names[winner],
        totals={name: float(total) for name, total in zip(names, best, strict=True)},
    )


class _Controls:
    """Admissible controls of T intervals and B plans from logits: a scaled sigmoid and a masked softmax."""

    def __init__(self, network: RegionalModel, steps: int, starts: Iterable[tuple], *, guidance: bool):
        mask = torch.tensor(network.split_mask)
        self._adjacency = torch.tensor(network.adjacency, dtype=torch.float64)
        self._mask, self._bounds = mask.double(), (network.u_min, network.u_max)
        # Rows without next region (j = i) keep finite logits and are zeroed: a softmax of only -inf is NaN.
        self._blocked = ~mask & mask.any(dim=1, keepdim=True)
        self._nominal = torch.tensor(network.nominal_splits).expand(steps, 1, *mask.shape)
        width = network.u_max - network.u_min
        perimeters, splits = zip(*starts, strict=True)
        share = (torch.tensor(np.stack(perimeters, axis=1)) - network.u_min) / width
        self.logits = [torch.logit(share.clamp(INSIDE, 1.0 - INSIDE))]
        if guidance:
            even = self._mask / self._mask.sum(dim=1, keepdim=True).clamp(min=1.0)
            theta = (1.0 - INSIDE) * torch.tensor(np.stack(splits, axis=1)) + INSIDE * even
            self.logits.append(torch.log(theta.clamp(min=1e-6)))
        for logits in self.logits:
            logits.requires_grad_()

    def __call__(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return perimeter (T, B, R, R) and splits (T, B, R, R, R), or (T, 1, R, R, R) without guidance."""
        low, high = self._bounds
        perimeter = (low + (high - low) * torch.sigmoid(self.logits[0])) * self._adjacency
        if len(self.logits) == 1:
            return perimeter, self._nominal
        return perimeter, torch.softmax(self.logits[1].masked_fill(self._blocked, -torch.inf), dim=-2) * self._mask


def _total_time_spent(
    scenario: Scenario, parameters: dynamics.Parameters, perimeter: torch.Tensor, splits: torch.Tensor
) -> Float[torch.Tensor, " B"]:
    """Return the total time spent [veh s] of plans: perimeter (T, B, R, R), splits (T, B or 1, R, R, R)."""
    x, demand = torch.from_numpy(scenario.start).expand(perimeter.shape[1], -1, -1), torch.from_numpy(scenario.demand)
    states = [x]
    for k in range(scenario.steps - 1):
        x = dynamics.advance(parameters, x, demand[k], perimeter[k], splits[k], **scenario.scheme)
        states.append(x)
    return scenario.step * torch.stack(states).sum((0, -2, -1))
