"""Vehicles that leave a queue at a signal, or where they merge: the link model beside SUMO."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import tiny_city
from test_links import CYCLE_S, ONE_LANE, STEP_S, model_of, rollout, triangle

from nmfd.model.links.flows import ACCELERATING, Numbers

RED_S = 43  # with yellow
FIRST, LAST = 10, 70  # cycles that count
STRAIGHT = (600, 0)  # where the next street ends (m)
RIGHT = (0, -600)
NODES = """<nodes><node id="a" x="-900" y="0"/><node id="c" x="0" y="0" type="traffic_light"/>
<node id="b" x="{x}" y="{y}"/></nodes>"""
EDGES = """<edges><edge id="ac" from="a" to="c" speed="{speed}"/>
<edge id="cb" from="c" to="b" speed="{speed}"/></edges>"""
CITY = """<additional><tlLogic id="c" type="static" programID="own" offset="0">
<phase duration="{green}" state="G"/><phase duration="3" state="y"/>
<phase duration="40" state="r"/></tlLogic>
<route id="r" edges="ac cb"/><flow id="f" route="r" begin="0" end="9999" period="1"/>
<edgeData id="e" file="seen.xml" begin="{begin}" end="{end}"/></additional>"""
MERGE = """<nodes><node id="w" x="-500" y="0"/><node id="e" x="500" y="0"/>
<node id="s" x="0" y="-500"/><node id="c" x="0" y="0" type="priority"/>
<node id="f" x="900" y="0"/></nodes>"""
INTO = """<edges><edge id="wc" from="w" to="c" priority="2" speed="{speed}"/>
<edge id="ce" from="c" to="e" priority="2" speed="{speed}"/>
<edge id="ef" from="e" to="f" priority="2" speed="{speed}"/>
<edge id="sc" from="s" to="c" priority="1" speed="{speed}"/></edges>"""
FLOWS = """<additional><route id="m" edges="wc ce"/><route id="r" edges="sc ce"/>
<flow id="m" route="m" begin="0" end="9999" probability="{flow}"/>
<flow id="r" route="r" begin="0" end="9999" period="1"/>
<edgeData id="e" file="seen.xml" begin="600" end="7800"/></additional>"""
BEFORE_RED = MERGE.replace('id="e" x="500"', 'id="e" x="200" type="traffic_light"')
INTO_A_QUEUE = """<additional><tlLogic id="e" type="static" programID="own" offset="0">
<phase duration="{green}" state="G"/><phase duration="3" state="y"/>
<phase duration="{red}" state="r"/></tlLogic>
<route id="m" edges="wc ce ef"/><route id="r" edges="sc ce ef"/>
<flow id="m" route="m" begin="0" end="9999" period="2"/>
<flow id="r" route="r" begin="0" end="9999" period="2"/>
<edgeData id="e" file="seen.xml" begin="1200" end="7800"/></additional>"""
CASES = [
    (13.89, 7, STRAIGHT),
    (13.89, 10, STRAIGHT),
    (13.89, 30, STRAIGHT),
    (8.33, 10, STRAIGHT),
    (13.89, 10, RIGHT),
    (13.89, 40, RIGHT),
    (8.33, 40, RIGHT),
]


@pytest.mark.slow
@pytest.mark.parametrize("speed, green, end", CASES)
def test_a_green_serves_as_many_vehicles_as_in_sumo(tmp_path, speed, green, end):
    expected, on_junction = served_in_sumo(tmp_path, speed, green, end)
    assert served(speed, green, on_junction) == pytest.approx(expected, rel=0.05)


def served_in_sumo(folder, speed, green, end):
    """Vehicles in each green, and their speed on the junction.

    speed: limit (m/s); green: (s); end: place where the next street ends (m)
    """
    cycle = green + RED_S
    begin, stop = FIRST * cycle, LAST * cycle
    about = {"speed": speed, "green": green, "begin": begin, "end": stop, "x": end[0], "y": end[1]}
    left = left_in_sumo(folder, stop, (NODES, EDGES, CITY), about)["ac"]
    over = ElementTree.parse(folder / "net.xml").find(".//edge[@function='internal']/lane")
    return left / (LAST - FIRST), float(over.get("speed"))


def left_in_sumo(folder, stop, texts, about):
    """Vehicles that leave each street; texts: of nodes, edges and traffic, numbers `about`."""
    nodes, edges, traffic, net = (folder / f"{name}.xml" for name in ("n", "e", "add", "net"))
    for path, text in zip((nodes, edges, traffic), texts, strict=True):
        path.write_text(text.format(**about))
    tiny_city.run("netconvert", "-n", nodes, "-e", edges, "-o", net, "--no-turnarounds")
    tiny_city.run("sumo", "-n", net, "-a", traffic, "-e", stop, "--time-to-teleport", -1)
    seen = ElementTree.parse(folder / "seen.xml").iter("edge")
    return {edge.get("id"): float(edge.get("left")) for edge in seen}


def served(speed, green, on_junction):
    """Vehicles in each green of the link model, with SUMO's default ones.

    on_junction: their speed there (m/s)
    """
    cycle = green + RED_S
    network = replace(
        triangle(),
        cell_share=np.array([[1.0, 0.0, 1.0]]),
        cycle=np.array([cycle, 1, 1]),
        begin=np.array([0, cycle, cycle + 1]),
        light=np.concatenate([np.ones(green), np.zeros(RED_S), np.ones(2)]),
        yields=np.concatenate([np.zeros(cycle + 1), np.ones(1)]),
        speed=np.full(3, on_junction),
        limit=np.full(3, speed),
        free_time=np.full(3, 300.0 / speed),
        acceleration=2.6,
        **ONE_LANE,
    )
    states = rollout(model_of(network), 1.0, intervals=48)
    left = float((states[-1].traffic.left - states[8].traffic.left)[0, 0])
    return left * cycle / (40 * STEP_S)


@pytest.mark.parametrize("flow", [0.1, 0.2])
def test_a_queue_merges_by_the_chance_of_a_gap(flow):
    gap = Numbers().gap + 13.89 / (2 * ACCELERATING * 2.6)
    share = merged(13.89, flow) / merged(13.89, 0.0)
    assert share == pytest.approx(np.exp(-gap * flow), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("speed, flow", [(13.89, 0.2), (13.89, 0.3), (8.33, 0.1), (8.33, 0.2)])
def test_a_queue_merges_as_in_sumo(tmp_path, speed, flow):
    """Share of what the same queue serves without a flow to give way to."""
    few, many = (merged_in_sumo(tmp_path, speed, rate) for rate in (flow, 0.001))
    share = merged(speed, flow) / merged(speed, 0.0)
    assert share == pytest.approx(few / many, abs=0.05)


def merged_in_sumo(folder, speed, flow):
    """Vehicles that leave a queue to merge with `flow` (veh/s)."""
    about = {"speed": speed, "flow": flow}
    return left_in_sumo(folder, 7800, (MERGE, INTO, FLOWS), about)["sc"]


def merged(speed, flow):
    """Vehicles that leave the same queue in the link model, from d to b."""
    network = replace(
        triangle(),
        cell_share=np.array([[1.0, 0.0, 1.0]]),
        origin=np.array([[1.0, 0.0, 1.0]]),
        light=np.ones(CYCLE_S + 2),
        speed=np.full(3, speed),
        limit=np.full(3, speed),
        free_time=np.full(3, 300.0 / speed),
        acceleration=2.6,
        **ONE_LANE,
    )
    states = rollout(model_of(network), flow, intervals=24, from_d=1.0)
    return float((states[-1].traffic.left - states[8].traffic.left)[0, 2])


@pytest.mark.slow
@pytest.mark.parametrize("green", [10, 20, 40])
def test_those_who_give_way_into_a_queue_find_room_as_in_sumo(tmp_path, green):
    about = {"speed": 13.89, "green": green, "red": 87 - green}
    left = left_in_sumo(tmp_path, 7800, (BEFORE_RED, INTO, INTO_A_QUEUE), about)
    expected = left["sc"] / (left["sc"] + left["wc"])
    assert share_of_minor(green) == pytest.approx(expected, abs=0.04)


def test_those_who_give_way_into_a_queue_find_what_room_is_left():
    """Without right of way for a it is 0.17."""
    assert share_of_minor(20) < 0.06


def share_of_minor(green):
    """Share of d of those who enter b, where a has right of way, and a signal stops them."""
    network = triangle()
    of_links = ("length", "behind", "limit", "stopped", "free_time", "first", "last", "detector")
    fourth = {name: np.pad(getattr(network, name), (0, 1), "edge") for name in of_links}
    network = replace(
        network,
        **fourth,
        street=np.array(["a", "b", "d", "e"]),
        region=np.array([0, 1, 2, 1]),
        lane_link=np.arange(4),
        movement_link=np.array([0, 1, 2]),
        turn_link=np.array([1, 3, 1]),
        server=np.arange(3),
        entry_link=np.arange(4),
        destination=np.ones(4, int),
        ending=np.array([[0.0, 0.0, 0.0, 1.0]]),
        origin=np.array([[1.0, 0.0, 1.0, 0.0]]),
        cell_entry=np.arange(3),
        cell_onward=np.array([1, 3, 1]),
        cell_share=np.ones((1, 3)),
        cycle=np.array([1, 90, 1]),
        begin=np.array([0, 1, 91]),
        light=np.concatenate([np.ones(1 + green), np.zeros(90 - green), np.ones(1)]),
        yields=np.concatenate([np.zeros(91), np.ones(1)]),
    )
    states = rollout(model_of(network), 1.0, intervals=80, from_d=1.0)
    left = (states[-1].traffic.left - states[16].traffic.left)[0]
    return float(left[2] / left[1])
