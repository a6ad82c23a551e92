"""What the fast paths are measured against: the same decisions, written down as plainly as they are
published."""

from collections.abc import Callable

import numpy as np
import torch

from nmfd.controllers.dpc.policy import Policy
from nmfd.model.regional_model import RegionalModel


def dpc(policy: Policy) -> Callable:
    """A policy called as in training, gradients and all, its outputs checked and normalised pair by
    pair."""

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


def euler(
    network: RegionalModel,
    x: np.ndarray,
    demand: np.ndarray,
    u: np.ndarray,
    theta: np.ndarray,
    step: float,
):
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
