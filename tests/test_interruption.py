"""Ctrl-C and kill -9: finished runs stay, nothing half-written counts, and the same command
continues to the same."""

import os
import shlex
import signal
import subprocess
import sys
import time

import pytest
import tiny
import torch
from commands import good, last_words, nmfd, runs, same, words

from nmfd import api
from nmfd.controllers import training
from nmfd.runs.run_many import run_many


def stopped(program, *arguments, out, by, after="[!.]*.nc", wait=0.0):
    """Run a command in a process group that gets a signal after its first finished run; return
    status and stderr.

    after: pattern of another file; wait: time after that (s). All processes have ended when stderr
        has
    """
    command = [sys.executable, "-m", program, *words(*arguments, "--out", out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 120.0
    while (
        process.poll() is None and time.monotonic() < deadline and not list(out.parent.rglob(after))
    ):
        time.sleep(0.02)
    time.sleep(wait)
    os.killpg(process.pid, by)
    _, said = process.communicate(timeout=60)
    return process.returncode, said


@pytest.mark.parametrize(
    "after, wait",
    [
        pytest.param("*", 0.15, marks=pytest.mark.slow),
        pytest.param(".lock", 0.0, marks=pytest.mark.slow),
        pytest.param("manifest.json", 0.3, marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_at_any_moment_is_one_line(tmp_path, out, after, wait):
    options = "--controllers no-control --seeds 200 --workers 2"
    command = ("benchmark", tiny.write(tmp_path), options)
    returned, said = stopped("nmfd", *command, out=out, by=signal.SIGINT, after=after, wait=wait)
    while "init_import_site" in said:  # before Python itself had started, on a busy machine
        wait *= 2
        returned, said = stopped(
            "nmfd", *command, out=out, by=signal.SIGINT, after=after, wait=wait
        )
    assert returned == 130, said
    assert said.startswith("nmfd: interrupted")
    assert said.count("\n") == 1, said


@pytest.mark.slow
@pytest.mark.parametrize("streams", ["<&- >&- 2>&-", "2>&1 | true"])
def test_runs_are_kept_without_standard_streams(tmp_path, out, streams):
    scenario = tiny.write(tmp_path)
    command = words(sys.executable, "-m nmfd benchmark", scenario, "--controllers no-control")
    subprocess.run(
        [f"{shlex.join(command)} --workers 2 --seeds 2 --out {tmp_path}/out {streams}"], shell=True
    )
    assert len(runs(out)) == 2
    assert (out / "total_accumulation.png").exists()


@pytest.mark.parametrize(
    "by, status",
    [
        pytest.param(signal.SIGINT, 130, id="Ctrl-C"),  # by default: test_cli.py
        pytest.param(signal.SIGTERM, 130, id="SIGTERM"),
        pytest.param(signal.SIGKILL, -9, id="kill -9"),
    ],
)
@pytest.mark.slow
def test_a_stopped_benchmark_continues(tmp_path, out, monkeypatch, by, status):
    scenario = tiny.write(tmp_path)
    options = "--controllers no-control,pi-gating --seeds 10 --workers 2"
    command = ("benchmark", scenario, options)
    returned, said = stopped("nmfd", *command, out=out, by=by)
    assert returned == status, said
    assert "Traceback" not in said
    if status == 130:
        assert said.splitlines()[-1].startswith("nmfd: interrupted: finished runs are in"), said
    first = runs(out)
    assert 0 < len(first) < 20
    monkeypatch.setattr(api, "run_many", lambda *a, **o: run_many(*a, **{**o, "workers": 0}))
    good(nmfd(*command, "--out", out))
    good(nmfd(*command, "--out", tmp_path / "whole"))
    whole = runs(tmp_path / "whole")
    assert len(whole) == 20
    assert same(runs(out), whole)
    assert same(first, {name: whole[name] for name in first})


@pytest.mark.parametrize("stop", [2, 5])
def test_a_resumed_training_is_the_uninterrupted_one(tmp_path, monkeypatch, stop):
    monkeypatch.setattr(training, "VALIDATION_PERIOD", 1)
    command = ("train", tiny.write(tmp_path), "--controller dpc-pcrg --steps 5 --device cpu")
    good(nmfd(*command, "--out", tmp_path / "whole.pt"))
    steps, clip = [], torch.nn.utils.clip_grad_norm_

    def interrupt(*args):
        steps.append(None)
        if len(steps) == stop:
            raise KeyboardInterrupt
        return clip(*args)

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", interrupt)
    line = last_words(nmfd(*command, "--out", tmp_path / "mine.pt"), 130)
    assert line.endswith(f"is {tmp_path / 'mine.pt'}; add --resume to continue")
    assert (tmp_path / "mine.pt").is_file()
    good(nmfd(*command, "--out", tmp_path / "mine.pt", "--resume"))
    assert (tmp_path / "mine.pt").read_bytes() == (tmp_path / "whole.pt").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {
        "network",
        "scenario",
        "whole.pt",
        "mine.pt",
    }
