"""The SUMO plant: ledger, signals second by second, guidance, reproducibility. Small, seeded
simulations of grid7."""

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import libsumo
import numpy as np
import pytest
import tiny

from cosim.plant.guidance import Guide
from cosim.plant.sampling import StreetSampler
from cosim.sumo.session import Session
from nmfd.api import load_scenario
from nmfd.model.scenario import with_demand
from nmfd.types import Controls

SCENARIO = "grid7_peak"
INTERVALS = 4


@pytest.fixture(scope="module")
def scenario():
    """The beginning of the peak, where the demand already flows."""
    return tiny.part(load_scenario(SCENARIO), 12, INTERVALS)


def random_controls(scenario, random, *, guidance=False):
    network = scenario.network
    perimeter = random.uniform(network.u_min - 0.2, network.u_max + 0.2, (network.regions,) * 2)
    perimeter = np.clip(perimeter, network.u_min, network.u_max)
    splits = random.random(network.split_mask.shape) * network.split_mask
    splits /= np.where(
        splits.sum(axis=1, keepdims=True) > 0, splits.sum(axis=1, keepdims=True), 1.0
    )
    return Controls(perimeter=perimeter, splits=splits if guidance else None)


def drive(plant, scenario, *, seed=1, guidance=False):
    """Run under random controls; the measurements and the plant's record."""
    random = np.random.default_rng(seed)
    measurements = [plant.reset(seed)]
    for _ in range(scenario.steps):
        measurements.append(plant.step(random_controls(scenario, random, guidance=guidance)))
    return measurements, SimpleNamespace(**plant.record())


def test_open_gateways_leave_sumo_alone(scenario, plant_of):
    """Every state at u_max is what SUMO shows by itself."""
    plant, shown = plant_of(), []
    network = scenario.network
    open_gateways = Controls(perimeter=network.open_perimeter)
    for actuated in (True, False):
        plant.reset(1)
        if not actuated:
            plant.session.set_signal_state = None  # would fail if anything were played
            plant.actuation._controls.clear()
        states = []
        step = plant.session.step
        plant.session.step = lambda step=step, states=states, session=plant.session: (
            step(),
            states.append([session.signal_state(s) for s in session.signals()]),
        )
        shown.append((states, plant.step(open_gateways).accumulation.tolist()))
    assert shown[0] == shown[1]


def test_ledger_and_crossings_balance(scenario, plant_of):
    measurements, record = drive(plant_of(), scenario, guidance=True)
    for k, (before, after) in enumerate(pairwise(measurements)):
        crossings = record.crossings[k]
        expected = before.accumulation + record.departures[k] - crossings.sum(1) + crossings.sum(0)
        expected -= np.diag(record.arrivals[k])
        assert (after.accumulation == expected).all()
        assert (crossings.sum(axis=2)[~scenario.network.adjacency] == 0).all()
    demand = scenario.step * scenario.demand.sum()
    entered = record.departures.sum() + measurements[-1].backlog.sum()
    assert abs(entered - demand) <= scenario.network.regions**2
    assert record.arrivals.sum() > 100


def test_the_samples_are_those_of_every_edge(plant_of):
    """Both while there are fewer vehicles than edges, and later."""
    plant, asked, crossing = plant_of(), [], []
    plant.reset(1)
    sampler = StreetSampler(plant.session, plant.city)

    def compared():
        asked.append(len(sampler._travelled()[0]))
        sampler.sample()
        counts, speeds = sampler.last
        session, edges = plant.session, plant.city.edges
        assert counts.tolist() == [session.vehicle_count(edge) for edge in edges]
        there = [
            [libsumo.vehicle.getSpeed(one) for one in session.vehicles_on(edge)] for edge in edges
        ]
        np.testing.assert_allclose(
            speeds, [np.mean(one) if one else 0.0 for one in there], atol=1e-9
        )
        means = sampler.finish(np.full(len(edges), False))
        routed = [
            libsumo.edge.getLastStepMeanSpeed(edge) if one else np.nan
            for edge, one in zip(edges, there, strict=True)
        ]
        np.testing.assert_allclose(
            means.speed, routed
        )  # guidance goes by what SUMO's own drivers have
        assert means.production.sum() == pytest.approx(sum(map(sum, there)))
        on_junctions = [session.vehicles_on(edge) for edge in plant.city.inside]
        assert means.crossing.tolist() == [len(there) for there in on_junctions]
        lengths = plant.city.inside.values()
        np.testing.assert_allclose(
            means.crossed,
            [
                sum(map(libsumo.vehicle.getSpeed, there)) / length
                for there, length in zip(on_junctions, lengths, strict=True)
            ],
            atol=1e-9,
        )
        crossing.append(int(means.crossing.sum()))

    for _ in range(18):
        for _ in range(10):
            plant.session.step()
        compared()
    assert 0 < min(asked) < max(asked) == len(plant.city.edges)
    assert max(crossing) > 10


@pytest.mark.slow
def test_teleporting_vehicles_stay_in_the_ledger(scenario, plant_of):
    plant = plant_of(time_to_teleport=20.0)
    measurements, record = drive(plant, with_demand(scenario, steps=3), seed=2)
    assert record.teleports.sum() > 0
    inside = record.departures.sum() - record.arrivals.sum()
    assert measurements[-1].accumulation.sum() == inside


def test_guided_vehicles_go_where_theta_sends_them(scenario, plant_of, monkeypatch):
    """All vehicles in region 2 bound for 4 are sent through 0: with full compliance none leaves for
    3 or 5, but for the few who depart just before the stop line of a lane that leads there."""
    monkeypatch.setitem(Guide.__init__.__kwdefaults__, "most_detour", 1e9)
    crossings, guided = sent_round(scenario, plant_of())
    assert guided > 15
    assert crossings[0] >= 10
    assert crossings[0] > 0.8 * crossings.sum()


def sent_round(scenario, plant):
    """Vehicles in 2 bound for 4 that left for every region (R,), and those guided to 0, where theta
    sends all there."""
    network = scenario.network
    splits = network.nominal_splits.copy()
    splits[2, :, 4] = 0.0
    splits[2, 0, 4] = 1.0
    plant.reset(1)
    for _ in range(scenario.steps):
        plant.step(Controls(perimeter=network.open_perimeter, splits=splits))
    record = SimpleNamespace(**plant.record())
    return record.crossings.sum(axis=0)[2, :, 4], record.guided.sum(axis=0)[2, 0, 4]


def test_guided_vehicles_are_asked_again(scenario, plant_of):
    """The ledger is checked at every step; who was told something else counts for the last only."""
    plant, scenario = plant_of(), with_demand(scenario, steps=1)
    _, once = drive(plant, scenario, guidance=True)
    plant.close()
    asked = plant_of(guidance_period=20.0)
    (first, record), (second, _) = (drive(asked, scenario, guidance=True) for _ in range(2))
    assert (record.guided != once.guided).any()
    assert 0 < record.guided.sum() <= record.departures.sum() + record.crossings.sum()
    assert (record.guided.sum(axis=0) >= 0).all()
    assert [m.accumulation.tolist() for m in first] == [m.accumulation.tolist() for m in second]


def test_second_session_is_refused(plant_of):
    plant_of().reset(1)
    with pytest.raises(RuntimeError, match="already open"):
        Session(Path("a"), Path("b"), seed=0)
