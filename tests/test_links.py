"""The link model: mass, derivatives, capacity, spillback, controls, and the plant around it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import tiny
import torch
from commands import error_line, good
from commands import nmfd as nmfd_command

from cosim.evaluation import link_phases
from cosim.evaluation.links import link_network, write_links
from cosim.sumo.net import Connection
from cosim.sumo.session import Phase
from cosim.sumo.signals import Signal
from nmfd import api
from nmfd.controllers.dpc.numbers import Numbers
from nmfd.controllers.dpc.policy_file import read_file as read_policy
from nmfd.controllers.dpc.street_rollout import MOST_DELAYED, Bound
from nmfd.errors import InputError
from nmfd.model.links.chance import DRAWS
from nmfd.model.links.compiled import compiled
from nmfd.model.links.flows import ACCELERATING, BETWEEN_M, BRAKING, REACTION, START_S, TURNING
from nmfd.model.links.model import Choices, Commands, LinkModel, choices_of
from nmfd.model.links.network import LinkNetwork, read_links
from nmfd.model.links.plant import LinkPlant, links_file
from nmfd.model.links.recompute import Recordings
from nmfd.model.links.signals import GAP_S, Lights

CYCLE_S = 60
GREEN_S = 30
LEAST_S = 5.0  # of both phases, if the signal is actuated
LONGEST_S = 45.0  # of the green one
ACTUATED = {"signals": "actuated", "gateways_fixed": False}
ONE_LANE = {"lane_link": np.arange(3), "server": np.array([0, 0, 2])}
SPEED = 10.0  # m/s on junctions
SPACING = 7.5
SATURATION = 1.0 / (REACTION + (SPACING + BETWEEN_M) / SPEED)  # of cars that keep a second
ACCELERATION = 2.5
LOST_S = (  # of each green: to get going, less the first headway and what drives on at yellow
    START_S + SPEED / (2 * ACCELERATING * ACCELERATION) - 1 / SATURATION - SPEED / (2 * BRAKING)
)
STEP_S = 90.0
NOMINAL = np.zeros((3, 3, 3))
NOMINAL[0, 1, 1] = 0.7
NOMINAL[0, 2, 1] = 0.3
NOMINAL[2, 1, 1] = 1.0


def triangle(length: float = 300.0) -> LinkNetwork:
    """Street a in region 0 leads to b in region 1, or by way of d in region 2.

    Trips go from a to b. The signal at the end of a has 30 s of green for a -> b, where a gate is;
    d -> b gives way to it.
    """
    green = np.arange(CYCLE_S) < GREEN_S
    light = np.concatenate([green, np.ones(2)]).astype(float)
    return LinkNetwork(
        regions=3,
        periods=1,
        period=900.0,
        numbers=np.array([1.0, 1.0, 1.0, 4.7]),
        spacing=SPACING,
        headway=1.0,
        dawdling=0.0,
        acceleration=ACCELERATION,
        street=np.array(["a", "b", "d"]),
        length=np.full(3, length),
        behind=np.zeros(3),
        limit=np.full(3, SPEED),
        stopped=np.zeros(3),
        free_time=np.full(3, length / 15.0),
        region=np.array([0, 1, 2]),
        lane_link=np.array([0, 0, 1, 2]),
        movement_link=np.array([0, 0, 2]),
        speed=np.full(3, SPEED),
        turn_movement=np.arange(3),
        turn_link=np.array([1, 2, 1]),
        first=np.full(3, 0.5),
        last=np.full(3, 0.5),
        served=np.arange(3),
        server=np.array([0, 1, 3]),
        entry_link=np.arange(3),
        destination=np.full(3, 1),
        ending=np.array([[0.0, 1.0, 0.0]]),
        origin=np.array([[1.0, 0.0, 0.0]]),
        cell_turn=np.arange(3),
        cell_entry=np.array([0, 0, 2]),
        cell_onward=np.array([1, 2, 1]),
        cell_share=np.array([[0.7, 0.3, 1.0]]),
        yielding=np.array([2]),
        foe=np.array([0]),
        cycle=np.array([CYCLE_S, 1, 1]),
        begin=np.array([0, CYCLE_S, CYCLE_S + 1]),
        light=light,
        yields=np.concatenate([np.zeros(CYCLE_S + 1), np.ones(1)]),
        gated=np.array([True, False, False]),
        signal=np.array([0, -1, -1]),
        stages=np.array([2]),
        stage_light=np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]),
        stage_yields=np.zeros((3, 2)),
        stage_loss=np.full((1, 2, 2), 3.0),
        stage_least=np.full((1, 2), 5.0),
        pressure_movement=np.array([0, 0]),
        pressure_link=np.array([0, 1]),
        pressure_weight=np.array([0.7, -1.0]),
        gain_stage=np.array([0]),
        gain_movement=np.array([0]),
        gain=np.array([1.0]),
        phases=np.array([2]),
        phase_second=np.array([[0, GREEN_S]]),
        phase_least=np.full((1, 2), LEAST_S),
        phase_most=np.array([[LONGEST_S, 15.0]]),
        detector=np.full(3, 20.0),
        detected=np.array([0]),
        detecting=np.array([0]),
    )


def model_of(
    network: LinkNetwork | None = None, device: str = "cpu", compiled: bool = True, **choices
) -> LinkModel:
    return LinkModel(
        network or triangle(),
        STEP_S,
        nominal=NOMINAL,
        choices=Choices(**choices),
        dtype=torch.float64,
        device=device,
        compiled=compiled,
    )


def demand_of(rate) -> torch.Tensor:
    demand = torch.zeros(1, 3, 3, dtype=torch.float64)
    return demand.index_put((torch.tensor(0), torch.tensor(0), torch.tensor(1)), rate)


def rollout(model, rate, commands=None, intervals=6, from_d=0.0):
    """All states; `rate`: of the trips from a to b (veh/s), or its function of the interval.

    from_d: rate of those from d to b (veh/s)
    """
    states = [model.start(1)]
    for k in range(intervals):
        now = rate(k) if callable(rate) else rate
        demand = demand_of(torch.as_tensor(now, dtype=torch.float64))
        demand[0, 2, 1] = from_d
        states.append(model.advance(states[-1], demand, commands or Commands()))
    return states


def vehicles(model, state) -> torch.Tensor:
    """All trips that were due until now, wherever they are."""
    outside = model.backlog(state).sum()
    return model.accumulation(state).sum() + outside + state.traffic.completed.sum()


def signals_shown(model, traffic_of, steps):
    """State and lights in each step; `traffic_of`: the traffic by step and state before it."""
    state = model.start(1).stages
    programme = Lights(torch.ones(1, 3).double(), torch.zeros(1, 3).double())
    for n in range(steps):
        state, lights = model._signals.step(n, state, traffic_of(n, state), programme)
        yield state, lights


def first_green(model, traffic_of, steps=40):
    """Length of the first green of a -> b (s)."""
    green = 0.0
    for _, lights in signals_shown(model, traffic_of, steps):
        if float(lights.light[0, 0]) == 0.0:
            break
        green += 2.0 * float(lights.light[0, 0])
    return green


def all_commands(gate=0.4, metering=0.3, share=0.5, price=None):
    gates = torch.ones(1, 3, 3, dtype=torch.float64)
    gates[0, 0, 1] = gate
    splits = torch.as_tensor(NOMINAL).unsqueeze(0).clone()
    splits[0, 0, 1, 1] = share
    splits[0, 0, 2, 1] = 1.0 - share
    rates = torch.full((1, 3), metering, dtype=torch.float64)
    prices = None
    if price is not None:
        prices = torch.full((1, 3), price, dtype=torch.float64)
    return Commands(gates, rates, splits, prices)


@pytest.mark.parametrize("signals", [{}, {"signals": "max-pressure"}, ACTUATED])
@pytest.mark.parametrize("commands", [None, all_commands(), all_commands(price=2.0)])
def test_no_vehicle_appears_or_vanishes(signals, commands):
    model = model_of(guided=commands is None, **signals)
    last = rollout(model, 1.2, commands)[-1]
    assert float(vehicles(model, last)) == pytest.approx(1.2 * 6 * STEP_S, abs=1e-9)
    assert float(model.accumulation(last).min()) >= 0.0
    assert float(model.accumulation(last).sum()) == pytest.approx(
        float(last.traffic.inside.sum()), abs=1e-9
    )


def test_the_derivative_of_the_mass_is_exact():
    rate = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    model = model_of(guided=True)
    last = rollout(model, rate)[-1]
    (slope,) = torch.autograd.grad(vehicles(model, last), rate)
    assert float(slope) == pytest.approx(6 * STEP_S, abs=1e-9)


def test_a_free_trip_takes_its_free_time():
    """Half of the trips begin at the end of a; all end halfway along b."""
    model = model_of(replace(triangle(), light=np.ones(CYCLE_S + 2)))
    rate = 0.02
    states = rollout(model, rate)
    by_way_of_d = 0.3
    expected = 20.0 * (0.5 + 0.5 + by_way_of_d)
    inside = float(states[-1].traffic.inside.sum())
    assert inside / rate == pytest.approx(expected, abs=5.0)  # a step on each link


def test_a_free_trip_takes_its_free_time_whatever_the_step():
    """Free-flow times between two steps are not rounded."""
    network = replace(triangle(), light=np.ones(CYCLE_S + 2))
    times = []
    for more in (0.0, 0.5, 2.0):
        free = replace(network, free_time=network.free_time + np.array([more, 0.0, more]))
        times.append(float(rollout(model_of(free), 0.02)[-1].traffic.inside.sum()) / 0.02)
    assert np.diff(times) == pytest.approx([0.8 * 0.5, 0.8 * 1.5], abs=0.02)


def test_a_vehicle_that_stood_is_late_on_the_next_street():
    """All drive by way of d; of ten vehicles five see a red light before."""
    green = (np.arange(CYCLE_S) < GREEN_S).astype(float)
    network = replace(
        triangle(),
        cell_share=np.array([[0.0, 1.0, 1.0]]),
        cycle=np.array([1, CYCLE_S, 1]),
        begin=np.array([0, 1, CYCLE_S + 1]),
        light=np.concatenate([np.ones(1), green, np.ones(1)]),
    )
    times = []
    for acceleration in (1e9, 2.5):
        model = model_of(replace(network, acceleration=acceleration))
        times.append(float(rollout(model, 0.1)[-1].spent) / (0.1 * 6 * STEP_S))
    assert times[1] - times[0] == pytest.approx(0.5 * 15.0 / (2.0 * 2.5), rel=0.4)


@pytest.mark.parametrize("signals", [{}, {"signals": "max-pressure"}, ACTUATED])
def test_chance_keeps_mass_and_its_derivative(signals):
    rate = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    model = model_of(guided=True, **signals)
    state = model.start(2, [3, 4], chance=True)
    for _ in range(6):
        demand = torch.cat([demand_of(rate), demand_of(rate)])
        state = model.advance(state, demand, all_commands())
    assert vehicles(model, state).item() == pytest.approx(state.begun.sum().item(), abs=1e-9)
    assert state.begun.tolist() == pytest.approx([0.5 * 6 * STEP_S] * 2, abs=1.0)
    (slope,) = torch.autograd.grad(vehicles(model, state), rate)
    assert float(slope) == pytest.approx(2 * 6 * STEP_S, abs=1e-9)


def test_vehicles_turn_by_chance_as_often_as_on_average():
    model = model_of()
    state = model.start(1, [1], chance=True)
    entry = model.flows.places(np.array([0, 0, 2]))
    choice = model._ways(state, state.draw, Commands(), state.chance).choice
    one = torch.ones(1, 3).double()
    taken = [choice.cells(n * one, one, 1).tolist()[0] for n in range(DRAWS)]
    assert sorted(set(np.array(taken).ravel())) == [0.0, 1.0]
    assert np.bincount(entry, taken[0]).tolist() == [1.0, 0.0, 1.0]
    assert np.mean(taken, axis=0) == pytest.approx([0.7, 0.3, 1.0], abs=0.1)


def test_each_vehicle_of_a_step_turns_by_itself():
    model = model_of()
    state = model.start(1, [1], chance=True)
    choice = model._ways(state, state.draw, Commands(), state.chance).choice
    one = torch.ones(1, 3).double()
    single = [choice.cells(n * one, one, 1) for n in range(4)]
    expected = (0.5 * single[0] + single[1] + single[2] + 0.25 * single[3]) / 2.75
    torch.testing.assert_close(choice.cells(0.5 * one, 2.75 * one, 3), expected)


def test_chance_makes_queues_where_streams_have_none():
    """Those who turn to b are 97 % of the flow that green lets pass."""
    model = model_of()
    demand = demand_of(torch.tensor(0.97 * SATURATION * GREEN_S / CYCLE_S / 0.7).double())
    spent = []
    for draws, chance in [([0], False), ([1], True), ([2], True)]:
        state = model.start(1, draws, chance=chance)
        for _ in range(20):
            state = model.advance(state, demand, Commands())
        spent.append(float(state.spent))
    assert min(spent[1:]) > 1.015 * spent[0]
    assert spent[1] != spent[2]


def test_shares_are_those_of_the_period_and_the_draw():
    """In the second period all drive by way of d; the other draw does so in the first one."""
    streets = triangle()
    direct = [1.0, 0.0, 1.0]
    around = [0.0, 1.0, 1.0]
    rows = {
        "origin": np.repeat(streets.origin, 4, axis=0),
        "ending": np.repeat(streets.ending, 4, axis=0),
        "cell_share": np.array([direct, around, around, direct]),
    }
    demand = demand_of(torch.tensor(0.05, dtype=torch.float64))
    model = model_of(replace(streets, periods=2, period=2 * STEP_S, **rows))
    passed = []
    for seed in (0, 1):
        state = model.start(1, [seed])
        gone = []
        for _ in range(6):
            state = model.advance(state, demand, Commands())
            gone.append(float(state.gone[0, 2]))
        passed.append(gone)
    assert passed[0][:2] == [0.0, 0.0]
    assert min(passed[0][3:]) > 4.0
    assert max(passed[1][:2]) > 2.0
    assert passed[1][-1] < 0.01


def test_a_queue_discharges_at_the_saturation_flow():
    """All want to go straight on: 30 s of green of every minute."""
    network = replace(triangle(), cell_share=np.array([[1.0, 0.0, 1.0]]), **ONE_LANE)
    model = model_of(network)
    states = rollout(model, 1.0, intervals=16)
    flow = (states[-1].traffic.left - states[7].traffic.left)[0, 0] / (9 * STEP_S)
    assert float(flow) == pytest.approx(SATURATION * (GREEN_S - LOST_S) / CYCLE_S, rel=0.05)


def test_a_slow_turn_limits_the_flow():
    network = replace(
        triangle(),
        cell_share=np.array([[1.0, 0.0, 1.0]]),
        speed=np.full(3, 5.0),
        light=np.ones(CYCLE_S + 2),
        **ONE_LANE,
    )
    states = rollout(model_of(network), 1.0, intervals=8)
    flow = (states[-1].traffic.left - states[3].traffic.left)[0, 0] / (5 * STEP_S)
    assert float(flow) == pytest.approx(1.0 / (TURNING + SPACING / 5.0), rel=0.02)


@pytest.mark.parametrize("length", [0.2, 10.0, 40.0])
def test_a_short_street_passes_the_full_flow(length):
    """All drive by way of d, over a junction of 30 m, without a red light."""
    network = replace(
        triangle(),
        length=np.array([300.0, 300.0, length]),
        behind=np.array([0.0, 0.0, 30.0]),
        free_time=np.array([20.0, 20.0, (length + 30.0) / 15.0]),
        cell_share=np.array([[0.0, 1.0, 1.0]]),
        light=np.ones(CYCLE_S + 2),
        yields=np.zeros(CYCLE_S + 2),
    )
    states = rollout(model_of(network), 1.0, intervals=8)
    flow = (states[-1].traffic.left - states[3].traffic.left)[0, 2] / (5 * STEP_S)
    assert float(flow) == pytest.approx(SATURATION, rel=0.05)


def test_a_blocked_turn_blocks_its_link_and_the_trips_that_begin():
    network = triangle()
    light = network.light.copy()
    light[:CYCLE_S] = 0.0
    network = replace(network, light=light, **ONE_LANE)
    model = model_of(network)
    last = rollout(model, 0.5, intervals=12)[-1]
    assert float(last.traffic.left[0, 0]) < 10.0
    assert float(last.traffic.inside[0, 0]) <= float(model.flows.storage[0]) + 1e-9
    assert float(model.backlog(last).sum()) > 400.0


def test_a_gate_leaves_its_share_of_green():
    network = replace(triangle(), cell_share=np.array([[1.0, 0.0, 1.0]]), **ONE_LANE)
    model = model_of(network, chain_limit=0.0)
    states = rollout(model, 1.0, all_commands(gate=0.2, metering=9.0, share=1.0), intervals=16)
    passed = float((states[-1].traffic.left - states[7].traffic.left)[0, 0])
    green = GREEN_S - 0.8 * (GREEN_S - 5.0) - LOST_S
    assert passed / (9 * STEP_S) == pytest.approx(SATURATION * green / CYCLE_S, rel=0.05)
    assert float(states[-1].realised[0, 0, 1]) == pytest.approx(0.2)


def test_an_actuated_green_lasts_until_no_vehicle_passes_for_three_seconds():
    """One leaves in each step of 2 s, the last at 19 s; it covers the detector for 0.5 s."""
    model = model_of(**ACTUATED)
    empty = model.start(1).traffic
    for last, green in ((0, LEAST_S), (10, np.ceil(19.5 + GAP_S)), (30, LONGEST_S)):
        found = first_green(
            model, lambda n, _, last=last: empty._replace(left=empty.left + min(n, last))
        )
        assert found == pytest.approx(green - LOST_S)


def test_vehicles_between_the_detector_and_the_stop_line_extend_no_green():
    """The third one stands on the detector, 20 m before the line."""
    model = model_of(replace(triangle(), **ONE_LANE), **ACTUATED)
    empty = model.start(1).traffic
    for vehicles, green in ((2.0, LEAST_S), (3.0, LONGEST_S)):
        queue = torch.tensor([[vehicles, 0.0, 0.0]]).double()
        found = first_green(model, lambda *_, queue=queue: empty._replace(queue=queue))
        assert found == pytest.approx(green - LOST_S)


def three_stages(*, beside: bool) -> LinkNetwork:
    """Stage 0 is for a -> b, stage 1 for d -> b, stage 2 for a -> d, which never presses.

    beside: a -> d is green in stage 0, too
    """
    light = np.array([[1.0, 0.0, 0.0], [float(beside), 0.0, 1.0], [0.0, 1.0, 0.0]])
    return replace(
        triangle(),
        signal=np.zeros(3, int),
        stages=np.array([3]),
        stage_light=light,
        stage_yields=np.zeros((3, 3)),
        stage_loss=np.full((1, 3, 3), 3.0),
        stage_least=np.full((1, 3), 5.0),
        pressure_movement=np.array([0, 2]),
        pressure_link=np.array([0, 2]),
        pressure_weight=np.ones(2),
        gain_stage=np.array([0, 1]),
        gain_movement=np.array([0, 2]),
        gain=np.ones(2),
    )


def stages_shown(model, inside_of, seconds):
    """Stage of the signal in each step of 2 s; `inside_of`: vehicles by link while it shows one."""
    empty = model.start(1).traffic

    def traffic_of(_, state):
        return empty._replace(inside=torch.tensor([inside_of(int(state.stage))]).double())

    return [int(state.stage) for state, _ in signals_shown(model, traffic_of, seconds // 2)]


@pytest.mark.parametrize("beside", [True, False])
def test_a_stage_is_overdue_for_movements_without_another_green(beside):
    """Queues never change: other stages take turns, as no green may last longer."""
    model = model_of(three_stages(beside=beside), signals="max-pressure")
    shown = stages_shown(model, lambda _: [5.0, 0.0, 5.0], 360)
    assert set(shown) == ({0, 1} if beside else {0, 1, 2})
    if not beside:
        assert 120 <= 2 * shown.index(2) <= 130


def test_max_pressure_decides_every_five_seconds():
    """Of 10 s, 3 are lost; after the least green of 5 all vehicles are at the other stage."""
    model = model_of(three_stages(beside=True), signals="max-pressure")
    queues = {0: [0.0, 0.0, 9.0], 1: [9.0, 0.0, 0.0]}
    shown = stages_shown(model, queues.get, 100)
    assert np.count_nonzero(np.diff(shown, prepend=0)) == 10


def test_gateways_keep_their_programme_beside_actuated_signals():
    """The signal of the triangle has a gateway."""
    fixed, kept, actuated = (
        rollout(model_of(**choices), 0.4)[-1].spent
        for choices in ({}, {"signals": "actuated"}, ACTUATED)
    )
    assert torch.equal(fixed, kept)
    assert not torch.equal(fixed, actuated)


@pytest.mark.parametrize(
    "gate, green", [(0.2, (10.0 - LOST_S) / CYCLE_S), (1.0, (LONGEST_S - LOST_S) / 50.0)]
)
def test_a_gate_of_an_actuated_signal_leaves_green_of_the_programme(gate, green):
    """An open one takes none of what the signal adds."""
    network = replace(triangle(), cell_share=np.array([[1.0, 0.0, 1.0]]), **ONE_LANE)
    model = model_of(network, chain_limit=0.0, **ACTUATED)
    states = rollout(model, 1.0, all_commands(gate=gate, metering=9.0, share=1.0), intervals=16)
    passed = float((states[-1].traffic.left - states[7].traffic.left)[0, 0])
    assert passed / (9 * STEP_S) == pytest.approx(SATURATION * green, rel=0.05)


def test_metering_admits_its_rate():
    model = model_of()
    states = rollout(model, 0.5, Commands(metering=torch.full((1, 3), 0.1).double()))
    entered = 6 * STEP_S * 0.5 - float(model.backlog(states[-1]).sum())
    assert entered == pytest.approx(6 * STEP_S * 0.1, abs=1.0)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.7, 1.0])
def test_drivers_head_for_commanded_regions(share):
    model = model_of()
    state = rollout(model, 0.1, intervals=1)[-1]
    cells = model._ways(state, state.draw, all_commands(share=share)).cells
    torch.testing.assert_close(cells, torch.tensor([[share, 1.0 - share, 1.0]]).double())


def test_drivers_avoid_delay_and_prices():
    model = model_of(guided=True)
    free = rollout(model, 0.01, intervals=2)[-1]
    jammed = rollout(model, 1.2)[-1]
    before = model._ways(free, free.draw, Commands()).cells[0]
    delay = torch.zeros_like(jammed.present)
    delay[0, 1] = 9000.0
    delayed = free._replace(present=delay, gone=torch.full_like(delay, 30.0))
    prices = torch.tensor([[0.0, 0.0, 5.0]]).double()
    priced = model._ways(free, free.draw, Commands(prices=prices)).cells[0]
    assert float(model._ways(delayed, delayed.draw, Commands()).cells[0, 0]) == pytest.approx(
        float(before[0]), 0.1
    )
    assert float(priced[1]) < 0.3 * float(before[1])


def test_partial_compliance_mixes_the_shares():
    model = model_of(compliance=0.25)
    state = rollout(model, 0.1, intervals=1)[-1]
    cells = model._ways(state, state.draw, all_commands(share=0.3)).cells
    assert float(cells[0, 0]) == pytest.approx(0.7 + 0.25 * (0.3 - 0.7))


def test_gradients_are_those_of_central_differences():
    """Gates, metering, splits and prices, where traffic flows and they bind."""
    model = model_of(chain_limit=0.0, guided=True)

    def spent(numbers):
        gate, metering, share, price = numbers
        gates = torch.ones(1, 3, 3, dtype=torch.float64)
        gates = gates.index_put(tuple(map(torch.tensor, (0, 0, 1))), gate)
        splits = all_commands().splits.index_put(tuple(map(torch.tensor, (0, 0, 1, 1))), share)
        splits = splits.index_put(tuple(map(torch.tensor, (0, 0, 2, 1))), 1.0 - share)
        rates = metering.expand(1, 3)
        prices = torch.stack([price * 0.0, price * 0.0, price]).unsqueeze(0)
        by_splits = Commands(gates, rates, splits)
        by_prices = Commands(gates, rates, None, prices)
        state = model.start(1)
        demand = demand_of(torch.tensor(0.45, dtype=torch.float64))
        for commands in (by_splits, by_splits, by_prices, by_prices, by_prices):
            state = model.advance(state, demand, commands)
        return state.spent.sum()

    numbers = torch.tensor([0.5, 0.3, 0.6, 0.5], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(spent(numbers), numbers)
    differences = []
    for n in range(4):
        change = torch.zeros(4, dtype=torch.float64)
        change[n] = 1e-4
        with torch.no_grad():
            rise = spent(numbers + change) - spent(numbers - change)
        differences.append(float(rise) / 2e-4)
    cosine = torch.nn.functional.cosine_similarity(gradient, torch.tensor(differences).double(), 0)
    assert float(cosine) > 0.99
    assert bool((gradient != 0.0).all())


@pytest.mark.slow
def test_gradients_of_grid7_are_those_of_central_differences():
    """Metering of each region, a gate around the centre, a price of it: 9 numbers."""
    scenario = api.loaded("grid7_peak", demand=0.8)
    network = read_links(links_file(scenario))
    choices = Choices(chain_limit=0.0)
    model = LinkModel(network, STEP_S, choices=choices, dtype=torch.float64)
    demand = torch.as_tensor(scenario.demand)

    def spent(numbers):
        gates = torch.ones(len(numbers), 7, 7, dtype=torch.float64)
        gates = gates.index_fill(2, torch.tensor([3]), 0.0)
        gates = gates + torch.eye(7)[3].double() * numbers[:, 7, None, None]
        prices = torch.eye(7)[3].double() * numbers[:, 8:9]
        state = model.start(len(numbers))
        for k in range(20):
            due = demand[k].expand(len(numbers), 7, 7)
            state = model.advance(state, due, Commands(gates, numbers[:, :7], None, prices))
        return state.spent

    numbers = torch.tensor([[0.3, 0.3, 0.25, 0.3, 0.25, 0.3, 0.3, 0.5, 0.5]]).double()
    numbers.requires_grad_()
    (gradient,) = torch.autograd.grad(spent(numbers).sum(), numbers)
    change = 1e-5 * torch.eye(9, dtype=torch.float64)
    with torch.no_grad():
        up, down = spent(torch.cat([numbers + change, numbers - change])).chunk(2)
    differences = (up - down) / 2e-5
    torch.testing.assert_close(gradient[0], differences, rtol=1e-3, atol=0.0)


def spent_and_slope(model, chance):
    """Time spent by two rollouts under all commands, and its derivative by the demand."""
    device = model.flows.device
    rate = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    commands = [part.to(device) for part in all_commands(price=2.0)]
    state = model.start(2, [3, 4], chance=chance)
    for _ in range(2):
        demand = torch.cat([demand_of(rate), demand_of(rate)]).to(device)
        state = model.advance(state, demand, Commands(*commands))
    spent = state.spent.sum()
    return spent.cpu(), *torch.autograd.grad(spent, rate)


def copied(parts):
    """Tensors as copies, and all others."""
    return [part.detach().clone() if isinstance(part, torch.Tensor) else part for part in parts]


class FakeGraph(NamedTuple):
    """Stands in for a CUDA graph, by running what it would have recorded."""

    run: Any
    own: list
    after: list

    def replay(self):
        for place, part in zip(self.after, self.run(self.own)[0], strict=True):
            if isinstance(place, torch.Tensor):
                place.copy_(part.detach())

    @classmethod
    def record(cls, run, given):
        own = copied(given)
        after, kind = run(own)
        after = copied(after)
        return own, cls(run, own, after), after, kind


@pytest.mark.parametrize("signals", [{}, {"signals": "max-pressure"}, ACTUATED])
@pytest.mark.parametrize("chance", [False, True])
def test_machine_code_gives_what_the_reference_gives(signals, chance):
    """Time spent by two rollouts, accumulations and backlog, and derivatives by all commands."""
    plain, machine = (
        judged_with_derivatives(model_of(compiled=compiled, **signals), chance)
        for compiled in (False, True)
    )
    torch.testing.assert_close(machine, plain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("beside", [True, False])
def test_machine_code_shows_overdue_stages_as_the_reference_does(beside):
    network = three_stages(beside=beside)
    plain, machine = (
        rollout(model_of(network, compiled=compiled, signals="max-pressure"), 0.9)[-1]
        for compiled in (False, True)
    )
    assert float(machine.spent[0]) == pytest.approx(float(plain.spent[0]), rel=1e-9)
    torch.testing.assert_close(machine.stages.red, plain.stages.red)


def judged_with_derivatives(model, chance):
    """Numbers of a busy city (5,), and the derivatives of their weighted sum by the commands."""
    commands = Commands(*(part.requires_grad_() for part in all_commands(price=2.0)))
    state = model.start(2, [3, 4], chance=chance)
    rate = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    for _ in range(5):
        state = model.advance(state, torch.cat([demand_of(rate)] * 2), commands)
    parts = [state.spent, model.accumulation(state), model.backlog(state), state.realised]
    parts.append(state.gone)
    judged = torch.stack([part.square().sum() for part in parts])
    weights = torch.tensor([1e-6, 1.0, 1.0, 1.0, 1.0], dtype=torch.float64)
    by = (rate, commands.gates, commands.metering, commands.prices)
    return judged.detach(), *torch.autograd.grad((weights * judged).sum(), by)


@pytest.mark.parametrize("signals", [{}, {"signals": "max-pressure"}, ACTUATED])
def test_recordings_give_the_same(signals, monkeypatch):
    model = model_of(compiled=False, **signals)
    plain = spent_and_slope(model, chance=True)
    monkeypatch.setattr(Recordings, "_record", FakeGraph.record)
    model._play = Recordings().play
    for _ in range(2):
        torch.testing.assert_close(spent_and_slope(model, chance=True), plain, rtol=0.0, atol=0.0)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("signals", [{}, {"signals": "max-pressure"}, ACTUATED])
def test_a_gpu_gives_the_same(signals):
    plain = spent_and_slope(model_of(**signals), chance=False)
    model = model_of(device="cuda", **signals)
    for _ in range(2):
        torch.testing.assert_close(spent_and_slope(model, chance=False), plain)


def test_a_batch_gives_what_single_rollouts_give():
    model = model_of()
    rates = torch.tensor([0.2, 0.9], dtype=torch.float64)
    demand = torch.cat([demand_of(rate) for rate in rates])
    state = model.start(2)
    for _ in range(4):
        state = model.advance(state, demand, Commands())
    for number, rate in enumerate((0.2, 0.9)):
        alone = rollout(model, rate, intervals=4)[-1]
        assert float(state.spent[number]) == pytest.approx(float(alone.spent[0]), rel=1e-12)


@pytest.mark.parametrize("name", ["pi-gating", "dpc-pcrg"])
def test_controllers_run_on_streets(name):
    result = api.run("grid7_peak", name, plant="links", steps=4)
    assert result.data.attrs["plant"] == "links"
    assert np.isfinite(result.total_time_spent)
    assert result.total_time_spent > 0.0


def test_the_same_seed_gives_the_same_run_and_another_one_other_routes():
    first, again, other = (
        api.run("grid7_peak", "no-control", plant="links", steps=4, seed=seed) for seed in (0, 0, 1)
    )
    assert np.array_equal(first["accumulation"], again["accumulation"])
    assert not np.array_equal(first["accumulation"], other["accumulation"])


@pytest.mark.parametrize(
    "key, value", [("signals", "webster"), ("metering", 1.2), ("measurement", "estimate")]
)
def test_what_streets_have_not_is_refused(key, value):
    scenario = api.load_scenario("grid7_peak", {f"sumo.{key}": value})
    with pytest.raises(InputError, match=f"sumo.{key}"):
        LinkPlant(scenario)


def test_words_of_a_strategy_change_streets():
    choices = choices_of(api.load_scenario("grid7_peak"), ["max-pressure", "rerouting-30"])
    assert choices.signals == "max-pressure"
    assert choices.rerouting == pytest.approx(0.3)
    alone = choices_of(api.load_scenario("grid7_peak"), ["actuated"], gated=False)
    assert alone.signals == "actuated"
    assert not alone.gateways_fixed
    by_word = api.run("grid7_peak", "no-control+max-pressure", plant="links", steps=4)
    changed = api.load_scenario("grid7_peak", {"sumo.signals": "max-pressure"})
    by_setting = api.run(changed, "no-control", plant="links", steps=4)
    fixed = api.run("grid7_peak", "no-control", plant="links", steps=4)
    assert np.array_equal(by_word["accumulation"], by_setting["accumulation"])
    assert not np.array_equal(by_word["accumulation"], fixed["accumulation"])


def test_a_word_that_streets_do_not_know_is_refused():
    with pytest.raises(InputError, match=r"\+planned: streets .*max-pressure.*rerouting-30"):
        api.run("grid7_peak", "no-control+planned", plant="links")


def test_streets_meter_as_commanded_only():
    with pytest.raises(InputError, match="pi-gating commands no rates; omit .metering"):
        api.run("grid7_peak", "pi-gating+metering", plant="links", steps=1)
    name = "pricing-rule+max-pressure+guidance-period-60+metering"
    assert api.run("grid7_peak", name, plant="links", steps=1).controller == name


def test_signals_that_choose_need_signals():
    scenario = api.load_scenario("grid7_peak", {"sumo.signals": "actuated"})
    network = read_links(links_file(scenario))
    none = replace(network, stages=network.stages[:0])
    with pytest.raises(InputError, match="sumo.signals: actuated needs signals"):
        LinkPlant(scenario, network=none)


def test_trips_may_begin_elsewhere_in_every_period():
    """No street has trips in both periods, but both have trips."""
    scenario = api.load_scenario("grid7_peak")
    network = read_links(links_file(scenario))
    half = np.arange(len(network.entry_link)) % 2
    every = network.origin.max(axis=0)
    origin = np.array([every * (half == 0), every * (half == 1)])
    rows = {name: getattr(network, name)[:1].repeat(2, axis=0) for name in ("ending", "cell_share")}
    LinkPlant(scenario, network=replace(network, periods=2, origin=origin, **rows))
    with pytest.raises(InputError, match="no route leads from region 0 to region 1"):
        LinkPlant(scenario, network=replace(network, origin=np.zeros_like(network.origin)))


def test_a_missing_file_names_the_command():
    failed = nmfd_command("benchmark economic_mpc --plant links --controllers greedy")
    assert "write it with 'cosim links'" in error_line(failed, "nmfd")


def test_a_file_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "links.npz"
    path.write_text("no network")
    with pytest.raises(InputError, match="is no network of links"):
        read_links(path)


@pytest.mark.slow
def test_the_benchmark_takes_streets(tmp_path):
    out = tmp_path / "runs"
    words = "--plant links --controllers no-control --steps 1 --out"
    printed = good(nmfd_command("benchmark grid7_peak", words, out))
    assert "no-control" in printed


def test_training_through_streets_finds_what_holds_trips_for_nothing(tmp_path):
    """The triangle flows, and metering at a fiftieth of the critical accumulation holds trips."""
    network = tiny.NETWORK.format(name="triangle")
    for region, others in enumerate(([1, 2], [0, 2], [0, 1])):
        network += tiny.REGION.format(position=region, adjacent=others)
    folder = tiny.write(tmp_path, network=network)
    triangle().write(folder / "links.npz")
    options = {"compact": True, "metering": True, "learning_rate": 0.01}
    numbers = list(Numbers(metering=0.02, metering_slope=1.0))
    table = {f"controllers.dpc-pc.{name}": value for name, value in options.items()}
    kept = [name for name in Numbers._fields if not name.startswith("metering")]
    table |= {"controllers.dpc-pc.numbers": numbers, "controllers.dpc-pc.kept": kept}
    scenario = api.loaded(api.load_scenario(folder, table), steps=8)
    out = tmp_path / "policy.pt"
    api.train(scenario, "dpc-pc", plant="links", steps=2, out=out)
    file = read_policy(out)
    assert file["configuration"]["plant"] == "links"
    trained = Numbers(*file["weights"]["numbers"].tolist())
    assert trained.metering > 0.02


def test_the_costate_of_a_vehicle_is_bounded():
    vehicles_before = torch.ones(1, 1, requires_grad=True)
    held = 1.0 * vehicles_before
    bound = Bound()
    bound.hold((held,))
    states = torch.stack([held.detach(), -1e9 * held]).unsqueeze(-1)
    bound.measure(states)
    (3.0 * states.sum()).backward()
    assert vehicles_before.grad.item() == pytest.approx(-3.0 * 2 * MOST_DELAYED)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The streets of the demo city, and the file that has them."""
    path = tmp_path_factory.mktemp("links") / "links.npz"
    scenario = api.load_scenario("demo")
    write_links(scenario, path, seeds=[1, 2])
    return link_network(scenario, seeds=[1, 2]), path


