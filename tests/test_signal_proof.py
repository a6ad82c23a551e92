"""The proof sheet of signals: violations by hand, SUMO's own record, and random commands under
every signal control."""

from functools import cache
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
import tiny_city
from signal_rules import CROSS, WALK, rules
from test_responsive import CARS, CONFIG

from cosim.api import run_controllers
from cosim.evaluation.signal_proof import VIOLATIONS, proof_sheet
from cosim.plant.plant import SumoPlant
from cosim.plant.settings import own_files, settings
from cosim.plant.strategy import parse
from cosim.sumo.net import city_of
from cosim.sumo.xml_files import read_xml
from nmfd.api import load_scenario
from nmfd.model.scenario import with_demand
from nmfd.types import Controls

CONTROLS = ("", "max-pressure", "actuated", "webster", "metering")


def judge(phases, shown, crossings=()):
    """The row of a signal with such phases, which shows (state, seconds)."""
    begins = np.cumsum([0.0, *(seconds for _, seconds in shown)]).tolist()
    states = [(begin, state) for begin, (state, _) in zip(begins, shown, strict=False)]
    return rules(phases, crossings).judge(states, begins[-1])


@pytest.mark.parametrize(
    "phases, shown, expected",
    [
        (CROSS, 3 * CROSS, {}),
        (WALK, 3 * WALK, {}),
        (CROSS, [*CROSS, ("Gr", 4), *CROSS[1:]], {"short_greens": 1}),
        (CROSS, [*CROSS, ("Gr", 9), ("yr", 2), ("rr", 1), *CROSS[2:]], {"short_yellows": 1}),
        (CROSS, [*CROSS, ("Gr", 9), ("rr", 3), *CROSS[2:]], {"short_yellows": 1}),
        (CROSS, [*CROSS, ("Gr", 9), ("yr", 1), ("yG", 2), ("rG", 9)], {"short_intergreens": 1}),
        (
            CROSS,
            [*CROSS, ("GG", 9), ("yy", 3), ("rr", 9)],
            {"conflicts": 1, "short_intergreens": 0},
        ),
        ([("Gg", 9), ("yr", 3), ("rG", 9), ("ry", 3)], [("GG", 9), ("gG", 9)], {"conflicts": 1}),
        (WALK, [*WALK, ("GrG", 19), *WALK[1:]], {"short_greens": 1}),  # a crossing keeps its 20 s
        (WALK, [*WALK, WALK[0], *WALK[2:5]], {"short_clearances": 1}),  # and is cleared for 9 s
        (WALK, [*WALK, *WALK[:3], *WALK[4:5]], {"short_intergreens": 1, "short_clearances": 1}),
        (WALK, [*WALK, *WALK[:4], ("rGr", 2), ("ryr", 2)], {"short_greens": 1}),  # 3 s originally
    ],
)
def test_violations_are_counted(phases, shown, expected):
    row = judge(phases, shown, crossings=(2,) if phases is WALK else ())
    assert {key: row[key] for key in VIOLATIONS} == dict.fromkeys(VIOLATIONS, 0) | expected


def test_figures_of_a_sheet():
    row = judge(CROSS, [*CROSS, ("Gr", 7), ("yr", 4), ("rG", 8)])
    assert (row["shortest_green"], row["shortest_yellow"], row["longest_red"]) == (7.0, 3.0, 36.0)


def test_clearance_of_a_crossing():
    """From the end of its green to that of the cars across it, not to that of the cars beside."""
    row = judge(WALK, [*WALK, *WALK[:2], ("yrr", 5), *WALK[3:5]], crossings=(2,))
    assert row["shortest_clearance"] == 9.0
    assert np.isnan(judge(CROSS, 3 * CROSS)["shortest_clearance"])


