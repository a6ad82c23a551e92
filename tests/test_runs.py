"""Run folders: nothing half-written, resumable, the same bytes; and the processes that fill them."""

import io
import json
import os
import termios
from dataclasses import replace

import numpy as np
import pytest
import trajectories

from nmfd.cli.progress import progress_line
from nmfd.errors import InputError
from nmfd.runs import files, run_folder, workers
from nmfd.types import Status

CONFIGURATION = {"scenario": "x", "step": 30.0, "protected": (1, 2)}


def trajectory(controller="no-control", seed=0, steps=4):
    rng = np.random.default_rng(seed)
    return trajectories.made(
        controller=controller, plant="nmfd", seed=seed, step=30.0, accumulation=rng.random((steps + 1, 2, 2)),
        backlog=np.zeros((steps + 1, 2, 2)), completed=np.arange(steps + 1.0), perimeter=rng.random((steps, 2, 2)),
        splits=rng.random((steps, 2, 2, 2)), decision_time=rng.random(steps), note=("",) * (steps - 1) + ("no",),
        status=np.array([0] * (steps - 1) + [(Status.SOLVER_FAILURE | Status.FALLBACK).value]),
        wall_time=1.0)


def opened(path, *, controllers=("no-control",), seeds=(0,), settings=None):
    order = [(name, seed) for name in controllers for seed in seeds]
    return run_folder.open_folder(path, configuration=CONFIGURATION, order=order, controllers=settings)


def test_trajectory_round_trip_and_same_bytes(tmp_path):
    original = trajectory()
    run_folder.write_trajectory(tmp_path / "a.npz", original)
    run_folder.write_trajectory(tmp_path / "b.npz", replace(original, decision_time=2 * original.decision_time))
    back = run_folder.read_trajectory(tmp_path / "a.npz")
    for name in (
            "accumulation", "backlog", "completed", "observed", "observed_backlog", "perimeter", "splits", "status"):
        np.testing.assert_array_equal(getattr(back, name), getattr(original, name))
    assert (back.controller, back.plant, back.seed, back.step) == ("no-control", "nmfd", 0, 30.0)
    assert back.note == original.note
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04 cut off"])
def test_a_file_that_is_no_trajectory(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(InputError, match="a.npz: is no trajectory"):
        run_folder.read_trajectory(tmp_path / "a.npz")


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


def test_workers_give_every_outcome_and_name_what_failed():
    outcomes = dict(workers.outcomes(double_or_trouble, [1, "die", 3, 2], workers=2))
    assert {task: outcomes[task] for task in (1, 2)} == {1: 2, 2: 4}
    assert outcomes["die"] == workers.Failure("its process died (status 3)")
    assert outcomes[3].reason.startswith("ZeroDivisionError: division by zero (test_runs.py:")


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_is_shown_on_a_terminal_only_and_wiped():
    with progress_line("x", io.StringIO()) as show:
        assert show is None
    stream = Terminal()
    with progress_line("training", stream) as show:
        show(0, 4, "best 3")
    *_, drawn, wiped, end = stream.getvalue().split("\r")
    assert drawn.startswith("training  [....") and "0/4" in drawn and drawn.endswith("best 3")
    assert wiped.isspace() and len(wiped) >= len(drawn) and end == ""


def test_progress_line_fits_the_terminal():
    behind, terminal = os.openpty()
    termios.tcsetwinsize(terminal, (24, 30))
    with open(terminal, "w") as stream, progress_line("training", stream) as show:
        show(0, 4, "a long note")
    drawn = os.read(behind, 1000).decode().split("\r")
    os.close(behind)
    assert max(map(len, drawn)) < 30 and any("training" in line for line in drawn)


def test_progress_begins_again_with_another_total():
    """Studies count runs, then iterations: the remaining time is that of what is shown."""
    stream = Terminal()
    with progress_line("identify", stream) as show:
        show(3, 4)
        show(0, 100, "fitting")
    assert "0/100  ? left, fitting" in stream.getvalue().split("\r")[-3]
