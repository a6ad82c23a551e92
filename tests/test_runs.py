"""Results and their files; many runs in a folder: nothing half-written, resumable, the same numbers
everywhere."""

import errno
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial

import numpy as np
import pandas as pd
import pytest
import tiny
import trajectories
import xarray as xr
from commands import problem
from filelock import FileLock
from trajectories import trajectory

from cosim.plant.record import RECORD
from nmfd import api, metrics
from nmfd.api import load_scenario
from nmfd.errors import InputError, RunFailed
from nmfd.runs import files
from nmfd.runs import run_many as module
from nmfd.runs.run_many import Run, finished_table, raise_failures, read_manifest, run_many
from nmfd.types import VARIABLES, Quantity, Result


def test_a_result_is_read_as_it_was_written(tmp_path):
    half = {"edge_vehicles": np.full((4, 5), 0.1, np.float16)}
    record = trajectories.record(4, regions=2) | half
    original = trajectories.recorded(trajectory(), record, {"co2_kg": 3.25, "notes": ""})
    original.write(tmp_path / "a.nc")
    back = Result.read(tmp_path / "a.nc")
    xr.testing.assert_identical(back.data, original.data)
    assert (back.controller, back.plant, back.seed, back.step) == ("no-control", "nmfd", 0, 30.0)
    assert back.co2_kg == 3.25
    assert back["gateway_flow"].shape == (4, 3)
    assert list(back["note"]) == ["", "", "", "no"]
    assert list(tmp_path.iterdir()) == [tmp_path / "a.nc"]
    assert pickle.loads(pickle.dumps(back)).seed == 0
    with pytest.raises(AttributeError, match="nothing"):
        _ = back.nothing


def test_arrays_without_entries_are_read_as_they_were_written(tmp_path):
    queue = Quantity(("time", "gateway"), "veh", "queue")
    original = trajectory().add({}, {"queue": queue}, queue=np.zeros((5, 0))).label(gateway=[])
    original.write(tmp_path / "a.nc")
    xr.testing.assert_identical(Result.read(tmp_path / "a.nc").data, original.data)


def test_the_same_run_is_the_same_but_for_times():
    one = trajectory()
    other = one.assign(decision_time=2.0 * one.decision_time, wall_time=7.0)
    assert not one.data.identical(other.data)
    assert one.without_times().identical(other.without_times())
    assert not one.without_times().identical(trajectory(seed=1).without_times())


def test_xarray_opens_a_run_with_names_and_units(tmp_path):
    original, record = trajectory(), trajectories.record(4, regions=2)
    original.add({}, RECORD, **record).assign(estimated=True).write(tmp_path / "a.nc")
    with xr.open_dataset(tmp_path / "a.nc") as data:
        assert dict(data.sizes) == {
            **{"time": 5, "interval": 4, "region": 2, "destination": 2, "next_region": 2},
            **{"gateway": 3, "edge": 5},
        }
        assert data.attrs["estimated"] == 1
        assert set(data.data_vars) == {*VARIABLES, *RECORD}
        for name, values in data.variables.items():
            assert values.attrs["long_name"], name
            assert "units" in values.attrs or name == "note", name
        assert list(data["status"].values) == [0, 0, 0, 3]  # a solver failure and a fallback
        assert list(data["time"].values) == [0.0, 30.0, 60.0, 90.0, 120.0]
        assert data["time"].attrs["units"] == "s"
        assert (
            float(data["accumulation"].sel(time=60.0, region=1, destination=0))
            == original.accumulation[2, 1, 0]
        )


def test_a_row_holds_the_figures_and_the_facts_of_a_run():
    row = metrics.summary(trajectories.recorded(trajectory(), {}, {"trips": 12}))
    assert list(row)[:4] == ["controller", "seed", "plant", "total_time_spent_veh_s"]
    assert list(row)[-1] == "trips"
    assert row["trips"] == 12
    assert row["solver_failures"] == 1
    assert set(metrics.COUNTED) < set(row)
    facts = Result({}, {"controller": "x", "seed": 1, "trips_veh": 2.0, "key": "{}"})
    assert metrics.summary(facts) == {"controller": "x", "seed": 1, "trips_veh": 2.0}
    assert "accumulation" in trajectory()._repr_html_()


