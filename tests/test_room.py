"""A command per boundary, shared over its gateways by the room before and behind them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import streets
import tiny
import tiny_city
from test_responsive import imported

from cosim.plant.room import Room, shared, upstream
from cosim.plant.supervisor import Supervisor
from cosim.sumo.net import Gateway
from nmfd import api
from nmfd.api import load_scenario
from nmfd.model.scenario import with_demand
from nmfd.types import Observation

# Streets a and b lead to the gateways a -> x and b -> y; c, which has a signal at its end, d and e
# lead to a.
TOWN = streets.city(
    dict.fromkeys("abcde", 0) | {"x": 1, "y": 1},
    {"a": "x", "b": "y", "c": "a", "d": "a", "e": "d", "x": "", "y": ""},
    length={"a": 150.0, "b": 150.0, "c": 75.0, "d": 300.0, "e": 75.0, "x": 75.0, "y": 75.0},
    signals={"a": "s", "b": "s", "c": "t"},
    gateways=tuple(
        Gateway(
            source=0, target=1, from_edge=one, to_edge=other, signal="s", links=(n,), lanes=(0,)
        )
        for n, (one, other) in enumerate((("a", "x"), ("b", "y")))
    ),
)


def room(on_lanes=(), green=(30.0, 30.0), limit=0.6):
    """A room whose lanes before the gateways hold these vehicles."""
    counts = dict(zip(("a_0", "b_0"), on_lanes, strict=False))
    session = SimpleNamespace(lane_vehicles=lambda lane: counts.get(lane, 0))
    return Room(session, TOWN, np.array(green), limit=limit, lanes=True)


def vehicles(**counts):
    return np.array([float(counts.get(edge, 0.0)) for edge in TOWN.edges])


@pytest.mark.parametrize("seed", range(20))
def test_the_mean_by_capacity_is_the_command_unless_floors_let_more_through(seed):
    random = np.random.default_rng(seed)
    urgency, floor, capacity = (
        random.uniform(-1, 1, 7),
        random.uniform(0, 0.5, 7),
        random.uniform(1, 9, 7),
    )
    for share in (0.0, 0.1, 0.4, 0.9, 1.0):
        given = shared(share, urgency, floor, capacity)
        assert np.average(given, weights=capacity) == pytest.approx(
            max(share, np.average(floor, weights=capacity))
        )
        assert (given >= floor).all()
        assert (given <= 1.0).all()
        order = np.argsort(urgency)
        free = (given > floor)[order] & (given < 1.0)[order]
        assert (np.diff(given[order][free]) >= -1e-12).all()


def test_the_chain_ends_at_a_signal_and_400_m_before_the_gateway():
    nearer = replace(TOWN, length={**TOWN.length, "d": 200.0})
    assert upstream(TOWN, "a") == ["a", "d"]
    assert upstream(TOWN, "b") == ["b"]
    assert upstream(nearer, "a") == ["a", "d", "e"]


def test_the_fuller_gateway_gets_more_and_a_full_one_is_open():
    half, gates = np.array([[1.0, 0.5], [1.0, 1.0]]), room(on_lanes=(4, 0))
    gates.command(half, vehicles(a=4))
    assert gates.share == pytest.approx([0.6, 0.4])  # 4 of 20 places taken
    gates.command(half, vehicles(a=4, x=5))  # the street behind is half full
    assert gates.share == pytest.approx([0.5 - 0.15, 0.5 + 0.15])
    gates = room(on_lanes=(12, 0))  # 0.6 of its lane
    gates.command(np.zeros((2, 2)), vehicles(a=12))
    assert gates.share == pytest.approx([1.0, 0.0])
    assert gates.realised()[0, 1] == pytest.approx(0.5)
    gates = room()  # the same in the street before, and one gateway without a command
    gates.command(np.zeros((2, 2)), vehicles(d=27))
    assert gates.share == pytest.approx([0.5, 0.0])  # 27 of 60 places: half-way between 0.3 and 0.6
    gates = room(on_lanes=(12, 0), limit=0.0)
    gates.command(half, vehicles(a=12))
    assert (gates.share == 0.5).all()


def test_realised_is_the_mean_since_the_command():
    gates = room(green=(30.0, np.nan))  # no command arrives at b
    gates.command(np.zeros((2, 2)), vehicles())
    gates.update(vehicles(a=20, d=40))
    assert gates.realised() == pytest.approx(np.array([[0.0, 0.5], [0.0, 0.0]]))
    assert gates.gateway_shares() == pytest.approx([0.5, 0.0])


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return imported(
        tmp_path_factory.mktemp("room") / "x", "town", signals=("--tls.set", "B1,B2,C1,C2")
    )


@pytest.mark.parametrize("limit, held", [(0.6, True), (0.0, False)])
def test_no_command_fills_the_street_before_a_gateway(town, limit, held):
    scenario = with_demand(load_scenario(town), steps=4)
    with tiny_city.plant_of(scenario, chain_limit=limit) as plant:
        plant.reset(1)
        closed = tiny.gates_at(scenario, scenario.network.u_min)
        realised = [plant.step(closed) for _ in range(4)][-1].realised
        record, streets = plant.record(), plant.city.edges
        before = [
            streets.index(gateway.from_edge) for gateway in plant.city.gateways if gateway.signal
        ]
        assert (
            record["edge_vehicles"][:, before].max() < 0.75 * 2 * 200.0 / 7.5
        ) == held  # room of two lanes
        assert (record["gateway_command"] == 0.0).all()
        assert (record["gateway_share"].max() > 0.3) == held
        assert realised.max() > scenario.network.u_min + 0.05 if held else realised is None


def test_the_integral_goes_on_from_what_was_realised():
    """At the set point the next command is the mean of what the entries realised."""
    scenario = load_scenario("economic_mpc")
    network, controller = scenario.network, api.controller("pi-gating", scenario)
    accumulation = np.zeros((7, 7))
    accumulation[3, 0] = controller.set_point[0]
    entries = network.adjacency[:, 3]
    realised = network.open_perimeter
    realised[entries, 3] = np.linspace(0.3, 0.7, entries.sum())
    seen = Observation(
        step=1, time=30.0, accumulation=accumulation, backlog=accumulation, realised=realised
    )
    assert controller.act(seen).perimeter[entries, 3] == pytest.approx(0.5)


@pytest.mark.parametrize(
    "change, full, share, opens",
    [
        (1, 1.5, 0.2, True),
        (0, 1.5, 0.2, True),
        (-1, 1.5, 0.2, False),
        (1, 0.5, 0.2, False),
        (1, 1.5, 0.9, False),
    ],
)
def test_gates_that_do_not_empty_their_region_open_for_a_while(change, full, share, opens):
    network = load_scenario("economic_mpc").network
    supervisor, command = Supervisor(network, 90.0), np.where(network.adjacency, 1.0, 0.0)
    command[:, 3] *= share
    accumulation, others = full * network.critical, np.arange(7) != 3
    opened = [supervisor.opened(command, accumulation + change * k) for k in range(35)]
    assert not np.array(opened)[:, others].any()
    assert [k for k, regions in enumerate(opened) if regions[3]] == (
        [*range(10, 20), *range(30, 35)] if opens else []
    )  # 900 s of patience, 900 s open
