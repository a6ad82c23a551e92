"""Planning model of a controller.

It may differ from the simulated city. It shares no array with the scenario, so that a controller
cannot change the plant.
"""

import copy
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from nmfd.arrays import PairsOverTime
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel, check_step, load_network
from nmfd.model.scenario import Horizon, Scenario

GUIDED = "guided"  # subfolder of a network with the model of the same city with guided drivers


@dataclass(frozen=True, kw_only=True)
class PlanningModel(Horizon):
    """Model that a controller or filter plans with.

    The city may follow another network, or none.

    forecast: demand from i to j in interval k (veh/s, (T, R, R) [k, i, j])
    """

    forecast: PairsOverTime

    @property
    def destinations(self) -> Bool[np.ndarray, " R"]:
        """Regions that are the destination of any trip, (R,)."""
        vehicles = self.forecast.sum(axis=(0, 1))
        if self.initial is not None:
            vehicles = vehicles + self.initial.sum(axis=0)
        return vehicles > 0


def planning_model(scenario: Scenario, network: RegionalModel | None = None) -> PlanningModel:
    """Return what a controller of `scenario` plans with.

    network: its regional model, the scenario's if None
    """
    shared = {part.name: getattr(scenario, part.name) for part in fields(Horizon)}
    shared["network"] = network or scenario.network
    return PlanningModel(**copy.deepcopy(shared), forecast=scenario.demand.copy())


def other_model(scenario: Scenario, folder: Path, where: str = "") -> RegionalModel:
    """Return the regional model in `folder`.

    where: names it in errors; its file if ""
    Raises: InputError if it is of another city
    """
    model = load_network(folder)
    if not np.array_equal(model.adjacency, scenario.network.adjacency):
        raise InputError(
            f"{where or folder / 'network.toml'}: network {model.name} has other regions or "
            f"boundaries than {scenario.network.name}; identify one for the same city with 'cosim "
            "identify'"
        )
    check_step(model, scenario.step / scenario.substeps, f"{model.folder}")
    return model


def guided_model(network: RegionalModel) -> Path | None:
    """Return the folder of the model with guided drivers, None without."""
    if network.folder is None:
        return None
    folder = network.folder / GUIDED
    return folder if (folder / "network.toml").is_file() else None
