"""Signal plans: max-pressure, actuated and optimised fixed time. Known answers, and states second
by second in SUMO."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import libsumo
import numpy as np
import pytest
import tiny
from signal_rules import watched

from cosim.plant.pressure import Roads
from cosim.sumo.signals import read_signals
from cosim.sumo.trips import make_trips, turning_flows
from nmfd.api import load_scenario
from nmfd.types import Controls


@pytest.fixture(scope="module")
def scenario():
    """The beginning of the peak, where the demand already flows."""
    return tiny.part(load_scenario("grid7_peak"), 14, 3)


def test_signals_of_the_city(city):
    simple, others = read_signals(city)
    assert len(simple) > 90
    assert not others
    for found in simple:
        assert sum(phase.duration for phase in found.phases) == 90
        assert {link.index for link in found.links} == set(range(len(found.phases[0].state)))


def test_signals_that_are_not_simple_are_left_alone(city, tmp_path):
    """Of several programmes the last counts, in additional files too."""
    text = city.net_file.read_text()
    text = text.replace('<tlLogic id="c11" type="static"', '<tlLogic id="c11" type="actuated"')
    begin = text.index('<tlLogic id="c12"')
    end = text.index("</tlLogic>", begin) + len("</tlLogic>")
    night = text[begin:end].replace('programID="0"', 'programID="night"')
    text = text[:end] + night.replace('type="static"', 'type="delay_based"') + text[end:]
    (tmp_path / "net.xml").write_text(text)
    changed = replace(city, net_file=tmp_path / "net.xml")
    simple, others = read_signals(changed)
    assert others == {"c11": "actuated signal", "c12": "delay_based signal"}
    assert not {"c11", "c12"} & {s.id for s in simple}
    last = night.replace("night", "last").replace('offset="0"', 'offset="7"')
    (tmp_path / "more.add.xml").write_text(f"<additional>{last}</additional>")
    simple, others = read_signals(changed, [tmp_path / "more.add.xml"])
    assert others == {"c11": "actuated signal"}
    assert [s.offset for s in simple if s.id == "c12"] == ["7"]


def test_pressure_is_upstream_minus_downstream(city, scenario):
    """A queue gives its stage the pressure; the same queue behind the junction takes it away;
    shares add up."""
    simple, _ = read_signals(city)
    roads = Roads(city, simple, turning_flows(city, scenario.demand, scenario.step))
    n = next(n for n, s in enumerate(simple) if s.id == "o11")
    chosen = simple[n]
    straight = next(k for k in chosen.links if chosen.phases[0].state[k.index] == "G")

    def pressures(counts):
        present = np.array([counts.get(lane.rpartition("_")[0], 0.0) for lane in roads.lanes])
        begin = roads.begins[n]
        return (roads.gain @ np.maximum(roads.weights @ present, 0.0))[
            begin : begin + len(chosen.stages)
        ]

    queue = pressures({straight.from_edge: 5.0})
    assert int(np.argmax(queue)) == 0
    assert queue[0] > 5.0
    targets = {k.to_edge: 25.0 for k in chosen.links if k.from_edge == straight.from_edge}
    assert pressures({straight.from_edge: 5.0, **targets})[0] < 0.2 * queue[0]
    held = (
        roads.weights.toarray().clip(min=0.0).sum(axis=0)
    )  # a vehicle before a signal is counted once
    before = [lane for lane, total in zip(roads.lanes, held, strict=True) if total > 0]
    assert len(before) > 300
    assert held[held > 0] == pytest.approx(1.0)


def test_max_pressure_runs_all_signals(city, scenario, plant_of):
    plant = plant_of(signals="max-pressure")
    plant.reset(1)
    shown = watched(plant)
    for _ in range(2):
        plant.step(Controls(perimeter=scenario.network.open_perimeter))
    gateways, changed = {g.signal for g in city.gateways}, set()
    for signal in plant.steered:
        cycle = [phase.state for phase in signal.phases for _ in range(int(phase.duration))]
        states = shown[signal.id]
        if states != [cycle[n % 90] for n in range(len(states))]:
            changed.add(signal.id)
    assert len(changed) > 30
    assert len(changed & gateways) > 10
    assert not np.isnan(plant.record()["gateway_green"]).any()
    assert not plant.actuation.leaks()


@pytest.mark.parametrize("gateways_fixed", [True, False])
def test_actuated_signals(plant_of, gateways_fixed):
    plant = plant_of(signals="actuated", gateways_fixed=gateways_fixed)
    plant.reset(1)
    gateways = {g.signal for g in plant.city.gateways}
    static = {name for name in plant.session.signals() if plant.session.programme(name).static}
    assert static == (gateways if gateways_fixed else set())


@pytest.mark.slow
def test_webster_in_sumo(scenario, plant_of):
    """SUMO runs the plan with its offsets; open gateways show it unchanged."""
    plant = plant_of(signals="webster")
    plant.reset(1)
    plans = {name: plant.session.programme(name) for name in plant.session.signals()}
    command = plant.session.command
    offsets = command[command.index("--additional-files") + 1].split(",")[1]
    for logic in ElementTree.parse(offsets).getroot():  # a later offset is a later beginning
        programme = plans[logic.get("id")]
        assert programme.position == pytest.approx(-float(logic.get("offset")) % programme.cycle)
    shown = watched(plant)
    plant.step(Controls(perimeter=scenario.network.open_perimeter))
    assert len({p.cycle for p in plans.values()}) == 1
    assert len({p.position for p in plans.values()}) > 5
    for name, states in shown.items():
        cycle = [p.state for p in plans[name].phases for _ in range(round(p.duration))]
        begin = round(plans[name].position)
        assert states == [cycle[(begin + n) % len(cycle)] for n in range(len(states))], name


@pytest.mark.slow
def test_the_same_drivers_reroute(scenario, plant_of):
    """Equipment follows from the seed, whatever the signals do; more drivers include the fewer."""
    equipped = {}
    for share, signals in ((0.3, "fixed"), (0.3, "max-pressure"), (0.6, "fixed")):
        plant = plant_of(rerouting=share, signals=signals)
        plant.reset(5)
        planned = make_trips(plant.city, scenario.demand, scenario.step, 5).routes
        seen = {}
        step = plant.session.step

        def watch(plant=plant, step=step, seen=seen, planned=planned):
            step()
            for vehicle in plant.session.departed():
                own = plant.session.route(vehicle) == planned[int(vehicle[1:])]
                seen[vehicle] = (
                    libsumo.vehicle.getParameter(vehicle, "has.rerouting.device") == "true",
                    own,
                )

        plant.session.step = watch
        plant.step(Controls(perimeter=np.full((7, 7), 0.9)))
        equipped[share, signals] = {v for v, (reroutes, _) in seen.items() if reroutes}
        assert all(own for reroutes, own in seen.values() if not reroutes)
        assert (
            sum(not own for reroutes, own in seen.values() if reroutes) > 10
        )  # on the fastest way from the start
        assert abs(len(equipped[share, signals]) / len(seen) - share) < 0.15
        plant.close()
    assert equipped[0.3, "fixed"] == equipped[0.3, "max-pressure"] < equipped[0.6, "fixed"]
