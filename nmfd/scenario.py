"""Demand, noise, horizon: loaded from scenario.toml and checked."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nmfd import toml
from nmfd.network import Network, check_step, load_network


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
    controller_options: controller name -> its table in [controllers], checked by that controller
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
    folder: Path | None = None


def trapezoid(time: np.ndarray, *, start: float, peak: float, ramp_up: float, flat: float, ramp_down: float):
    """Demand [veh/s] at `time` (T,) [s]: rises from 0 at `start`, stays at `peak` for `flat` and falls to 0."""
    end = start + ramp_up + flat + ramp_down
    rising = (time - start) / ramp_up if ramp_up > 0 else np.where(time >= start, 1.0, 0.0)
    falling = (end - time) / ramp_down if ramp_down > 0 else np.where(time < end, 1.0, 0.0)
    return peak * np.clip(np.minimum(rising, falling), 0.0, 1.0)


def read_tables(folder: Path) -> toml.Table:
    """`folder`/scenario.toml; what it does not say is that of the scenario in the folder `base`, if it names one.

    Tables are completed key by key, everything else is taken whole. Raises InputError.
    """
    path, folders, content = folder / "scenario.toml", [], {}
    while True:
        table = toml.read(folder / "scenario.toml")
        own = table.raw()
        if folder.resolve() in folders:
            raise table.error("base", "the scenarios are each other's base; remove one of the keys")
        folders.append(folder.resolve())
        if isinstance(own.get("network"), str):  # relative to the file that says it
            own["network"] = os.path.relpath(folder / own["network"], path.parent)
        content = _completed(content, own)
        base = table.text("base", None)
        if base is None:
            content.pop("base", None)
            return toml.Table(content, path)
        folder = folder / base


def _completed(content: dict, base: dict) -> dict:
    """`content` with what only `base` has, in the tables of both too."""
    both = {key: _completed(content[key], base[key]) for key in content
            if isinstance(content[key], dict) and isinstance(base.get(key), dict)}
    return {**base, **content, **both}


def load_scenario(folder: Path | str) -> Scenario:
    """Read `folder`/scenario.toml and its network. Raises InputError; the table [sumo] is left to cosim."""
    folder = Path(folder)
    root = read_tables(folder)
    name = root.text("name")
    network = load_network(folder / root.text("network"))
    step = root.number("step", above=0.0)
    steps = root.integer("steps", low=1)
    integrator = root.text("integrator", "euler", ("euler", "rk4"))
    substeps = root.integer("substeps", 1, low=1)
    protected = root.integers("protected", (), high=network.regions - 1)
    noise = root.table("noise", None)
    measurement_std = noise.number("measurement_std", 0.0, low=0.0)
    noise.close()
    factor = root.number("demand_factor", 1.0, low=0.0)
    demand = np.zeros((steps, network.regions, network.regions))
    time = step * np.arange(steps)
    for row in root.tables("demand"):
        pair = [_region(row, key, network) for key in ("from", "to")]
        rate = trapezoid(
            time, start=row.number("start", low=0.0), peak=row.number("peak", low=0.0),
            ramp_up=row.number("ramp_up", low=0.0), flat=row.number("flat", low=0.0),
            ramp_down=row.number("ramp_down", low=0.0))
        demand[:, pair[0], pair[1]] += rate
        if row.flag("both_ways", False):
            demand[:, pair[1], pair[0]] += rate
        row.close()
    controller_options = root.raw_table("controllers")
    root.raw_table("sumo")
    root.close()
    check_step(network, step / substeps, str(folder / "scenario.toml"))
    return Scenario(
        name=name, network=network, step=step, steps=steps, demand=factor * demand, measurement_std=measurement_std,
        integrator=integrator, substeps=substeps, protected=protected, controller_options=controller_options,
        folder=folder)


def as_modelled(scenario: Scenario, controller: str) -> Scenario:
    """`scenario` with the regional model that `controller` plans with: the network that its option `model` names.

    Drivers who are guided, or who reroute by themselves, make another model of the same city. Raises InputError.
    """
    options = dict(scenario.controller_options.get(controller, {}))
    if "model" not in options or scenario.folder is None:
        return scenario
    table = toml.Table(options, scenario.folder / "scenario.toml", f"controllers.{controller}.")
    model = load_network(scenario.folder / table.text("model"))
    if not np.array_equal(model.adjacency, scenario.network.adjacency):
        raise table.error("model", f"network {model.name} has other regions or boundaries than {scenario.network.name}"
                          "; identify one for the same city with 'cosim identify'")
    del options["model"]
    check_step(model, scenario.step / scenario.substeps, f"{model.folder}")
    return replace(
        scenario, network=model, controller_options={**scenario.controller_options, controller: options})


def _region(row: toml.Table, key: str, network: Network) -> int:
    value = row.integer(key)
    if value >= network.regions:
        raise row.error(
            key, f"region {value} is unknown; network {network.name} has the regions 0 to {network.regions - 1}")
    return value
