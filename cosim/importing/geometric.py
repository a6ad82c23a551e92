"""k-means on the road graph: every block belongs to the centre that is nearest by road, with a handicap for centres
of regions that are too large. Such regions are connected, compact and of similar size."""

from dataclasses import replace

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from cosim.importing.blocks import Blocks

ROUNDS = 40
GAIN = 0.3  # of the handicap's growth per round, in mean radii
THINNEST = 0.05  # width over length that a city counts with at least: one along a straight road has no area


def k_means(blocks: Blocks, regions: int, seed: int) -> Int[np.ndarray, " B"]:
    """(B,) region of every block, 0 to regions - 1. The best of all rounds: sizes alike first, then compact."""
    random = np.random.default_rng([seed, 0x6B6D])
    blocks = replace(blocks, weight=blocks.core + 0.1 * blocks.weight)  # ways in and out make no region
    centres = _start(blocks, regions, random)
    extent = np.ptp(blocks.position, axis=0)
    radius = np.sqrt(np.maximum(extent, max(THINNEST * extent.max(), 1.0)).prod() / regions) / 2
    handicap, share = np.zeros(regions), blocks.weight.sum() / regions
    best, least = None, np.inf
    for _ in range(ROUNDS):
        labels, distance = _nearest(blocks, centres, handicap)
        sizes = np.bincount(labels, blocks.weight, regions)
        spread = float(np.average((distance / radius) ** 2, weights=blocks.weight))
        cost = spread + 2.0 * float(((sizes / share - 1.0) ** 2).mean())
        if cost < least - 1e-9:
            best, least = labels, cost
        handicap += GAIN * radius * np.clip(sizes / share - 1.0, -1.0, 1.0)
        handicap -= handicap.min()
        centres = [_middle(blocks, labels == n) if (labels == n).any() else centre for n, centre in enumerate(centres)]
    return best


def _start(blocks: Blocks, regions: int, random: np.random.Generator) -> list[int]:
    """k-means++: blocks far from each other."""
    centres = [int(random.choice(len(blocks.weight), p=blocks.weight / blocks.weight.sum()))]
    while len(centres) < regions:
        apart = ((blocks.position[:, None] - blocks.position[centres]) ** 2).sum(-1).min(axis=1)
        apart[centres] = 0.0
        odds = blocks.weight * apart
        if odds.sum() <= 0:
            odds = np.ones(len(apart))
            odds[centres] = 0.0
        centres.append(int(random.choice(len(odds), p=odds / odds.sum())))
    return centres


def _nearest(blocks: Blocks, centres: list[int], handicap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B,) region and (B,) distance [m] by road to the centre of each block; a centre stays its own."""
    size, regions = len(blocks.weight), len(centres)
    near = blocks.near.tocoo()
    # A node of its own stands for every region, `handicap` away from its centre and from nothing else.
    rows = np.concatenate([near.row, size + np.arange(regions)])
    columns = np.concatenate([near.col, centres])
    lengths = np.concatenate([near.data, handicap + 1e-3])
    graph = coo_array((lengths, (rows, columns)), shape=(size + regions,) * 2).tocsr()
    distance, _, source = dijkstra(
        csr_array(graph), indices=size + np.arange(regions), min_only=True, return_predecessors=True
    )
    labels = source[:size] - size
    return labels, distance[:size] - handicap[labels]


def _middle(blocks: Blocks, inside: np.ndarray) -> int:
    """The block nearest to the centre of gravity of a region."""
    members = np.flatnonzero(inside)
    middle = np.average(blocks.position[members], axis=0, weights=blocks.weight[members])
    return int(members[((blocks.position[members] - middle) ** 2).sum(axis=1).argmin()])
