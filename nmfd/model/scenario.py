"""Demand, noise and horizon of a run, and their scenario.toml."""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from jaxtyping import Bool
from pydantic import Field, model_validator

from nmfd.arrays import Intervals, PairsOverTime, PerPair
from nmfd.errors import InputError
from nmfd.faults import Fault, parse
from nmfd.model.regional_model import (
    RegionalModel,
    check_step,
    load_network,
    network_toml,
)
from nmfd.runs import config, files, shipped
from nmfd.runs.config import (
    Name,
    Numbers,
    Problem,
    Regions,
    Rows,
    Settings,
    Text,
    Texts,
    setting,
    whole,
)

SHORTEST_STEP_S = 0.1
LONGEST_STEP_S = 86_400.0
MOST_STEPS = 10**6
MOST_FLOW_VEH_S = 1e6
# Options of controllers that name a file or folder -> kind of the folder that it may be found in.
CONTROLLER_FILES = {
    "model": shipped.NETWORK,
    "policy": shipped.SCENARIO,
    "plan": shipped.SCENARIO,
}
KINDS = ("demand", "demand-total", "mfd-scale", "mfd-axis", "trip-lengths")  # of `perturbed`
# Fields of a scenario with the names of their keys in scenario.toml.
SETTINGS = (
    "name",
    "step",
    "steps",
    "integrator",
    "substeps",
    "protected",
    "demand_factor",
    "measurement_std",
    "process_std",
    "faults",
)


@dataclass(frozen=True, kw_only=True)
class Horizon:
    """Network, control intervals and options.

    A scenario shares them with the planning models of its controllers.

    name: of the scenario
    step: control interval [s]
    steps: T
    measurement_std: standard deviation of the Gaussian noise on each observed x_ij [veh]
    integrator, substeps: "euler" or "rk4", and its steps per control interval, of the regional
        model
    protected: regions that gating protects
    controller_options: controller -> its table in [controllers], checked by that controller
    initial: (R, R) [veh], [i, j]: vehicles in i bound for j at the start; None: empty
    folder: of scenario.toml, or None
    """

    name: str
    network: RegionalModel
    step: float
    steps: int
    measurement_std: float = 0.0
    integrator: str = "euler"
    substeps: int = 1
    protected: tuple[int, ...] = ()
    controller_options: Mapping[str, dict] = field(default_factory=dict)
    initial: PerPair | None = None
    folder: Path | None = None

    @property
    def scheme(self) -> dict[str, Any]:
        """Control interval and integration, as arguments of the regional models."""
        return {"step": self.step, "integrator": self.integrator, "substeps": self.substeps}

    @property
    def where(self) -> str:
        """File that error messages name."""
        return "scenario.toml" if self.folder is None else str(self.folder / "scenario.toml")


