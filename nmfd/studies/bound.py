"""Optimal control with known demand: best plan found and lower bound.

Both are those of the regional model.

Best plan found: gradient descent (Adam) on all controls of all intervals at once, through
`dynamics`, from several starts. The problem is not convex, so the optimum may take less total time
spent (TTS).

Lower bound: the optimum of a linear relaxation, which no control falls below. It has variables at
every evaluation of the derivative by `dynamics.advance` (one per substep with Euler, four with
RK4): x_ij [veh], the outflows before the gates r_ij = k_ij q_i x_ij, and the transfer flows y_ihj
[veh/s]. Here k_ij are exit rates and n_i = sum_j x_ij. Initial state, demand, states from flows in
each substep and stage, and the sum of the TTS are those of `advance`. Relaxed are:

    r_ij = k_ij q_i(n_i) x_ij    to    k_ij min q_i x_ij <= r_ij <= k_ij max q_i x_ij
                                       sum_j r_ij / k_ij <= s n_i + c   for lines s n + c >= g_i(n),
                                       between 0 and all vehicles there ever are
    y_ihj = u_ih theta_ihj r_ij  to    without guidance, nominal theta:
                                       u_min theta_ihj r_ij <= y_ihj <= u_max theta_ihj r_ij
                                       with guidance, over the allowed turns:
                                       u_min r_ij <= sum_h y_ihj <= u_max r_ij
    boundaries with capacity     to    y_ihj <= theta_ihj r_ij or sum_h y_ihj <= r_ij
                                       sum_j y_ihj <= u_max capacity_ih

The controls may differ between substeps, stages and destinations, and the classes of a region need
not share its outflow in proportion. Each trajectory of the plant meets all of this, so that the
minimum is a lower bound for every controller with these controls and without metering. It holds
without process noise, and, with RK4, for trajectories with x >= 0 at all stages (Euler keeps
x >= 0, see `check_step`). Controllers on the acyclic plant are covered with guidance, and without
it if the nominal splits follow shortest paths.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse

from nmfd import closed_loop
from nmfd.arrays import PairsOverTime, TurnsOverTime
from nmfd.controllers.dpc.policy import PerimeterLayer, SplitsLayer
from nmfd.controllers.open_loop import NAMES, Plan
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model import dynamics
from nmfd.model.integration import SCHEMES
from nmfd.model.mfd import Mfd
from nmfd.model.plant import NmfdPlant
from nmfd.model.regional_model import LEAST_LIMIT, RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs.progress import Show
from nmfd.tensors import one_thread

ITERATIONS = 1500
LEARNING_RATE = 0.15  # of Adam, on logits; decays along a cosine
INSIDE = 0.02  # distance of starts from the edge of the admissible set, where the gradient is zero
# Lines above the MFD of a region, in the relaxation: from its slope at 0 to the critical
# accumulation.
LINES = 16


class Start(NamedTuple):
    """Controls of all intervals from which a descent starts."""

    perimeter: PairsOverTime
    splits: TurnsOverTime


def compute(
    scenario: Scenario, name: str, *, iterations: int = ITERATIONS, progress: Show = None
) -> Plan:
    """Return the best plan found, with the lower bound.

    The descents start from neutral plans, PI gating and trained policies.

    name: "bound-pc" or "bound-pcrg"
    iterations: of the descents

    Raises: InputError
    """
    if name not in NAMES:
        raise InputError(f"--controller: {name!r} is no bound; choose one of {', '.join(NAMES)}")
    guidance = NAMES[name]
    steps = scenario.steps
    if progress:
        progress(0, steps, "lower bound")
    lower = lower_bound(scenario, guidance=guidance)
    starts = neutral_starts(scenario.network, steps, guidance=guidance)
    controllers = ["pi-gating"] if scenario.protected else []
    for trained in ["dpc-pc", "dpc-pcrg"] if guidance else ["dpc-pc"]:
        if scenario.folder and (scenario.folder / f"{trained}.pt").is_file():
            controllers.append(trained)
    for controller in controllers:
        if progress:
            progress(0, steps, f"closed loop {controller}")
        policy = parse(controller).make(scenario)
        result = closed_loop.run(NmfdPlant(scenario), policy, scenario, seed=0)
        starts[controller] = Start(result["perimeter"], result["splits"])
    plan = solve(scenario, starts, guidance=guidance, iterations=iterations, progress=progress)
    return replace(plan, lower=lower)


def neutral_starts(network: RegionalModel, steps: int, *, guidance: bool) -> dict[str, Start]:
    """Return two constant plans: open boundaries, and mean controls."""
    mask = network.split_mask
    even = network.nominal_splits
    if guidance:
        even = mask / np.maximum(mask.sum(axis=1, keepdims=True), 1)
    middle = 0.5 * (network.u_min + network.u_max)

    def constant(u: float, splits: np.ndarray) -> Start:
        perimeter = np.where(network.adjacency, u, 0.0)
        return Start(
            perimeter=np.broadcast_to(perimeter, (steps, *perimeter.shape)),
            splits=np.broadcast_to(splits, (steps, *splits.shape)),
        )

    return {
        "open": constant(network.u_max, network.nominal_splits),
        "middle": constant(middle, even),
    }


@one_thread()
def solve(
    scenario: Scenario,
    starts: Mapping[str, Start],
    *,
    guidance: bool,
    iterations: int = ITERATIONS,
    progress: Show = None,
) -> Plan:
    """Return the best plan by separate descents.

    A KeyboardInterrupt ends them early and returns the best plan so far.

    starts: by name
    """
    parameters = dynamics.parameters(scenario.network)
    controls = _Controls(scenario.network, scenario.steps, starts.values(), guidance=guidance)
    optimizer = torch.optim.Adam(controls.logits, lr=LEARNING_RATE)
    best = np.full(len(starts), math.inf)
    try:
        for iteration in range(iterations + 1):  # the last only evaluates
            cosine = 1.0 + math.cos(math.pi * iteration / (iterations + 1))
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * 0.5 * cosine
            perimeter, splits = controls()
            totals = _total_time_spent(scenario, parameters, perimeter, splits)
            values = totals.detach().numpy()
            better = values < best
            best[better] = values[better]
            controls.keep(better)
            if progress:
                progress(iteration, iterations, f"best {best.min():.4g} veh s")
            if iteration < iterations:
                optimizer.zero_grad()
                torch.log(totals.clamp(min=1.0)).sum().backward()  # each at its own scale
                optimizer.step()
    except KeyboardInterrupt:
        if not np.isfinite(best).all():
            raise
    names = list(starts)
    winner = int(best.argmin())
    found = controls.kept(winner)
    return Plan(
        perimeter=found.perimeter,
        splits=found.splits if guidance else None,
        start=names[winner],
        totals=dict(zip(names, best.tolist(), strict=True)),
    )


class _Controls:
    """Admissible controls of T intervals and B plans from logits.

    logits: of the perimeter, and with guidance of the splits
    """

    def __init__(
        self, network: RegionalModel, steps: int, starts: Iterable[Start], *, guidance: bool
    ):
        self._box = PerimeterLayer(network).double()
        self._simplex = SplitsLayer(network).double()
        nominal = torch.tensor(network.nominal_splits)
        self._nominal = nominal.expand(steps, 1, *nominal.shape)
        perimeters, splits = zip(*starts, strict=True)
        u = torch.tensor(np.stack(perimeters, axis=1))
        share = (u - network.u_min) / (network.u_max - network.u_min)
        self.logits = [torch.logit(share.clamp(INSIDE, 1.0 - INSIDE))]
        if guidance:
            even = self._simplex(torch.zeros_like(self._nominal[0]))
            theta = (1.0 - INSIDE) * torch.tensor(np.stack(splits, axis=1)) + INSIDE * even
            self.logits.append(torch.log(theta.clamp(min=1e-6)))
        self._kept = [logits.clone() for logits in self.logits]
        for logits in self.logits:
            logits.requires_grad_()

    def __call__(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return perimeter (T, B, R, R) and splits (T, B, R, R, R).

        Without guidance the splits are (T, 1, R, R, R).
        """
        perimeter = self._box(self.logits[0])
        if len(self.logits) == 1:
            return perimeter, self._nominal
        return perimeter, self._simplex(self.logits[1])

    def keep(self, plans: np.ndarray) -> None:
        """Remember the present logits of some plans (B,) bool."""
        for logits, kept in zip(self.logits, self._kept, strict=True):
            kept[:, plans] = logits.detach()[:, plans]

    def kept(self, plan: int) -> Start:
        """Return the controls that were remembered last for a plan."""
        with torch.no_grad():
            for logits, kept in zip(self.logits, self._kept, strict=True):
                logits[:, 0] = kept[:, plan]
            perimeter, splits = self()
        return Start(perimeter[:, 0].numpy(), splits[:, 0].numpy())


