"""Shapes of torch's tensors for annotations, as nmfd.arrays has them, and torch on one thread.

B: any batch, or none, that broadcasts.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float

PerRollout = Float[torch.Tensor, "*#B"]
PerRegion = Float[torch.Tensor, "*#B R"]
PerPair = Float[torch.Tensor, "*#B R R"]
PerTurn = Float[torch.Tensor, "*#B R R R"]


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread within the block, or, as a decorator, within the function.

    The matrices here are small: on a busy machine more threads wait for one another twenty times
    longer than they compute. Afterwards torch has its number of threads back.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
