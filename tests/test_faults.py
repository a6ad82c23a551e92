"""Faults of sensors, streets and signals: their effect, the status of the decisions under them, and
wrong ones."""

import itertools
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import tiny_city
from commands import call, error_line

import nmfd
from cosim.plant.gates import DEFAULT_YELLOW_S
from cosim.sumo.net import city_of
from nmfd import faults
from nmfd.api import load_scenario
from nmfd.controllers.rules import Constant
from nmfd.errors import InputError
from nmfd.types import Controls

STEPS = 8


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    """Two regions, the second one congested."""
    text = tiny.SCENARIO.replace("peak = 2.0", "peak = 4.0").replace(
        "measurement_std = 0.5", "measurement_std = 0.0"
    )
    return load_scenario(tiny.write(tmp_path_factory.mktemp("tiny"), scenario=text))


class Diary(Constant):
    """No control that keeps its observations."""

    def __init__(self, scenario):
        super().__init__("diary", Controls(perimeter=scenario.network.open_perimeter))
        self.seen = []

    def act(self, measurement):
        self.seen.append(measurement)
        return super().act(measurement)


def driven(scenario, *ordered):
    """Exact accumulations (T, 2, 2), observed ones, and notes of a run with these faults."""
    diary = Diary(scenario)
    result = nmfd.run(replace(scenario, faults=ordered), diary)
    assert [m.step for m in diary.seen] == list(range(scenario.steps))
    return (
        result["accumulation"][:-1],
        np.stack([m.accumulation for m in diary.seen]),
        result["note"],
    )


def check_notes(notes, begin, end, text):
    assert [k for k, note in enumerate(notes) if note] == list(range(begin, end))
    assert set(notes[begin:end]) == {text}


def test_frozen_measurements(scenario):
    exact, seen, notes = driven(scenario, "frozen@6-12")
    assert (seen[6:12] == exact[6]).all()
    assert (seen[12:] == exact[12:]).all()
    assert (seen[:6] == exact[:6]).all()
    assert (exact[6] != exact[11]).any()
    check_notes(notes, 6, 12, "measurement frozen")


def test_delayed_measurements(scenario):
    exact, seen, notes = driven(scenario, "delayed:3@5-20")
    assert (seen[5:] == exact[2:-3]).all()
    assert (seen[:5] == exact[:5]).all()
    check_notes(notes, 5, 20, "measurement 3 intervals late")


def test_a_region_without_measurements(scenario):
    exact, seen, notes = driven(scenario, "missing:0@4-10")
    assert (seen[4:10, 0] == exact[3, 0]).all()
    assert (seen[4:10, 1] == exact[4:10, 1]).all()
    check_notes(notes, 4, 10, "measurement 2 of 4 entries missing, last ones used")


class Mad(Constant):
    """A controller of which one number is not finite in interval 3."""

    def act(self, measurement):
        shapes = {"perimeter": (2, 2), "splits": (2, 2, 2), "prices": (2,), "metering": (2,)}
        arrays = {
            "perimeter": np.full((2, 2), 0.5),
            "splits": None,
        }
        arrays[self.wrong] = np.full(shapes[self.wrong], 0.5)
        if self.wrong == "splits":
            arrays["splits"] = self.splits.copy()
        if measurement.step == 3:
            arrays[self.wrong][self.at] = self.value
        return Controls(**arrays)


@pytest.mark.parametrize("plant", ["nmfd", "acyclic"])
@pytest.mark.parametrize(
    "wrong, at",
    [("perimeter", (0, 1)), ("splits", (1, 0, 0)), ("prices", (1,)), ("metering", (0,))],
)
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_a_number_that_is_not_finite_is_named(scenario, plant, wrong, at, value):
    controller = Mad("no-control", Controls(perimeter=scenario.network.open_perimeter))
    controller.wrong, controller.at, controller.value = wrong, at, value
    controller.splits = scenario.network.nominal_splits
    expected = (
        f"no-control: interval 3: {wrong}{list(at)}: expected a finite number, got {value} instead"
    )
    with pytest.raises(InputError, match=f"^{re.escape(expected)}$"):
        nmfd.run(scenario, controller, plant=plant)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "frozen:3",
        "missing",
        "missing:2",
        "missing:x",
        "delayed:1.5",
        "frozen@5",
        "frozen@9-3",
        "closed",
        "signal:",
    ],
)
def test_wrong_faults(text):
    with pytest.raises(InputError, match="expected frozen, delayed:INTERVALS"):
        faults.parse(text, "here", 2)