@dataclass(frozen=True, kw_only=True)
class Scenario(Horizon):
    """T control intervals of a simulated network.

    demand: (T, R, R) [veh/s], [k, i, j]: vehicles that start in i bound for j during interval k
    process_std: standard deviation of the Gaussian noise on each x_ij of the regional plants after
        an interval [veh]
    demand_factor: factor already applied to the demand, for a city with vehicles of its own
    faults: injected into every run (nmfd.faults)
    sumo: table [sumo], checked by cosim
    """

    demand: PairsOverTime
    process_std: float = 0.0
    demand_factor: float = 1.0
    faults: tuple[str, ...] = ()
    sumo: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check shape and values of the demand and the initial state.

        Raises: InputError
        """
        regions = self.network.regions
        shapes = {"demand": (self.steps, regions, regions), "initial": (regions, regions)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values is None:
                continue
            if np.shape(values) != shape:
                expected = f"shape {shape} for {self.steps} intervals and {regions} regions"
                raise config.error(self.where, name, config.got(expected, np.shape(values)))
            if not (np.isfinite(values) & (np.asarray(values) >= 0.0)).all():
                raise config.error(self.where, name, "expected finite numbers from 0 up")

    @property
    def start(self) -> PerPair:
        """A copy of `initial` (R, R) [veh]; zeros if the network is empty."""
        if self.initial is None:
            return np.zeros(self.demand.shape[1:])
        return self.initial.copy()

    def with_options(self, table: str, options: Mapping[str, Any]) -> "Scenario":
        """Return the scenario with other options in a table of controllers."""
        own = {**self.controller_options.get(table, {}), **options}
        return replace(self, controller_options={**self.controller_options, table: own})

    @cached_property
    def hash(self) -> str:
        """Hash of all that a run depends on, whatever the names of its files."""
        content = [
            self.network.hash,
            self.step,
            self.steps,
            self.measurement_std,
            self.integrator,
            self.substeps,
            self.protected,
            self.controller_options,
        ]
        # What is not used does not count: hashes of finished runs stay valid.
        if self.faults:
            content.append(self.faults)
        if self.process_std:
            content.append(["process_std", self.process_std])
        if self.initial is not None:
            content.append(self.initial.tolist())
        text = json.dumps(content, sort_keys=True, default=str)
        flows = np.ascontiguousarray(self.demand).tobytes()
        return hashlib.sha256(text.encode() + flows).hexdigest()[:16]

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of a run besides network and demand, as in scenario.toml."""
        content = {name: getattr(self, name) for name in SETTINGS}
        content |= {"controllers": self.controller_options, "sumo": self.sumo}
        if self.initial is not None:
            content["initial"] = self.initial.tolist()
        return json.loads(json.dumps(content))

    def save(self, folder: Path | str) -> Path:
        """Write the scenario to a folder that nmfd.load_scenario reads; return it.

        Trained policies are not copied. The network is named if it lies in a folder, else written.
        Raises: InputError if the folder holds a scenario already
        """
        folder = Path(folder)
        file = folder / "scenario.toml"
        if file.exists():
            raise InputError(f"{file}: exists; choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        content = self.settings
        if self.folder is not None:
            _relocate(content, self.folder, folder)
        content["network"] = self._saved_network(folder)
        content["demand_file"] = "demand.csv"
        rows = ["interval,from,to,veh_s"]
        for k, i, j in np.argwhere(self.demand > 0.0).tolist():
            rows.append(f"{k},{i},{j},{float(self.demand[k, i, j]) / self.demand_factor!r}")
        files.write_text(folder / "demand.csv", "\n".join(rows) + "\n")
        files.write_text(file, tomli_w.dumps(content))
        return folder

    def _saved_network(self, folder: Path) -> str:
        """Return the folder of the network, seen from `folder`.

        A network without a folder is written there.
        """
        own = self.network.folder
        if own is not None and load_network(own).hash == self.network.hash:
            return files.relative(own, folder)
        (folder / "network").mkdir(exist_ok=True)
        text = network_toml(self.network, {}, f"Network of the scenario {self.name}")
        files.write_text(folder / "network" / "network.toml", text)
        return "network"

    @cached_property
    def ordered_faults(self) -> tuple[Fault, ...]:
        """`faults`, parsed. Raises InputError."""
        where = f"{self.where}: faults"
        return tuple(parse(text, where, self.network.regions) for text in self.faults)


def with_demand(scenario: Scenario, *, steps: int | None = None, factor: float = 1.0) -> Scenario:
    """Return the beginning of a scenario, with another demand.

    steps: control intervals; all if None
    factor: of the demand
    Raises: InputError
    """
    if steps is None:
        steps = scenario.steps
    if not 1 <= steps <= scenario.steps:
        raise InputError(
            f"steps: expected 1 to {scenario.steps} control intervals, got {steps} instead; for "
            f"more, change steps in {scenario.where}, or --set steps=N"
        )
    return replace(
        scenario,
        steps=steps,
        demand=factor * scenario.demand[:steps],
        demand_factor=factor * scenario.demand_factor,
    )


def pairs_with_demand(demand: PairsOverTime) -> Bool[np.ndarray, "R R"]:
    """Return the pairs of regions with demand at any time.

    Noise perturbs these pairs, all the time.

    demand: (veh/s, (T, R, R))
    """
    return (demand > 0).any(axis=0)


def perturbed(scenario: Scenario, sigma: float, seed: int, kind: str = "demand") -> Scenario:
    """Return `scenario` with another demand or other MFDs.

    The kinds are, with standard normal draws n:

    demand: max(0, d_ij(k) + sigma n_ij(k)) [veh/s]. Clipping passes only the positive half of the
        noise while no demand is planned, which adds 0.4 sigma veh/s per pair.
    demand-total: the same, scaled to the planned trips of every pair
    mfd-scale, mfd-axis: outflow, or accumulation axis and storage, of every region times exp(sigma
        n_i)
    trip-lengths: exit rates times exp(sigma n_ij), as if trips were longer or shorter

    The same seed gives the same n for every sigma (common random numbers). No outflow rises above
    the largest that the integration step allows. Raises: InputError
    """
    if kind not in KINDS:
        raise InputError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}; correct it")
    random = np.random.default_rng([seed, 0x64656D])
    network = scenario.network
    if kind.startswith("demand"):
        noise = random.standard_normal(scenario.demand.shape) * pairs_with_demand(scenario.demand)
        demand = np.maximum(scenario.demand + sigma * noise, 0.0)
        if kind == "demand-total":
            demand *= scenario.demand.sum(axis=0) / np.maximum(demand.sum(axis=0), 1e-9)
        return replace(scenario, demand=demand)
    rates = network.relative_rates
    highest = scenario.substeps / scenario.step / network.free_rates
    if kind == "trip-lengths":
        factors = np.exp(sigma * random.standard_normal(rates.shape))
        rates = np.minimum(rates * factors, highest[:, None])
        return replace(scenario, network=replace(network, exit_rates=rates))
    factor = np.exp(sigma * random.standard_normal(network.regions))
    wide = high = np.ones_like(factor)
    if kind == "mfd-axis":
        wide = factor
    else:
        high = factor
    high = np.minimum(high, highest / rates.max(axis=1))
    mfds = []
    for mfd, width, height in zip(network.mfds, wide.tolist(), high.tolist(), strict=True):
        mfds.append(mfd.scaled(width, height))
    storage = None if network.storage is None else wide * network.storage
    return replace(scenario, network=replace(network, mfds=tuple(mfds), storage=storage))