def _total_time_spent(
    scenario: Scenario,
    parameters: dynamics.Parameters,
    perimeter: torch.Tensor,
    splits: torch.Tensor,
) -> Float[torch.Tensor, " B"]:
    """Return the total time spent [veh s] of plans.

    perimeter: (-, (T, B, R, R))
    splits: (-, (T, B or 1, R, R, R))
    """
    demand = torch.from_numpy(scenario.demand)
    x = torch.from_numpy(scenario.start).expand(perimeter.shape[1], -1, -1)
    states = [x]
    for k in range(scenario.steps - 1):
        x = dynamics.advance(parameters, x, demand[k], perimeter[k], splits[k], **scenario.scheme)
        states.append(x)
    return scenario.step * torch.stack(states).sum((0, -2, -1))


@dataclass(frozen=True, kw_only=True)
class Relaxation:
    """Linear programme: minimise cost z.

    Constraints: upper z <= most, equal z = given, 0 <= z <= 1. The parts of z are x (points,
    pairs), step r (points, pairs) and step y (points, turns), all over `vehicles`. A point is an
    evaluation of the derivative.

    pairs: i and j, those that vehicles may use ((P, 2))
    turns: i, h and j, those that vehicles may use ((E, 3))
    step: of the integration (s)
    vehicles: all that there ever are (veh)
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
    """Return a lower bound of the total time spent [veh s] under any controls.

    It is the value of the dual solution of `relaxation`, a bound even if the solver stops short of
    the optimum.

    Raises: InputError if the plant has process noise, or the solver fails
    """
    from scipy.optimize import linprog  # slow to import

    if scenario.process_std:
        problem = f"expected 0 for a lower bound, got {scenario.process_std:g}"
        raise InputError(f"{scenario.where}: process_std: {problem}; add --set process_std=0")
    if scenario.network.equal_ways:
        problem = "equal_ways: there is no lower bound for times that depend on the next region"
        raise InputError(f"{scenario.network.name}: {problem}; remove the key from network.toml")
    if not (scenario.demand.any() or scenario.start.any()):
        return 0.0
    lp = relaxation(scenario, guidance=guidance)
    answer = linprog(
        lp.cost,
        A_ub=lp.upper,
        b_ub=lp.most,
        A_eq=lp.equal,
        b_eq=lp.given,
        bounds=(0.0, 1.0),
        method="highs-ipm",
    )
    if answer.status:
        raise InputError(
            f"{scenario.where}: no lower bound, the solver reports: {answer.message}; "
            "change the scenario"
        )
    limit = np.minimum(answer.ineqlin.marginals, 0.0)
    balance = answer.eqlin.marginals
    reduced = lp.cost - limit @ lp.upper - balance @ lp.equal
    dual = limit @ lp.most + balance @ lp.given + np.minimum(reduced, 0.0).sum()
    return float(scenario.step * lp.vehicles * dual)


def relaxation(scenario: Scenario, *, guidance: bool) -> Relaxation:
    """Return the linear programme of `lower_bound`."""
    network = scenario.network
    allowed = network.split_mask if guidance else network.nominal_splits > 0
    # Pairs (i, j) where vehicles start or depart, and those that they reach over allowed turns.
    present = (scenario.demand > 0).any(axis=0) | (scenario.start > 0)
    for _ in range(network.regions):
        present = present | (present[:, None] & allowed).any(axis=0)
    pairs = np.argwhere(present)
    turns = np.argwhere(present[:, None] & allowed)
    step = scenario.step / scenario.substeps
    vehicles = max(1.0, float(scenario.start.sum() + scenario.step * scenario.demand.sum()))
    slopes, change = _integration(scenario)
    points = slopes.shape[1]
    per_interval = len(SCHEMES[scenario.integrator][0]) * scenario.substeps
    interval = np.arange(points) // per_interval  # of each point

    # The change of x follows from the trips that end, the transfer flows and the demand.
    ending = np.diag((pairs[:, 0] == pairs[:, 1]).astype(float))
    leaving = _incidence(pairs, turns[:, [0, 2]])
    entering = _incidence(pairs, turns[:, [1, 2]])
    motion = sparse.hstack(
        [
            sparse.kron(change, sparse.eye_array(len(pairs))),
            sparse.kron(slopes, ending),
            sparse.kron(slopes, leaving - entering),
        ]
    )
    size = points * (2 * len(pairs) + len(turns))
    first = sparse.eye_array(len(pairs), size)
    demand = scenario.demand[interval][:, *pairs.T]
    given = [scenario.start[*pairs.T], step * (slopes @ demand).ravel()]

    blocks = _limits(network, pairs, turns, leaving, step, vehicles, guidance=guidance)
    upper = []
    for part in ("x", "r", "y"):
        rows = np.concatenate([getattr(block, part) for block in blocks])
        upper.append(sparse.kron(sparse.eye_array(points), rows))
    most = np.concatenate([block.most for block in blocks])

    cost = np.zeros(size)
    begins = np.arange(points) % per_interval == 0
    cost[: points * len(pairs)] = begins.repeat(len(pairs))
    return Relaxation(
        cost=cost,
        upper=sparse.hstack(upper).tocsr(),
        most=np.tile(most, points) / vehicles,
        equal=sparse.vstack([first, motion]).tocsr(),
        given=np.concatenate(given) / vehicles,
        pairs=pairs,
        turns=turns,
        step=step,
        vehicles=vehicles,
    )


def _incidence(pairs: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return (P, E), 1 where a pair (P, 2) is the end (E, 2) of a turn."""
    return (pairs[:, None] == ends).all(axis=2).astype(float)


