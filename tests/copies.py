"""Copies of the committed cities, which a test may change."""

import shutil
from pathlib import Path

ROOT = Path(__file__).parents[1]


def peak(folder: Path) -> Path:
    """The scenario grid7_peak in `folder`, with its network and models and without the reference results."""
    for network in (ROOT / "networks").glob("grid7*"):
        shutil.copytree(network, folder / "networks" / network.name)
    shutil.copytree(ROOT / "scenarios" / "grid7_peak", folder / "scenarios" / "peak",
                    ignore=shutil.ignore_patterns("reference"))
    return folder / "scenarios" / "peak"
