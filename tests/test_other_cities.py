"""What cities of others bring: each gives a working result or one clear line, and loses no vehicle
without a word."""

import re
import shutil

import numpy as np
import pytest
import tiny_city
from commands import cosim
from tiny_city import driven

from cosim.api import run as cosim_run
from cosim.importing.case import read_sumo_input
from cosim.importing.importer import import_city
from cosim.importing.quality import left_alone
from cosim.importing.streets import read_streets
from cosim.plant.settings import settings
from cosim.sumo.recorded_trips import draw, read_recorded_trips
from cosim.sumo.signals import read_files
from nmfd.api import load_scenario
from nmfd.errors import InputError

FLOW = '<flow id="f" begin="0" end="600" number="60" from="A1B1" to="C1D1"/>'


@pytest.fixture(scope="module")
def net(tmp_path_factory):
    return tiny_city.network(tmp_path_factory.mktemp("net"))


@pytest.fixture
def city(net, tmp_path):
    """city(routes, additional, options, net) writes a sumocfg with these contents."""

    def write(routes=FLOW, additional="", options="", net_file=net):
        (tmp_path / "c.rou.xml").write_text(f"<routes>{routes}</routes>")
        (tmp_path / "c.add.xml").write_text(f"<additional>{additional}</additional>")
        config = tmp_path / "c.sumocfg"
        config.write_text(
            f'<configuration><net-file value="{net_file}"/><route-files value="c.rou.xml"/>'
            f'<additional-files value="c.add.xml"/>{options}</configuration>'
        )
        return config

    return write


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """The folder of an imported city."""
    folder = tmp_path_factory.mktemp("project")
    tiny_city.imported(folder)
    return folder


def imported(source, out=None, **options):
    """(report, scenario) of an import into two regions."""
    out = out or source.parent / "networks" / "x"
    scenario = out.parent.parent / "scenarios" / out.name
    for folder in (out, scenario):
        shutil.rmtree(folder, ignore_errors=True)
    report = import_city(source, out, scenario, **{"regions": 2, "seeds": 1} | options)
    return report, load_scenario(scenario)


def refused(config, *options):
    """The one line of an import that fails and leaves nothing behind."""
    result = cosim(
        "import", config, "--regions 2 --out", config.parent / "networks" / "x", *options
    )
    assert result.exit_code == 2, result.stdout + str(result.exception)
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.stderr
    assert not list(config.parent.glob("*/x/*"))
    return result.stderr


def test_files_are_found_wherever_they_are(net, tmp_path):
    """Upwards, in folders with spaces and letters of all kinds."""
    below = tmp_path / "stra\u00dfe 1" / "deep"
    below.mkdir(parents=True)
    (tmp_path / "n\u00e9t 1.net.xml").write_bytes(net.read_bytes())
    (below.parent / "c.rou.xml").write_text(f"<routes>{FLOW}</routes>")
    config = below / "\u57ce.sumocfg"
    config.write_text(
        '<configuration><net-file value="../../n\u00e9t 1.net.xml"/>'
        '<route-files v="../c.rou.xml"/></configuration>'
    )
    out = tmp_path / "networks" / 'd\'"x" \\ y'
    scenario = imported(config, out=out)[1]
    assert scenario.name == out.name
    assert scenario.demand.sum() * scenario.step == pytest.approx(60)


def test_files_are_found_by_the_environment(net, tmp_path, monkeypatch):
    """As SUMO replaces ${NAME}: a whole path or a part, in lists too; an unknown one is empty."""
    below = tmp_path / "a b"
    below.mkdir()
    (below / "c.rou.xml").write_text(f"<routes>{FLOW}</routes>")
    (tmp_path / "d.rou.xml").write_text("<routes></routes>")
    (tmp_path / "e.add.xml").write_text("<additional/>")
    monkeypatch.setenv("CITY", str(tmp_path))
    monkeypatch.setenv("UP", "..")
    monkeypatch.setenv("STEP", "0.5")
    monkeypatch.delenv("NONE", raising=False)
    config = below / "c.sumocfg"
    config.write_text(
        f'<configuration><net-file value="{net.parent}/${{NONE}}{net.name}"/>'
        '<route-files value="${CITY}/d.rou.xml, c.rou.xml"/>'
        '<additional-files value="${UP}/e.add.xml,${CITY}/e.add.xml"/>'
        '<step-length value="${STEP}"/></configuration>'
    )
    case = read_sumo_input(config)
    assert [path.resolve() for path in (case.net, *case.routes)] == [
        net,
        tmp_path / "d.rou.xml",
        below / "c.rou.xml",
    ]
    assert [path.resolve() for path in case.additional] == [tmp_path / "e.add.xml"] * 2
    assert case.step_length == 0.5


