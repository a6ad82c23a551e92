"""How annotations are checked at every call while testing: types, and the shapes of arrays (jaxtyping, beartype)."""

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype

# NumPy's numbers may stand for Python's, and whole ones for any.
check = beartype(conf=BeartypeConf(hint_overrides=FrozenDict({
    int: int | np.integer, float: float | int | np.floating | np.integer, bool: bool | np.bool_})))
