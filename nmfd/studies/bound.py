"""Optimal control of the regional model over the full horizon, with known demand: best plan found
and lower bound.

Best plan found: gradient descent (Adam) on all controls of all intervals at once, through
`dynamics`, from several starts. The problem is not convex, so the optimum may take less total time
spent (TTS).

Lower bound: the optimum of a linear relaxation, which no control falls below. Its variables at
every evaluation of the derivative by `dynamics.advance` (one per substep with Euler, four with RK4)
are x_ij [veh], the outflows before the gates r_ij = k_ij q_i x_ij, and the transfer flows y_ihj
[veh/s]; k_ij: exit rates, n_i = sum_j x_ij. Initial state, demand, states from flows in each
substep and stage, and the sum of the TTS are those of `advance`. Relaxed are

    r_ij = k_ij q_i(n_i) x_ij   to  k_ij min q_i x_ij <= r_ij <= k_ij max q_i x_ij and sum_j r_ij / k_ij <= s n_i + c
                                    for lines s n + c >= g_i(n), between 0 and all vehicles there
                                    ever are
    y_ihj = u_ih theta_ihj r_ij to  u_min theta_ihj r_ij <= y_ihj <= u_max theta_ihj r_ij, nominal theta (PC), or
                                    u_min r_ij <= sum_h y_ihj <= u_max r_ij over the allowed turns
                                    (PCRG)
    boundaries with capacity    to  y_ihj <= theta_ihj r_ij or sum_h y_ihj <= r_ij, sum_j y_ihj <= u_max capacity_ih

The controls may differ between substeps, stages and destinations, and the classes of a region need
not share its outflow in proportion. Each trajectory of the plant meets all of this, so that the
minimum is a lower bound for every controller with these controls and without metering. It holds
without process noise, and, with RK4, for trajectories with x >= 0 at all stages (Euler keeps x >=
0, see `check_step`). Controllers on the acyclic plant are covered with routes (PCRG), and without
if the nominal splits follow shortest paths.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse

from nmfd import closed_loop
from nmfd.controllers.dpc.policy import PerimeterLayer, SplitsLayer
from nmfd.controllers.open_loop import NAMES, Plan
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model import dynamics
from nmfd.model.mfd import Mfd
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import LEAST_LIMIT, RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.tensors import one_thread

ITERATIONS = 1500
LEARNING_RATE = 0.15  # of Adam, on logits; decays along a cosine
LINES = 16  # above the MFD of a region, in the relaxation: from its slope at 0 to the critical accumulation
Note = Callable[[int, int, str], None]  # takes done, all, note
INSIDE = 0.02  # distance of starts from the edge of the admissible set, where the gradient is zero


def compute(
    scenario: Scenario, name: str, *, iterations: int = ITERATIONS, progress: Note | None = None
) -> Plan:
    """Return the best plan found `name` ("bound-pc" or "bound-pcrg") with the lower bound.

    It starts from neutral plans, PI gating and trained policies.
    """
    if name not in NAMES:
        raise InputError(f"--controller: {name!r} is no bound; choose one of {', '.join(NAMES)}")
    guidance, steps = NAMES[name], scenario.steps
    if progress:
        progress(0, steps, "lower bound")
    lower = lower_bound(scenario, guidance=guidance)
    begin = neutral_starts(scenario.network, steps, guidance=guidance)
    policies = ["dpc-pc", "dpc-pcrg"] if guidance else ["dpc-pc"]
    trained = [
        policy
        for policy in policies
        if scenario.folder and (scenario.folder / f"{policy}.pt").is_file()
    ]
    for start in [*(["pi-gating"] if scenario.protected else []), *trained]:
        if progress:
            progress(0, steps, f"closed loop {start}")
        result = closed_loop.run(NmfdPlant(scenario), parse(start).make(scenario), scenario, seed=0)
        begin[start] = result["perimeter"], result["splits"]
    plan = solve(scenario, begin, guidance=guidance, iterations=iterations, progress=progress)
    return replace(plan, lower=lower)


def neutral_starts(network: RegionalModel, steps: int, *, guidance: bool) -> dict[str, tuple]:
    """Return perimeter (T, R, R) and splits (T, R, R, R) of open boundaries, and of mean
    controls."""
    mask, nominal = network.split_mask, network.nominal_splits
    even = mask / np.maximum(mask.sum(axis=1, keepdims=True), 1) if guidance else nominal

    def constant(u: float, splits: np.ndarray) -> tuple:
        perimeter = np.where(network.adjacency, u, 0.0)
        return np.broadcast_to(perimeter, (steps, *perimeter.shape)), np.broadcast_to(
            splits, (steps, *splits.shape)
        )

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
    """Return the best plan by separate descents from `starts`: name -> perimeter (T, R, R) and
    splits (T, R, R, R).

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
                group["lr"] = (
                    LEARNING_RATE * 0.5 * (1.0 + math.cos(math.pi * iteration / (iterations + 1)))
                )
            perimeter, splits = controls()
            totals = _total_time_spent(scenario, parameters, perimeter, splits)
            for n in np.flatnonzero(totals.detach().numpy() < best):
                best[n] = totals[n].item()
                kept[n] = tuple(logits[:, n].detach().clone() for logits in controls.logits)
            if progress:
                progress(iteration, iterations, f"best {best.min():.4g} veh s")
            if iteration < iterations:
                optimizer.zero_grad()
                torch.log(totals.clamp(min=1.0)).sum().backward()  # each at its own scale
                optimizer.step()
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
    """Admissible controls of T intervals and B plans from logits."""

    def __init__(
        self, network: RegionalModel, steps: int, starts: Iterable[tuple], *, guidance: bool
    ):
        self._box, self._simplex = PerimeterLayer(network).double(), SplitsLayer(network).double()
        self._nominal = torch.tensor(network.nominal_splits).expand(
            steps, 1, *network.split_mask.shape
        )
        perimeters, splits = zip(*starts, strict=True)
        share = (torch.tensor(np.stack(perimeters, axis=1)) - network.u_min) / (
            network.u_max - network.u_min
        )
        self.logits = [torch.logit(share.clamp(INSIDE, 1.0 - INSIDE))]
        if guidance:
            even = self._simplex(torch.zeros_like(self._nominal[0]))
            theta = (1.0 - INSIDE) * torch.tensor(np.stack(splits, axis=1)) + INSIDE * even
            self.logits.append(torch.log(theta.clamp(min=1e-6)))
        for logits in self.logits:
            logits.requires_grad_()

    def __call__(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return perimeter (T, B, R, R) and splits (T, B, R, R, R), or (T, 1, R, R, R) without
        guidance."""
        perimeter = self._box(self.logits[0])
        return perimeter, self._nominal if len(self.logits) == 1 else self._simplex(self.logits[1])


def _total_time_spent(
    scenario: Scenario,
    parameters: dynamics.Parameters,
    perimeter: torch.Tensor,
    splits: torch.Tensor,
) -> Float[torch.Tensor, " B"]:
    """Return the total time spent [veh s] of plans: perimeter (T, B, R, R), splits (T, B or 1, R,
    R, R)."""
    x, demand = (
        torch.from_numpy(scenario.start).expand(perimeter.shape[1], -1, -1),
        torch.from_numpy(scenario.demand),
    )
    states = [x]
    for k in range(scenario.steps - 1):
        x = dynamics.advance(parameters, x, demand[k], perimeter[k], splits[k], **scenario.scheme)
        states.append(x)
    return scenario.step * torch.stack(states).sum((0, -2, -1))


@dataclass(frozen=True, kw_only=True)
class Relaxation:
    """Linear programme: minimise cost z with upper z <= most, equal z = given and 0 <= z <= 1.

    z: x, step r (points, pairs) and step y (points, turns), one after the other, all over
        `vehicles`
    point: an evaluation of the derivative; step: of the integration [s]; vehicles: all that there
        ever are
    pairs: (P, 2), i and j; turns: (E, 3), i, h and j; those that vehicles may use
    """

    cost: np.ndarray
    upper: sparse.csr_array
    most: np.ndarray
    equal: sparse.csr_array
    given: np.ndarray
    pairs: np.ndarray
    turns: np.ndarray
    step: float
    vehicles: float


def lower_bound(scenario: Scenario, *, guidance: bool) -> float:
    """Return a lower bound of the total time spent [veh s] under any controls, by the relaxation of
    this module.

    It is the value of the dual solution, which is a bound even if the solver stops short of the
    optimum.

    Raises: InputError if the plant has process noise, or the solver fails
    """
    from scipy.optimize import linprog  # slow to import

    if scenario.process_std:
        problem = f"expected 0 for a lower bound, got {scenario.process_std:g}"
        raise InputError(f"{scenario.where}: process_std: {problem}; add --set process_std=0")
    if not (scenario.demand.any() or scenario.start.any()):
        return 0.0
    lp = relaxation(scenario, guidance=guidance)
    limits = {"A_ub": lp.upper, "b_ub": lp.most, "A_eq": lp.equal, "b_eq": lp.given}
    answer = linprog(lp.cost, **limits, bounds=(0.0, 1.0), method="highs-ipm")
    if answer.status:
        raise InputError(
            f"{scenario.where}: no lower bound, the solver reports: {answer.message}; change the scenario"
        )
    limit, balance = np.minimum(answer.ineqlin.marginals, 0.0), answer.eqlin.marginals
    reduced = lp.cost - limit @ lp.upper - balance @ lp.equal
    dual = limit @ lp.most + balance @ lp.given + np.minimum(reduced, 0.0).sum()
    return float(scenario.step * lp.vehicles * dual)


def relaxation(scenario: Scenario, *, guidance: bool) -> Relaxation:
    """Return the linear programme of `lower_bound`."""
    network, eye = scenario.network, sparse.eye_array
    allowed = network.split_mask if guidance else network.nominal_splits > 0
    present = (scenario.demand > 0).any(axis=0) | (scenario.start > 0)
    for _ in range(network.regions):
        present = present | (present[:, None] & allowed).any(axis=0)
    pairs, turns = np.argwhere(present), np.argwhere(present[:, None] & allowed)
    step = scenario.step / scenario.substeps
    vehicles = max(1.0, float(scenario.start.sum() + scenario.step * scenario.demand.sum()))

    # Row n of `slopes`: weights of the derivatives that lead from the begin of the substep to point
    # n + 1.
    weights, places = dynamics.SCHEMES[scenario.integrator]
    substeps, stages = (scenario.steps - 1) * scenario.substeps, len(weights)
    moves, points = substeps * stages, substeps * stages + 1
    along, begin = np.diag([*places[1:], 0.0]), np.zeros((stages, stages))
    along[-1], begin[:, 0] = weights, 1.0
    slopes = sparse.kron(eye(substeps), along) @ eye(moves, points)
    change = eye(moves, points, k=1) - sparse.kron(eye(substeps), begin) @ eye(moves, points)
    origin, after = (turns[:, [n, 2]] for n in (0, 1))
    leaving, entering = (
        (pairs[:, None] == ends).all(axis=2).astype(float) for ends in (origin, after)
    )
    ending = np.diag((pairs[:, 0] == pairs[:, 1]).astype(float))
    motion = [sparse.kron(change, eye(len(pairs)))]
    motion += [sparse.kron(slopes, flow) for flow in (ending, leaving - entering)]
    first = eye(len(pairs), points * (2 * len(pairs) + len(turns)))
    interval = np.arange(points) // (stages * scenario.substeps)
    given = [
        scenario.start[*pairs.T],
        step * (slopes @ scenario.demand[interval][:, *pairs.T]).ravel(),
    ]

    rows = _limits(network, pairs, turns, leaving, step, vehicles, guidance=guidance)
    upper = [
        sparse.kron(eye(points), np.concatenate(blocks))
        for blocks in list(zip(*rows, strict=True))[:3]
    ]
    cost = np.zeros(first.shape[1])
    cost[: points * len(pairs)] = (np.arange(points) % (stages * scenario.substeps) == 0).repeat(
        len(pairs)
    )
    return Relaxation(
        cost=cost,
        upper=sparse.hstack(upper).tocsr(),
        most=np.tile(np.concatenate([most for *_, most in rows]), points) / vehicles,
        equal=sparse.vstack([first, sparse.hstack(motion)]).tocsr(),
        given=np.concatenate(given) / vehicles,
        pairs=pairs,
        turns=turns,
        step=step,
        vehicles=vehicles,
    )


def _limits(
    network: RegionalModel,
    pairs: np.ndarray,
    turns: np.ndarray,
    leaving: np.ndarray,
    step: float,
    vehicles: float,
    *,
    guidance: bool,
) -> list[tuple[np.ndarray, ...]]:
    """Return blocks of a x + b step r + c step y <= d at every point: a, b (n, P), c (n, E) and d
    (n,) [veh]."""
    each, at, off = np.eye(len(pairs)), pairs[:, 0], pairs[:, 0] != pairs[:, 1]
    exit_rates = np.ones(len(pairs)) if network.exit_rates is None else network.exit_rates[*pairs.T]
    blocks = []
    for region in np.unique(at):
        slope, intercept, low, high = _lines(network.mfds[region], vehicles)
        own, one = each[at == region], np.ones((len(slope), 1))
        none = np.zeros((len(slope), len(turns))), np.zeros((len(own), len(turns)))
        blocks.append(
            (
                -step * slope[:, None] * (at == region),
                one * (at == region) / exit_rates,
                none[0],
                step * intercept,
            )
        )
        for sign, rate in ((1.0, high), (-1.0, low)):
            blocks.append(
                (-sign * step * rate * own * exit_rates, sign * own, none[1], np.zeros(len(own)))
            )
    least, most = (network.u_min, network.u_max) if network.capacity is None else (0.0, 1.0)
    if guidance:
        desired, through = each[off], leaving[off]
    else:
        desired, through = network.nominal_splits[*turns.T][:, None] * leaving.T, np.eye(len(turns))
    for sign, share in ((1.0, most), (-1.0, least)):
        blocks.append(
            (0.0 * desired, -sign * share * desired, sign * through, np.zeros(len(desired)))
        )
    if network.capacity is not None:
        borders = np.unique(turns[:, :2], axis=0)
        empty = np.zeros((len(borders), len(pairs)))
        crossing = (turns[:, :2] == borders[:, None]).all(axis=2).astype(float)
        blocks.append((empty, empty, crossing, step * (network.capacity[*borders.T] + LEAST_LIMIT)))
    return blocks


def _lines(mfd: Mfd, vehicles: float) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return slopes and intercepts of lines above g, and bounds of g(n) / n, for n from 0 to
    `vehicles`.

    They hold between the points of a grid, too, if the rate rises or falls from each to the next.
    """
    body = np.linspace(0.0, min(vehicles, mfd.jam), 20001)
    rate, end = mfd.rate(body), max(vehicles, mfd.jam)
    highest = np.maximum(rate[:-1], rate[1:])
    grid = np.concatenate([body[:-1], body[1:], [end]])
    flow = np.concatenate([highest * body[:-1], highest * body[1:], [mfd.outflow(end)]])
    at_end = (flow[-1] - flow[:-1]) / np.maximum(
        end - grid[:-1], 1e-9
    )  # slopes of the envelope, at its end
    last = min(0.0, float(at_end.min()))
    slopes = np.append(
        np.linspace(last, 0.0, LINES // 4), rate.max() * np.linspace(0.0, 1.0, LINES)[1:] ** 2
    )
    intercepts = np.array([(flow - slope * grid).max() for slope in slopes])
    return slopes, intercepts, float(min(rate.min(), mfd.rate(end))), float(rate.max())
