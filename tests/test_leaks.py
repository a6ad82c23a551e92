"""Gates that cannot hold: told as uncontrolled in tables, verdict, pictures and results, and never
commanded."""

import re
from functools import cache
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import tiny_city
from commands import cosim
from test_responsive import CARS, CONFIG

from cosim.api import run_controllers
from cosim.evaluation.simulate import leaking_share
from cosim.importing.importer import import_city
from cosim.reporting.city import City
from cosim.sumo.signals import free_light
from cosim.sumo.xml_files import read_xml
from cosim.view.picture import CityPicture
from nmfd.api import load_scenario

SIGNALS = ("B1", "B2", "C1", "C2")
USUAL = ("--tls.set B1,B2,C1,C2",)
ARROWS = ("--default-junction-type traffic_light_right_on_red",)
CLOSED, OPEN = 0.1, 0.9


def programme(net, signal, change, about='programID="more"'):
    """A <tlLogic> with the phases of a signal after change(state)."""
    logic = next(one for one in read_xml(net).iter("tlLogic") if one.get("id") == signal)
    rows = "".join(
        f'<phase duration="{row.get("duration")}" state="{change(row.get("state"))}"/>'
        for row in logic.iter("phase")
    )
    return f'<tlLogic id="{signal}" type="static" {about} offset="0">{rows}</tlLogic>'


def same_light(light):
    """A function of a net file and a signal: a programme whose lights are all the same."""
    return lambda net, signal: programme(net, signal, lambda state: light * len(state))


def arrows(net, signal):
    """A programme with turns on red instead of red."""
    return programme(net, signal, lambda state: state.replace("r", "s"))


def one_phase(net, signal):
    return re.sub(r"(<phase [^>]*>)+", r"\1", same_light("G")(net, signal))


def red_and_yellow(net, signal):
    return programme(net, signal, lambda state: state.replace("y", "u"))


def off(net, signal):
    return f'<tlLogic id="{signal}" type="static" programID="off"/>'


def timetable(net, signal):
    table = '<WAUT refTime="0" id="w" startProg="0"><wautSwitch time="99" to="more"/></WAUT>'
    switch = f'<wautJunction wautID="w" junctionID="{signal}"/>'
    return same_light("G")(net, signal) + table + switch


def ordinary_at_last(net, signal):
    """Turns on red, and the ordinary programme after them."""
    return arrows(net, signal) + programme(net, signal, str, 'programID="last"')


def one_lane_free(text):
    """A network in which one of the two lanes of every movement straight on at C1 has no signal."""
    return re.sub(r'(<connection [^>]*fromLane="1"[^>]*) tl="C1" linkIndex="\d+"', r"\1", text)


def plain(text):
    return text


def imported(folder, programmes=(), network=plain, options="", signals=USUAL):
    """The scenario of a city of two regions, left and right.

    programmes: signals and functions of net file and signal, for the additional file
    """
    net = tiny_city.network(folder, *signals)
    net.write_text(network(net.read_text()))
    (folder / "cars.rou.xml").write_text(CARS)
    contents = "".join(made(net, signal) for signal, made in programmes)
    (folder / "more.add.xml").write_text(f"<additional>{contents}</additional>")
    more = f'<additional-files value="more.add.xml"/>{options}'
    (folder / "city.sumocfg").write_text(CONFIG.replace("</input>", f"{more}</input>"))
    own = tiny_city.regions(net, lambda edge: int(edge[0] in "CD"))
    out = folder / "networks" / "x"
    import_city(folder / "city.sumocfg", out, regions=own, seeds=1)
    return folder / "scenarios" / "x"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """`imported` in a folder of its own, once for all tests that ask for the same."""

    @cache
    def make(*given, **options):
        return imported(tmp_path_factory.mktemp("city"), *given, **options)

    return make


def told(folder):
    """Everything that tells which gateways a command can hold, after two intervals."""
    scenario = load_scenario(folder)
    table = pd.read_csv(scenario.network.folder / "gateways.csv", keep_default_na=False)
    with tiny_city.played(scenario, 2, CLOSED, chain_limit=0.0) as (plant, _, record):
        leaks = plant.actuation.leaks()
        return SimpleNamespace(
            table=table,
            controlled=(table["control"] == "controlled").to_numpy(),
            loaded=(City(scenario).gateways["control"] == "controlled").to_numpy(),
            commanded=~np.isnan(record.gateway_green[0]),
            leaks=[gateway in leaks for gateway in plant.city.gateways],
            flow=record.gateway_flow.sum(axis=0),
            share=leaking_share(record, plant.city, leaks),
            drawn=[gate.signal for gate in CityPicture.of(scenario, plant.city).gates],
            verdict=scenario.network.controllable,
        )


