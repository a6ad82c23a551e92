"""What the arrays of a run are: axes, unit and meaning, said once beside the field, for files, tables and docs.

Axes: time (T+1 states), interval (T decisions), region (where vehicles are or come from), next_region, destination; in
a city gateway and edge, in the order of cosim.sumo.net.City.
"""

from collections.abc import Mapping
from dataclasses import field, fields
from typing import Any

import numpy as np


def quantity(*dimensions: str, unit: str, text: str, attributes: Mapping | None = None, **options: Any) -> Any:
    """A dataclass field that holds an array with these named axes; options: of dataclasses.field.

    unit: "" of texts; attributes: more of them, for the file
    """
    attributes = {**({"units": unit} if unit else {}), **(attributes or {})}
    return field(metadata={"dimensions": dimensions, "text": text, "attributes": attributes}, **options)


def quantities(kind: type) -> dict[str, Mapping]:
    """Name -> dimensions, text and attributes of the fields of a dataclass that are quantities."""
    return {f.name: f.metadata for f in fields(kind) if "dimensions" in f.metadata}


def variables(kind: type, values: Mapping) -> dict[str, tuple]:
    """The `values` of quantities of `kind`, as far as given, as xarray.Dataset takes them: name -> (dimensions, array,
    attributes)."""
    return {
        name: (about["dimensions"], np.asarray(values[name]), {"long_name": about["text"], **about["attributes"]})
        for name, about in quantities(kind).items()
        if name in values
    }
