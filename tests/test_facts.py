"""Facts of a run: trips as SUMO tells of them, queues before gateways, what is recorded per
edge."""

import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import tiny
import tiny_city

import cosim
from cosim.evaluation import simulate
from cosim.plant.meter import Trip
from cosim.plant.plant import SumoPlant
from cosim.sumo.outputs import TripReader
from nmfd import metrics
from nmfd.api import load_scenario
from nmfd.model.scenario import with_demand
from nmfd.types import Controls

SCENARIO = "grid7_peak"
TRIP = '<tripinfo id="v" depart="{}" arrival="{}" duration="{}"/>'


def test_vehicles_under_way_have_not_ended(tmp_path):
    path = tmp_path / "trips.xml"
    path.write_text(f"<tripinfos>{TRIP.format(10, 110, 100)}{TRIP.format(50, -1, 70)}</tripinfos>")
    reader = TripReader(path)
    assert [end.time for end in reader.finish()] == [110.0]
    assert reader.completed == 1
    assert list(reader.under_way) == ["v"]


def test_trips_that_never_began_count_with_what_they_have_waited():
    trips = [
        Trip(0, True, "completed", 5.0, 105.0, 30.0),
        Trip(0, True, "under way", 0.0, 70.0, 10.0),
        Trip(1, True, "waiting", 400.0, 400.0),
        Trip(1, True, "given up", 25.0, 25.0),
        Trip(0, False, "waiting", 9000.0, 9000.0),
        Trip(1, False, "completed", 0.0, 90.0, 40.0, True),
        Trip(1, False, "waiting", 80.0, 80.0, public=True),
    ]
    row, by_origin = simulate.trip_measures(trips, 3)
    assert (row["trips"], row["removed_veh"], row["removed_waiting_veh"], row["other_trips"]) == (
        4,
        1,
        1,
        3,
    )
    assert (row["public_transport_trips"], row["public_transport_delay_s"]) == (2, 40.0)
    np.testing.assert_array_equal(by_origin, [87.5, 212.5, np.nan])
    assert (row["mean_trip_time_s"], row["mean_departure_delay_s"], row["mean_time_loss_s"]) == (
        150.0,
        107.5,
        20.0,
    )
    nobody, _ = simulate.trip_measures([], 3)
    assert nobody["trips"] == nobody["other_time_spent_veh_s"] == 0
    assert np.isnan(nobody["mean_trip_time_s"])


@pytest.fixture(scope="module")
def run():
    """Two intervals in the middle of the peak, second by second: plant, record, vehicles on the
    road, facts."""
    scenario = with_demand(tiny.part(load_scenario(SCENARIO), 20, 2), factor=2.0)
    plant = SumoPlant(scenario)
    try:
        plant.reset(1)
        running, step, session = [], plant.session.step, plant.session
        session.step = lambda: (step(), running.append(len(session.running())))
        network = scenario.network
        for _ in range(2):
            plant.step(Controls(perimeter=network.open_perimeter))
        facts = plant.trip_facts()
        yield plant, SimpleNamespace(**plant.record()), running, facts
    finally:
        plant.close()


def test_time_on_the_road_is_that_of_the_vehicles_seen_second_by_second(run):
    plant, record, running, _ = run
    trips = plant.meter.trips()
    assert sum(trip.time - trip.departure_delay for trip in trips) == pytest.approx(sum(running))
    assert record.time_spent.sum() == pytest.approx(sum(trip.time for trip in trips))
    assert len(trips) >= record.departures.sum()
    lost = [sum(trip.time_loss for trip in trips if trip.origin == origin) for origin in range(7)]
    assert ((np.array(lost) > 0.0) == (record.departures.sum(axis=(0, 2)) > 0)).all()
    assert sum(lost) < sum(running)


