"""Whether a strategy can run in a city: asked before anything is simulated or written, and by the plant itself."""

from cosim.plant.launch import own_files
from cosim.plant.programmes import CitySignals, city_signals
from cosim.plant.settings import ESTIMATE, FIXED, PRESSURES, Settings, scenario_file, settings
from cosim.sumo.net import City
from nmfd.controllers.strategy import Strategy
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario


def check_strategy(strategy: Strategy, scenario: Scenario, city: City) -> None:
    """InputError, in a line that begins with the strategy, unless it can run in this city."""
    try:
        chosen = settings(scenario).changed(**strategy.city)
        check_settings(scenario, chosen)
        if chosen.signals != FIXED:
            signals_of(city, scenario, chosen)
    except InputError as error:
        raise InputError(f"controller {strategy.name} cannot run here: {error}") from None


def signals_of(city: City, scenario: Scenario, chosen: Settings) -> CitySignals:
    """The signals of the city, by what may be done with them. InputError where the chosen programme fits none."""
    return city_signals(city, chosen, own_files(scenario, chosen.additional))


def check_settings(scenario: Scenario, chosen: Settings) -> None:
    """InputError for what needs lanes where there are none."""
    for key, values, what in (
        ("signals", PRESSURES, "counts vehicles lane by lane"),
        ("measurement", (ESTIMATE,), "needs loop detectors on lanes"),
    ):
        if chosen.mesoscopic and (value := getattr(chosen, key)) in values:
            raise InputError(
                f"{scenario_file(scenario)}: sumo.{key}: {value} {what}, but SUMO's mesoscopic model has no lanes; "
                "omit it, or set mesoscopic = false (import the city without --mesoscopic)"
            )
