"""Moving single blocks over the boundaries of a partition, where that makes it better.

    cost = variance of the features within the regions (of 1 in all per feature, by lane metres)
           + CUT     * price of the boundary / that at the beginning
           + BALANCE * mean of (size / mean size - 1)^2

The price of a boundary is that of the connections over it: one that a fixed-time signal controls is cheap, one that
much traffic takes without any is dear. That makes boundaries short, and puts them where perimeter control has a say.
Blocks move one by one, and end in the nearest optimum: the best of several starts is taken.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array

from cosim.importing.baseline import Baseline
from cosim.importing.blocks import Blocks
from cosim.importing.streets import Streets

CUT, BALANCE = 0.5, 0.5
CONTROLLED, DEAREST = 0.25, 5.0  # price of a controlled connection, and the most for one that is not (usually 1 to 2)
PASSES = 12


def prices(
    streets: Streets, blocks: Blocks, controlled: Bool[np.ndarray, " L"], baseline: Baseline | None
) -> csr_array:
    """(B, B) symmetric: the price of a boundary between two blocks. controlled: (L,) bool, of streets.links."""
    price = np.ones(len(streets.links))
    if baseline is not None:
        moves = baseline.moves()
        flow = np.array([moves[int(a), int(b)] for a, b in streets.links], dtype=float)
        price = np.minimum(price + flow / max(flow.mean(), 1e-9), DEAREST)
    price = np.where(controlled, CONTROLLED, price)
    ends = blocks.of[streets.links]
    keep = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])
    rows, columns, price = ends[keep, 0], ends[keep, 1], price[keep]
    both = np.r_[rows, columns], np.r_[columns, rows]
    return coo_array((np.tile(price, 2), both), shape=(len(blocks.weight),) * 2).tocsr()


def refine(
    blocks: Blocks, labels: Int[np.ndarray, " B"], feature: Float[np.ndarray, "B F"], price: csr_array
) -> Int[np.ndarray, " B"]:
    """(B,) better labels; no region is lost or torn apart. feature: (B, F), each with variance 1 over the city."""
    state = _State(blocks, labels, feature, price)
    for _ in range(PASSES):
        moved = 0
        for block in range(len(labels)):
            moved += state.improve(block)
        if not moved:
            break
    return state.labels


def cut(labels: Int[np.ndarray, " B"], price: csr_array) -> float:
    """The price of the boundaries between the regions."""
    pairs = price.tocoo()
    return float(pairs.data[labels[pairs.row] != labels[pairs.col]].sum()) / 2


def best(
    blocks: Blocks, starts: Sequence[Int[np.ndarray, " B"]], feature: Float[np.ndarray, "B F"], price: csr_array
) -> Int[np.ndarray, " B"]:
    """(B,) the labels of least cost among the refined `starts`, of those that have the most regions. The price of
    boundaries is over that of the first start for all of them."""
    scale, weight = max(cut(starts[0], price), 1e-9), blocks.weight / blocks.weight.sum()

    def cost(labels: np.ndarray) -> tuple[int, float]:
        regions = int(labels.max()) + 1
        size = np.bincount(labels, weight, regions)
        total = np.stack([np.bincount(labels, weight * axis, regions) for axis in feature.T], axis=1)
        between = ((total**2).sum(axis=1) / np.maximum(size, 1e-12)).sum()
        balance = ((size * regions - 1.0) ** 2).mean()
        return -regions, CUT * cut(labels, price) / scale + BALANCE * balance - between

    return min((refine(blocks, labels, feature, price) for labels in starts), key=cost)


class _State:
    """Labels with the sums that make the gain of a move cheap."""

    def __init__(self, blocks: Blocks, labels: np.ndarray, feature: np.ndarray, price: csr_array):
        self.labels, self._weight = labels.copy(), blocks.weight / blocks.weight.sum()
        self._feature, self._price = feature, price
        regions = int(labels.max()) + 1
        self._size = np.bincount(labels, self._weight, regions)
        self._sum = np.stack([np.bincount(labels, self._weight * axis, regions) for axis in feature.T], axis=1)
        self._count = np.bincount(labels, minlength=regions)
        self._scale = CUT / max(cut(labels, price), 1e-9)

    def improve(self, block: int) -> bool:
        """Move the block to the neighbouring region that gains most, if any does."""
        here = int(self.labels[block])
        span = slice(self._price.indptr[block], self._price.indptr[block + 1])
        around, price = self._price.indices[span], self._price.data[span]
        regions = self.labels[around]
        options = np.unique(regions[regions != here])
        if not len(options) or self._count[here] == 1:
            return False
        staying = price[regions == here].sum()
        best, target = 1e-9, None
        for region in options:
            gain = self._scale * (price[regions == region].sum() - staying)
            gain += self._spread_gain(block, here, region) + self._balance_gain(block, here, region)
            if gain > best:
                best, target = gain, int(region)
        if target is None or self._tears(block, here, around[regions == here]):
            return False
        self.labels[block] = target
        for region, sign in ((here, -1.0), (target, 1.0)):
            self._size[region] += sign * self._weight[block]
            self._sum[region] += sign * self._weight[block] * self._feature[block]
            self._count[region] += int(sign)
        return True

    def _spread_gain(self, block: int, here: int, region: int) -> float:
        """What the variance within loses: it is the total minus sum over regions of |sum|^2 / size."""
        weight, part = self._weight[block], self._weight[block] * self._feature[block]

        def between(total: np.ndarray, size: float) -> float:
            return float(total @ total) / max(size, 1e-12)

        before = between(self._sum[here], self._size[here]) + between(self._sum[region], self._size[region])
        after = between(self._sum[here] - part, self._size[here] - weight)
        return after + between(self._sum[region] + part, self._size[region] + weight) - before

    def _balance_gain(self, block: int, here: int, region: int) -> float:
        count, weight = len(self._size), self._weight[block]
        now, then = np.array([self._size[here], self._size[region]]) * count - 1.0, weight * count
        return BALANCE / count * float((now**2).sum() - (now[0] - then) ** 2 - (now[1] + then) ** 2)

    def _tears(self, block: int, here: int, around: np.ndarray) -> bool:
        """Whether the region falls apart without the block: its neighbours there must find each other."""
        wanted = set(around.tolist())
        if len(wanted) <= 1:
            return False
        start = wanted.pop()
        seen, queue = {block, start}, [start]
        while queue and wanted:
            n = queue.pop()
            for other in self._price.indices[self._price.indptr[n] : self._price.indptr[n + 1]].tolist():
                if other not in seen and self.labels[other] == here:
                    seen.add(other)
                    wanted.discard(other)
                    queue.append(other)
        return bool(wanted)
