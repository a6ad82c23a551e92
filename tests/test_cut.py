"""Trips of a network inside a smaller network, and the city that `cosim get` makes of them."""

import pytest
import tiny_city

from cosim.importing import get
from cosim.importing.case import read_sumo_input
from cosim.importing.cut import DELAY, UNKNOWN_SPEED, Trip, trips_inside
from cosim.importing.streets import read_streets

ROUTES = """<routes>
  <route id="r0" edges="far A0A1 A1B1 gap B1C1 C1D1 D1D2 far"/><route id="r1" edges="A0A1 A1B1"/>
</routes>"""
VEHICLES = """<additional>
  <vehicle id="late" depart="30" route="r0"/><vehicle id="early" depart="20" route="r1"/>
</additional>"""


@pytest.fixture
def streets(tmp_path):
    return read_streets(tiny_city.network(tmp_path))


@pytest.mark.parametrize(
    ("route", "expected"),
    [
        ("A0A1 A1B1 B1C1", "A0A1 A1B1 B1C1"),
        ("far A0A1 A1B1 gap B1C1 C1D1 D1D2 far", "B1C1 C1D1 D1D2"),
        ("A0A1 A1B1 B1C1 gap C1D1 D1D2", "A0A1 A1B1 B1C1"),
        ("A0A1 A1B1 C1D1 D1D2 D2D3", "C1D1 D1D2 D2D3"),
        ("A0A1 A1B1 gap B1C1 C1D1", "A0A1 A1B1"),
        ("A0A1 gap B1C1", None),
        ("far", None),
    ],
    ids=("whole", "longest", "begin", "not connected", "first of equals", "too short", "outside"),
)
def test_the_longest_connected_stretch(streets, route, expected):
    found = trips_inside([Trip("a", 0.0, route.split())], streets)
    assert [" ".join(trip.edges) for trip in found] == [expected] * (expected is not None)


def test_a_trip_enters_later_by_its_time_outside(streets):
    def time(edge):
        return streets.length[streets.number[edge]] / streets.speed[streets.number[edge]]

    route = ["far", "A0A1", "A1B1", "gap", "B1C1", "C1D1", "D1D2"]
    trips = [
        Trip("a", 100.0, route),
        Trip("b", 101.0, route[4:]),
        Trip("a", 50.0, route[4:]),  # the same vehicle in another part
    ]
    own, entering = trips_inside(trips, streets)
    assert own == ("b", 101.0, route[4:], False)
    unknown = streets.length.mean() / UNKNOWN_SPEED
    outside = time("A0A1") + time("A1B1") + 2 * unknown
    assert entering.depart == pytest.approx(100.0 + DELAY * outside)
    assert entering.entered


def test_get_makes_the_cut(monkeypatch, tmp_path):
    tiny_city.network(tmp_path)
    (tmp_path / "part.rou.xml").write_text(ROUTES)
    (tmp_path / "part_vehicles.add.xml").write_text(VEHICLES)
    files = ("city.net.xml", "part.rou.xml", "part_vehicles.add.xml")
    city = {
        "about": "a city",
        "licence": "MIT",
        "sources": [(tmp_path / file).as_uri() for file in files],
        "folder": "tiny",
        "start": "tiny.sumocfg",
        "regions": "dublin-regions.csv",
        "cut": {"net": files[0], "around": [], "trips": ["part"], "begin": 0, "end": 600},
    }
    monkeypatch.setattr(get, "published", lambda: {"there": city})
    out = tmp_path / "there"
    text = get.get("there", out)
    assert f"cosim import {out}/tiny.sumocfg --regions {out}/dublin-regions.csv" in text
    assert (out / "dublin-regions.csv").is_file()
    assert read_sumo_input(out / "tiny.sumocfg").end == 600.0
    traffic = tiny_city.traffic_of(out / "tiny.sumocfg")
    assert [vehicle.get("id") for vehicle in traffic.vehicles] == ["early", "late"]
    assert [vehicle.get("departPos") for vehicle in traffic.vehicles] == ["random_free", "base"]
