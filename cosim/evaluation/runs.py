"""Runs in SUMO for nmfd.runs.run_many: jobs, and everything that their results depend on."""

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
    flows = np.ascontiguousarray(with_demand(scenario, factor=demand).demand)
    shared = {
        **(city or city_key(scenario, strategies)),
        "steps": scenario.steps,
        "demand": float(demand),
        "demand_hash": hashlib.sha256(flows.tobytes()).hexdigest()[:16],
    }
    own = policies or {}
    for strategy in strategies:
        strategy.make(scenario, own.get(strategy.name))  # reports mistakes before the first run
    keys = {
        s.name: {**shared, "controller": s.fingerprint(scenario, own.get(s.name))}
        for s in strategies
    }
    cost = SECONDS_PER_TRIP * scenario.step * float(flows.sum())
    return [
        Run(
            run_name(s.name, seed),
            keys[s.name],
            Simulation(scenario, s, seed, demand, own.get(s.name)),
            folder,
            cost,
        )
        for seed in seeds
        for s in strategies
    ]


def city_key(scenario: Scenario, strategies: Sequence[Strategy]) -> dict[str, object]:
    """Check that the strategies can run in the city; return what all runs there depend on. Raises
    InputError."""
    chosen = settings(scenario)
    check_tables(scenario)
    files = city_files(scenario.network)
    city = scenario_city(scenario, chosen)
    check_adjacency(city, scenario.network)
    own_vehicles(scenario, chosen, city)
    simple, _ = read_signals(city, own_files(scenario, chosen.additional), HELD)
    everywhere = any(one.settings(scenario).signals_from_outside for one in strategies)
    incidents.check(
        scenario.ordered_faults,
        city,
        "faults",
        [signal.id for signal in simple] if everywhere else (),
    )
    for path in own_files(scenario, (*chosen.background, *chosen.additional)):
        read_xml(path)
    for strategy in strategies:
        check_strategy(strategy, scenario, city)
    sumo = chosen.model_dump(mode="json", exclude_defaults=True)
    hashes = {
        key: [file_hash(path) for path in own_files(scenario, sumo[key])]
        for key in FILES
        if key in sumo
    }
    return {
        "scenario": scenario.name,
        "network": scenario.network.name,
        "plant": "sumo",
        "step_s": scenario.step,
        "net_file_hash": file_hash(files.net_file),
        "regions_hash": file_hash(files.regions_csv),
        "measurement_std_veh": scenario.measurement_std,
        "sumo": {**sumo, **hashes},
        "libsumo": metadata.version("libsumo"),
        "faults": list(scenario.faults),
    }
