"""Vehicles of the link model: where trips begin and end, and the average vehicle."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from cosim.evaluation.link_vehicles import CAR, drives_of, means_of
from cosim.evaluation.links import link_network
from cosim.plant.settings import settings
from cosim.sumo.recorded_trips import RecordedTrips
from nmfd import api

LENGTHS = {"a": 100.0, "b": 200.0}
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
        ('departPos="25" arrivalPos="50"', 0.75, 0.25),
        ('departPos="-25" arrivalPos="-50"', 0.25, 0.75),
        ('departPos="random_free" arrivalPos="random"', 0.5, 0.5),
        ('departPos="last" arrivalPos="max"', 1.0, 1.0),
        ('departPos="500" arrivalPos="-500"', 0.0, 0.0),
    ],
)
def test_trips_begin_and_end_along_their_streets(places, first, last):
    given = trips(f'<vehicle id="v" depart="0" {places}><route edges="a b"/></vehicle>')
    (drive,) = drives_of(given, {}, LENGTHS)
    assert drive == (("a", "b"), pytest.approx(first), pytest.approx(last))


def test_trips_without_a_way_are_left_out():
    given = trips(
        '<vehicle id="v" depart="0"><route edges="a"/></vehicle>',
        '<vehicle id="w" depart="0"><route edges="a c"/></vehicle>',
        '<vehicle id="x" depart="0" route="r"/>',
        '<trip id="y" depart="0" from="a" to="b"/>',
    )
    drives = drives_of(given, {"r": ("b", "a")}, LENGTHS)
    assert [drive.route for drive in drives] == [("b", "a")]


def test_the_average_vehicle(tmp_path):
    (tmp_path / "types.xml").write_text(TYPES)
    scenario = replace(api.load_scenario("demo"), folder=tmp_path)
    chosen = settings(scenario).model_copy(update={"additional": ("types.xml",)})
    types = ("van", "mix", "small", "unknown")
    given = trips(*(f'<vehicle id="{n}" depart="0" type="{n}"/>' for n in types))
    means = means_of(scenario, chosen, given)
    assert means["length"] == pytest.approx(np.mean([8.0, 4.0, 3.0, CAR["length"]]))
    assert means["minGap"] == pytest.approx(np.mean([2.5, 1.25, 1.0, 2.5]))
    assert means["accel"] == CAR["accel"]


@pytest.mark.slow
def test_vehicles_that_ignore_signs_keep_their_streets():
    """475 of Bologna's cars drive on lanes for buses, and count as flow where they drive."""
    network = link_network(api.load_scenario("bologna_lanes"))
    assert "b35[0]" in network.street
    assert network.spacing == pytest.approx(6.2, abs=0.2)
