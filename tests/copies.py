"""The folder of the project, and copies of its cities, which a test may change."""

import shutil
from pathlib import Path

ROOT = Path(__file__).parents[1]


def grid7(folder: Path) -> None:
    """grid7 and its other models in `folder`/networks, with the city that conftest.py has built."""
    for network in (ROOT / "networks").glob("grid7*"):
        shutil.copytree(network, folder / "networks" / network.name)


def peak(folder: Path) -> Path:
    """The scenario grid7_peak in `folder`, with its network and models and without the reference
    results."""
    grid7(folder)
    shutil.copytree(
        ROOT / "scenarios" / "grid7_peak",
        folder / "scenarios" / "peak",
        ignore=shutil.ignore_patterns("reference"),
    )
    return folder / "scenarios" / "peak"
