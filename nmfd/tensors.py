"""Shapes of torch's tensors for annotations; one thread for torch.

nmfd.arrays has those of NumPy. B: any batch, or none, that broadcasts.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float

THREADS = torch.get_num_threads()  # outside of `one_thread`: one per core, or OMP_NUM_THREADS
PerRollout = Float[torch.Tensor, "*#B"]
PerRegion = Float[torch.Tensor, "*#B R"]
PerPair = Float[torch.Tensor, "*#B R R"]
PerTurn = Float[torch.Tensor, "*#B R R R"]


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread within the block.

    As a decorator: within the function. The matrices here are small: on a busy machine, more
    threads wait for one another twenty times longer than they compute. Afterwards torch has its
    number of threads back.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
