"""cosim import: from a sumocfg to a network and a scenario that run, on a small city of
everything."""

import csv
import gzip
import re
import shutil
import xml.etree.ElementTree as ElementTree

import numpy as np
import pandas as pd
import pytest
import tiny_city
from commands import cosim, error_line, good

from cosim.evaluation.identify import identify
from cosim.importing.case import read_sumo_input
from cosim.importing.demand import read_traffic
from cosim.importing.streets import graph, read_streets
from cosim.plant.plant import SumoPlant
from cosim.plant.settings import settings
from cosim.plant.strategy import parse
from cosim.sumo.net import load_city
from cosim.sumo.recorded_trips import own_flows, read_recorded_trips, read_routes
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model.regional_model import load_network
from nmfd.model.scenario import with_demand

IMPORT = "import --regions 3 --seeds 1"


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return tiny_city.city(tmp_path_factory.mktemp("city"))


@pytest.fixture(scope="module")
def imported(config, tmp_path_factory):
    """(project folder, what the import printed)."""
    project = tmp_path_factory.mktemp("project")
    text = good(cosim(IMPORT, config, "--out", project / "networks" / "tiny"))
    shutil.copytree(
        project, project.with_name("as-imported")
    )  # runs build something in the other one
    return project, text


@pytest.fixture
def scenario(imported):
    return load_scenario(imported[0] / "scenarios" / "tiny")


def test_traffic_keeps_cars_and_leaves_the_rest_alone(config):
    case = read_sumo_input(config)
    assert case.begin == 600.0
    assert case.end == 1500.0
    traffic = tiny_city.traffic_of(config)
    ids = [vehicle.get("id") for vehicle in traffic.vehicles]
    assert len(set(ids)) == len(ids)
    assert {"round", "stops", "short"} <= set(ids)
    assert not {"early", "astray", "gap", "bus"} & set(ids)
    assert sum(name.startswith("zones.") for name in ids) == 30
    assert sum(name.startswith("across.") for name in ids) == 75
    assert sum(name.startswith("back.") for name in ids) == 60
    assert 30 <= sum(name.startswith("chance.") for name in ids) <= 90
    assert 30 <= sum(name.startswith("down.") for name in ids) <= 90
    assert (np.diff(traffic.depart) >= 0).all()
    assert traffic.depart.min() >= 600.0
    assert [element.get("id") for element in traffic.background] == [
        "line2.0",
        "bus",
        "walker",
        "line2.1",
        "line2.2",
    ]
    assert "edgeData" not in [element.tag for element in traffic.shared]
    detector = next(element for element in traffic.shared if element.tag == "inductionLoop")
    assert detector.get("file") == "NUL"  # a run writes nothing into the user's folders


