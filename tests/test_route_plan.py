"""Planned routes: who gets which, what a route costs all, and a plan of a small city."""

import xml.etree.ElementTree as ElementTree
from collections import Counter

import numpy as np
import pandas as pd
import pytest
import streets
import tiny_city
from commands import cosim, good

from cosim.evaluation.move_times import Costs, Driven, Visits, read_driven, visits
from cosim.evaluation.plan_routes import Base, Driver, assess, changed_plan, without_loops
from cosim.plant.strategy import parse
from cosim.sumo.recorded_trips import RecordedTrips
from cosim.sumo.route_plan import Ends, RoutePlan, planned_trips, read_plan
from nmfd.api import load_scenario
from nmfd.errors import InputError

SHORT, LONG = ("a", "b", "z"), ("a", "c", "z")


@pytest.fixture
def city():
    """Two ways from a to z; by c it takes longer on empty streets."""
    lengths = {"a": 10.0, "b": 10.0, "c": 30.0, "z": 10.0}
    onward = {"a": ("b", "c"), "b": ("z",), "c": ("z",), "z": ()}
    return streets.city(dict.fromkeys(lengths, 0), onward, length=lengths)


def vehicle(name, edges="a b z", **attributes):
    element = ElementTree.Element("vehicle", {"id": name, **attributes})
    if edges:
        ElementTree.SubElement(element, "route", edges=edges)
    return element


def routes_of(found):
    return [element.find("route").get("edges") for element in found.originals.elements]


def planned(plan, elements, departures=None, *, seed=1, compliance=1.0):
    """The trips of these vehicles with a plan; they depart at once unless it is said."""
    times = departures or [0.0] * len(elements)
    drawn = [(times[n], n, each.get("id")) for n, each in enumerate(elements)]
    trips = RecordedTrips(depart=np.zeros(len(elements)), elements=tuple(elements))
    found = planned_trips(plan, trips, drawn, {}, seed=seed, compliance=compliance)
    assert found.drawn == drawn
    return found


def plan_of(*rows):
    plan = RoutePlan()
    for row in rows:
        plan.add(*row)
    return plan


@pytest.mark.parametrize("seed", range(5))
def test_drivers_share_routes_as_in_the_plan_whatever_the_seed(seed):
    plan = plan_of((0.0, SHORT, 2), (0.0, LONG, 1), (900.0, LONG, 5))
    times = [float(n) for n in range(9)]
    found = planned(plan, [vehicle(f"v{n}") for n in range(9)], times, seed=seed)
    assert Counter(routes_of(found)) == {"a b z": 6, "a c z": 3}
    assert found.planned == {f"v{n}" for n in range(9)}


def test_the_nearest_quarter_of_an_hour_counts():
    plan = plan_of((0.0, LONG), (2700.0, SHORT))
    found = planned(plan, [vehicle("v"), vehicle("w")], [1000.0, 9000.0])
    assert routes_of(found) == ["a c z", "a b z"]


def test_only_drivers_with_a_plan_and_without_stops_are_planned():
    stopping = vehicle("stops")
    ElementTree.SubElement(stopping, "stop", lane="b_0")
    trip = ElementTree.Element("trip", {"id": "trip", "from": "a", "to": "z", "type": "car"})
    ElementTree.SubElement(trip, "param", key="of", value="trip")
    elements = [
        stopping,
        vehicle("elsewhere", "b z"),
        trip,
        vehicle("via", via="b"),
        vehicle("v"),
        vehicle("round", "a b a"),
    ]
    found = planned(plan_of((0.0, LONG)), elements)
    assert found.planned == {"trip", "v"}
    assert routes_of(found) == ["a b z", "b z", "a c z", "a b z", "a c z", "a b a"]
    made = found.originals.elements[2]
    assert (made.tag, made.attrib) == ("vehicle", {"id": "trip", "type": "car"})
    assert [part.tag for part in made] == ["route", "param"]


def test_some_drivers_keep_their_route_if_not_all_comply():
    drivers = [vehicle(f"v{n}") for n in range(400)]
    found = planned(plan_of((0.0, LONG)), drivers, compliance=0.5)
    assert len(found.planned) == 400  # none of them is guided either
    assert 160 < routes_of(found).count("a c z") < 240


def test_a_plan_is_written_read_and_added_up(tmp_path, city):
    plan_of((0.0, SHORT, 2), (950.0, LONG)).write(tmp_path / "plan.csv.gz")
    rows = pd.read_csv(tmp_path / "plan.csv.gz").to_numpy().tolist()
    assert rows == [[0.0, 2, "a b z"], [900.0, 1, "a c z"]]
    again = read_plan([tmp_path / "plan.csv.gz"] * 2, city)
    again.write(tmp_path / "twice.csv.gz")
    assert pd.read_csv(tmp_path / "twice.csv.gz")["drivers"].tolist() == [4, 2]


def test_trips_that_no_route_is_for_take_parts_of_routes():
    plan = plan_of((0.0, ("o", "a", "b", "z"), 2), (900.0, ("a", "c", "z", "p")), (0.0, ("b", "z")))
    plan.add_parts([Ends("a", "z"), Ends("b", "z"), Ends("z", "a"), None])
    assert plan.shared_out(Ends("a", "z"), 0, 2, 0.5) == [SHORT, SHORT]
    assert plan.shared_out(Ends("a", "z"), 1, 1, 0.5) == [LONG]
    assert plan.quarter(Ends("z", "a"), 0.0) is None
    assert plan.quarter(Ends("b", "z"), 900.0) == 0  # only its own route: no part of another


