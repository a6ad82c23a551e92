"""Progress of commands, and how those end that are interrupted."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nmfd.cli.errors import Interrupted
from nmfd.runs.progress import Show
from nmfd.runs.progress import watched as progress_line

__all__ = ["progress_line", "resumable"]


@contextmanager
def resumable(label: str, out: Path, results: str = "") -> Iterator[Show]:
    """`progress_line` of a command that keeps what is finished in the folder `out`; Ctrl-C says how to go on.

    results: the file there that holds what is finished; without it nothing is kept
    """
    try:
        with progress_line(label) as show:
            yield show
    except KeyboardInterrupt:
        if not (out / results).exists():
            raise Interrupted("interrupted before a run was finished; nothing is kept") from None
        raise Interrupted(
            f"interrupted; finished runs are in {out}: the same command with --out {shlex.quote(str(out))} goes on"
        ) from None
