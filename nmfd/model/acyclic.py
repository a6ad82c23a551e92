"""The acyclic regional model (ANMFD): vehicles return neither to their origin nor to the region
they came from.

The state is a vector over the cells that can ever be occupied, one per x_ogij (origin o, previous
region g, current region i, destination j); its flows run along a list of moves from cell to cell:

    dx_iiii/dt = d_ii - m_iiiii
    dx_iiij/dt = d_ij - sum_{h in N_i} u_ih m_iiihj                                              j != i
    dx_ogii/dt = sum_f u_gi m_ofgii - m_ogiii                                    g in N_i, o != i
    dx_ogij/dt = sum_f u_gi m_ofgij - sum_{h in N_i - {o, g}} u_ih m_ogihj       g in N_i, o != i, j != i
    m_ogihj = theta_ogihj q_i(x_i) x_ogij

After Tumu et al. (see `dynamics`), with three corrections of the published text: u_ih limits every
outflow; theta_ogihj is theta_ihj without h = g and h = o, renormalised (if nothing is left, the
least-bad next region is taken and counted); the sum that translates back keeps o = j and g = j
where i = j.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nmfd.arrays import PerPair, PerRegion, PerTurn
from nmfd.model.dynamics import counted
from nmfd.model.mfd import Mfd, stacked
from nmfd.model.regional_model import LEAST_ROOM, RegionalModel, passing_share

LEAST_SHARE = (
    1e-6  # of theta left without h = g and h = o: less is the rounding of an optimiser, not a route
)

PerCell = Float[np.ndarray, " C"]
PerMove = Float[np.ndarray, " M"]
CellIndex = Int[np.ndarray, " C"]
MoveIndex = Int[np.ndarray, " M"]


@dataclass(frozen=True, kw_only=True)
class Acyclic:
    """Cells x_ogij and the moves between them, for one network.

    origin, previous, region, destination: (C,) int, o, g, i, j of each cell; o = g = i where the
        trip starts
    start: (R, R) int, [i, j]: the cell x_iiij that demand d_ij enters
    move_from, move_to: (M,) int, cells; move_next: (M,) int, h of each move
    move_onward: (M,) bool, false if the move turns back in a dead end
    fallback: (C,) int, least-bad move of each cell; -1 where the trip ends
    mfd: of all regions
    exit_rates: (C,) [-]; capacity: (R, R) [veh/s] under u = 1, or None; storage: (R,) [veh] or None
    """

    origin: CellIndex
    previous: CellIndex
    region: CellIndex
    destination: CellIndex
    start: Int[np.ndarray, "R R"]
    move_from: MoveIndex
    move_to: MoveIndex
    move_next: MoveIndex
    move_onward: Bool[np.ndarray, " M"]
    fallback: CellIndex
    mfd: Mfd
    exit_rates: PerCell
    capacity: PerPair | None
    storage: PerRegion | None


def build(network: RegionalModel) -> Acyclic:
    """Return all cells reachable from x_iiij, and their moves."""
    start = np.arange(network.regions**2).reshape(network.regions, network.regions)
    cells: dict[tuple[int, int, int, int], int] = {
        (i, i, i, j): int(n) for (i, j), n in np.ndenumerate(start)
    }
    queue, fallback = list(cells), {}
    moves: list[tuple[int, int, int, bool]] = []
    for o, g, i, j in queue:  # grows during the loop
        if i == j:
            continue
        cell, neighbours = cells[o, g, i, j], np.flatnonzero(network.adjacency[i]).tolist()
        allowed = [h for h in neighbours if h not in (o, g)]
        # In a dead end turning back is the least-bad move, counted like every forced move.
        best = min(
            allowed or neighbours,
            key=lambda h: (not network.split_mask[i, h, j], network.hops[h, j], h),
        )
        for h in allowed or [best]:
            target = o, i, h, j
            if target not in cells:
                cells[target] = len(cells)
                queue.append(target)
            if h == best:
                fallback[cell] = len(moves)
            moves.append((cell, cells[target], h, bool(allowed)))
    table = np.array(moves, dtype=int).reshape(-1, 4)
    index = np.array(list(cells), dtype=int)
    rates = np.ones(network.adjacency.shape) if network.exit_rates is None else network.exit_rates
    return Acyclic(
        exit_rates=rates[index[:, 2], index[:, 3]],
        capacity=network.open_capacity,
        storage=network.storage,
        origin=index[:, 0],
        previous=index[:, 1],
        region=index[:, 2],
        destination=index[:, 3],
        start=start,
        move_from=table[:, 0],
        move_to=table[:, 1],
        move_next=table[:, 2],
        move_onward=table[:, 3].astype(bool),
        fallback=np.array([fallback.get(n, -1) for n in range(len(cells))]),
        mfd=stacked(network.mfds, np.array),
    )


def shares(model: Acyclic, splits: PerTurn) -> tuple[PerMove, Bool[np.ndarray, " C"]]:
    """Return theta_ogihj of each move (M,) [-], and the forced cells (C,) bool.

    A cell is forced to its least-bad move if theta, splits (R, R, R) [-], leads only to its origin
    or previous region.
    """
    region, destination = model.region[model.move_from], model.destination[model.move_from]
    weight = splits[region, model.move_next, destination] * model.move_onward
    left = np.bincount(model.move_from, weight, minlength=len(model.region))
    forced = (left <= LEAST_SHARE) & (model.fallback >= 0)
    theta = np.where(
        forced[model.move_from], 0.0, weight / np.maximum(left, LEAST_SHARE)[model.move_from]
    )
    theta[model.fallback[forced]] = 1.0
    return theta, forced


def outflow(model: Acyclic, x: PerCell) -> PerCell:
    """Return the desired outflow (C,) [veh/s] of the state x (C,) [veh]."""
    accumulation = np.bincount(model.region, x, minlength=len(model.start))
    return model.exit_rates * model.mfd.rate(accumulation)[model.region] * x


def derivative(
    model: Acyclic, x: PerCell, demand: PerPair, perimeter: PerPair, theta: PerMove
) -> tuple[PerCell, float]:
    """Return dx/dt (C,) and the completed trips [veh/s].

    x (C,) [veh], demand (R, R) [veh/s], perimeter (R, R) [-], theta (M,) [-]
    """
    leaving, ends = outflow(model, x), model.region == model.destination
    passing = transfers(model, x, leaving, perimeter, theta)
    change = -np.where(ends, leaving, 0.0)
    change[model.start] += demand
    change -= np.bincount(model.move_from, passing, minlength=len(x))
    change += np.bincount(model.move_to, passing, minlength=len(x))
    return change, float(leaving[ends].sum())


def transfers(
    model: Acyclic, x: PerCell, leaving: PerCell, perimeter: PerPair, theta: PerMove
) -> PerMove:
    """Return the flow of each move (M,) [veh/s] from `leaving` (C,) [veh/s]; capacities as in
    dynamics.passing."""
    wish, here = theta * leaving[model.move_from], model.region[model.move_from]
    if model.capacity is None:
        return perimeter[here, model.move_next] * wish
    regions = len(model.start)
    wish_of_pair = np.bincount(
        here * regions + model.move_next, wish, minlength=regions**2
    ).reshape(regions, regions)
    room = np.maximum(
        1.0 - np.bincount(model.region, x, minlength=regions) / model.storage, LEAST_ROOM
    )
    return (
        passing_share(wish_of_pair, perimeter * model.capacity * room)[here, model.move_next] * wish
    )


def advance_counted(
    model: Acyclic,
    x: PerCell,
    demand: PerPair,
    perimeter: PerPair,
    theta: PerMove,
    step: float,
    **scheme: Any,
) -> tuple[PerCell, float]:
    """Return x after one control interval of `step` [s] under constant inputs, and the completed
    trips [veh]."""
    return counted(lambda x: derivative(model, x, demand, perimeter, theta), x, step, **scheme)
