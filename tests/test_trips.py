"""Trips of grid7: their number, their regions, their routes and their seeds."""

import xml.etree.ElementTree as ElementTree
from itertools import pairwise

import numpy as np
import pytest

from cosim.sumo.recorded_trips import as_recorded, draw, write_recorded_trips
from cosim.sumo.trips import make_trips
from nmfd.api import load_scenario


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("grid7_peak")


@pytest.fixture(scope="module")
def trips(city, scenario):
    return make_trips(city, scenario.demand, scenario.step, seed=1)


def test_every_pair_gets_its_vehicles(trips, scenario):
    counts = np.zeros((7, 7))
    np.add.at(counts, (trips.origin, trips.destination), 1)
    assert np.abs(counts - scenario.demand.sum(axis=0) * scenario.step).max() < 1.0
    assert 7000 <= counts.sum() <= 11000


def test_vehicles_depart_when_the_demand_says(trips, scenario):
    per_step = np.histogram(trips.depart, bins=scenario.step * np.arange(scenario.steps + 1))[0]
    pairs = (scenario.demand.sum(axis=0) > 0).sum()
    assert np.abs(per_step - scenario.demand.sum(axis=(1, 2)) * scenario.step).max() < pairs
    assert (np.diff(trips.depart) >= 0).all()


def test_routes_lead_from_region_to_region(trips, city):
    for origin, destination, route, arrival in zip(
        trips.origin, trips.destination, trips.routes, trips.arrival, strict=True
    ):
        assert city.region_of[route[0]] == origin
        assert city.region_of[route[-1]] == destination
        assert route[0] != route[-1]
        assert all(b in city.successors[a] for a, b in pairwise(route))
        assert 0 < arrival < city.length[route[-1]]


def test_no_trip_starts_or_ends_on_a_radial_or_in_a_pocket(trips, city):
    into_the_centre = {gateway.from_edge for gateway in city.gateways if gateway.target == 3}
    out_of_the_centre = {gateway.to_edge for gateway in city.gateways if gateway.source == 3}
    assert not into_the_centre & {route[0] for route in trips.routes}
    assert not out_of_the_centre & {route[-1] for route in trips.routes}
    assert not any(edge.endswith(".p") for route in trips.routes for edge in (route[0], route[-1]))


def test_seeds(city, scenario, trips, tmp_path):
    written, file = [], tmp_path / "trips.rou.xml"
    again, other = (make_trips(city, scenario.demand, scenario.step, seed) for seed in (1, 2))
    for drawn in (trips, again, other):
        made = as_recorded(drawn)
        write_recorded_trips(made, draw(made, seed=1, factor=1.0, jitter=0.0, begin=0.0), file)
        written.append(file.read_bytes())
    first, again, other = written
    assert first == again != other
    vehicles = list(ElementTree.fromstring(first).iter("vehicle"))
    assert len(vehicles) > 7000
    assert [vehicle.get("id") for vehicle in vehicles] == [f"v{n}" for n in range(len(vehicles))]
