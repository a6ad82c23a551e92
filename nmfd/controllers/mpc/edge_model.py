"""Regional model in edge-list form with exact gradients, for optimisation over many regions.

A turn (i, h, j) is the movement of the vehicles in i bound for j over the boundary to h. Only turns
and destinations in use are listed, so that a planar city costs R^2 and not R^3. The equations are
those of `nmfd.model.dynamics`. The gradient of the total time spent follows by the adjoint method,
at about the cost of two more rollouts.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nmfd.arrays import PerRegion
from nmfd.controllers.mpc.projected_gradient import Late
from nmfd.model.dynamics import SCHEMES
from nmfd.model.mfd import Mfd, stacked
from nmfd.model.regional_model import LEAST_LIMIT, LEAST_ROOM, SHARPNESS, RegionalModel

PerCell = Float[np.ndarray, " C"]
PerEdge = Float[np.ndarray, " E"]
PerTurn = Float[np.ndarray, " V"]
Demands = Float[np.ndarray, "H C"]
Plan = Float[np.ndarray, "K D"]  # D = E + V decisions in each interval
Decision = Float[np.ndarray, " D"]


@dataclass(frozen=True, kw_only=True)
class Turns:
    """Network with J destinations in use, as C = R J cells x_ij, E edges u_ih and V turns
    theta_ihj.

    destinations: (J,); cell (i, n) of the n-th destination has number i J + n
    edges: (i, h) of every edge, (E, 2); turns: (i, h, j), (V, 3)
    edge: edge of every turn, (V,); source, target: cells x_ij and x_hj of every turn, (V,)
    own: nominal theta_ihj (-, (V,))
    region: (C,); ends: cells in which trips end (i = j), (C,)
    mfd: of all regions
    exit_rates: (-, (C,)); capacity: under u = 1 (veh/s, (E,)) or None; storage: (veh, (R,)) or None
    step: control interval (s); substeps, integrator: integration steps in it, and their scheme
        (dynamics.SCHEMES)
    rounding: width of the rounded kink of the MFDs at the jam accumulation (veh); 0 for the exact
        model
    """

    destinations: Int[np.ndarray, " J"]
    edges: Int[np.ndarray, "E 2"]
    turns: Int[np.ndarray, "V 3"]
    edge: Int[np.ndarray, " V"]
    source: Int[np.ndarray, " V"]
    target: Int[np.ndarray, " V"]
    own: PerTurn
    region: Int[np.ndarray, " C"]
    ends: Bool[np.ndarray, " C"]
    mfd: Mfd
    exit_rates: PerCell
    capacity: PerEdge | None
    storage: PerRegion | None
    step: float
    substeps: int = 1
    integrator: str = "euler"
    rounding: float = 0.0


def build(
    network: RegionalModel, destinations: Int[np.ndarray, " J"], *, guidance: bool, **scheme: Any
) -> Turns:
    """Return the turns of vehicles bound for `destinations` (J,): all with guidance, else the
    nominal ones.

    scheme: step, substeps and integrator of `Turns`
    """
    regions, count = network.regions, len(destinations)
    in_use = np.isin(np.arange(regions), destinations)
    turns = np.argwhere((network.split_mask if guidance else network.nominal_splits > 0) & in_use)
    here, onward, bound = turns.T
    number = np.zeros(regions, dtype=int)
    number[destinations] = np.arange(count)
    edges, edge = np.unique(here * regions + onward, return_inverse=True)
    cells, edges = np.arange(regions * count), np.stack([edges // regions, edges % regions], axis=1)
    rates = np.ones(network.adjacency.shape) if network.exit_rates is None else network.exit_rates
    capacity = network.open_capacity
    return Turns(
        exit_rates=rates[:, destinations].ravel(),
        storage=network.storage,
        capacity=None if capacity is None else capacity[tuple(edges.T)],
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
    """Return q_i (1/s, (R,)) and dq_i/dx_i (1/(veh s), (R,)) of the accumulations x_i (veh, (R,)).

    With rounding r, min(x, jam) is (x + jam - sqrt((x - jam)^2 + r^2)) / 2: off by r/2 at the jam
    accumulation, and by less than r^2 / (4 |x - jam|) elsewhere.
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
) -> tuple[PerCell, tuple]:
    """Return dx/dt (veh/s, (C,)) of x (veh, (C,)) under demand (veh/s, (C,)), and the record for
    `pull_derivative`."""
    cells = len(x)
    accumulation = x.reshape(len(model.mfd.jam), -1).sum(axis=1)
    q, change_of_q = rate(model, accumulation)
    q = model.exit_rates * q[model.region]
    leaving = q * x
    wish = splits * leaving[model.source]
    boundary = None
    share = perimeter
    if model.capacity is not None:
        boundary = _boundary(
            model, np.bincount(model.edge, wish, len(model.edges)), perimeter, accumulation
        )
        share = boundary[0]
    transfers = share[model.edge] * wish
    change = demand - np.where(model.ends, leaving, 0.0)
    change -= np.bincount(model.source, transfers, cells)
    change += np.bincount(model.target, transfers, cells)
    return change, (x, leaving, q, change_of_q, wish, share, boundary)


