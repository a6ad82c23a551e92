"""Controllers compared without no-control: tables and reasons take the first one as reference."""

import re
from dataclasses import replace

import made_up
import pytest
import tiny
from commands import good, nmfd
from made_up import rows_of

from cosim.evaluation import explain, results, statistics
from nmfd.studies.benchmark import compared_with

PAIR = ("pi-gating", "dpc-pcrg")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made_up.folder(
        tmp_path_factory.mktemp("pair") / "runs", controllers=PAIR, seeds=(1, 2), levels=(0.8, 1.0)
    )


def test_the_reference_controller():
    assert compared_with(["a", "no-control", "b"]) == "no-control"
    assert compared_with(["b", "a"]) == "b"
    rows = rows_of({(1.0, "a"): {1: 1.0}, (1.3, "no-control"): {1: 1.0}, (1.3, "a"): {1: 1.0}})
    assert statistics.compared_with(rows) == "a"  # what every level has
    assert statistics.compared_with(rows[rows["demand"] == 1.3]) == "no-control"
    few = rows_of({(1.0, "no-control"): {1: 2.0}, (1.0, "a"): {1: 1.0, 2: 1.0, 3: 1.0}})
    assert statistics.compared_with(few) == "a"
    assert statistics.compared_with(few[few["seed"] < 3]) == "a"


def test_tables_pair_with_the_first(folder):
    table = statistics.statistics(results.read(folder).rows)
    second = table[table["controller"] == "dpc-pcrg"]
    assert (second["change_percent"] < -30.0).all()
    assert (second["change_seeds"] == 2).all()
    assert (table["against"] == "pi-gating").all()
    heads = [
        line
        for line in (folder / "evaluate.md").read_text().splitlines()
        if line.startswith("| controller | se")
    ]
    assert len(heads) == 2
    assert all("| against pi-gating |" in line for line in heads)


def test_reasons_are_against_the_first(folder):
    why = (folder / "evaluate.md").read_text().partition("## Why")[2]
    assert "ithout control" not in why
    assert "Under pi-gating" in why
    assert (
        len(re.findall(r"- dpc-pcrg gains \(-\d+\.\d % total time spent against pi-gating ± ", why))
        == 2
    )
    assert why.count("- pi-gating is the reference") == 2


def test_reasons_name_what_the_controller_did_and_what_limits_it(folder):
    finished = results.read(folder)
    level = finished.level(1.0)
    level.rows["removed_veh"], level.rows["trips"] = 10.0, 1000.0
    gains = explain.paragraph(level, finished, "dpc-pcrg")
    assert "holds vehicles back in" in gains
    assert "times per trip" in gains
    assert "removal" not in gains
    assert gains.endswith(
        f". Some lose: trips from {finished.scenario.network.region_names[2]} (+30 %) take longer."
    )
    level.rows["removed_veh"] = 11.0
    assert explain.city(level, finished).endswith("; 1.1% of its trips end by removal.")
    level.rows["total_time_spent_veh_s"] *= level.rows["controller"].map(
        {"dpc-pcrg": 9.0, "pi-gating": 1.0}
    )
    level.rows["leaking_share"] = 0.8
    level.rows["gateway_full_share"] = level.rows["controller"].map(
        {"dpc-pcrg": 0.5, "pi-gating": 0.1}
    )
    level.rows["split_lanes"], level.rows["signal_lanes"] = 3.0, 9.0
    level.rows["intergreen_share"], level.rows["programmed_intergreen_share"] = 0.3, 0.1
    loses = explain.paragraph(level, finished, "dpc-pcrg")
    assert loses.startswith("dpc-pcrg loses (+")
    assert loses.endswith("; 1.1% of its trips end by removal.")
    for words in (
        "80% of the boundary flow",
        "50% of the time, not 10%",
        "3 of 9 lanes",
        "between stages 30%",
    ):
        assert words in loses


def test_a_gate_that_never_closes_says_so_first_and_no_critical_accumulation_is_made_up(tmp_path):
    finished = results.read(
        made_up.folder(tmp_path / "gate", controllers=("no-control", "pi-gating"), seeds=(1, 2))
    )
    network, level = finished.scenario.network, finished.level(1.0)
    gate = {"pi-gating": {"set_point": [90000.0] * len(finished.scenario.protected)}}
    unseen = replace(network, critical_above=dict.fromkeys(range(network.regions), 1.0))
    finished = replace(
        finished, scenario=replace(finished.scenario, network=unseen, controller_options=gate)
    )
    reasons = explain.paragraph(level, finished, "pi-gating").partition("): ")[2]
    name = network.region_names[finished.scenario.protected[0]]
    assert reasons.startswith(
        f"{name} never reaches the set point of its gate, 90000 vehicles, with "
    )
    assert "is critical" not in reasons
    assert f"critical accumulation; that of {network.regions} regions was not seen" in explain.city(
        level, finished
    )


def test_one_controller_alone(tmp_path):
    assert (
        "against"
        not in statistics.markdown(rows_of({(1.0, "actuated"): {1: 100.0}})).splitlines()[2]
    )
    alone = results.read(made_up.folder(tmp_path / "one", controllers=("pi-gating",), seeds=(1,)))
    assert explain.city(alone.level(1.0), alone).startswith("Signals under control see")


def test_the_benchmark_compares_with_the_first(tmp_path):
    scenario = tiny.write(tmp_path)
    out = good(
        nmfd("benchmark", scenario, "--controllers pi-gating,probing-pc --out", tmp_path / "b")
    )
    assert re.search(r"^probing-pc .*[-+]\d+\.\d %", out, re.M)
    assert "TTS against pi-gating" in " ".join(out.split())
