"""What a search compares: the geometric mean of the total time spent over seeds and demand levels.

The same trips for everybody, and no level counts for more because it is heavier.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from cosim.evaluation import experiment
from cosim.evaluation.statistics import TTS

SCORE = "score_veh_s"


def column(level: float, seed: int) -> str:
    """Of one run's total time spent, in the table of a search."""
    return f"tts_{level:g}_{seed}_veh_s"


def totals(
    folder: Path,
    levels: Iterable[float],
    seeds: Sequence[int],
    fact: str = TTS,
    named: Callable[[float, int], str] = column,
) -> dict[str, float]:
    """Column -> `fact` of the run at that level with that seed; NaN where there is none."""
    found: dict[str, float] = {}
    for level in levels:
        path = experiment.level_folder(folder, level)
        rows = experiment.overview(path).set_index("seed")[fact] if (path / "summary.csv").is_file() else {}
        found |= {named(level, seed): float(rows.get(seed, math.nan)) for seed in seeds}
    return found


def score(found: Iterable[float]) -> float:
    """The geometric mean [veh s] of `totals`; NaN if one is missing. A city may be empty."""
    return float(np.exp(np.log(np.maximum(list(found), 1.0)).mean()))
