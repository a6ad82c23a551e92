"""Co-simulation: regional controllers in a SUMO city.

    import cosim

    result = cosim.run("scenarios/grid7_peak", "dpc-pcrg", seed=1)
    print(result.facts["mean_trip_time_s"], result.trajectory.to_frame())

`run` is one closed loop in SUMO, `run_tasks` many with a run folder, `sweep` many more on processes or a cluster;
`read_run` reads a run folder. Names here are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cosim.api import run
    from cosim.experiment import experiment as run_tasks
    from cosim.experiment import overview, read_run
    from cosim.plant import SumoPlant
    from cosim.simulate import Result, Task
    from cosim.sumo_settings import Settings, settings
    from cosim.sweeps import Sweep, sweep

__all__ = [
    "Result", "Settings", "SumoPlant", "Sweep", "Task", "overview", "read_run", "run", "run_tasks", "settings", "sweep"]
_PLACES = {
    "Result": "simulate.Result", "Settings": "sumo_settings.Settings", "SumoPlant": "plant.SumoPlant",
    "Task": "simulate.Task",
    "overview": "experiment.overview", "read_run": "experiment.read_run", "run": "api.run",
    "run_tasks": "experiment.experiment", "settings": "sumo_settings.settings", "Sweep": "sweeps.Sweep",
    "sweep": "sweeps.sweep"}


def __getattr__(name: str):
    if name not in _PLACES:
        raise AttributeError(f"module 'cosim' has no attribute {name!r}")
    module, attribute = _PLACES[name].split(".")
    return getattr(import_module(f"cosim.{module}"), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
