"""The same seed gives the same bytes: in this process and in others, one run at a time and with
workers."""

import os
import subprocess
import sys

import pytest
import tiny
import tiny_city
from commands import cosim, good, nmfd, runs, same, words
from copies import ROOT

from nmfd import api


def elsewhere(program, *arguments):
    """In a process of its own, with another order of sets and dictionaries."""
    subprocess.run(
        [sys.executable, "-m", program, *words(*arguments)],
        check=True,
        stdout=subprocess.DEVNULL,
        env={**os.environ, "PYTHONHASHSEED": "77", "PYTHONPATH": str(ROOT)},
    )


@pytest.mark.slow
def test_benchmarks(tmp_path):
    scenario = tiny.write(tmp_path)
    command = (
        "benchmark",
        scenario,
        "--controllers mpc-pcrg,probing-pcrg --plant acyclic --set steps=8 --out",
    )
    controllers = ["mpc-pcrg", "probing-pcrg"]
    api.benchmark(scenario, controllers, steps=8, plant="acyclic", out=tmp_path / "a", workers=0)
    elsewhere("nmfd", *command, tmp_path / "b")
    assert same(runs(tmp_path / "a"), runs(tmp_path / "b"))
    assert len(runs(tmp_path / "a")) == 2


@pytest.mark.slow
def test_trainings(tmp_path):
    command = ("train", tiny.write(tmp_path), "--controller dpc-pcrg --steps 4 --device cpu --out")
    good(nmfd(*command, tmp_path / "a.pt"))
    elsewhere("nmfd", *command, tmp_path / "b.pt")
    assert (tmp_path / "a.pt").read_bytes() == (tmp_path / "b.pt").read_bytes()


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return tiny_city.imported(tmp_path_factory.mktemp("city"))


@pytest.mark.slow
def test_runs_in_sumo_and_workers(city, tmp_path):
    """Two runs in this process, one after the other, and the same two side by side in processes of
    their own."""
    names = ("route-guidance+rerouting-50", "probing-pcrg")
    for name in names:
        good(cosim("run", city, "--controller", name, "--seed 5 --steps 3 --out", tmp_path / "a"))
    both = f"--controller {names[0]} --against {names[1]} --seed 5 --steps 3".split()
    good(cosim("run", city, *both, "--out", tmp_path / "b"))
    assert same(runs(tmp_path / "a"), runs(tmp_path / "b"))
    assert len(runs(tmp_path / "a")) == 2