def test_options_that_every_run_sets_itself_are_told(city):
    """A device that writes is not taken over, but SUMO draws who would have it."""
    config = city(
        options='<tripinfo-output value="t.xml"/><seed value="7"/><threads value="2"/>'
        '<device.fcd.probability value="0.5"/><device.rerouting.probability value="0.3"/>'
        '<weight-files value="w.xml"/>'
    )
    case = read_sumo_input(config)
    assert case.ignored == ("device.fcd.probability", "seed", "threads", "tripinfo-output")
    assert case.options == {"collision.action": "teleport", "device.rerouting.probability": "0"}
    assert case.reading == {
        "device.fcd.probability": "1e-12",
        "device.rerouting.probability": "0.3",
    }
    assert [*case.left_out] == ["weight-files"]


@pytest.mark.parametrize(
    "option, remedy",
    [
        ("tripinfo-output", "cosim.run(..., tripinfo=FILE) keeps SUMO's trips"),
        ("tripinfo-output.write-unfinished", "omit it"),
        ("begin", "give sumo.begin"),
        ("seed", "give the seed of a run"),
    ],
)
def test_options_of_a_scenario_that_every_run_sets_itself_are_refused(project, option, remedy):
    toml = project / "scenarios" / "tiny" / "scenario.toml"
    text = toml.read_text()
    table = "[sumo.options]              # of SUMO, as the city has them\n"
    assert table in text
    toml.write_text(text.replace(table, f'{table}"{option}" = "1"\n'))
    try:
        with pytest.raises(InputError, match="options: .* is set by every run itself") as raised:
            settings(load_scenario(toml.parent))
    finally:
        toml.write_text(text)
    assert remedy in str(raised.value)


MADE = """<route id="more" edges="B2C2 C2D2"/>
<calibrator id="c" edge="B2C2" pos="0" freq="60">
<flow begin="0" end="600" route="more" vehsPerHour="4000" speed="15"/></calibrator>"""
PERSONS = "".join(
    f'<person id="p{n}" depart="{n}"><personTrip from="A2B2" to="C2C3" modes="car"/></person>'
    for n in range(5)
)


@pytest.mark.slow
def test_private_trips_are_those_of_the_demand(city):
    """Vehicles that calibrators and persons make are none, whether they drive or not."""
    bus = '<vehicle id="b" line="1" depart="1"><route edges="A1B1 B1C1"/></vehicle>'
    text, scenario = imported(city(FLOW + bus + PERSONS, MADE, '<end value="600"/>'))
    assert "60 vehicles in" in text
    run = cosim_run(scenario, "no-control", seed=0)
    assert run.trips == 60
    assert run.removed_veh == run.removed_waiting_veh == run.given_up.sum() == 0
    assert run.completed_veh == run.completed[-1] == run.private_arrivals.sum() == 60
    assert run.public_transport_trips == 1
    assert run.other_trips > 100
    assert run.arrivals.sum() > 160


@pytest.mark.parametrize(
    "options, expected",
    [
        ('<begin value="-10"/>', "c.sumocfg: expected 0 s <= begin < end, got begin -10 s"),
        (
            '<begin value="600"/><end value="300"/>',
            "c.sumocfg: expected 0 s <= begin < end, got begin 600 s, end 300",
        ),
        ('<time-to-teleport value="abc"/>', "c.sumocfg: time-to-teleport: expected seconds"),
        ('<step-length value="abc"/>', "c.sumocfg: step-length: expected seconds"),
    ],
)
def test_options_that_are_wrong(city, options, expected):
    assert expected in refused(city(options=options))


