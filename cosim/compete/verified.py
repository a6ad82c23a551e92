"""Many rows of published tables made again, one after the other, and what came of them in one table.

    verified.csv    folder, row, verdict (SAME, ROUNDED, DIFFERENT or FAILED), how many figures were compared, how many
                    of them were the same to the last digit, which differ or why it failed, and the commit

The table grows over calls: rows that it has of this commit are not made again, unless there are changes that are not
committed; rows of other folders stay. Several processes may let it grow at a time.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from cosim.compete.verify import Row, Verdict, verify
from nmfd import __version__
from nmfd.errors import InputError, RunFailed
from nmfd.runs.files import check_file, locked, write_table
from nmfd.runs.progress import Show
from nmfd.runs.provenance import provenance

TABLE, LOCK = "verified.csv", ".verified.lock"
WAIT = 60.0  # s, for other processes that add a line
SAME, ROUNDED, DIFFERENT, FAILED = "the same", "within rounding", "different", "failed"
COLUMNS = ("folder", "row", "verdict", "compared", "equal", "what", "commit")

Line = dict[str, object]


def verify_all(
    folder: Path,
    rows: Sequence[Row],
    *,
    out: Path,
    within: float | None = None,
    missing: bool = False,
    progress: Show,
    tell: Callable[[str], None],
) -> list[Line]:
    """The lines of the table of `rows`, which are in `folder`, after those that are not there yet were made again.

    out: the folder of the table; within: as of `verify`; missing: whether a line of another commit is enough; tell: is
    told every row that did not come out the same. InputError for a table that is none.
    """
    out.mkdir(parents=True, exist_ok=True)
    here, place = provenance(), folder.as_posix()
    commit = here["commit"] or f"version {__version__}"  # not in a checkout

    def add(line: Line) -> None:
        """Instead of what the table had of that row."""
        with locked(out / LOCK, out / TABLE, WAIT):
            others = [one for one in _read(out / TABLE) if (one["folder"], one["row"]) != (place, line["row"])]
            write_table(out / TABLE, pd.DataFrame([*others, line], columns=list(COLUMNS)))

    enough = {
        line["row"]
        for line in _read(out / TABLE)
        if line["folder"] == place
        and line["verdict"] != FAILED
        and (missing or line["commit"] == commit and not here["dirty"])
    }
    for done, row in enumerate(rows):
        progress(done, len(rows), row.label)
        if row.label not in enough:
            line = {"folder": place, "row": row.label, **_line(row, within), "commit": commit}
            add(line)
            if line["verdict"] in (DIFFERENT, FAILED):
                tell(f"{row.label}: {line['verdict']}, {line['what']}")
    progress(len(rows), len(rows), "")
    labels = {row.label for row in rows}
    return [line for line in _read(out / TABLE) if line["folder"] == place and line["row"] in labels]


def _line(row: Row, within: float | None) -> Line:
    try:
        found = verify(row, within)
    except (InputError, RunFailed) as error:
        return {"verdict": FAILED, "compared": 0, "equal": 0, "what": str(error)}
    return {"verdict": _word(found), "compared": found.compared, "equal": found.equal, "what": "; ".join(found.differ)}


def _word(found: Verdict) -> str:
    if not found.good:
        return DIFFERENT
    return SAME if found.exact else ROUNDED


def _read(file: Path) -> list[Line]:
    """What an earlier call has written. InputError."""
    if not file.exists():
        return []
    check_file(file)
    try:
        table = pd.read_csv(file, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: is no table of cosim verify ({error}); choose another folder with --out") from None
    if not {*COLUMNS} <= {*table.columns}:
        raise InputError(
            f"{file}: is no table of cosim verify (expected {', '.join(COLUMNS)}); choose another folder with --out"
        )
    return table[list(COLUMNS)].to_dict("records")
