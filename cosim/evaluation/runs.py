"""Runs in SUMO for nmfd.runs.run_many: jobs and what they depend on."""

import hashlib
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path

import numpy as np

from cosim.evaluation.simulate import Simulation
from cosim.plant import incidents
from cosim.plant.launch import own_vehicles
from cosim.plant.programmes import check_strategy, scenario_city
from cosim.plant.settings import FILES, own_files, settings
from cosim.plant.strategy import Strategy, check_tables
from cosim.sumo.net import check_adjacency, city_files
from cosim.sumo.signals import HELD, read_signals
from cosim.sumo.xml_files import read_xml
from nmfd.model.scenario import Scenario, with_demand
from nmfd.runs.files import file_hash, run_name
from nmfd.runs.run_many import Run

GUIDANCE = ("cosim.plant.guidance",)  # loads a compiler, so only for guided runs
SECONDS_PER_TRIP = 0.006  # wall time, in the committed results of grid7 and cities


def runs_of(
    scenario: Scenario,
    strategies: Sequence[Strategy],
    seeds: Sequence[int],
    *,
    city: Mapping[str, object] | None = None,
    demand: float = 1.0,
    policies: Mapping[str, Path] | None = None,
    folder: str = "",
) -> list[Run]:
    """Return the runs of strategies x seeds at one demand level, seed by seed.

    city: result of `city_key`, computed if None
    policies: strategy name -> file instead of the scenario's
    folder: below that of all runs
    Raises: InputError if a strategy cannot run in this city
    """
    if city is None:
        city = city_key(scenario, strategies)
    if policies is None:
        policies = {}
    flows = np.ascontiguousarray(with_demand(scenario, factor=demand).demand)
    shared = {
        **city,
        "steps": scenario.steps,
        "demand": float(demand),
        "demand_hash": hashlib.sha256(flows.tobytes()).hexdigest()[:16],
    }
    keys = {}
    for strategy in strategies:
        policy = policies.get(strategy.name)
        strategy.make(scenario, policy)  # reports mistakes before the first run
        own = strategy.fingerprint(scenario, policy)
        keys[strategy.name] = {**shared, "controller": own}
    expected = SECONDS_PER_TRIP * scenario.step * float(flows.sum())
    runs = []
    for seed in seeds:
        for strategy in strategies:
            name = strategy.name
            job = Simulation(scenario, strategy, seed, demand, policies.get(name))
            modules = GUIDANCE if strategy.guides else ()
            runs.append(Run(run_name(name, seed), keys[name], job, folder, expected, modules))
    return runs


def city_key(scenario: Scenario, strategies: Sequence[Strategy]) -> dict[str, object]:
    """Return what all runs in the city depend on.

    Raises: InputError if a strategy cannot run in it
    """
    chosen = settings(scenario)
    check_tables(scenario)
    files = city_files(scenario.network)
    city = scenario_city(scenario, chosen)
    check_adjacency(city, scenario.network)
    own_vehicles(scenario, chosen, city)
    simple, _ = read_signals(city, own_files(scenario, chosen.additional), HELD)
    driven = []
    if any(one.settings(scenario).signals_from_outside for one in strategies):
        driven = [signal.id for signal in simple]
    incidents.check(scenario.ordered_faults, city, "faults", driven)
    for path in own_files(scenario, (*chosen.background, *chosen.additional)):
        read_xml(path)
    for strategy in strategies:
        check_strategy(strategy, scenario, city)
    sumo = chosen.model_dump(mode="json", exclude_defaults=True)
    for key in FILES:
        if key in sumo:
            sumo[key] = [file_hash(path) for path in own_files(scenario, sumo[key])]
    return {
        "scenario": scenario.name,
        "network": scenario.network.name,
        "plant": "sumo",
        "step_s": scenario.step,
        "net_file_hash": file_hash(files.net_file),
        "regions_hash": file_hash(files.regions_csv),
        "measurement_std_veh": scenario.measurement_std,
        "sumo": sumo,
        "libsumo": metadata.version("libsumo"),
        "faults": list(scenario.faults),
    }
