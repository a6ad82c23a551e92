"""The longest wait of a driver at red, which is not the longest red of an empty link."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import tiny_city

from cosim.api import run_controllers
from cosim.plant.waits import Waits
from cosim.sumo.signals import Link

LINKS = {
    "s": [
        Link(index=0, from_edge="a", lane=0, to_edge="b"),
        Link(index=1, from_edge="a", lane=0, to_edge="c"),
        Link(index=2, from_edge="d", lane=0, to_edge="b"),
    ]
}
FLOW = '<flow id="f" begin="0" end="900" period="4" from="A1B1" to="C1D1"/>'


def street(vehicle="car", standing=0.0, route=("a", "b")):
    """A session in which one vehicle is first on the lane of edge a."""
    session = SimpleNamespace(time=0.0, stands=standing)
    session.halting = lambda edge: int(edge == "a" and vehicle is not None)
    session.first_on = lambda lane: vehicle if lane == "a_0" else None
    session.standing_time = lambda vehicle: session.stands
    session.route = lambda vehicle: route
    session.route_index = lambda vehicle: route.index("a")
    return session


def waited(session, *moments):
    """The longest wait after (time, state that begins, time that the vehicle has stood)."""
    states = {"s": []}
    waits = Waits(session, LINKS, states)
    for time, state, standing in moments:
        session.time, session.stands = float(time), standing
        if state:
            states["s"].append((float(time), state))
            waits.changed("s", state, float(time))
        waits.sample()
    return waits.longest().get("s")


@pytest.mark.parametrize(
    "moments, expected",
    [
        (((0, "rrr", 0.0), (10, "", 8.0), (20, "", 18.0), (25, "Grr", 0.0)), 23.0),
        (((0, "Grr", 9.0), (10, "rrr", 19.0), (20, "", 29.0), (30, "Grr", 39.0)), 20.0),  # a queue
        (((0, "rGr", 0.0), (10, "", 8.0), (20, "", 18.0)), 18.0),  # until the end of the run
        (((0, "Grr", 0.0), (10, "", 9.0), (20, "", 19.0)), None),  # at green
        (((0, "srr", 0.0), (10, "", 9.0), (20, "", 19.0)), None),  # it may turn on red
        (((0, "yrr", 0.0), (3, "rrr", 0.0), (10, "", 6.0), (12, "grr", 8.0)), 8.0),
    ],
)
def test_a_wait_is_the_time_at_red(moments, expected):
    assert waited(street(), *moments) == expected


def test_nobody_waits_on_an_empty_lane_or_for_another_turn():
    moments = ((0, "rrr", 0.0), (10, "", 8.0), (20, "", 18.0))
    assert waited(street(vehicle=None), *moments) is None
    assert waited(street(route=("a", "elsewhere")), *moments) is None
    assert waited(street(route=("a",)), *moments) is None
    assert waited(street(route=("a", "c")), *moments) == 18.0


@pytest.mark.slow
def test_the_sheet_of_a_run(tmp_path, out):
    """Cars of one street only: max-pressure leaves the other links red, but nobody waits there."""
    net = tiny_city.network(tmp_path, "--tls.set B1,B2,C1,C2")
    (tmp_path / "cars.rou.xml").write_text(f"<routes>{FLOW}</routes>")
    (tmp_path / "city.sumocfg").write_text(
        f'<configuration><net-file value="{net}"/><route-files value="cars.rou.xml"/>'
        '<time><end value="900"/></time></configuration>'
    )
    scenario = tiny_city.imported(tmp_path, regions=2, source=tmp_path / "city.sumocfg")
    run_controllers(scenario, ["no-control", "no-control+max-pressure"], steps=6, out=out)
    table = pd.read_csv(out / "signals.csv").set_index(["controller", "signal"])
    driven = table.loc[[(name, "B1") for name in ("no-control", "no-control+max-pressure")]]
    fixed, pressed = driven.longest_wait_s
    red = driven.longest_red_s.iloc[0]
    assert 0.5 * red < fixed <= red
    assert np.isnan(pressed)
    assert driven.longest_red_s.iloc[1] > 300.0
    assert np.isnan(table.longest_wait_s["no-control", "C2"])
