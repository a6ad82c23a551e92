"""Economic MPC by IPOPT on the published formulation: the reference of the projected-gradient solver.

Multiple shooting on the CasADi twin of the regional model (nmfd.model.dynamics_casadi): every x_ij, u_ih and theta_ihj
of every interval is a variable and the dynamics are constraints. Two orders of magnitude slower.
"""

from collections.abc import Mapping

import casadi as ca
import numpy as np

from nmfd.arrays import PairsOverTime, PerPair, TurnsOverTime
from nmfd.model import dynamics_casadi as model
from nmfd.model.planning import PlanningModel

UNIT = 1000.0  # veh, unit of the accumulations in the solver


class Ipopt:
    """Solver that minimises the vehicles summed over the ends of `horizon` intervals."""

    def __init__(self, planning: PlanningModel, *, guidance: bool, horizon: int, limits: Mapping[str, float]):
        """limits: options of IPOPT, such as max_iter and max_wall_time (s)"""
        network = planning.network
        self._network, self._horizon, self._guidance = network, horizon, guidance
        self._edges, self._turns = np.argwhere(network.adjacency), np.argwhere(network.split_mask & guidance)
        regions, p = network.regions, model.parameters(network)
        self.shape = regions, regions
        start, demand = ca.SX.sym("start", regions, regions), ca.SX.sym("demand", regions, regions * horizon)
        variables, constraints, total, x = [], [], 0.0, start
        for k in range(horizon):
            u, theta = ca.SX.sym(f"u{k}", len(self._edges)), ca.SX.sym(f"theta{k}", len(self._turns))
            splits, sums = self._splits(theta)
            perimeter = ca.SX(regions, regions)
            for n, (i, h) in enumerate(self._edges.tolist()):
                perimeter[i, h] = u[n]
            after = ca.SX.sym(f"x{k}", regions, regions)
            flows = demand[:, k * regions : (k + 1) * regions], perimeter, splits
            moved = model.advance(p, UNIT * x, *flows, **planning.scheme)
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

    def solve(self, state: PerPair, demand: PairsOverTime) -> tuple[PairsOverTime, TurnsOverTime, str | None]:
        """Return u (-, (H, R, R)), theta (-, (H, R, R, R)), and the reason if IPOPT did not converge, else None.

        state: (veh, (R, R)); demand: (veh/s, (H, R, R))
        """
        network, regions, horizon = self._network, self._network.regions, self._horizon
        edges, turns, x = self._edges, self._turns, state.T.ravel() / UNIT
        guess = np.concatenate([np.full(len(edges), network.u_max), network.nominal_splits[tuple(turns.T)], x])
        given = np.concatenate([x, *(d.T.ravel() for d in demand)])
        bounds = {"lbx": self._lower, "ubx": self._upper, "lbg": 0.0, "ubg": 0.0}
        answer = self._solver(x0=np.tile(guess, horizon), p=given, **bounds)["x"].full().reshape(horizon, -1)
        stats = self._solver.stats()
        perimeter, splits = np.zeros((horizon, regions, regions)), np.tile(network.nominal_splits, (horizon, 1, 1, 1))
        perimeter[:, edges[:, 0], edges[:, 1]] = answer[:, : len(edges)]
        splits[:, turns[:, 0], turns[:, 1], turns[:, 2]] = answer[:, len(edges) : len(edges) + len(turns)]
        return perimeter, splits, None if stats["success"] else f"IPOPT: {stats['return_status']}"

    def _splits(self, theta: ca.SX) -> tuple[list[ca.SX], list[ca.SX]]:
        """Return R matrices (R, R), and the constraints that are 0 if their shares have sum 1."""
        regions = self._network.regions
        if not self._guidance:
            return [ca.SX(ca.sparsify(ca.DM(rows))) for rows in self._network.nominal_splits], []
        splits = [ca.SX(regions, regions) for _ in range(regions)]
        for n, (i, h, j) in enumerate(self._turns.tolist()):
            splits[i][h, j] = theta[n]
        return splits, [ca.sum1(splits[i][:, j]) - 1.0 for i in range(regions) for j in range(regions) if i != j]