def _integration(scenario: Scenario) -> tuple[sparse.sparray, sparse.sparray]:
    """Return two matrices (points - 1, points) of `dynamics.advance`.

    Row n of the first has the weights of the derivatives that lead from the begin of the substep to
    point n + 1; row n of the second is the difference of the states there.
    """
    weights, places = SCHEMES[scenario.integrator]
    stages = len(weights)
    along = np.diag([*places[1:], 0.0])
    along[-1] = weights
    begin = np.zeros((stages, stages))
    begin[:, 0] = 1.0
    substeps = (scenario.steps - 1) * scenario.substeps
    moves = substeps * stages
    each = sparse.eye_array(substeps)
    points = sparse.eye_array(moves, moves + 1)
    next_points = sparse.eye_array(moves, moves + 1, k=1)
    slopes = sparse.kron(each, along) @ points
    change = next_points - sparse.kron(each, begin) @ points
    return slopes, change


class _Block(NamedTuple):
    """Inequalities x X + r (step R) + y (step Y) <= most [veh].

    They hold at every point, of which X, R and Y are the variables; x, r, y have a row for each
    inequality.
    """

    x: np.ndarray
    r: np.ndarray
    y: np.ndarray
    most: np.ndarray


def _limits(
    network: RegionalModel,
    pairs: np.ndarray,
    turns: np.ndarray,
    leaving: np.ndarray,
    step: float,
    vehicles: float,
    *,
    guidance: bool,
) -> list[_Block]:
    """Return the inequalities of the relaxation.

    leaving: (P, E), 1 where a turn leaves a pair
    step, vehicles: those of the Relaxation
    """
    exit_rates = network.relative_rates[*pairs.T]
    blocks = []
    for region in np.unique(pairs[:, 0]):
        there = pairs[:, 0] == region
        above = _lines(network.mfds[region], vehicles)
        own = np.eye(len(pairs))[there]
        no_turn = np.zeros((len(own), len(turns)))
        # The outflow of the region is below the lines ...
        blocks.append(
            _Block(
                x=-step * above.slopes[:, None] * there,
                r=np.ones((len(above.slopes), 1)) * there / exit_rates,
                y=np.zeros((len(above.slopes), len(turns))),
                most=step * above.intercepts,
            )
        )
        # ... and that of each pair between the largest and the smallest rate.
        for sign, rate in ((1.0, above.high), (-1.0, above.low)):
            x = -sign * step * rate * own * exit_rates
            blocks.append(_Block(x=x, r=sign * own, y=no_turn, most=np.zeros(len(own))))
    # What passes the boundaries is between two shares of the desired flow.
    if guidance:
        going = pairs[:, 0] != pairs[:, 1]
        desired = np.eye(len(pairs))[going]
        through = leaving[going]
    else:
        desired = network.nominal_splits[*turns.T][:, None] * leaving.T
        through = np.eye(len(turns))
    least = network.u_min
    most = network.u_max
    if network.capacity is not None:
        least = 0.0
        most = 1.0
    none = np.zeros(len(desired))
    for sign, share in ((1.0, most), (-1.0, least)):
        r = -sign * share * desired
        blocks.append(_Block(x=0.0 * desired, r=r, y=sign * through, most=none))
    if network.capacity is not None:
        boundaries = np.unique(turns[:, :2], axis=0)
        nothing = np.zeros((len(boundaries), len(pairs)))
        crossing = (turns[:, :2] == boundaries[:, None]).all(axis=2).astype(float)
        limit = step * (network.capacity[*boundaries.T] + LEAST_LIMIT)
        blocks.append(_Block(x=nothing, r=nothing, y=crossing, most=limit))
    return blocks


