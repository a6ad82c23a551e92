"""Numbers of compact policies and rules (nmfd.controllers.dpc.compact)."""

from typing import Annotated, NamedTuple

from pydantic import Field

from nmfd.runs import config


class Numbers(NamedTuple):
    """Parameters of a compact policy (-).

    The last three may be omitted in scenario.toml.
    """

    set_point: float = 1.0
    gain: float = 2.0
    relief: float = 0.0
    price: float = 1.0
    price_from: float = 0.6
    elsewhere: float = 0.0
    elsewhere_from: float = 0.6
    metering: float = 1.5
    integral: float = 0.0
    metering_protected: float = 0.0
    metering_gain: float = 1.0


NumbersOption = Annotated[config.Numbers, Field(min_length=8, max_length=11)]
MEANING = (
    "set_point, gain, relief, price, price_from, elsewhere, elsewhere_from, metering, "
    "integral (0), metering_protected (0), metering_gain (1); see nmfd/controllers/dpc/compact.py"
)
