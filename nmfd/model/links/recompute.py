"""Derivatives that are computed by running a function again.

As torch.utils.checkpoint, which takes two thirds longer here: without `use_reentrant` it records
every tensor twice, and with it torch.autograd.grad is not possible.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_unflatten

T = TypeVar("T")
Parts = Sequence[Any]  # tensors and others
Run = Callable[[Parts], tuple[list, Any]]


def at_once(name: Hashable, run: Run, given: Parts) -> tuple[list, Any]:
    """Return run(given); name: of `run`."""
    return run(given)


class Recordings:
    """Functions of tensors that a GPU ran once, and plays (CUDA graphs).

    Python takes longer to launch thousands of small operations than a GPU to do them.
    """

    def __init__(self) -> None:
        self._tapes: dict[Hashable, tuple[list, torch.cuda.CUDAGraph, list, Any]] = {}
        self._pool: Any = None

    def play(self, name: Hashable, run: Run, given: Parts) -> tuple[list, Any]:
        """Return run(given), as `at_once`.

        A call with the name, shapes and other parts of an earlier one plays what that one ran.
        """
        shapes = [(part.shape, part.dtype) if isinstance(part, Tensor) else part for part in given]
        key = (name, *shapes)
        if key not in self._tapes:
            self._tapes[key] = self._record(run, given)
        own, graph, after, kind = self._tapes[key]
        for place, part in zip(own, given, strict=True):
            if isinstance(place, Tensor):
                place.copy_(part)
        graph.replay()
        return [part.clone() if isinstance(part, Tensor) else part for part in after], kind

    def _record(self, run: Run, given: Parts) -> tuple[list, torch.cuda.CUDAGraph, list, Any]:
        """Return places of the arguments, a recording, and its result."""
        own = [part.detach().clone() if isinstance(part, Tensor) else part for part in given]
        # The first run loads kernels, which cannot be recorded.
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            run(own)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool):
            after, kind = run(own)
        self._pool = graph.pool()
        return own, graph, after, kind


def run_again(function: Callable[..., T], *arguments: Any, play: Callable = at_once) -> T:
    """Return function(*arguments), without what its derivatives need.

    The derivatives run it again. It has the derivatives by its arguments only.

    arguments, result: named tuples and tuples of tensors and others
    play: at_once, or that of Recordings, which are for this function
    """
    given, kind = tree_flatten(arguments)
    name = repr(kind)
    kinds = []

    def run(parts: Parts) -> tuple[list, Any]:
        return tree_flatten(function(*tree_unflatten(list(parts), kind)))

    def forward(parts: Parts) -> tuple:
        after, kind_after = play(name, run, parts)
        kinds.append(kind_after)
        return tuple(after)

    def derive(needed: tuple[bool, ...], weights: Parts) -> list:
        def derivatives(parts: Parts) -> tuple[list, None]:
            count = len(needed)
            return _derivatives(run, parts[:count], needed, parts[count:]), None

        return play((name, needed), derivatives, [*given, *weights])[0]

    after = _Again.apply(forward, derive, *given) if torch.is_grad_enabled() else forward(given)
    return tree_unflatten(list(after), kinds[0])


class _Again(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, forward: Callable, derive: Callable, *given: Any) -> tuple:
        ctx.set_materialize_grads(False)
        ctx.derive = derive
        return forward(given)

    @staticmethod
    def backward(ctx: Any, *weights: Tensor | None) -> tuple:
        return (None, None, *ctx.derive(ctx.needs_input_grad[2:], weights))


def _derivatives(
    run: Run, given: Parts, needed: Sequence[bool], weights: Sequence[Tensor | None]
) -> list[Tensor | None]:
    """Return the derivatives of the weighted sum of the results.

    needed: True for the parts by which they are
    weights: of the results; None: not in the sum
    """
    inputs = []
    wanted = []
    for part, is_needed in zip(given, needed, strict=True):
        own = part
        if is_needed:
            own = part.detach().requires_grad_()
            wanted.append(own)
        inputs.append(own)
    with torch.enable_grad():
        after, _ = run(inputs)
    outputs = []
    weights_of_outputs = []
    for part, weight in zip(after, weights, strict=True):
        if weight is not None and part.requires_grad:
            outputs.append(part)
            weights_of_outputs.append(weight)
    found = iter(torch.autograd.grad(outputs, wanted, weights_of_outputs, allow_unused=True))
    return [next(found) if is_needed else None for is_needed in needed]
