"""Regions of similar density by Ward's criterion, or the user's own.

The aims are those of Ji and Geroliminis, "On the spatial partitioning of urban transportation
networks" (2012): regions that are homogeneous in density, connected and compact. Perimeter control
needs more: boundaries at signals. So streets that much traffic joins without a controllable signal
merge first. In the end every region is connected and can be reached from each other, and every edge
is in one (`finish`). Regions of the user's own may be in several pieces.
"""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cosim.importing.baseline import Baseline
from cosim.importing.streets import Streets, graph
from cosim.sumo.arrays import EdgeNumbers, PerEdge
from cosim.sumo.net import read_regions
from nmfd.arrays import Positions
from nmfd.errors import InputError

SMOOTHING_ROUNDS = 2  # of averaging densities with the neighbours
HIGHEST_DENSITY = 0.15  # veh/m of lane; denser counts as this dense
# Of the mean region, up to which streets merge over connections without a signal.
UNSIGNALLED_SHARE = 0.3
SMALLEST_SHARE = 0.4  # of the mean region, in lane metres of the core: smaller clusters dissolve
DIRECTIONS = (
    "east",
    "north-east",
    "north",
    "north-west",
    "west",
    "south-west",
    "south",
    "south-east",
)
CENTRAL_SHARE = 0.35  # of the city's radius, within which a region is the centre
MAX_EXTRA_CLUSTERS = 20  # beyond the requested number, among which enough large ones are searched
PerBlock = Float[np.ndarray, " B"]


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """B pieces of the main part of a network that no boundary divides.

    They are streets with both directions, and roundabouts.
    of: (E,) block of an edge, -1 outside the main part
    weight: (B,) lane metres; core: (B,) those of edges of the strongly connected core
    position: (B, 2) [m]
    joins: (B, B) symmetric, number of connections between two blocks
    """

    of: EdgeNumbers
    weight: PerBlock
    core: PerBlock
    position: Float[np.ndarray, "B 2"]
    joins: csr_array


def own_regions(streets: Streets, path: Path) -> EdgeNumbers:
    """Read the region of every edge from a table edge,region.

    Edges that it does not name have -1.
    Raises: InputError
    """
    given = read_regions(path)
    unknown = given.keys() - streets.number.keys()
    if unknown:
        raise InputError(
            f"{path}: edge {min(unknown)} is not in {streets.path}; remove it or give its network"
        )
    labels = np.array([given.get(edge, -1) for edge in streets.edges])
    used = np.unique(labels[streets.drivable & (labels >= 0)])
    if len(used) < 2 or len(used) != labels.max() + 1:
        raise InputError(
            f"{path}: expected two or more regions 0, 1, ..., each with an edge that cars may use"
        )
    return labels


def partition(
    streets: Streets, baseline: Baseline, regions: int, *, uncontrollable: Collection[str] = ()
) -> EdgeNumbers:
    """Cluster the streets into regions of similar density without control.

    regions: requested number; fewer result if clusters cannot be reached from each other
    uncontrollable: signals that perimeter control cannot use
    Raises: InputError if the network has too few streets for the requested regions
    """
    blocks = make_blocks(streets)
    count = len(blocks.weight)
    if regions > count:
        raise InputError(
            f"--regions: expected at most {count}, the streets of {streets.path}, got {regions} "
            "instead"
        )
    controllable = streets.controllable(uncontrollable)
    limit = UNSIGNALLED_SHARE * blocks.weight.sum() / regions
    merged = without_signals(streets, blocks, baseline.moves(), controllable, limit)
    weight = np.bincount(merged, blocks.weight)
    means = []  # of merged blocks, which then look alike
    for axis in features(blocks, block_density(streets, blocks, baseline)).T:
        means.append(np.bincount(merged, blocks.weight * axis) / weight)
    labels = cluster(blocks, np.stack(means, axis=1)[merged], regions)
    return finish(streets, np.where(blocks.of >= 0, labels[blocks.of], -1))


