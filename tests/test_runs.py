"""Run folders: nothing half-written, resumable, the same bytes; and the processes that fill them."""

import ast
import hashlib
import io
import json
import os
import subprocess
import termios
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trajectories
import xarray as xr
from trajectories import trajectory

from cosim.plant.record import Record
from nmfd import quantities
from nmfd.cli.progress import progress_line
from nmfd.errors import InputError
from nmfd.runs import files, progress, provenance, run_folder, workers
from nmfd.runs.tables import markdown_table
from nmfd.runs.tally import Tally
from nmfd.types import Result

ROOT = Path(__file__).parents[1]
CONFIGURATION = {"scenario": "x", "step": 30.0, "protected": (1, 2)}


def opened(path, *, controllers=("no-control",), seeds=(0,), settings=None):
    order = [(name, seed) for name in controllers for seed in seeds]
    return run_folder.open_folder(path, configuration=CONFIGURATION, order=order, controllers=settings)


def test_trajectory_round_trip_and_same_bytes(tmp_path):
    original = trajectory()
    run_folder.write_trajectory(tmp_path / "a.nc", original)
    run_folder.write_trajectory(tmp_path / "b.nc", replace(original, decision_time=2 * original.decision_time))
    back = run_folder.read_trajectory(tmp_path / "a.nc")
    for name in ("accumulation", "backlog", "completed", "observed", "observed_backlog", "perimeter", "splits"):
        np.testing.assert_array_equal(getattr(back, name), getattr(original, name))
    assert (back.controller, back.plant, back.seed, back.step) == ("no-control", "nmfd", 0, 30.0)
    assert back.note == original.note and back.estimated is False and (back.status == original.status).all()
    assert (tmp_path / "a.nc").read_bytes() == (tmp_path / "b.nc").read_bytes()


def test_the_same_run_gives_the_same_bytes_at_another_time(tmp_path, monkeypatch):
    """HDF5 can keep times of its objects."""
    more = quantities.variables(Record, trajectories.record(4, regions=2))
    run_folder.write_trajectory(tmp_path / "a.nc", trajectory(), more)
    time.sleep(1.1)
    run_folder.write_trajectory(tmp_path / "b.nc", trajectory(), more)
    first, second = ((tmp_path / name).read_bytes() for name in ("a.nc", "b.nc"))
    assert hashlib.sha256(first).digest() == hashlib.sha256(second).digest()


def test_xarray_opens_a_run_with_names_and_units(tmp_path):
    original, record = replace(trajectory(), estimated=True), trajectories.record(4, regions=2)
    run_folder.write_trajectory(tmp_path / "a.nc", original, quantities.variables(Record, record))
    with xr.open_dataset(tmp_path / "a.nc") as data:
        assert dict(data.sizes) == {
            "time": 5,
            "interval": 4,
            "region": 2,
            "destination": 2,
            "next_region": 2,
            "gateway": 3,
            "edge": 5,
        }
        assert data.attrs == {"controller": "no-control", "plant": "nmfd", "seed": 0, "step": 30.0, "estimated": 1}
        assert set(data.data_vars) == {*quantities.quantities(Result), *record} - {"decision_time"}
        for name, values in data.variables.items():
            assert values.attrs["long_name"] and ("units" in values.attrs or name == "note"), name
        assert tuple(data["note"].values) == original.note == ("", "", "", "no")
        assert list(data["status"].values) == [0, 0, 0, 3]  # a solver failure and a fallback
        assert data["status"].attrs["flag_meanings"] == "solver_failure fallback sensor_fault plant_fault late"
        assert list(data["status"].attrs["flag_masks"]) == [1, 2, 4, 8, 16]
        assert list(data["time"].values) == [0.0, 30.0, 60.0, 90.0, 120.0] and data["time"].attrs["units"] == "s"
        assert float(data["accumulation"].sel(time=60.0, region=1, destination=0)) == original.accumulation[2, 1, 0]
        for name, values in record.items():
            np.testing.assert_array_equal(data[name].values, values)
    assert run_folder.read_trajectory(tmp_path / "a.nc").estimated is True


@pytest.mark.parametrize("page, kind", [("nmfd/runs/README.md", Result), ("cosim/plant/record.md", Record)])
def test_the_pages_list_what_is_in_a_file(page, kind):
    table = markdown_table(
        ("variable", "dimensions", "unit", "what"),
        (
            (name, ", ".join(about["dimensions"]), about["attributes"].get("units", ""), about["text"])
            for name, about in quantities.quantities(kind).items()
        ),
    )
    assert table in (ROOT / page).read_text()


def test_the_tables_of_a_run_row_by_row():
    run = trajectory()
    states, controls = run.to_frame(), run.controls_frame()
    assert list(states.columns) == [
        "controller",
        "plant",
        "seed",
        "time_s",
        "region",
        "destination",
        "accumulation_veh",
        "backlog_veh",
    ]
    assert list(controls.columns) == ["controller", "plant", "seed", "time_s", "region", "next_region", "perimeter"]
    for n, (k, i, j) in enumerate(np.ndindex(5, 2, 2)):
        assert tuple(states.loc[n]) == ("no-control", "nmfd", 0, 30.0 * k, i, j, run.accumulation[k, i, j], 0.0)
    assert (controls["perimeter"] == run.perimeter.ravel()).all() and controls["time_s"].max() == 90.0


