"""Vehicles that leave a queue in each green: the link model beside SUMO, at one signal."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import tiny_city
from test_links import ONE_LANE, STEP_S, model_of, rollout, triangle

RED_S = 43  # with yellow
FIRST, LAST = 10, 70  # cycles that count
NODES = """<nodes><node id="a" x="-900" y="0"/><node id="c" x="0" y="0" type="traffic_light"/>
<node id="b" x="600" y="0"/></nodes>"""
EDGES = """<edges><edge id="ac" from="a" to="c" speed="{speed}"/>
<edge id="cb" from="c" to="b" speed="{speed}"/></edges>"""
CITY = """<additional><tlLogic id="c" type="static" programID="own" offset="0">
<phase duration="{green}" state="G"/><phase duration="3" state="y"/>
<phase duration="40" state="r"/></tlLogic>
<route id="r" edges="ac cb"/><flow id="f" route="r" begin="0" end="9999" period="1"/>
<edgeData id="e" file="seen.xml" begin="{begin}" end="{end}"/></additional>"""


@pytest.mark.slow
@pytest.mark.parametrize("speed, green", [(13.89, 7), (13.89, 10), (13.89, 30), (8.33, 10)])
def test_a_green_serves_as_many_vehicles_as_in_sumo(tmp_path, speed, green):
    assert served(speed, green) == pytest.approx(served_in_sumo(tmp_path, speed, green), rel=0.05)


def served_in_sumo(folder, speed, green):
    """Vehicles in each green; speed: limit (m/s); green: (s)"""
    cycle = green + RED_S
    about = {"speed": speed, "green": green, "begin": FIRST * cycle, "end": LAST * cycle}
    for name, text in (("n.xml", NODES), ("e.xml", EDGES), ("add.xml", CITY)):
        (folder / name).write_text(text.format(**about))
    net = folder / "net.xml"
    files = ("-n", folder / "n.xml", "-e", folder / "e.xml", "-o", net, "--no-turnarounds")
    tiny_city.run("netconvert", *files)
    tiny_city.run("sumo", "-n", net, "-a", folder / "add.xml", "-e", LAST * cycle, "--seed", 1)
    street = ElementTree.parse(folder / "seen.xml").find(".//edge[@id='ac']")
    return float(street.get("left")) / (LAST - FIRST)


def served(speed, green):
    """The same in the link model, with SUMO's default vehicles."""
    cycle = green + RED_S
    network = replace(
        triangle(),
        cell_share=np.array([[1.0, 0.0, 1.0]]),
        cycle=np.array([cycle, 1, 1]),
        begin=np.array([0, cycle, cycle + 1]),
        light=np.concatenate([np.ones(green), np.zeros(RED_S), np.ones(2)]),
        yields=np.concatenate([np.zeros(cycle + 1), np.ones(1)]),
        speed=np.full(3, speed),
        free_time=np.full(3, 300.0 / speed),
        acceleration=2.6,
        **ONE_LANE,
    )
    states = rollout(model_of(network), 1.0, intervals=48)
    left = float((states[-1].traffic.left - states[8].traffic.left)[0, 0])
    return left * cycle / (40 * STEP_S)
