"""OD matrices between zones: three formats that say the same, and imports of cities whose demand is one."""

import gzip
import xml.etree.ElementTree as ElementTree

import numpy as np
import pandas as pd
import pytest
import tiny_city
from commands import cosim

from cosim.importing.case import read_sumo_input
from cosim.importing.demand import read_traffic
from cosim.importing.od import read_od, trips
from cosim.importing.streets import read_streets
from cosim.sumo.recorded_trips import read_recorded_trips
from nmfd.api import load_scenario
from nmfd.errors import InputError

RELATIONS = """<data><interval id="morning" begin="7:30:00" end="30600">
  <tazRelation from="west" to="east" count="90"/><tazRelation from="east" to="west" count="30.5"/>
  <tazRelation from="east" to="east" count="0"/></interval></data>"""
O_FORMAT = """$OR;D2
* From-Time  To-Time
7.30 8.30
* Factor
0.50
* from to number
   west  east   180.00
   east  west    61
   east  east     0
"""
V_FORMAT = """$VMR;D2
* vehicle type
van
7.30 8.30
* Factor
1.0
* zones
2
  west
  east
* west
   0   90.0
* east
   30.5
   0
"""
ZONES = """<additional><tazs><taz id="west"><tazSource id="A0A1" weight="3"/><tazSource id="A1A2" weight="1"/>
  <tazSink id="A1A0" weight="1"/></taz><taz id="east" edges="D1D2 D2D1"/></tazs></additional>"""


@pytest.fixture(scope="module")
def net(tmp_path_factory):
    folder = tmp_path_factory.mktemp("od")
    (folder / "zones.taz.xml").write_text(ZONES)
    return tiny_city.network(folder)