@pytest.mark.parametrize(
    "plant, command",
    [
        ("nmfd", "nmfd benchmark scenarios/x, with no-control, pi-gating"),
        ("sumo", "cosim run, evaluate or sweep scenarios/x, with no-control, pi-gating"),
        (None, "the command that made it"),
    ],
)
def test_a_folder_of_an_older_version_says_what_to_run(tmp_path, plant, command):
    (tmp_path / "no-control-0.npz").write_bytes(b"PK")
    if plant:
        (tmp_path / "manifest.json").write_text(
            json.dumps(
                {
                    "configuration": {"plant": plant},
                    "controllers": {"no-control": {}, "pi-gating": {}},
                    "sessions": [{"scenario_folder": "scenarios/x"}],
                }
            )
        )
    for use in (
        lambda: run_folder.read_trajectory(tmp_path / "no-control-0.nc"),
        lambda: opened(tmp_path).__enter__(),
        lambda: run_folder.read_summary(tmp_path / "summary.csv"),
    ):
        with pytest.raises(InputError, match=f"older version .*; delete it and run again: {command}$"):
            use()


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04 cut off"])
def test_a_file_that_is_no_trajectory(tmp_path, content):
    (tmp_path / "a.nc").write_bytes(content)
    with pytest.raises(InputError, match="a.nc: is no run"):
        run_folder.read_trajectory(tmp_path / "a.nc")


