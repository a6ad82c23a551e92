"""Co-simulation: regional controllers in a SUMO city.

    import cosim

    result = cosim.run("grid7_peak", "dpc-pcrg", seed=1)
    print(result.mean_trip_time_s, result.to_frame())

`run` is one closed loop in SUMO, `run_tasks` many with a run folder;
`read_run` reads a run folder, `City` shows a city before anything runs. Names here are
imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim import api as api
    from cosim.api import read_run, run, run_tasks
    from cosim.evaluation.experiment import overview
    from cosim.evaluation.simulate import Result, Task
    from cosim.plant.plant import SumoPlant
    from cosim.plant.settings import Settings, settings
    from cosim.report.city import City

__all__ = [
    "City",
    "Result",
    "Settings",
    "SumoPlant",
    "Task",
    "overview",
    "read_run",
    "run",
    "run_tasks",
    "settings",
]
_PLACES = {
    "City": "report.city.City",
    "Result": "evaluation.simulate.Result",
    "Settings": "plant.settings.Settings",
    "SumoPlant": "plant.plant.SumoPlant",
    "Task": "evaluation.simulate.Task",
    "overview": "evaluation.experiment.overview",
    "read_run": "api.read_run",
    "run": "api.run",
    "run_tasks": "api.run_tasks",
    "settings": "plant.settings.settings",
}


def __getattr__(name: str) -> Any:
    if name == "api":
        return import_module("cosim.api")
    if name not in _PLACES:
        raise AttributeError(f"module 'cosim' has no attribute {name!r}")
    module, _, attribute = _PLACES[name].rpartition(".")
    return getattr(import_module(f"cosim.{module}"), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
