"""kill -9 at any moment: what was finished stays, nothing half-written counts, and the same command goes on to the same
bytes. Commands run in forked processes, which kill themselves beside a write, or are killed after a while."""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import tiny
import tiny_city
import torch
from commands import MAINS, call, good, killed

from cosim.plant.plant import SumoPlant
from nmfd.api import load_scenario
from nmfd.controllers.dpc import training
from nmfd.errors import InputError
from nmfd.runs import files, run_folder, scratch, workers
from nmfd.runs.files import TEMPORARY
from nmfd.runs.run_folder import LOCK
from nmfd.runs.scratch import Scratch, sweep


def everything_readable(folder: Path) -> None:
    """Every run that counts is there as a whole."""
    if not folder.exists():
        return
    for path in folder.iterdir():
        assert not path.name.startswith(".") or TEMPORARY.fullmatch(path.name) or path.name == LOCK, path
    if (folder / "manifest.json").exists():
        json.loads((folder / "manifest.json").read_text())
    if (folder / "summary.csv").exists():
        for row in run_folder.read_summary(folder / "summary.csv"):
            trajectory = run_folder.read_trajectory(folder / f"{row['controller']}-{row['seed']}.nc")
            assert trajectory.accumulation.sum() * trajectory.step > 0


def arrays(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("*.nc")}


def interrupted(file: Path, *command, after: float, by: int = signal.SIGINT) -> tuple[int, str]:
    """Exit status and stderr (through `file`) of a command in a forked process that gets Ctrl-C, or another signal,
    after so many seconds."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        with suppress(BaseException):
            with file.open("w", encoding="utf-8") as stream:
                os.dup2(stream.fileno(), 1), os.dup2(stream.fileno(), 2)
            sys.stdout, sys.stderr = (open(n, "w", encoding="utf-8", closefd=False) for n in (1, 2))
            signal.signal(signal.SIGINT, signal.default_int_handler)
            program, *arguments = map(str, command)
            os.write(writer, b"x")
            try:
                MAINS[program](arguments)
            except SystemExit as end:
                sys.stderr.flush()
                os._exit(end.code)
        os._exit(99)
    os.read(reader, 1)
    time.sleep(after)
    os.kill(child, by)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), file.read_text(encoding="utf-8")


@pytest.mark.slow
def test_ctrl_c_at_random_moments(tmp_path):
    """Status 130 and a line, unless it was too late; the same command then goes on to the same bytes."""
    scenario, out, draw = tiny.write(tmp_path), tmp_path / "out", random.Random(4)
    command = ("nmfd", "benchmark", scenario, "--controllers", "no-control,mpc-pc", "--seeds", 2, "--out")
    good(call(*command, tmp_path / "whole"))  # the first time takes longer: libraries and checks are set up
    begin = time.monotonic()
    good(call(*command, tmp_path / "again"))
    lasted, seen = time.monotonic() - begin, set()
    for share in (0.0, 0.1, 0.3, 0.6):
        status, said = interrupted(tmp_path / "said", *command, out, after=lasted * (share + 0.1 * draw.random()))
        seen.add(status)
        assert status in (0, 130) and "Traceback" not in said and said.count("interrupted") == (status == 130), said
        everything_readable(out)
        if status == 0:
            break
    assert 130 in seen
    good(call(*command, out))
    assert arrays(out) == arrays(tmp_path / "whole")


@pytest.mark.parametrize(
    "command",
    [
        ("benchmark", "--controllers", "no-control,mpc-pc", "--seeds", 200),
        ("bound", "--controller", "bound-pc", "--iterations", 100_000),
    ],
    ids=["benchmark", "bound"],
)
def test_sigterm_ends_like_ctrl_c(tmp_path, command):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    name, *options = command
    out = tmp_path / "out" if name == "benchmark" else tmp_path / "plan.npz"
    status, said = interrupted(
        tmp_path / "said", "nmfd", name, scenario, *options, "--out", out, after=1.0, by=signal.SIGTERM
    )
    assert status == 143 and "Traceback" not in said and said.splitlines()[-1].startswith("nmfd: interrupted"), said
    assert not [path for path in tmp_path.rglob(".*") if path.name == LOCK or TEMPORARY.fullmatch(path.name)]
    if name == "benchmark":
        everything_readable(out)


def test_an_interrupt_that_a_compiled_library_made_an_error_of_its_own_of(monkeypatch, capsys):
    """matplotlib's drawing of a path says `Invalid bounding box` where Ctrl-C comes while it reads an array."""

    def draw(**_):
        with suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        raise ValueError("Invalid bounding box")

    monkeypatch.setattr(MAINS["nmfd"].commands["show"], "callback", draw)
    for number in (signal.SIGINT, signal.SIGTERM):
        with pytest.raises(SystemExit) as end:
            MAINS["nmfd"](["show"])
        assert end.value.code == 128 + number and capsys.readouterr().err == "nmfd: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