def test_import_gives_every_edge_one_region_and_connected_regions(imported):
    project, _ = imported
    network = project / "networks" / "tiny"
    assert (network / "map.png").stat().st_size > 10_000
    streets = read_streets(network / "city.net.xml.gz")
    with (network / "regions.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["edge"] for row in rows] == list(streets.edges)
    region = np.array([int(row["region"]) for row in rows])
    assert set(region) == {0, 1, 2}
    from scipy.sparse.csgraph import connected_components

    inside = streets.links[region[streets.links[:, 0]] == region[streets.links[:, 1]]]
    assert connected_components(graph(inside, len(region)), directed=False)[0] == 3
    city = load_city(network / "city.net.xml.gz", network / "regions.csv", 3)
    with gzip.open(network / "city.net.xml.gz") as stream:
        internal = [
            e.get("id")
            for e in ElementTree.parse(stream).iter("edge")
            if e.get("function") == "internal"
        ]
    assert set(internal) <= set(city.region_of)


def test_gateways_and_quality_add_up(imported):
    network = imported[0] / "networks" / "tiny"
    gateways, quality = pd.read_csv(network / "gateways.csv"), pd.read_csv(network / "quality.csv")
    regions = dict(pd.read_csv(network / "regions.csv").itertuples(index=False))
    assert all(
        regions[g.from_edge] == g.source and regions[g.to_edge] == g.target
        for g in gateways.itertuples()
    )
    streets = read_streets(network / "city.net.xml.gz")
    crossing = {
        (streets.edges[a], streets.edges[b])
        for a, b in streets.links
        if regions[streets.edges[a]] != regions[streets.edges[b]]
    }
    assert crossing == set(zip(gateways.from_edge, gateways.to_edge, strict=True))
    assert set(gateways.control) <= {"controlled", "no signal"}
    assert (gateways.control == "controlled").any()
    whole = quality.iloc[-1]
    free = gateways.flow_veh[gateways.control != "controlled"].sum() / gateways.flow_veh.sum()
    assert whole.uncontrolled_share == pytest.approx(free, abs=1e-3)
    answer = (network / "verdict.txt").read_text().splitlines()[0]
    assert answer.startswith("Can perimeter control help? Cannot say yet: the")
    assert answer in imported[1]
    assert "cosim identify scenarios/tiny" in imported[1]
    assert "times its free-flow time" in imported[1]
    shares = load_network(network).controllable
    assert (shares > 0).any()
    assert ((shares >= 0) & (shares <= 1)).all()
    assert load_network(network).placeholder
    assert quality.lane_km[:-1].sum() == pytest.approx(whole.lane_km, abs=0.02)


def test_import_is_deterministic_and_atomic(imported, config, tmp_path):
    project = imported[0].with_name("as-imported")
    command = (IMPORT, config, "--out", tmp_path / "networks" / "tiny")
    good(cosim(*command))
    for folder in ("networks", "scenarios"):
        here, there = (sorted((root / folder).rglob("*")) for root in (project, tmp_path))
        assert [file.name for file in here] == [file.name for file in there]
        for one, other in zip(here, there, strict=True):
            assert one.is_dir() or one.read_bytes() == other.read_bytes(), one.name
    assert "exists; choose another name" in error_line(cosim(*command))


def test_scenario_drives_the_original_vehicles(scenario, config):
    traffic = tiny_city.traffic_of(config)
    assert scenario.demand.sum() * scenario.step == pytest.approx(len(traffic.vehicles), rel=1e-4)
    assert settings(scenario).begin == 600.0
    assert settings(scenario).ways_return
    with tiny_city.played(scenario, 10, 0.9, scenario.network.nominal_splits) as (
        plant,
        measurement,
        record,
    ):
        due = len(plant.meter.trips())
        # every car, and the buses: one, and one per 200 s in ten minutes
        assert due == (traffic.depart < 600.0 + 10 * scenario.step - 10).sum() + 1 + 3
        assert record.departures.sum() == due - measurement.backlog.sum()
        assert record.arrivals.sum() + measurement.accumulation.sum() == record.departures.sum()
        free = plant.session.is_free
        assert not any(
            free(v) for v in plant.session.running() if v.startswith(("line2", "bus", "stops"))
        )
        assert record.guided.sum() > 0


def test_own_regions_come_back(imported, config, tmp_path):
    table = imported[0] / "networks" / "tiny" / "regions.csv"
    again = tiny_city.imported(tmp_path, table, config).parents[1] / "networks" / "tiny"
    assert (again / "regions.csv").read_bytes() == table.read_bytes()


def test_networks_as_they_are(tmp_path):
    """Left-hand traffic; two signals; none at all: a working result."""
    for name, options, expected in (
        ("left", ("--lefthand true --tls.set B1,C2",), "left-hand traffic; 2 signals"),
        ("none", ("--default-junction-type priority",), "no gateway has a signal"),
    ):
        (tmp_path / name).mkdir()
        config = tiny_city.city(tmp_path / name, *options)
        folder = tiny_city.imported(tmp_path / name, 2, config)
        assert expected in (tmp_path / name / "networks" / "tiny" / "import.txt").read_text()
        with tiny_city.played(load_scenario(folder), 3, 0.1) as (_, _, record):
            assert record.departures.sum() > 0


def test_signals_that_are_left_alone(config, tmp_path):
    """A timetable switches one: perimeter control leaves it alone."""
    shutil.copytree(config.parent, tmp_path, dirs_exist_ok=True)
    timetable = (
        '<WAUT id="day" startProg="0" refTime="0"><wautSwitch time="900" to="0"/></WAUT>'
        '<wautJunction wautID="day" junctionID="C2"/></additional>'
    )
    additional = tmp_path / "city.add.xml"
    additional.write_text(additional.read_text().replace("</additional>", timetable))
    scenario = load_scenario(tiny_city.imported(tmp_path, 4, tmp_path / "city.sumocfg"))
    control = (
        pd.read_csv(tmp_path / "networks" / "tiny" / "gateways.csv")
        .set_index("signal")
        .control.to_dict()
    )
    assert control.get("C2", "programme follows a timetable") == "programme follows a timetable"
    assert settings(scenario).leave_signals == ("C2",)


def test_mesoscopic_models_keep_the_ledger_and_differ(scenario):
    crossings = []
    for model in (True, "ltm"):
        with tiny_city.played(scenario, 8, 0.5, mesoscopic=model) as (_, _, record):
            crossings.append(record.crossings)
    classic, ltm = crossings
    assert classic.sum() > 0
    assert ltm.sum() > 0
    assert (classic != ltm).any()


@pytest.mark.parametrize("key, value", [("signals", "max-pressure"), ("measurement", "estimate")])
def test_mesoscopic_has_no_lanes(scenario, key, value):
    with pytest.raises(InputError, match=f"sumo.{key}: {value} .* has no lanes"):
        SumoPlant(scenario, settings=settings(scenario).changed(mesoscopic=True, **{key: value}))


def test_options_and_includes_of_the_user_count(config, tmp_path):
    """SUMO's short form of values, its scale, its mesoscopic model, files in files; all else is
    named."""
    for file in config.parent.glob("*.xml*"):
        shutil.copy(file, tmp_path)
    (tmp_path / "cars.rou.xml").write_text(
        '<routes><include href="more/cars.rou.xml"/><flow id="none" begin="600" '
        'end="900" number="0" from="A0A1" to="D1D2"/></routes>'
    )
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "cars.rou.xml").write_text(
        '<routes><flow id="f" begin="600" end="1200" number="60" from="A1B1" to="C1D1"/></routes>'
    )
    (tmp_path / "city.sumocfg").write_text(
        '<configuration><net-file v="city.net.xml"/><route-files v="cars.rou.xml"/>'
        '<begin v="600"/><scale v="2.5"/><mesosim v="true"/><max-depart-delay value="60"/>'
        '<tripinfo-output value="trips.xml"/></configuration>'
    )
    case = read_sumo_input(tmp_path / "city.sumocfg")
    assert case.reading == {"scale": "2.5"}
    assert case.mesoscopic
    assert case.left_out == {}
    assert case.ignored == ("tripinfo-output",)
    assert case.options["max-depart-delay"] == "60"
    assert case.options["meso-junction-control"] == "false"
    text = good(cosim(IMPORT, tmp_path / "city.sumocfg", "--out", tmp_path / "networks" / "x"))
    assert "150 vehicles in" in text
    assert "that only write files: tripinfo-output" in text
    scenario = load_scenario(tmp_path / "scenarios" / "x")
    assert scenario.demand_factor == 1.0
    assert scenario.demand.sum() * scenario.step == pytest.approx(150.0)
    assert settings(scenario).mesoscopic
    options = ("--routes", tmp_path / "cars.rou.xml", "--out", tmp_path / "networks" / "y")
    good(cosim(IMPORT, tmp_path / "city.net.xml", *options))  # without any sumocfg
    assert load_scenario(
        tmp_path / "scenarios" / "y"
    ).demand.sum() * scenario.step == pytest.approx(60.0)
    (tmp_path / "more" / "cars.rou.xml").write_text(
        '<routes><include href="../cars.rou.xml"/></routes>'
    )
    with pytest.raises(InputError, match="include each other without end"):
        read_traffic(case, read_streets(case.net), seed=0)


