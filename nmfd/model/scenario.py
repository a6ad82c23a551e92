"""Demand, noise, horizon: loaded from scenario.toml and checked."""

import csv
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nmfd.controllers import registry
from nmfd.errors import InputError
from nmfd.model.regional_model import Network, check_step, load_network
from nmfd.model.scenario_file import MOST_NUMBERS, PlanningOptions, ScenarioTable, read_tables
from nmfd.runs import config

GUIDED = "guided"         # in a network's folder: that of the same city's model with guided drivers
GUIDING = ("mpc-pcrg", "dpc-pcrg")  # beginnings of the names of the controllers that plan with it


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """T control intervals on a network.

    name, network
    step: control interval [s]
    steps: T
    demand: (T, R, R) [veh/s], [k, i, j] = vehicles that start in i bound for j, during interval k
    measurement_std: of the Gaussian noise on every x_ij that a controller sees [veh]
    integrator: "euler" or "rk4", of the regional model
    substeps: integration steps of the regional model per control interval
    protected: the regions that gating protects
    demand_factor: what the demand was multiplied by already, for a city that drives vehicles of its own
    forecast_error: standard deviation of the logarithm of what a controller is told of the demand, over the truth [-]
    forecast_seed: of that error
    controller_options: controller name -> its table in [controllers], checked by that controller
    faults: injected into every run (nmfd.faults)
    folder: where scenario.toml was, or None
    """

    name: str
    network: Network
    step: float
    steps: int
    demand: np.ndarray
    measurement_std: float = 0.0
    integrator: str = "euler"
    substeps: int = 1
    protected: tuple[int, ...] = ()
    controller_options: Mapping[str, dict] = field(default_factory=dict)
    demand_factor: float = 1.0
    forecast_error: float = 0.0
    forecast_seed: int = 0
    faults: tuple[str, ...] = ()
    folder: Path | None = None

    @cached_property
    def forecast(self) -> np.ndarray:
        """(T, R, R) [veh/s]: the demand as controllers that look ahead know it.

        Each pair is off by a factor for the whole run and one per interval, lognormal with mean 1, which share the
        variance equally: a forecast is wrong about the day, and about the quarter of an hour.
        """
        if not self.forecast_error:
            return self.demand
        random = np.random.default_rng([self.forecast_seed, 0x666F72])
        spread = self.forecast_error / np.sqrt(2.0)
        normal = random.standard_normal((1, *self.demand.shape[1:])) + random.standard_normal(self.demand.shape)
        return self.demand * np.exp(spread * normal - spread**2)


def trapezoid(time: np.ndarray, *, start: float, peak: float, ramp_up: float, flat: float, ramp_down: float):
    """Demand [veh/s] at `time` (T,) [s]: rises from 0 at `start`, stays at `peak` for `flat` and falls to 0."""
    end = start + ramp_up + flat + ramp_down
    rising = (time - start) / ramp_up if ramp_up > 0 else np.where(time >= start, 1.0, 0.0)
    falling = (end - time) / ramp_down if ramp_down > 0 else np.where(time < end, 1.0, 0.0)
    return peak * np.clip(np.minimum(rising, falling), 0.0, 1.0)


def load_scenario(folder: Path | str) -> Scenario:
    """Read `folder`/scenario.toml and its network, and check the options of every controller in it. Raises InputError;
    the table [sumo] is left to cosim."""
    folder = Path(folder)
    path = folder / "scenario.toml"
    table = config.checked(ScenarioTable, read_tables(folder), path)
    network = load_network(folder / table.network)
    _check_regions(table, network, path)
    demand = _trapezoids(table, network.regions)
    if table.demand_file is not None:
        demand += _demand_file(folder / table.demand_file, table.steps, network.regions)
    check_step(network, table.step / table.substeps, str(path))
    scenario = Scenario(
        name=table.name, network=network, step=table.step, steps=table.steps, demand=table.demand_factor * demand,
        measurement_std=table.noise.measurement_std, integrator=table.integrator, substeps=table.substeps,
        protected=table.protected, controller_options=table.controllers, demand_factor=table.demand_factor,
        forecast_error=table.forecast.error, forecast_seed=table.forecast.seed, faults=table.faults, folder=folder)
    registry.check_options(scenario)
    _check_faults(scenario)
    return scenario


def _check_faults(scenario: Scenario) -> None:
    from nmfd import faults

    faults.of(scenario)


