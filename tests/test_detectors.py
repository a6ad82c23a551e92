"""Loop detectors and probes in SUMO: what they see of a small run, and the closed loop on
estimates."""

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import tiny

from cosim.evaluation.simulate import Simulation, estimation_errors, simulate
from cosim.plant.detectors import instruments, lay_out, probes
from cosim.plant.plant import SumoPlant
from cosim.plant.settings import Settings, settings
from cosim.plant.strategy import parse
from nmfd import api, closed_loop
from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.model.planning import planning_model
from nmfd.types import Controls

SCENARIO = "grid7_peak"


@pytest.fixture(scope="module")
def scenario():
    """The peak from its middle on: the forecast is right, and the city fills."""
    return tiny.part(load_scenario(SCENARIO), 14, 2)


def drive(scenario, controller=None, planning=None, settings=None, **overrides):
    plant = SumoPlant(scenario, settings=settings or Settings(**overrides), planning=planning)
    with closing(plant):
        return closed_loop.run(
            plant, controller or api.controller("pi-gating", scenario), scenario, seed=3
        )


@pytest.fixture(scope="module")
def run(scenario):
    return drive(scenario, measurement="estimate")


def test_travel_times_come_from_probes(scenario):
    with closing(SumoPlant(scenario, settings=Settings(measurement="estimate"))) as plant:
        plant.reset(3)
        plant.step(Controls(perimeter=scenario.network.open_perimeter))
        streets = plant._streets
    assert 0.05 < streets.timed.sum() / streets.vehicles.sum() < 0.2
    assert (np.isfinite(streets.speed) == (streets.timed > 0.0)).all()
    assert np.nanmin(streets.speed) > 0.0


def test_layout(city):
    few, many = lay_out(city, 0.1), lay_out(city, 0.3)
    assert set(few.edges) < set(many.edges)
    assert lay_out(city, 0.3).positions == many.positions
    for edge, positions in zip(many.edges, many.positions, strict=True):
        length = city.length[city.edges[edge]]
        assert positions[0] > 0.0
        assert positions[-1] < length
        assert len(positions) == (1 if length < 100.0 else 2 if length < 150.0 else 3)
        assert np.allclose(np.diff(positions), length / len(positions))
    per_region = np.bincount(
        [city.region_of[city.edges[edge]] for edge in many.edges], minlength=city.regions
    )
    links = np.bincount([city.region_of[edge] for edge in city.edges], minlength=city.regions)
    assert (per_region == np.ceil(0.3 * links)).all()
    known = instruments(city, many, 0.1)
    assert ((known.detector_share > 0.15) & (known.detector_share < 0.45)).all()
    assert (known.detector_error < instruments(city, few, 0.1).detector_error).all()
    everything = instruments(city, lay_out(city, 1.0), 1.0)
    assert (everything.detector_share == 1.0).all()
    assert (everything.detector_error < known.detector_error).all()
    assert (everything.detector_noise < known.detector_noise).all()
    assert (everything.counted_share.sum(axis=1) > 0).all()
    assert set(np.unique(everything.counted_share)) == {0.0, 1.0}


def test_probes_are_a_share_of_the_vehicles():
    names = [f"v{n}" for n in range(10_000)]
    drawn = probes(names, 0.1, seed=4)
    assert 900 < len(drawn) < 1100
    assert drawn == probes(names, 0.1, seed=4) != probes(names, 0.1, seed=5)
    assert probes(names, 0.0, seed=4) == frozenset()
    assert probes(names, 1.0, seed=4) == set(names)


@pytest.mark.slow
def test_all_links_and_all_probes_see_everything(scenario):
    """Loops on every link come close to the accumulations; probes are all vehicles."""
    plant = SumoPlant(
        scenario, settings=Settings(measurement="estimate", detector_share=1.0, probe_share=1.0)
    )
    seen = []
    with closing(plant):
        state, controller = plant.reset(3), api.controller("pi-gating", scenario)
        readings = plant._estimation.readings
        plant._estimation.readings = lambda: (seen.append(readings()), seen[-1])[1]
        for _ in range(scenario.steps):
            before, state = state, plant.step(controller.act(plant.observe()))
        estimate, streets = plant.observe(), plant._streets
        crossings = plant.record()["crossings"][-1].sum(axis=2)
    assert (seen[-1].probes == state.accumulation).all()
    assert (streets.timed == streets.vehicles).all()
    assert np.abs(estimate.accumulation - state.accumulation).max() < 3.0
    assert (estimate.backlog == state.backlog).all()
    mean = 0.5 * (before.accumulation + state.accumulation).sum()
    assert seen[-1].accumulation.sum() == pytest.approx(mean, rel=0.25)
    there = np.isfinite(seen[-1].crossings)
    assert (there == scenario.network.adjacency).all()
    assert (
        np.abs(seen[-1].crossings[there] - crossings[there]).max() <= 3.0
    )  # on a junction: crossed, not yet counted


def test_the_closed_loop_runs_on_estimates(scenario, run):
    """The estimate is what the gate sees, the trajectory stays exact, and they are not far
    apart."""
    assert run.observed.shape == run.accumulation.shape
    assert np.isfinite(run.observed).all()
    assert run.observed.min() >= 0.0
    assert (run.observed[0] == 0.0).all()
    assert (run.accumulation == np.round(run.accumulation)).all()
    assert (run.observed[1:] != np.round(run.observed[1:])).any()
    share, cells = estimation_errors(run, scenario.network.critical).values()
    assert 0.0 < share < 0.15
    assert 0.0 < cells < 10.0
    vehicles = run.accumulation[-1].sum()
    assert abs(run.observed[-1].sum() - vehicles) < 0.2 * vehicles


def test_estimating_changes_nothing_but_what_is_seen(scenario, run):
    """The same controls give the same city, with detectors or without."""
    again = tiny.Acting(lambda seen: Controls(perimeter=run.perimeter[seen.step]))
    exact = drive(scenario, again)
    assert not exact.estimated
    assert run.estimated
    assert (exact["accumulation"] == run.accumulation).all()


def test_states_are_estimated_with_the_model_of_those_who_drive():
    """`simulate` gives the plant the model with which the controller plans: another estimate of the
    same city."""
    strategies = [
        parse(name) for name in ("route-guidance+estimate", "route-guidance+estimate+max-pressure")
    ]
    scenario = load_scenario(SCENARIO, {"steps": 1})
    models = [strategy.planning(scenario).network for strategy in strategies]
    assert [model.folder.name for model in models] == ["grid7_guided", "grid7_max_pressure"]
    found = simulate(Simulation(scenario, strategies[0], seed=3))
    for model, same in zip(models, (True, False), strict=True):
        planning = replace(planning_model(scenario), network=model)
        changed = settings(scenario).changed(measurement="estimate")
        again = drive(scenario, make_controller("route-guidance", scenario), planning, changed)
        assert (again.accumulation == found.accumulation).all()
        assert (again.observed == found.observed).all() == same