def block_density(streets: Streets, blocks: Blocks, baseline: Baseline) -> PerBlock:
    """Return the density of every block without control (veh/m of lane)."""
    inside = blocks.of >= 0
    vehicles = baseline.density(streets) * streets.lane_metres
    return np.bincount(blocks.of[inside], vehicles[inside], len(blocks.weight)) / blocks.weight


def cluster(
    blocks: Blocks, feature: Float[np.ndarray, "B F"], regions: int
) -> Int[np.ndarray, " B"]:
    """Return the cluster of every block, -1 in too small clusters."""
    # Its import takes a second, which other commands do not need.
    from sklearn.cluster import AgglomerativeClustering

    size = blocks.weight
    if np.count_nonzero(blocks.core) >= regions:
        size = blocks.core
    least = SMALLEST_SHARE * size.sum() / regions
    best = np.zeros(len(feature), dtype=int)
    most = 0
    for count in range(regions, min(regions + MAX_EXTRA_CLUSTERS, len(feature)) + 1):
        ward = AgglomerativeClustering(n_clusters=count, connectivity=blocks.joins)
        labels = ward.fit_predict(feature)
        large = np.bincount(labels, size) >= least
        if most < large.sum() <= regions:
            best = np.where(large[labels], labels, -1)
            most = large.sum()
        if most == regions:
            break
    return best


def features(blocks: Blocks, density: PerBlock) -> Float[np.ndarray, "B 3"]:
    """Return density of the neighbourhood and position of each block.

    Each has variance 1 over the city's lanes.
    """
    weight = blocks.weight
    joins = (blocks.joins > 0).astype(float)
    smooth = np.minimum(density, HIGHEST_DENSITY)
    for _ in range(SMOOTHING_ROUNDS):
        smooth = (smooth * weight + joins @ (smooth * weight)) / (weight + joins @ weight)
    place = blocks.position - np.average(blocks.position, axis=0, weights=weight)
    radius = np.sqrt(np.average((place**2).sum(axis=1), weights=weight))
    mean = np.average(smooth, weights=weight)
    spread = np.sqrt(np.average((smooth - mean) ** 2, weights=weight))
    return np.column_stack([smooth / max(spread, 1e-9), place / max(radius, 1e-9)])


def make_blocks(streets: Streets) -> Blocks:
    """Group the edges of the main part into blocks."""
    inside = streets.main_part
    lanes = streets.lane_metres
    together = _opposite(streets)
    for ring in streets.roundabouts:
        together += [(ring[0], edge) for edge in ring[1:]]
    pairs = np.array(together, dtype=int).reshape(-1, 2)
    pairs = pairs[inside[pairs].all(axis=1)]
    _, label = connected_components(graph(pairs, len(streets.edges)), directed=False)
    of = np.full(len(streets.edges), -1)
    _, of[inside] = np.unique(label[inside], return_inverse=True)
    count = of.max() + 1

    def total(values: PerEdge) -> np.ndarray:
        return np.bincount(of[inside], values[inside], count)

    weight = total(lanes)
    position = np.stack([total(axis * lanes) / weight for axis in streets.centre.T], axis=1)
    core = total(lanes * streets.core)
    return Blocks(of=of, weight=weight, core=core, position=position, joins=streets.joins(of))


def without_signals(
    streets: Streets,
    blocks: Blocks,
    moves: Counter[tuple[int, int]],
    controllable: np.ndarray,
    limit: float,
) -> np.ndarray:
    """Return a group (B,) for every block.

    Blocks that much traffic joins without a controllable signal share one.

    controllable: (L,) for every link
    limit: of a group [m of lanes]
    """
    flow: Counter[tuple[int, int]] = Counter()
    for (a, b), controlled in zip(streets.links, controllable, strict=True):
        one, other = sorted((blocks.of[a], blocks.of[b]))
        if one >= 0 and one != other and not controlled:
            flow[int(one), int(other)] += moves[int(a), int(b)]
    pairs = sorted(flow, key=lambda pair: (-flow[pair], pair))
    label = np.arange(len(blocks.weight))
    size = blocks.weight.copy()
    for pair in pairs:
        one, other = label[list(pair)]
        if one != other and size[one] + size[other] <= limit:
            label[label == other] = one
            size[one] += size[other]
    return np.unique(label, return_inverse=True)[1]