class DemandTable(Settings):
    """One flow, a trapezoid over time.

    Flows of the same pair of regions add up.
    """

    origin: config.Region = setting("origin region", alias="from")
    to: config.Region = setting("destination region")
    start: config.Seconds = setting("begin of the flow")
    peak: config.Flow = setting("largest flow")
    ramp_up: config.Seconds = setting("time to rise to the peak")
    flat: config.Seconds = setting("time at the peak")
    ramp_down: config.Seconds = setting("time to fall to 0")

    def rate(self, time: Intervals) -> Intervals:
        """Return the flow [veh/s] at `time` (T,) [s]."""
        end = self.start + self.ramp_up + self.flat + self.ramp_down
        rising = np.where(time >= self.start, 1.0, 0.0)
        if self.ramp_up > 0:
            rising = (time - self.start) / self.ramp_up
        falling = np.where(time < end, 1.0, 0.0)
        if self.ramp_down > 0:
            falling = (end - time) / self.ramp_down
        return self.peak * np.clip(np.minimum(rising, falling), 0.0, 1.0)


class ScenarioTable(Settings):
    """A network, its demand and noise, and the horizon."""

    name: Name = setting("name of the scenario")
    base: Text | None = setting(
        "folder or shipped name of a scenario that gives the keys omitted here", None
    )
    network: Text = setting("folder or shipped name of the network")
    step: float = setting("control interval", unit="s", ge=SHORTEST_STEP_S, le=LONGEST_STEP_S)
    steps: int = whole("control intervals", low=1, high=MOST_STEPS)
    integrator: Literal["euler", "rk4"] = setting(
        "integration scheme of the regional model", "euler"
    )
    substeps: int = whole(
        "integration steps of the regional model per control interval", 1, low=1, high=1000
    )
    protected: Regions = setting("regions that gating protects", ())
    demand: Rows[DemandTable] | None = setting(
        "one table per flow; optional beside demand_file", None
    )
    demand_file: Text | None = setting(
        "csv with the columns interval, from, to, veh_s, added to [[demand]]", None
    )
    demand_factor: float = setting("factor of the whole demand", 1.0, unit="-", ge=0.0, le=1000.0)
    measurement_std: float = setting(
        "standard deviation of the noise on each observed accumulation by destination",
        0.0,
        unit="veh",
        ge=0.0,
        le=1e6,
    )
    process_std: float = setting(
        "standard deviation of the noise on the state after each interval; not in SUMO",
        0.0,
        unit="veh",
        ge=0.0,
        le=1e6,
    )
    initial: Annotated[tuple[Numbers, ...], Field(strict=False)] = setting(
        "vehicles at the start, regional model only: one row per region, by destination",
        (),
        unit="veh",
    )
    faults: Texts = setting("injected into every run: KIND[:VALUE][@FROM-TO]", ())
    controllers: dict[str, dict[str, Any]] = setting("options of controllers", {})
    sumo: dict[str, Any] = setting("simulation of the city, for cosim", {})

    @model_validator(mode="after")
    def _has_demand(self) -> "ScenarioTable":
        if self.demand is None and self.demand_file is None:
            raise Problem("demand", "missing; add a list of tables [[demand]], or demand_file")
        return self


