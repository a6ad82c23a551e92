"""The bound: full-horizon optimal control of the regional model with perfect knowledge of the demand.

Gradient descent (Adam) on all controls of all intervals at once, through `dynamics`. The problem is not convex, so
several starts are descended together and the best answer is kept: it is the least total time spent that is known to
be possible, not one that is proven to be the least.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float

from nmfd import closed_loop
from nmfd.controllers.open_loop import NAMES, Plan
from nmfd.controllers.strategy import Strategy, parse
from nmfd.errors import InputError
from nmfd.model import dynamics
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.tensors import one_thread

ITERATIONS = 1500
LEARNING_RATE = 0.15  # of Adam, on logits; falls along a cosine
INSIDE = 0.02  # a start is moved this far into the admissible set: on its edge there is no gradient


def check(name: str) -> None:
    """InputError unless `name` is a bound."""
    if name not in NAMES:
        raise InputError(f"--controller: {name!r} is no bound; choose one of {', '.join(NAMES)}")


def compute(
    scenario: Scenario,
    name: str,
    *,
    starts: Sequence[Strategy] | None = None,
    iterations: int = ITERATIONS,
    progress: Callable[[int, int, str], None] | None = None,
) -> Plan:
    """The bound `name` ("bound-pc" or "bound-pcrg"), from neutral starts and the closed loops of `starts`.

    starts: strategies with the same action set or a smaller one; default PI gating and the scenario's own policies
    """
    check(name)
    guidance = NAMES[name]
    begin = neutral_starts(scenario.network, scenario.steps, guidance=guidance)
    for strategy in _usual_starts(scenario, guidance) if starts is None else starts:
        trajectory = closed_loop.run(
            NmfdPlant(scenario),
            strategy.make(scenario),
            scenario,
            seed=0,
            progress=progress
            and (lambda done, total, name=strategy.name: progress(done, total, f"closed loop {name}")),
        )
        if not guidance and not np.array_equal(trajectory.splits[0], scenario.network.nominal_splits):
            raise InputError(f"--from: {strategy.name} guides routes, which {name} may not; omit it")
        begin[strategy.name] = trajectory.perimeter, trajectory.splits
    return solve(scenario, begin, guidance=guidance, iterations=iterations, progress=progress)


def _usual_starts(scenario: Scenario, guidance: bool) -> list[Strategy]:
    candidates = (["pi-gating"] if scenario.protected else []) + ["dpc-pc"] + (["dpc-pcrg"] if guidance else [])
    return [
        parse(name)
        for name in candidates
        if not name.startswith("dpc") or (scenario.folder is not None and (scenario.folder / f"{name}.pt").is_file())
    ]


def neutral_starts(network: RegionalModel, steps: int, *, guidance: bool) -> dict[str, tuple]:
    """Perimeter (T, R, R) and splits (T, R, R, R) that know nothing: everything open, and everything in the middle."""
    mask = network.split_mask
    even = mask / np.maximum(mask.sum(axis=1, keepdims=True), 1)

    def constant(u: float, splits: np.ndarray) -> tuple:
        return (
            np.broadcast_to(np.where(network.adjacency, u, 0.0), (steps, *network.adjacency.shape)),
            np.broadcast_to(splits if guidance else network.nominal_splits, (steps, *splits.shape)),
        )

    return {
        "open": constant(network.u_max, network.nominal_splits),
        "middle": constant(0.5 * (network.u_min + network.u_max), even),
    }


@one_thread()
def solve(
    scenario: Scenario,
    starts: Mapping[str, tuple],
    *,
    guidance: bool,
    iterations: int = ITERATIONS,
    learning_rate: float = LEARNING_RATE,
    progress: Callable[[int, int, str], None] | None = None,
) -> Plan:
    """The best plan found from `starts`: name -> perimeter (T, R, R) and splits (T, R, R, R).

    The descents do not see one another. A KeyboardInterrupt ends them early; what was found by then is returned.
    """
    network = scenario.network
    parameters = dynamics.parameters(network)
    demand = torch.from_numpy(scenario.demand)
    controls = _Controls(network, scenario.steps, starts.values(), guidance=guidance)
    optimizer = torch.optim.Adam(controls.logits, lr=learning_rate)
    best = np.full(len(starts), math.inf)
    kept: list[tuple] = [()] * len(starts)
    iteration = 0
    try:
        for iteration in range(iterations + 1):  # the last only looks at what the step before has reached
            for group in optimizer.param_groups:
                group["lr"] = learning_rate * 0.5 * (1.0 + math.cos(math.pi * iteration / (iterations + 1)))
            perimeter, splits = controls()
            totals = _total_time_spent(scenario, parameters, demand, perimeter, splits)
            for n in np.flatnonzero(totals.detach().numpy() < best):
                best[n] = totals[n].item()
                kept[n] = tuple(logits[:, n].detach().clone() for logits in controls.logits)
            if iteration < iterations:
                optimizer.zero_grad()
                torch.log(totals.clamp(min=1.0)).sum().backward()  # every descent by its own scale
                optimizer.step()
                if progress:
                    progress(iteration + 1, iterations, f"best {best.min():.4g} veh s")
    except KeyboardInterrupt:
        if not np.isfinite(best).all():
            raise
    winner = int(best.argmin())
    with torch.no_grad():
        for logits, found in zip(controls.logits, kept[winner], strict=True):
            logits[:, 0] = found
        perimeter, splits = (value[:, 0].numpy() for value in controls())
    names = list(starts)
    return Plan(
        perimeter=perimeter,
        splits=splits if guidance else None,
        start=names[winner],
        totals={name: float(total) for name, total in zip(names, best, strict=True)},
        iterations=iteration,
    )


class _Controls:
    """Admissible controls of T intervals and B plans from logits: a scaled sigmoid and a masked softmax."""

    def __init__(self, network: RegionalModel, steps: int, starts: Iterable[tuple], *, guidance: bool):
        mask = torch.tensor(network.split_mask)
        self._adjacency = torch.tensor(network.adjacency, dtype=torch.float64)
        self._mask, self._bounds = mask.double(), (network.u_min, network.u_max)
        # Rows with no way out (j = i) keep finite logits and are zeroed: a softmax of nothing but -inf is NaN.
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
        """Perimeter (T, B, R, R) and splits (T, B, R, R, R), or (T, 1, R, R, R) without guidance."""
        low, high = self._bounds
        perimeter = (low + (high - low) * torch.sigmoid(self.logits[0])) * self._adjacency
        if len(self.logits) == 1:
            return perimeter, self._nominal
        return perimeter, torch.softmax(self.logits[1].masked_fill(self._blocked, -torch.inf), dim=-2) * self._mask


def _total_time_spent(
    scenario: Scenario,
    parameters: dynamics.Parameters,
    demand: Float[torch.Tensor, "T R R"],
    perimeter: Float[torch.Tensor, "T B R R"],
    splits: Float[torch.Tensor, "T b R R R"],  # b: B or 1
) -> Float[torch.Tensor, " B"]:
    """TTS (B,) [veh s] of plans from the start of the scenario by the definition of nmfd.metrics."""
    x = torch.from_numpy(scenario.start).expand(perimeter.shape[1], -1, -1)
    states = [x]
    for k in range(scenario.steps - 1):
        x = dynamics.advance(
            parameters,
            x,
            demand[k],
            perimeter[k],
            splits[k],
            scenario.step,
            integrator=scenario.integrator,
            substeps=scenario.substeps,
        )
        states.append(x)
    return scenario.step * torch.stack(states).sum((0, -2, -1))
