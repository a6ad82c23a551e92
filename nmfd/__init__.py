"""Regional (NMFD) traffic model, controllers on it, and the closed loop.

    >>> import nmfd
    >>> result = nmfd.run("economic_mpc", nmfd.PiGating(kp=2.0), seed=1)
    >>> print(f"{result.total_time_spent:.3g} veh s")
    8.87e+07 veh s

`run` is one closed loop, `benchmark` many with a run folder; `train` makes a DPC policy. A
controller is its options (`NoControl`, `PiGating`, `EconomicMpc`, `Dpc`, ...), a name, or any
object with `reset` and `act` (see `Controller`; `nmfd new-controller` writes a template). Names
here are imported at their first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nmfd import api as api
    from nmfd.api import (
        benchmark,
        controller,
        load_scenario,
        options,
        robustness,
        run,
        train,
    )
    from nmfd.controllers.base import Options
    from nmfd.controllers.dpc.options import ConstantControl, Dpc, GatingRule, PricingRule
    from nmfd.controllers.dpc.policy import ModuleController, PerimeterLayer, SplitsLayer
    from nmfd.controllers.dpc.rollout import Trajectories
    from nmfd.controllers.mpc.controller import EconomicMpc
    from nmfd.controllers.open_loop import Bound
    from nmfd.controllers.rules import Greedy, NoControl, PiGating, Probing, RouteGuidance
    from nmfd.errors import InputError
    from nmfd.metrics import summary, total_time_spent
    from nmfd.model.links.plant import LinkPlant
    from nmfd.model.mfd import Cubic, Mfd, PiecewiseLinear, trapezoid
    from nmfd.model.planning import PlanningModel
    from nmfd.model.plant import AcyclicPlant, NmfdPlant
    from nmfd.model.regional_model import RegionalModel, load_network
    from nmfd.model.scenario import Scenario
    from nmfd.studies.measured import Identified, identify
    from nmfd.types import Controller, Controls, Observation, Plant, Result, State, Status

__version__ = "0.2.0"  # of the package perimeter-cosim, nmfd and cosim alike
_MODULES = {
    "api": (
        "benchmark",
        "controller",
        "load_scenario",
        "options",
        "robustness",
        "run",
        "train",
    ),
    "controllers.base": ("Options",),
    "controllers.dpc.options": ("ConstantControl", "Dpc", "GatingRule", "PricingRule"),
    "controllers.dpc.policy": ("ModuleController", "PerimeterLayer", "SplitsLayer"),
    "controllers.dpc.rollout": ("Trajectories",),
    "controllers.mpc.controller": ("EconomicMpc",),
    "controllers.open_loop": ("Bound",),
    "controllers.rules": ("Greedy", "NoControl", "PiGating", "Probing", "RouteGuidance"),
    "errors": ("InputError",),
    "metrics": ("summary", "total_time_spent"),
    "model.links.plant": ("LinkPlant",),
    "model.mfd": ("Cubic", "Mfd", "PiecewiseLinear", "trapezoid"),
    "model.planning": ("PlanningModel",),
    "model.plant": ("AcyclicPlant", "NmfdPlant"),
    "model.regional_model": ("RegionalModel", "load_network"),
    "model.scenario": ("Scenario",),
    "studies.measured": ("Identified", "identify"),
    "types": ("Controller", "Controls", "Observation", "Plant", "Result", "State", "Status"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name == "api":
        return import_module("nmfd.api")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'nmfd' has no attribute {name!r}")
    return getattr(import_module(f"nmfd.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