def test_a_run_that_was_cut_off_anywhere(tmp_path):
    run_folder.write_trajectory(tmp_path / "a.nc", trajectory())
    whole = (tmp_path / "a.nc").read_bytes()
    for length in [*range(0, len(whole), len(whole) // 20), len(whole) - 1]:
        (tmp_path / "a.nc").write_bytes(whole[:length])
        with pytest.raises(InputError, match="a.nc: is no run"):
            run_folder.read_trajectory(tmp_path / "a.nc")


def test_a_netcdf_file_of_somebody_else(tmp_path):
    xr.Dataset({"temperature": ("time", np.ones(3))}).to_netcdf(tmp_path / "a.nc", engine="netcdf4")
    with pytest.raises(InputError, match="a.nc: is no run"):
        run_folder.read_trajectory(tmp_path / "a.nc")


def test_no_module_of_one_system_is_imported_at_the_top_of_a_file():
    found = [
        (path.name, name.name)
        for folder in ("nmfd", "cosim")
        for path in (ROOT / folder).rglob("*.py")
        for line in ast.parse(path.read_text()).body
        if isinstance(line, ast.Import)
        for name in line.names
    ]
    assert len(found) > 100 and not [pair for pair in found if pair[1] in ("fcntl", "grp", "pwd", "resource")]


def test_atomic_leaves_the_old_file_and_nothing_else_when_writing_fails(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), files.atomic(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_rows_come_in_the_order_asked_for_and_are_kept(tmp_path):
    with opened(tmp_path / "r", controllers=("a", "b"), seeds=(0, 1)) as folder:
        for run in (("b", 1), ("a", 0)):
            folder.add(trajectory(*run))
        assert folder.finished == [("a", 0), ("b", 1)]
    with opened(tmp_path / "r", controllers=("c",)) as folder:
        folder.add(trajectory("c"))
    rows = run_folder.read_summary(tmp_path / "r" / "summary.csv")
    assert [(row["controller"], row["seed"]) for row in rows] == [("a", 0), ("b", 1), ("c", 0)]
    assert rows[0]["solver_failures"] == 1 and list(rows[0]) == list(run_folder.COLUMNS)
    sessions = json.loads((tmp_path / "r" / "manifest.json").read_text())["sessions"]
    assert [session["seeds"] for session in sessions] == [[0, 1], [0]]


def test_a_run_without_its_trajectory_is_not_finished(tmp_path):
    with opened(tmp_path / "r") as folder:
        folder.add(trajectory())
        folder.trajectory_path("no-control", 0).unlink()
        assert folder.finished == [] and folder.trajectories() == []


def test_another_configuration_or_policy_is_refused(tmp_path):
    with opened(tmp_path / "r", settings={"no-control": {"policy_hash": "1"}}) as folder:
        folder.add(trajectory())
    before = (tmp_path / "r" / "manifest.json").read_bytes()
    with pytest.raises(InputError, match='no-control: {"policy_hash": "1"} there, {"policy_hash": "2"} asked for'):
        with opened(tmp_path / "r", settings={"no-control": {"policy_hash": "2"}}):
            pass
    with pytest.raises(InputError, match="step: 30.0 there, 60.0 asked for"):
        with run_folder.open_folder(tmp_path / "r", configuration={**CONFIGURATION, "step": 60.0}, order=[]):
            pass
    assert (tmp_path / "r" / "manifest.json").read_bytes() == before


def test_a_folder_in_which_nothing_was_finished_goes_again(tmp_path):
    with pytest.raises(KeyboardInterrupt), opened(tmp_path / "a" / "b") as folder:
        run_folder.write_trajectory(folder.trajectory_path("no-control", 0), trajectory())
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt), opened(tmp_path) as folder:  # one that was there before stays, empty
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_finished_runs_survive_a_failure(tmp_path):
    with pytest.raises(RuntimeError), opened(tmp_path / "r") as folder:
        folder.add(trajectory())
        raise RuntimeError
    with opened(tmp_path / "r") as folder:
        assert folder.finished == [("no-control", 0)]


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "r").write_text("")
    with pytest.raises(InputError, match="r: is a file"), opened(tmp_path / "r"):
        pass


def double_or_trouble(task):
    if task == "die":
        os._exit(3)
    return 2 * task if task < 3 else 1 / 0


@pytest.mark.slow
def test_workers_give_every_outcome_and_name_what_failed():
    outcomes = dict(workers.outcomes(double_or_trouble, [1, "die", 3, 2], workers=2))
    assert {task: outcomes[task] for task in (1, 2)} == {1: 2, 2: 4}
    assert outcomes["die"] == workers.Failure("its process died (status 3)")
    assert outcomes[3].reason.startswith("ZeroDivisionError: division by zero (test_runs.py:")


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.usefixtures("unchecked")  # a StringIO is no typing.TextIO
def test_progress_is_a_line_that_is_wiped_on_a_terminal_and_plain_ones_elsewhere(monkeypatch):
    stream = io.StringIO()
    with progress_line("x", stream) as show:
        show(1, 4)
    assert stream.getvalue() == ""  # for what is over in a moment
    monkeypatch.setattr(progress, "EVERY", 0.2)
    with progress_line("cosim", stream) as show:
        show(1, 4, "0/2 runs")
        time.sleep(0.1)
        show(2, 4, "1/2 runs; seed 1: 17 of 70 min")
        time.sleep(0.4)
    first, *_ = stream.getvalue().splitlines()
    assert first.startswith("cosim: 2/4 after 00:00, 00:0") and first.endswith("left, 1/2 runs; seed 1: 17 of 70 min")
    stream = Terminal()
    with progress_line("training", stream) as show:
        show(0, 4, "best 3")
    *_, drawn, wiped, end = stream.getvalue().split("\r")
    assert drawn.startswith("training  [....") and "0/4" in drawn and drawn.endswith("best 3")
    assert wiped.isspace() and len(wiped) >= len(drawn) and end == ""


def test_progress_line_fits_the_terminal():
    behind, terminal = os.openpty()
    termios.tcsetwinsize(terminal, (24, 30))
    with open(terminal, "w", encoding="utf-8") as stream, progress_line("training", stream) as show:
        show(0, 4, "a long note")
    drawn = os.read(behind, 1000).decode().split("\r")
    os.close(behind)
    assert max(map(len, drawn)) < 30 and any("training" in line for line in drawn)


@pytest.mark.usefixtures("unchecked")
def test_progress_begins_again_with_another_total():
    """Studies count runs, then iterations: the remaining time is that of what is shown."""
    stream = Terminal()
    with progress_line("identify", stream) as show:
        show(3, 4)
        show(0, 100, "fitting")
    assert "0/100  ? left, fitting" in stream.getvalue().split("\r")[-3]


def half_way(task):
    workers.reached(0.5)
    time.sleep(1.5 * workers.LOOK)
    return task


@pytest.mark.slow
def test_who_waits_for_workers_sees_how_far_they_are():
    seen, told = [], []
    tally = Tally(
        lambda *what: told.append(what),
        [1, 2],
        steps=lambda run: 10 * run,
        label=lambda run: f"run {run}",
        at=lambda run, share: f" at {share:.0%}",
    )
    for task, _ in workers.outcomes(
        half_way, [1, 2], workers=2, look=lambda running: (seen.append(list(running)), tally.look(running))
    ):
        tally.end(task, failed=task == 2)
    assert [(1, 0.5), (2, 0.5)] in seen
    assert told[0] == (0, 30, "0/2 runs") and (15, 30, "0/2 runs; run 1 at 50%; run 2 at 50%") in told
    assert [what[0] for what in told] == sorted(what[0] for what in told) and told[-1][:2] == (30, 30)
    assert told[-1][2].startswith("2/2 runs; ")
    workers.reached(0.7)  # in this process, which is no worker: nothing


def test_a_look_at_the_checkout_does_not_write_to_it(tmp_path):
    (tmp_path / "a").write_text("content")
    for command in (["init", "-q"], ["add", "a"], ["-c", "user.name=x", "-c", "user.email=x", "commit", "-qm", "x"]):
        subprocess.run(["git", "-C", tmp_path, *command], check=True)
    os.utime(tmp_path / "a", (1e9, 1e9))  # git would write that down
    before = (tmp_path / ".git" / "index").read_bytes()
    assert provenance._git(tmp_path, "status", "--porcelain") == ""
    assert (tmp_path / ".git" / "index").read_bytes() == before
