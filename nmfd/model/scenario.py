"""Demand, noise and horizon of a run, and the scenario.toml that declares them."""

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


@dataclass(frozen=True, kw_only=True)
class Horizon:
    """Network, control intervals and options, which a scenario shares with the planning models of
    its controllers.

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
        """Raise InputError for a demand or initial state of a wrong shape or value."""
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
        return np.zeros(self.demand.shape[1:]) if self.initial is None else self.initial.copy()

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
        ]
        content += [self.protected, self.controller_options]
        content += [self.faults] if self.faults else []
        content += [["process_std", self.process_std]] if self.process_std else []
        content += [self.initial.tolist()] if self.initial is not None else []
        text = json.dumps(content, sort_keys=True, default=str)
        return hashlib.sha256(
            text.encode() + np.ascontiguousarray(self.demand).tobytes()
        ).hexdigest()[:16]

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of a run besides network and demand, as in scenario.toml."""
        content = {
            "name": self.name,
            "step": self.step,
            "steps": self.steps,
            "integrator": self.integrator,
            "substeps": self.substeps,
            "protected": list(self.protected),
            "demand_factor": self.demand_factor,
            "measurement_std": self.measurement_std,
            "process_std": self.process_std,
            "faults": list(self.faults),
            "controllers": self.controller_options,
            "sumo": self.sumo,
        }
        if self.initial is not None:
            content["initial"] = self.initial.tolist()
        return json.loads(json.dumps(content))

    def save(self, folder: Path | str) -> Path:
        """Write the scenario as a folder that nmfd.load_scenario reads, and return its path.

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
        """Return the folder of the network, seen from `folder`; write it there if it has none."""
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
        return tuple(
            parse(text, f"{self.where}: faults", self.network.regions) for text in self.faults
        )


def with_demand(scenario: Scenario, *, steps: int | None = None, factor: float = 1.0) -> Scenario:
    """Return at most the first `steps` control intervals of `scenario`, with `factor` times its
    demand."""
    if steps is not None and steps < 1:
        raise InputError(f"steps: expected 1 or more control intervals, got {steps} instead")
    steps = scenario.steps if steps is None else min(steps, scenario.steps)
    return replace(
        scenario,
        steps=steps,
        demand=factor * scenario.demand[:steps],
        demand_factor=factor * scenario.demand_factor,
    )


def pairs_with_demand(demand: PairsOverTime) -> Bool[np.ndarray, "R R"]:
    """Return the pairs of regions with demand (T, R, R) at any time: noise perturbs these, all the
    time."""
    return (demand > 0).any(axis=0)


def perturbed(scenario: Scenario, sigma: float, seed: int, kind: str = "demand") -> Scenario:
    """Return `scenario` with another demand or other MFDs; n are standard normal draws. Raise
    InputError.

    demand: max(0, d_ij(k) + sigma n_ij(k)) [veh/s]. Clipping passes only the positive half of the
        noise while no demand is planned, which adds 0.4 sigma veh/s per pair.
    demand-total: the same, scaled to the planned trips of every pair
    mfd-scale, mfd-axis: outflow, or accumulation axis and storage, of every region times exp(sigma
        n_i)
    trip-lengths: exit rates times exp(sigma n_ij), as if trips were longer or shorter

    The same seed gives the same n for every sigma (common random numbers). No outflow rises above
    the largest that the integration step allows.
    """
    if kind not in KINDS:
        raise InputError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}; correct it")
    random, network = np.random.default_rng([seed, 0x64656D]), scenario.network
    if kind.startswith("demand"):
        noise = random.standard_normal(scenario.demand.shape) * pairs_with_demand(scenario.demand)
        demand = np.maximum(scenario.demand + sigma * noise, 0.0)
        if kind == "demand-total":
            demand *= scenario.demand.sum(axis=0) / np.maximum(demand.sum(axis=0), 1e-9)
        return replace(scenario, demand=demand)
    rates = np.ones(network.adjacency.shape) if network.exit_rates is None else network.exit_rates
    highest = (
        scenario.substeps
        / scenario.step
        / np.array([mfd.rate_up_to_jam(0.0) for mfd in network.mfds])
    )
    if kind == "trip-lengths":
        rates = np.minimum(
            rates * np.exp(sigma * random.standard_normal(rates.shape)), highest[:, None]
        )
        return replace(scenario, network=replace(network, exit_rates=rates))
    factor = np.exp(sigma * random.standard_normal(network.regions))
    high = np.minimum(factor if kind == "mfd-scale" else 1.0, highest / rates.max(axis=1)).tolist()
    wide = factor if kind == "mfd-axis" else np.ones_like(factor)
    mfds = tuple(
        mfd.scaled(*by) for mfd, *by in zip(network.mfds, wide.tolist(), high, strict=True)
    )
    storage = None if network.storage is None else wide * network.storage
    return replace(scenario, network=replace(network, mfds=mfds, storage=storage))


class DemandTable(Settings):
    """One flow, a trapezoid over time; flows of the same pair of regions add up."""

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
        rising = (
            (time - self.start) / self.ramp_up
            if self.ramp_up > 0
            else np.where(time >= self.start, 1.0, 0.0)
        )
        falling = (
            (end - time) / self.ramp_down if self.ramp_down > 0 else np.where(time < end, 1.0, 0.0)
        )
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
    """Read `folder`/scenario.toml and its network, or a shipped scenario by its name. Raises
    InputError.

    settings: dotted key -> value, which replace those of the file, such as {"sumo.compliance": 0.5}
    """
    folder = shipped.found(folder, shipped.SCENARIO)
    path = folder / "scenario.toml"
    tables = read_tables(folder)
    for key, value in (settings or {}).items():
        for part in reversed(
            re.findall(r'"[^"]*"|[^.]+', key)
        ):  # parts with dots stand in double quotes
            value = {part.strip('"'): value}
        tables = _completed(value, tables)
    table = config.checked(ScenarioTable, tables, path)
    network = load_network(folder / table.network)
    check_step(network, table.step / table.substeps, str(path))
    values = {
        key: value for key, value in vars(table).items() if key in Scenario.__dataclass_fields__
    }
    values["network"] = network
    values["demand"] = table.demand_factor * _demand(table, network, folder)
    values["folder"] = folder
    values["controller_options"] = table.controllers
    values["initial"] = np.array(table.initial) if table.initial else None
    if max(table.protected, default=0) >= network.regions:
        allowed = f"a list of distinct whole numbers from 0 to {network.regions - 1}"
        raise config.error(path, "protected", config.got(allowed, list(table.protected)))
    _check_initial(table.initial, network.regions, path)
    scenario = Scenario(**values)
    _ = scenario.ordered_faults
    return scenario


def _check_initial(rows: tuple[Numbers, ...], regions: int, path: Path) -> None:
    """Raise InputError unless there are no rows, or R of R numbers from 0 up."""
    if not rows:
        return
    lengths = {len(rows), *map(len, rows)}
    if lengths != {regions} or min(map(min, rows)) < 0:
        allowed = f"{regions} lists of {regions} numbers from 0 up"
        raise config.error(path, "initial", config.got(allowed, [list(row) for row in rows]))


def read_tables(folder: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """Return `folder`/scenario.toml, completed by the scenario that it names as `base`. Raises
    InputError.

    above: folders of the scenarios based on this one
    """
    file, folders = folder / "scenario.toml", (*above, folder)
    own = config.read(file)
    base = own.pop("base", None)
    _relocate(own, folder, folders[0])
    if folder.resolve() in (other.resolve() for other in above):
        raise config.error(
            file, "base", "the scenarios are each other's base; remove one of the keys"
        )
    if base is None:
        return own
    if not isinstance(base, str) or not base.isprintable():
        raise config.error(file, "base", config.got("the folder of a scenario in quotes", base))
    return _completed(
        own, read_tables(shipped.found(base, shipped.SCENARIO, beside=folder), folders)
    )


def _relocate(own: dict, folder: Path, here: Path) -> None:
    """Rewrite the paths in a scenario.toml in `folder` relative to the folder `here`."""

    def seen(name: str, *kinds: str) -> str:
        return files.relative(shipped.found(name, *kinds, beside=folder), here)

    for key, kinds in (("network", (shipped.NETWORK,)), ("demand_file", ())):
        if isinstance(own.get(key), str):
            own[key] = seen(own[key], *kinds)
    sumo = own.get("sumo")
    if isinstance(sumo, dict):
        for key in ("routes", "background", "additional"):
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
    both = {
        key: _completed(content[key], base[key])
        for key in content
        if isinstance(content[key], dict) and isinstance(base.get(key), dict)
    }
    return {**base, **content, **both}


def _demand(table: ScenarioTable, network: RegionalModel, folder: Path) -> PairsOverTime:
    """Return the demand (T, R, R) [veh/s] of [[demand]] and demand_file. Raises InputError."""
    demand = np.zeros((table.steps, network.regions, network.regions))
    time = table.step * np.arange(table.steps)
    for n, row in enumerate(table.demand or ()):
        for key, region in (("from", row.origin), ("to", row.to)):
            if region >= network.regions:
                known = f"region {region} is unknown; network {network.name} has 0 to {network.regions - 1}"
                raise config.error(folder / "scenario.toml", f"demand[{n}].{key}", known)
        demand[:, row.origin, row.to] += row.rate(time)
    if table.demand_file is not None:
        from_file = np.zeros_like(demand)
        interval, origin, to, rate = _demand_rows(folder / table.demand_file, network.regions)
        inside = interval < table.steps
        np.add.at(from_file, (interval[inside], origin[inside], to[inside]), rate[inside])
        demand += from_file
    return demand


def _demand_rows(path: Path, regions: int) -> tuple[np.ndarray, ...]:
    """Return interval, origin, destination (N,) and flow (N,) [veh/s] of a csv file. Raises
    InputError."""
    files.check_file(path, "give a csv file")
    try:
        text = path.read_text(encoding="utf-8").splitlines()
        if not text or text[0] != "interval,from,to,veh_s":
            raise ValueError("its first line is not interval,from,to,veh_s")
        rows = np.loadtxt(text[1:], delimiter=",", ndmin=2).reshape(-1, 4)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as demand ({error}); give a csv file") from None
    interval, origin, to, rate = rows.T
    whole_numbers = (rows[:, :3] == np.floor(rows[:, :3])).all(axis=1) & (rows[:, :3] >= 0).all(
        axis=1
    )
    good = (
        whole_numbers
        & (np.maximum(origin, to) < regions)
        & (rate >= 0.0)
        & (rate <= MOST_FLOW_VEH_S)
    )
    if not good.all():
        line = int(np.argmin(good))
        raise InputError(
            f"{path}: line {line + 2}: expected an interval from 0 up, two regions from 0 to {regions - 1} and "
            f"veh/s from 0 to {MOST_FLOW_VEH_S:g}, got {text[line + 1]} instead"
        )
    return interval.astype(int), origin.astype(int), to.astype(int), rate
