"""The regional model along the list of its turns, with exact gradients: for optimisation, also over many regions.

A turn (i, h, j) is the way of the vehicles in i bound for j over the boundary to h: theta in edge-list form. Only turns
and destinations in use are listed, so that a plane city costs R^2 and not R^3. The equations are those of
`nmfd.dynamics` (design.md, section 2); the gradient of the total time spent follows by the adjoint method, at about the
cost of two more rollouts.
"""

from dataclasses import dataclass

import numpy as np

from nmfd.network import Network

# Weights of the slopes of an explicit Runge-Kutta scheme, and where each slope but the first is taken, in steps along
# the slope before it.
SCHEMES = {"euler": ((1.0,), ()), "rk4": ((1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.5, 0.5, 1.0))}


@dataclass(frozen=True, kw_only=True)
class Turns:
    """One network with J destinations in use, as C = R J cells x_ij, E edges u_ih and V turns theta_ihj.

    destinations: (J,) int; cells are numbered (i, n) -> i J + n for the n-th of them
    edges: (E, 2) int, the (i, h) that a turn crosses; turns: (V, 3) int, the (i, h, j)
    edge: (V,) int, edge of every turn; source, target: (V,) int, the cells x_ij and x_hj of every turn
    own: (V,) [-], the nominal theta_ihj
    region: (C,) int; ends: (C,) bool, trips end here (i = j)
    a, b, c, jam: (R,) of the MFDs
    rounding: [veh], width over which the kink of the MFDs at the jam accumulation is rounded off; 0 for the exact model
    """

    destinations: np.ndarray
    edges: np.ndarray
    turns: np.ndarray
    edge: np.ndarray
    source: np.ndarray
    target: np.ndarray
    own: np.ndarray
    region: np.ndarray
    ends: np.ndarray
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    jam: np.ndarray
    rounding: float