def proven(folder, words, intervals, tmp_path):
    """Run with random commands in every interval; return the sheet of what SUMO's saveTLSStates
    wrote."""
    scenario, strategy = (
        with_demand(load_scenario(folder), steps=intervals),
        parse("no-control", words),
    )
    chosen = (
        settings(scenario)
        .changed(gateways_fixed=False, mesoscopic=False)
        .changed(**strategy.changes)
    )
    city, network, random = city_of(scenario.network), scenario.network, np.random.default_rng(5)
    programmes = [city.net_file, *own_files(scenario, chosen.additional)]
    events = ElementTree.Element("additional")
    for signal in {
        logic.get("id") for file in programmes for logic in read_xml(file).iter("tlLogic")
    }:
        about = {"type": "SaveTLSStates", "source": signal, "dest": str(tmp_path / "states.xml")}
        ElementTree.SubElement(events, "timedEvent", about)
    ElementTree.ElementTree(events).write(tmp_path / "tls.add.xml")
    chosen = chosen.changed(additional=(*chosen.additional, str(tmp_path / "tls.add.xml")))
    plant = SumoPlant(scenario, settings=chosen)
    try:
        plant.reset(5)
        for _ in range(intervals):
            share = random.choice([0.0, 1.0, random.uniform()], network.adjacency.shape)
            u = network.u_min + share * (network.u_max - network.u_min)
            rate = random.uniform(0.0, 1.0, network.regions)
            plant.step(Controls(perimeter=np.where(network.adjacency, u, 0.0), metering=rate))
        end, observed = plant.session.time, plant.actuation.states
    finally:
        plant.close()
    states = {}
    for element in ElementTree.parse(tmp_path / "states.xml").iter("tlsState"):
        row = states.setdefault(element.get("id"), [])
        if not row or row[-1][1] != element.get("state"):
            row.append((float(element.get("time")), element.get("state")))
    sheet, own = (
        proof_sheet(each, programmes, end=end, step=chosen.step_length, waits={})
        for each in (states, observed)
    )
    assert all(np.array_equal(sheet[key], own[key]) for key in VIOLATIONS)
    assert len(sheet["signal"]) > 3
    return sheet


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """The imported city with crossings and signals of a kind; another name is that of a city."""

    @cache
    def made(kind):
        if kind not in ("static", "actuated", "delay_based"):
            return kind
        folder = tmp_path_factory.mktemp(kind)
        crossings = "--sidewalks.guess --sidewalks.guess.max-speed 50 --crossings.guess"
        signals = f"--tls.set B1,B2,C1,C2 --tls.default-type {kind}"
        tiny_city.network(folder, signals, crossings)
        (folder / "cars.rou.xml").write_text(CARS)
        (folder / "city.sumocfg").write_text(CONFIG)
        return tiny_city.imported(folder, regions=2, source=folder / "city.sumocfg")

    return made


@pytest.mark.slow
def test_a_run_says_that_signals_break_rules(imported, tmp_path):
    """Signals that stop and start to obey cut greens short; without such faults nothing is said."""
    scenario, faults = imported("static"), ["signal:B1@1-2", "signal:B2@3-5"]
    for settings_, steps, said in (({"faults": faults}, 6, True), ({}, 2, False)):
        out = tmp_path / str(said)
        changed = load_scenario(scenario, settings_)
        rows = run_controllers(changed, ["no-control+max-pressure"], steps=steps, out=out)
        table = pd.read_csv(out / "signals.csv")
        assert list(table)[2] == "signal"
        assert sorted(table.signal) == ["B1", "B2", "C1", "C2"]
        cleared = table.shortest_clearance_s >= 8.0  # 5 s, and the yellow of the cars beside
        assert (cleared == (table.short_clearances == 0)).all()
        assert cleared.all() != said
        broken = table[list(VIOLATIONS)].to_numpy().sum()
        assert (broken > 0) == said
        assert rows["signal_violations"].tolist() == [broken]
        assert pd.read_csv(out / "runs.csv").signal_violations.tolist() == [broken]


@pytest.mark.parametrize("city", CONTROLS)
@pytest.mark.parametrize(
    "place",
    [
        "static",
        "actuated",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("delay_based", "demo", "grid7_peak", "bologna", "luxembourg")
        ),
    ],
)
def test_random_commands_violate_nothing(imported, tmp_path, place, city):
    if place in ("actuated", "delay_based") and city in ("actuated", "webster"):
        pytest.skip("only for fixed-time signals")
    sheet = proven(imported(place), city, 4, tmp_path)
    assert {key: sheet["signal"][sheet[key] > 0].tolist() for key in VIOLATIONS} == {
        key: [] for key in VIOLATIONS
    }
