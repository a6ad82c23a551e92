"""Demand, noise, horizon: loaded from scenario.toml and checked."""

import csv
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from nmfd.arrays import Intervals, PairsOverTime, PerPair
from nmfd.errors import InputError
from nmfd.faults import Fault, parse
from nmfd.model.regional_model import RegionalModel, check_step, load_network
from nmfd.model.scenario_file import MOST_NUMBERS, OWN_TIME_LIMIT, ScenarioTable, read_tables
from nmfd.runs import config, shipped
from nmfd.runs.files import check_file


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
    own_time_limit: of every call of a controller of the user's own [s], 0 for none; no result depends on it
    initial: (R, R) [veh], [i, j] = vehicles that are in i bound for j when a run begins; None: nobody
    folder: where scenario.toml was, or None
    """

    name: str
    network: RegionalModel
    step: float
    steps: int
    demand: PairsOverTime
    measurement_std: float = 0.0
    integrator: str = "euler"
    substeps: int = 1
    protected: tuple[int, ...] = ()
    controller_options: Mapping[str, dict] = field(default_factory=dict)
    demand_factor: float = 1.0
    forecast_error: float = 0.0
    forecast_seed: int = 0
    faults: tuple[str, ...] = ()
    own_time_limit: float = OWN_TIME_LIMIT
    initial: PerPair | None = None
    folder: Path | None = None

    @property
    def start(self) -> PerPair:
        """(R, R) [veh]: `initial` as an array of its own, zeros for nobody."""
        return np.zeros(self.demand.shape[1:]) if self.initial is None else self.initial.copy()

    @cached_property
    def forecast(self) -> PairsOverTime:
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
    def hash(self) -> str:
        """A fingerprint of all that a run depends on, whatever its files are called."""
        settings = [
            self.network.hash,
            self.step,
            self.steps,
            self.measurement_std,
            self.integrator,
            self.substeps,
            self.protected,
            self.controller_options,
        ]
        if self.forecast_error:
            settings.append([self.forecast_error, self.forecast_seed])
        if self.faults:
            settings.append(self.faults)
        if self.initial is not None:
            settings.append(self.initial.tolist())
        text = json.dumps(settings, sort_keys=True, default=str)
        return hashlib.sha256(text.encode() + np.ascontiguousarray(self.demand).tobytes()).hexdigest()[:16]

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


def with_time_limit(scenario: Scenario, seconds: float | None) -> Scenario:
    """`scenario` with the option --time-limit, if it is given."""
    return scenario if seconds is None else replace(scenario, own_time_limit=seconds)


def with_demand(scenario: Scenario, *, steps: int | None = None, factor: float = 1.0) -> Scenario:
    """The first `steps` control intervals of `scenario`, at most all of them, with `factor` times its demand."""
    steps = scenario.steps if steps is None else min(steps, scenario.steps)
    return replace(
        scenario, steps=steps, demand=factor * scenario.demand[:steps], demand_factor=factor * scenario.demand_factor
    )


def trapezoid(
    time: Intervals, *, start: float, peak: float, ramp_up: float, flat: float, ramp_down: float
) -> Intervals:
    """Demand [veh/s] at `time` (T,) [s]: rises from 0 at `start`, stays at `peak` for `flat` and falls to 0."""
    end = start + ramp_up + flat + ramp_down
    rising = (time - start) / ramp_up if ramp_up > 0 else np.where(time >= start, 1.0, 0.0)
    falling = (end - time) / ramp_down if ramp_down > 0 else np.where(time < end, 1.0, 0.0)
    return peak * np.clip(np.minimum(rising, falling), 0.0, 1.0)


def read_scenario(folder: Path | str) -> Scenario:
    """Read `folder`/scenario.toml and its network; a name alone is that of one that comes with the package.

    Raises InputError.

    The table [controllers] is left to the controllers (nmfd.controllers.registry.checked_scenario), [sumo] to cosim.
    """
    folder = shipped.found(folder, shipped.SCENARIO)
    path = folder / "scenario.toml"
    table = config.checked(ScenarioTable, read_tables(folder), path)
    network = load_network(folder / table.network)
    _check_regions(table, network, path)
    demand = _trapezoids(table, network.regions)
    if table.demand_file is not None:
        demand += _demand_file(folder / table.demand_file, table.steps, network.regions)
    check_step(network, table.step / table.substeps, str(path))
    scenario = Scenario(
        name=table.name,
        network=network,
        step=table.step,
        steps=table.steps,
        demand=table.demand_factor * demand,
        measurement_std=table.noise.measurement_std,
        integrator=table.integrator,
        substeps=table.substeps,
        protected=table.protected,
        controller_options=table.controllers,
        demand_factor=table.demand_factor,
        forecast_error=table.forecast.error,
        forecast_seed=table.forecast.seed,
        faults=table.faults,
        own_time_limit=table.own_time_limit,
        initial=_initial(table, network.regions),
        folder=folder,
    )
    _ = scenario.ordered_faults  # checked here, where the file is known
    return scenario


def _check_regions(table: ScenarioTable, network: RegionalModel, path: Path) -> None:
    """InputError for regions that the network has not, or more intervals than there is memory for."""
    most, known = network.regions - 1, f"network {network.name} has the regions 0 to {network.regions - 1}"
    if max(table.protected, default=0) > most:
        raise config.error(
            path, "protected", config.got(f"a list of distinct whole numbers from 0 to {most}", list(table.protected))
        )
    ends = [(f"demand[{n}]", (("from", row.origin), ("to", row.to))) for n, row in enumerate(table.demand or ())]
    ends += [(f"initial[{n}]", (("region", row.region), ("to", row.to))) for n, row in enumerate(table.initial)]
    for where, pair in ends:
        for key, region in pair:
            if region > most:
                raise config.error(path, f"{where}.{key}", f"region {region} is unknown; {known}")
    if table.steps > MOST_NUMBERS // network.regions**2:
        raise config.error(
            path, "steps", config.got(f"a whole number from 1 to {MOST_NUMBERS // network.regions**2}", table.steps)
        )


def _trapezoids(table: ScenarioTable, regions: int) -> PairsOverTime:
    """(T, R, R) [veh/s]: the flows of [[demand]]."""
    demand = np.zeros((table.steps, regions, regions))
    time = table.step * np.arange(table.steps)
    for row in table.demand or ():
        rate = trapezoid(time, **row.model_dump(include={"start", "peak", "ramp_up", "flat", "ramp_down"}))
        demand[:, row.origin, row.to] += rate
        if row.both_ways:
            demand[:, row.to, row.origin] += rate
    return demand


def _initial(table: ScenarioTable, regions: int) -> PerPair | None:
    """(R, R) [veh]: the vehicles of [[initial]]."""
    if not table.initial:
        return None
    inside = np.zeros((regions, regions))
    for row in table.initial:
        inside[row.region, row.to] += row.vehicles
    return inside


def _demand_file(path: Path, steps: int, regions: int) -> PairsOverTime:
    """(T, R, R) [veh/s] of a csv with the columns interval, from, to, veh_s; intervals beyond T are left out.

    Raises InputError.
    """
    demand = np.zeros((steps, regions, regions))
    check_file(path, "give a csv file")
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
                f"veh/s from 0 to 1e6, got {','.join(row)} instead"
            )
        if k < steps:
            demand[k, i, j] += rate
    return demand
