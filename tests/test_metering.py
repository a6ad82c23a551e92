"""Trips that are made to wait: how many, who first, and that nobody is lost or counted twice."""

import gzip
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_city

from cosim.plant.metering import FILLING_S, KI, KP, Metering
from cosim.sumo.recorded_trips import HeldTrips
from cosim.sumo.xml_files import read_xml
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model.plant import AcyclicPlant, NmfdPlant
from nmfd.model.scenario import with_demand
from nmfd.types import Controls

CRITICAL = np.array([100.0, 50.0])


def metering(depart, origin, level=1.2):
    """Of trips to region 1, and who has begun: (time, vehicle, route)."""
    begun, count = [], len(depart)
    session = SimpleNamespace(time=0.0, step_length=1.0)
    session.begin_trip = lambda order: begun.append(
        (session.time, order["vehID"], order["routeID"])
    )
    trips = HeldTrips(
        depart=np.array(depart, dtype=float),
        origin=np.array(origin, dtype=int),
        destination=np.ones(count, dtype=int),
        orders=tuple({"vehID": f"v{n}", "routeID": f"r{n}"} for n in range(count)),
    )
    return Metering(session, trips, CRITICAL, level=level, step=90.0), session, begun


def played(meters, session, seconds):
    for _ in range(seconds):
        meters.play()
        session.time += 1.0


def test_trips_begin_in_turn_at_the_rate_and_what_is_not_used_is_not_saved():
    meters, session, begun = metering([0.0] * 6 + [100.0] * 3, [0, 1, 0, 0, 0, 1, 0, 0, 0])
    meters.command(np.array([0.1, 0.0]), CRITICAL)
    played(meters, session, 60)
    assert all(vehicle[1:] == route[1:] for _, vehicle, route in begun)
    assert meters.backlog().tolist() == [[0.0, 0.0], [0.0, 1.0]]
    assert meters.waiting() == [(1, 0.0)]
    assert {vehicle: time for time, vehicle, _ in begun} == meters.waited
    assert meters.waited == {"v0": 0.0, "v1": 0.0, "v2": 10.0, "v3": 20.0, "v4": 30.0}
    played(meters, session, 55)
    assert [time for time, _, _ in begun[5:]] == [100.0, 110.0]


@pytest.mark.parametrize("step", [0.5, 1.0])
@pytest.mark.parametrize("rate", [0.3, 0.4, 0.6, 0.7, 0.8, 0.9, 1.2, 1.5, 1.9])
def test_with_a_queue_trips_begin_at_the_commanded_rate(rate, step):
    meters, session, begun = metering([0.0] * 2000, [0] * 2000)
    session.step_length = step
    meters.command(np.array([rate, 0.0]), CRITICAL)
    for _ in range(round(1000 / step)):
        meters.play()
        session.time += step
    assert len(begun) == round(1000 * rate)


def test_without_a_command_regions_are_held_at_their_level():
    meters, _, _ = metering([], [])
    most, rates = CRITICAL / FILLING_S, []
    for full in (0.5, 1.5, 1.5, 1.3):
        meters.command(None, full * CRITICAL)
        rates.append(meters._rate / CRITICAL * 90.0)
    expected = [np.full(2, 90.0 / FILLING_S)]
    for before, now in ((0.5, 1.5), (1.5, 1.5), (1.5, 1.3)):
        expected.append(
            np.clip(expected[-1] + KP * (before - now) + KI * (1.2 - now), 0.0, 90.0 / FILLING_S)
        )
    np.testing.assert_allclose(rates, expected)
    assert 0.0 < rates[1][0] < rates[0][0]
    assert (meters._rate <= most).all()