class _Lines(NamedTuple):
    """Lines above an MFD g(n), and bounds of g(n) / n [1/s].

    slopes: (1/s, (L,))
    intercepts: (veh/s, (L,))
    """

    slopes: np.ndarray
    intercepts: np.ndarray
    low: float
    high: float


def _lines(mfd: Mfd, vehicles: float) -> _Lines:
    """Return lines and bounds that hold for n from 0 to `vehicles`.

    They hold between the points of a grid, too, if the rate rises or falls from each to the next.
    """
    body = np.linspace(0.0, min(vehicles, mfd.jam), 20001)
    end = max(vehicles, mfd.jam)
    rate = mfd.rate(body)
    highest = np.maximum(rate[:-1], rate[1:])
    grid = np.concatenate([body[:-1], body[1:], [end]])
    flow = np.concatenate([highest * body[:-1], highest * body[1:], [mfd.outflow(end)]])
    # Slopes of the envelope, at its end.
    at_end = (flow[-1] - flow[:-1]) / np.maximum(end - grid[:-1], 1e-9)
    last = min(0.0, float(at_end.min()))
    falling = np.linspace(last, 0.0, LINES // 4)
    rising = rate.max() * np.linspace(0.0, 1.0, LINES)[1:] ** 2
    slopes = np.append(falling, rising)
    return _Lines(
        slopes=slopes,
        intercepts=np.array([(flow - slope * grid).max() for slope in slopes]),
        low=float(min(rate.min(), mfd.rate(end))),
        high=float(rate.max()),
    )
