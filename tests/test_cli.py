"""The command line: benchmark, train and show on a tiny scenario; quick help; one line for Ctrl-C and failures."""

import importlib
import json
import os
import subprocess
import sys

import click
import numpy as np
import pytest
import tiny
import torch
from commands import nmfd
from nmfd.cli.declared import Declared, shown
from PIL import Image

from cosim.cli import main
from nmfd import closed_loop
from nmfd.controllers.dpc import rollout, training
from nmfd.controllers.rules import PiGating
from nmfd.controllers.strategy import CONTROLLERS
from nmfd.runs import run_folder
from nmfd.studies import benchmark

HEAVY = ("pydantic", "torch", "casadi", "libsumo", "numpy", "pandas", "matplotlib")
TIMES = ("evaluation_time_s", "control_step_ms_median", "control_step_ms_max")
COLUMNS = (
    "controller,seed,plant,total_time_spent_veh_s,final_accumulation_veh,max_accumulation_veh,completed_veh,"
    "evaluation_time_s,control_step_ms_median,control_step_ms_max,solver_failures,fallbacks,"
    "late_decisions,sensor_faults,plant_faults"
)


@pytest.fixture
def scenario(tmp_path):
    return tiny.write(tmp_path)


@pytest.fixture
def benchmark_command(scenario, tmp_path):
    return ["benchmark", scenario, "--controllers", "no-control,pi-gating", "--seeds", 2, "--out", tmp_path / "out"]


def timeless(folder):
    """The rows of summary.csv without what differs from run to run, and the bytes of every trajectory."""
    rows = [
        {key: value for key, value in row.items() if key not in TIMES}
        for row in run_folder.read_summary(folder / "summary.csv")
    ]
    return rows, {path.name: path.read_bytes() for path in folder.glob("*.nc")}


def commands(package):
    """The command line itself and every command of `package`."""
    group = importlib.import_module(f"{package}.cli.main").main
    return [[], *([command] for command in group.commands)]


@pytest.mark.parametrize("package", ["nmfd", "cosim"])
def test_help_is_quick_and_shows_an_example(package):
    alone = {name: value for name, value in os.environ.items() if not name.startswith("COV")}  # not traced
    for command in commands(package):
        call = [sys.executable, "-c", f"from {package}.cli.main import main; main()", *command, "--help"]
        durations = []
        for _ in range(4):  # the least of them, and processor time: the machine has other work
            begin = os.times()
            text = subprocess.run(call, capture_output=True, text=True, check=True, env=alone).stdout
            end = os.times()
            durations.append(end.children_user + end.children_system - begin.children_user - begin.children_system)
            if durations[-1] < 0.5:
                break
        assert min(durations) < 0.5, command
        assert "Example" in text and "Usage: " + " ".join([package, *command]) in text


@pytest.mark.parametrize("package", ["nmfd", "cosim"])
def test_importing_the_command_line_imports_nothing_heavy(package):
    code = f"import sys, {package}.cli.main; print(*[name for name in {HEAVY} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "\n"


def test_without_arguments_the_help_is_shown():
    result = nmfd()
    assert result.exit_code == 0 and "benchmark" in result.stdout


def test_the_help_names_every_controller():
    assert ",".join(CONTROLLERS) in "".join(nmfd("benchmark", "--help").stdout.split())


def test_benchmark_writes_a_run_folder(benchmark_command, tmp_path):
    result = nmfd(*benchmark_command)
    assert result.exit_code == 0, result.stderr
    lines = result.stdout.splitlines()
    assert lines[2].split()[:2] == ["no-control", "2"] and lines[3].split()[:2] == ["pi-gating", "2"]
    assert "±" in lines[3] and lines[3].count("%") == 1
    assert lines[-1] == f"Written to {tmp_path / 'out'}"
    summary = (tmp_path / "out" / "summary.csv").read_text().splitlines()
    assert summary[0] == COLUMNS
    assert [line.split(",")[:3] for line in summary[1:]] == [
        [name, seed, "nmfd"] for name in ("no-control", "pi-gating") for seed in "01"
    ]
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    with Image.open(tmp_path / "out" / "mfd.png") as picture:
        assert json.loads(picture.info["Trail"])["command"] == manifest["sessions"][0]["command"]
    assert manifest["configuration"]["plant"] == "nmfd"
    assert manifest["sessions"][0]["seeds"] == [0, 1] and manifest["sessions"][0]["versions"]["torch"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "summary.csv",
        "manifest.json",
        "total_accumulation.png",
        "region_accumulation.png",
        "spawn_matrix.png",
        "region_map.png",
        "mfd.png",
        "no-control-0.nc",
        "no-control-1.nc",
        "pi-gating-0.nc",
        "pi-gating-1.nc",
    }


