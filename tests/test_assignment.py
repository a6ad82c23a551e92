"""A generated peak: its routes are assigned, and its level is one of a congested network, not of a
few full streets."""

import re
from itertools import pairwise
from xml.etree.ElementTree import fromstring

import pytest
import tiny_city

from cosim.importing.assignment import assign
from cosim.importing.streets import read_streets
from cosim.sumo.recorded_trips import read_recorded_trips
from nmfd.api import load_scenario
from nmfd.errors import InputError

NODES = "".join(
    f'<node id="{name}" x="{x}" y="{y}"/>'
    for name, x, y in (
        ("a", 0, 0),
        ("b", 200, 0),
        ("c", 700, 200),
        ("m", 700, 0),
        ("d", 1200, 0),
        ("e", 1400, 0),
    )
)
# From b to d: straight on, where two lanes become one at m, or 1.08 times as long over c.
EDGES = "".join(
    f'<edge id="{name}" from="{name[0]}" to="{name[1]}" numLanes="{lanes}" speed="{speed}"/>'
    for name, lanes, speed in (
        ("ab", 3, 20),
        ("bm", 2, 13),
        ("md", 1, 13),
        ("bc", 2, 13),
        ("cd", 2, 13),
        ("de", 3, 20),
    )
)


@pytest.fixture(scope="module")
def fork(tmp_path_factory):
    """(network, 600 vehicles in ten minutes that all go straight on)"""
    folder = tmp_path_factory.mktemp("fork")
    (folder / "n.xml").write_text(f"<nodes>{NODES}</nodes>")
    (folder / "e.xml").write_text(f"<edges>{EDGES}</edges>")
    net = folder / "fork.net.xml"
    tiny_city.run(
        "netconvert", "-n", folder / "n.xml", "-e", folder / "e.xml", "-o", net, "--no-turnarounds"
    )
    vehicle = (
        '<vehicle id="v{0}" type="car" depart="{0}.00" departLane="best">'
        '<route edges="ab bm md de"/></vehicle>'
    )
    return net, [
        fromstring('<vType id="car"/>'),
        *(fromstring(vehicle.format(n)) for n in range(600)),
    ]


@pytest.mark.slow
def test_routes_spread_until_nobody_gains(fork):
    """The fork: the gap falls to what was asked for, in both of SUMO's models; the seed tells
    all."""
    net, vehicles = fork
    stages = []
    options = {"begin": 0.0, "end": 1800.0, "seed": 3, "iterations": 2}
    found = assign(
        net, vehicles, **options, mesoscopic=False, progress=lambda stage, _: stages.append(stage)
    )
    ways = {tuple(route) for route in found.routes.values()}
    assert ways == {("ab", "bm", "md", "de"), ("ab", "bc", "cd", "de")}
    assert len(found.routes) == 600
    queue, followed = found.gaps[:-1], found.gaps[-1]
    assert queue[0] > 0.5
    assert queue[-1] < 0.05
    assert found.best == len(queue)
    assert len(stages) == len(found.gaps)
    assert stages[0] == "assignment, at most 2 iterations"
    assert "car-following" in stages[-1]
    assert 0.0 <= followed < 0.5
    assert assign(net, vehicles, **options).gaps == queue


def test_an_assignment_that_sumo_refuses(fork):
    net, vehicles = fork
    broken = [
        vehicles[0],
        fromstring('<vehicle id="v" type="none" depart="0"><route edges="ab bm md de"/></vehicle>'),
    ]
    with pytest.raises(InputError, match="duaIterate.py cannot assign routes: Error: .*none"):
        assign(net, broken, begin=0.0, end=600.0, seed=0, iterations=1)


@pytest.mark.slow
def test_an_import_assigns_its_peak(tmp_path):
    """The gap is in the report, the routes in the scenario."""
    net = tiny_city.network(tmp_path, "--tls.set B1,C2", name="tiny.net.xml")
    folder = tiny_city.imported(tmp_path, 2, net, demand="peak", mesoscopic=True, iterations=1)
    scenario, text = (
        load_scenario(folder),
        (tmp_path / "networks" / "tiny" / "import.txt").read_text(),
    )
    assert scenario.demand_factor == 1.0
    assert re.search(r"relative gap [\d.]+ % in iteration 1 of 1", text)
    gap = float(re.search(r"([\d.]+) % in iteration", text)[1])
    assert ("WARNING: a relative gap above 5 %" in text) == (gap > 5.0)
    streets = read_streets(net)
    links = set(map(tuple, streets.links))
    for vehicle in read_recorded_trips([scenario.folder / "vehicles.rou.xml.gz"]).elements:
        route = [streets.number[edge] for edge in vehicle.find("route").get("edges").split()]
        assert links.issuperset(pairwise(route))