def _boundary(
    model: Turns, wish: PerEdge, perimeter: PerEdge, accumulation: PerRegion
) -> tuple[PerEdge, ...]:
    """Return the share of `wish` (veh/s, (E,)) that passes, and its derivatives by wish, u and
    accumulation ahead."""
    assert model.capacity is not None
    assert model.storage is not None
    ahead = model.edges[:, 1]
    free = 1.0 - accumulation[ahead] / model.storage[ahead]
    room, open_capacity = np.maximum(free, LEAST_ROOM), model.capacity
    limit = perimeter * open_capacity * room + LEAST_LIMIT
    ratio = wish / limit
    power = ratio ** (SHARPNESS - 1)
    share = (1.0 + power * ratio) ** (-1.0 / SHARPNESS)
    of_ratio = -power * share / (1.0 + power * ratio)
    of_limit = -of_ratio * ratio / limit
    of_ahead = np.where(free > LEAST_ROOM, -perimeter * open_capacity / model.storage[ahead], 0.0)
    return share, of_ratio / limit, of_limit * open_capacity * room, of_limit * of_ahead


def pull_derivative(
    model: Turns, adjoint: PerCell, splits: PerTurn, record: tuple
) -> tuple[PerCell, PerEdge, PerTurn]:
    """Return the gradients by x (C,), perimeter (E,) and splits (V,), if that by dx/dt is `adjoint`
    (C,)."""
    x, leaving, q, change_of_q, wish, share, boundary = record
    regions, edges = len(model.mfd.jam), len(model.edges)
    gain = adjoint[model.target] - adjoint[model.source]
    of_perimeter = np.bincount(model.edge, gain * wish, edges)
    of_wish, of_accumulation = share[model.edge] * gain, 0.0
    if boundary is not None:
        of_share = of_perimeter
        _, by_wish, by_perimeter, by_ahead = boundary
        of_wish = of_wish + (of_share * by_wish)[model.edge]
        of_perimeter = of_share * by_perimeter
        of_accumulation = np.bincount(model.edges[:, 1], of_share * by_ahead, regions)
    of_leaving = np.bincount(model.source, splits * of_wish, len(x)) - np.where(
        model.ends, adjoint, 0.0
    )
    of_region = of_accumulation + change_of_q * (of_leaving * model.exit_rates * x).reshape(
        regions, -1
    ).sum(axis=1)
    return q * of_leaving + of_region[model.region], of_perimeter, of_wish * leaving[model.source]