def _opposite(streets: Streets) -> list[tuple[int, int]]:
    """Return pairs of edges in opposite directions, one each.

    They lie between the same two junctions.
    """
    waiting: dict[tuple[int, int], list[int]] = {}
    pairs = []
    for n, (begin, end) in enumerate(streets.junctions):
        if waiting.get((end, begin)):
            pairs.append((waiting[end, begin].pop(0), n))
        else:
            waiting.setdefault((begin, end), []).append(n)
    return pairs


def finish(streets: Streets, labels: EdgeNumbers, *, own: bool = False) -> EdgeNumbers:
    """Return a region for every edge from labels, -1 for none.

    Regions become connected, and each can be reached from each; those that fail join a neighbour.
    Other edges join an adjoining region or the nearest. Regions are numbered from north to south.

    own: the labels are the user's own; regions may be in several pieces, and keep their order
    """
    regions = labels.copy()
    regions[~streets.drivable] = -1
    regions = _spread(streets, regions, streets.links, streets.drivable)
    while True:
        if not own:
            regions = connect(streets, regions)
        victim = _not_reachable(streets, regions)
        if victim is None:
            break
        # The region joins the neighbour with the most connections.
        pairs = regions[streets.links]
        beyond = np.concatenate([pairs[pairs[:, 0] == victim, 1], pairs[pairs[:, 1] == victim, 0]])
        beyond = beyond[(beyond != victim) & (beyond >= 0)]
        regions = np.where(regions == victim, np.argmax(np.bincount(beyond)), regions)
    everywhere = np.ones(len(streets.edges), dtype=bool)
    regions = _spread(streets, regions, streets.all_links, everywhere)
    if not own:
        return _numbered(streets, regions)
    _, numbers = np.unique(regions, return_inverse=True)
    return numbers


def pieces_of(streets: Streets, regions: EdgeNumbers) -> EdgeNumbers:
    """Return the number of the piece of a region in which every edge lies.

    The connections of the main part join the edges of a piece.
    """
    links = streets.main_links
    kept = links[regions[links[:, 0]] == regions[links[:, 1]]]
    _, piece = connected_components(graph(kept, len(regions)), directed=False)
    return piece


def connect(streets: Streets, regions: EdgeNumbers) -> EdgeNumbers:
    """Keep the largest connected piece of every region in the main part.

    Other pieces join their main neighbour.
    """
    regions = regions.copy()
    inside = streets.main_part
    links = streets.main_links
    for _ in range(len(regions)):
        piece = pieces_of(streets, regions)
        weight = np.bincount(piece, streets.lane_metres)
        loose = np.zeros(len(regions), dtype=bool)
        for region in np.unique(regions[inside]):
            members = np.flatnonzero(inside & (regions == region))
            pieces = np.unique(piece[members])
            largest = pieces[np.argmax(weight[pieces])]
            loose[members] = piece[members] != largest
        if not loose.any():
            return regions
        # A piece may adjoin loose pieces only: then it waits for the next round.
        both = np.concatenate([links, links[:, ::-1]])
        both = both[loose[both[:, 0]] & ~loose[both[:, 1]]]
        around = regions[both[:, 1]]  # before any piece joins
        for number in np.unique(piece[both[:, 0]]):
            neighbours = around[piece[both[:, 0]] == number]
            regions[loose & (piece == number)] = np.argmax(np.bincount(neighbours))
    return regions


