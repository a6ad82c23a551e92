"""Cutting a city into regions, by one of several methods."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from cosim.importing.baseline import Baseline
from cosim.importing.blocks import make_blocks
from cosim.importing.clustering import agglomerate, features
from cosim.importing.geometric import k_means
from cosim.importing.given import read_given
from cosim.importing.refine import best, prices
from cosim.importing.regions import finish
from cosim.importing.streets import Streets
from nmfd.errors import InputError

METHODS = {
    "density": "clusters of streets with similar densities without control",
    "geometric": "k-means on the road graph",
    "edges": "a csv with the columns edge,region",
    "taz": "a SUMO file with a TAZ per region",
    "polygons": "a SUMO file with one or more polygons per region",
}
STARTS = 4  # of k-means, from which the partition is refined
GIVEN = ("edges", "taz", "polygons")


def partition(
    streets: Streets, baseline: Baseline | None, *, regions: int | None, method: str, given: Path | None, seed: int,
    left_alone: Collection[str] = (),
) -> tuple[np.ndarray, int, int]:
    """(E,) region of every edge, numbered from 0, by a method of METHODS, how many were asked for, and how many streets
    are in another one than the file `given` says, for those that read one.

    left_alone: signals that perimeter control cannot use. Regions of the user's own keep their order and edges, but
    edges without a region get one. Raises InputError where there are no two regions to be had.
    """
    if method in GIVEN:
        labels = read_given(streets, given, method)
        found, regions = finish(streets, labels, renumber=False), int(labels.max()) + 1
        moved = _moved(labels, found, streets.drivable & (labels >= 0))
    else:
        moved = 0
        blocks = make_blocks(streets)
        if regions > len(blocks.weight):
            raise InputError(
                f"--regions: expected at most {len(blocks.weight)}, the streets of {streets.path}, got {regions} "
                "instead")
        density = np.zeros(len(streets.edges)) if baseline is None else baseline.density(streets)
        feature = features(blocks, blocks.mean(density, streets.lane_metres))
        if method == "geometric":
            feature = feature[:, 1:]
            starts = []
        else:
            starts = [agglomerate(blocks, feature, regions)]
        starts += [k_means(blocks, regions, seed + n) for n in range(STARTS)]
        controlled = np.array([
            signal is not None and signal not in left_alone for signal in streets.link_signals], dtype=bool)
        labels = best(blocks, starts, feature, prices(streets, blocks, controlled, baseline))
        found = finish(streets, np.where(blocks.of >= 0, labels[blocks.of], -1))
    if found.max() < 1:
        raise InputError(
            f"{streets.path}: no two regions can be made that can be reached from each other; give a network with "
            "more streets, or other regions")
    return found, regions, moved


def _moved(labels: np.ndarray, found: np.ndarray, members: np.ndarray) -> int:
    """How many of some edges are not in the region that most of those with the same label are in."""
    votes = np.zeros((int(labels.max()) + 1, int(found.max()) + 1), dtype=int)
    np.add.at(votes, (labels[members], found[members]), 1)
    return int(votes.sum() - votes.max(axis=1).sum())