@pytest.mark.parametrize(
    ("text", "problem"),
    [("begin,drivers\n0,1\n", "is not a plan of routes"), (None, "row 0: edge y is not in")],
)
def test_a_wrong_plan_is_an_error(tmp_path, city, text, problem):
    file = tmp_path / "plan.csv"
    file.write_text(text or "begin,drivers,route\n0,1,a y z\n")
    with pytest.raises(InputError, match=problem):
        read_plan([file], city)


def test_times_are_those_of_moves_when_the_edge_was_entered(city):
    driven = [Driven(0.0, SHORT, (10.0, 310.0, 330.0)), Driven(0.0, LONG, (20.0,))]
    found = visits(city, driven, 0.0, 600.0)
    pairs = [("a", "b"), ("a", "c"), ("b", "z"), ("c", "z")]
    moves = [city.moves.index(pair) for pair in pairs]
    assert found.count[0, moves].tolist() == [1.0, 1.0, 1.0, 0.0]
    assert found.spent[0, moves].tolist() == [10.0, 20.0, 300.0, 0.0]
    assert not found.count[1].any()


def jammed(city, time):
    """Costs with many vehicles that took `time` (s) from b to z in the second period only."""
    shape = 2, len(city.moves)
    count = np.zeros(shape)
    count[1, city.moves.index(("b", "z"))] = 1e9
    return Costs(city, [Visits(time * count, count)], 0.0)


def test_a_route_costs_the_time_of_the_driver_and_of_those_behind(city):
    costs = jammed(city, 25.0)
    short, long = ([city.number[edge] for edge in route] for route in (SHORT, LONG))
    assert costs.of(short, 0.0) == pytest.approx(20.0)
    assert costs.of(short, 300.0) == pytest.approx(10.0 + 2 * 25.0 - 10.0)
    assert costs.of(long, 300.0) == pytest.approx(40.0)
    # b is entered 10 s after the departure.
    assert costs.of(short, 291.0) == pytest.approx(50.0)
    assert costs.of([short[0], short[2]], 0.0) == np.inf
    # The own time by b is shorter, 35 s, but adds more for all.
    tree = costs.least(short[0], 300.0)
    assert tree.way(short[2]) == tuple(long)
    assert tree.costs[short[2]] == pytest.approx(40.0)


def test_those_who_gain_most_change_first_and_the_gap_is_relative(city):
    costs = jammed(city, 25.0)
    drivers = [Driver(0.0, 0.0, LONG), Driver(300.0, 300.0, SHORT), Driver(400.0, 400.0, LONG)]
    found = assess(city, costs, drivers, 0.0)
    assert found.gap == pytest.approx(30.0 / (20.0 + 40.0 + 40.0))
    assert [(change.gain, change.driver) for change in found.changes] == [(20.0, 0), (10.0, 1)]
    plan = changed_plan(drivers, found.changes[:1])
    assert plan.shared_out(("a", "z"), 0, 3, 0.5) == [SHORT, SHORT, LONG]


def test_the_best_run_with_a_plan_is_changed_and_less_after_one_without_a_gain():
    guided = Base(0, 100.0, [])
    first = guided.after(1, 120.0, [])
    assert first == (1, 120.0, [], guided.share)
    worse = first.after(2, 130.0, [])
    assert (worse.number, worse.spent) == (1, 120.0)
    assert worse.share < first.share
    assert worse.after(3, 110.0, []) == (3, 110.0, [], worse.share)


def test_loops_are_cut():
    assert without_loops(("a", "b", "c", "b", "d", "a", "e")) == ("a", "e")


def test_the_word():
    strategy = parse("planned+max-pressure")
    assert strategy.city.planned == ("plan.csv.gz",)
    with pytest.raises(InputError, match="sumo.planned: no such file: .*; .*cosim plan"):
        strategy.settings(load_scenario("demo"))


@pytest.mark.slow
def test_a_plan_is_made_followed_and_resumed(tmp_path):
    scenario = tiny_city.imported(tmp_path)
    command = ("plan", scenario, "--controller max-pressure --iterations 2 --demand 2")
    told = good(cosim(*command, "--out", tmp_path / "runs"))
    assert len(told.splitlines()) == 1 + 3 + 1
    first = (scenario / "plan.csv.gz").read_bytes()
    (scenario / "plan.csv.gz").unlink()
    runs = [*(tmp_path / "runs").rglob("*.nc")]
    before = [run.stat().st_mtime_ns for run in runs]
    assert good(cosim(*command, "--out", tmp_path / "runs")) == told
    assert (scenario / "plan.csv.gz").read_bytes() == first
    assert [run.stat().st_mtime_ns for run in runs] == before
    assert len(read_driven(tmp_path / "runs" / "routes-2.xml")) > 100
    evaluate = ("evaluate", scenario, "--seeds 7-7 --demand 2 --out", tmp_path / "other")
    good(cosim(*evaluate, "--controllers planned+guided+compliance-50,no-control"))
    good(cosim(*evaluate, "--controllers planned+max-pressure --set sumo.routes=[]"))