def test_a_city_is_written_and_read(written):
    network, path = written
    again = vars(read_links(path))
    for name, value in vars(network).items():
        assert np.array_equal(value, again[name]), name


def test_each_stage_of_an_actuated_city_has_a_detector(written):
    network, _ = written
    extended = np.flatnonzero(network.phase_least < network.phase_most)
    assert set(extended) <= set(network.detecting)
    assert (network.phase_least.ravel()[extended] == LEAST_S).all()
    assert (network.phase_most[network.phase_least == 3.0] == 3.0).all()  # yellow
    assert network.detector[network.detected].max() == pytest.approx((5 / 1.9 + 0.5) * 7.5)


def test_a_detector_extends_the_phases_in_which_its_whole_lane_is_green():
    """Lane a1 turns left; b turns left beside a movement with the right of way; a0 leads to b."""
    states = ("GgGg", "rGrr", "Grrr")
    phases = tuple(Phase(duration=20.0, state=state) for state in states)
    signal = Signal(id="s", offset="0", phases=phases, links=())

    def lane(source, number, target, *links):
        rest = {"via": None, "signal": "s", "to_lane": 0, "state": "o"}
        return [
            Connection(source=source, target=target, link=link, lane=number, **rest)
            for link in links
        ]

    lanes = {("a", 0): lane("a", 0, "b", 0), ("a", 1): lane("a", 1, "c", 1)}
    lanes["b", 0] = lane("b", 0, "d", 2, 3)
    city = SimpleNamespace(lanes={"a": 2, "b": 2})
    found = {one: link_phases._extended(signal, one, lanes, city) for one in lanes}
    assert found == {("a", 0): {0}, ("a", 1): {1}, ("b", 0): {0}}


def test_shares_of_a_city_sum_to_one(written):
    network, _ = written
    for share in network.cell_share:
        leaving = np.bincount(network.cell_entry, share)
        assert np.allclose(leaving[leaving > 0.0], 1.0)


def test_each_street_has_room_and_a_lane(written):
    network, _ = written
    assert np.array_equal(np.unique(network.lane_link), np.arange(len(network.length)))
    assert (network.free_time > 0.0).all()


def test_machine_code_that_cannot_be_kept_is_made_anew(monkeypatch):
    """As where no folder may be written."""
    monkeypatch.setattr("numba.core.caching.CacheImpl._locator_classes", [])
    assert compiled(lambda number: 2 * number)(21) == 42
