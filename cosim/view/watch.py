"""`cosim watch`: the runs, their server, and how it ends."""

import logging
import time
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress

import psutil

from cosim.evaluation.simulate import Task
from cosim.view.budget import Budget
from cosim.view.live import Viewer
from cosim.view.server import LOOPBACK, Server
from cosim.view.show import Seen, Show
from nmfd.runs.workers import Failure, ended

LOOK = 0.2  # s, between two looks at whether all is over
PATIENCE = 10.0  # s, for somebody to open the page of runs that have ended
NICER = 10  # how much the server gives way to the runs


def watch(
    tasks: Sequence[Task],
    *,
    host: str = LOOPBACK,
    port: int = 0,
    delay: float = 0.0,
    browse: bool = False,
    tell: Callable[[str], None] = print,
    progress: Callable[[int, int], None] | None = None,
) -> list[Seen]:
    """Run the tasks side by side with a live page, until they have ended and nobody looks any more; what they showed.

    delay: [s] of wall time per simulated second at least; browse: open the page here; tell: is given its address
    Raises InputError and RunFailed.
    """
    over_at: float | None = None
    for name in ("bokeh", "tornado"):  # what strangers send is no news
        logging.getLogger(name).setLevel(logging.CRITICAL)

    def done() -> bool:
        nonlocal over_at
        if not show.over:
            return False
        over_at = over_at or time.monotonic()
        if all(isinstance(seen.outcome, Failure) for seen in show.runs):
            return True
        return server.viewers == 0 and time.monotonic() - over_at > PATIENCE

    budget = Budget()
    server = Server(lambda document: Viewer(show, document, budget), host=host, port=port, budget=budget)
    show = Show(tasks, delay=delay, progress=progress)
    try:
        while show.picture is None and not show.over:
            show.changed.wait(LOOK)
        if show.picture is not None:
            with suppress(psutil.Error, OSError):  # what the runs need goes first
                psutil.Process().nice(
                    NICER
                    if not hasattr(psutil, "BELOW_NORMAL_PRIORITY_CLASS")
                    else (psutil.BELOW_NORMAL_PRIORITY_CLASS)
                )
            tell(f"Watch it at {server.address}")
            if browse:
                webbrowser.open(server.address)
            server.serve(LOOK, done)
    finally:
        show.close()
    failed = [(seen.name, seen.outcome) for seen in show.runs if isinstance(seen.outcome, Failure)]
    if failed:
        raise ended(failed)
    return show.runs