@pytest.mark.parametrize("kind", [NmfdPlant, AcyclicPlant])
def test_in_the_regional_model_who_may_not_enter_waits_and_enters_later(kind):
    scenario = with_demand(load_scenario("economic_mpc"), steps=12)
    network, plant = scenario.network, kind(scenario)
    opened = Controls(perimeter=network.open_perimeter)
    due = scenario.demand.sum(axis=(1, 2)) * scenario.step
    state = plant.reset(0)
    for k in range(12):
        rate = np.full(network.regions, 0.001 if k < 6 else 1e6)
        state = plant.step(replace(opened, metering=rate))
        inside = scenario.start.sum() + due[: k + 1].sum() - state.completed
        assert state.accumulation.sum() + state.backlog.sum() == pytest.approx(inside)
        assert (state.backlog >= 0.0).all()
        assert (state.backlog.sum() > 1.0) == (0 < k < 6)
    assert state.backlog.sum() == pytest.approx(0.0, abs=1e-9)


def ran(scenario, seed=5, **changes):
    """States and trips of a city with nothing held back at its gateways."""
    network = scenario.network
    rate = changes.pop("rate", None)
    opened = Controls(perimeter=network.open_perimeter, metering=rate)
    with tiny_city.plant_of(scenario, **changes) as plant:
        plant.reset(seed)
        return [plant.step(opened) for _ in range(scenario.steps)], plant.meter.trips()


def test_in_a_city_the_books_hold_and_waiting_counts():
    """grid7 with hardly anybody let in: the same trips, due at the same times, wait."""
    scenario = with_demand(load_scenario("grid7_peak"), steps=3)
    rate = np.full(7, 0.02)
    (free, trips), (held, metered) = (
        ran(scenario, rate=rate, metering=level) for level in (0.0, 1.2)
    )
    assert len(metered) == len(trips)
    inside = [(state.accumulation.sum() + state.backlog.sum() + state.completed) for state in held]
    assert inside == [
        state.accumulation.sum() + state.backlog.sum() + state.completed for state in free
    ]
    assert held[-1].backlog.sum() > 0.4 * inside[-1] > free[-1].backlog.sum()
    began = inside[-1] - held[-1].backlog.sum()
    assert 0 < began <= 7 * (1 + 0.02 * 270)
    spent = 90.0 * sum(state.backlog.sum() for state in held[:2])  # the integral, from below
    assert (
        spent
        < sum(trip.departure_delay for trip in metered)
        < spent + 90.0 * held[-1].backlog.sum()
    )


@pytest.fixture
def own(tmp_path):
    """A city whose vehicles come from a route file."""
    return tiny_city.imported(tmp_path)


def test_a_citys_own_vehicles_wait_as_well(own):
    scenario = with_demand(load_scenario(own), steps=6)
    regions, step = scenario.network.regions, scenario.step
    (free, due), *metered = (
        ran(scenario),
        *(
            ran(scenario, metering=1.2, rate=np.full(regions, rate))
            for rate in (100.0, 0.0, 1.0 / step)
        ),
    )
    (fast, again), (closed, _), (held_back, trips) = metered
    inside = [
        [state.accumulation.sum() + state.backlog.sum() + state.completed for state in states]
        for states in (free, fast, closed, held_back)
    ]
    assert inside[0] == inside[1] == inside[2] == inside[3]
    assert len(due) == len(again) == len(trips)
    assert fast[-1].accumulation.sum() == pytest.approx(free[-1].accumulation.sum(), rel=0.15)
    began = (
        closed[-1].backlog.sum() - held_back[-1].backlog.sum()
    )  # some of the file do not wait, whatever the rate
    assert 0 < began <= regions * 6
    assert closed[-1].backlog.sum() > 0.9 * len(due)
    spent = step * sum(state.backlog.sum() for state in held_back[:-1])
    assert (
        spent
        < sum(trip.departure_delay for trip in trips)
        < spent + step * held_back[-1].backlog.sum()
    )


def test_a_city_in_which_no_trip_can_wait(own):
    vehicles = next(own.glob("vehicles.rou.xml*"))
    root = read_xml(vehicles)
    for vehicle in root:
        vehicle.set("line", "7")
    with gzip.open(vehicles, "wb") as stream:
        ElementTree.ElementTree(root).write(stream)
    with pytest.raises(
        InputError, match="sumo.metering: none of the vehicles in sumo.routes can wait"
    ):
        ran(load_scenario(own), metering=1.2)
