"""Economic MPC by IPOPT on the published formulation: the reference of the projected-gradient
solver.

Multiple shooting on the CasADi twin of nmfd.model.dynamics: every x_ij, u_ih and theta_ihj of every
interval is a variable and the dynamics are constraints. Two orders of magnitude slower.

The twin has the same names and equations on SX, MX or DM matrices, without a batch: x (R, R) [veh];
demand (R, R) [veh/s]; perimeter (R, R) [-]; splits: R matrices (R, R) [-], splits[i][h, j].
Structural zeros are kept.
"""

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from nmfd.arrays import PairsOverTime, PerPair, TurnsOverTime
from nmfd.model import dynamics
from nmfd.model.mfd import stacked
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import LEAST_ROOM, RegionalModel, passing_share

XP = SimpleNamespace(
    **vars(ca) | {"minimum": ca.fmin, "maximum": ca.fmax, "where": ca.if_else}
)  # NumPy's names
UNIT = 1000.0  # veh, unit of the accumulations in the solver
Matrix: TypeAlias = ca.SX | ca.MX | ca.DM
Turns: TypeAlias = Sequence[Matrix]  # R of them
Parameters: TypeAlias = SimpleNamespace


class Ipopt:
    """Solver that minimises the vehicles summed over the ends of `horizon` intervals."""

    def __init__(
        self, planning: PlanningModel, *, guidance: bool, horizon: int, limits: Mapping[str, float]
    ):
        """limits: options of IPOPT, such as max_iter and max_wall_time (s)"""
        network = planning.network
        self._network, self._horizon, self._guidance = network, horizon, guidance
        self._edges, self._turns = (
            np.argwhere(network.adjacency),
            np.argwhere(network.split_mask & guidance),
        )
        regions, p = network.regions, parameters(network)
        self.shape = regions, regions
        start, demand = (
            ca.SX.sym("start", regions, regions),
            ca.SX.sym("demand", regions, regions * horizon),
        )
        variables, constraints, total, x = [], [], 0.0, start
        for k in range(horizon):
            u, theta = (
                ca.SX.sym(f"u{k}", len(self._edges)),
                ca.SX.sym(f"theta{k}", len(self._turns)),
            )
            splits, sums = self._splits(theta)
            perimeter = ca.SX(regions, regions)
            for n, (i, h) in enumerate(self._edges.tolist()):
                perimeter[i, h] = u[n]
            after = ca.SX.sym(f"x{k}", regions, regions)
            flows = demand[:, k * regions : (k + 1) * regions], perimeter, splits
            moved = advance(p, UNIT * x, *flows, **planning.scheme)
            constraints += [*sums, ca.vec(ca.densify(moved) / UNIT - after)]
            total, x = total + ca.sum1(ca.vec(after)), after
            variables += [u, theta, ca.vec(after)]
        edges, turns, cells = len(self._edges), len(self._turns), regions**2
        self._lower = np.tile([network.u_min] * edges + [0.0] * (turns + cells), horizon)
        self._upper = np.tile([network.u_max] * edges + [1.0] * turns + [np.inf] * cells, horizon)
        problem = {"x": ca.vertcat(*variables), "f": total, "g": ca.vertcat(*constraints)}
        problem["p"] = ca.vertcat(ca.vec(start), ca.vec(demand))
        options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", **limits}}
        self._solver = ca.nlpsol("mpc", "ipopt", problem, options)

    def solve(
        self, state: PerPair, demand: PairsOverTime
    ) -> tuple[PairsOverTime, TurnsOverTime, str | None]:
        """Return u (-, (H, R, R)), theta (-, (H, R, R, R)), and the reason if IPOPT did not
        converge, else None.

        state: (veh, (R, R)); demand: (veh/s, (H, R, R))
        """
        network, regions, horizon = self._network, self._network.regions, self._horizon
        edges, turns, x = self._edges, self._turns, state.T.ravel() / UNIT
        guess = np.concatenate(
            [np.full(len(edges), network.u_max), network.nominal_splits[tuple(turns.T)], x]
        )
        given = np.concatenate([x, *(d.T.ravel() for d in demand)])
        bounds = {"lbx": self._lower, "ubx": self._upper, "lbg": 0.0, "ubg": 0.0}
        answer = (
            self._solver(x0=np.tile(guess, horizon), p=given, **bounds)["x"]
            .full()
            .reshape(horizon, -1)
        )
        stats = self._solver.stats()
        perimeter, splits = (
            np.zeros((horizon, regions, regions)),
            np.tile(network.nominal_splits, (horizon, 1, 1, 1)),
        )
        perimeter[:, edges[:, 0], edges[:, 1]] = answer[:, : len(edges)]
        splits[:, turns[:, 0], turns[:, 1], turns[:, 2]] = answer[
            :, len(edges) : len(edges) + len(turns)
        ]
        return perimeter, splits, None if stats["success"] else f"IPOPT: {stats['return_status']}"

    def _splits(self, theta: ca.SX) -> tuple[list[ca.SX], list[ca.SX]]:
        """Return R matrices (R, R), and the constraints that are 0 if their shares have sum 1."""
        regions = self._network.regions
        if not self._guidance:
            return [ca.SX(ca.sparsify(ca.DM(rows))) for rows in self._network.nominal_splits], []
        splits = [ca.SX(regions, regions) for _ in range(regions)]
        for n, (i, h, j) in enumerate(self._turns.tolist()):
            splits[i][h, j] = theta[n]
        return splits, [
            ca.sum1(splits[i][:, j]) - 1.0 for i in range(regions) for j in range(regions) if i != j
        ]


