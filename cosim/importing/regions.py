"""Regions made usable: connected, reachable from each other, numbered, with every edge in one."""

import numpy as np
from jaxtyping import Int
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cosim.importing.streets import Streets, graph
from cosim.sumo.arrays import EdgeNumbers
from nmfd.arrays import Positions

DIRECTIONS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


def finish(streets: Streets, labels: EdgeNumbers, *, renumber: bool = True) -> EdgeNumbers:
    """Return a region for every edge, from labels of the edges for cars, -1 for none.

    Regions become connected, and each can be reached from each; those that fail join a neighbour. Other edges join an
    adjoining region or the nearest. Regions are numbered from north to south, or in the order of the labels.
    """
    regions = labels.copy()
    regions[~streets.drivable] = -1
    regions = _spread(streets, regions, streets.links, streets.drivable)
    while True:
        regions = connect(streets, regions)
        if (victim := _not_reachable(streets, regions)) is None:
            break
        pairs = regions[streets.links]  # the region joins the neighbour with the most connections
        beyond = np.concatenate([pairs[pairs[:, 0] == victim, 1], pairs[pairs[:, 1] == victim, 0]])
        beyond = beyond[(beyond != victim) & (beyond >= 0)]
        regions = np.where(regions == victim, np.argmax(np.bincount(beyond)), regions)
    everywhere = np.ones(len(streets.edges), dtype=bool)
    regions = _spread(streets, regions, streets.all_links, everywhere)
    return _numbered(streets, regions) if renumber else np.unique(regions, return_inverse=True)[1]


def connect(streets: Streets, regions: EdgeNumbers) -> EdgeNumbers:
    """Keep the largest connected piece of every region in the main part; other pieces join their main neighbour."""
    regions, inside = regions.copy(), streets.main_part
    links = streets.links[inside[streets.links].all(axis=1)]
    for _ in range(len(regions)):
        kept = links[regions[links[:, 0]] == regions[links[:, 1]]]
        _, piece = connected_components(graph(kept, len(regions)), directed=False)
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
        votes = [(number, regions[both[piece[both[:, 0]] == number, 1]]) for number in np.unique(piece[both[:, 0]])]
        for number, neighbours in votes:
            regions[loose & (piece == number)] = np.argmax(np.bincount(neighbours))
    return regions


def digraph(streets: Streets, regions: EdgeNumbers) -> Int[np.ndarray, "R R"]:
    """Count the connections [i, h] from an edge of region i to one of region h, i != h."""
    count = int(regions[streets.drivable].max()) + 1
    crossing = np.zeros((count, count), dtype=int)
    pairs = regions[streets.links]
    np.add.at(crossing, (pairs[:, 0], pairs[:, 1]), 1)
    np.fill_diagonal(crossing, 0)
    return crossing


def _not_reachable(streets: Streets, regions: np.ndarray) -> int | None:
    """Return the smallest region outside the largest set of regions that can be reached from each other."""
    inside = streets.main_part
    used, numbers = np.unique(regions[inside], return_inverse=True)
    links = np.searchsorted(used, regions[streets.links[inside[streets.links].all(axis=1)]])
    _, part = connected_components(graph(links, len(used)), directed=True, connection="strong")
    size = np.bincount(numbers, streets.lane_metres[inside])
    outside = np.flatnonzero(part != np.argmax(np.bincount(part, size)))
    return None if not len(outside) else int(used[outside[np.argmin(size[outside])]])


def _spread(streets: Streets, regions: np.ndarray, links: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Give the `wanted` edges without a region that of a linked edge, else of the nearest."""
    regions, both = regions.copy(), np.concatenate([links, links[:, ::-1]])
    while True:
        reach = both[wanted[both[:, 0]] & (regions[both[:, 0]] < 0) & (regions[both[:, 1]] >= 0)]
        if not len(reach):
            break
        edges, first = np.unique(reach[:, 0], return_index=True)
        regions[edges] = regions[reach[first, 1]]
    missing, known = np.flatnonzero(wanted & (regions < 0)), np.flatnonzero(regions >= 0)
    if len(missing):
        regions[missing] = regions[known[cKDTree(streets.centre[known]).query(streets.centre[missing])[1]]]
    return regions


def _numbered(streets: Streets, regions: np.ndarray) -> np.ndarray:
    """Number the regions 0, 1, ... from north to south, ties from west to east."""
    used = np.unique(regions)
    middle = {region: _gravity(streets, regions == region) for region in used}
    order = sorted(used, key=lambda region: (-round(middle[region][1], 1), middle[region][0]))
    return np.argsort(order)[np.searchsorted(used, regions)]


def positions(streets: Streets, regions: EdgeNumbers) -> Positions:
    """Return the centre of gravity (R, 2) [m] of each region's lanes."""
    return np.array([_gravity(streets, regions == region) for region in range(regions.max() + 1)])


def _gravity(streets: Streets, members: np.ndarray) -> np.ndarray:
    weight = streets.lane_metres[members] + 1e-6
    return np.average(streets.centre[members], axis=0, weights=weight)


def names(streets: Streets, regions: EdgeNumbers) -> tuple[str, ...]:
    """Name each region by its place: centre, north, south-west 2, ..."""
    places, middle = positions(streets, regions), _gravity(streets, regions >= 0)
    radius = np.sqrt(np.average(((streets.centre - middle) ** 2).sum(axis=1), weights=streets.lane_metres))
    plain: list[str] = []
    for x, y in places - middle:
        central = np.hypot(x, y) < 0.35 * radius
        plain.append("centre" if central else DIRECTIONS[round(np.arctan2(y, x) / (np.pi / 4)) % 8])
    return tuple(
        name if plain.count(name) == 1 else f"{name} {plain[: n + 1].count(name)}" for n, name in enumerate(plain)
    )
