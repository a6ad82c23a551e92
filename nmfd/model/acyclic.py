"""The acyclic regional model (ANMFD): no vehicle turns back.

Vehicles return neither to their origin nor to the region they came from. The state is a vector over
the cells that can ever be occupied, one per x_ogij (origin o, previous region g, current region i,
destination j); its flows run along a list of moves from cell to cell:

    dx_iiii/dt = d_ii - m_iiiii
    dx_iiij/dt = d_ij - sum_{h in N_i} u_ih m_iiihj                                    j != i
    dx_ogii/dt = sum_f u_gi m_ofgii - m_ogiii                              g in N_i, o != i
    dx_ogij/dt = sum_f u_gi m_ofgij - sum_{h in N_i - {o, g}} u_ih m_ogihj
                                                                   g in N_i, o != i, j != i
    m_ogihj = theta_ogihj q_i(x_i) x_ogij

After Tumu et al. (see `dynamics`), with three corrections of the published text:

- u_ih limits every outflow;
- theta_ogihj is theta_ihj without h = g and h = o, renormalised; if nothing is left, the least-bad
  next region is taken and counted;
- the sum that translates back keeps o = j and g = j where i = j.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from nmfd.arrays import PerPair, PerRegion, PerTurn
from nmfd.model.mfd import Mfd, stacked
from nmfd.model.regional_model import LEAST_ROOM, RegionalModel, passing_share

# Share of theta left without h = g and h = o: less is the rounding of an optimiser, not a route.
LEAST_SHARE = 1e-6

PerCell = Float[np.ndarray, " C"]
PerMove = Float[np.ndarray, " M"]
CellIndex = Int[np.ndarray, " C"]
MoveIndex = Int[np.ndarray, " M"]


@dataclass(frozen=True, kw_only=True)
class Acyclic:
    """Cells x_ogij of a network and the moves between them.

    origin, previous, region, destination: o, g, i, j of each cell (int, (C,)); o = g = i where the
        trip starts
    start: [i, j]: the cell x_iiij that demand d_ij enters (int, (R, R))
    move_from, move_to: cells of each move (int, (M,))
    move_next: h of each move (int, (M,))
    move_onward: False if the move turns back in a dead end (bool, (M,))
    fallback: least-bad move of each cell; -1 where the trip ends (int, (C,))
    mfd: of all regions
    exit_rates: (-, (C,))
    detours: of each move (-, (M,)), or None
    capacity: under u = 1 (veh/s, (R, R)), or None
    storage: (veh, (R,)), or None
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
    detours: PerMove | None
    capacity: PerPair | None
    storage: PerRegion | None


def build(network: RegionalModel) -> Acyclic:
    """Return all cells reachable from x_iiij, and their moves."""
    start = np.arange(network.regions**2).reshape(network.regions, network.regions)
    # (o, g, i, j) -> number of the cell
    cells = {(i, i, i, j): int(number) for (i, j), number in np.ndenumerate(start)}
    queue = list(cells)
    move_from: list[int] = []
    move_to = []
    move_next = []
    move_onward = []
    fallback = {}
    for o, g, i, j in queue:  # grows during the loop
        if i == j:
            continue
        cell = cells[o, g, i, j]
        neighbours = np.flatnonzero(network.adjacency[i]).tolist()
        allowed = [h for h in neighbours if h not in (o, g)]
        turns_back = ~network.split_mask[i, :, j]
        least_bad = min(allowed or neighbours, key=lambda h: (turns_back[h], network.hops[h, j], h))
        # In a dead end turning back is the least-bad move, counted like every forced move.
        for h in allowed or [least_bad]:
            target = o, i, h, j
            if target not in cells:
                cells[target] = len(cells)
                queue.append(target)
            if h == least_bad:
                fallback[cell] = len(move_from)
            move_from.append(cell)
            move_to.append(cells[target])
            move_next.append(h)
            move_onward.append(bool(allowed))
    origin, previous, region, destination = np.array(list(cells), dtype=int).T
    detours = network.detours
    if detours is not None:
        detours = detours[region[move_from], move_next, destination[move_from]]
    return Acyclic(
        origin=origin,
        previous=previous,
        region=region,
        destination=destination,
        start=start,
        move_from=np.array(move_from, dtype=int),
        move_to=np.array(move_to, dtype=int),
        move_next=np.array(move_next, dtype=int),
        move_onward=np.array(move_onward, dtype=bool),
        fallback=np.array([fallback.get(n, -1) for n in range(len(cells))]),
        mfd=stacked(network.mfds, np.array),
        exit_rates=network.relative_rates[region, destination],
        detours=detours,
        capacity=network.open_capacity,
        storage=network.storage,
    )