def test_signal_plans_know_the_city_s_own_vehicles(scenario):
    """Turning flows are those of its routes, and of fastest ways; every signal plan runs on its
    signals."""
    scenario = with_demand(scenario, steps=2)
    own, additional = (
        [scenario.folder / name for name in names]
        for names in (settings(scenario).routes, settings(scenario).additional)
    )
    files = scenario.network.folder
    city = load_city(files / "city.net.xml.gz", files / "regions.csv", 3)
    flows = own_flows(city, read_recorded_trips(own), read_routes(additional), 2.0)
    assert flows["A1B1", "B1B0"] >= 2.0 / 900.0  # the route that one vehicle names
    assert (
        2.0 * 75 / 900 <= flows["B1C1", "C1D1"] < 2.0 * 120 / 900
    )  # the flow straight on, of trips
    assert all(b in city.successors[a] for a, b in flows)
    for plan in ("max-pressure", "webster", "actuated"):
        with tiny_city.played(scenario, 2, 0.9, signals=plan) as (_, _, record):
            assert record.departures.sum() > 0


@pytest.mark.parametrize(
    "change, expected",
    [
        (lambda folder: (folder / "buses.rou.xml").unlink(), "route-files: no such file"),
        (lambda folder: (folder / "city.net.xml").write_text("<net><edge"), "is not a"),
        (
            lambda folder: (folder / "city.net.xml").write_text("<net></net>"),
            "has no edge that cars may use",
        ),
        (
            lambda folder: (folder / "city.sumocfg").write_text("<routes/>"),
            "a net.xml or a file of OpenStreetMap",
        ),
        (
            lambda folder: (folder / "city.sumocfg").write_text(
                '<configuration><net-file value="city.net.xml"/></configuration>'
            ),
            "or add --routes FILE, --counts FILE or --demand",
        ),
    ],
)
def test_one_clear_line(config, tmp_path, change, expected):
    shutil.copytree(config.parent, tmp_path, dirs_exist_ok=True)
    change(tmp_path)
    command = (IMPORT, tmp_path / "city.sumocfg", "--out", tmp_path / "networks" / "x")
    assert expected in error_line(cosim(*command))
    assert not (tmp_path / "networks").exists() or not list((tmp_path / "networks").iterdir())


