"""Planning model of a controller: its belief about the city, which may differ from the simulated city.

It shares no array with the scenario, so that a controller cannot change the plant.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool

from nmfd.arrays import PairsOverTime, PerPair
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel, check_step, load_network
from nmfd.model.scenario import Scenario
from nmfd.runs import config
from nmfd.runs.config import Problem, Settings, Text, setting

GUIDED = "guided"  # subfolder of a network with the model of the same city with guided drivers
GUIDING = ("mpc-pcrg", "dpc-pcrg")  # prefixes of the controllers that plan with it


@dataclass(frozen=True, kw_only=True)
class PlanningModel:
    """Regional model, forecast and options that a controller, filter or supervisor has before a run.

    name: of the scenario
    network: regional model; the city may follow another one, or none
    step: control interval (s)
    steps: T
    forecast: demand from i to j in interval k (veh/s, (T, R, R) [k, i, j])
    measurement_std: standard deviation of the noise on every observed x_ij (veh)
    integrator, substeps: of the regional model
    protected: regions that gating protects
    controller_options: controller name -> its table in [controllers]
    initial: vehicles in i bound for j at the start (veh, (R, R)); None for an empty city
    folder: of the scenario, or None
    """

    name: str
    network: RegionalModel
    step: float
    steps: int
    forecast: PairsOverTime
    measurement_std: float = 0.0
    integrator: str = "euler"
    substeps: int = 1
    protected: tuple[int, ...] = ()
    controller_options: Mapping[str, dict] = field(default_factory=dict)
    initial: PerPair | None = None
    folder: Path | None = None

    @property
    def destinations(self) -> Bool[np.ndarray, " R"]:
        """Regions that are the destination of any trip, (R,)."""
        vehicles = self.forecast.sum(axis=(0, 1))
        return (vehicles if self.initial is None else vehicles + self.initial.sum(axis=0)) > 0

    @property
    def where(self) -> str:
        """File that error messages name."""
        return "scenario.toml" if self.folder is None else str(self.folder / "scenario.toml")


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


def options(declaration: type[Declared], planning: PlanningModel, name: str, table: str = "") -> Declared:
    """Return the checked options of controller `name`.

    table: name of the table in error messages, if not `name`
    Raises: InputError
    """
    prefix = f"controllers.{table or name}."
    checked = config.checked(declaration, planning.controller_options.get(name, {}), planning.where, prefix)
    if problem := checked.misfit(planning):
        raise config.error(planning.where, prefix + problem.key, str(problem))
    return checked


def planning_model(scenario: Scenario, controller: str = "", table: str = "") -> PlanningModel:
    """Return the planning model of `controller`.

    Its network is the option `model`, else the guided model of the city if the controller guides routes, else the
    scenario's. The options of [controllers.TABLE] go over those of [controllers.CONTROLLER].

    Raises: InputError
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
        network = copy.deepcopy(scenario.network)
    return PlanningModel(
        name=scenario.name,
        network=network,
        step=scenario.step,
        steps=scenario.steps,
        forecast=scenario.forecast.copy(),
        measurement_std=scenario.measurement_std,
        integrator=scenario.integrator,
        substeps=scenario.substeps,
        protected=scenario.protected,
        initial=copy.copy(scenario.initial),
        folder=scenario.folder,
        controller_options=copy.deepcopy({**tables, controller: merged} if controller else dict(tables)),
    )


def other_model(scenario: Scenario, folder: Path, where: str = "") -> RegionalModel:
    """Return the regional model in `folder`. Raise InputError, which names `where`, if it is of another city."""
    model = load_network(folder)
    if not np.array_equal(model.adjacency, scenario.network.adjacency):
        raise InputError(
            f"{where or folder / 'network.toml'}: network {model.name} has other regions or boundaries than "
            f"{scenario.network.name}; identify one for the same city with 'cosim identify'"
        )
    check_step(model, scenario.step / scenario.substeps, f"{model.folder}")
    return model


def guided_model(network: RegionalModel) -> Path | None:
    """Return the folder of the city's model with guided drivers, if there is one."""
    folder = None if network.folder is None else network.folder / GUIDED
    return folder if folder is not None and (folder / "network.toml").is_file() else None