def shares(model: Acyclic, splits: PerTurn) -> tuple[PerMove, Bool[np.ndarray, " C"]]:
    """Return theta_ogihj of each move (M,) [-], and forced cells (C,) bool.

    A cell is forced to its least-bad move if theta leads only to its origin or previous region.

    splits: theta (-, (R, R, R))
    """
    region = model.region[model.move_from]
    destination = model.destination[model.move_from]
    weight = splits[region, model.move_next, destination] * model.move_onward
    left = np.bincount(model.move_from, weight, minlength=len(model.region))
    forced = (left <= LEAST_SHARE) & (model.fallback >= 0)
    theta = weight / np.maximum(left, LEAST_SHARE)[model.move_from]
    theta[forced[model.move_from]] = 0.0
    theta[model.fallback[forced]] = 1.0
    return theta, forced


def outflow(model: Acyclic, x: PerCell, theta: PerMove) -> PerCell:
    """Return the desired outflow of each cell (veh/s, (C,)).

    x: accumulations of the cells (veh, (C,))
    theta: share of each move (-, (M,))
    """
    accumulation = np.bincount(model.region, x, minlength=len(model.start))
    leaving = model.exit_rates * model.mfd.rate(accumulation)[model.region] * x
    if model.detours is None:
        return leaving
    return leaving / (1.0 + np.bincount(model.move_from, theta * model.detours, len(x)))


def derivative(
    model: Acyclic, x: PerCell, demand: PerPair, perimeter: PerPair, theta: PerMove
) -> tuple[PerCell, float]:
    """Return dx/dt (C,) and the completed trips [veh/s].

    x: accumulations of the cells (veh, (C,))
    demand: (veh/s, (R, R))
    perimeter: (-, (R, R))
    theta: share of each move (-, (M,))
    """
    leaving = outflow(model, x, theta)
    ends = model.region == model.destination
    passing = transfers(model, x, leaving, perimeter, theta)
    change = -np.where(ends, leaving, 0.0)
    change[model.start] += demand
    change -= np.bincount(model.move_from, passing, minlength=len(x))
    change += np.bincount(model.move_to, passing, minlength=len(x))
    return change, float(leaving[ends].sum())


def transfers(
    model: Acyclic, x: PerCell, leaving: PerCell, perimeter: PerPair, theta: PerMove
) -> PerMove:
    """Return the flow of each move (M,) [veh/s].

    Capacities act as in dynamics.passing.

    leaving: desired outflow of each cell (veh/s, (C,))
    """
    wish = theta * leaving[model.move_from]
    here = model.region[model.move_from]
    if model.capacity is None:
        return perimeter[here, model.move_next] * wish
    regions = len(model.start)
    boundary = here * regions + model.move_next
    wish_of_boundary = np.bincount(boundary, wish, minlength=regions**2)
    wish_of_boundary = wish_of_boundary.reshape(regions, regions)
    accumulation = np.bincount(model.region, x, minlength=regions)
    room = np.maximum(1.0 - accumulation / model.storage, LEAST_ROOM)
    share = passing_share(wish_of_boundary, perimeter * model.capacity * room)
    return share[here, model.move_next] * wish
