"""How annotations are checked at every call while testing: types, and the shapes of arrays
(jaxtyping, beartype)."""

from collections.abc import Callable
from typing import Any, get_args

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from jaxtyping import AbstractArray

# NumPy's numbers may stand for Python's, and whole ones for any.
check = beartype(
    conf=BeartypeConf(
        hint_overrides=FrozenDict(
            {
                int: int | np.integer,
                float: float | int | np.floating | np.integer,
                bool: bool | np.bool_,
            }
        )
    )
)


def check_arrays(function: Callable) -> Callable:
    """Only the parameters and the result that are, or hold, arrays with a shape: in tests of cosim
    made-up sessions and cities stand for real ones."""
    kept = {name: hint for name, hint in function.__annotations__.items() if _holds_arrays(hint)}
    if not kept:
        return function
    function.__annotations__ = kept
    return check(function)


def _holds_arrays(hint: Any) -> bool:
    return (isinstance(hint, type) and issubclass(hint, AbstractArray)) or any(
        map(_holds_arrays, get_args(hint))
    )