BOUNDARIES = [(1, False), (1, True), (2, False), (2, True), (3, False), (3, True), (5, True), (6, False), (8, True)]


@pytest.mark.slow
def test_benchmark_killed_beside_its_writes(tmp_path):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    command = ("nmfd", "benchmark", scenario, "--controllers", "no-control,pi-gating", "--out")
    good(call(*command, tmp_path / "whole"))
    for write, behind in BOUNDARIES:
        killed(*command, out, write=write, behind=behind)
        everything_readable(out)
    good(call(*command, out))
    assert arrays(out) == arrays(tmp_path / "whole")
    assert {path.name for path in out.iterdir()} == {path.name for path in (tmp_path / "whole").iterdir()}


@pytest.mark.slow
def test_benchmark_killed_at_random_moments(tmp_path):
    scenario, out, draw = tiny.write(tmp_path), tmp_path / "out", random.Random(1)
    command = ("nmfd", "benchmark", scenario, "--controllers", "no-control,pi-gating,mpc-pc", "--seeds", 3, "--out")
    begin = time.monotonic()
    good(call(*command, tmp_path / "whole"))
    lasted = time.monotonic() - begin
    for _ in range(6):
        killed(*command, out, after=draw.uniform(0.0, lasted))
        everything_readable(out)
    good(call(*command, out))
    assert arrays(out) == arrays(tmp_path / "whole")
    rows = [
        [
            {**row, "evaluation_time_s": 0, "control_step_ms_median": 0, "control_step_ms_max": 0}
            for row in run_folder.read_summary(folder / "summary.csv")
        ]
        for folder in (out, tmp_path / "whole")
    ]
    assert rows[0] == rows[1]


@pytest.mark.parametrize(
    "kill", [*({"write": n, "behind": behind} for n in (1, 2, 4) for behind in (False, True)), {"after": 0.2}]
)
def test_training_killed_and_resumed_is_the_uninterrupted_one(tmp_path, monkeypatch, kill):
    monkeypatch.setattr(training, "VALIDATE_EVERY", 1)
    scenario = tiny.write(tmp_path)
    command = ("nmfd", "train", scenario, "--controller", "dpc-pcrg", "--steps", 5, "--no-compile", "--device", "cpu")
    good(call(*command, "--out", tmp_path / "whole.pt"))
    out = tmp_path / "mine.pt"
    killed(*command, "--out", out, **kill)
    if out.exists():
        torch.load(out, weights_only=True)
    started = (tmp_path / "mine.pt.resume").exists()
    good(call(*command, "--out", out, *(["--resume"] if started else [])))
    whole, mine = (torch.load(file, weights_only=True) for file in (tmp_path / "whole.pt", out))
    assert all(torch.equal(whole["weights"][key], mine["weights"][key]) for key in whole["weights"])
    assert out.read_bytes() == (tmp_path / "whole.pt").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {
        "network",
        "scenario",
        "whole.pt",
        "mine.pt",
    }


@pytest.mark.parametrize("content", [b"", b"x", {"configuration": {}}, {"configuration": 5}, [1], "cut"])
def test_a_damaged_training_state_is_one_line(tmp_path, monkeypatch, content):
    monkeypatch.setattr(training, "VALIDATE_EVERY", 1)
    scenario, state = tiny.write(tmp_path), tmp_path / "p.pt.resume"
    command = (
        "nmfd",
        "train",
        scenario,
        "--controller",
        "dpc-pc",
        "--steps",
        3,
        "--no-compile",
        "--device",
        "cpu",
        "--out",
        tmp_path / "p.pt",
    )
    if isinstance(content, bytes):
        state.write_bytes(content)
    elif content == "cut":
        assert killed(*command, write=3)
        state.write_bytes(state.read_bytes()[:900])
    else:
        torch.save(content, state)
    result = call(*command, "--resume")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and "p.pt.resume: " in result.stderr


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    folder = tmp_path_factory.mktemp("city")
    config = tiny_city.city(folder)
    good(
        call(
            "cosim",
            "import",
            config,
            "--regions",
            3,
            "--out",
            folder / "networks" / "tiny",
        )
    )
    return folder / "scenarios" / "tiny"


