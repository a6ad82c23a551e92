"""What users of notebooks and shells expect: one name or many, patterns, tables, progress, a look
at a city."""

import io
import itertools
import re
import sys

import numpy as np
import pytest
import tiny
from commands import error_line, good
from commands import nmfd as command

import cosim
import nmfd
from cosim.plant.strategy import parse
from nmfd.controllers import strategy
from nmfd.runs import progress

NAMES = ("no-control", "dpc-pc", "dpc-pcrg", "pi-gating")


@pytest.fixture
def listed(tmp_path, monkeypatch):
    """Names of the strategies in a list, where those of NAMES can be made."""
    monkeypatch.setattr(strategy, "ready", lambda scenario, parse: [parse(name) for name in NAMES])
    scenario = nmfd.load_scenario(tiny.write(tmp_path))
    return lambda given: [one.name for one in strategy.parse_many(given, scenario, strategy.parse)]


@pytest.mark.parametrize(
    "given, expected",
    [
        ("no-control", ["no-control"]),
        (["no-control"], ["no-control"]),
        ("no-control, pi-gating", [NAMES[0], NAMES[3]]),
        ("dpc-*", ["dpc-pc", "dpc-pcrg"]),
        ("dpc-*,dpc-pc,dpc-pc", ["dpc-pcrg", "dpc-pc"]),
        (["mpc-pc", "*-p[ci]", "dpc-??"], ["mpc-pc", "dpc-pc"]),
        ("*", list(NAMES)),
    ],
    ids=str,
)
def test_one_name_many_and_patterns(listed, given, expected):
    assert listed(given) == expected


def test_a_pattern_stands_for_what_has_a_policy(tmp_path, monkeypatch):
    monkeypatch.setattr("nmfd.studies.plots.save", lambda *given: None)
    folder = tiny.write(tmp_path)
    scenario = nmfd.load_scenario(folder)
    names = [one.name for one in strategy.ready(scenario, strategy.parse)]
    assert "mpc-pc" in names
    assert not any(name.startswith("dpc") for name in names)
    table = good(
        command("benchmark", folder, "--controllers no-*,pi-gating --out", tmp_path / "out")
    )
    assert re.findall("^(no-control|pi-gating) ", table, re.MULTILINE) == [
        "no-control",
        "pi-gating",
    ]
    assert "matches 'dpc-*'" in error_line(
        command("benchmark", folder, "--controllers dpc-*"), "nmfd"
    )
    for name in ("dpc-pc.pt", "dpc-pc+max-pressure.pt", "dpc-pc+nonsense.pt"):
        (folder / name).touch()
    names = [one.name for one in strategy.ready(nmfd.load_scenario(folder), parse)]
    assert {"dpc-pc", "dpc-pc+max-pressure"} <= set(names)
    assert not {"dpc-pcrg", "dpc-pc+nonsense"} & set(names)


def test_progress_is_shown_on_a_terminal_and_in_notebooks_only(monkeypatch, capsys, tmp_path):
    folder, calls = tiny.write(tmp_path), []
    nmfd.run(folder, "no-control", progress=lambda done, steps: calls.append((done, steps)))
    assert calls[-1] == (20, 20)
    nmfd.run(folder, "no-control")
    assert capsys.readouterr().err == ""  # no terminal

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stderr", shown := Terminal())
    nmfd.run(folder, "no-control")
    assert "no-control" in shown.getvalue()
    monkeypatch.setattr(sys, "stderr", silent := Terminal())
    nmfd.run(folder, "no-control", progress=False)
    assert silent.getvalue() == ""


@pytest.mark.parametrize("said, lines", [(False, ["train, b: about 5 min left"]), (True, [])])
def test_a_long_stage_is_announced_once_from_the_time_of_its_first_steps(
    monkeypatch, capsys, said, lines
):
    clock = itertools.count(0.0, 3.0)
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with progress.watched("train", said=said) as show:
        for step in (
            (1, 101, "slow"),
            (1, 101, "a"),
            (2, 101, "b"),
            (3, 101, "c"),
            (0, 9, "short"),
            (1, 9, "d"),
        ):
            show(*step)
    assert capsys.readouterr().err.splitlines() == lines


def test_the_time_of_an_earlier_stage_or_of_the_first_step_is_not_that_of_the_others(
    monkeypatch, capsys
):
    """Two runs of 300 s, then 61 steps: the first compiles for 200 s, others take 4 s."""
    clock = iter((0.0, 300.0, 600.0, 800.0, 804.0, 808.0))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with progress.watched("identify") as show:
        for step in ((0, 2), (1, 2), (2, 2), (1, 61), (2, 61), (3, 61)):
            show(*step)
    assert capsys.readouterr().err.splitlines() == ["identify: about 4 min left"]


@pytest.fixture(scope="module")
def city():
    return cosim.City("grid7_peak")


def test_a_city_without_a_run(city):
    regions, gateways = city.regions, city.gateways
    assert len(regions) == 7
    assert regions["lane_km"].between(10, 30).all()
    assert regions["critical_veh"].tolist() == [mfd.critical for mfd in city.network.mfds]
    joined = {(g.source, g.target) for g in gateways.itertuples()}
    assert joined == {(i, h) for i, h in np.argwhere(city.network.adjacency)}
    assert set(gateways["control"]) == {"controlled"}
    assert "centre" in city._repr_html_()
    assert "max_outflow_veh_s" in city._repr_html_()


def test_the_map_is_drawn_into_the_axes_it_is_given(city):
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    assert city.plot(ax) is ax
    assert len(ax.collections[0].get_paths()) == city.regions["edges"].sum()
    assert cosim.City("networks/grid7").plot().collections