def test_faults_of_a_city_are_refused_on_the_regional_model(tmp_path):
    folder = tiny.write(tmp_path, scenario='faults = ["closed:x"]\n' + tiny.SCENARIO)
    result = call("nmfd", "benchmark", folder, "--controllers no-control --out", tmp_path / "out")
    assert "closed is a fault of a city" in error_line(result, "nmfd")


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return load_scenario(tiny_city.imported(tmp_path_factory.mktemp("city")))


def in_sumo(city, *ordered, perimeter=None, watch=None, **changed):
    """The states and the record of a run with these faults; watch(plant) is called after the
    reset."""
    scenario = replace(city, faults=ordered)
    gates = tiny.gates_at(city, city.network.u_max if perimeter is None else perimeter)
    with tiny_city.plant_of(scenario, **changed) as plant:
        states = [plant.reset(0)]
        if watch:
            watch(plant)
        states += [plant.step(gates) for _ in range(STEPS)]
        return states, SimpleNamespace(**plant.record())


def test_a_closed_street(city):
    edge, records = "B1C1", {}
    n = city_of(city.network).edges.index(edge)
    for ordered in ((), (f"closed:{edge}@2-5",)):
        states, records[ordered] = in_sumo(city, *ordered)
        problems = [state.problem for state in states[1:]]
        assert problems == [
            f"edge {edge} closed" if ordered and 2 <= k < 5 else "" for k in range(STEPS)
        ]
    free, shut = (record.edge_vehicles[:, n].astype(float) for record in records.values())
    assert shut[3:5].mean() > 2.0 * free[3:5].mean() + 1.0
    assert records[()].arrivals[2:5].sum() > records[(f"closed:{edge}@2-5",)].arrivals[2:5].sum()
    assert shut[-1] < shut[3:5].max()


def test_a_signal_that_does_not_obey_shows_its_own_green(city):
    gateways, closed = city_of(city.network).gateways, city.network.u_min
    signal = next(gateway.signal for gateway in gateways if gateway.signal is not None)
    _, free = in_sumo(city, perimeter=closed)
    states, record = in_sumo(city, f"signal:{signal}@3-6", perimeter=closed)
    problems = [state.problem for state in states[1:]]
    assert problems == [
        f"signal {signal} took no programme" if 3 <= k < 6 else "" for k in range(STEPS)
    ]
    own = [n for n, gateway in enumerate(gateways) if gateway.signal == signal]
    assert own
    assert (record.gateway_green[3:6, own] == record.gateway_original_green[3:6, own]).all()
    assert (free.gateway_green[3:6, own] < free.gateway_original_green[3:6, own]).any()


@pytest.mark.parametrize(
    "signals, gateway", [("fixed", True), ("max-pressure", True), ("max-pressure", False)]
)
def test_a_signal_that_does_not_obey_is_safe(city, signals, gateway):
    """Second by second its own programme, with yellow before and after."""
    with tiny_city.plant_of(city) as plant:
        gateways = {gateway.signal for gateway in plant.city.gateways}
        name = next(one.id for one in plant.steered if (one.id in gateways) == gateway)
        plant.reset(0)
        phases = plant.session.programme(name).phases
    own = [phase.state for phase in phases for _ in range(round(phase.duration))]
    shown = []

    def watch(plant):
        step = plant.session.step
        plant.session.step = lambda: (step(), shown.append(plant.session.signal_state(name)))

    in_sumo(city, f"signal:{name}@3-6", perimeter=city.network.u_min, watch=watch, signals=signals)
    interval = round(city.step)
    begin, end = 3 * interval + round(DEFAULT_YELLOW_S), 6 * interval
    cycles = [[own[(n + k) % len(own)] for k in range(end - begin)] for n in range(len(own))]
    assert shown[begin:end] in cycles
    assert shown[begin - interval : end - interval] not in cycles
    assert shown[-len(own) :] not in [cycle[: len(own)] for cycle in cycles]
    for before, after in itertools.pairwise(shown):
        assert not any(a in "Gg" and b == "r" for a, b in zip(before, after, strict=True)), (
            before,
            after,
        )


@pytest.mark.parametrize(
    "ordered, problem", [("closed:no", "edge 'no' is not in"), ("signal:no", "'no' is no signal")]
)
def test_faults_that_the_city_does_not_have(city, out, ordered, problem):
    file = city.folder / "scenario.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(f'faults = ["{ordered}"]\n{text}', encoding="utf-8")
    try:
        result = call("cosim", "run", city.folder, "--controller no-control --out", out)
    finally:
        file.write_text(text, encoding="utf-8")
    assert problem in error_line(result)
    assert not out.exists()
