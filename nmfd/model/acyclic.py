"""The acyclic regional model (ANMFD): vehicles return neither to their origin nor to the region they came from.

The state is a vector over the cells that can ever be occupied, one per x_ogij (origin o, previous region g, current
region i, destination j); its flows run along a list of moves from cell to cell:

    dx_iiii/dt = d_ii - m_iiiii
    dx_iiij/dt = d_ij - sum_{h in N_i} u_ih m_iiihj                                              j != i
    dx_ogii/dt = sum_f u_gi m_ofgii - m_ogiii                                    g in N_i, o != i
    dx_ogij/dt = sum_f u_gi m_ofgij - sum_{h in N_i - {o, g}} u_ih m_ogihj       g in N_i, o != i, j != i
    m_ogihj = theta_ogihj q_i(x_i) x_ogij

After Tumu et al. (see `dynamics`), with the slips of the published text corrected: u_ih stands in every outflow;
theta_ogihj is theta_ihj with h = g and h = o removed and renormalised over what is left (if nothing is, the least-bad
next region is taken and counted); the sum that translates back keeps o = j and g = j where i = j.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from nmfd.arrays import PerPair, PerRegion, PerTurn
from nmfd.model.dynamics import SCHEMES
from nmfd.model.regional_model import LEAST_LIMIT, LEAST_ROOM, SHARPNESS, RegionalModel

# Less than this share of theta left after removing h = g and h = o counts as nothing: what remains is then the
# rounding of an optimiser or a softmax, and scaling it up to 1 would make a route of noise.
LEAST_SHARE = 1e-6

PerCell = Float[np.ndarray, " C"]
PerMove = Float[np.ndarray, " M"]
CellIndex = Int[np.ndarray, " C"]
MoveIndex = Int[np.ndarray, " M"]
CellMask = Bool[np.ndarray, " C"]
MoveMask = Bool[np.ndarray, " M"]


@dataclass(frozen=True, kw_only=True)
class Acyclic:
    """The cells x_ogij and the moves between them, for one network.

    origin, previous, region, destination: (C,) int, the o, g, i, j of every cell; o = g = i where the trip starts
    start: (R, R) int, [i, j] = the cell x_iiij in which demand d_ij appears
    move_from, move_to: (M,) int, cells; move_next: (M,) int, the h of every move
    move_onward: (M,) bool, false where the move turns back because the cell is a dead end
    fallback: (C,) int, the least-bad move of every cell; -1 where the trip ends
    a, b, c, jam: (R,) of the MFDs
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
    move_onward: MoveMask
    fallback: CellIndex
    a: PerRegion
    b: PerRegion
    c: PerRegion
    jam: PerRegion
    exit_rates: PerCell
    capacity: PerPair | None
    storage: PerRegion | None


def build(network: RegionalModel) -> Acyclic:
    """All cells that can be reached from x_iiij, and their moves."""
    neighbours = [np.flatnonzero(row) for row in network.adjacency]
    cells: dict[tuple[int, int, int, int], int] = {}
    for i in range(network.regions):
        for j in range(network.regions):
            cells[i, i, i, j] = len(cells)
    start = np.arange(network.regions**2).reshape(network.regions, network.regions)
    queue, fallback = list(cells), {}
    moves: list[tuple[int, int, int, bool]] = []
    for cell in queue:  # grows while it is walked
        o, g, i, j = cell
        if i == j:
            continue
        allowed = [h for h in neighbours[i] if h not in (o, g)]
        # In a dead end there is no way on: turning back is then the least bad, and counted like every forced move.
        options = allowed or list(neighbours[i])
        best = min(options, key=lambda h: (not network.split_mask[i, h, j], network.hops[h, j], h))
        for h in allowed or [best]:
            target = (o, i, int(h), j)
            if target not in cells:
                cells[target] = len(cells)
                queue.append(target)
            if h == best:
                fallback[cells[cell]] = len(moves)
            moves.append((cells[cell], cells[target], h, bool(allowed)))
    table = np.array(moves, dtype=int).reshape(-1, 4)
    index = np.array(list(cells), dtype=int)
    mfds = {name: np.array([getattr(m, name) for m in network.mfds]) for name in ("a", "b", "c", "jam")}
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
        **mfds,
    )


def shares(model: Acyclic, splits: PerTurn) -> tuple[PerMove, CellMask]:
    """theta_ogihj of every move (M,) [-], and which cells are forced (C,) bool.

    splits: (R, R, R) [-], [i, h, j] = theta_ihj. A cell is forced if theta leaves it nothing but its origin and its
    previous region: it takes its least-bad move.
    """
    region, destination = model.region[model.move_from], model.destination[model.move_from]
    weight = splits[region, model.move_next, destination] * model.move_onward
    left = np.bincount(model.move_from, weight, minlength=len(model.region))
    forced = (left <= LEAST_SHARE) & (model.fallback >= 0)
    theta = np.where(forced[model.move_from], 0.0, weight / np.maximum(left, LEAST_SHARE)[model.move_from])
    theta[model.fallback[forced]] = 1.0
    return theta, forced


