"""The arrays of a run: axes, unit and meaning of each, for files, tables and documentation.

Axes: time (T+1 states), interval (T decisions), region (where vehicles are or come from), next_region, destination; in
a city gateway and edge, in the order of cosim.sumo.net.City.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class Quantity(NamedTuple):
    """Named axes, unit ("" of texts) and meaning of an array; attributes: more of them, for the file."""

    dimensions: tuple[str, ...]
    unit: str
    text: str
    attributes: Mapping[str, Any] = {}


def dataset_variables(about: Mapping[str, Quantity], values: Mapping[str, Any]) -> dict[str, tuple]:
    """Return the `values` as xarray.Dataset takes them: name -> (dimensions, array, attributes)."""
    return {
        name: (
            quantity.dimensions,
            _array(values[name]),
            {"long_name": quantity.text, **({"units": quantity.unit} if quantity.unit else {}), **quantity.attributes},
        )
        for name, quantity in about.items()
        if name in values
    }


def _array(values: Any) -> np.ndarray:
    array = np.asarray(values)
    return array.astype(object) if array.dtype.kind == "U" else array  # as netCDF gives texts back