def read_scenario(folder: Path | str, settings: Mapping[str, Any] | None = None) -> Scenario:
    """Read a scenario and its network.

    folder: folder of scenario.toml, or the name of a shipped scenario
    settings: dotted key -> value, which replace those of the file, such as {"sumo.compliance": 0.5}
    Raises: InputError
    """
    folder = shipped.found(folder, shipped.SCENARIO)
    path = folder / "scenario.toml"
    tables = read_tables(folder)
    for key, value in (settings or {}).items():
        parts = re.findall(r'"[^"]*"|[^.]+', key)  # parts with dots stand in double quotes
        for part in reversed(parts):
            value = {part.strip('"'): value}
        tables = _completed(value, tables)
    table = config.checked(ScenarioTable, tables, path)
    network = load_network(folder / table.network)
    check_step(network, table.step / table.substeps, str(path))
    values = {}
    for key, value in vars(table).items():
        if key in Scenario.__dataclass_fields__:
            values[key] = value
    values["network"] = network
    values["demand"] = table.demand_factor * _demand(table, network, folder)
    values["folder"] = folder
    values["controller_options"] = table.controllers
    values["initial"] = None
    if max(table.protected, default=0) >= network.regions:
        allowed = f"a list of distinct whole numbers from 0 to {network.regions - 1}"
        raise config.error(path, "protected", config.got(allowed, list(table.protected)))
    if table.initial:
        lengths = {len(table.initial), *map(len, table.initial)}
        if lengths != {network.regions} or min(map(min, table.initial)) < 0:
            allowed = f"{network.regions} lists of {network.regions} numbers from 0 up"
            rows = [list(row) for row in table.initial]
            raise config.error(path, "initial", config.got(allowed, rows))
        values["initial"] = np.array(table.initial)
    scenario = Scenario(**values)
    _ = scenario.ordered_faults
    return scenario