def build(network: Network, destinations: np.ndarray, *, guidance: bool) -> Turns:
    """The turns of vehicles bound for `destinations` (J,): all possible ones with guidance, else the nominal ones."""
    regions, count = network.regions, len(destinations)
    in_use = np.isin(np.arange(regions), destinations)
    turns = np.argwhere((network.split_mask if guidance else network.nominal_splits > 0) & in_use)
    here, onward, bound = turns.T
    number = np.zeros(regions, dtype=int)
    number[destinations] = np.arange(count)
    edges, edge = np.unique(here * regions + onward, return_inverse=True)
    cells = np.arange(regions * count)
    return Turns(
        destinations=destinations, edges=np.stack([edges // regions, edges % regions], axis=1), turns=turns, edge=edge,
        source=here * count + number[bound], target=onward * count + number[bound],
        own=network.nominal_splits[here, onward, bound], region=cells // count,
        ends=cells // count == np.asarray(destinations)[cells % count],
        **{name: np.array([getattr(m, name) for m in network.mfds]) for name in ("a", "b", "c", "jam")},
        rounding=0.0)


def rate(model: Turns, accumulation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """q_i [1/s] (R,) and dq_i/dx_i [1/(veh s)] (R,) of the accumulations x_i (R,) [veh].

    With rounding r, min(x, jam) is (x + jam - sqrt((x - jam)^2 + r^2)) / 2: off by r/2 at the jam accumulation, and by
    less than r^2 / (4 |x - jam|) elsewhere.
    """
    above = accumulation - model.jam
    spread = np.sqrt(above**2 + model.rounding**2)
    share = 0.5 - 0.5 * above / np.maximum(spread, 1e-12)  # d min(x, jam) / dx
    body = 0.5 * (accumulation + model.jam - spread)
    top = accumulation - body + model.jam
    q = ((model.a * body + model.b) * body + model.c) * model.jam / top
    return q, ((2.0 * model.a * body + model.b) * share * model.jam - q * (1.0 - share)) / top


def derivative(model: Turns, x: np.ndarray, demand: np.ndarray, passing: np.ndarray) -> tuple[np.ndarray, tuple]:
    """dx/dt (C,) [veh/s] of x (C,) [veh] under demand (C,) [veh/s] and passing = u_ih theta_ihj (V,) [-].

    Also what `pull_derivative` needs.
    """
    cells = len(x)
    q, change_of_q = rate(model, x.reshape(len(model.jam), -1).sum(axis=1))
    q = q[model.region]
    leaving = q * x
    transfers = passing * leaving[model.source]
    change = demand - np.where(model.ends, leaving, 0.0)
    change -= np.bincount(model.source, transfers, cells)
    change += np.bincount(model.target, transfers, cells)
    return change, (x, leaving, q, change_of_q)


def pull_derivative(model: Turns, price: np.ndarray, passing: np.ndarray, record: tuple) -> tuple:
    """The worth of x (C,) and of passing (V,), where a unit of dx/dt is worth `price` (C,)."""
    x, leaving, q, change_of_q = record
    gain = price[model.target] - price[model.source]
    of_leaving = np.bincount(model.source, passing * gain, len(x)) - np.where(model.ends, price, 0.0)
    of_region = change_of_q * (of_leaving * x).reshape(len(model.jam), -1).sum(axis=1)
    return q * of_leaving + of_region[model.region], gain * leaving[model.source]


def advance(model: Turns, x, demand, passing, step: float, integrator: str = "euler") -> tuple[np.ndarray, list]:
    """x (C,) after `step` [s] by one step of the integrator, and what `pull_advance` needs."""
    weights, nodes = SCHEMES[integrator]
    total, records, at = np.zeros_like(x), [], x
    for stage, weight in enumerate(weights):
        slope, record = derivative(model, at, demand, passing)
        records.append(record)
        total += weight * slope
        if stage < len(nodes):
            at = x + step * nodes[stage] * slope
    return x + step * total, records


def pull_advance(model: Turns, price, passing, records: list, step: float, integrator: str = "euler") -> tuple:
    """The worth of x (C,) and of passing (V,) before a step, where x after it is worth `price` (C,)."""
    weights, nodes = SCHEMES[integrator]
    of_x, of_passing, of_node = price, np.zeros_like(passing), None
    for stage in reversed(range(len(weights))):
        of_slope = step * weights[stage] * price
        if stage < len(nodes):
            of_slope = of_slope + step * nodes[stage] * of_node
        of_node, more = pull_derivative(model, of_slope, passing, records[stage])
        of_x, of_passing = of_x + of_node, of_passing + more
    return of_x, of_passing


def vehicle_steps(
    model: Turns, start: np.ndarray, demand: np.ndarray, plan: np.ndarray, step: float, *, substeps: int = 1,
    integrator: str = "euler", gradient: bool = False,
) -> tuple[float, np.ndarray | None]:
    """Vehicles in the network, summed over the ends of H control intervals of `step` [s], and its gradient.

    start: (C,) [veh]; demand: (H, C) [veh/s]
    plan: (K, E + V) [-], u of the edges and theta of the turns in every interval; the last stays in force
    The gradient (K, E + V) is None unless asked for.
    """
    perimeter, splits, passing, interval = _unfolded(model, plan, len(demand), substeps)
    x, total, tape = start, 0.0, []
    for node, k in enumerate(interval):
        x, records = advance(model, x, demand[node // substeps], passing[k], step / substeps, integrator)
        if gradient:
            tape.append(records)
        if (node + 1) % substeps == 0:
            total += float(x.sum())
    if not gradient:
        return total, None
    worth, price = np.zeros_like(passing), np.zeros_like(x)
    for node, k in reversed(list(enumerate(interval))):
        if (node + 1) % substeps == 0:
            price = price + 1.0
        price, of_passing = pull_advance(model, price, passing[k], tape.pop(), step / substeps, integrator)
        worth[k] += of_passing
    return total, _folded(model, splits * worth, perimeter * worth)


def vehicles_at_stake(
    model: Turns, start: np.ndarray, demand: np.ndarray, plan: np.ndarray, step: float, *, substeps: int = 1,
    integrator: str = "euler",
) -> np.ndarray:
    """How many vehicles every number of the plan decides on (K, E + V) [veh]; arguments as in `vehicle_steps`.

    Of an edge, those that want to cross it in that interval; of a turn, those that leave its cell.
    """
    _, splits, passing, interval = _unfolded(model, plan, len(demand), substeps)
    x, leaving = start, np.zeros_like(passing)
    for node, k in enumerate(interval):
        x, records = advance(model, x, demand[node // substeps], passing[k], step / substeps, integrator)
        leaving[k] += step / substeps * records[0][1][model.source]
    return _folded(model, splits * leaving, leaving)


def _unfolded(model: Turns, plan: np.ndarray, horizon: int, substeps: int) -> tuple:
    """u and theta (K, V) of all turns, their product, and the row of the plan in force at every integration step."""
    edges = len(model.edges)
    perimeter, splits = plan[:, :edges][:, model.edge], plan[:, edges:]
    return perimeter, splits, perimeter * splits, np.minimum(np.arange(horizon * substeps) // substeps, len(plan) - 1)


def _folded(model: Turns, of_edges: np.ndarray, of_turns: np.ndarray) -> np.ndarray:
    """(K, E + V) of two arrays (K, V), the first summed over the turns of every edge."""
    summed = [np.bincount(model.edge, row, len(model.edges)) for row in of_edges]
    return np.concatenate([np.reshape(summed, (len(of_turns), -1)), of_turns], axis=1)
