"""PI gating of the centre: what it reaches on the benchmark, its anti-windup and its options."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
from commands import problem

from nmfd import api
from nmfd.api import load_scenario
from nmfd.controllers.rules import filled
from nmfd.errors import InputError
from nmfd.metrics import summary
from nmfd.model.planning import planning_model
from nmfd.model.regional_model import RegionalModel
from nmfd.types import Status

SCENARIO = load_scenario("economic_mpc")
NETWORK, CENTRE = SCENARIO.network, 3
CRITICAL = NETWORK.mfds[CENTRE].critical


def seen(vehicles, step=0):
    """A measurement with `vehicles` in the centre."""
    accumulation = np.zeros((7, 7))
    accumulation[CENTRE, 0] = vehicles
    return tiny.seen(accumulation, step)


def gate(controls):
    """The one u of all entries of the centre."""
    entries = controls.perimeter[NETWORK.adjacency[:, CENTRE], CENTRE]
    assert (entries == entries[0]).all()
    return entries[0]


def with_options(**options):
    return replace(SCENARIO, controller_options={"pi-gating": options})


def test_benchmark_row():
    trajectory = api.run(SCENARIO, "pi-gating")
    row = summary(trajectory)
    assert row["total_time_spent_veh_s"] == pytest.approx(8.9e7, rel=0.02)
    assert row["final_accumulation_veh"] < 500.0
    assert trajectory["accumulation"][:, CENTRE].sum(axis=1).max() < 1.25 * CRITICAL


def test_only_the_entries_are_metered_and_within_bounds():
    controller, random = api.controller("pi-gating", SCENARIO), np.random.default_rng(0)
    others = NETWORK.adjacency.copy()
    others[:, CENTRE] = False
    for step in range(100):
        controls = controller.act(seen(random.uniform(-10.0, 3.0 * CRITICAL), step))
        assert NETWORK.u_min <= gate(controls) <= NETWORK.u_max
        assert (controls.perimeter[others] == NETWORK.u_max).all()
        assert (controls.perimeter[~NETWORK.adjacency] == 0.0).all()
        assert controls.splits is None
        assert controls.status == Status.OK


@pytest.mark.parametrize("long, then, limit", [(0.0, 1.2, "u_max"), (3.0, 0.8, "u_min")])
def test_the_integral_does_not_wind_up(long, then, limit):
    """After hours at one bound, the gate leaves it as fast as after ten minutes."""
    gates = []
    for intervals in (20, 1000):
        controller = api.controller("pi-gating", SCENARIO)
        for step in range(intervals):
            controls = controller.act(seen(long * CRITICAL, step))
        assert gate(controls) == getattr(NETWORK, limit)
        controller.act(seen(then * CRITICAL, intervals))
        gates.append(gate(controller.act(seen(then * CRITICAL, intervals + 1))))
    assert gates[0] == gates[1] != getattr(NETWORK, limit)


def pair(bound, **facts):
    """Two regions; of the trips that begin in 0, the share `bound` goes to 1."""
    network = RegionalModel(
        name="pair",
        region_names=("0", "1"),
        positions=np.array([[0.0, 0.0], [1000.0, 0.0]]),
        adjacency=~np.eye(2, dtype=bool),
        mfds=(NETWORK.mfds[0],) * 2,
        u_min=0.1,
        u_max=0.9,
        **facts,
    )
    forecast = np.array([[[1.0 - bound, bound], [0.0, 1.0]]])
    return SimpleNamespace(network=network, forecast=forecast, step=60.0)


@pytest.mark.parametrize("bound", [0.5, 1.0])
def test_open_gates_fill_a_region_with_what_its_neighbour_sends(bound):
    largest = NETWORK.mfds[0].capacity
    assert filled(pair(bound), 1) == pytest.approx(60.0 * bound * largest)


def test_a_boundary_lets_in_no_more_than_its_capacity_and_holds_only_at_signals():
    capacity = np.array([[0.0, 0.3], [0.3, 0.0]])
    narrow = pair(1.0, capacity=capacity)
    let_in = 60.0 * narrow.network.open_capacity[0, 1]
    assert let_in < 60.0 * NETWORK.mfds[0].capacity
    assert filled(narrow, 1) == pytest.approx(let_in)
    half = np.array([[0.0, 0.5], [0.5, 0.0]])
    assert filled(pair(1.0, capacity=capacity, controllable=half), 1) == pytest.approx(0.5 * let_in)


def test_default_gains_correct_an_error_within_an_interval():
    controller = api.controller("pi-gating", with_options(set_point=[3000.0]))
    share = filled(planning_model(SCENARIO), CENTRE) / CRITICAL
    controller.act(seen(3000.0))
    error = 30.0 / CRITICAL
    expected = 0.9 - (1.0 + 0.3) * error / share
    assert gate(controller.act(seen(3030.0, 1))) == pytest.approx(expected)


def test_one_step_by_hand():
    controller = api.controller("pi-gating", with_options(set_point=[3000.0], kp=0.5, ki=0.001))
    controller.act(seen(3000.0))
    by_hand = 0.9 + (0.5 * (3000.0 - 3600.0) + 0.001 * 30.0 * (3000.0 - 3600.0)) / CRITICAL
    assert gate(controller.act(seen(3600.0, 1))) == pytest.approx(by_hand, rel=1e-12)


def test_a_gate_moves_by_at_most_max_change():
    options = with_options(set_point=[3000.0], kp=5.0, max_change=0.2)
    controller = api.controller("pi-gating", options)
    controller.act(seen(3000.0))
    gates = [gate(controller.act(seen(n, k))) for k, n in enumerate((5000.0, 7000.0, 5000.0), 1)]
    assert gates == pytest.approx([0.7, 0.5, 0.7])


def test_reset_forgets():
    controller = api.controller("pi-gating", SCENARIO)
    for step in range(5):
        controller.act(seen(2.0 * CRITICAL, step))
    controller.reset()
    assert gate(controller.act(seen(0.0))) == NETWORK.u_max


@pytest.mark.parametrize(
    "options, expected",
    [
        ({"kP": 1.0}, "kP: unknown key"),
        ({"ki": 0.0}, "ki: should be greater than 0"),
        ({"kp": -1.0}, "kp: should be greater"),
        ({"set_point": [1.0, 2.0]}, "set_point: expected a list of 1 numbers"),
        ({"set_point": [-5.0]}, r"set_point\[0\]: should be greater than 0"),
    ],
)
def test_wrong_options(options, expected):
    line = problem(api.controller, "pi-gating", with_options(**options))
    assert re.search(f"controllers.pi-gating.{expected}", line)


def test_every_protected_region_is_held_at_its_set_point():
    """The gates of both move by their own error; a boundary between them has one for each
    direction."""
    options = {"set_point": [1000.0, 3000.0], "kp": 0.0, "ki": 0.001}
    assert NETWORK.adjacency[5, 3]
    controller = api.controller("pi-gating", replace(with_options(**options), protected=(5, 3)))
    accumulation = np.zeros((7, 7))
    accumulation[5, 0], accumulation[3, 1] = 1200.0, 3300.0
    controls = controller.act(tiny.seen(accumulation))
    for region, error in ((5, 200.0), (3, 300.0)):
        entries = controls.perimeter[NETWORK.adjacency[:, region], region]
        assert entries == pytest.approx(
            NETWORK.u_max - 0.03 * error / NETWORK.mfds[region].critical, rel=1e-12
        )
    others = np.delete(np.arange(7), [5, 3])
    assert (controls.perimeter[:, others][NETWORK.adjacency[:, others]] == NETWORK.u_max).all()


def test_something_must_be_protected():
    with pytest.raises(
        InputError, match="protected: pi-gating needs at least one protected region, got none"
    ):
        api.controller("pi-gating", replace(SCENARIO, protected=()))


def test_the_set_point_by_a_share_of_the_maximum_outflow():
    mfd = NETWORK.mfds[3]
    for share in (0.5, 0.95, 1.0):
        (point,) = api.controller("pi-gating", with_options(outflow_share=share)).set_point
        assert point <= mfd.critical
        assert mfd.outflow(point) == pytest.approx(share * mfd.capacity, rel=1e-3)
    assert api.controller(
        "pi-gating", with_options(outflow_share=0.5, set_point=[3000.0])
    ).set_point == [3000.0]


def test_probing_moves_around_the_set_point_that_identification_gives():
    options = {"probing-pc": {"set_point": [2000.0]}}
    probing = api.controller("probing-pc", replace(SCENARIO, controller_options=options))
    probing.reset(1)
    gates = [probing.act(seen(2000.0, k)).perimeter for k in range(20)]
    assert len({u.tobytes() for u in gates}) > 1
    assert probing._gating.critical == [2000.0]
