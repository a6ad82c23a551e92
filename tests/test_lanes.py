"""Two leaders who wait for each other's lane block a street for ever; guided drivers go on
instead."""

import math
import sys

import libsumo
import numpy as np
import pytest
import streets
import tiny_city

from cosim.plant.guidance import Guide
from cosim.plant.meter import Event
from cosim.plant.stuck import LEADER_M, LEADER_PATIENCE_S, QUEUE_END_M, Lanes
from cosim.sumo.session import Session, _compiled

NODES = """<nodes><node id="a" x="0" y="0"/><node id="b" x="300" y="0"/>
<node id="l" x="600" y="200"/>
<node id="r" x="600" y="-200"/><node id="e" x="900" y="0"/></nodes>"""
EDGES = """<edges><edge id="ab" from="a" to="b" numLanes="2"/>
<edge id="bl" from="b" to="l"/><edge id="br" from="b" to="r"/>
<edge id="le" from="l" to="e"/><edge id="re" from="r" to="e"/><edge id="lr" from="l" to="r"/>
<edge id="rl" from="r" to="l"/></edges>"""
AFTER = {
    "ab": ("bl", "br"),
    "bl": ("le", "lr"),
    "br": ("re", "rl"),
    "lr": ("re",),
    "rl": ("le",),
    "le": (),
    "re": (),
}
# The right lane, 0, leads to the right only.
CONNECTIONS = """<connections><connection from="ab" to="br" fromLane="0" toLane="0"/>
<connection from="ab" to="bl" fromLane="1" toLane="0"/></connections>"""
QUEUE = 12  # vehicles on each lane, all of whom want to be on the other one
VEHICLE = """<vehicle id="{way}{n}" depart="0" departLane="{lane}" departPos="{at}" departSpeed="0">
<route edges="ab {edges}"/></vehicle>"""
TARGETS = {"left": "le", "right": "re"}
LEADERS = {f"{way}0": target for way, target in TARGETS.items()}


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lanes")
    options = ["-o", folder / "net.xml"]
    for option, text in (("-n", NODES), ("-e", EDGES), ("-x", CONNECTIONS)):
        (folder / f"{option}.xml").write_text(text)
        options += [option, folder / f"{option}.xml"]
    tiny_city.run("netconvert", *options)
    return folder


@pytest.fixture
def session(network, request):
    """A queue on both lanes, each in that of the other, its leader at the given place [m], from the
    end if negative."""
    routes = network / f"at{request.param}.rou.xml"
    routes.write_text(
        "<routes>"
        + "".join(
            VEHICLE.format(way=way, n=n, lane=lane, at=request.param - 7.5 * n, edges=edges)
            for n in range(QUEUE)
            for lane, (way, edges) in enumerate({"left": "bl le", "right": "br re"}.items())
        )
        + "</routes>"
    )
    session = Session(network / "net.xml", routes, seed=1)
    session.step()
    yield session
    session.close()


def drive(session, seconds):
    """Whether all arrived within that time."""
    ended = set()
    for _ in range(seconds):
        session.step()
        ended |= set(session.arrived())
    return len(ended) == QUEUE * len(TARGETS)


def guide_of(session, *, period, turn_late=False):
    """Return a guide with a command, of the whole network as one region."""
    length, speed = dict.fromkeys(AFTER, 300.0), dict.fromkeys(AFTER, 13.9)
    city, random = (
        streets.city(dict.fromkeys(AFTER, 0), AFTER, length=length, speed=speed),
        np.random.default_rng(0),
    )
    guide = Guide(
        session,
        city,
        np.zeros((1, 1, 1)),
        compliance=1.0,
        period=period,
        turn_late=turn_late,
        random=random,
    )
    guide.command(np.zeros((1, 1, 1)), None)
    return guide


def ways_out(lanes):
    """The way of either leader, [] if there is none."""
    return {vehicle: lanes.way_out(vehicle, target) for vehicle, target in LEADERS.items()}


@pytest.mark.parametrize("session", [-0.5], indirect=True)
def test_with_a_way_out_each_goes_on_where_the_lane_leads(session):
    lanes = Lanes(session)
    assert not any(ways_out(lanes).values())  # they have just come
    assert not drive(session, int(LEADER_PATIENCE_S) + 20)
    ways = ways_out(lanes)
    assert ways == {"left0": ["ab", "br", "rl", "le"], "right0": ["ab", "bl", "lr", "re"]}
    for vehicle, way in ways.items():
        assert session.set_route(vehicle, way)
    assert not any(ways_out(lanes).values())  # they are in the right lane
    for _ in range(60):
        session.step()
    assert not LEADERS.keys() & {
        vehicle for vehicle in session.running() if session.road(vehicle) == "ab"
    }


@pytest.mark.parametrize("session", [100], indirect=True)
def test_no_way_begins_on_a_street_that_is_closed_to_cars(session):
    assert session.fastest("br", "le")[1] == ("br", "rl", "le")
    libsumo.lane.setAllowed("br_0", ["bus"])
    assert session.fastest("br", "le") == (math.inf, ())


@pytest.mark.parametrize("session, late", [(-0.5, True), (100, False)], indirect=["session"])
def test_near_the_end_of_a_lane_it_is_too_late_for_others(session, late):
    lanes = Lanes(session)
    assert 0.5 < LEADER_M < QUEUE_END_M < 200.0 - 12.0
    assert lanes.too_late("left0", ["ab", "bl", "le"]) is late
    assert not lanes.too_late("left0", ["ab", "br", "re"])
    assert not lanes.too_late("left0", ["ab"])
    assert not Lanes(session, 0.0).too_late("left0", ["ab", "bl", "le"])


@pytest.mark.parametrize("session", [-0.5], indirect=True)
@pytest.mark.parametrize(
    "turn_late, period, sent", [(False, 60.0, False), (True, 60.0, True), (True, 0.0, False)]
)
def test_from_before_the_stop_line_they_are_sent_elsewhere_only_if_they_are_led_on(
    session, turn_late, period, sent
):
    guide = guide_of(session, period=period, turn_late=turn_late)
    assert session.set_route(
        "left0", ["ab", "br", "rl", "le"]
    )  # longer than by bl, where the lane does not lead
    guide.apply([Event(vehicle="left0", source=None, edge="le", region=0, destination=0)])
    assert (session.route("left0") == ("ab", "bl", "le")) is sent


@pytest.mark.parametrize("session", [-0.5], indirect=True)
def test_guided_drivers_are_led_on(session):
    guide = guide_of(session, period=60.0)
    guide.apply(
        [
            Event(
                vehicle=vehicle,
                source=None,
                edge=TARGETS[vehicle.rstrip("0123456789")],
                region=0,
                destination=0,
            )
            for vehicle in session.running()
        ]
    )
    for _ in range(1800):
        session.step()
        guide.apply([])
    assert guide.led_on >= 2
    assert not session.running()


def test_functions_of_sumo_are_called_without_python_between():
    compiled = sys.modules["libsumo._libsumo"].vehicle_getRoadID
    assert _compiled(libsumo.vehicle.getRoadID) is compiled
    assert _compiled(compiled) is compiled
