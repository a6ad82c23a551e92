"""torch on one thread: the matrices here are small, and more threads only wait for one another."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """torch computes on one thread within the block, or, as a decorator, `@one_thread()`, within the function.

    Afterwards it has as many as before: who imports the package keeps their own setting. On a busy machine the threads
    of a closed loop took twenty times as long to wait for one another as it takes to compute.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