def test_measures_of_a_city_are_those_of_tripinfo(tmp_path):
    """Cars and buses that cannot all enter, in a run that ends before their trips."""
    config, info = tiny_city.city(tmp_path), tmp_path / "trips.xml"
    crowd = '<flow id="{0}" {1} begin="600.3" end="900" period="0.7" from="{2}" to="{3}"/>'
    crowds = crowd.format("cars", "", "A1B1", "C1D1") + crowd.format(
        "line9", 'type="citybus"', "A2B2", "C2D2"
    )
    (tmp_path / "buses.rou.xml").write_text(
        tiny_city.BUSES.replace("<vehicle", crowds + "<vehicle")
    )
    scenario = tiny_city.imported(tmp_path, source=config)
    result = cosim.run(scenario, "no-control", steps=3, seed=1, tripinfo=info)
    row = metrics.summary(result)
    root = ElementTree.parse(info)
    trips = pd.DataFrame([trip.attrib for trip in root.iter("tripinfo")])
    trips = trips.astype(
        dict.fromkeys(("depart", "arrival", "duration", "departDelay", "timeLoss"), float)
    )
    trips = trips[
        trips["duration"] + trips["departDelay"] > 0
    ]  # the others are due at the end itself
    time, other = trips["duration"] + trips["departDelay"], trips["vType"].str.startswith("citybus")
    begun, ended = ~other & (trips["depart"] >= 0), ~other & (trips["arrival"] >= 0)
    emissions = {
        trip.get("id"): float(trip.find("emissions").get("CO2_abs"))
        for trip in root.iter("tripinfo")
    }
    assert row["co2_kg"] == pytest.approx(
        1e-6 * sum(emissions.values()), rel=1e-2
    )  # parts of steps
    assert result["co2"].sum() == pytest.approx(row["co2_kg"], rel=1e-5)
    assert result["co2"].min() >= 0.0
    assert (
        row["longest_queue_veh"] == result["queue_max"].max() >= result["gateway_queue_max"].max()
    )
    private, delay = time[~other], trips["departDelay"]
    expected = {
        "total_time_spent_veh_s": private.sum(),
        "trips": len(private),
        "departed_veh": sum(begun),
    }
    expected |= {"completed_veh": sum(ended), "final_backlog_veh": sum(~other & ~begun)}
    expected |= {
        "mean_trip_time_s": private.mean(),
        "mean_finished_trip_time_s": time[ended].mean(),
    }
    expected |= {
        "median_trip_time_s": np.percentile(private, 50),
        "p95_trip_time_s": np.percentile(private, 95),
    }
    expected |= {
        "mean_departure_delay_s": delay[~other].mean(),
        "mean_time_loss_s": trips["timeLoss"][begun].mean(),
    }
    expected |= {"other_trips": sum(other), "other_time_spent_veh_s": time[other].sum()}
    expected |= {"other_departure_delay_veh_s": delay[other].sum()}
    expected |= {
        "public_transport_trips": sum(other),
        "public_transport_delay_s": trips["timeLoss"][other & (trips["depart"] >= 0)].mean(),
    }
    assert {name: row[name] for name in expected} == pytest.approx(
        expected, rel=1e-5
    )  # of hundredths of seconds
    assert result["time_spent"].shape == (3,)
    assert min(expected.values()) > 0
    assert result["other_time_spent"].sum() == pytest.approx(time[other].sum())


def test_outputs_do_not_change_who_reroutes(tmp_path):
    scenario = load_scenario(tiny_city.imported(tmp_path), {"sumo.rerouting": 0.5, "steps": 4})
    files = None, tmp_path / "a.xml"
    plain, written = (cosim.run(scenario, "no-control", seed=1, tripinfo=each) for each in files)
    assert (plain.edge_vehicles == written.edge_vehicles).all()
    assert plain.co2_kg == written.co2_kg > 0


def test_vehicles_under_way_have_emitted(run):
    plant, record, running, trips = run
    assert record.arrivals.sum() < 0.2 * record.departures.sum()  # hardly any trip has ended
    totals = plant.edge_totals()
    assert totals["passed"].sum() > 2 * record.departures.sum()  # each passes several streets
    assert 0.0 < totals["time_loss"].sum() < record.time_spent.sum() + record.other_time_spent.sum()
    assert totals["co2"].sum() == pytest.approx(trips["co2_kg"], rel=1e-5)
    edges = [plant.city.edges.index(gateway.from_edge) for gateway in plant.city.gateways]
    assert (totals["queue_max"][edges] == record.gateway_queue_max.max(axis=0)).all()
    litres = trips["fuel_kg"] / 0.745
    assert 0.3 < litres / sum(running) * 3600 < 5.0  # per vehicle and hour, in city traffic
    assert trips["co2_kg"] / trips["fuel_kg"] == pytest.approx(
        3.1, abs=0.15
    )  # kg of CO2 from a kg of petrol


def test_edges_hold_the_vehicles_of_their_region(run):
    plant, record, _, _ = run
    region = np.array([plant.city.region_of[edge] for edge in plant.city.edges])
    summed = np.stack(
        [np.bincount(region, edges, 7) for edges in record.edge_vehicles.astype(float)]
    )
    np.testing.assert_allclose(summed, record.mean_accumulation, rtol=2e-3)


def test_the_time_inside_is_that_of_all_vehicles(run):
    """Junctions included."""
    _, record, running, _ = run
    assert record.time_inside.sum() == pytest.approx(sum(running), rel=1e-3)


def test_queues_before_gateways(run):
    _, record, _, _ = run
    assert (record.gateway_queue <= record.gateway_queue_max).all()
    assert record.gateway_queue_max.max() > 5


def test_full_edges_before_gateways(run):
    plant, record, _, _ = run
    city, room = plant.city, plant.city.room
    for share, expected in ((0.0, 0.0), (0.7, 0.0), (0.9, 1.0)):
        full = vars(record) | {"edge_vehicles": np.tile(share * room, (2, 1))}
        row = simulate.queue_facts(full, city)
        assert row["gateway_full_share"] == expected
