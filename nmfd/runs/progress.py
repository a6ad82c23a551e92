"""Progress: a bar in a notebook, a line that moves on a terminal, elsewhere a plain line every half minute."""

import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Protocol, TextIO, runtime_checkable

from tqdm.std import tqdm

LINE = "{desc}  [{bar:24}]  {n_fmt}/{total_fmt}  {remaining} left{postfix}"
PLAIN = "{desc}: {n_fmt}/{total_fmt} after {elapsed}, {remaining} left{postfix}"
BEAT = 1.0  # s, between two looks of the moving line at the clock
EVERY = 30.0  # s, between two plain lines
SOON = 1.0  # s: what is done sooner shows nothing in a notebook


@runtime_checkable
class Show(Protocol):
    """A callback as `closed_loop.run` and the studies want it."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


Progress = Callable[..., None] | bool | None


@contextmanager
def progress_line(label: str, stream: TextIO | None = None) -> Iterator[Show]:
    """What shows progress on `stream` (default stderr): on a terminal in a line that is wiped at the end.

    The remaining time is what is left at the mean rate since the line, or another total, began.
    """
    stream = sys.stderr if stream is None else stream
    over, moving = threading.Event(), stream.isatty()
    with ExitStack() as stack:
        shown = stream if moving else stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
        # a new note is shown even if nothing more is done: miniters 0; jams change the rate, not for long: smoothing 0
        line = stack.enter_context(
            tqdm(
                desc=label,
                file=shown,
                leave=False,
                dynamic_ncols=True,
                ascii=".#",
                miniters=0,
                smoothing=0.0,
                bar_format=LINE if moving else PLAIN,
            )
        )

        def beat() -> None:
            while not over.wait(BEAT if moving else EVERY):
                if moving:
                    line.refresh()
                elif line.total is None or line.n < line.total:  # else somebody looks at what has ended
                    print(line, file=stream, flush=True)

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield _shown(line)
        finally:
            over.set()
            thread.join()


@contextmanager
def watched(label: str, progress: Progress) -> Iterator[Callable[..., None] | None]:
    """What a function of the Python interface hands on as its callback.

    progress: the user's own callback; None for a bar in a notebook or a terminal, and silence elsewhere; False for none
    """
    if callable(progress):
        yield progress
    elif progress is False:
        yield None
    elif in_notebook():
        with ExitStack() as bars:
            yield _late(label, bars)
    elif sys.stderr.isatty():
        with progress_line(label) as show:
            yield show
    else:
        yield None


def in_notebook() -> bool:
    """Whether a Jupyter kernel runs this process."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in shell.config


def _late(label: str, bars: ExitStack) -> Show:
    """What makes a bar, which ends with `bars`, of work that is not done SOON."""
    begin = time.monotonic()
    shown: list[Show] = []

    def show(done: int, total: int, note: str = "") -> None:
        if not shown and time.monotonic() - begin >= SOON:
            shown.append(_shown(bars.enter_context(_notebook_bar(label, total))))
        if shown:
            shown[0](done, total, note)

    return show


def _notebook_bar(label: str, total: int) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without ipywidgets it is a line of text, and a warning
        from tqdm.autonotebook import tqdm as bar  # asks whether there are widgets
    return bar(desc=label, total=total, leave=False, miniters=0)


def _shown(line: Any) -> Show:
    def show(done: int, total: int, note: str = "") -> None:
        line.set_postfix_str(note, refresh=False)
        if total != line.total or done < line.n:
            line.initial = 0
            line.reset(total)
            line.initial = line.n = done  # what was there before says nothing of the rate
        line.update(done - line.n)

    return show
