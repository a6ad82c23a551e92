"""The command line `nmfd`: what its commands write, quick help, --set, and one line for Ctrl-C and
failures."""

import os
import subprocess
import sys
import time

import pytest
import torch
from commands import MAINS, call, error_line, good, last_words, nmfd, runs, same

from nmfd import closed_loop
from nmfd.controllers import training
from nmfd.controllers.rules import PiGate
from nmfd.runs.run_many import run_many
from nmfd.types import Result

HEAVY = ("pydantic", "torch", "casadi", "libsumo", "numpy", "pandas", "matplotlib")


@pytest.fixture
def both(folder, out):
    options = "--controllers no-control,pi-gating --seeds 2 --out"
    return ["benchmark", folder, options, out]


@pytest.fixture
def in_process(monkeypatch):
    """Make runs in this process, where tests can change what they call."""

    def here(*args, **options):
        return run_many(*args, **{**options, "workers": 0})

    monkeypatch.setattr("nmfd.api.run_many", here)


@pytest.mark.parametrize("package", MAINS)
def test_help_is_quick_fits_a_screen_and_shows_examples(package):
    begin, main = time.process_time(), MAINS[package]
    assert sorted(name for names in main.sections.values() for name in names) == sorted(
        main.commands
    )
    for name in main.commands:
        text = good(call(package, name, "--help"))
        assert "Example" in text, name
        assert f"{package} {name}" in text, name
    assert time.process_time() - begin < 2.0
    alone = {
        name: value for name, value in os.environ.items() if not name.startswith("COV")
    }  # not traced
    code = f"import sys, {package}.cli; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=alone
    )
    assert done.stdout == "\n"
    done = subprocess.run(
        [sys.executable, "-m", package], capture_output=True, text=True, env=alone
    )
    lines = (done.stdout + done.stderr).splitlines()  # without arguments, the help is shown
    assert lines[0].startswith("Usage: ")
    assert len(lines) <= 26
    assert max(map(len, lines)) <= 80
    assert f"Begin with `{package}" in " ".join(lines)


def test_benchmark_writes_a_run_folder(both, tmp_path):
    lines = good(nmfd(*both)).splitlines()
    assert lines[1].split()[:2] == ["no-control", "2"]
    assert lines[2].split()[:2] == [
        "pi-gating",
        "2",
    ]
    assert "±" in lines[2]
    assert lines[-1].startswith(f"Written to {tmp_path / 'out'}: see ")
    names = {f"{name}-{seed}.nc" for name in ("no-control", "pi-gating") for seed in (0, 1)}
    assert names | {"runs.csv", "manifest.json", "mfd.png"} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }


def test_settings(folder, out):
    """--set changes a key, in a nested table too, and mistakes name the key."""
    command = ("benchmark", folder, "--controllers pi-gating --out", out, "--set")
    good(nmfd(*command, "steps=3 --set controllers.pi-gating.kp=2.5"))
    assert Result.read(out / "pi-gating-0.nc").accumulation.shape[0] == 4
    for text, problem in (
        ("stepz=3", "scenario.toml: stepz: unknown key; did you mean step?"),
        ("steps=x", "scenario.toml: steps: should be a valid integer, got 'x'"),
        ("controllers.pi-gating.kq=1", "controllers.pi-gating.kq: unknown key"),
        ("steps", "expected KEY=VALUE, such as steps=12, got 'steps' instead"),
    ):
        assert problem in error_line(nmfd(*command, text), "nmfd")


def test_a_failing_controller_names_itself_and_the_others_are_kept(
    both, out, monkeypatch, in_process
):
    monkeypatch.setattr(PiGate, "act", lambda self, measurement: 1 / 0)
    line = last_words(nmfd(*both), 1)
    assert "pi-gating, seed 0: ZeroDivisionError: division by zero (test_cli.py:" in line
    assert set(runs(out)) == {"no-control-0.nc", "no-control-1.nc"}


def test_an_interrupted_benchmark_continues(both, tmp_path, out, monkeypatch, in_process):
    good(nmfd(*both[:-1], tmp_path / "whole"))
    calls, run = [], closed_loop.run

    def stopped(*args, **options):
        calls.append(options["seed"])
        if len(calls) == 3:
            raise KeyboardInterrupt
        return run(*args, **options)

    monkeypatch.setattr(closed_loop, "run", stopped)
    line = last_words(nmfd(*both), 130)
    assert line.startswith("nmfd: interrupted: finished runs are in ")
    assert len(runs(out)) == 2
    good(nmfd(*both))
    assert len(calls) == 5  # two, the interrupted one, and the two that were left
    assert same(runs(out), runs(tmp_path / "whole"))


def test_without_a_compiler_training_is_not_compiled(folder, tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(training, "WORTH_COMPILING", 2)
    good(nmfd("train", folder, "--controller dpc-pc --steps 2"))
    content = torch.load(folder / "dpc-pc.pt", weights_only=True)
    assert content["configuration"]["compiled"] is False


def test_a_gpu_that_is_not_there_is_one_line(folder, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    result = nmfd("train", folder, "--controller dpc-pc --steps 1 --device cuda")
    assert "finds no GPU here" in error_line(result, "nmfd")


def test_show_draws_the_scenario(folder, tmp_path):
    assert "2 regions, 360 trips between 1 pairs" in good(
        nmfd("show", folder, "--out", tmp_path / "figures")
    )
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "spawn_matrix.png",
        "region_map.png",
        "mfd.png",
    }


def test_a_new_controller_runs(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "nmfd benchmark economic_mpc" in good(nmfd("new-controller mine.py"))
    good(nmfd("benchmark", folder, "--controllers mine.py:MyController --set steps=2 --out out"))
    for name, problem in (
        ("mine.py", "exists; choose another"),
        ("mine.txt", "ends in .py"),
        ("no/x.py", "No such"),
    ):
        assert problem in error_line(nmfd("new-controller", name), "nmfd")
