"""Co-simulation: regional controllers in a SUMO city.

    import cosim

    result = cosim.run("grid7_peak", "dpc-pcrg", seed=1)
    print(result.mean_trip_time_s, result.to_frame())

`run` is one closed loop in SUMO, `read_run` reads one of a run folder, `City` shows a city. Names here are imported at
their first use; `cosim.api` has a function for every command.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim import api as api
    from cosim.api import evaluate, read_run, run, tune
    from cosim.plant.plant import SumoPlant
    from cosim.plant.settings import Settings, settings
    from cosim.report.city import City
    from nmfd.types import Result

__all__ = [
    "City",
    "Result",
    "Settings",
    "SumoPlant",
    "evaluate",
    "read_run",
    "run",
    "settings",
    "tune",
]
_PLACES = {
    "City": "report.city.City",
    "Settings": "plant.settings.Settings",
    "SumoPlant": "plant.plant.SumoPlant",
    "read_run": "api.read_run",
    "run": "api.run",
    "evaluate": "api.evaluate",
    "tune": "api.tune",
    "settings": "plant.settings.settings",
}


def __getattr__(name: str) -> Any:
    if name == "api":
        return import_module("cosim.api")
    if name == "Result":
        return import_module("nmfd.types").Result
    if name not in _PLACES:
        raise AttributeError(f"module 'cosim' has no attribute {name!r}")
    module, _, attribute = _PLACES[name].rpartition(".")
    return getattr(import_module(f"cosim.{module}"), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
