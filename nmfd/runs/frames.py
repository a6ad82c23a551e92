"""Run folders as Parquet files, for pandas, DuckDB, R and the like.

summary.parquet     one row per run: summary.csv, in SUMO with sumo.csv
states.parquet      one row per run, time and pair of regions (Result.to_frame)
controls.parquet    one row per run, control interval and pair of regions (Result.controls_frame)
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from nmfd.runs import trail
from nmfd.runs.files import atomic
from nmfd.types import Result


def write(folder: Path, trajectories: Sequence[Result], tables: Mapping[str, pd.DataFrame]) -> list[Path]:
    """Write `tables` by name, and those of the trajectories, to `folder`, atomically; the files."""
    frames = {
        **tables,
        "states": pd.concat([t.to_frame() for t in trajectories], ignore_index=True),
        "controls": pd.concat([t.controls_frame() for t in trajectories], ignore_index=True),
    }
    return [write_parquet(folder / f"{name}.parquet", frame) for name, frame in frames.items()]


def write_parquet(path: Path, frame: pd.DataFrame) -> Path:
    """Write `frame` to `path`, atomically, with its trail (nmfd.runs.trail) in its attrs."""
    frame = frame.copy(deep=False)
    frame.attrs["trail"] = trail.of(path)
    with atomic(path) as temporary:
        frame.to_parquet(temporary, index=False)
    return path
