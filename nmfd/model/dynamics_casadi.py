"""The regional model in CasADi: the twin of `dynamics`, for optimisation by IPOPT.

The same names and equations on SX, MX or DM matrices, without a batch: x (R, R) [veh], [i, j] in region i bound for j;
demand (R, R) [veh/s]; perimeter (R, R) [-], [i, h]; splits: a sequence of R matrices (R, R) [-], splits[i][h, j].
Structural zeros of x, perimeter and splits are kept.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, TypeAlias

import casadi as ca

from nmfd.model import dynamics
from nmfd.model.regional_model import LEAST_LIMIT, LEAST_ROOM, SHARPNESS, RegionalModel

Matrix: TypeAlias = ca.SX | ca.MX | ca.DM
Turns: TypeAlias = Sequence[Matrix]  # R of them
Parameters: TypeAlias = SimpleNamespace


def parameters(network: RegionalModel) -> Parameters:
    """Return `dynamics.parameters` as constants: vectors (R, 1), but storage (1, R); adjacency 1 or structural zero."""
    known = vars(dynamics.parameters(network)).items()
    p = Parameters(**{name: None if values is None else ca.DM(values.numpy()) for name, values in known})
    p.adjacency, p.storage = ca.sparsify(p.adjacency), None if p.storage is None else p.storage.T
    return p


def rate(p: Parameters, accumulation: Matrix) -> Matrix:
    """Return q_i = g_i(min(x_i, jam_i)) / x_i (R, 1) [1/s] of accumulation (R, 1) [veh]."""
    body = ca.fmin(accumulation, p.jam)
    return ((p.a * body + p.b) * body + p.c) * p.jam / (accumulation + p.jam - body)


def flows(p: Parameters, x: Matrix, perimeter: Matrix, splits: Turns) -> tuple[Matrix, list[Matrix]]:
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
    return completions, [ca.repmat(open_share[i, :].T, 1, regions) * transfer for i, transfer in enumerate(transfers)]


def passing(p: Parameters, wish: Matrix, perimeter: Matrix, accumulation: Matrix) -> Matrix:
    """Return the share (R, R) [-] of the desired flow `wish` (R, R) [veh/s] that passes each boundary."""
    room = ca.fmax(1.0 - accumulation.T / p.storage, LEAST_ROOM)
    limit = perimeter * p.capacity * ca.repmat(room, wish.shape[0], 1)
    return (1.0 + (wish / (limit + LEAST_LIMIT)) ** SHARPNESS) ** (-1.0 / SHARPNESS)


def derivative(p: Parameters, x: Matrix, demand: Matrix, perimeter: Matrix, splits: Turns) -> Matrix:
    """Return dx_ij/dt (R, R) [veh/s]."""
    completions, transfers = flows(p, x, perimeter, splits)
    leaving = ca.vertcat(*(ca.sum1(transfer) for transfer in transfers))
    entering = sum(transfers[1:], transfers[0])
    return demand - ca.diag(completions) - leaving + entering


def advance(
    p: Parameters, x: Matrix, demand: Matrix, perimeter: Matrix, splits: Turns, step: float, **scheme: Any
) -> Matrix:
    """Return x after one control interval of `step` [s] under constant inputs; scheme: see `dynamics.integrated`."""
    return dynamics.integrated(lambda x: derivative(p, x, demand, perimeter, splits), x, step, **scheme)
