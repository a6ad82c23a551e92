"""Facts of a run: trips as SUMO tells of them, queues before gateways, what is recorded per edge."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trajectories

from cosim.evaluation import simulate
from cosim.plant.plant import SumoPlant
from cosim.sumo.net import edge_room
from cosim.sumo.outputs import TripReader
from nmfd import metrics
from nmfd.api import load_scenario
from nmfd.types import Controls

SCENARIO = Path(__file__).parents[1] / "scenarios" / "grid7_peak"
TRIP = '<tripinfo id="v" depart="{}" departDelay="{}" arrival="{}" duration="{}">{}</tripinfo>'
EMITTED = '<emissions CO2_abs="2000000" fuel_abs="1000000"/>'


def test_trips_under_way_and_not_departed_count_with_what_they_have_spent(tmp_path):
    path = tmp_path / "trips.xml"
    path.write_text(
        "<tripinfos>"
        + "".join(
            (TRIP.format(10, 5, 110, 100, EMITTED), TRIP.format(50, 0, -1, 70, EMITTED), TRIP.format(-1, 40, -1, 0, ""))
        )
        + "</tripinfos>"
    )
    reader = TripReader(path)
    reader.finish()
    read = reader.facts
    assert (read.trips, read.completed, read.travel_time, read.departure_delay) == (3, 1, 170.0, 45.0)
    assert (read.co2, read.fuel) == (4.0, 2.0)
    row = simulate.trip_means(read)
    assert row["mean_trip_time_s"] == pytest.approx(170 / 3) and row["mean_departure_delay_s"] == 15.0


@pytest.fixture(scope="module")
def run():
    """Three intervals in the middle of the peak, second by second: plant, record, vehicles on the road, facts."""
    loaded = load_scenario(SCENARIO)
    scenario = replace(loaded, steps=3, demand=2.0 * loaded.demand[20:23])
    plant = SumoPlant(scenario)
    try:
        plant.reset(1)
        running, step, session = [], plant.session.step, plant.session
        session.step = lambda: (step(), running.append(len(session.running())))
        network = scenario.network
        for _ in range(3):
            plant.step(Controls(perimeter=np.where(network.adjacency, network.u_max, 0.0), splits=None))
        yield plant, SimpleNamespace(**plant.record()), running, plant.trip_facts()
    finally:
        plant.close()


def test_time_on_the_road_is_that_of_the_vehicles_seen_second_by_second(run):
    plant, record, running, trips = run
    assert trips.travel_time == pytest.approx(sum(running), rel=0.01)  # a second at either end of a trip
    assert trips.completed == record.arrivals.sum() and trips.trips >= record.departures.sum()


def test_what_is_lost_on_the_road_is_known_by_origin(run):
    plant, record, running, trips = run
    lost = plant.time_loss()
    assert lost.sum() == pytest.approx(trips.time_loss) and 0.0 < trips.time_loss < trips.travel_time
    assert ((lost > 0.0) == (record.departures.sum(axis=(0, 2)) > 0)).all()


def test_fairness_is_that_of_mean_delays_by_origin():
    waiting = np.zeros((3, 2, 2))
    waiting[:, 1, 0] = [10.0, 10.0, 5.0]  # two intervals of 30 s, five that never entered
    departures = np.zeros((2, 2, 2))
    departures[0], departures[1, 1, 0] = [[20.0, 10.0], [0.0, 5.0]], 20.0
    run = trajectories.made(
        controller="no-control",
        plant="sumo",
        seed=0,
        step=30.0,
        accumulation=waiting,
        backlog=waiting,
        completed=np.zeros(3),
        perimeter=np.zeros((2, 2, 2)),
        splits=np.zeros((2, 2, 2, 2)),
    )
    arrays = trajectories.record(2, regions=2) | {"departures": departures, "given_up": np.zeros((2, 2, 2))}
    run = trajectories.recorded(run, arrays, {})
    # 30 trips from region 0 lose 10 s each, 30 from region 1 wait 20 s and lose 10 s each
    assert simulate.delay_gini(run, np.array([300.0, 300.0])) == pytest.approx((30 - 10) / (2 * (30 + 10)))
    assert metrics.gini(np.array([5.0, 5.0, 5.0]), np.array([1.0, 9.0, 0.0])) == 0.0
    assert metrics.gini(np.array([0.0, 0.0, 3.0]), np.array([1.0, 1.0, 1.0])) == pytest.approx(2 / 3)
    assert metrics.gini(np.array([0.0, 3.0]), np.array([2.0, 1.0])) == pytest.approx(2 / 3)  # people, not regions
    assert metrics.gini(np.zeros(2), np.ones(2)) == 0.0 and np.isnan(metrics.gini(np.ones(2), np.zeros(2)))


def test_vehicles_under_way_have_emitted(run):
    _, record, running, trips = run
    assert record.arrivals.sum() < 0.2 * record.departures.sum()  # hardly any trip has ended
    litres = trips.fuel / 0.745
    assert 0.3 < litres / sum(running) * 3600 < 5.0  # per vehicle and hour, in city traffic
    assert trips.co2 / trips.fuel == pytest.approx(3.1, abs=0.15)  # kg of CO2 from a kg of petrol


def test_edges_hold_the_vehicles_of_their_region(run):
    plant, record, _, _ = run
    region = np.array([plant.city.region_of[edge] for edge in plant.city.edges])
    summed = np.stack([np.bincount(region, edges, 7) for edges in record.edge_vehicles.astype(float)])
    np.testing.assert_allclose(summed, record.mean_accumulation, rtol=2e-3)


def test_open_gateways_show_the_original_green(run):
    plant, record, _, _ = run
    actuated = ~np.isnan(record.gateway_green[0])
    assert actuated.sum() > 50
    shown, original = record.gateway_green[1:, actuated], record.gateway_original_green[1:, actuated]
    np.testing.assert_allclose(shown, original, atol=1.0)
    assert (record.gateway_queue <= record.gateway_queue_max).all() and record.gateway_queue_max.max() > 5


def test_full_edges_before_gateways(run):
    plant, record, _, _ = run
    city, room = plant.city, edge_room(plant.city)
    for share, expected in ((0.0, 0.0), (0.7, 0.0), (0.9, 1.0)):
        full = SimpleNamespace(**vars(record) | {"edge_vehicles": np.tile(share * room, (3, 1))})
        row = simulate.queue_facts(full, city)
        assert row["gateway_full_share"] == expected
