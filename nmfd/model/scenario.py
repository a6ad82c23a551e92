"""Demand, noise, horizon: loaded from scenario.toml and checked."""

import csv
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nmfd.errors import InputError
from nmfd.faults import Fault, parse
from nmfd.model.regional_model import LONGEST_NAME, RegionalModel, check_step, load_network
from nmfd.runs import config

MOST_NUMBERS = 2 * 10**8  # of a demand table: more would not fit into memory
LONGEST_STEP = 86_400.0   # s


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
    network: RegionalModel
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


    @cached_property
    def ordered_faults(self) -> tuple[Fault, ...]:
        """`faults`, parsed. InputError."""
        where = "scenario.toml" if self.folder is None else self.folder / "scenario.toml"
        return tuple(parse(text, f"{where}: faults", self.network.regions) for text in self.faults)


def with_faults(scenario: Scenario, texts: Sequence[str]) -> Scenario:
    """`scenario` with more faults, as the option --fault gives them. InputError."""
    for text in texts:
        parse(text, "--fault", scenario.network.regions)
    return replace(scenario, faults=(*scenario.faults, *texts))


def trapezoid(time: np.ndarray, *, start: float, peak: float, ramp_up: float, flat: float, ramp_down: float):
    """Demand [veh/s] at `time` (T,) [s]: rises from 0 at `start`, stays at `peak` for `flat` and falls to 0."""
    end = start + ramp_up + flat + ramp_down
    rising = (time - start) / ramp_up if ramp_up > 0 else np.where(time >= start, 1.0, 0.0)
    falling = (end - time) / ramp_down if ramp_down > 0 else np.where(time < end, 1.0, 0.0)
    return peak * np.clip(np.minimum(rising, falling), 0.0, 1.0)


def read_tables(folder: Path) -> config.Table:
    """`folder`/scenario.toml; what it does not say is that of the scenario in the folder `base`, if it names one.

    Tables are completed key by key, everything else is taken whole. Raises InputError.
    """
    path, folders, content = folder / "scenario.toml", [], {}
    while True:
        table = config.read(folder / "scenario.toml")
        own = table.raw()
        if folder.resolve() in folders:
            raise table.error("base", "the scenarios are each other's base; remove one of the keys")
        folders.append(folder.resolve())
        _name_from(own, folder, path.parent)
        content = _completed(content, own)
        base = table.text("base", None)
        if base is None:
            content.pop("base", None)
            return config.Table(content, path)
        folder = folder / base


def _name_from(own: dict, folder: Path, here: Path) -> None:
    """Files that a scenario.toml names are relative to it: rewrite them as seen from the folder `here`."""
    def seen(name: str) -> str:
        return os.path.relpath(folder / name, here)

    for key in ("network", "demand_file"):
        if isinstance(own.get(key), str):
            own[key] = seen(own[key])
    sumo = own.get("sumo")
    for key in ("routes", "background", "additional") if isinstance(sumo, dict) else ():
        if isinstance(sumo.get(key), list) and all(isinstance(name, str) for name in sumo[key]):
            sumo[key] = [seen(name) for name in sumo[key]]
    controllers = own.get("controllers")
    for options in controllers.values() if isinstance(controllers, dict) else ():
        if isinstance(options, dict) and isinstance(options.get("model"), str):
            options["model"] = seen(options["model"])


def _completed(content: dict, base: dict) -> dict:
    """`content` with what only `base` has, in the tables of both too."""
    both = {key: _completed(content[key], base[key]) for key in content
            if isinstance(content[key], dict) and isinstance(base.get(key), dict)}
    return {**base, **content, **both}


def read_scenario(folder: Path | str) -> Scenario:
    """Read `folder`/scenario.toml and its network. Raises InputError.

    The table [controllers] is left to the controllers (nmfd.controllers.registry.checked_scenario), [sumo] to cosim.
    """
    folder = Path(folder)
    root = read_tables(folder)
    name = root.text("name", longest=LONGEST_NAME)
    network = load_network(folder / root.text("network"))
    step = root.number("step", above=0.0, high=LONGEST_STEP)
    steps = root.integer("steps", low=1, high=MOST_NUMBERS // network.regions**2)
    integrator = root.text("integrator", "euler", ("euler", "rk4"))
    substeps = root.integer("substeps", 1, low=1, high=1000)
    protected = root.integers("protected", (), high=network.regions - 1)
    noise = root.table("noise", None)
    measurement_std = noise.number("measurement_std", 0.0, low=0.0, high=1e6)
    noise.close()
    factor = root.number("demand_factor", 1.0, low=0.0, high=1000.0)
    demand = np.zeros((steps, network.regions, network.regions))
    time = step * np.arange(steps)
    for row in root.tables("demand", () if root.has("demand_file") else ...):
        pair = [_region(row, key, network) for key in ("from", "to")]
        rate = trapezoid(
            time, start=row.number("start", low=0.0), peak=row.number("peak", low=0.0, high=1e6),
            ramp_up=row.number("ramp_up", low=0.0), flat=row.number("flat", low=0.0),
            ramp_down=row.number("ramp_down", low=0.0))
        demand[:, pair[0], pair[1]] += rate
        if row.flag("both_ways", False):
            demand[:, pair[1], pair[0]] += rate
        row.close()
    if root.has("demand_file"):
        demand += _demand_file(folder / root.text("demand_file"), steps, network.regions)
    forecast = root.table("forecast", None)
    forecast_error, forecast_seed = forecast.number("error", 0.0, low=0.0, high=2.0), forecast.integer("seed", 0)
    forecast.close()
    controller_options, ordered = root.raw_table("controllers"), root.texts("faults", ())
    root.raw_table("sumo")
    root.close()
    check_step(network, step / substeps, str(folder / "scenario.toml"))
    scenario = Scenario(
        name=name, network=network, step=step, steps=steps, demand=factor * demand, measurement_std=measurement_std,
        integrator=integrator, substeps=substeps, protected=protected, controller_options=controller_options,
        demand_factor=factor, forecast_error=forecast_error, forecast_seed=forecast_seed, faults=ordered, folder=folder)
    _ = scenario.ordered_faults  # checked here, where the file is known
    return scenario


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


def _region(row: config.Table, key: str, network: RegionalModel) -> int:
    value = row.integer(key)
    if value >= network.regions:
        raise row.error(
            key, f"region {value} is unknown; network {network.name} has the regions 0 to {network.regions - 1}")
    return value
