"""A city's own vehicles: what seeds and demand factors do to them; demand files, one-way
neighbours."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import tiny

from cosim.sumo.recorded_trips import (
    draw,
    read_recorded_trips,
    write_held_trips,
    write_recorded_trips,
)
from cosim.sumo.xml_files import xml_text
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model.regional_model import load_network

VEHICLES = (
    "<routes>"
    + "".join(
        f'<vehicle id="v{n}" type="lorry" depart="{100 + 2 * n}"><route edges="a b"/>'
        '<stop lane="a_0" duration="5"/></vehicle>'
        for n in range(200)
    )
    + "</routes>"
)


def recorded(folder, routes):
    (folder / "cars.rou.xml").write_text(routes)
    return read_recorded_trips([folder / "cars.rou.xml"])


@pytest.fixture
def originals(tmp_path):
    return recorded(tmp_path, VEHICLES)


def test_seed_moves_departures_and_nothing_else(originals, tmp_path):
    def written(name, **options):
        path = tmp_path / name
        drawn = draw(
            originals, **{"seed": 1, "factor": 1.0, "jitter": 10.0, "begin": 100.0} | options
        )
        write_recorded_trips(originals, drawn, path)
        return path.read_bytes()

    assert written("a") == written("b") != written("c", seed=2)
    plain = ElementTree.fromstring(written("d", jitter=0.0))
    assert [ElementTree.tostring(e).strip() for e in plain] == [
        ElementTree.tostring(original).strip() for original in originals.elements
    ]
    departs = {e.get("id"): float(e.get("depart")) for e in ElementTree.fromstring(written("e"))}
    shift = np.array([departs[f"v{n}"] - (100 + 2 * n) for n in range(200)])
    assert np.abs(shift).max() <= 10.01
    assert shift.std() > 3.0
    assert min(departs.values()) >= 100.0


def test_elements_are_written_as_by_the_library():
    text = (
        '<vehicle id="a&amp;&quot;b" name="&lt;\'&#10;&#9;&#13;é"> x &lt; y <route edges="a b"/>z'
        "<param key='k'>v</param><stop><param/></stop>\n</vehicle>"
    )
    element = ElementTree.fromstring(text)
    assert xml_text(element) == ElementTree.tostring(element, encoding="unicode")
    element.set("id", "other")
    element.set("depart", "1")
    changed = xml_text(ElementTree.fromstring(text), {"id": "other", "depart": "1"})
    assert changed == ElementTree.tostring(element, encoding="unicode")


MIXED = """<routes>
  <vehicle id="own" type="car" depart="1" departLane="best" arrivalPos="-1" color="red"
    arrival="90"><route edges="a b"/></vehicle>
  <vehicle id="shared" depart="2" route="morning"/>
  <vehicle id="unknown" depart="3" route="evening"/>
  <vehicle id="stops" depart="4"><route edges="a b"/><stop lane="a_0" duration="5"/></vehicle>
  <vehicle id="line" depart="5" line="7"><route edges="a b"/></vehicle>
  <vehicle id="repeats" depart="6"><route edges="a b" repeat="3"/></vehicle>
  <vehicle id="parks" depart="7">
    <route edges="a b"><stop lane="a_0" duration="5"/></route></vehicle>
  <vehicle id="nowhere" depart="8"><route edges=""/></vehicle>
  <vehicle id="tells" depart="9"><param key="a" value="b"/></vehicle>
  <trip id="trip" depart="10" from="a" to="c"/>
  <trip id="round" depart="11" from="c" to="c"/>
  <trip id="via" depart="12" from="a" to="c" via="b"/>
  <trip id="zone" depart="13" fromTaz="a" to="c"/>