def test_a_run_in_sumo_killed_starts_again_from_its_beginning(city, tmp_path):
    command = ("cosim", "run", city, "--controller", "pi-gating", "--steps", 3, "--out")
    good(call(*command, tmp_path / "whole"))
    out, draw = tmp_path / "out", random.Random(2)
    for kill in [{"write": n, "behind": n % 2 == 0} for n in (1, 2, 3, 4, 5)] + [{"after": draw.uniform(0.1, 0.8)}]:
        killed(*command, out, **kill)
        everything_readable(out)
    good(call(*command, out))
    assert arrays(out) == arrays(tmp_path / "whole") and len(arrays(out)) == 1
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


@pytest.mark.slow
def test_an_evaluation_killed_goes_on_to_the_same_bytes(city, tmp_path):
    command = (
        "cosim",
        "evaluate",
        city,
        "--controllers",
        "no-control,pi-gating",
        "--seeds",
        2,
        "--steps",
        3,
        "--workers",
        1,
        "--out",
    )
    good(call(*command, tmp_path / "whole"))
    out, draw = tmp_path / "out", random.Random(3)
    for _ in range(4):
        killed(*command, out, after=draw.uniform(1.0, 15.0))
        everything_readable(out / "demand-1")
    good(call(*command, out))
    assert arrays(out / "demand-1") == arrays(tmp_path / "whole" / "demand-1")


def test_an_import_killed_is_no_network_or_a_whole_one(tmp_path):
    config = tiny_city.city(tmp_path)
    out, scenario = tmp_path / "networks" / "tiny", tmp_path / "scenarios" / "tiny"
    command = ("cosim", "import", config, "--regions", 3, "--out", out)
    for write in (1, 4, 8):
        assert killed(*command, write=write, behind=True)
        assert not (out / "network.toml").exists() and not (scenario / "scenario.toml").exists()
    good(call(*command))
    before = (out / "network.toml").read_bytes()
    assert killed(*command, "--force", write=2, behind=True)
    assert not (out / "network.toml").exists()
    good(call(*command, "--force"))
    assert (out / "network.toml").read_bytes() == before


PARENT = """
import os, sys, time
from pathlib import Path
from nmfd.runs.workers import outcomes

def sleep_and_tell(folder):
    (folder / str(os.getpid())).write_text("")
    time.sleep(60.0)

if __name__ == "__main__":
    for _ in outcomes(sleep_and_tell, [Path(sys.argv[1])] * 2, workers=2):
        pass
"""


def test_workers_do_not_outlive_a_killed_parent(tmp_path):
    script, folder = tmp_path / "parent.py", tmp_path / "pids"
    folder.mkdir()
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, script, folder])
    try:
        assert wait_for(lambda: len(list(folder.iterdir())) == 2, 60.0)
        children = [int(path.name) for path in folder.iterdir()]
        assert all(map(alive, children))
    finally:
        parent.kill()
        parent.wait()
    assert wait_for(lambda: not any(map(alive, children)), 10.0)


