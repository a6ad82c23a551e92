"""Signals that SUMO actuates: held back and rationed, with yellow and minimum green; untouched where nothing is held."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny_city
from commands import cosim
from signal_rules import MIN_GREEN, check

from cosim.plant.plant import SumoPlant
from cosim.plant.settings import settings
from cosim.sumo.net import gateway_movements
from nmfd.api import load_scenario
from nmfd.types import Controls

KINDS = ("actuated", "delay_based")
CONFIG = """<configuration>
  <input><net-file value="city.net.xml"/><route-files value="cars.rou.xml"/></input><time><end value="450"/></time>
</configuration>"""
CARS = """<routes>
  <flow id="east" begin="0" end="450" period="3" from="A1B1" to="C1D1"/>
  <flow id="west" begin="0" end="450" period="4" from="D2C2" to="B2A2"/>
  <flow id="down" begin="0" end="450" period="5" from="B3B2" to="B1B0"/>
  <flow id="up" begin="0" end="450" period="6" from="C0C1" to="C2C3"/>
</routes>"""


@pytest.fixture(scope="module", params=KINDS)
def town(request, tmp_path_factory):
    """The kind and the folder of a city whose signals are all of it; two regions, left and right."""
    folder = tmp_path_factory.mktemp(request.param)
    tiny_city.network(folder, "--tls.set", "B1,B2,C1,C2", "--tls.default-type", request.param)
    (folder / "cars.rou.xml").write_text(CARS)
    (folder / "city.sumocfg").write_text(CONFIG)
    done = cosim("import", folder / "city.sumocfg", "--regions", 2, "--method", "geometric", "--no-run", "--out",
                 folder / "networks" / "town")
    assert done.exit_code == 0, done.output + str(done.exception)
    return request.param, folder


def drive(folder, gates, **overrides):
    """States of every signal second by second, the programmes, the record, leaks; gates: u of every interval."""
    scenario = replace(load_scenario(folder / "scenarios" / "town"), steps=len(gates))
    plant = SumoPlant(scenario, overrides=settings(scenario).changed(**overrides))
    try:
        plant.reset(1)
        session, shown, step = plant.session, {}, plant.session.step
        plans = {name: session.programme(name) for name in session.signals()}

        def watch():
            step()
            for name in plans:
                shown.setdefault(name, []).append(session.signal_state(name))

        session.step = watch
        for gate in gates:
            plant.step(Controls(perimeter=np.where(scenario.network.adjacency, gate, 0.0), splits=None))
        plans |= {signal.id: signal for signal in plant.simple_signals}
        own = {name: session.programme_id(name) for name in plans}
        return shown, plans, plant.record(), plant.leaks(), own, gateway_movements(plant.city)
    finally:
        plant.close()


def test_gateways_of_actuated_signals_are_controlled(town):
    """The table tells them from fixed ones and from missing ones."""
    kind, folder = town
    gateways = pd.read_csv(folder / "networks" / "town" / "gateways.csv", keep_default_na=False)
    assert set(zip(gateways.control, gateways.kind, strict=True)) >= {("controlled", kind)}
    assert set(gateways.kind[gateways.control == "no signal"]) <= {""}


def test_held_back_safely(town):
    """Less flow at u_min, the green rationed; never red without yellow; given back to SUMO afterwards."""
    _, folder = town
    opened = drive(folder, [0.9] * 5)
    held = drive(folder, [0.1] * 5)
    assert not held[3] or all(gateway.signal is None for gateway in held[3])
    flows = [record.gateway_flow.sum() for _, _, record, *_ in (opened, held)]
    assert flows[1] < 0.7 * flows[0]
    for shown, plans, _, _, _, gates in (opened, held):
        for name, states in shown.items():
            check(states, [(phase.state, phase.duration) for phase in plans[name].phases])
            assert name not in gates or len(states[0]) > max(gates[name])
    green = held[2].gateway_green
    reached = ~np.isnan(green[0])
    assert np.nanmax(green[1:, reached]) <= 2 * MIN_GREEN + 1.0
    back = drive(folder, [0.9, 0.1, 0.5, 0.7, 0.9, 0.9])
    assert all(programme == "0" for programme in back[4].values())
    assert (back[2].gateway_green[-1, reached] > 2 * MIN_GREEN).all()
    for name, states in back[0].items():
        check(states, [(phase.state, phase.duration) for phase in back[1][name].phases])


def test_open_gates_leave_sumo_s_own_signals_to_the_byte(town, monkeypatch):
    """As if there were no gateway signal at all."""
    _, folder = town
    opened = drive(folder, [0.9] * 5)
    names = tuple(gateway for gateway in opened[1])
    alone = drive(folder, [0.9] * 5, leave_signals=names)
    assert opened[0] == alone[0] and (opened[2].edge_vehicles == alone[2].edge_vehicles).all()
    assert np.isnan(alone[2].gateway_green).all() and not np.isnan(opened[2].gateway_green).all()


@pytest.mark.parametrize("signals", ["max-pressure", "max-pressure-cyclic"])
def test_rationed_under_max_pressure(town, signals):
    _, folder = town
    seen = {}
    for gate in (0.9, 0.1):
        shown, plans, record, leaks, _, _ = drive(folder, [gate] * 5, signals=signals)
        for name, states in shown.items():
            check(states, [(phase.state, phase.duration) for phase in plans[name].phases])
        seen[gate] = record.gateway_flow.sum()
        assert all(gateway.signal is None for gateway in leaks)
    assert seen[0.1] < 0.7 * seen[0.9]


REFUSED = {
    "max-pressure": "max-pressure counts vehicles lane by lane",
    "pi-gating+max-pressure-cyclic": "max-pressure-cyclic counts vehicles lane by lane",
    "route-guidance+estimate": "needs loop detectors on lanes"}


@pytest.fixture(scope="module")
def queues(town, tmp_path_factory):
    """The city of `town` in SUMO's queue model, and a city without any signal."""
    made = {}
    for name, options, given in (("queues", ("--mesoscopic",), town[1]), ("bare", (), None)):
        folder = given or tmp_path_factory.mktemp(name)
        if given is None:
            tiny_city.network(folder, "--default-junction-type", "priority")
            (folder / "cars.rou.xml").write_text(CARS)
            (folder / "city.sumocfg").write_text(CONFIG)
        done = cosim("import", folder / "city.sumocfg", "--regions", 2, "--method", "geometric", "--no-run", "--out",
                     folder / "networks" / name, *options)
        assert done.exit_code == 0, done.output + str(done.exception)
        made[name] = folder / "scenarios" / name
    return made


@pytest.mark.parametrize("command", ["run", "evaluate", "sweep"])
@pytest.mark.parametrize("name, city", [*((name, "queues") for name in REFUSED), ("pi-gating", "bare"), ("mine", "queues")])
def test_what_cannot_run_here_is_refused_before_the_first_run(queues, tmp_path, command, name, city):
    """One line that names it, though another strategy comes first; nothing is written."""
    if name == "mine":
        (tmp_path / "mine.py").write_text(
            "class Mine:\n    def __init__(self, scenario):\n        pass\n    def reset(self, *a, **k):\n        pass\n"
            "    def act(self, observation, *a):\n        return None\n")
        name = f"{tmp_path / 'mine.py'}:Mine+max-pressure"
    names = (("--controllers", f"no-control,{name}") if command != "run" else
             ("--controller", "no-control", "--against", name))
    done = cosim(command, queues[city], *names, "--steps", 1, "--out", tmp_path / "out")
    assert done.exit_code != 0 and len(done.stderr.strip().splitlines()) == 1
    assert f"controller {name} cannot" in done.stderr
    assert REFUSED.get(name, "lane by lane" if city == "queues" else "none of the") in done.stderr
    assert not (tmp_path / "out").exists()