def parameters(network: RegionalModel) -> Parameters:
    """Return `dynamics.parameters` as constants: vectors (R, 1), but storage (1, R); adjacency 1 or
    structural zero."""
    known = vars(dynamics.parameters(network)) | {"mfd": None}
    p = Parameters(
        **{
            name: None if values is None else ca.DM(values.numpy())
            for name, values in known.items()
        }
    )
    p.mfd = stacked(network.mfds, lambda numbers: ca.DM(list(numbers)))
    p.adjacency, p.storage = ca.sparsify(p.adjacency), None if p.storage is None else p.storage.T
    return p


def rate(p: Parameters, accumulation: Matrix) -> Matrix:
    """Return q_i = g_i(min(x_i, jam_i)) / x_i (R, 1) [1/s] of accumulation (R, 1) [veh]."""
    return p.mfd.rate(accumulation, XP)


def flows(
    p: Parameters, x: Matrix, perimeter: Matrix, splits: Turns
) -> tuple[Matrix, list[Matrix]]:
    """Return trip completions m_ii (R, 1) and transfer flows [veh/s], R matrices (R, R) [h, j]."""
    regions, accumulation = x.shape[0], ca.sum2(x)
    leaving = ca.repmat(rate(p, accumulation), 1, regions) * x
    if p.exit_rates is not None:
        leaving *= p.exit_rates
    completions = ca.diag(leaving)
    wishing = leaving - ca.diag(completions)
    transfers = [splits[i] * ca.repmat(wishing[i, :], regions, 1) for i in range(regions)]
    if p.capacity is None:
        open_share = perimeter * p.adjacency
    else:
        wish = ca.vertcat(*(ca.sum2(transfer).T for transfer in transfers))
        open_share = passing(p, wish, perimeter, accumulation) * p.adjacency
    return completions, [
        ca.repmat(open_share[i, :].T, 1, regions) * transfer for i, transfer in enumerate(transfers)
    ]


def passing(p: Parameters, wish: Matrix, perimeter: Matrix, accumulation: Matrix) -> Matrix:
    """Return the share (R, R) [-] of the desired flow `wish` (R, R) [veh/s] that passes each
    boundary."""
    room = ca.fmax(1.0 - accumulation.T / p.storage, LEAST_ROOM)
    return passing_share(wish, perimeter * p.capacity * ca.repmat(room, wish.shape[0], 1))


def derivative(
    p: Parameters, x: Matrix, demand: Matrix, perimeter: Matrix, splits: Turns
) -> Matrix:
    """Return dx_ij/dt (R, R) [veh/s]."""
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
    """Return x after one control interval of `step` [s] under constant inputs; scheme: see
    `dynamics.integrated`."""
    return dynamics.integrated(
        lambda x: derivative(p, x, demand, perimeter, splits), x, step, **scheme
    )