@pytest.mark.parametrize("name, text", [("a.xml", RELATIONS), ("a.od", O_FORMAT), ("a.fma", V_FORMAT)])
def test_three_formats_say_the_same(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with gzip.open(tmp_path / f"{name}.gz", "wt") as stream:
        stream.write(text)
    cells = read_od(tmp_path / name)
    assert {(c.origin, c.destination): c.count for c in cells} == {("west", "east"): 90.0, ("east", "west"): 30.5}
    assert all((c.begin, c.end, c.zones) == (27000.0, 30600.0, True) for c in cells)
    assert [c.count for c in read_od(tmp_path / f"{name}.gz")] == [90.0, 30.5]
    assert {c.type for c in cells} == ({"van"} if name == "a.fma" else {None})


@pytest.mark.parametrize("name, text", [("a.xml", RELATIONS), ("a.od", O_FORMAT), ("a.fma", V_FORMAT)])
def test_the_same_trips_as_od2trips(net, tmp_path, name, text):
    (tmp_path / name).write_text(text)
    option = "--tazrelation-files" if name == "a.xml" else "--od-matrix-files"
    tiny_city.run(
        "od2trips",
        "--taz-files",
        net.with_name("zones.taz.xml"),
        option,
        tmp_path / name,
        "--output-file",
        tmp_path / "trips.xml",
    )
    theirs = list(ElementTree.parse(tmp_path / "trips.xml").getroot().iter("trip"))
    ours = trips(read_od(tmp_path / name), np.random.default_rng(0), (), lambda *_: None)
    assert abs(len(theirs) - len(ours)) <= 1
    for made in (theirs, ours):
        departs = [float(trip.get("depart")) for trip in made]
        assert 27000.0 <= min(departs) < 27100.0 and 30500.0 < max(departs) <= 30600.0


def test_trips_are_even_and_half_a_vehicle_is_a_chance(tmp_path):
    (tmp_path / "a.xml").write_text(RELATIONS)
    cells, counts = read_od(tmp_path / "a.xml"), []
    for seed in range(40):
        made = trips(cells, np.random.default_rng(seed), (), lambda *_: None)
        counts.append(len(made))
        depart = np.array([float(trip.get("depart")) for trip in made[:90]])
        assert np.allclose(depart, 27000.0 + 40.0 * np.arange(90), atol=40.0) and (np.diff(depart) >= 0).all()
    assert set(counts) == {120, 121} and 10 < counts.count(121) < 30


def test_import_of_a_matrix(net, tmp_path):
    """It begins when the matrix does, weights of sources count, and the vehicles run between the zones."""
    (tmp_path / "morning.od").write_text(O_FORMAT)
    result = cosim(
        "import",
        net,
        "--regions",
        2,
        "--method",
        "geometric",
        "--od",
        tmp_path / "morning.od",
        "--zones",
        net.with_name("zones.taz.xml"),
        "--no-run",
        "--out",
        tmp_path / "networks" / "od",
    )
    assert result.exit_code == 0, result.output
    scenario = load_scenario(tmp_path / "scenarios" / "od")
    assert "begin = 27000.0" in (scenario.folder / "scenario.toml").read_text()
    vehicles = read_recorded_trips([scenario.folder / "vehicles.rou.xml.gz"])
    assert len(vehicles.depart) in (120, 121) and scenario.demand.sum() * scenario.step == pytest.approx(
        len(vehicles.depart), rel=1e-4
    )
    ends = pd.DataFrame([(e.get("from"), e.get("to")) for e in vehicles.elements], columns=["from", "to"])
    there = ends[ends["from"].str.startswith("A")]
    assert len(there) == 90 and set(there["to"]) == {"D1D2", "D2D1"}
    assert 0.6 < (there["from"] == "A0A1").mean() < 0.9
    assert set(ends["to"][ends["from"].str.startswith("D")]) == {"A1A0"}


def test_relations_in_an_additional_file(net, tmp_path):
    (tmp_path / "city.add.xml").write_text(ZONES.replace("</additional>", RELATIONS[6:-7] + "</additional>"))
    (tmp_path / "city.sumocfg").write_text(
        f'<configuration><net-file value="{net}"/><additional-files value="city.add.xml"/></configuration>'
    )
    case = read_sumo_input(tmp_path / "city.sumocfg")
    traffic = read_traffic(case, read_streets(case.net), seed=0)
    assert len(traffic.vehicles) in (120, 121) and "interval" not in [element.tag for element in traffic.shared]


@pytest.mark.parametrize(
    "text, expected",
    [
        ("nothing", "is no OD matrix"),
        ("<data/>", "is no OD matrix"),
        ("$OR;D2\n7.00 8.00\n", "ends before the line with"),
        ("$OR;D2\n7.00\n1\n", "from-time and to-time"),
        ("$OR;D2\n8.00 7.00\n1\n1 2 3\n", "an interval ends at 25200 s"),
        ("$OR;D2\n7.00 8.00\n1\n1 2 -3\n", "1 to 2: expected a number from 0 up"),
        ("$V;D2\n7.00 8.00\n1\n2\n1 2\n1 2 3\n", "expected 2 names and 2 x 2 numbers"),
    ],
)
def test_broken_matrices(tmp_path, text, expected):
    (tmp_path / "a.od").write_text(text)
    with pytest.raises(InputError, match=expected):
        read_od(tmp_path / "a.od")


def test_unknown_zone_and_vehicles_beside_a_matrix(net, tmp_path):
    (tmp_path / "a.od").write_text(O_FORMAT)
    arguments = (
        "--regions",
        2,
        "--method",
        "geometric",
        "--od",
        tmp_path / "a.od",
        "--no-run",
        "--out",
        tmp_path / "n",
    )
    result = cosim("import", net, *arguments)
    assert result.exit_code == 2 and "TAZ 'west' is unknown; define it in a file for --zones" in result.stderr
    result = cosim("import", tiny_city.city(tmp_path), *arguments)
    assert result.exit_code == 2 and "vehicles of its own; omit --od" in result.stderr
