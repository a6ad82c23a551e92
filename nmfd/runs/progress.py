"""A bar of progress where somebody looks: in a notebook, or one line on stderr where that is a terminal."""

import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Protocol, TextIO, runtime_checkable

from tqdm.std import tqdm

LINE = "{desc}  [{bar:24}]  {n_fmt}/{total_fmt}  {remaining} left{postfix}"
SOON = 1.0  # s: what is done sooner shows nothing in a notebook


@runtime_checkable
class Show(Protocol):
    """A callback as `closed_loop.run` and the studies want it."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


Progress = Callable[..., None] | bool | None


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
        yield _shown(line)


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
    else:
        with progress_line(label) as show:
            yield show


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
        if total != line.total:
            line.reset(total)
        line.update(done - line.n)

    return show
