"""Signals that SUMO actuates: held back and rationed, with yellow and minimum green; untouched
elsewhere."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import tiny
import tiny_city
from commands import cosim
from signal_rules import MIN_GREEN, watched

from cosim.importing.importer import import_city
from cosim.plant.gates import DEFAULT_YELLOW_S
from nmfd.api import load_scenario
from nmfd.model.scenario import with_demand

CONFIG = """<configuration>
  <input><net-file value="city.net.xml"/><route-files value="cars.rou.xml"/></input>
  <time><end value="450"/></time>
</configuration>"""
CARS = """<routes>
  <flow id="east" begin="0" end="450" period="3" from="A1B1" to="C1D1"/>
  <flow id="west" begin="0" end="450" period="4" from="D2C2" to="B2A2"/>
  <flow id="down" begin="0" end="450" period="5" from="B3B2" to="B1B0"/>
  <flow id="up" begin="0" end="450" period="6" from="C0C1" to="C2C3"/>
</routes>"""


def imported(folder, name, *, signals, **options):
    """The scenario of a city of two regions, left and right."""
    folder.mkdir()
    tiny_city.network(folder, *signals)
    (folder / "cars.rou.xml").write_text(CARS)
    (folder / "city.sumocfg").write_text(CONFIG)
    out = folder / "networks" / name
    import_city(folder / "city.sumocfg", out, regions=2, seeds=1, **options)
    return folder / "scenarios" / name


@pytest.fixture(
    scope="module", params=("actuated", pytest.param("delay_based", marks=pytest.mark.slow))
)
def town(request, tmp_path_factory):
    """The kind of all signals, and the scenario."""
    return request.param, imported(
        tmp_path_factory.mktemp("town") / request.param,
        "town",
        signals=(f"--tls.set B1,B2,C1,C2 --tls.default-type {request.param}",),
    )


@pytest.fixture(scope="module")
def opened(town):
    """A run with open gates, in which SUMO does all by itself."""
    return drive(town[1], [0.9] * 4)


def drive(folder, gates, faults=(), **overrides):
    """A run under u = gates[k] in interval k: what every signal shows second by second, and
    more."""
    scenario = replace(with_demand(load_scenario(folder), steps=len(gates)), faults=tuple(faults))
    with tiny_city.plant_of(scenario, **({"chain_limit": 0.0} | overrides)) as plant:
        plant.reset(1)
        shown = watched(plant)
        for gate in gates:
            plant.step(tiny.gates_at(scenario, gate))
        return SimpleNamespace(
            shown=shown,
            record=SimpleNamespace(**plant.record()),
            leaks=plant.actuation.leaks(),
            gateways=plant.city.gateways,
            programmes={name: plant.session.programme_id(name) for name in shown},
        )


def test_gateways_of_actuated_signals_are_controlled(town):
    """The table tells them from fixed ones and from missing ones."""
    kind, scenario = town
    gateways = pd.read_csv(
        scenario.parents[1] / "networks" / "town" / "gateways.csv", keep_default_na=False
    )
    assert set(zip(gateways.control, gateways.kind, strict=True)) == {
        ("controlled", kind),
        ("no signal", ""),
    }


def test_held_back(town, opened):
    """Less flow at u_min, and the minimum green; given back to SUMO afterwards."""
    run = drive(town[1], [0.1, 0.1, 0.5, 0.9, 0.9, 0.9])
    assert run.leaks
    assert all(gateway.signal is None for gateway in run.leaks)
    reached = ~np.isnan(run.record.gateway_green[0])
    green, free = run.record.gateway_green[:, reached], opened.record.gateway_green[:, reached]
    assert (green[1] <= MIN_GREEN + 1.0).all()
    assert (free[1] > 2 * MIN_GREEN).all()
    assert (green[2] > MIN_GREEN + 1.0).any()
    assert (green[-1] > MIN_GREEN + 1.0).all()
    assert run.record.gateway_flow[1].sum() < 0.5 * opened.record.gateway_flow[1].sum()
    assert set(run.programmes.values()) == {
        "0"
    }  # not "online", as signals that are told their states


def test_open_gates_leave_sumo_s_own_signals_to_the_byte(town, opened):
    """As if no gateway signal could be held."""
    alone = drive(town[1], [0.9] * 4, leave_signals=tuple(opened.shown))
    assert opened.shown == alone.shown
    assert (opened.record.edge_vehicles == alone.record.edge_vehicles).all()
    assert np.isnan(alone.record.gateway_green).all()
    assert not np.isnan(opened.record.gateway_green).all()


@pytest.mark.parametrize("signals", ["fixed", "max-pressure"])
def test_the_share_of_ungated_green(town, signals):
    """An open gate shows all green that SUMO or max-pressure gives it, however little that is."""
    for gates, least, most in ((0.9, 1.0, 1.0), (0.1, 0.0, 0.5)):
        record = drive(town[1], [gates] * 3, signals=signals).record
        shown, ungated = record.gateway_green[1:], record.gateway_original_green[1:]
        given = ungated > 0.0
        assert given.any()
        assert (shown[given] <= ungated[given]).all()
        assert least <= shown[given].sum() / ungated[given].sum() <= most


def test_rationed_under_max_pressure(town, opened):
    """Max-pressure runs their stages, and closed gateways let less through."""
    run = drive(town[1], [0.1] * 3, signals="max-pressure")
    assert run.record.gateway_flow[1:3].sum() < 0.6 * opened.record.gateway_flow[1:3].sum()
    assert all(gateway.signal is None for gateway in run.leaks)


def test_a_deaf_signal_runs_its_own_programme_and_can_be_held_again(town):
    """Green to red by way of yellow all the time."""
    run = drive(town[1], [0.1, 0.1, 0.1], faults=("signal:B2@1-2",))
    assert not any(
        a in "Gg" and b == "r"
        for before, after in pairwise(run.shown["B2"])
        for a, b in zip(before, after, strict=True)
    )
    own = [n for n, gateway in enumerate(run.gateways) if gateway.signal == "B2"]
    green = run.record.gateway_green[:, own]
    assert (green[[0, 2]] <= MIN_GREEN + 1.0).all()
    assert (green[1] >= 2 * MIN_GREEN).all()
    interval = len(run.shown["B2"]) // 3
    deaf = run.shown["B2"][interval : 2 * interval]
    for n, seconds in zip(own, green[1], strict=True):
        lights = [state[run.gateways[n].links[0]] for state in deaf]
        shown = sum(light in "Gg" for light in lights)
        assert seconds == pytest.approx(shown, abs=DEFAULT_YELLOW_S)  # of the change


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Scenarios: a city in SUMO's queue model, and one without any signal."""
    folder, made = tmp_path_factory.mktemp("places"), {}
    for name, signals, options in (
        ("queues", ("--tls.set", "B1,B2"), {"mesoscopic": True}),
        ("bare", ("--default-junction-type priority",), {}),
    ):
        made[name] = imported(folder / name, name, signals=signals, **options)
    return made


@pytest.mark.parametrize(
    "command, name, city, said",
    [
        ("run", "max-pressure", "queues", "max-pressure counts vehicles lane by lane"),
        ("evaluate", "route-guidance+estimate", "queues", "needs loop detectors on lanes"),
        ("evaluate", "mine.py:Mine+max-pressure", "queues", "counts vehicles lane by lane"),
        ("run", "webster", "bare", "webster needs fixed-time signals"),
        ("evaluate", "pi-gating+max-pressure", "bare", "max-pressure needs signals"),
    ],
)
def test_what_cannot_run_here_is_refused_before_the_first_run(
    places, tmp_path, monkeypatch, command, name, city, said
):
    """One line that names it, though another strategy comes first; nothing is written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(tiny.CONTROLLER)
    names = f"--controllers no-control,{name}"
    if command == "run":
        names = f"--controller no-control --against {name}"
    done = cosim(command, places[city], names, "--steps 1 --out out")
    assert done.exit_code != 0
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert f"controller {name} cannot run here: " in done.stderr
    assert said in done.stderr
    assert not (tmp_path / "out").exists()