</routes>"""


def test_whom_a_program_can_let_begin(tmp_path):
    originals = recorded(tmp_path, MIXED)
    drawn = draw(originals, seed=1, factor=1.0, jitter=0.0, begin=0.0)
    held = write_held_trips(
        originals, drawn, tmp_path / "out.xml", {"morning": ("b", "c")}, {"a": 0, "b": 1, "c": 2}
    )
    assert held.orders == (
        {
            "vehID": "own",
            "routeID": "held.0",
            "typeID": "car",
            "departLane": "best",
            "arrivalPos": "-1",
        },
        {"vehID": "shared", "routeID": "morning"},
        {"vehID": "trip", "routeID": "held.9"},
        {"vehID": "round", "routeID": "held.10"},
    )
    assert held.depart.tolist() == [1.0, 2.0, 10.0, 11.0]
    assert held.origin.tolist() == [0, 1, 0, 2]
    assert held.destination.tolist() == [1, 2, 2, 2]
    written = list(ElementTree.parse(tmp_path / "out.xml").getroot())
    routes, others = ([e for e in written if (e.tag == "route") == held] for held in (True, False))
    assert [(e.get("id"), e.get("edges")) for e in routes] == [
        ("held.0", "a b"),
        ("held.9", "a c"),
        ("held.10", "c"),
    ]
    names = ["unknown", "stops", "line", "repeats", "parks", "nowhere", "tells", "via", "zone"]
    assert [e.get("id") for e in others] == names
    assert others[1].find("stop") is not None


@pytest.mark.parametrize(
    "factor, count", [(0.0, 0), (0.8, 160), (1.0, 200), (1.3, 260), (2.5, 500)]
)
def test_factor_thins_and_duplicates(originals, factor, count):
    drawn = draw(originals, seed=3, factor=factor, jitter=5.0, begin=0.0)
    names = [name for _, _, name in drawn]
    assert len(drawn) == count == len(set(names))
    assert [t for t, _, _ in drawn] == sorted(t for t, _, _ in drawn)
    copies = np.bincount([n for _, n, _ in drawn], minlength=200)
    assert copies.max(initial=0) <= np.ceil(factor)
    assert copies.min() >= np.floor(factor)


@pytest.mark.parametrize(
    "text, expected",
    [
        ("<routes><flow id='f'/></routes>", "expected vehicle and trip elements only, got flow"),
        (
            "<routes><trip id='t' depart='triggered'/></routes>",
            "expected a time from 0 s up, got 'triggered'",
        ),
        ("<routes><trip", "is not an XML file that SUMO could read"),
    ],
)
def test_route_files_that_are_none(tmp_path, text, expected):
    with pytest.raises(InputError, match=expected):
        recorded(tmp_path, text)


def with_demand_file(folder, rows):
    scenario = tiny.write(
        folder,
        scenario=tiny.SCENARIO.split("[[demand]]")[0].replace(
            "protected", 'demand_file = "demand.csv"\nprotected'
        ),
    )
    (scenario / "demand.csv").write_text("interval,from,to,veh_s\n" + rows)
    return scenario


def test_demand_file(tmp_path):
    folder = with_demand_file(tmp_path, "0,0,1,2.5\n3,1,0,1.0\n3,1,0,0.5\n99,0,1,7\n")
    scenario = load_scenario(folder)
    assert scenario.demand[0, 0, 1] == 2.5
    assert scenario.demand[3, 1, 0] == 1.5
    assert scenario.demand.sum() == 4.0


def test_scenario_on_a_base_finds_its_files(tmp_path):
    folder = with_demand_file(tmp_path, "0,0,1,2.5\n")
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "scenario.toml").write_text('base = "../scenario"\ndemand_factor = 2.0\n')
    assert (
        load_scenario(tmp_path / "more").demand.sum()
        == 2.0 * load_scenario(folder).demand.sum()
        == 5.0
    )


def ring(onward=(1, 2)):
    """Regions 0, 1, 2, each adjacent to the others; from region 0 roads lead to `onward`."""
    return tiny.NETWORK.format(name="ring") + "".join(
        tiny.REGION.format(
            position=n, adjacent=list(onward) if n == 0 else [h for h in range(3) if h != n]
        )
        for n in range(3)
    )


def test_one_way_neighbours(tmp_path):
    tiny.write(tmp_path, network=ring([2]))
    network = load_network(tmp_path / "network")
    assert not network.adjacency[0, 1]
    assert network.adjacency[1, 0]
    assert network.hops[0, 1] == 2
    assert network.split_mask[0, :, 1].tolist() == [False, False, True]
    assert (network.nominal_splits.sum(axis=1)[~np.eye(3, dtype=bool)] > 0).all()
    tiny.write(tmp_path / "cut", network=ring([]))
    with pytest.raises(InputError, match="cannot be reached from region 0"):
        load_network(tmp_path / "cut" / "network")
