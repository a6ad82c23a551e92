"""Demand that differs from what was planned for: Gaussian noise on the spawn matrix, clipped at zero."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from nmfd.arrays import PairsOverTime
from nmfd.model.scenario import Scenario

# Which entries d_ij(k) of the spawn matrix are perturbed. Clipping lets only the positive half of the noise through
# where nothing was planned, so that "pairs" and "all" add demand: 0.4 sigma veh/s per pair, from start to end.
WHERE = {
    "planned": "pairs of regions with demand, while it lasts: about as many vehicles as planned",
    "pairs": "pairs of regions with demand, all the time: more vehicles than planned",
    "all": "every pair of regions, all the time: many times the planned vehicles",
}


def entries(demand: PairsOverTime, where: str) -> Bool[np.ndarray, "T R R"]:
    """(T, R, R) bool: the entries of `demand` (T, R, R) that `where`, a key of WHERE, perturbs."""
    if where == "planned":
        return demand > 0
    if where == "pairs":
        return np.broadcast_to((demand > 0).any(axis=0), demand.shape)
    return np.ones(demand.shape, dtype=bool)


def perturbed(scenario: Scenario, sigma: float, seed: int, *, where: str) -> Scenario:
    """`scenario` with max(0, d_ij(k) + sigma n_ij(k)) [veh/s], n standard normal and independent, drawn from `seed`.

    The same seed gives the same n for every sigma, so that the steps of sigma are compared on common noise.
    """
    noise = np.random.default_rng([seed, 0x64656D]).standard_normal(scenario.demand.shape)
    noise *= entries(scenario.demand, where)
    return replace(scenario, demand=np.maximum(scenario.demand + sigma * noise, 0.0))
