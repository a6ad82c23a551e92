"""How alike the densities within regions are, and how unlike those of neighbours: two numbers to compare partitions by.

Y. Ji and N. Geroliminis, "On the spatial partitioning of urban transportation networks", Transportation Research Part
B 46 (2012). With d_i the density of link i, every link counting once, and N_A links, mean m_A and variance var_A (over
N_A) of the densities in region A:

    NSN(A, B) = sum over i in A, j in B of (d_i - d_j)^2 / (N_A N_B) = var_A + var_B + (m_A - m_B)^2
    NS(A)     = NSN(A, A) / NSN(A, X),  X the neighbour of A with the smallest NSN(A, X)
    NS        = mean of NS(A) over the regions                                   (NcutSilhouette)
    TV_n      = sum over A of N_A var_A / (N var of all links)                   (normalised total variance)

Below 1, NS(A) tells that the links of A are more like each other than like those of the most similar neighbour. TV_n
is what is left of the variance, from 0 to 1; it falls as regions are added, NS need not. Of both less is better.
"""

import numpy as np
from jaxtyping import Float

from cosim.sumo.arrays import EdgeNumbers, PerEdge
from nmfd.arrays import Adjacency, PerRegion


def dissimilarity(one: Float[np.ndarray, " N"], other: Float[np.ndarray, " M"]) -> float:
    """NSN of two regions, from the densities of their links; in the square of their unit."""
    return float(one.var() + other.var() + (one.mean() - other.mean()) ** 2)


def ncut_silhouettes(density: PerEdge, regions: EdgeNumbers, neighbours: Adjacency) -> PerRegion:
    """(R,) NS of every region [-]; 1 where it and its neighbour have one and the same density, NaN without links or
    neighbours. density, regions: (E,) of the links that count; neighbours: (R, R) symmetric."""
    links = [density[regions == region] for region in range(len(neighbours))]
    found = np.full(len(links), np.nan)
    for region, own in enumerate(links):
        beside = [dissimilarity(own, links[other]) for other in np.flatnonzero(neighbours[region]) if len(links[other])]
        if len(own) and beside:
            found[region] = dissimilarity(own, own) / min(beside) if min(beside) > 0 else 1.0
    return found


def variance_shares(density: PerEdge, regions: EdgeNumbers, count: int) -> PerRegion:
    """(count,) the part of every region in TV_n [-], whose sum that is; NaN where all densities are alike.
    density, regions: (E,) of the links that count."""
    total = len(density) * float(density.var())
    links = [density[regions == region] for region in range(count)]
    within = np.array([len(own) * own.var() if len(own) else 0.0 for own in links])
    return within / total if total > 0 else np.full(count, np.nan)
