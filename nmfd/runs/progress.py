"""Progress of long computations.

It is a bar of tqdm on a terminal and in a notebook, and a line about the time left anywhere.
"""

import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

with warnings.catch_warnings(action="ignore"):  # a notebook without ipywidgets gets no bar
    from tqdm.auto import tqdm

tqdm.monitor_interval = 0  # no thread watches bars: nmfd.runs.pool forks only without threads
Show = Callable[..., None] | None  # takes done, all and perhaps a note
Progress = Show | bool
MEASURED_S = 2.0  # of the first steps, from which the time of all others follows
LONG_S = 30.0  # what takes longer is announced


@contextmanager
def watched(label: str, progress: Progress = None, *, said: bool = False) -> Iterator[Show]:
    """Yield the function that shows progress.

    progress: the user's own function; None for a bar on a terminal or in a notebook, and a line on
        stderr about the time left after the first steps of every long stage; False for neither
    said: the caller has said how long it takes, so this line is left out
    """
    if progress is False:
        yield None
    elif callable(progress):
        yield progress
    else:
        with tqdm(desc=label, leave=False, dynamic_ncols=True, smoothing=0.0, disable=None) as bar:
            first = math.inf
            latest = 0
            begun = math.nan  # NaN: nothing is to be said

            def show(done: int, total: int, note: str = "") -> None:
                nonlocal first, latest, begun
                now = time.monotonic()
                other_stage = total != bar.total or done < latest
                # The first step may load or compile what others only use.
                if other_stage or done <= max(first, 1):
                    first = done
                    begun = math.nan if said else now
                latest = done
                bar.total = total
                bar.set_postfix_str(note, refresh=False)
                bar.update(done - bar.n)
                left = (total - done) * (now - begun) / max(done - first, 1)
                if now - begun > MEASURED_S and left > LONG_S:
                    begun = math.nan
                    stage = f"{label}, {note}" if note else label
                    tqdm.write(f"{stage}: about {left / 60:.0f} min left", file=sys.stderr)

            yield show
