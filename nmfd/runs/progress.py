"""Progress as a bar of tqdm, on a terminal and in a notebook."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

with warnings.catch_warnings(action="ignore"):  # of a notebook without ipywidgets, which gets no bar
    from tqdm.auto import tqdm

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
