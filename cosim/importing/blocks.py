"""Blocks: the pieces that a partition is made of, and the graph of which piece is next to which.

A street, both directions, is one block, and so is a roundabout: no boundary should run along the middle of either.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cosim.importing.layers import sampled
from cosim.importing.streets import Streets
from cosim.sumo.arrays import PerEdge

ASIDE = 30.0  # m between the carriageways of one street, at most
OPPOSED = -0.9  # cosine of the angle between their directions, at most
LARGEST = 0.02  # of the network: no block grows beyond by joining carriageways


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """B blocks of the main part of a network.

    of: (E,) block of an edge, -1 outside the main part
    weight: (B,) lane metres; core: (B,) those of edges from which each other such edge can be reached; a region without
        any is a way in or out of the city, from or to which nobody can come back; position: (B, 2) [m]
    near: (B, B) symmetric, the distance [m] between the middles of two blocks that traffic joins
    joins: (B, B) symmetric, how many connections join them
    """

    of: Int[np.ndarray, " E"]
    weight: Float[np.ndarray, " B"]
    core: Float[np.ndarray, " B"]
    position: Float[np.ndarray, "B 2"]
    near: csr_array
    joins: csr_array

    def mean(self, value: PerEdge, weight: PerEdge) -> Float[np.ndarray, " B"]:
        """(B,): the mean of `value` (E,) over the edges of each block, by `weight` (E,)."""
        inside = self.of >= 0
        total = np.bincount(self.of[inside], (value * weight)[inside], len(self.weight))
        return total / np.maximum(np.bincount(self.of[inside], weight[inside], len(self.weight)), 1e-9)


def make_blocks(streets: Streets) -> Blocks:
    """The blocks of the largest part of the network that cars can drive."""
    size, inside = len(streets.edges), streets.main_part
    pairs = [
        _opposite(streets),
        *(np.array([(ring[0], n) for n in ring[1:]]).reshape(-1, 2) for ring in streets.roundabouts),
    ]
    pairs = np.concatenate([p.reshape(-1, 2) for p in pairs]).astype(int)
    pairs = pairs[inside[pairs].all(axis=1)]
    same = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    _, label = connected_components(same, directed=False)
    label = _carriageways(streets, label)
    _, number = np.unique(label[inside], return_inverse=True)
    of = np.full(size, -1)
    of[inside] = number
    count = number.max() + 1
    weight = np.bincount(number, streets.lane_metres[inside], count)
    position = np.stack(
        [
            np.bincount(number, (streets.centre[:, axis] * streets.lane_metres)[inside], count) / weight
            for axis in (0, 1)
        ],
        axis=1,
    )
    ends = of[streets.links[inside[streets.links].all(axis=1)]]
    ends = ends[ends[:, 0] != ends[:, 1]]
    both = np.concatenate([ends, ends[:, ::-1]])
    joins = coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    joins.sum_duplicates()
    near = joins.tocoo()
    apart = np.hypot(*(position[near.row] - position[near.col]).T)
    near = csr_array((np.maximum(apart, 1.0), (near.row, near.col)), shape=(count, count))
    core = np.bincount(number, (streets.lane_metres * streets.core)[inside], count)
    return Blocks(of=of, weight=weight, core=core, position=position, near=near, joins=joins)


def _carriageways(streets: Streets, label: np.ndarray) -> np.ndarray:
    """Join the two sides of divided roads: an edge and the one that runs the other way beside most of it."""
    points, of = sampled(streets.shapes, streets.main_part)
    first = np.searchsorted(of, of, side="left")
    last = np.searchsorted(of, of, side="right") - 1
    place = np.arange(len(of))
    heading = points[np.minimum(place + 1, last)] - points[np.maximum(place - 1, first)]
    heading /= np.maximum(np.hypot(*heading.T), 1e-9)[:, None]
    pairs = cKDTree(points).query_pairs(ASIDE, output_type="ndarray")
    pairs = pairs[(heading[pairs[:, 0]] * heading[pairs[:, 1]]).sum(axis=1) < OPPOSED]
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    beside = np.unique(np.column_stack([pairs[:, 0], of[pairs[:, 1]]]), axis=0)  # every point once per other edge
    edges, votes = np.unique(np.column_stack([of[beside[:, 0]], beside[:, 1]]), axis=0, return_counts=True)
    count = np.bincount(of, minlength=len(label))
    edges = edges[votes > 0.5 * count[edges[:, 0]]]
    size, limit = np.bincount(label, streets.lane_metres), LARGEST * streets.lane_metres.sum()
    label = label.copy()
    group: dict[int, list[int]] = {}
    for n, name in enumerate(label):
        group.setdefault(int(name), []).append(n)
    for a, b in edges:
        one, other = int(label[a]), int(label[b])
        if one != other and size[one] + size[other] <= limit:
            group[one] += group.pop(other)
            label[group[one]] = one
            size[one] += size[other]
    return label


def _opposite(streets: Streets) -> np.ndarray:
    """(n, 2): pairs of edges between the same two junctions in opposite directions, one each."""
    waiting: dict[tuple[int, int], list[int]] = {}
    found = []
    for n, (begin, end) in enumerate(streets.junctions):
        if waiting.get((end, begin)):
            found.append((waiting[end, begin].pop(0), n))
        else:
            waiting.setdefault((begin, end), []).append(n)
    return np.array(found, dtype=int).reshape(-1, 2)
