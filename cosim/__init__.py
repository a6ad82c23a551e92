"""Co-simulation: regional controllers in a SUMO city.

    >>> import cosim
    >>> result = cosim.run("demo", nmfd.PiGating(), city=cosim.Settings(guided=True), steps=2)
    >>> result.accumulation.shape  # states, regions, destinations
    (3, 5, 5)

`run` is one closed loop in SUMO, `evaluate` many in a folder, `read_run` reads one of them. A city
is the scenario's, changed by `Settings`; `City` shows it. Names here are imported at their first
use; `cosim.api` has functions of the other commands.
"""

from collections.abc import Iterable
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cosim import api as api
    from cosim.api import (
        Tuned,
        catalogue,
        compare,
        evaluate,
        plan,
        report,
        run,
        study,
        tune,
    )
    from cosim.evaluation.identify import identify
    from cosim.evaluation.results import read_run
    from cosim.importing.importer import import_city
    from cosim.plant.plant import SumoPlant
    from cosim.plant.settings import Settings, settings
    from cosim.plant.strategy import Strategy
    from cosim.reporting.city import City
    from nmfd.types import Result

_MODULES = {
    "cosim.api": (
        "Tuned",
        "catalogue",
        "compare",
        "evaluate",
        "plan",
        "report",
        "run",
        "study",
        "tune",
    ),
    "cosim.evaluation.identify": ("identify",),
    "cosim.evaluation.results": ("read_run",),
    "cosim.importing.importer": ("import_city",),
    "cosim.plant.plant": ("SumoPlant",),
    "cosim.plant.settings": ("Settings", "settings"),
    "cosim.plant.strategy": ("Strategy",),
    "cosim.reporting.city": ("City",),
    "nmfd.types": ("Result",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name == "api":
        return import_module("cosim.api")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'cosim' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> Iterable[str]:
    return sorted({*globals(), *__all__})