@pytest.mark.parametrize("name", [".", "..", "networks/a,b"])
def test_folders_that_can_have_no_city(city, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    result = cosim("import", city(), "--regions 2 --out", name)
    assert result.exit_code == 2
    assert "--out: expected a folder such as networks/mycity" in result.stderr
    assert not list(tmp_path.rglob("*.toml"))


def test_steps_and_teleports_of_the_city(city):
    """Any negative time means never; steps that do not fit are not simulated before either, and
    that is said."""
    text, scenario = imported(
        city(options='<time-to-teleport value="-10"/><step-length value="2"/>')
    )
    assert settings(scenario).time_to_teleport == -1.0
    assert settings(scenario).step_length == 1.0
    assert "not taken over from c.sumocfg: step-length = 2, not 1" in text
    assert " 0 teleports" in text


def test_an_id_twice(city):
    line = refused(city(FLOW + '<trip id="f.3" depart="5" from="A1B1" to="C1D1"/>'))
    assert "c.sumocfg: vehicle f.3: another one has this id" in line


def test_copies_of_vehicles_get_ids_of_their_own(tmp_path):
    (tmp_path / "a.rou.xml").write_text(
        "<routes>"
        + "".join(
            f'<trip id="{name}" depart="1" from="a" to="b"/>' for name in ("0", "0.1", "0.1.1", "1")
        )
        + "</routes>"
    )
    drawn = draw(
        read_recorded_trips([tmp_path / "a.rou.xml"]), seed=0, factor=3.0, jitter=0.0, begin=0.0
    )
    names = [name for _, _, name in drawn]
    assert len(names) == len(set(names)) == 12
    assert {
        "0",
        "0.1",
        "0.1.1",
        "1",
        "1.1",
        "1.2",
        "0.2",
    } <= set(names)


def test_cars_for_streets_that_are_closed_to_them(net, city, tmp_path):
    """SUMO would keep them waiting for ever: they are left out, with a word; lorries that may go
    there are not."""
    text = re.sub(r'(<lane id="C1D1_\d" index="\d") ', r'\1 allow="bus truck" ', net.read_text())
    (tmp_path / "closed.net.xml").write_text(text)
    said, scenario = imported(
        city(
            FLOW + '<vType id="lorry" vClass="truck"/>'
            '<trip id="lorry" type="lorry" depart="9" from="A1B1" to="C1D1"/>'
            '<vehicle id="over" depart="10"><route edges="B1C1 C1D1 D1D2"/></vehicle>'
            '<trip id="car" depart="12" from="A1B1" to="D1D2"/>',
            net_file="closed.net.xml",
        )
    )
    assert "2 vehicles in" in said
    assert "without a route that SUMO could drive, left out: 61" in said
    due, departed, *_, backlog = driven(scenario, 2, 0.4)
    assert due == departed == 2
    assert backlog == 0


def test_what_else_changes_routes_and_vehicles(city, tmp_path, monkeypatch):
    """Rerouters with other routes, closed streets and calibrators: SUMO runs them, the ledger is
    exact; vehicles that SUMO gives up are told; nothing is written where the user is."""
    monkeypatch.chdir(tmp_path)
    config = city(
        FLOW + '<trip id="shut" depart="100" from="C2D2" to="D1D0"/>'
        '<trip id="begins" depart="begin" from="A1B1" to="D1D0">'
        '<param key="has.ssm.device" value="true"/></trip>',
        '<routeProbe id="probe" edge="A1B1" freq="60" file="probe.xml"/>'
        '<route id="other" edges="B1C1 C1C2"/><route id="more" edges="B2C2 C2D2"/>'
        '<rerouter id="r" edges="B1C1"><interval begin="0" end="600">'
        '<routeProbReroute id="other" probability="1"/></interval></rerouter>'
        '<rerouter id="s" edges="C2D2"><interval begin="0" end="600">'
        '<closingReroute id="C2D2" disallow="passenger"/></interval></rerouter>'
        '<calibrator id="c" edge="B2C2" pos="0" output="calibrator.xml" routeProbe="probe" '
        'freq="60"><flow begin="0" end="600" route="more" vehsPerHour="600"/></calibrator>',
    )
    text, scenario = imported(config)
    assert " 1 without a route or a free lane" in text
    assert {element.get("id") for element in tiny_city.traffic_of(config).vehicles} >= {
        "begins",
        "shut",
    }
    _, departed, arrived, inside, _ = driven(scenario, 5, 0.4, rerouting=0.5)
    assert departed - arrived == inside
    assert departed > 40
    assert {path.name for path in tmp_path.iterdir()} == {
        "c.rou.xml",
        "c.add.xml",
        "c.sumocfg",
        "networks",
        "scenarios",
    }


def test_signals_that_cannot_be_controlled(net, city, tmp_path):
    """Off, or without any programme, as railway crossings are: no gateway counts as controlled by
    them."""
    config = city(additional='<tlLogic id="B1" programID="off" type="static" offset="0"/>')
    case = read_sumo_input(config)
    switched = read_files(case.net, case.additional).timetabled
    found = left_alone(read_streets(case.net, case.additional), switched)
    assert found == {"B1": "switched off"}
    text = re.sub(r'<tlLogic id="C2".*?</tlLogic>', "", net.read_text(), flags=re.DOTALL)
    (tmp_path / "other.net.xml").write_text(text)
    found = left_alone(read_streets(tmp_path / "other.net.xml"))
    assert found == {"C2": "no programme"}


def test_phases_that_do_not_follow_in_order(net, city):
    """Perimeter control would play them one after the other: it leaves such signals alone, in table
    and run."""
    text = re.sub(r'(<phase duration="\d+")', r'\1 next="0 1"', net.read_text())
    branching = net.with_name("branching.net.xml")
    branching.write_text(text)
    said, scenario = imported(city(net_file=branching))
    assert "no gateway has a signal that perimeter control can use" in said
    assert "branching signal" in (scenario.network.folder / "gateways.csv").read_text()
    with tiny_city.played(scenario, 0, 0.4) as (plant, _, _):
        assert len(plant.actuation.leaks()) == len(plant.city.gateways) > 0


def test_cycles_shorter_than_half_a_second(net, city, tmp_path):
    """Of a network that somebody made for something else: control intervals are the usual 90 s."""
    (tmp_path / "fast.net.xml").write_text(
        re.sub(r'(<phase duration=")\d+', r"\g<1>0.05", net.read_text())
    )
    _, scenario = imported(city(net_file="fast.net.xml"), mesoscopic=True)
    assert scenario.step == 90.0


def along_roads(folder, nodes, edges, first, last):
    """Import a network of these elements with trips from the first to the last; return the report
    and the scenario."""
    (folder / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "e.edg.xml").write_text(f"<edges>{edges}</edges>")
    net = folder / "road.net.xml"
    tiny_city.run("netconvert", "-n", folder / "n.nod.xml", "-e", folder / "e.edg.xml", "-o", net)
    flow = FLOW.replace("A1B1", first).replace("C1D1", last)
    (folder / "r.rou.xml").write_text(f"<routes>{flow}</routes>")
    return imported(net, routes=[folder / "r.rou.xml"])


def test_a_city_along_a_straight_road(tmp_path):
    """It has no width."""
    nodes = "".join(f'<node id="{n}" x="{200 * n}" y="0" type="traffic_light"/>' for n in range(9))
    edges = "".join(
        f'<edge id="f{n}" from="{n}" to="{n + 1}"/><edge id="b{n}" from="{n + 1}" to="{n}"/>'
        for n in range(8)
    )
    text, scenario = along_roads(tmp_path, nodes, edges, "f0", "f7")
    assert "regions instead of" not in text
    assert scenario.network.adjacency.sum() == 2
    sizes = np.bincount(
        np.loadtxt(
            tmp_path / "networks" / "x" / "regions.csv",
            dtype=int,
            delimiter=",",
            skiprows=1,
            usecols=1,
        )
    )
    assert sizes.min() >= 4


def test_parts_without_a_connection_and_small_regions_are_told(tmp_path):
    """As of a map that is cut at its edge, or of islands."""
    nodes, edges = [], []
    for part, (count, y) in enumerate(((9, 0), (4, 5000))):
        for n in range(count):
            nodes.append(f'<node id="{part}.{n}" x="{200 * n}" y="{y}" type="traffic_light"/>')
        for n in range(count - 1):
            one, other = f"{part}.{n}", f"{part}.{n + 1}"
            edges.append(f'<edge id="f{one}" from="{one}" to="{other}"/>')
            edges.append(f'<edge id="b{one}" from="{other}" to="{one}"/>')
    text, scenario = along_roads(tmp_path, "".join(nodes), "".join(edges), "f0.0", "f0.7")
    assert "the streets fall into 2 parts without a connection; 27" in text
    assert scenario.network.regions == 2
    for region in range(2):
        assert re.search(rf"region {region} \w+ has [12]\.\d lane-kilometres, too few for", text)


def test_own_regions_from_a_spreadsheet_and_in_pieces(net, city, tmp_path):
    """A mark at the beginning and empty lines do not matter; a region in pieces stays, and is
    told."""
    config, edges = city(), read_streets(net).edges
    rows = [f"{edge},{int(edge[0] in 'CD')}" for edge in edges]
    csv = tmp_path / "own.csv"
    csv.write_bytes("\r\n".join(["\ufeffedge,region", *rows, "", ""]).encode())
    text, scenario = imported(config, regions=csv)
    assert "are in other regions" not in text
    assert scenario.network.regions == 2
    apart = {"A0A1", "A1A2", "D2D3"}
    csv.write_text("\n".join(["edge,region", *(f"{edge},{int(edge in apart)}" for edge in edges)]))
    text, scenario = imported(config, regions=csv)
    assert re.search("region 1 .* is in 2 pieces, as in your own table", text), text
    assert "are in other regions" not in text


def test_sumos_own_words_in_one_line(city, capfd):
    """SUMO's message about the input is in the error, and nothing else is printed."""
    phases = '<phase duration="30" state="Gr"/><phase duration="30" state="rG"/>'
    extra = f'<tlLogic id="none" type="static" programID="1">{phases}</tlLogic>'
    with pytest.raises(InputError, match="sumo cannot run it: .* plan loaded for tls 'none'"):
        imported(city(additional=extra))
    _, scenario = imported(city())
    (scenario.folder / "broken.add.xml").write_text(f"<additional>{extra}</additional>")
    toml = scenario.folder / "scenario.toml"
    toml.write_text(
        toml.read_text().replace("[sumo]\n", '[sumo]\nadditional = ["broken.add.xml"]\n')
    )
    capfd.readouterr()
    with pytest.raises(InputError, match="SUMO cannot run it .* plan loaded for tls 'none'"):
        driven(load_scenario(scenario.folder), 1, 0.4)
    assert capfd.readouterr().err == ""


def test_speeds_and_coordinates(city):
    """A fixed speed is deadly before a signal under control; trips between coordinates are
    driven."""
    traffic = tiny_city.traffic_of(
        city(
            '<trip id="a" depart="1" from="A1B1" to="C1D1" departSpeed="13.9"/>'
            '<trip id="b" depart="1" fromXY="1,1" toXY="9,9"/>'
            '<trip id="c" depart="1" from="A1B1" to="C1D1" departSpeed="random"/>'
        )
    )
    assert [vehicle.get("departSpeed") for vehicle in traffic.vehicles] == ["max", None, "random"]
    assert traffic.notes == {"fixed speeds at the departure, made the highest safe ones": 1}


@pytest.mark.slow
def test_a_generated_peak_beside_types_of_the_city(city):
    config = city("", '<vType id="car" vClass="passenger" sigma="0.9"/>')
    text, _ = imported(config, demand="peak", level=0.1, iterations=1, mesoscopic=True)
    assert "trips of a generated morning peak" in text
