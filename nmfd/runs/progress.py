"""Progress as a bar of tqdm, on a terminal and in a notebook."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol, runtime_checkable

from tqdm.auto import tqdm


@runtime_checkable
class Show(Protocol):
    """A function that takes what is done, what there is to do, and what is running."""

    def __call__(self, done: int, total: int, note: str = "") -> None: ...


Progress = Callable[..., None] | bool | None


@contextmanager
def watched(label: str, progress: Progress = None) -> Iterator[Callable[..., None] | None]:
    """Yield the function that shows progress.

    progress: the user's own function; None for a bar on a terminal or in a notebook; False for none
    """
    if progress is False:
        yield None
    elif callable(progress):
        yield progress
    else:
        with tqdm(desc=label, leave=False, dynamic_ncols=True, smoothing=0.0, disable=None) as bar:

            def show(done: int, total: int, note: str = "") -> None:
                bar.total = total
                bar.set_postfix_str(note, refresh=False)
                bar.update(done - bar.n)

            yield show
