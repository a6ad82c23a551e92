"""Agglomerative clustering of blocks on their densities: Ward's criterion, but only neighbours merge.

The aims are those of Ji and Geroliminis, "On the spatial partitioning of urban transportation networks": regions
homogeneous in density, and compact. Single links are bimodal, so that densities are averaged over the neighbourhood
first; the place counts too, or regions would be threads along the congested roads.
"""

import heapq

import numpy as np
from jaxtyping import Float, Int

from cosim.importing.blocks import Blocks

SMOOTHING = 2  # rounds of averaging with the neighbours
PLACE = 1.0  # weight of the place against the density, both with variance 1 over the city
HIGHEST = 0.15  # veh/m; denser is as dense
SMALLEST = 0.4  # of the mean size, of Blocks.core: a cluster below is none of the regions that were asked for


def features(blocks: Blocks, density: Float[np.ndarray, " B"]) -> Float[np.ndarray, "B 3"]:
    """(B, 3): density of the neighbourhood, and place, each with variance 1 over the lanes of the city."""
    weight, joins = blocks.weight, (blocks.joins > 0).astype(float)
    smooth = np.minimum(density, HIGHEST)
    for _ in range(SMOOTHING):
        smooth = (smooth * weight + joins @ (smooth * weight)) / (weight + joins @ weight)
    place = blocks.position - np.average(blocks.position, axis=0, weights=weight)
    radius = np.sqrt(np.average((place**2).sum(axis=1), weights=weight))
    spread = np.sqrt(np.average((smooth - np.average(smooth, weights=weight)) ** 2, weights=weight))
    return np.column_stack([smooth / max(spread, 1e-9), PLACE * place / max(radius, 1e-9)])


def agglomerate(blocks: Blocks, feature: Float[np.ndarray, "B F"], regions: int) -> Int[np.ndarray, " B"]:
    """(B,) region of every block, 0 to regions - 1 (fewer where there are not enough blocks of a size)."""
    merges = _merges(blocks, feature)
    least = SMALLEST * float(blocks.core.sum()) / regions
    sizes = dict(enumerate(blocks.core.tolist()))  # plain floats: two numpy booleans add up to one
    history = []  # after n merges: how many clusters are large enough
    large = sum(size >= least for size in sizes.values())
    history.append(large)
    for a, b, new in merges:
        large -= (sizes[a] >= least) + (sizes[b] >= least)
        sizes[new] = sizes.pop(a) + sizes.pop(b)
        large += sizes[new] >= least
        history.append(large)
    enough = [n for n, count in enumerate(history) if count == regions]
    done = enough[-1] if enough else len(merges) - min(regions - 1, len(merges))
    parent = list(range(len(blocks.weight) + len(merges)))
    for a, b, new in merges[:done]:
        parent[a] = parent[b] = new
    labels = np.array([_root(parent, n) for n in range(len(blocks.weight))])
    return _without_tiny(blocks, feature, labels, regions)


def _merges(blocks: Blocks, feature: np.ndarray) -> list[tuple[int, int, int]]:
    """All merges (cluster, cluster, new cluster), the cheapest first."""
    count = len(blocks.weight)
    weight, mean = list(blocks.weight), [row for row in feature]
    near: dict[int, set[int]] = {  # of every cluster that is not part of a larger one yet
        n: set(blocks.joins.indices[blocks.joins.indptr[n] : blocks.joins.indptr[n + 1]].tolist()) for n in range(count)
    }

    def cost(a: int, b: int) -> float:
        gap = mean[a] - mean[b]
        return weight[a] * weight[b] / (weight[a] + weight[b]) * float(gap @ gap)

    heap = [(cost(a, b), a, b) for a in range(count) for b in near[a] if a < b]
    heapq.heapify(heap)
    merges = []
    while heap:
        _, a, b = heapq.heappop(heap)
        if a not in near or b not in near:
            continue
        new, total = len(weight), weight[a] + weight[b]
        merges.append((a, b, new))
        mean.append((weight[a] * mean[a] + weight[b] * mean[b]) / total)
        weight.append(total)
        near[new] = around = (near.pop(a) | near.pop(b)) - {a, b}
        for other in sorted(around):
            near[other] = (near[other] - {a, b}) | {new}
            heapq.heappush(heap, (cost(other, new), other, new))
    return merges


def _root(parent: list[int], n: int) -> int:
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


def _without_tiny(blocks: Blocks, feature: np.ndarray, labels: np.ndarray, regions: int) -> np.ndarray:
    """The smallest cluster goes to its most similar neighbour until `regions` are left."""
    _, labels = np.unique(labels, return_inverse=True)
    joins = blocks.joins.tocoo()
    while labels.max() + 1 > regions:
        sizes = np.bincount(labels, blocks.weight)
        smallest = int(np.argmin(np.bincount(labels, blocks.core)))
        mean = np.array([np.bincount(labels, blocks.weight * axis) / sizes for axis in feature.T]).T
        beyond = np.unique(labels[joins.col[labels[joins.row] == smallest]])
        beyond = beyond[beyond != smallest]
        if not len(beyond):
            break
        target = beyond[((mean[beyond] - mean[smallest]) ** 2).sum(axis=1).argmin()]
        labels = np.where(labels == smallest, target, labels)
        _, labels = np.unique(labels, return_inverse=True)
    return labels