LIGHTS = (
    ("B1", arrows),
    ("B2", same_light("o")),
    ("C1", same_light("O")),
    ("C2", timetable),
)
CASES = {
    "lights": (
        (LIGHTS,),
        {
            ("B1", "turn on red"),
            ("B2", "blinking"),
            ("C1", "switched off"),
            ("C2", "programme follows a timetable"),
        },
    ),
    "programmes": (
        ((("B1", off), ("B2", ordinary_at_last)), one_lane_free),
        {
            ("B1", "switched off"),
            ("B2", "controlled"),
            ("C1", "controlled"),
            ("", "no signal on some lanes"),
            ("C2", "controlled"),
        },
    ),
    "off option": (
        ((), plain, '<tls.all-off value="true"/>'),
        {(signal, "switched off") for signal in SIGNALS},
    ),
    "queue model": (
        ((), plain, '<mesosim value="true"/>'),
        {(signal, "mesoscopic model without junction control") for signal in SIGNALS},
    ),
}
SLOW_CASES = ("programmes", "off option")


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=pytest.mark.slow) if case in SLOW_CASES else case for case in CASES],
)
def test_one_word_for_every_gateway(made, case):
    """Table, verdict, map and run agree on which gateways a command can hold."""
    given, expected = CASES[case]
    seen = told(made(*given))
    table = seen.table[seen.table["control"] != "no signal"]
    assert set(zip(table["signal"], table["control"], strict=True)) == expected
    assert (seen.loaded == seen.controlled).all()
    assert (seen.commanded == seen.controlled).all()
    assert (np.array(seen.leaks) == ~seen.controlled).all()
    assert any(seen.drawn) == seen.controlled.any() == seen.verdict.any()
    free = seen.flow[~seen.controlled].sum() / seen.flow.sum()
    assert seen.share == pytest.approx(free)
    assert (seen.share < 0.9) == (case == "programmes")


def test_turns_on_red_leak_and_the_other_gates_hold(made):
    """SUMO's own signals with turns on red: right turns pass closed gates, all others are held."""
    folder = made(signals=ARROWS)
    seen = told(folder)
    kinds = set(seen.table["control"])
    assert kinds == {"controlled", "turn on red"}
    scenario = load_scenario(folder)
    with tiny_city.played(scenario, 2, OPEN, chain_limit=0.0) as (_, _, record):
        free = record.gateway_flow.sum(axis=0)
    assert seen.flow[seen.controlled].sum() < 0.5 * free[seen.controlled].sum()


def test_a_whole_run(made, out):
    """Without words about broken rules; a timetable may cut the green of a programme short."""
    text = run_controllers(made(LIGHTS), ["no-control"], steps=3, out=out)
    assert "break their rules" not in text
    row = pd.read_csv(out / "runs.csv").iloc[0]
    assert row.signal_violations == 0
    assert row.leaking_share > 0.5


def test_max_pressure_runs_signals_with_turns_on_red(made):
    scenario = load_scenario(made(signals=ARROWS))
    with tiny_city.played(scenario, 2, OPEN, signals="max-pressure") as (plant, _, record):
        assert len(plant.steered) == 12  # without those at the corners
        assert record.gateway_flow.sum() > 0.0


def test_max_pressure_says_why_it_cannot_run(made, out):
    unfit = (
        ("B1", same_light("o")),
        ("B2", off),
        ("C1", one_phase),
        ("C2", red_and_yellow),
    )
    done = cosim("run", made(unfit), "--controller max-pressure --steps 1 --out", out)
    assert done.exit_code != 0
    assert "none of the 4 signals here is one (" in done.stderr
    for reason in ("blinking", "switched off", "fewer than two green phases", "light u"):
        assert f"{reason}: 1" in done.stderr


@pytest.mark.parametrize(
    "states, links, expected",
    [
        (("Gr", "yr", "rG"), (0,), ""),
        (("Gr", "yr", "ug"), (0, 1), ""),
        (("Gr", "sr", "rG"), (0,), "turn on red"),
        (("Gr", "sr", "rG"), (1,), ""),
        (("GG", "Gs"), (0, 1), "turn on red"),
        (("Gr", "or"), (0,), "blinking"),
        (("OG", "Or"), (0,), "switched off"),
        (("rG", "rr"), (0,), "never green"),
        (("rG", "rr"), (0, 1), ""),
        (("XG", "rr"), (0,), "light X"),
        ((), (0,), "never green"),
    ],
)
def test_the_lights_that_a_command_can_hold(states, links, expected):
    assert free_light(states, links) == expected
