"""Cutting a city into regions, by one of several methods."""

from pathlib import Path

import numpy as np

from cosim.importing.baseline import Baseline
from cosim.importing.blocks import make_blocks
from cosim.importing.geometric import k_means
from cosim.importing.regions import finish
from cosim.importing.streets import Streets
from nmfd.errors import InputError

METHODS = ("density", "geometric")


def partition(
    streets: Streets, baseline: Baseline | None, *, regions: int | None, method: str, given: Path | None, seed: int,
) -> np.ndarray:
    """(E,) region of every edge, numbered from 0. Raises InputError where there are no two regions to be had."""
    blocks = make_blocks(streets)
    if regions > len(blocks.weight):
        raise InputError(
            f"--regions: expected at most {len(blocks.weight)}, the streets of {streets.path}, got {regions} instead")
    labels = k_means(blocks, regions, seed)
    found = finish(streets, np.where(blocks.of >= 0, labels[blocks.of], -1))
    if found.max() < 1:
        raise InputError(
            f"{streets.path}: no two regions can be made that can be reached from each other; give a network with "
            "more streets, or other regions")
    return found
