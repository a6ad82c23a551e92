"""Types of the front door, for `mypy .ci/typed.py`; nothing here is run."""

from pathlib import Path
from typing import assert_type

import xarray
from torch import nn

import cosim
import nmfd
from nmfd.runs.frame import Table


def front_door(module: nn.Linear) -> None:
    """Every line is an error of mypy if the type is another one, or Any."""
    result = nmfd.run("economic_mpc", nmfd.PiGating(kp=2.0), seed=1)
    assert_type(result.total_time_spent, float)
    assert_type(result.accumulation, xarray.DataArray)
    assert_type(result.controller, str)
    assert_type(nmfd.train("economic_mpc"), Path)
    assert_type(nmfd.train("economic_mpc", policy=module), nn.Linear)
    assert_type(nmfd.benchmark("economic_mpc", "no-control"), Table)
    assert_type(nmfd.robustness("economic_mpc", ["no-control"]), Table)
    assert_type(cosim.run("demo", nmfd.PiGating()).total_time_spent, float)
    assert_type(cosim.evaluate("demo", ["no-control"]), Table)
    assert_type(cosim.compare("runs"), Table)
    assert_type(cosim.tune("demo", "pi-gating", options={}).table, Table)
    assert_type(nmfd.PiGating().kp, float | None)
