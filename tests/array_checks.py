"""Checks arrays as annotated, and nothing else: in cosim's tests made-up sessions and cities stand for real ones."""

from collections.abc import Callable
from typing import Any, get_args

from annotations import check
from jaxtyping import AbstractArray


def arrays(function: Callable) -> Callable:
    """`function` with checks of the parameters and the result that are, or hold, arrays with a shape."""
    kept = {name: hint for name, hint in function.__annotations__.items() if _holds_arrays(hint)}
    if not kept:
        return function
    function.__annotations__ = kept
    return check(function)


def _holds_arrays(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray) or any(map(_holds_arrays, get_args(hint)))
