"""Vehicles of the link model: where trips begin and end, and the average vehicle."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from cosim.evaluation.link_vehicles import (
    CAR,
    STOPPING_S,
    Drive,
    blocked,
    drives_of,
    means_of,
)
from cosim.evaluation.links import by_quarter, link_network
from cosim.sumo.net import city_of
from cosim.sumo.recorded_trips import RecordedTrips
from cosim.sumo.route_plan import QUARTER_S
from nmfd import api

TYPES = """
<additional>
  <vType id="van" length="8"/>
  <vTypeDistribution id="mix">
    <vType id="small" length="3" minGap="1" probability="0.75"/>
    <vType id="large" length="7" minGap="2" probability="0.25"/>
  </vTypeDistribution>
</additional>"""


def trips(*elements):
    parts = tuple(map(ElementTree.fromstring, elements))
    return RecordedTrips(depart=np.zeros(len(parts)), elements=parts)


@pytest.mark.parametrize(
    "places, first, last",
    [
        ("", 1.0, 1.0),
        ('departPos="25" arrivalPos="25"', 0.75, 0.25),
        ('departPos="-25" arrivalPos="-25"', 0.25, 0.75),
        ('departPos="random_free" arrivalPos="random"', 0.5, 0.5),
        ('departPos="last" arrivalPos="max"', 1.0, 1.0),
        ('departPos="500" arrivalPos="-500"', 0.0, 0.0),
    ],
)
def test_trips_begin_and_end_along_their_streets(places, first, last):
    city = city_of(api.load_scenario("demo").network)
    move = city.moves[0]
    city = replace(city, length={**city.length, **dict.fromkeys(move, 100.0)})
    route = f'<route edges="{" ".join(move)}"/>'
    given = trips(f'<vehicle id="v" depart="0" {places}>{route}</vehicle>')
    (drive,) = drives_of(given, {}, [], city)
    assert drive == (0.0, move, pytest.approx(first), pytest.approx(last))


def test_trips_are_parted_by_the_time_they_are_due():
    """Those before the first quarter of an hour, or after the last one, count in these."""
    due = [-1.0, 0.0, QUARTER_S - 1.0, QUARTER_S, 5.0 * QUARTER_S]
    drives = [Drive(100.0 + time, ("a", "b"), 1.0, 1.0) for time in due]
    parts = by_quarter(drives, 100.0, 2.0 * QUARTER_S)
    assert [len(part) for part in parts] == [3, 2]
    assert parts[1] == drives[3:]


def test_trips_without_a_route_take_the_fastest_one():
    """Those that have no way, or drive on one street only, are left out."""
    city = city_of(api.load_scenario("demo").network)
    first, second = city.moves[0]
    given = trips(
        f'<vehicle id="v" depart="0"><route edges="{first}"/></vehicle>',
        f'<vehicle id="w" depart="0"><route edges="{first} unknown"/></vehicle>',
        '<vehicle id="x" depart="0" route="r"/>',
        f'<trip id="y" depart="0" from="{first}" to="{second}"/>',
        f'<trip id="z" depart="0" from="{first}" to="unknown"/>',
    )
    drives = drives_of(given, {"r": (first, second)}, [], city)
    assert [drive.route for drive in drives] == 2 * [(first, second)]


def test_the_average_vehicle(tmp_path):
    file = tmp_path / "types.xml"
    file.write_text(TYPES)
    types = ("van", "mix", "small", "unknown")
    given = trips(*(f'<vehicle id="{n}" depart="0" type="{n}"/>' for n in types))
    means = means_of(given, [file])
    assert means["length"] == pytest.approx(np.mean([8.0, 4.0, 3.0, CAR["length"]]))
    assert means["minGap"] == pytest.approx(np.mean([2.5, 1.25, 1.0, 2.5]))
    assert means["accel"] == CAR["accel"]


def test_buses_that_stop_block_their_lane(tmp_path):
    """A stop of a time that is not known counts nothing."""
    buses = tmp_path / "buses.xml"
    stops = tmp_path / "stops.xml"
    stops.write_text('<additional><busStop id="s" lane="a_0"/></additional>')
    buses.write_text(
        """<routes><vehicle id="v" depart="triggered"><stop busStop="s" duration="20"/>
        <stop lane="b_1" duration="0:00:40"/><stop lane="b_1" until="600"/></vehicle>
        <trip id="w" depart="1800"><stop busStop="s" duration="24"/></trip></routes>"""
    )
    shares = blocked([buses], [stops], 1800.0)
    assert shares == {
        "a_0": pytest.approx((20.0 + 24.0 + 2 * STOPPING_S) / 1800.0),
        "b_1": pytest.approx((40.0 + STOPPING_S) / 1800.0),
    }
    assert blocked([], [stops], 1800.0) == {}


@pytest.mark.slow
def test_vehicles_that_ignore_signs_keep_their_streets():
    """475 of Bologna's cars drive on lanes for buses, and count as flow where they drive."""
    network = link_network(api.load_scenario("bologna_lanes"))
    assert "b35[0]" in network.street
    assert network.spacing == pytest.approx(6.2, abs=0.2)