def _check_regions(table: ScenarioTable, network: Network, path: Path) -> None:
    """InputError for regions that the network has not, or more intervals than there is memory for."""
    most, known = network.regions - 1, f"network {network.name} has the regions 0 to {network.regions - 1}"
    if max(table.protected, default=0) > most:
        raise config.error(path, "protected", config.got(
            f"a list of distinct whole numbers from 0 to {most}", list(table.protected)))
    for number, row in enumerate(table.demand or ()):
        for key, region in (("from", row.origin), ("to", row.to)):
            if region > most:
                raise config.error(path, f"demand[{number}].{key}", f"region {region} is unknown; {known}")
    if table.steps > MOST_NUMBERS // network.regions**2:
        raise config.error(path, "steps", config.got(
            f"a whole number from 1 to {MOST_NUMBERS // network.regions**2}", table.steps))


def _trapezoids(table: ScenarioTable, regions: int) -> np.ndarray:
    """(T, R, R) [veh/s]: the flows of [[demand]]."""
    demand = np.zeros((table.steps, regions, regions))
    time = table.step * np.arange(table.steps)
    for row in table.demand or ():
        rate = trapezoid(time, **row.model_dump(include={"start", "peak", "ramp_up", "flat", "ramp_down"}))
        demand[:, row.origin, row.to] += rate
        if row.both_ways:
            demand[:, row.to, row.origin] += rate
    return demand


def _demand_file(path: Path, steps: int, regions: int) -> np.ndarray:
    """(T, R, R) [veh/s] of a csv with the columns interval, from, to, veh_s; intervals beyond T are left out.

    Raises InputError.
    """
    demand = np.zeros((steps, regions, regions))
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a table with the columns interval,from,to,veh_s") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); give a csv file") from None
    if not rows or rows[0] != ["interval", "from", "to", "veh_s"]:
        found = ",".join(rows[0]) if rows else "nothing"
        raise InputError(f"{path}: line 1: expected interval,from,to,veh_s, got {found} instead")
    for number, row in enumerate(rows[1:], start=2):
        try:
            k, i, j, rate = int(row[0]), int(row[1]), int(row[2]), float(row[3])
            good = len(row) == 4 and k >= 0 and 0 <= i < regions and 0 <= j < regions and 0.0 <= rate <= 1e6
        except (ValueError, IndexError):
            good = False
        if not good:
            raise InputError(
                f"{path}: line {number}: expected an interval from 0 up, two regions from 0 to {regions - 1} and "
                f"veh/s from 0 to 1e6, got {','.join(row)} instead")
        if k < steps:
            demand[k, i, j] += rate
    return demand


def guided_model(network: Network) -> Path | None:
    """The folder of the same city's model with guided drivers, if there is one beside that of the drivers' own."""
    folder = None if network.folder is None else network.folder / GUIDED
    return folder if folder is not None and (folder / "network.toml").is_file() else None


def as_modelled(scenario: Scenario, controller: str) -> Scenario:
    """`scenario` with the regional model that `controller` plans with: the network that its option `model` names, or
    else, where it guides routes, the one in the folder GUIDED of the scenario's network, if there is one.

    Drivers who are guided, or who reroute by themselves, make another model of the same city. A controller "NAME+..."
    is NAME with the options of [controllers."NAME+..."] over those of [controllers.NAME]. Raises InputError.
    """
    name, tables = controller.partition("+")[0], scenario.controller_options
    options = {**tables.get(name, {}), **tables.get(controller, {})}
    configured = replace(scenario, controller_options={**tables, name: options})
    if "model" in options and scenario.folder is not None:
        where, table = scenario.folder / "scenario.toml", f"controllers.{controller}."
        model = config.checked(PlanningOptions, {"model": options.pop("model")}, where, table).model
        return with_model(configured, scenario.folder / model, functools.partial(config.error, where, f"{table}model"))
    if name.startswith(GUIDING) and (folder := guided_model(scenario.network)) is not None:
        return with_model(configured, folder)
    return configured


def with_model(
    scenario: Scenario, folder: Path, wrong: Callable[[str], InputError] | None = None,
) -> Scenario:
    """`scenario` with another regional model of the same city. wrong: the error that there is with it, of its words."""
    model = load_network(folder)
    if not np.array_equal(model.adjacency, scenario.network.adjacency):
        error = f"network {model.name} has other regions or boundaries than {scenario.network.name}; identify one " \
                "for the same city with 'cosim identify'"
        raise wrong(error) if wrong else InputError(f"{folder / 'network.toml'}: {error}")
    check_step(model, scenario.step / scenario.substeps, f"{model.folder}")
    return replace(scenario, network=model)