def digraph(streets: Streets, regions: EdgeNumbers) -> Int[np.ndarray, "R R"]:
    """Count the connections [i, h] from region i to another one h."""
    count = int(regions[streets.drivable].max()) + 1
    crossing = np.zeros((count, count), dtype=int)
    pairs = regions[streets.links]
    np.add.at(crossing, (pairs[:, 0], pairs[:, 1]), 1)
    np.fill_diagonal(crossing, 0)
    return crossing


def _not_reachable(streets: Streets, regions: np.ndarray) -> int | None:
    """Return a region to dissolve, None if there is none.

    It is the smallest one outside the largest set that can be reached from each other.
    """
    inside = streets.main_part
    used, numbers = np.unique(regions[inside], return_inverse=True)
    links = np.searchsorted(used, regions[streets.main_links])
    _, part = connected_components(graph(links, len(used)), directed=True, connection="strong")
    size = np.bincount(numbers, streets.lane_metres[inside])
    outside = np.flatnonzero(part != np.argmax(np.bincount(part, size)))
    if not len(outside):
        return None
    return int(used[outside[np.argmin(size[outside])]])


def _spread(
    streets: Streets, regions: np.ndarray, links: np.ndarray, wanted: np.ndarray
) -> np.ndarray:
    """Give `wanted` edges without a region that of a linked edge.

    If there is none, that of the nearest.
    """
    regions = regions.copy()
    both = np.concatenate([links, links[:, ::-1]])
    while True:
        reach = both[wanted[both[:, 0]] & (regions[both[:, 0]] < 0) & (regions[both[:, 1]] >= 0)]
        if not len(reach):
            break
        edges, first = np.unique(reach[:, 0], return_index=True)
        regions[edges] = regions[reach[first, 1]]
    missing = np.flatnonzero(wanted & (regions < 0))
    known = np.flatnonzero(regions >= 0)
    if len(missing):
        _, nearest = cKDTree(streets.centre[known]).query(streets.centre[missing])
        regions[missing] = regions[known[nearest]]
    return regions


def _numbered(streets: Streets, regions: np.ndarray) -> np.ndarray:
    """Number the regions from north to south, ties from west to east."""
    used = np.unique(regions)
    places = []
    for region in used:
        x, y = _gravity(streets, regions == region)
        places.append((-round(y, 1), x, region))
    order = [region for _, _, region in sorted(places)]
    return np.argsort(order)[np.searchsorted(used, regions)]


def positions(streets: Streets, regions: EdgeNumbers) -> Positions:
    """Return the centre of gravity (R, 2) [m] of each region's lanes."""
    return np.array([_gravity(streets, regions == region) for region in range(regions.max() + 1)])


def _gravity(streets: Streets, members: np.ndarray) -> np.ndarray:
    weight = streets.lane_metres[members] + 1e-6
    return np.average(streets.centre[members], axis=0, weights=weight)


def names(streets: Streets, regions: EdgeNumbers) -> tuple[str, ...]:
    """Name each region by its place: centre, ring, north, south-west 2, ..."""
    places, middle = positions(streets, regions), _gravity(streets, regions >= 0)
    away = ((streets.centre - middle) ** 2).sum(axis=1)
    mean = np.average(away, weights=streets.lane_metres)
    plain = []
    for region, (x, y) in enumerate(places - middle):
        if np.hypot(x, y) < CENTRAL_SHARE * np.sqrt(mean):
            own = regions == region
            around = np.average(away[own], weights=streets.lane_metres[own] + 1e-6) > mean
            plain.append("ring" if around else "centre")
        else:
            plain.append(DIRECTIONS[round(np.arctan2(y, x) / (np.pi / 4)) % 8])
    numbered = []
    for n, name in enumerate(plain):
        if plain.count(name) > 1:
            name = f"{name} {plain[: n + 1].count(name)}"
        numbered.append(name)
    return tuple(numbered)
