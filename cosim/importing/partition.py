"""Cutting a city into regions, by one of several methods."""

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from cosim.importing.baseline import Baseline
from cosim.importing.blocks import make_blocks
from cosim.importing.clustering import agglomerate, features
from cosim.importing.geometric import k_means
from cosim.importing.given import read_given
from cosim.importing.refine import best, prices
from cosim.importing.regions import finish
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers
from nmfd.errors import InputError

STARTS = 4  # of k-means, from which the partition is refined
SIDE_BY_SIDE = 20  # partitions, about, that are compared


@dataclass(frozen=True, kw_only=True)
class Clustered:
    """Into so many regions, by "density": clusters of streets with similar densities without control, or "geometric":
    k-means on the road graph."""

    method: Literal["density", "geometric"]
    regions: int


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """As the user's file says, by method: a csv with the columns edge,region, or a SUMO file with a TAZ, or one or more
    polygons, per region."""

    method: Literal["edges", "taz", "polygons"]
    file: Path


def partition(
    streets: Streets, baseline: Baseline | None, cut: Clustered | Drawn, *, seed: int, left_alone: Collection[str] = ()
) -> tuple[EdgeNumbers, int, int]:
    """(E,) region of every edge, numbered from 0, how many were asked for, and how many streets are in another one than
    a file of the user's says.

    left_alone: signals that perimeter control cannot use. Regions of the user's own keep their order and edges, but
    edges without a region get one. Raises InputError where there are no two regions to be had.
    """
    if isinstance(cut, Drawn):
        labels = read_given(streets, cut.file, cut.method)
        found, regions = finish(streets, labels, renumber=False), int(labels.max()) + 1
        moved = _moved(labels, found, streets.drivable & (labels >= 0))
    else:
        regions, moved = cut.regions, 0
        blocks = make_blocks(streets)
        if regions > len(blocks.weight):
            raise InputError(
                f"--regions: expected at most {len(blocks.weight)}, the streets of {streets.path}, got {regions} "
                "instead"
            )
        density = np.zeros(len(streets.edges)) if baseline is None else baseline.density(streets)
        feature = features(blocks, blocks.mean(density, streets.lane_metres))
        if cut.method == "geometric":
            feature = feature[:, 1:]
            starts = []
        else:
            starts = [agglomerate(blocks, feature, regions)]
        starts += [k_means(blocks, regions, seed + n) for n in range(STARTS)]
        controlled = np.array(
            [signal is not None and signal not in left_alone for signal in streets.link_signals], dtype=bool
        )
        labels = best(blocks, starts, feature, prices(streets, blocks, controlled, baseline))
        found = finish(streets, np.where(blocks.of >= 0, labels[blocks.of], -1))
    if found.max() < 1:
        raise InputError(
            f"{streets.path}: no two regions can be made that can be reached from each other; give a network with "
            "more streets, or other regions"
        )
    return found, regions, moved


def alternatives(
    streets: Streets,
    baseline: Baseline,
    cut: Clustered | Drawn,
    regions: EdgeNumbers,
    *,
    seed: int,
    left_alone: Collection[str] = (),
) -> dict[int, EdgeNumbers]:
    """How many regions were asked for -> (E,) region of every edge, from 2 to twice as many as in `regions`, by the
    same method, or "density" beside regions of the user's own; what cannot be had is left out."""
    method = cut.method if isinstance(cut, Clustered) else "density"
    found: dict[int, EdgeNumbers] = {}
    most = 2 * (int(regions.max()) + 1)
    for number in np.unique(np.linspace(2, most, min(most - 1, SIDE_BY_SIDE)).astype(int)):
        with suppress(InputError):
            found[int(number)], *_ = partition(
                streets, baseline, Clustered(method=method, regions=int(number)), seed=seed, left_alone=left_alone
            )
    return found


def _moved(labels: np.ndarray, found: np.ndarray, members: np.ndarray) -> int:
    """How many of some edges are not in the region that most of those with the same label are in."""
    votes = np.zeros((int(labels.max()) + 1, int(found.max()) + 1), dtype=int)
    np.add.at(votes, (labels[members], found[members]), 1)
    return int(votes.sum() - votes.max(axis=1).sum())
