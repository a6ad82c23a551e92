"""Economic MPC by IPOPT, the reference of the projected-gradient solver.

The published formulation is multiple shooting: every x_ij, u_ih and theta_ihj of every interval is
a variable, and the dynamics are constraints. It is two orders of magnitude slower.

The dynamics are a CasADi twin of nmfd.model.dynamics, with the same names and equations, on SX, MX
or DM matrices without a batch. Structural zeros are kept.

x: (veh, (R, R)); demand: (veh/s, (R, R)); perimeter: (-, (R, R))
splits: R matrices (-, (R, R)), splits[i][h, j]
"""

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from nmfd.arrays import PairsOverTime, PerPair, TurnsOverTime
from nmfd.model import dynamics
from nmfd.model.integration import integrated
from nmfd.model.mfd import stacked
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import LEAST_ROOM, RegionalModel, passing_share

RENAMED = {"minimum": ca.fmin, "maximum": ca.fmax, "where": ca.if_else}
XP = SimpleNamespace(**vars(ca) | RENAMED)  # under NumPy's names
UNIT = 1000.0  # veh, unit of the accumulations in the solver
Matrix: TypeAlias = ca.SX | ca.MX | ca.DM
Turns: TypeAlias = Sequence[Matrix]  # R of them
Parameters: TypeAlias = SimpleNamespace


class Ipopt:
    """Solver for the vehicles, summed over the ends of all intervals."""

    def __init__(
        self, planning: PlanningModel, *, guidance: bool, horizon: int, limits: Mapping[str, float]
    ):
        """limits: options of IPOPT, such as max_iter and max_wall_time (s)"""
        network = planning.network
        regions = network.regions
        self.shape = (regions, regions)
        self._network = network
        self._horizon = horizon
        self._guidance = guidance
        self._edges = np.argwhere(network.adjacency)
        self._turns = np.argwhere(network.split_mask & guidance)
        p = parameters(network)
        start = ca.SX.sym("start", regions, regions)
        demand = ca.SX.sym("demand", regions, regions * horizon)
        variables = []
        constraints = []
        total = 0.0
        x = start
        for k in range(horizon):
            u = ca.SX.sym(f"u{k}", len(self._edges))
            theta = ca.SX.sym(f"theta{k}", len(self._turns))
            splits, sums = self._splits(theta)
            perimeter = ca.SX(regions, regions)
            for n, (i, h) in enumerate(self._edges.tolist()):
                perimeter[i, h] = u[n]
            entering = demand[:, k * regions : (k + 1) * regions]
            moved = advance(p, UNIT * x, entering, perimeter, splits, **planning.scheme)
            after = ca.SX.sym(f"x{k}", regions, regions)
            constraints += [*sums, ca.vec(ca.densify(moved) / UNIT - after)]
            variables += [u, theta, ca.vec(after)]
            total = total + ca.sum1(ca.vec(after))
            x = after
        edges = len(self._edges)
        turns = len(self._turns)
        cells = regions**2
        self._lower = np.tile([network.u_min] * edges + [0.0] * (turns + cells), horizon)
        self._upper = np.tile([network.u_max] * edges + [1.0] * turns + [np.inf] * cells, horizon)
        problem = {
            "x": ca.vertcat(*variables),
            "f": total,
            "g": ca.vertcat(*constraints),
            "p": ca.vertcat(ca.vec(start), ca.vec(demand)),
        }
        options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", **limits}}
        self._solver = ca.nlpsol("mpc", "ipopt", problem, options)

    def solve(
        self, state: PerPair, demand: PairsOverTime
    ) -> tuple[PairsOverTime, TurnsOverTime, str | None]:
        """Return u (H, R, R), theta (H, R, R, R), and the reason of a failure.

        The reason is None if IPOPT converged.

        state: (veh, (R, R)); demand: (veh/s, (H, R, R))
        """
        network = self._network
        horizon = self._horizon
        edges = len(self._edges)
        turns = len(self._turns)
        # CasADi stores matrices by columns.
        x = state.T.ravel() / UNIT
        nominal = network.nominal_splits[tuple(self._turns.T)]
        guess = np.concatenate([np.full(edges, network.u_max), nominal, x])
        answer = self._solver(
            x0=np.tile(guess, horizon),
            p=np.concatenate([x, *(interval.T.ravel() for interval in demand)]),
            lbx=self._lower,
            ubx=self._upper,
            lbg=0.0,
            ubg=0.0,
        )
        rows = answer["x"].full().reshape(horizon, -1)
        perimeter = np.zeros((horizon, *self.shape))
        perimeter[:, *self._edges.T] = rows[:, :edges]
        splits = np.tile(network.nominal_splits, (horizon, 1, 1, 1))
        splits[:, *self._turns.T] = rows[:, edges : edges + turns]
        stats = self._solver.stats()
        reason = None if stats["success"] else f"IPOPT: {stats['return_status']}"
        return perimeter, splits, reason

    def _splits(self, theta: ca.SX) -> tuple[list[ca.SX], list[ca.SX]]:
        """Return R matrices (R, R), and constraints.

        The constraints are 0 if the shares have sum 1.
        """
        regions = self._network.regions
        if not self._guidance:
            return [ca.SX(ca.sparsify(ca.DM(rows))) for rows in self._network.nominal_splits], []
        splits = [ca.SX(regions, regions) for _ in range(regions)]
        for n, (i, h, j) in enumerate(self._turns.tolist()):
            splits[i][h, j] = theta[n]
        sums = []
        for i in range(regions):
            for j in range(regions):
                if i != j:
                    sums.append(ca.sum1(splits[i][:, j]) - 1.0)
        return splits, sums


