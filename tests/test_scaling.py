"""The scaling experiment: its networks and states, cases in their own processes, limits, resumption, figure, errors."""

import json
import math

import numpy as np
import pytest
from commands import nmfd
from tasks import whose

from nmfd.runs import files
from nmfd.runs.workers import Failure, outcomes
from nmfd.studies import scaling


@pytest.mark.parametrize("family, degree", [("complete", 18), ("hexagonal", 6)])
def test_networks(family, degree):
    city = scaling.network(family, 19)
    assert (city.hops >= 0).all() and (city.adjacency == city.adjacency.T).all()
    assert city.adjacency.sum(axis=1).max() == degree
    assert len({mfd.c for mfd in city.mfds}) == 19
    for mfd in city.mfds:
        assert mfd.problem() is None
        assert 0.8 * 10_000 <= mfd.jam <= 1.2 * 10_000 and 0.8 * 0.0042 <= mfd.c <= 1.2 * 0.0042
    again = scaling.network(family, 19)
    assert again.mfds == city.mfds and scaling.network(family, 19, seed=1).mfds != city.mfds


def test_the_hexagonal_family_grows_around_its_centre():
    """1 + 6 + 12 regions are whole rings: 7 of them have all their six neighbours."""
    city = scaling.network("hexagonal", 19)
    assert (city.adjacency.sum(axis=1) == 6).sum() == 7 and city.adjacency.sum() == 2 * 42


def test_initial_states():
    city = scaling.network("complete", 8)
    x = scaling.initial_state(city, "published")
    assert 0.0 <= x.min() < x.max() < 100.0
    filled = scaling.initial_state(city, "congested").sum(axis=1) / [mfd.jam for mfd in city.mfds]
    assert 0.0 <= filled.min() < 0.5 < filled.max() <= 1.2


def test_a_row(tmp_path):
    for name in scaling.CONTROLLERS:
        row = scaling.run_one(scaling.Case("hexagonal", "congested", 4, name), memory_gib=1000.0)
        assert list(row) == list(scaling.COLUMNS)
        assert row["status"] == "ok" and row["unsolved_decisions"] == 0
        assert 0.0 < row["median_decision_s"] <= row["longest_decision_s"] and row["set_up_s"] > 0.0
        assert 10.0 < row["peak_memory_mib"] < 1e5


@pytest.mark.slow
def test_cases_are_kept_added_and_drawn(tmp_path):
    out = tmp_path / "out"
    first = nmfd("scaling", "--regions", 3, "--controllers", "mpc-pc", "--out", out)
    assert first.exit_code == 0, first.output
    assert "mpc-pc" in first.stdout and f"Written to {out}" in first.stdout
    row = files.read_rows(out / "scaling.csv", scaling.COLUMNS)[0]
    second = nmfd(
        "scaling", "--regions", "3,4", "--controllers", "mpc-pc", "--out", out, "--workers", 2, "--family", "hexagonal"
    )
    assert second.exit_code == 0, second.output
    rows = files.read_rows(out / "scaling.csv", scaling.COLUMNS)
    assert [(r["family"], r["regions"]) for r in rows] == [("complete", 3), ("hexagonal", 3), ("hexagonal", 4)]
    assert rows[0] == row  # not measured again
    assert (out / "scaling.png").stat().st_size > 10_000
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["configuration"]["experiment"] == "scaling" and len(manifest["sessions"]) == 2


def test_what_takes_too_much_is_a_row_with_its_reason(tmp_path):
    slow = scaling.scaling(["mpc-pc"], out=tmp_path / "slow", regions=[2], time_limit=0.01)
    assert slow[0]["status"] == "not finished after 0.01 s" and math.isnan(slow[0]["median_decision_s"])
    big = scaling.scaling(["mpc-pcrg"], out=tmp_path / "big", regions=[150], memory_gib=0.3)
    assert "MemoryError" in big[0]["status"] or "died" in big[0]["status"]
    assert (tmp_path / "big" / "scaling.png").exists()
    assert files.read_rows(tmp_path / "big" / "scaling.csv", scaling.COLUMNS)[0]["status"] == big[0]["status"]


@pytest.mark.slow
def test_fresh_processes_and_their_time_limit():
    results = dict(outcomes(whose, ["a", "b", "late", "c"], 2, fresh=True, seconds=20.0))
    assert results["late"] == Failure("not finished after 20 s")
    assert len({results[task] for task in "abc"}) == 3


@pytest.mark.parametrize(
    "arguments, fragment",
    [
        (
            ["--regions", "1,2"],
            "'--regions': expected a list of distinct whole numbers from 2 to 1000000, separated by commas, got '1,2'",
        ),
        (["--regions", "2,2"], "'--regions': expected a list of distinct"),
        (["--regions", "a"], "'--regions': expected"),
        (["--controllers", "pi-gating"], "'pi-gating' is not measured; choose from dpc-pc, dpc-pcrg, mpc-pc, mpc-pcrg"),
        (["--controllers", "x"], "controller 'x' is unknown"),
        (["--family", "cube"], "expected one of complete, hexagonal, got 'cube'"),
        (["--load", "none"], "expected one of published, congested, got 'none'"),
        (["--memory", "0"], "'--memory': expected a number above 0"),
        (["--workers", "0"], "'--workers'"),
        (["--out", "/dev/null/x"], "/dev/null/x: Not a directory"),
    ],
)
def test_errors_are_one_line(tmp_path, arguments, fragment):
    out = [] if "--out" in arguments else ["--out", tmp_path / "out"]
    result = nmfd("scaling", *arguments, *out)
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and result.stdout == ""
    assert result.stderr.startswith("nmfd: error: ") and fragment in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    result = nmfd("scaling", "--regions", 2, "--out", tmp_path)
    assert result.exit_code == 2 and "holds no manifest.json" in result.stderr
    assert np.array([path.name for path in tmp_path.iterdir()]) == ["notes.txt"]
