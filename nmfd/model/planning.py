"""Planning model of a controller: its belief about the city, which may differ from the simulated
city.

It shares no array with the scenario, so that a controller cannot change the plant.
"""

import copy
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool

from nmfd.arrays import PairsOverTime
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel, check_step, load_network
from nmfd.model.scenario import Horizon, Scenario
from nmfd.runs import config
from nmfd.runs.config import Problem, Settings, Text, setting

GUIDED = "guided"  # subfolder of a network with the model of the same city with guided drivers
GUIDING = ("mpc-pcrg", "dpc-pcrg", "pricing-rule")  # prefixes of the controllers that plan with it


@dataclass(frozen=True, kw_only=True)
class PlanningModel(Horizon):
    """Model of a controller or filter before a run; the city may follow another network, or none.

    forecast: demand from i to j in interval k (veh/s, (T, R, R) [k, i, j])
    """

    forecast: PairsOverTime

    @property
    def destinations(self) -> Bool[np.ndarray, " R"]:
        """Regions that are the destination of any trip, (R,)."""
        vehicles = self.forecast.sum(axis=(0, 1))
        return (vehicles if self.initial is None else vehicles + self.initial.sum(axis=0)) > 0


class Options(Settings):
    """Options of every controller."""

    model: Text | None = setting(
        "folder or shipped name of the regional model to plan with; by default that of the scenario's network or, for "
        "controllers that guide routes, the one in its folder guided",
        None,
    )

    def misfit(self, planning: PlanningModel) -> Problem | None:
        """Return what does not fit the planning model, or None."""
        return None


Declared = TypeVar("Declared", bound=Options)


def options(
    declaration: type[Declared], planning: PlanningModel, name: str, table: str = ""
) -> Declared:
    """Return the checked options of controller `name`; errors name `table` instead. Raise
    InputError."""
    prefix = f"controllers.{table or name}."
    checked = config.checked(
        declaration, planning.controller_options.get(name, {}), planning.where, prefix
    )
    if problem := checked.misfit(planning):
        raise config.error(planning.where, prefix + problem.key, str(problem))
    return checked


def planning_model(scenario: Scenario, controller: str = "", table: str = "") -> PlanningModel:
    """Return the planning model of `controller`, with the options of `table` over its own. Raise
    InputError.

    Its network is the option `model`, else the guided model of the city if the controller guides
    routes, else the scenario's.
    """
    table, tables = table or controller, scenario.controller_options
    merged = {**tables.get(controller, {}), **tables.get(table, {})}
    if "model" in merged and scenario.folder is not None:
        where, prefix = scenario.folder / "scenario.toml", f"controllers.{table}."
        model = config.checked(Options, {"model": merged.pop("model")}, where, prefix).model
        assert model is not None  # TOML has no null
        network = other_model(scenario, scenario.folder / model, f"{where}: {prefix}model")
    elif controller.startswith(GUIDING) and (folder := guided_model(scenario.network)) is not None:
        network = other_model(scenario, folder)
    else:
        network = scenario.network
    own = (part.name for part in fields(Horizon) if part.name != "network")
    shared = {name: copy.deepcopy(getattr(scenario, name)) for name in own}
    if controller:
        shared["controller_options"][controller] = copy.deepcopy(merged)
    return PlanningModel(**shared, network=copy.deepcopy(network), forecast=scenario.demand.copy())


def other_model(scenario: Scenario, folder: Path, where: str = "") -> RegionalModel:
    """Return the regional model in `folder`. Raise InputError, which names `where`, if it is of
    another city."""
    model = load_network(folder)
    if not np.array_equal(model.adjacency, scenario.network.adjacency):
        what = f"network {model.name} has other regions or boundaries than {scenario.network.name}"
        remedy = "identify one for the same city with 'cosim identify'"
        raise InputError(f"{where or folder / 'network.toml'}: {what}; {remedy}")
    check_step(model, scenario.step / scenario.substeps, f"{model.folder}")
    return model


def guided_model(network: RegionalModel) -> Path | None:
    """Return the folder of the city's model with guided drivers, if there is one."""
    folder = None if network.folder is None else network.folder / GUIDED
    return folder if folder is not None and (folder / "network.toml").is_file() else None