def parameters(network: RegionalModel) -> Parameters:
    """Return `dynamics.parameters` as constants.

    They are vectors (R, 1), but storage (1, R), and detours R matrices (R, R). adjacency is 1 or a
    structural zero.
    """
    p = Parameters(mfd=stacked(network.mfds, lambda numbers: ca.DM(list(numbers))))
    for name, values in vars(dynamics.parameters(network)).items():
        if name == "mfd":
            continue
        if values is not None and name == "detours":
            p.detours = [ca.DM(of_region) for of_region in values.numpy()]
        else:
            setattr(p, name, None if values is None else ca.DM(values.numpy()))
    p.adjacency = ca.sparsify(p.adjacency)
    if p.storage is not None:
        p.storage = p.storage.T
    return p


def rate(p: Parameters, accumulation: Matrix) -> Matrix:
    """Return q_i = g_i(min(x_i, jam_i)) / x_i (1/s, (R, 1)).

    accumulation: (veh, (R, 1))
    """
    return p.mfd.rate(accumulation, XP)


def flows(
    p: Parameters, x: Matrix, perimeter: Matrix, splits: Turns
) -> tuple[Matrix, list[Matrix]]:
    """Return trip completions m_ii (veh/s, (R, 1)) and transfer flows (veh/s).

    The transfer flows are R matrices (R, R) [h, j].
    """
    regions = x.shape[0]
    accumulation = ca.sum2(x)
    leaving = ca.repmat(rate(p, accumulation), 1, regions) * x
    if p.exit_rates is not None:
        leaving *= p.exit_rates
    if p.detours is not None:
        longer = [ca.sum1(splits[i] * p.detours[i]) for i in range(regions)]
        leaving /= 1.0 + ca.vertcat(*longer)
    completions = ca.diag(leaving)
    wishing = leaving - ca.diag(completions)
    wishes = [splits[i] * ca.repmat(wishing[i, :], regions, 1) for i in range(regions)]
    if p.capacity is None:
        share = perimeter * p.adjacency
    else:
        wish = ca.vertcat(*(ca.sum2(of_region).T for of_region in wishes))
        share = passing(p, wish, perimeter, accumulation) * p.adjacency
    transfers = [ca.repmat(share[i, :].T, 1, regions) * wishes[i] for i in range(regions)]
    return completions, transfers


def passing(p: Parameters, wish: Matrix, perimeter: Matrix, accumulation: Matrix) -> Matrix:
    """Return the share of `wish` that passes each boundary (-, (R, R)).

    wish: desired flow (veh/s, (R, R))
    """
    room = ca.fmax(1.0 - accumulation.T / p.storage, LEAST_ROOM)
    return passing_share(wish, perimeter * p.capacity * ca.repmat(room, wish.shape[0], 1))


def derivative(
    p: Parameters, x: Matrix, demand: Matrix, perimeter: Matrix, splits: Turns
) -> Matrix:
    """Return dx_ij/dt (veh/s, (R, R))."""
    completions, transfers = flows(p, x, perimeter, splits)
    leaving = ca.vertcat(*(ca.sum1(transfer) for transfer in transfers))
    entering = sum(transfers[1:], transfers[0])
    return demand - ca.diag(completions) - leaving + entering


def advance(
    p: Parameters,
    x: Matrix,
    demand: Matrix,
    perimeter: Matrix,
    splits: Turns,
    step: float,
    **scheme: Any,
) -> Matrix:
    """Return x after one control interval under constant inputs.

    step: control interval (s)
    scheme: as of `integration.integrated`
    """
    return integrated(lambda x: derivative(p, x, demand, perimeter, splits), x, step, **scheme)
