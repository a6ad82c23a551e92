"""What the fast paths are measured against: the same decisions, written down as plainly as they are published."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import torch

from nmfd.controllers.dpc.policy import Policy
from nmfd.model import dynamics_casadi as model
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario


def mpc(scenario: Scenario, *, guidance: bool, horizon: int = 8) -> Callable:
    """Economic MPC by IPOPT with MUMPS on the plain formulation: multiple shooting, every x_ij a variable.

    Returns a function of the state (R, R) [veh] and the demand (horizon, R, R) [veh/s] that gives u (horizon, R, R),
    theta (horizon, R, R, R), and whether IPOPT has converged. Accumulations are in 1000 veh, so that it has a fair
    chance.
    """
    network, unit = scenario.network, 1000.0
    regions, p = network.regions, model.parameters(scenario.network)
    edges, turns = np.argwhere(network.adjacency), np.argwhere(network.split_mask & guidance)
    start, demand = ca.SX.sym("start", regions, regions), ca.SX.sym("demand", regions, regions * horizon)
    variables, lower, upper, constraints, total, x = [], [], [], [], 0.0, start
    for k in range(horizon):
        u, theta = ca.SX.sym(f"u{k}", len(edges)), ca.SX.sym(f"theta{k}", len(turns))
        perimeter = ca.SX(regions, regions)
        for n, (i, h) in enumerate(edges.tolist()):
            perimeter[i, h] = u[n]
        splits = [ca.SX(rows) for rows in model.splits_list(network.nominal_splits)]
        if guidance:
            splits = [ca.SX(regions, regions) for _ in range(regions)]
            for n, (i, h, j) in enumerate(turns.tolist()):
                splits[i][h, j] = theta[n]
            for i in range(regions):
                for j in range(regions):
                    if i != j:
                        constraints.append(ca.sum1(splits[i][:, j]) - 1.0)
        after = ca.SX.sym(f"x{k}", regions, regions)
        moved = model.advance(
            p, unit * x, demand[:, k * regions:(k + 1) * regions], perimeter, splits, scenario.step,
            integrator=scenario.integrator, substeps=scenario.substeps)
        constraints.append(ca.vec(ca.densify(moved) / unit - after))
        total, x = total + ca.sum1(ca.vec(after)), after
        variables += [u, theta, ca.vec(after)]
        lower += [network.u_min] * len(edges) + [0.0] * (len(turns) + regions**2)
        upper += [network.u_max] * len(edges) + [1.0] * len(turns) + [np.inf] * regions**2
    solver = ca.nlpsol("plain", "ipopt", {
        "x": ca.vertcat(*variables), "p": ca.vertcat(ca.vec(start), ca.vec(demand)), "f": total,
        "g": ca.vertcat(*constraints)}, {
            "print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 200}})

    def decide(state: np.ndarray, forecast: np.ndarray):
        guess = np.concatenate([
            np.full(len(edges), network.u_max), network.nominal_splits[tuple(turns.T)], state.T.ravel() / unit])
        answer = solver(
            x0=np.tile(guess, horizon), p=np.concatenate([state.T.ravel() / unit, *(d.T.ravel() for d in forecast)]),
            lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)["x"].full().reshape(horizon, -1)
        perimeter, splits = np.zeros((horizon, regions, regions)), np.tile(network.nominal_splits, (horizon, 1, 1, 1))
        perimeter[:, edges[:, 0], edges[:, 1]] = answer[:, :len(edges)]
        if guidance:
            splits[:, turns[:, 0], turns[:, 1], turns[:, 2]] = answer[:, len(edges):len(edges) + len(turns)]
        return perimeter, splits, solver.stats()["success"]

    return decide


def dpc(policy: Policy) -> Callable:
    """A policy called as in training, gradients and all, its outputs checked and normalised pair by pair."""

    def decide(accumulation: np.ndarray):
        perimeter, splits = policy(torch.tensor(accumulation, dtype=torch.float32))
        perimeter = perimeter.detach().numpy().astype(float)
        if splits is None:
            return perimeter, None
        splits = splits.detach().numpy().astype(float)
        regions = len(accumulation)
        for i in range(regions):
            for j in range(regions):
                if splits[i, :, j].sum() > 0:
                    splits[i, :, j] /= splits[i, :, j].sum()
        return perimeter, splits

    return decide


def euler(network: RegionalModel, x: np.ndarray, demand: np.ndarray, u: np.ndarray, theta: np.ndarray, step: float):
    """x (R, R) [veh] after `step` [s], from the equations of nmfd.model.dynamics, term by term."""
    regions, neighbours = network.regions, [np.flatnonzero(row) for row in network.adjacency]
    q = [float(mfd.rate(x[i].sum())) for i, mfd in enumerate(network.mfds)]
    change = demand.copy()
    for i in range(regions):
        for j in range(regions):
            if i == j:
                change[i, i] -= q[i] * x[i, i]
                continue
            for h in neighbours[i]:
                moved = u[i, h] * theta[i, h, j] * q[i] * x[i, j]
                change[i, j] -= moved
                change[h, j] += moved
    return x + step * change
