"""Regional model as a list of edges, with exact gradients for solvers.

A turn (i, h, j) is the movement of the vehicles in i bound for j over the boundary to h. Only turns
and destinations in use are listed, so that a planar city costs R^2 and not R^3. The equations are
those of `nmfd.model.dynamics`. The gradient of the total time spent follows by the adjoint method,
at about the cost of two more rollouts.

In the names below, `of_x` is the gradient of the total by x.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from nmfd.arrays import PerRegion
from nmfd.controllers.mpc.projected_gradient import Late
from nmfd.model.integration import SCHEMES
from nmfd.model.mfd import Mfd, stacked
from nmfd.model.regional_model import LEAST_LIMIT, LEAST_ROOM, SHARPNESS, RegionalModel

PerCell = Float[np.ndarray, " C"]
PerEdge = Float[np.ndarray, " E"]
PerTurn = Float[np.ndarray, " V"]
TurnNumbers = Int[np.ndarray, " V"]
Demands = Float[np.ndarray, "H C"]
Plan = Float[np.ndarray, "K D"]  # D = E + V decisions in each interval
Decision = Float[np.ndarray, " D"]


@dataclass(frozen=True, kw_only=True)
class Turns:
    """Network with J destinations in use: C = R J cells, E edges and V turns.

    Cells hold x_ij; that of the n-th destination in region i has number i J + n. Edges have u_ih,
    turns theta_ihj.

    destinations: regions, (J,)
    edges: (i, h) of every edge, (E, 2)
    turns: (i, h, j) of every turn, (V, 3)
    edge: edge of every turn, (V,)
    source, target: cells x_ij and x_hj of every turn, (V,)
    own: nominal theta_ihj (-, (V,))
    region: of every cell, (C,)
    ends: cells in which trips end (i = j), (C,)
    mfd: of all regions
    exit_rates: (-, (C,))
    detours: of every turn (-, (V,)) or None
    capacity: under u = 1 (veh/s, (E,)) or None
    storage: (veh, (R,)) or None
    step: control interval (s)
    substeps, integrator: integration steps in it, and their scheme (integration.SCHEMES)
    rounding: width of the rounded kink of the MFDs at the jam accumulation (veh); 0 for the exact
        model
    """

    destinations: Int[np.ndarray, " J"]
    edges: Int[np.ndarray, "E 2"]
    turns: Int[np.ndarray, "V 3"]
    edge: TurnNumbers
    source: TurnNumbers
    target: TurnNumbers
    own: PerTurn
    region: Int[np.ndarray, " C"]
    ends: Bool[np.ndarray, " C"]
    mfd: Mfd
    exit_rates: PerCell
    detours: PerTurn | None
    capacity: PerEdge | None
    storage: PerRegion | None
    step: float
    substeps: int = 1
    integrator: str = "euler"
    rounding: float = 0.0


class Boundary(NamedTuple):
    """Share of the desired flow that passes each edge, and derivatives.

    by_wish, by_perimeter, by_ahead: by desired flow, u, and accumulation ahead
    """

    share: PerEdge
    by_wish: PerEdge
    by_perimeter: PerEdge
    by_ahead: PerEdge


class Record(NamedTuple):
    """Intermediate results of `derivative`, for its gradient.

    x, leaving: vehicles in the cells and their outflow (C,)
    rate, slope: outflow per vehicle (C,), and the derivative of q_i (R,)
    duration: mean time of a cell's vehicles in a region by their next ones (C,); None without
        detours
    wish: desired flow of every turn (V,)
    share: of it that passes each edge (E,)
    boundary: None without capacities
    """

    x: PerCell
    leaving: PerCell
    rate: PerCell
    slope: PerRegion
    duration: PerCell | None
    wish: PerTurn
    share: PerEdge
    boundary: Boundary | None


def build(
    network: RegionalModel, destinations: Int[np.ndarray, " J"], *, guidance: bool, **scheme: Any
) -> Turns:
    """Return the turns of vehicles bound for `destinations` (J,).

    guidance: all allowed turns instead of the nominal ones
    scheme: step, substeps and integrator of `Turns`
    """
    regions = network.regions
    count = len(destinations)
    allowed = network.split_mask if guidance else network.nominal_splits > 0
    turns = np.argwhere(allowed & np.isin(np.arange(regions), destinations))
    here, onward, bound = turns.T
    codes, edge = np.unique(here * regions + onward, return_inverse=True)
    edges = np.stack([codes // regions, codes % regions], axis=1)
    number = np.zeros(regions, dtype=int)  # of a destination
    number[destinations] = np.arange(count)
    cells = np.arange(regions * count)
    detours = network.detours
    if detours is not None:
        detours = detours[here, onward, bound]
    capacity = network.open_capacity
    if capacity is not None:
        capacity = capacity[tuple(edges.T)]
    return Turns(
        exit_rates=network.relative_rates[:, destinations].ravel(),
        detours=detours,
        storage=network.storage,
        capacity=capacity,
        destinations=destinations,
        edges=edges,
        turns=turns,
        edge=edge,
        source=here * count + number[bound],
        target=onward * count + number[bound],
        own=network.nominal_splits[here, onward, bound],
        region=cells // count,
        ends=cells // count == np.asarray(destinations)[cells % count],
        mfd=stacked(network.mfds, np.array),
        **scheme,
    )


def rate(model: Turns, accumulation: PerRegion) -> tuple[PerRegion, PerRegion]:
    """Return q_i (1/s, (R,)) and dq_i/dx_i (1/(veh s), (R,)).

    With rounding r, min(x, jam) is (x + jam - sqrt((x - jam)^2 + r^2)) / 2: off by r/2 at the jam
    accumulation, and by less than r^2 / (4 |x - jam|) elsewhere.

    accumulation: x_i (veh, (R,))
    """
    jam = model.mfd.jam
    above = accumulation - jam
    spread = np.sqrt(above**2 + model.rounding**2)
    share = 0.5 - 0.5 * above / np.maximum(spread, 1e-12)  # d min(x, jam) / dx
    body = 0.5 * (accumulation + jam - spread)
    top = accumulation - body + jam
    q = model.mfd.rate_up_to_jam(body) * jam / top
    return q, (model.mfd.slope_up_to_jam(body) * share * jam - q * (1.0 - share)) / top


def derivative(
    model: Turns, x: PerCell, demand: PerCell, perimeter: PerEdge, splits: PerTurn
) -> tuple[PerCell, Record]:
    """Return dx/dt (veh/s, (C,)), and the record for `pull_derivative`.

    x: (veh, (C,)); demand: (veh/s, (C,))
    """
    cells = len(x)
    accumulation = x.reshape(len(model.mfd.jam), -1).sum(axis=1)
    per_region, slope = rate(model, accumulation)
    q = model.exit_rates * per_region[model.region]
    duration = None
    if model.detours is not None:
        duration = 1.0 + np.bincount(model.source, splits * model.detours, cells)
        q = q / duration
    leaving = q * x
    wish = splits * leaving[model.source]
    boundary = None
    share = perimeter
    if model.capacity is not None:
        wish_of_edges = np.bincount(model.edge, wish, len(model.edges))
        boundary = _boundary(model, wish_of_edges, perimeter, accumulation)
        share = boundary.share
    transfers = share[model.edge] * wish
    change = demand - np.where(model.ends, leaving, 0.0)
    change -= np.bincount(model.source, transfers, cells)
    change += np.bincount(model.target, transfers, cells)
    return change, Record(x, leaving, q, slope, duration, wish, share, boundary)


def _boundary(model: Turns, wish: PerEdge, perimeter: PerEdge, accumulation: PerRegion) -> Boundary:
    """Return the share of `wish` that passes each edge.

    wish: desired flow (veh/s, (E,))
    """
    assert model.capacity is not None
    assert model.storage is not None
    ahead = model.edges[:, 1]
    storage = model.storage[ahead]
    free = 1.0 - accumulation[ahead] / storage
    room = np.maximum(free, LEAST_ROOM)
    limit = perimeter * model.capacity * room + LEAST_LIMIT
    ratio = wish / limit
    power = ratio ** (SHARPNESS - 1)
    share = (1.0 + power * ratio) ** (-1.0 / SHARPNESS)
    of_ratio = -power * share / (1.0 + power * ratio)
    of_limit = -of_ratio * ratio / limit
    of_ahead = np.where(free > LEAST_ROOM, -perimeter * model.capacity / storage, 0.0)
    return Boundary(
        share=share,
        by_wish=of_ratio / limit,
        by_perimeter=of_limit * model.capacity * room,
        by_ahead=of_limit * of_ahead,
    )


def pull_derivative(
    model: Turns, adjoint: PerCell, splits: PerTurn, record: Record
) -> tuple[PerCell, PerEdge, PerTurn]:
    """Return the gradients by x (C,), perimeter (E,) and splits (V,).

    adjoint: gradient by dx/dt (C,)
    """
    regions = len(model.mfd.jam)
    gain = adjoint[model.target] - adjoint[model.source]
    of_share = np.bincount(model.edge, gain * record.wish, len(model.edges))
    of_wish = record.share[model.edge] * gain
    of_perimeter = of_share
    of_accumulation = 0.0
    boundary = record.boundary
    if boundary is not None:
        of_wish = of_wish + (of_share * boundary.by_wish)[model.edge]
        of_perimeter = of_share * boundary.by_perimeter
        of_accumulation = np.bincount(model.edges[:, 1], of_share * boundary.by_ahead, regions)
    of_leaving = np.bincount(model.source, splits * of_wish, len(record.x))
    of_leaving = of_leaving - np.where(model.ends, adjoint, 0.0)
    of_rates = of_leaving * model.exit_rates * record.x
    of_splits = of_wish * record.leaving[model.source]
    if model.detours is not None:
        of_rates = of_rates / record.duration
        of_duration = -of_leaving * record.leaving / record.duration
        of_splits = of_splits + of_duration[model.source] * model.detours
    of_rate = of_rates.reshape(regions, -1).sum(axis=1)
    of_region = of_accumulation + record.slope * of_rate
    of_x = record.rate * of_leaving + of_region[model.region]
    return of_x, of_perimeter, of_splits


def advance(
    model: Turns, x: PerCell, demand: PerCell, perimeter: PerEdge, splits: PerTurn
) -> tuple[PerCell, list[Record]]:
    """Return x (C,) after one integration step, and its records."""
    step = model.step / model.substeps
    total = np.zeros_like(x)
    slope = np.zeros_like(x)
    records = []
    for weight, place in zip(*SCHEMES[model.integrator], strict=True):
        slope, record = derivative(model, x + step * place * slope, demand, perimeter, splits)
        records.append(record)
        total += weight * slope
    return x + step * total, records


def pull_advance(
    model: Turns, adjoint: PerCell, splits: PerTurn, records: list[Record]
) -> tuple[PerCell, Decision]:
    """Return the gradients by x (C,) before a step and by its decision.

    adjoint: gradient by x after the integration step (C,)
    """
    step = model.step / model.substeps
    of_x = adjoint
    of_decision = np.zeros(len(model.edges) + len(splits))
    of_node = np.zeros_like(adjoint)  # by x at the node that comes after the present one
    ahead = 0.0  # from the present node to that one, along its slope (s)
    nodes = list(zip(records, *SCHEMES[model.integrator], strict=True))
    for record, weight, place in reversed(nodes):
        of_slope = step * weight * adjoint + ahead * of_node
        of_node, of_perimeter, of_splits = pull_derivative(model, of_slope, splits, record)
        of_x = of_x + of_node
        of_decision = of_decision + np.concatenate([of_perimeter, of_splits])
        ahead = step * place
    return of_x, of_decision


def vehicle_steps(
    model: Turns,
    start: PerCell,
    demand: Demands,
    plan: Plan,
    *,
    gradient: bool = False,
    deadline: float = math.inf,
    beyond: Callable[[PerCell], tuple[float, PerCell]] | None = None,
) -> tuple[float, Plan | None]:
    """Return the vehicles, summed over the ends of all intervals.

    The second value is the gradient (K, E + V), or None without `gradient`.

    start: (veh, (C,)); demand: (veh/s, (H, C))
    plan: u of the edges and theta of the turns in every interval (-, (K, E + V)); the last stays in
        force
    deadline: by time.perf_counter (s)
    beyond: terminal cost of the final state (veh intervals) and its gradient
    Raises: Late
    """
    x = start
    total = 0.0
    tape = []
    for step in _steps(model, start, demand, plan, deadline):
        x = step.x
        tape.append(step)
        if len(tape) % model.substeps == 0:
            total += float(x.sum())
    adjoint = np.zeros_like(x)
    if beyond is not None:
        more, adjoint = beyond(x)
        total += more
    if not gradient:
        return total, None
    of_plan = np.zeros_like(plan)
    while tape:
        _check_time(deadline)
        if len(tape) % model.substeps == 0:
            adjoint = adjoint + 1.0
        step = tape.pop()
        splits = plan[step.row, len(model.edges) :]
        adjoint, of_decision = pull_advance(model, adjoint, splits, step.records)
        of_plan[step.row] += of_decision
    return total, of_plan


def affected_vehicles(
    model: Turns, start: PerCell, demand: Demands, plan: Plan, *, deadline: float = math.inf
) -> Plan:
    """Return the vehicles (veh, (K, E + V)) that the plan affects.

    For an edge, the vehicles that want to cross it in that interval; for a turn, those that leave
    its cell. Arguments as in `vehicle_steps`.
    """
    edges = len(model.edges)
    affected = np.zeros_like(plan)
    for step in _steps(model, start, demand, plan, deadline):
        leaving = model.step / model.substeps * step.records[0].leaving[model.source]
        splits = plan[step.row, edges:]
        affected[step.row, :edges] += np.bincount(model.edge, splits * leaving, edges)
        affected[step.row, edges:] += leaving
    return affected


class _Step(NamedTuple):
    """Integration step.

    row: of the plan in force
    x: after the step (veh, (C,))
    """

    row: int
    x: PerCell
    records: list[Record]


def _steps(
    model: Turns, x: PerCell, demand: Demands, plan: Plan, deadline: float
) -> Iterator[_Step]:
    """Yield all integration steps.

    Raises: Late
    """
    edges = len(model.edges)
    for interval in np.repeat(np.arange(len(demand)), model.substeps):
        _check_time(deadline)
        row = min(interval, len(plan) - 1)
        x, records = advance(model, x, demand[interval], plan[row, :edges], plan[row, edges:])
        yield _Step(row, x, records)


def _check_time(deadline: float) -> None:
    if time.perf_counter() > deadline:
        raise Late