def advance(
    model: Turns, x: PerCell, demand: PerCell, perimeter: PerEdge, splits: PerTurn
) -> tuple[PerCell, list]:
    """Return x (C,) after one integration step, and the records for `pull_advance`."""
    step, total, slope, records = (
        model.step / model.substeps,
        np.zeros_like(x),
        np.zeros_like(x),
        [],
    )
    for weight, place in zip(*SCHEMES[model.integrator], strict=True):
        slope, record = derivative(model, x + step * place * slope, demand, perimeter, splits)
        records.append(record)
        total += weight * slope
    return x + step * total, records


def pull_advance(
    model: Turns, adjoint: PerCell, splits: PerTurn, records: list
) -> tuple[PerCell, Decision]:
    """Return the gradients by x (C,) and decision (E + V,) before a step, if that by x after it is
    `adjoint`."""
    of_x, of_decision, of_node = (
        adjoint,
        np.zeros(len(model.edges) + len(splits)),
        np.zeros_like(adjoint),
    )
    step, ahead = model.step / model.substeps, 0.0  # ahead: from the node before to this one (s)
    for record, weight, place in reversed(
        list(zip(records, *SCHEMES[model.integrator], strict=True))
    ):
        of_slope = step * weight * adjoint + ahead * of_node
        of_node, *more = pull_derivative(model, of_slope, splits, record)
        of_x, of_decision, ahead = of_x + of_node, of_decision + np.concatenate(more), step * place
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
    """Return the vehicles summed over the ends of H control intervals, and the gradient (K, E + V)
    or None.

    start: (veh, (C,)); demand: (veh/s, (H, C))
    plan: u of the edges and theta of the turns in every interval (-, (K, E + V)); the last stays in
        force
    deadline: by time.perf_counter (s)
    beyond: terminal cost of the final state (veh intervals) and its gradient
    Raises: Late
    """
    x, total, tape = start, 0.0, []
    for step, (k, x, records) in enumerate(_steps(model, start, demand, plan, deadline), 1):
        tape.append((k, records))
        if step % model.substeps == 0:
            total += float(x.sum())
    more, adjoint = (0.0, np.zeros_like(x)) if beyond is None else beyond(x)
    total += more
    if not gradient:
        return total, None
    of_plan, edges = np.zeros_like(plan), len(model.edges)
    for step in range(len(tape), 0, -1):
        _look(deadline)
        if step % model.substeps == 0:
            adjoint = adjoint + 1.0
        k, records = tape[step - 1]
        adjoint, of_decision = pull_advance(model, adjoint, plan[k, edges:], records)
        of_plan[k] += of_decision
    return total, of_plan


def affected_vehicles(
    model: Turns, start: PerCell, demand: Demands, plan: Plan, *, deadline: float = math.inf
) -> Plan:
    """Return the vehicles that every number of the plan affects (veh, (K, E + V)); arguments as in
    `vehicle_steps`.

    For an edge, the vehicles that want to cross it in that interval; for a turn, those that leave
    its cell.
    """
    edges, affected = len(model.edges), np.zeros_like(plan)
    for k, _, records in _steps(model, start, demand, plan, deadline):
        leaving = model.step / model.substeps * records[0][1][model.source]
        affected[k, :edges] += np.bincount(model.edge, plan[k, edges:] * leaving, edges)
        affected[k, edges:] += leaving
    return affected


def _steps(
    model: Turns, x: PerCell, demand: Demands, plan: Plan, deadline: float
) -> Iterator[tuple[int, PerCell, list]]:
    """Yield the row of the plan in force, x after, and the records of every integration step.
    Raises: Late"""
    edges = len(model.edges)
    for interval in np.repeat(np.arange(len(demand)), model.substeps):
        _look(deadline)
        k = min(interval, len(plan) - 1)
        x, records = advance(model, x, demand[interval], plan[k, :edges], plan[k, edges:])
        yield k, x, records


def _look(deadline: float) -> None:
    if time.perf_counter() > deadline:
        raise Late