def read_tables(folder: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return `folder`/scenario.toml, completed by its `base`.

    above: folders of the scenarios based on this one
    Raises: InputError
    """
    file = folder / "scenario.toml"
    folders = (*above, folder)
    own = config.read(file)
    base = own.pop("base", None)
    _relocate(own, folder, folders[0])
    if folder.resolve() in (other.resolve() for other in above):
        problem = "the scenarios are each other's base; remove one of the keys"
        raise config.error(file, "base", problem)
    if base is None:
        return own
    if not isinstance(base, str) or not base.isprintable():
        raise config.error(file, "base", config.got("the folder of a scenario in quotes", base))
    place = shipped.found(base, shipped.SCENARIO, beside=folder)
    return _completed(own, read_tables(place, folders))


def _relocate(own: dict, folder: Path, here: Path) -> None:
    """Rewrite the paths of a scenario.toml, so that they begin elsewhere.

    folder: where they begin now
    here: where they shall begin
    """

    def seen(name: str, *kinds: str) -> str:
        return files.relative(shipped.found(name, *kinds, beside=folder), here)

    for key, kinds in (("network", (shipped.NETWORK,)), ("demand_file", ())):
        if isinstance(own.get(key), str):
            own[key] = seen(own[key], *kinds)
    sumo = own.get("sumo")
    if isinstance(sumo, dict):
        for key in ("routes", "background", "additional", "planned"):
            if isinstance(sumo.get(key), list) and all(isinstance(name, str) for name in sumo[key]):
                sumo[key] = [seen(name) for name in sumo[key]]
    controllers = own.get("controllers")
    if not isinstance(controllers, dict):
        return
    for options in controllers.values():
        if not isinstance(options, dict):
            continue
        for key, kind in CONTROLLER_FILES.items():
            if isinstance(options.get(key), str):
                options[key] = seen(options[key], kind)


def _completed(content: dict, base: dict) -> dict:
    """Return `content` with what only `base` has, table by table."""
    result = {**base, **content}
    for key in content:
        if isinstance(content[key], dict) and isinstance(base.get(key), dict):
            result[key] = _completed(content[key], base[key])
    return result


def _demand(table: ScenarioTable, network: RegionalModel, folder: Path) -> PairsOverTime:
    """Return the demand of [[demand]] and demand_file (veh/s, (T, R, R)).

    Raises: InputError
    """
    demand = np.zeros((table.steps, network.regions, network.regions))
    time = table.step * np.arange(table.steps)
    for n, row in enumerate(table.demand or ()):
        for key, region in (("from", row.origin), ("to", row.to)):
            if region >= network.regions:
                known = f"network {network.name} has 0 to {network.regions - 1}"
                problem = f"region {region} is unknown; {known}"
                raise config.error(folder / "scenario.toml", f"demand[{n}].{key}", problem)
        demand[:, row.origin, row.to] += row.rate(time)
    if table.demand_file is not None:
        from_file = np.zeros_like(demand)
        rows = _demand_rows(folder / table.demand_file, network.regions)
        rows = rows[rows[:, 0] < table.steps]
        interval, origin, to = rows[:, :3].astype(int).T
        np.add.at(from_file, (interval, origin, to), rows[:, 3])
        demand += from_file
    return demand


def _demand_rows(path: Path, regions: int) -> np.ndarray:
    """Return the rows of a csv file of demand.

    They hold interval, origin, destination and flow (veh/s). Raises: InputError
    """
    files.check_file(path, "give a csv file")
    try:
        text = path.read_text(encoding="utf-8").splitlines()
        if not text or text[0] != "interval,from,to,veh_s":
            raise ValueError("its first line is not interval,from,to,veh_s")
        rows = np.loadtxt(text[1:], delimiter=",", ndmin=2).reshape(-1, 4)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as demand ({error}); give a csv file") from None
    numbers = rows[:, :3]
    rate = rows[:, 3]
    whole_numbers = ((numbers == np.floor(numbers)) & (numbers >= 0)).all(axis=1)
    known = (rows[:, 1:3] < regions).all(axis=1)
    good = whole_numbers & known & (rate >= 0.0) & (rate <= MOST_FLOW_VEH_S)
    if not good.all():
        line = int(np.argmin(good)) + 1
        raise InputError(
            f"{path}: line {line + 1}: expected an interval from 0 up, two regions from 0 to "
            f"{regions - 1} and veh/s from 0 to {MOST_FLOW_VEH_S:g}, got {text[line]} instead"
        )
    return rows
