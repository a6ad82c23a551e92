"""The city grid7: built from its recipe, cut into regions, signalised; and the one-line errors of its files."""

import re
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import pytest

from cosim.sumo.build import build, ensure_built, read_recipe
from cosim.sumo.net import check_adjacency, load_city
from nmfd.errors import InputError
from nmfd.model.regional_model import load_network

GRID7 = Path(__file__).parents[1] / "networks" / "grid7"


@pytest.fixture(scope="module")
def files():
    return ensure_built(load_network(GRID7))


@pytest.fixture(scope="module")
def city(files):
    return load_city(files.net_file, files.regions_csv, 7)


def test_same_recipe_same_bytes(files):
    recipe = read_recipe(GRID7 / "city.toml", 7)
    assert build(recipe, "city.toml") == (files.net_file.read_bytes(), files.regions_csv.read_bytes())


def test_a_changed_recipe_is_built_again(tmp_path):
    shutil.copytree(GRID7, tmp_path / "grid7", ignore=shutil.ignore_patterns("build"))
    network = load_network(tmp_path / "grid7")
    files = ensure_built(network)
    before = files.net_file.stat().st_mtime_ns
    ensure_built(network)
    assert files.net_file.stat().st_mtime_ns == before
    recipe = tmp_path / "grid7" / "city.toml"
    recipe.write_text(recipe.read_text().replace("cycle = 90", "cycle = 80"))
    ensure_built(network)
    assert files.net_file.stat().st_mtime_ns > before
    assert [path.name for path in files.net_file.parent.glob(".*")] == []


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
        assert gateway.signal and gateway.links
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
        (lambda text: text.replace("c00-c01,3\n", ""), r"edge c00-c01 has no region \(1 such edges\)"),
        (lambda text: text.replace("c00-c01,3", "c00-c01,7"), "an edge and a region from 0 to 6, got c00-c01,7"),
        (lambda text: text + "c00-c01,3\n", "edge c00-c01 appears twice"),
        (lambda text: re.sub(r",6\n", ",5\n", text), "region 6 has no edges"),
    ],
)
def test_wrong_regions_give_one_line(files, tmp_path, change, message):
    table = tmp_path / "regions.csv"
    table.write_text(change(files.regions_csv.read_text()))
    with pytest.raises(InputError, match=message) as caught:
        load_city(files.net_file, table, 7)
    assert "\n" not in str(caught.value)


def test_missing_and_broken_nets_give_one_line(files, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_city(tmp_path / "none.net.xml", files.regions_csv, 7)
    broken = tmp_path / "broken.net.xml"
    broken.write_text("<net><edge")
    with pytest.raises(InputError, match="is not a SUMO network"):
        load_city(broken, files.regions_csv, 7)


def test_wrong_recipes_give_one_line(tmp_path):
    shutil.copytree(GRID7, tmp_path / "grid7", ignore=shutil.ignore_patterns("build"))
    path = tmp_path / "grid7" / "city.toml"
    good = path.read_text()
    for old, new, message in (
        ("speed =", "sped =", "centre.sped: unknown key; did you mean speed"),
        ("0 0 0 0 0 1 1 1 1", "0 0 0 0 0 1 1 1 9", r"expected a region from 0 to 6 .* got '9'"),
        ("cycle = 90", "cycle = 90\nwrong = 1", "signals.wrong: unknown key"),
    ):
        path.write_text(good.replace(old, new, 1))
        with pytest.raises(InputError, match=message):
            ensure_built(load_network(tmp_path / "grid7"))
    network_file = tmp_path / "grid7" / "network.toml"
    network_file.write_text(network_file.read_text().replace('recipe = "city.toml"', 'net = "a.net.xml"'))
    with pytest.raises(InputError, match="sumo.regions: missing"):
        ensure_built(load_network(tmp_path / "grid7"))
    with pytest.raises(InputError, match="no city to simulate"):
        ensure_built(load_network(GRID7.parent / "hexagon7"))
