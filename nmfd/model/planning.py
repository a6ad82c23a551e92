"""What a controller is made from: its belief about the city, which is not the city.

A `Scenario` is what happens. A `PlanningModel` is what somebody who plans ahead knows of it: a regional model, a
forecast of the demand, bounds and options. It shares no array with the scenario: what a controller does to it changes
nobody else's result.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from nmfd.arrays import PairsOverTime, PerPair
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel, check_step, load_network
from nmfd.model.scenario import Scenario
from nmfd.runs import config
from nmfd.runs.config import Settings, Text, setting

GUIDED = "guided"  # in a network's folder: that of the same city's model with guided drivers
GUIDING = ("mpc-pcrg", "dpc-pcrg")  # beginnings of the names of the controllers that plan with it


class PlanningOptions(Settings):
    """Options of every controller, beside its own."""

    model: Text | None = setting(
        "folder or shipped name of the regional model to plan with; by default that of the scenario's network or, for "
        "controllers that guide routes, the one in its folder guided",
        None,
    )


@dataclass(frozen=True, kw_only=True)
class PlanningModel:
    """What a controller, a filter or a supervisor knows before a run begins.

    name: of the scenario
    network: the regional model that is believed in; the city may follow another one, or none
    step: control interval [s]
    steps: T
    forecast: (T, R, R) [veh/s], [k, i, j] = vehicles expected to start in i bound for j, during interval k
    measurement_std: of the Gaussian noise that is expected on every observed x_ij [veh]
    integrator, substeps: of the regional model, as of nmfd.model.scenario.Scenario
    protected: the regions that gating protects
    controller_options: controller name -> its table in [controllers]
    initial: (R, R) [veh], [i, j] = vehicles in i bound for j when a run begins; None: nobody
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
        """(R,): whether anybody is bound for a region."""
        vehicles = self.forecast.sum(axis=(0, 1))
        return (vehicles if self.initial is None else vehicles + self.initial.sum(axis=0)) > 0

    @property
    def where(self) -> str:
        """The file that error messages name."""
        return "scenario.toml" if self.folder is None else str(self.folder / "scenario.toml")


def planning_model(scenario: Scenario, controller: str = "") -> PlanningModel:
    """What `controller` is made from in `scenario`.

    Its regional model is the network that the controller's option `model` names, or else, where it guides routes, the
    one in the folder GUIDED of the scenario's network, if there is one, or else the scenario's own: drivers who are
    guided, or who reroute by themselves, make another model of the same city. A controller "NAME+..." is NAME with the
    options of [controllers."NAME+..."] over those of [controllers.NAME]. Raises InputError.
    """
    name, tables = controller.partition("+")[0], scenario.controller_options
    options = {**tables.get(name, {}), **tables.get(controller, {})}
    if "model" in options and scenario.folder is not None:
        where, prefix = scenario.folder / "scenario.toml", f"controllers.{controller}."
        model = config.checked(PlanningOptions, {"model": options.pop("model")}, where, prefix).model
        assert model is not None  # TOML has no null
        network = other_model(scenario, scenario.folder / model, f"{where}: {prefix}model")
    elif name.startswith(GUIDING) and (folder := guided_model(scenario.network)) is not None:
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
        controller_options=copy.deepcopy({**tables, name: options} if name else dict(tables)),
    )


def with_model(planning: PlanningModel, scenario: Scenario, folder: Path) -> PlanningModel:
    """`planning` with the regional model in `folder`, of the city of `scenario`. Raises InputError."""
    return replace(planning, network=other_model(scenario, folder))


def other_model(scenario: Scenario, folder: Path, where: str = "") -> RegionalModel:
    """The regional model in `folder`, of the same city as that of `scenario`.

    where: who names it, for the InputError
    """
    model = load_network(folder)
    if not np.array_equal(model.adjacency, scenario.network.adjacency):
        raise InputError(
            f"{where or folder / 'network.toml'}: network {model.name} has other regions or boundaries than "
            f"{scenario.network.name}; identify one for the same city with 'cosim identify'"
        )
    check_step(model, scenario.step / scenario.substeps, f"{model.folder}")
    return model


def guided_model(network: RegionalModel) -> Path | None:
    """The folder of the same city's model with guided drivers, if there is one beside that of the drivers' own."""
    folder = None if network.folder is None else network.folder / GUIDED
    return folder if folder is not None and (folder / "network.toml").is_file() else None
