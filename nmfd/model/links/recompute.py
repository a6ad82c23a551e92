"""Derivatives that are computed by running a function again.

As torch.utils.checkpoint, which takes two thirds longer here: without `use_reentrant` it records
every tensor twice, and with it torch.autograd.grad is not possible.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_unflatten

T = TypeVar("T")


def run_again(function: Callable[..., T], *arguments: Any) -> T:
    """Return function(*arguments), without what its derivatives need.

    The derivatives run it again. It has the derivatives by its arguments only.

    arguments, result: named tuples and tuples of tensors and others
    """
    given, kind = tree_flatten(arguments)
    if not torch.is_grad_enabled():
        return function(*arguments)
    kinds = []

    def run(parts: list) -> list:
        after, kind_after = tree_flatten(function(*tree_unflatten(parts, kind)))
        kinds.append(kind_after)
        return after

    after = _Again.apply(run, *given)
    return tree_unflatten(list(after), kinds[0])


class _Again(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, run: Callable[[list], list], *given: Any) -> tuple:
        ctx.set_materialize_grads(False)
        ctx.run = run
        ctx.given = given
        return tuple(run(list(given)))

    @staticmethod
    def backward(ctx: Any, *derivatives: Tensor | None) -> tuple:
        inputs = []
        wanted = []
        for part, needed in zip(ctx.given, ctx.needs_input_grad[1:], strict=True):
            own = part
            if needed:
                own = part.detach().requires_grad_()
                wanted.append(own)
            inputs.append(own)
        with torch.enable_grad():
            after = ctx.run(inputs)
        outputs = []
        weights = []
        for part, weight in zip(after, derivatives, strict=True):
            if weight is not None and part.requires_grad:
                outputs.append(part)
                weights.append(weight)
        found = iter(torch.autograd.grad(outputs, wanted, weights, allow_unused=True))
        by_input = [next(found) if needed else None for needed in ctx.needs_input_grad[1:]]
        return (None, *by_input)
