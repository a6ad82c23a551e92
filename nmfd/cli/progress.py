"""One line of progress on stderr, where that is a terminal; silence elsewhere."""

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, TextIO

from tqdm.std import tqdm

from nmfd.cli.errors import Interrupted

LINE = "{desc}  [{bar:24}]  {n_fmt}/{total_fmt}  {remaining} left{postfix}"


class Show(Protocol):
    """A callback as `closed_loop.run` and the studies want it."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


@contextmanager
def progress_line(label: str, stream: TextIO | None = None) -> Iterator[Show | None]:
    """What shows progress on a line that is wiped at the end; None if `stream` (default stderr) is no terminal."""
    stream = sys.stderr if stream is None else stream
    if not stream.isatty():
        yield None
        return
    # a new note is shown even if nothing more is done: miniters 0
    with tqdm(
        desc=label, file=stream, leave=False, dynamic_ncols=True, ascii=".#", miniters=0, bar_format=LINE,
    ) as line:
        def show(done: int, total: int, note: str = "") -> None:
            line.set_postfix_str(note, refresh=False)
            if total != line.total:
                line.reset(total)
            line.update(done - line.n)

        yield show


@contextmanager
def resumable(label: str, out: Path, results: str = "") -> Iterator[Show | None]:
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