def alive(process: int) -> bool:
    """Running, and no zombie that nobody has waited for."""
    try:
        return Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_for(condition, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


def test_the_second_of_two_runs_into_one_folder_is_told(tmp_path):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    out.mkdir()
    with files.locked(out / LOCK, out):
        for program, command in (
            ("nmfd", ("benchmark", scenario, "--controllers", "no-control", "--out", out)),
            ("nmfd", ("robustness", scenario, "--controllers", "no-control", "--scenarios", 1, "--out", out)),
        ):
            result = call(program, *command)
            assert result.exit_code == 2 and result.stderr.count("\n") == 1
            assert f"out: process {os.getpid()} on " in result.stderr and "is writing to it" in result.stderr
    assert not (out / LOCK).exists()
    good(call("nmfd", "benchmark", scenario, "--controllers", "no-control", "--out", out))
    assert not (out / LOCK).exists()


def test_the_second_of_two_trainings_of_one_policy_is_told(tmp_path):
    scenario = tiny.write(tmp_path)
    with files.locked(scenario / ".dpc-pc.pt.lock", scenario / "dpc-pc.pt"):
        result = call("nmfd", "train", scenario, "--controller", "dpc-pc", "--steps", 1, "--device", "cpu")
    assert result.exit_code == 2 and "is writing to it" in result.stderr
    good(call("nmfd", "train", scenario, "--controller", "dpc-pc", "--steps", 1, "--device", "cpu"))


def test_the_lock_of_a_killed_process_is_no_lock(tmp_path):
    child = os.fork()
    if child == 0:
        with files.locked(tmp_path / LOCK, tmp_path):
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert (tmp_path / LOCK).exists()
    with files.locked(tmp_path / LOCK, tmp_path):
        with pytest.raises(InputError, match="is writing to it"), files.locked(tmp_path / LOCK, tmp_path):
            pass
    assert not (tmp_path / LOCK).exists()


def test_temporary_files_of_others_are_left_alone(tmp_path):
    (tmp_path / ".dpc-pc-12.tmp.pt").write_text("")
    (tmp_path / ".dpc-pc-robust-12.tmp.pt").write_text("")
    (tmp_path / ".mine").write_text("")
    files.sweep(tmp_path, {"dpc-pc"})
    assert {path.name for path in tmp_path.iterdir()} == {".dpc-pc-robust-12.tmp.pt", ".mine"}
    files.sweep(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {".mine"}


def test_a_mistake_in_every_run_is_a_mistake_of_the_user():
    mistakes = [("a", workers.Failure("x", mistake=True)), ("b", workers.Failure("y", mistake=True))]
    assert isinstance(workers.ended(mistakes), InputError) and str(workers.ended(mistakes)) == "a: x; b: y"
    assert isinstance(workers.ended([*mistakes, ("c", workers.Failure("z"))]), workers.RunFailed)


def test_arrays_of_a_run_hold_no_times(tmp_path):
    """Else no two runs could have the same bytes."""
    scenario = tiny.write(tmp_path)
    for name in ("a", "b"):
        good(call("nmfd", "benchmark", scenario, "--controllers", "mpc-pc", "--out", tmp_path / name))
    assert arrays(tmp_path / "a") == arrays(tmp_path / "b")
    assert np.isnan(run_folder.read_trajectory(tmp_path / "a" / "mpc-pc-0.nc").decision_time).all()


def test_scratch_folders_of_killed_processes_go_at_the_next_start(tmp_path, monkeypatch, city):
    """Those of living ones stay, and so does what is none."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "cosim-mine").mkdir()
    child = os.fork()
    if child == 0:
        plant = SumoPlant(load_scenario(city))
        plant.reset(0)
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    [left] = [path for path in tmp_path.glob("cosim-*") if path.name != "cosim-mine"]
    assert (left / "trips.rou.xml").is_file()
    with Scratch("cosim-") as own:
        assert not left.exists() and own.is_dir()
        good(call("cosim", "run", city, "--controller", "no-control", "--steps", 2, "--out", tmp_path / "out"))
        assert own.is_dir()
    assert [path.name for path in tmp_path.glob("cosim-*")] == ["cosim-mine"]


def test_what_is_made_while_others_look_for_old_folders_stays(tmp_path, monkeypatch):
    """A folder that was taken for an old one before it was locked is made anew."""
    acquire = scratch.FileLock.acquire

    def swept_before(lock):
        monkeypatch.setattr(scratch.FileLock, "acquire", acquire)
        Path(lock.lock_file).touch()
        sweep(tmp_path, "x-")
        return acquire(lock)

    monkeypatch.setattr(scratch.FileLock, "acquire", swept_before)
    with Scratch("x-", where=tmp_path) as folder:
        sweep(tmp_path, "x-")
        assert list(tmp_path.iterdir()) == [folder]
    assert not list(tmp_path.iterdir())


def test_what_is_written_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    """After a power loss: the content before the name, and the name before anybody says that it is there."""
    done, sync, replace = [], os.fsync, os.replace

    def noted(handle):
        done.append(Path(os.readlink(f"/proc/self/fd/{handle}")))
        sync(handle)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(os, "replace", lambda source, target: (done.append("replace"), replace(source, target)))
    files.write_text(tmp_path / "a.csv", "x")
    assert done == [tmp_path / f".a-{os.getpid()}.tmp.csv", "replace", tmp_path]
    assert (tmp_path / "a.csv").read_text() == "x"
