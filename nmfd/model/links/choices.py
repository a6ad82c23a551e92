"""Options of the table [sumo] that the link model takes."""

from typing import Literal

from nmfd.model.scenario import Scenario
from nmfd.runs import config
from nmfd.runs.config import Share, setting


class Choices(config.Settings):
    """Signals and drivers of the city; other values are not in the link model."""

    signals: Literal["fixed", "max-pressure"] = setting("control of the signals", "fixed")
    lookahead: float = setting("as of max-pressure in a city", 1.0, unit="s", gt=0.0)
    chain_limit: Share = setting(
        "share of a link's room beyond which no gate holds vehicles there; 0: no limit", 0.6
    )
    guided: bool = setting("drivers are guided by travel times without a command", False)
    compliance: Share = setting("share of the drivers who follow the guidance", 1.0)
    rerouting: Share = setting("share of the drivers who weigh travel times by themselves", 0.0)
    metering: float = setting("metering without a command; 0: never", 0.0, ge=0.0, le=0.0)
    measurement: Literal["exact"] = setting("what controllers see", "exact")


def choices_of(scenario: Scenario) -> Choices:
    """Return the choices of the table [sumo].

    Raises: InputError for a value that the link model has not
    """
    own = {name: value for name, value in scenario.sumo.items() if name in Choices.model_fields}
    return config.checked(Choices, own, scenario.where, "sumo.")
