"""Co-simulation: regional controllers in a SUMO city.

    >>> import cosim
    >>> result = cosim.run("demo", "pi-gating", seed=1, steps=2)
    >>> result.accumulation.shape  # states, regions, destinations; as a table: result.data.accumulation.to_dataframe()
    (3, 5, 5)

`run` is one closed loop in SUMO, `read_run` reads one of a run folder, `City` shows a city, `list`
what is shipped. Names here are imported at their first use; `cosim.api` has a function for every
command.
"""

from collections.abc import Iterable
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim import api as api
    from cosim.api import evaluate, run, tune
    from cosim.evaluation.results import read_run
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
    "list",
    "read_run",
    "run",
    "settings",
    "tune",
]
_PLACES = {
    **dict.fromkeys(("evaluate", "run", "tune"), "cosim.api"),
    "read_run": "cosim.evaluation.results",
    "SumoPlant": "cosim.plant.plant",
    **dict.fromkeys(("Settings", "settings"), "cosim.plant.settings"),
    "City": "cosim.report.city",
    "Result": "nmfd.types",
}


def __getattr__(name: str) -> Any:
    if name == "api":
        return import_module("cosim.api")
    if name not in _PLACES:
        raise AttributeError(f"module 'cosim' has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> Iterable[str]:
    return sorted({*globals(), *__all__})


def list() -> None:
    """Print the shipped scenarios, networks and policies, and all controllers."""
    print(import_module("nmfd.api").catalogue())
