"""Tables of earlier evaluations whose run folders are not there any more, beside the runs that are.

    <folder>/earlier/<n>-<hash>.csv    copies of their runs.csv, with their trails, in the order in which they came

Their rows stand in the tables as if their runs lay in the folder; what is drawn or explained of runs is without them.
Of a run that is in several tables, the row of the one that came first counts.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from nmfd.errors import InputError
from nmfd.runs import files, trail

KEYS = {"demand": float, "controller": str, "seed": int}  # of runs.csv


def add(out: Path, tables: Sequence[Path], rows: pd.DataFrame) -> None:
    """Copy tables to `out`. rows: of the runs there. InputError for what is no table of runs, or does not fit them."""
    for table in tables:
        _left(out, table, rows)
        known, name = trail.earlier(out), f"{files.file_hash(table)}.csv"
        if not any(copy.name.endswith(name) for copy in known):
            (out / trail.EARLIER).mkdir(parents=True, exist_ok=True)
            files.write_text(out / trail.EARLIER / f"{len(known):03d}-{name}", table.read_text(encoding="utf-8"))


def joined(out: Path, rows: pd.DataFrame) -> pd.DataFrame:
    """`rows`, of the runs in `out`, and those of earlier tables there that were not run again. Raises InputError."""
    for table in trail.earlier(out):
        left = _left(out, table, rows)
        rows = pd.concat([part for part in (rows, left) if len(part)] or [rows], ignore_index=True)
    return rows


def _left(out: Path, table: Path, rows: pd.DataFrame) -> pd.DataFrame:
    """The rows of `table` that are not in `rows`. InputError for runs of another city, demand or controller than those
    in `out`."""
    found = files.read_table(table, KEYS, "give the runs.csv of an evaluation")
    keys, known = (pd.MultiIndex.from_frame(frame[[*KEYS]]) for frame in (found, rows))
    left = found[~keys.isin(known)]
    used = {(f"demand-{level:g}", name) for level, name in zip(left["demand"], left["controller"], strict=True)}
    here = _hashes(trail.of_runs(out))
    for key, value in _hashes(trail.read(table)).items():
        if here.get(key, value) != value and (len(key) == 2 or key[:2] in used):
            raise InputError(
                f"{table}: its runs are of another {' '.join(key)} ({value}) than those in {out} ({here[key]}); choose "
                "another folder with --out"
            )
    return left


def _hashes(found: Mapping) -> dict[tuple[str, ...], str]:
    """(run folder, controller, hash), or without controller, -> value; of a trail."""
    values: dict[tuple[str, ...], str] = {}
    for place, about in found.get("hashes", {}).items():
        for key, value in about.items():
            values.update(
                {(place, key, name): each for name, each in value.items()}
                if isinstance(value, Mapping)
                else {(place, key): value}
            )
    return values
