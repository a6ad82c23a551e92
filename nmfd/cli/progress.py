"""Progress on stderr: one line that moves where that is a terminal, elsewhere a plain line every half minute."""

import os
import shlex
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol, TextIO

from tqdm.std import tqdm

from nmfd.cli.errors import Interrupted

LINE = "{desc}  [{bar:24}]  {n_fmt}/{total_fmt}  {remaining} left{postfix}"
PLAIN = "{desc}: {n_fmt}/{total_fmt} after {elapsed}, {remaining} left{postfix}"
BEAT = 1.0    # s, between two looks of the moving line at the clock
EVERY = 30.0  # s, between two plain lines


class Show(Protocol):
    """A callback as `closed_loop.run` and the studies want it."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


@contextmanager
def progress_line(label: str, stream: TextIO | None = None) -> Iterator[Show]:
    """What shows progress on `stream` (default stderr): on a terminal in a line that is wiped at the end.

    The remaining time is what is left at the mean rate since the line, or another total, began.
    """
    stream = sys.stderr if stream is None else stream
    over, moving = threading.Event(), stream.isatty()
    with ExitStack() as stack:
        shown = stream if moving else stack.enter_context(open(os.devnull, "w"))
        # a new note is shown even if nothing more is done: miniters 0; jams change the rate, not for long: smoothing 0
        line = stack.enter_context(tqdm(
            desc=label, file=shown, leave=False, dynamic_ncols=True, ascii=".#", miniters=0, smoothing=0.0,
            bar_format=LINE if moving else PLAIN))

        def beat() -> None:
            while not over.wait(BEAT if moving else EVERY):
                if moving:
                    line.refresh()
                elif line.total is None or line.n < line.total:  # else somebody looks at what has ended
                    print(line, file=stream, flush=True)

        def show(done: int, total: int, note: str = "") -> None:
            line.set_postfix_str(note, refresh=False)
            if total != line.total or done < line.n:
                line.initial = 0
                line.reset(total)
                line.initial = line.n = done  # what was there before says nothing of the rate
            line.update(done - line.n)

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield show
        finally:
            over.set()
            thread.join()


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
