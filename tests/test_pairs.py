"""Controllers compared without no-control: every table, picture and sentence works against the first one."""

import re

import made_up
import pandas as pd
import pytest
import tiny
from commands import cosim, good, nmfd
from made_up import rows_of

from cosim.evaluation import experiment, explain, results, statistics
from nmfd.studies.benchmark import compared_with

PAIR = ("pi-gating", "dpc-pcrg")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made_up.folder(tmp_path_factory.mktemp("pair") / "runs", controllers=PAIR, seeds=(1, 2), levels=(0.8, 1.0))


def test_what_is_compared_with():
    assert compared_with(["a", "no-control", "b"]) == "no-control" and compared_with(["b", "a"]) == "b"
    rows = rows_of({(1.0, "a"): {1: 1.0}, (1.3, "no-control"): {1: 1.0}, (1.3, "a"): {1: 1.0}})
    assert statistics.compared_with(rows) == "a"  # what every level has
    assert statistics.compared_with(rows[rows["demand"] == 1.3]) == "no-control"


def test_tables_pair_with_the_first(folder):
    table = pd.read_csv(folder / "evaluate.csv")
    second = table[table["controller"] == "dpc-pcrg"]
    assert (second["change_percent"] < -30.0).all() and (second["change_seeds"] == 2).all()
    assert (table["against"] == "pi-gating").all()
    text = (folder / "evaluate.md").read_text()
    heads = [line for line in text.splitlines() if line.startswith("| controller | seeds")]
    assert len(heads) == 2 and all("| against pi-gating |" in line for line in heads)


def test_reasons_are_told_against_the_first(folder):
    """One line per controller and level; nothing is asked for that nobody needs."""
    why = (folder / "evaluate.md").read_text().partition("## Why")[2]
    assert "nothing can be said" not in why and "ithout control" not in why
    assert len(re.findall(r"- dpc-pcrg gains \(-\d+\.\d % in total time spent against pi-gating ± ", why)) == 2
    assert why.count("- pi-gating is what the others are compared with") == 2 and "Under pi-gating" in why


def test_a_pair_of_which_none_is_better():
    rows = rows_of({(1.0, "actuated"): {1: 100.0, 2: 100.0}, (1.0, "webster"): {1: 120.0, 2: 121.0}})
    assert "+20.5 %" in experiment.overview_table(rows) and "TTS against actuated" in " ".join(
        experiment.overview_table(rows).split()
    )


def test_one_controller_alone_says_so(tmp_path):
    rows = rows_of({(1.0, "webster"): {1: 100.0}})
    assert "against" not in statistics.markdown(statistics.statistics(rows)).splitlines()[2]
    assert experiment.overview_table(rows)
    alone = made_up.folder(tmp_path / "one", controllers=("pi-gating",), seeds=(1,))
    assert "pi-gating has no common seed with no-control" in (alone / "evaluate.md").read_text()
    assert explain.at(
        1.0, results.read(alone).level(1.0).folder, results.read(alone).scenario.network, results.read(alone).rows
    )[0].startswith("Signals under control see")


def test_the_benchmark_compares_with_the_first(tmp_path):
    scenario = tiny.write(tmp_path)
    out = good(nmfd("benchmark", scenario, "--controllers", "pi-gating,probing-pc", "--out", tmp_path / "b"))
    assert re.search(r"^probing-pc .*[-+]\d+\.\d %", out, re.M) and "TTS against pi-gating" in " ".join(out.split())


def test_run_compares_with_what_against_names(tmp_path, monkeypatch):
    """`--controller A --against B`: the change of A is against B."""
    asked = []
    monkeypatch.setattr(
        experiment,
        "experiment",
        lambda tasks, **_: (
            asked.extend(task.controller for task in tasks) or rows_of({(1.0, t.controller): {1: 1.0} for t in tasks})
        ),
    )
    for controller, against in (("pi-gating", "actuated"), ("pi-gating", "no-control")):
        asked.clear()
        good(cosim("run", made_up.SCENARIO, "--controller", controller, "--against", against, "--out", tmp_path))
        assert compared_with(asked) == against