def test_import_at_a_demand_level(config, tmp_path):
    """The factor reaches the scenario: vehicles and demand; mesoscopic too."""
    scenario = load_scenario(tiny_city.imported(tmp_path, 2, config, level=1.5, mesoscopic=True))
    assert settings(scenario).mesoscopic
    assert scenario.demand_factor == 1.5
    vehicles = read_recorded_trips([scenario.folder / "vehicles.rou.xml.gz"])
    assert scenario.demand.sum() * scenario.step == pytest.approx(
        1.5 * len(vehicles.depart), rel=1e-4
    )


def test_guidance_leaves_roads_that_are_closed_to_cars_alone(config, tmp_path):
    """Taxis over and to a bus road keep their way; cars in the same city are guided."""
    net = tmp_path / "city.net.xml"
    root = ElementTree.parse(config.parent / "city.net.xml")
    for lane in root.iter("lane"):
        if lane.get("id").startswith("C1D1_"):
            lane.set("allow", "bus taxi")
    root.write(net)
    (tmp_path / "cars.rou.xml").write_text(
        '<routes><vType id="taxi" vClass="taxi"/><route id="over" edges="A1B1 B1C1 C1D1 D1D2"/>'
        '<flow id="over" type="taxi" begin="0" end="600" period="20" route="over"/>'
        '<flow id="to" type="taxi" begin="0" end="600" period="20" from="A0A1" to="C1D1"/>'
        '<flow id="car" begin="0" end="600" period="10" from="A0A1" to="D2D3"/></routes>'
    )
    (tmp_path / "city.sumocfg").write_text(
        '<configuration><net-file value="city.net.xml"/><route-files value="cars.rou.xml"/>'
        "</configuration>"
    )
    scenario = load_scenario(tiny_city.imported(tmp_path, 2, tmp_path / "city.sumocfg"))
    with tiny_city.played(scenario, 6, 0.9, scenario.network.nominal_splits) as (_, _, record):
        assert record.guided.sum() > 10


@pytest.mark.slow
def test_identification_gives_both_models_and_the_import_takes_the_second_away(
    imported, config, tmp_path
):
    """Drivers on their own routes and guided ones; new regions need new models."""
    shutil.copytree(imported[0], tmp_path, dirs_exist_ok=True)
    network, scenario = tmp_path / "networks" / "tiny", tmp_path / "scenarios" / "tiny"
    file = scenario / "scenario.toml"
    file.write_text(re.sub(r"\nsteps = \d+", "\nsteps = 10", file.read_text()))
    text = identify(network, levels=[1, 2], seeds=1, iterations=3, out=tmp_path / "loading")
    assert f"Written to {network / 'guided' / 'network.toml'}" in text
    assert (tmp_path / "loading" / "guided" / "level-2" / "probing-pcrg-1000.nc").is_file()
    loaded = load_scenario(scenario)
    guided = parse("dpc-pcrg").own_planning(loaded).network
    assert guided.hash != loaded.network.hash
    assert "PLACEHOLDERS" not in (network / "network.toml").read_text()
    assert not loaded.network.placeholder
    assert loaded.network.observed_split_ratios
    assert all(mfd.problem() is None for mfd in loaded.network.mfds)
    assert all("one seed" in doubts for doubts in loaded.network.doubts)
    assert text.count("Can perimeter control help?") == 2
    assert (tmp_path / "loading" / "fit.csv").is_file()
    assert loaded.network.controllable is not None
    assert loaded.network.controllable.any()
    shutil.rmtree(network)
    shutil.rmtree(scenario)
    tiny_city.imported(tmp_path, 2, config)
    assert parse("dpc-pcrg").own_planning(load_scenario(scenario)).network.regions == 2


def test_a_part_without_a_name_is_an_error(tmp_path):
    net = tiny_city.network(tmp_path)
    added = tmp_path / "added.add.xml"
    added.write_text("<additional><tlLogic/></additional>")
    with pytest.raises(InputError, match="added.add.xml: tlLogic: id: missing; add"):
        read_streets(net, [added])
    net.write_text(net.read_text().replace('<connection from="', '<connection was="', 1))
    with pytest.raises(InputError, match="not a SUMO network .connection: from: missing"):
        read_streets(net)