def test_trajectories_of_the_folder_agree_with_the_summary(benchmark_command, tmp_path):
    nmfd(*benchmark_command, "--plant", "acyclic")
    for row in run_folder.read_summary(tmp_path / "out" / "summary.csv"):
        trajectory = run_folder.read_trajectory(tmp_path / "out" / f"{row['controller']}-{row['seed']}.nc")
        assert trajectory.plant == row["plant"] == "acyclic"
        assert 30.0 * trajectory.accumulation[:-1].sum() == pytest.approx(row["total_time_spent_veh_s"], rel=1e-12)
        assert np.all(trajectory.accumulation >= 0)


def test_two_workers_give_the_same_rows_as_one(benchmark_command, tmp_path):
    assert nmfd(*benchmark_command).exit_code == 0
    result = nmfd(*benchmark_command[:-1], tmp_path / "two", "--workers", 2)
    assert result.exit_code == 0, result.stderr
    assert timeless(tmp_path / "out") == timeless(tmp_path / "two")


def test_an_interrupted_benchmark_goes_on(benchmark_command, tmp_path, monkeypatch):
    nmfd(*benchmark_command[:-1], tmp_path / "whole")
    calls = []

    def run(*args, **kwargs):
        calls.append(kwargs["seed"])
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(*args, **kwargs)

    original = closed_loop.run
    monkeypatch.setattr(closed_loop, "run", run)
    result = nmfd(*benchmark_command)
    assert result.exit_code == 130
    assert result.stderr.count("\n") == 1 and f"--out {tmp_path / 'out'} goes on" in result.stderr
    assert len(run_folder.read_summary(tmp_path / "out" / "summary.csv")) == 2
    assert nmfd(*benchmark_command).exit_code == 0
    assert len(calls) == 5  # two, the interrupted one, and the two that were left
    assert timeless(tmp_path / "out") == timeless(tmp_path / "whole")
    assert len(json.loads((tmp_path / "out" / "manifest.json").read_text())["sessions"]) == 2