def rate(model: Acyclic, x: PerCell) -> PerRegion:
    """q_i [1/s] (R,) of the state x (C,) [veh], with x_i the sum of all x_ogij in i."""
    accumulation = np.bincount(model.region, x, minlength=len(model.jam))
    body = np.minimum(accumulation, model.jam)
    return ((model.a * body + model.b) * body + model.c) * model.jam / np.maximum(accumulation, model.jam)


def derivative(model: Acyclic, x: PerCell, demand: PerPair, perimeter: PerPair, theta: PerMove) -> PerCell:
    """dx/dt (C,) [veh/s] of x (C,) [veh] under demand (R, R) [veh/s], perimeter (R, R) [-] and theta (M,) [-]."""
    leaving = model.exit_rates * rate(model, x)[model.region] * x
    passing = transfers(model, x, leaving, perimeter, theta)
    change = -np.where(model.region == model.destination, leaving, 0.0)
    change[model.start] += demand
    change -= np.bincount(model.move_from, passing, minlength=len(x))
    change += np.bincount(model.move_to, passing, minlength=len(x))
    return change


def transfers(model: Acyclic, x: PerCell, leaving: PerCell, perimeter: PerPair, theta: PerMove) -> PerMove:
    """The flow of every move (M,) [veh/s], of those `leaving` (C,) [veh/s]; capacities as in dynamics.passing."""
    wish, here = theta * leaving[model.move_from], model.region[model.move_from]
    if model.capacity is None:
        return perimeter[here, model.move_next] * wish
    regions = len(model.jam)
    wish_of_pair = np.bincount(here * regions + model.move_next, wish, minlength=regions**2).reshape(regions, regions)
    room = np.maximum(1.0 - np.bincount(model.region, x, minlength=regions) / model.storage, LEAST_ROOM)
    limit = perimeter * model.capacity * room + LEAST_LIMIT
    return (1.0 + (wish_of_pair / limit) ** SHARPNESS)[here, model.move_next] ** (-1.0 / SHARPNESS) * wish


def euler(model: Acyclic, x: PerCell, demand: PerPair, perimeter: PerPair, theta: PerMove, step: float) -> PerCell:
    """x after `step` [s] by forward Euler; keeps x >= 0 where step * q <= 1 and demand >= 0."""
    return x + step * derivative(model, x, demand, perimeter, theta)


def rk4(model: Acyclic, x: PerCell, demand: PerPair, perimeter: PerPair, theta: PerMove, step: float) -> PerCell:
    """x after `step` [s] by the classical fourth-order Runge-Kutta scheme."""
    k1 = derivative(model, x, demand, perimeter, theta)
    k2 = derivative(model, x + 0.5 * step * k1, demand, perimeter, theta)
    k3 = derivative(model, x + 0.5 * step * k2, demand, perimeter, theta)
    k4 = derivative(model, x + step * k3, demand, perimeter, theta)
    return x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


INTEGRATORS = {"euler": euler, "rk4": rk4}


def advance(
    model: Acyclic,
    x: PerCell,
    demand: PerPair,
    perimeter: PerPair,
    theta: PerMove,
    step: float,
    *,
    integrator: str = "euler",
    substeps: int = 1,
) -> PerCell:
    """x after one control interval of `step` [s], in `substeps` equal steps under constant controls and demand."""
    for _ in range(substeps):
        x = INTEGRATORS[integrator](model, x, demand, perimeter, theta, step / substeps)
    return x


def advance_counted(
    model: Acyclic,
    x: PerCell,
    demand: PerPair,
    perimeter: PerPair,
    theta: PerMove,
    step: float,
    *,
    integrator: str = "euler",
    substeps: int = 1,
) -> tuple[PerCell, float]:
    """As `advance`, and the trips [veh] that ended meanwhile, by the same scheme: for the ledger."""
    step, ended, ends = step / substeps, 0.0, model.region == model.destination
    for _ in range(substeps):
        slope, total = np.zeros_like(x), np.zeros_like(x)
        for weight, place in zip(*SCHEMES[integrator], strict=True):
            at = x + place * step * slope
            slope = derivative(model, at, demand, perimeter, theta)
            total += weight * slope
            leaving = model.exit_rates[ends] * rate(model, at)[model.region[ends]] * at[ends]
            ended += step * weight * float(leaving.sum())
        x = x + step * total
    return x, ended


def translate(model: Acyclic, x: PerCell) -> PerPair:
    """x_ij = sum over o, g of x_ogij (R, R) [veh]; o = j and g = j stay in for i = j, the trips inside a region."""
    regions = len(model.jam)
    flat = np.bincount(model.region * regions + model.destination, x, minlength=regions**2)
    return flat.reshape(regions, regions)
