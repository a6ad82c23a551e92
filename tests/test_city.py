"""The city grid7: cut into regions, signalised; and the one-line errors of its files."""

import re
import runpy
import shutil
import tomllib
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import pytest
from commands import problem
from copies import ROOT

from cosim.sumo.net import check_adjacency, city_files, load_city
from nmfd.errors import InputError
from nmfd.model.regional_model import load_network

GRID7 = ROOT / "networks" / "grid7"


@pytest.mark.parametrize("name", ["demo", "grid7"])
def test_the_recipe_makes_the_shipped_network(name):
    folder = GRID7.parent / name
    table = tomllib.loads((folder / "city.toml").read_text(encoding="utf-8"))
    net, regions = runpy.run_path(str(GRID7.parent / "build_grid.py"))["build"](table, name)
    assert net == (folder / "city.net.xml").read_bytes()
    assert regions == (folder / "regions.csv").read_bytes()


@pytest.fixture(scope="module")
def files():
    return city_files(load_network(GRID7))


@pytest.fixture(scope="module")
def city(files):
    return load_city(*files, 7)


def test_gateways_join_the_adjacent_regions(city):
    network = load_network(GRID7)
    check_adjacency(city, network)
    hexagon = load_network(GRID7.parent / "hexagon7")
    assert (network.adjacency == hexagon.adjacency).all()
    apart = network.adjacency.copy()
    apart[0, 1] = apart[1, 0] = False
    with pytest.raises(InputError, match=r"regions\[0\].adjacent: region 1 is missing"):
        check_adjacency(city, replace(network, adjacency=apart))
    apart[0, 1] = apart[1, 0] = apart[0, 6] = apart[6, 0] = True
    with pytest.raises(InputError, match=r"regions\[0\].adjacent: lists 6, but no edge leads"):
        check_adjacency(city, replace(network, adjacency=apart))


def test_gateway_links_are_those_of_their_movement(files, city):
    root = ElementTree.parse(files.net_file).getroot()
    links = root.iterfind("connection[@tl]")
    movement = {(c.get("tl"), int(c.get("linkIndex"))): (c.get("from"), c.get("to")) for c in links}
    for gateway in city.gateways:
        assert city.region_of[gateway.from_edge] == gateway.source != gateway.target
        assert city.region_of[gateway.to_edge] == gateway.target
        assert gateway.signal
        assert gateway.links
        for link in gateway.links:
            assert movement[gateway.signal, link] == (gateway.from_edge, gateway.to_edge)


def test_lanes_into_the_centre_lead_only_there(city):
    for gateway in city.gateways:
        if gateway.target == 3:
            assert {city.region_of[edge] for edge in city.successors[gateway.from_edge]} == {3}
            assert city.length[gateway.from_edge] > 200.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("edge,region", "edge;region"), "line 1: expected edge,region"),
        (lambda text: text + "nowhere,3\n", "edge nowhere is not in"),
        (
            lambda text: text.replace("c00-c01,3\n", ""),
            r"edge c00-c01 has no region \(1 such edges\)",
        ),
        (
            lambda text: text.replace("c00-c01,3", "c00-c01,7"),
            "an edge and a region from 0 to 6, got c00-c01,7",
        ),
        (lambda text: text + "c00-c01,3\n", "edge c00-c01 appears twice"),
        (lambda text: re.sub(r",6\n", ",5\n", text), "region 6 has no edges"),
    ],
)
def test_wrong_regions_give_one_line(files, tmp_path, change, message):
    table = tmp_path / "regions.csv"
    table.write_text(change(files.regions_csv.read_text()))
    assert re.search(message, problem(load_city, files.net_file, table, 7))


def test_missing_and_broken_nets_give_one_line(files, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_city(tmp_path / "none.net.xml", files.regions_csv, 7)
    broken = tmp_path / "broken.net.xml"
    broken.write_text("<net><edge")
    with pytest.raises(InputError, match="is not a SUMO network"):
        load_city(broken, files.regions_csv, 7)


def test_wrong_tables_of_a_city_give_one_line(tmp_path):
    shutil.copy(GRID7 / "network.toml", tmp_path)
    with pytest.raises(InputError, match="sumo.net: no such file"):
        city_files(load_network(tmp_path))
    text = (tmp_path / "network.toml").read_text()
    (tmp_path / "network.toml").write_text(text.replace('regions = "regions.csv"\n', ""))
    with pytest.raises(InputError, match="sumo.regions: missing"):
        city_files(load_network(tmp_path))
    with pytest.raises(InputError, match="no city to simulate"):
        city_files(load_network(GRID7.parent / "hexagon7"))