def test_decision_times_are_processor_times_of_all_threads(tmp_path):
    scenario = load_scenario(tiny.write(tmp_path))

    def burn():
        while time.thread_time() < 0.06:
            pass

    class Sleeper:
        name = "sleeper"

        def reset(self, seed=0):
            self.begun = False

        def act(self, observation):
            if not self.begun:
                self.begun, thread = True, threading.Thread(target=burn)
                thread.start()
                thread.join()
            time.sleep(0.03)
            return tiny.gates_at(scenario, 0.5)

    row = metrics.summary(api.run(scenario, Sleeper()))
    assert (
        row["control_step_ms_first"]
        == row["control_step_ms_max"]
        >= 60.0
        > 20.0
        > row["control_step_ms_median"]
    )


@pytest.mark.parametrize("damage", ["missing", "cut off", "empty", "a table"])
def test_what_is_no_run_is_one_line(tmp_path, damage):
    file = tmp_path / "a.nc"
    if damage != "missing":
        trajectory().write(file)
        whole = file.read_bytes()
        file.write_bytes(
            {"cut off": whole[: len(whole) // 2], "empty": b"", "a table": b"a,b\n1,2\n"}[damage]
        )
    assert re.search(r"a\.nc: (no such run|is no run of this version)", problem(Result.read, file))


def test_atomic_write_leaves_the_old_file_when_interrupted(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), files.atomic(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


# Jobs, for processes that import this module.
def job(controller="no-control", seed=0, calls=None):
    if calls is not None:
        calls.append((controller, seed))
    return trajectory(controller, seed)


def die(status=3):
    os._exit(status)


def crash():
    os.kill(os.getpid(), signal.SIGSEGV)


def divide():
    return 1 / 0


def run_of(
    controller="no-control", seed=0, *, calls=None, scenario="s", policy="p", folder="", work=None
):
    key = {"scenario_hash": scenario, "controller": {"policy_hash": policy}}
    return Run(
        files.run_name(controller, seed), key, work or partial(job, controller, seed, calls), folder
    )


run_here = partial(run_many, workers=0)


def test_runs_are_done_once_and_come_in_the_order_asked_for(tmp_path):
    calls, out = [], tmp_path / "a" / "out"
    first = [run_of("b", 1, calls=calls), run_of("a", 0, calls=calls)]
    rows = run_here(first, out)
    assert list(zip(rows["controller"], rows["seed"], strict=True)) == [("b", 1), ("a", 0)] == calls
    assert set(rows["failure"]) == {""}
    assert rows["total_time_spent_veh_s"].iloc[1] > 0
    assert "folder" not in rows
    again = run_here([run_of("c", calls=calls), *first[1:]], out)
    assert list(again["controller"]) == ["c", "a", "b"]
    assert len(calls) == 3
    pd.testing.assert_frame_equal(
        again, pd.read_csv(out / "runs.csv", keep_default_na=False), check_dtype=False
    )
    manifest = read_manifest(out)
    assert [session["seeds"] for session in manifest["sessions"]] == [[0, 1], [0]]
    assert manifest["folders"][""] == {
        "key": {"scenario_hash": "s"},
        "controllers": {name: {"policy_hash": "p"} for name in "bac"},
    }
    assert {"command", "commit", "versions", "date"} <= set(manifest["sessions"][0])
    assert re.fullmatch(r"None|[0-9a-f]{40}", str(manifest["sessions"][0]["commit"]))


def test_a_run_with_another_key_is_replaced_only_if_that_is_said(tmp_path, capsys):
    calls, out = [], tmp_path / "out"
    run_here([run_of("a", calls=calls), run_of("b", calls=calls)], out)
    changed = [run_of("a", calls=calls, policy="q"), run_of("b", calls=calls)]
    with pytest.raises(InputError, match=r"a-0.nc: is a run with other settings \(controller ch"):
        run_here(changed, out)
    assert len(calls) == 2
    run_here(changed, out, overwrite=True)
    assert calls == [("a", 0), ("b", 0), ("a", 0)]
    assert "a-0.nc: out of date, controller changed" in capsys.readouterr().err
    other = [run_of("a", calls=calls, scenario="other")]
    with pytest.raises(InputError, match="scenario_hash changed.*or add --overwrite"):
        run_here(other, out)
    rows = run_here(other, out, overwrite=True)
    assert len(calls) == 4
    assert list(rows["controller"]) == ["a"]


def test_files_that_are_no_runs_are_left_alone(tmp_path, capsys):
    calls, out = [], tmp_path / "out"
    runs = [run_of("a", calls=calls)]
    first = run_here(runs, out)
    (out / "a-before.nc").write_bytes((out / "a-0.nc").read_bytes())
    (out / "a-7.nc").write_bytes((out / "a-0.nc").read_bytes())
    os.mkfifo(out / "a-8.nc")
    again = run_here(runs, out)
    pd.testing.assert_frame_equal(first, again)
    assert "a-7.nc: is the run of a with seed 0, not that of its name" in capsys.readouterr().err
    rows = run_here([run_of("a", 7, calls=calls), run_of("a", 8, calls=calls)], out)
    assert set(rows["seed"]) == {0, 7, 8}
    assert calls == [("a", 0), ("a", 7), ("a", 8)]


@pytest.mark.parametrize(
    "content", ["[]", "{", '{"folders": {"": {}}, "sessions": [{}]}', '{"folders": {}}']
)
def test_a_damaged_manifest_is_one_line(out, content):
    run_here([run_of()], out)
    (out / "manifest.json").write_text(content)
    line = problem(run_here, [run_of()], out)
    assert "manifest.json: is no manifest of runs, or damaged" in line


def test_a_name_that_no_file_can_have_is_refused_before_the_runs(out):
    calls = []
    with pytest.raises(InputError, match="its name is longer than the 200 bytes"):
        run_here([run_of("a" * 250, calls=calls)], out)
    assert calls == []


def test_a_run_that_lasts_too_long_is_ended_and_the_others_go_on(out):
    runs = [run_of("a", work=partial(time.sleep, 600)), run_of("b")]
    rows = run_many(runs, out, time_limit=3.0).set_index("controller")["failure"]
    assert rows["a"] == "its time limit of 3 s is over"
    assert rows["b"] == ""


def test_folders_of_killed_processes_are_swept(tmp_path):
    code = (
        "import os, pathlib, signal; from nmfd.runs.files import temporary_folder\n"
        f"with temporary_folder(where=pathlib.Path({str(tmp_path)!r})) as folder:\n"
        "    os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code], check=False)
    assert len(list(tmp_path.iterdir())) == 1
    with files.temporary_folder(where=tmp_path) as folder:
        assert len(list(tmp_path.iterdir())) == 2  # it may be new, without its lock
        past = time.time() - 10.0
        for held in tmp_path.glob("*/.held"):
            os.utime(held, (past, past))
        files.sweep(tmp_path, "cosim-")
        assert list(tmp_path.iterdir()) == [folder]
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_is_cut_off_is_done_again(out):
    calls, file = [], out / "a-0.nc"
    run_here([run_of("a", calls=calls)], file.parent)
    file.write_bytes(file.read_bytes()[:100])
    assert len(run_here([run_of("a", calls=calls)], file.parent)) == 1
    assert len(calls) == 2


@pytest.fixture
def two_runs(tmp_path):
    """Two runs and their folder."""
    runs, out = [run_of("b"), run_of("a")], tmp_path / "out"
    run_here(runs, out)
    return runs, out


def test_finished_runs_are_not_read_again(two_runs, monkeypatch):
    runs, out = two_runs
    written = (out / "runs.csv").stat().st_mtime_ns
    expected = pd.read_csv(out / "runs.csv")
    monkeypatch.setattr(Result, "read", None)
    again = run_here(runs, out)
    assert again["controller"].tolist() == ["b", "a"]
    pd.testing.assert_frame_equal(finished_table(out), expected)
    assert (out / "runs.csv").stat().st_mtime_ns == written


@pytest.mark.parametrize("damaged", ["runs.csv", ".rows.json"])
@pytest.mark.parametrize("content", [None, "", "controller,seed\nb,x\n", '{"runs": {}}'])
def test_tables_that_do_not_match_the_files_are_repaired(two_runs, damaged, content):
    runs, out = two_runs
    expected = (out / "runs.csv").read_text()
    (out / damaged).unlink()
    if content is not None:
        (out / damaged).write_text(content)
    assert sorted(finished_table(out)["controller"]) == ["a", "b"]
    run_here(runs, out)
    assert (out / "runs.csv").read_text() == expected


def test_rows_are_those_of_files_that_have_changed(two_runs):
    runs, out = two_runs
    stamp = (out / "a-0.nc").stat()
    Result.read(out / "a-0.nc").assign(completed=np.full(5, 7.0)).write(out / "a-0.nc")
    os.utime(out / "a-0.nc", ns=(stamp.st_atime_ns, stamp.st_mtime_ns + 1))
    assert finished_table(out)["completed_veh"].tolist()[1] == 7.0
    assert run_here(runs, out)["completed_veh"].tolist()[1] == 7.0
    (out / "b-0.nc").unlink()
    assert finished_table(out)["controller"].tolist() == ["a"]


def test_rows_of_other_code_are_made_again(two_runs):
    runs, out = two_runs
    known = json.loads((out / ".rows.json").read_text())
    known["runs"]["a-0.nc"][0]["completed_veh"] = 7.0
    (out / ".rows.json").write_text(json.dumps(known))
    assert run_here(runs, out)["completed_veh"].tolist()[1] == 7.0
    (out / ".rows.json").write_text(json.dumps({**known, "made_by": "older"}))
    assert run_here(runs, out)["completed_veh"].tolist()[1] != 7.0


def test_some_arrays_are_those_of_the_whole_file(two_runs):
    _, out = two_runs
    whole = Result.read(out / "a-0.nc")
    some = Result.read(out / "a-0.nc", only=("accumulation", "other"))
    np.testing.assert_array_equal(some["accumulation"], whole["accumulation"])
    assert some.attrs == whole.attrs
    assert list(some.data) == ["accumulation"]


def test_levels_have_folders_of_their_own(out):
    runs = [run_of("path/to/file.py:Class", level, folder=f"demand-{level}") for level in (1, 2)]
    rows = run_here(runs, out)
    assert list(rows["folder"]) == ["demand-1", "demand-2"]
    assert set(rows["controller"]) == {"path/to/file.py:Class"}
    assert len(list((out / "demand-1").glob("*.nc"))) == 1
    assert len(run_here(runs[:1], out)) == 2


def test_failures_are_rows_and_the_others_go_on(out):
    def mistaken():
        raise InputError("policy.pt: no such file")

    runs = [
        run_of("a", work=lambda: 1 / 0),
        run_of("b", work=mistaken),
        run_of("c", work=lambda: exit(3)),
        run_of("d"),
    ]
    rows = run_here(runs, out).set_index("controller")["failure"]
    assert rows["a"].startswith("ZeroDivisionError: division by zero (test_runs.py:")
    assert rows["b"] == "policy.pt: no such file"
    assert rows["c"].startswith("SystemExit: 3")
    assert rows["d"] == ""
    with pytest.raises(RunFailed, match=r"^a, seed 0: ZeroDivisionError.*; b, seed 0: policy.pt"):
        raise_failures(run_here(runs, out))
    assert set(run_here([run_of(name) for name in "abcd"], out)["failure"]) == {""}


@pytest.mark.slow
def test_processes_that_die_are_rows_and_give_the_same_numbers(tmp_path):
    works = {"a": die, "b": partial(die, 0), "c": crash, "e": None}
    runs = [run_of(name, work=work) for name, work in works.items()]
    rows = run_many(runs, tmp_path / "out", workers=3).set_index("controller")["failure"]
    assert rows.to_dict() == {
        "a": "its process died (status 3)",
        "b": "its process died (status 0)",
        "c": "its process died (status -11, Segmentation fault)",
        "e": "",
    }
    run_here([run_of("e")], tmp_path / "here")
    one, other = (Result.read(tmp_path / where / "e-0.nc") for where in ("out", "here"))
    assert one.data.identical(other.data)


@pytest.mark.slow
def test_a_script_without_a_guard_is_not_run_again_by_its_processes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(f"""
import sys
sys.path.append({os.path.dirname(__file__)!r})
print("begun")
from test_runs import run_of, run_many
print(list(run_many([run_of("a"), run_of("b")], {str(tmp_path / "out")!r}, workers=2)["failure"]))
""")
    (tmp_path / "statistics.py").write_text(
        "raise ImportError"
    )  # a file of the user is not a module
    done = subprocess.run(
        [sys.executable, "-P", script], capture_output=True, text=True, cwd=tmp_path, timeout=120
    )
    assert done.stdout.split("\n") == ["begun", "['', '']", ""], done.stderr


def test_a_folder_is_that_of_one_process_and_of_runs(tmp_path, out):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: is a file"):
        run_here([run_of()], tmp_path / "file")
    with pytest.raises(InputError, match="is not empty and holds no manifest.json"):
        run_here([run_of()], tmp_path)
    run_here([run_of()], out)
    with (
        FileLock(out / ".lock"),
        pytest.raises(InputError, match="another process is writing to it"),
    ):
        run_here([run_of()], out)
    with module.locked(out):  # as a command does
        run_here([run_of()], out)


def test_a_full_disk_leaves_nothing_that_is_refused(tmp_path, out, monkeypatch):
    def full(path, _):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with (
        monkeypatch.context() as patch,
        pytest.raises(OSError, match="No space left on device: .*manifest.json"),
    ):
        patch.setattr(module, "write_text", full)
        run_here([run_of()], out)
    assert list(tmp_path.iterdir()) == []
    out.mkdir()
    (out / ".manifest-1.tmp.json").write_text("{")  # of a process that was killed
    assert len(run_here([run_of()], out)) == 1


def test_progress_counts_runs(out):
    shown = []
    run_here(
        [run_of("a"), run_of("b")],
        out,
        progress=lambda *what: shown.append(what),
    )
    assert shown == [(0, 2, ""), (1, 2, "a-0"), (2, 2, "b-0")]


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_runs(out):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, dashboard_address=None
    ) as cluster:
        runs = [run_of("a"), run_of("b", work=die), run_of("c", work=divide)]
        rows = run_many(runs, out, scheduler=cluster.scheduler_address).set_index("controller")[
            "failure"
        ]
    assert rows["a"] == ""
    assert rows["b"] == "its process died (status 3)"
    assert "ZeroDivisionError" in rows["c"]
    assert (
        Result.read(out / "a-0.nc")
        .without_times()
        .identical(trajectory("a").assign(key=json.dumps(dict(runs[0].key))).without_times())
    )


def test_a_scheduler_that_does_not_answer_is_one_line(out, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(module, "DASK_PATIENCE_S", 0.2)
    with pytest.raises(InputError, match="no Dask scheduler answers at 'tcp://127.0.0.1:1'"):
        run_many([run_of()], out, scheduler="tcp://127.0.0.1:1")


@pytest.mark.slow
def test_ctrl_c_leaves_no_lock_behind(tmp_path):
    """After an interrupt in the middle of xarray's work, results are still written and read."""
    run, interrupts = trajectory(), 0

    def interrupt():
        while interrupts < 10:
            time.sleep(0.1)
            os.kill(os.getpid(), signal.SIGINT)

    (thread := threading.Thread(target=interrupt)).start()
    while interrupts < 10:
        with suppress(KeyboardInterrupt):
            while True:
                run.write(tmp_path / "a.nc")
                Result.read(tmp_path / "a.nc")
        interrupts += 1
    with suppress(KeyboardInterrupt):
        thread.join()
    xr.testing.assert_identical(Result.read(tmp_path / "a.nc").data, run.data)
