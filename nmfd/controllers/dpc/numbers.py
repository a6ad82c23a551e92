"""Numbers of compact policies, rules and constant control."""

from typing import Annotated, NamedTuple

from pydantic import Field

from nmfd.runs import config


class Numbers(NamedTuple):
    """Parameters of a compact policy (-).

    The last four may be omitted in scenario.toml.
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
    metering_slope: float = 1.0


NumbersOption = Annotated[config.Numbers, Field(min_length=8, max_length=12)]
MEANING = (
    "set_point, gain, relief, price, price_from, elsewhere, elsewhere_from, metering, "
    "integral (0), metering_protected (0), metering_gain (1), metering_slope (1); "
    "see nmfd/controllers/dpc/compact.py"
)


class Levels(NamedTuple):
    """Numbers of constant control (-).

    gate: opening of the boundaries into protected regions, from 0 (u_min) to 1 (u_max)
    price, elsewhere: prices of protected and of other regions
    metering: departures of a region in FILL_TIME_S, as a share of its critical accumulation
    """

    gate: float = 1.0
    price: float = 0.0
    elsewhere: float = 0.0
    metering: float = 1.0


LevelsOption = Annotated[config.Numbers, Field(min_length=4, max_length=4)]
LEVELS_MEANING = "gate, price, elsewhere, metering; see nmfd/controllers/dpc/constant.py"
