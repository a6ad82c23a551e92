"""The same seed gives the same bytes: in this process and in others, one run at a time and with workers."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import tiny
import tiny_city
from click.testing import CliRunner

import cosim.cli
import nmfd.cli
from nmfd.types import Result

ROOT = Path(__file__).parents[1]
MAINS = {"nmfd": nmfd.cli.main, "cosim": cosim.cli.main}


def here(program, *arguments):
    result = CliRunner().invoke(MAINS[program], [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output + repr(result.exception)


def elsewhere(program, *arguments):
    """In a process of its own, with another order of sets and dictionaries."""
    subprocess.run(
        [sys.executable, "-m", program, *map(str, arguments)],
        check=True,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONHASHSEED": "77", "PYTHONPATH": str(ROOT)},
    )


def same_runs(one: Path, other: Path, count: int) -> bool:
    """Return True if two folders hold the same `count` runs, but for wall times."""
    first, second = (
        {file.name: Result.read(file).without_times() for file in sorted(f.glob("*.nc"))} for f in (one, other)
    )
    return len(first) == count and first.keys() == second.keys() and all(first[n].identical(second[n]) for n in first)


def test_benchmarks(tmp_path):
    scenario = tiny.write(tmp_path)
    command = ("benchmark", scenario, "--controllers", "mpc-pcrg,probing-pcrg", "--plant", "acyclic", "--out")
    here("nmfd", *command, tmp_path / "a")
    elsewhere("nmfd", *command, tmp_path / "b")
    assert same_runs(tmp_path / "a", tmp_path / "b", 2)


@pytest.mark.slow
def test_trainings(tmp_path):
    command = ("train", tiny.write(tmp_path), "--controller", "dpc-pcrg", "--steps", 4, "--device", "cpu", "--out")
    here("nmfd", *command, tmp_path / "a.pt")
    elsewhere("nmfd", *command, tmp_path / "b.pt")
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "b.pt").read_bytes()


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    folder = tmp_path_factory.mktemp("city")
    here("cosim", "import", tiny_city.city(folder), "--regions", 3, "--out", folder / "networks" / "tiny")
    return folder / "scenarios" / "tiny"


@pytest.mark.slow
def test_runs_in_sumo_and_workers(city, tmp_path):
    """Two runs in this process, one after the other, and the same two side by side in processes of their own."""
    names = ("route-guidance+rerouting-50", "probing-pcrg")
    for name in names:
        here("cosim", "run", city, "--controller", name, "--seed", 5, "--steps", 3, "--out", tmp_path / "a")
    here(
        "cosim",
        "run",
        city,
        "--controller",
        names[0],
        "--against",
        names[1],
        "--seed",
        5,
        "--steps",
        3,
        "--out",
        tmp_path / "b",
    )
    assert same_runs(tmp_path / "a", tmp_path / "b", 2)
