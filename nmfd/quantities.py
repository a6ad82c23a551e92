"""The arrays of a run: axes, unit and meaning of each, for files, tables and documentation.

Axes: time (T+1 states), interval (T decisions), region (where vehicles are or come from), next_region, destination; in
a city gateway and edge, in the order of cosim.sumo.net.City.
"""

from collections.abc import Mapping
from dataclasses import field, fields
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


def quantity(*dimensions: str, unit: str, text: str) -> Any:
    """Return a dataclass field that holds an array with these named axes."""
    return field(metadata={"quantity": Quantity(dimensions, unit, text)})


def quantities(kind: type) -> dict[str, Quantity]:
    """Return the quantities of a dataclass by the names of its fields."""
    return {f.name: f.metadata["quantity"] for f in fields(kind) if "quantity" in f.metadata}


def variables(kind: type, values: Mapping) -> dict[str, tuple]:
    """Return the `values` of quantities of `kind` as xarray.Dataset takes them."""
    return dataset_variables(quantities(kind), values)