def test_interrupted_before_the_first_run_leaves_nothing(benchmark_command, tmp_path, monkeypatch):
    def run(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(closed_loop, "run", run)
    result = nmfd(*benchmark_command[:-1], tmp_path / "a" / "b")
    assert (result.exit_code, result.stderr) == (130, "nmfd: interrupted before a run was finished; nothing is kept\n")
    assert not (tmp_path / "a").exists()


def test_a_failing_controller_names_itself_and_the_others_are_kept(benchmark_command, tmp_path, monkeypatch):
    monkeypatch.setattr(PiGating, "act", lambda self, measurement: 1 / 0)
    result = nmfd(*benchmark_command)
    assert result.exit_code == 1 and result.stderr.count("\n") == 1
    assert "controller pi-gating, seed 0: ZeroDivisionError: division by zero (test_cli.py:" in result.stderr
    rows, trajectories = timeless(tmp_path / "out")
    assert [row["controller"] for row in rows] == ["no-control"] * 2 and len(trajectories) == 2


def test_controllers_can_be_added_to_a_folder(scenario, tmp_path):
    out = ["--out", tmp_path / "out"]
    assert nmfd("benchmark", scenario, "--controllers", "no-control", *out).exit_code == 0
    result = nmfd("benchmark", scenario, "--controllers", "pi-gating", *out)
    assert result.exit_code == 0, result.stderr
    assert [row["controller"] for row in timeless(tmp_path / "out")[0]] == ["no-control", "pi-gating"]


def test_a_folder_of_another_plant_is_refused(benchmark_command, tmp_path):
    nmfd(*benchmark_command)
    before = timeless(tmp_path / "out")
    result = nmfd(*benchmark_command, "--plant", "acyclic")
    assert result.exit_code == 2 and 'plant: "nmfd" there, "acyclic" asked for' in result.stderr
    assert timeless(tmp_path / "out") == before


def test_training_can_be_interrupted_and_resumed(scenario, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "VALIDATE_EVERY", 1)
    calls = []

    def once_per_step(*args):
        calls.append(None)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return original(*args)

    original = torch.nn.utils.clip_grad_norm_
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", once_per_step)
    command = ["train", scenario, "--controller", "dpc-pc", "--steps", 4]
    result = nmfd(*command)
    assert result.exit_code == 130 and result.stderr.count("\n") == 1
    again = f"nmfd train {scenario} --controller dpc-pc --steps 4 --resume"
    assert result.stderr.endswith(f"the best policy so far is {scenario / 'dpc-pc.pt'}; go on with: {again}\n")
    assert nmfd("benchmark", scenario, "--controllers", "dpc-pc", "--out", tmp_path / "early").exit_code == 0
    result = nmfd(*again.split()[1:])
    assert result.exit_code == 0 and "best" in result.stdout and len(calls) == 5
    assert {path.name for path in scenario.iterdir()} == {"scenario.toml", "dpc-pc.pt"}
    assert nmfd("benchmark", scenario, "--controllers", "dpc-pc", "--out", tmp_path / "late").exit_code == 0


def test_training_interrupted_at_once_keeps_nothing(scenario, monkeypatch):
    def random_start(self, *args):
        raise KeyboardInterrupt

    monkeypatch.setattr(training.Rollout, "random_start", random_start)
    result = nmfd("train", scenario, "--controller", "dpc-pc")
    assert (result.exit_code, result.stderr) == (
        130,
        "nmfd: interrupted before the first validation; nothing is kept\n",
    )
    assert [path.name for path in scenario.iterdir()] == ["scenario.toml"]


@pytest.fixture
def no_compiler(tmp_path, monkeypatch):
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(training, "WORTH_COMPILING", 2)


def test_without_a_compiler_training_goes_on_uncompiled(no_compiler, scenario):
    result = nmfd("train", scenario, "--controller", "dpc-pc", "--steps", 2)
    assert result.exit_code == 0 and result.stderr.count("\n") == 1 and "training goes on uncompiled" in result.stderr
    content = torch.load(scenario / "dpc-pc.pt", weights_only=True)
    assert content["configuration"]["compiled"] is False


def test_asking_for_compilation_without_a_compiler_is_one_line(no_compiler, scenario):
    result = nmfd("train", scenario, "--controller", "dpc-pc", "--steps", 2, "--compile")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and "install g++" in result.stderr
    assert [path.name for path in scenario.iterdir()] == ["scenario.toml"]


def test_a_compiler_that_does_not_work_counts_as_none(monkeypatch):
    def compiled_step(step):
        def compiled(x):
            raise RuntimeError("Python.h: no such file")

        return compiled

    monkeypatch.setattr(rollout, "compiled_step", compiled_step)
    assert not rollout.can_compile()


def test_a_gpu_that_is_not_there_is_one_line(scenario, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    result = nmfd("train", scenario, "--controller", "dpc-pc", "--steps", 1, "--device", "cuda")
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1) and "finds no GPU here" in result.stderr


def test_show_draws_the_scenario(scenario, tmp_path):
    result = nmfd("show", scenario, "--out", tmp_path / "figures")
    assert result.exit_code == 0, result.stderr
    assert "2 regions, 360 trips between 1 pairs" in result.stdout
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"spawn_matrix.png", "region_map.png", "mfd.png"}


def test_interval_is_students():
    assert benchmark.interval([1.0, 2.0, 3.0]) == pytest.approx(4.3027 / 3**0.5, rel=1e-4)
    assert np.isnan(benchmark.interval([1.0]))


def declared_options():
    return [
        pytest.param(package, command, option, id=f"{package}-{command}-{option.name}")
        for package in ("nmfd", "cosim")
        for command, found in importlib.import_module(f"{package}.cli.main").main.commands.items()
        for option in found.params
        if isinstance(option, Declared)
    ]


@pytest.mark.parametrize("package, command, option", declared_options())
def test_an_option_says_what_its_declaration_says(package, command, option):
    module, _, name = option._declaration.partition(":")
    field = getattr(importlib.import_module(module), name).model_fields[option.name]
    context = click.Context(importlib.import_module(f"{package}.cli.main").main.commands[command])
    names, text = option.get_help_record(context)
    assert text.lower().startswith(field.description.lower())
    if not option.is_flag and option._instead is None:
        assert option.get_default(context) == field.get_default()
        assert option.type_cast_value(context, shown(field.get_default())) == field.get_default()


@pytest.mark.parametrize("value", ["0", "-1", "1.5", "nan", "x", "200000001"])
def test_an_option_allows_what_its_declaration_allows(value):
    with pytest.raises(click.BadParameter, match=f"expected a whole number from 1 to 200000000, got '{value}' instead"):
        option = next(option for option in main.commands["run"].params if option.name == "steps")
        option.type_cast_value(click.Context(main.commands["run"]), value)
