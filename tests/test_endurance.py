"""Endurance: neither a thousand episodes of the regional model nor a day in SUMO makes a process grow."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
import tiny_city
from click.testing import CliRunner

from cosim.cli import main
from cosim.plant.plant import SumoPlant
from cosim.plant.settings import settings
from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.closed_loop import run
from nmfd.model.plant import AcyclicPlant, NmfdPlant
from nmfd.types import Controls

PEAK = Path(__file__).parents[1] / "scenarios" / "grid7_peak"
GROWTH = 1.05  # of the memory, after the first part


def memory() -> float:
    """Of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def in_a_fork(measure) -> list[float]:
    """The memories that `measure` yields, in a process in which nothing else has left room to grow into."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(writer, " ".join(f"{mib:.2f}" for mib in measure()).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as stream:
        found = [float(mib) for mib in stream.read().split()]
    os.waitpid(child, 0)
    return found


def episodes(scenario, count):
    controllers = [make_controller(name, scenario) for name in ("pi-gating", "mpc-pcrg")]
    for n in range(count):
        make = (NmfdPlant, AcyclicPlant)[n % 2]
        run(make(scenario), controllers[n // 2 % 2], scenario, seed=n)
        yield memory()


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_episodes_of_the_regional_model(tmp_path, count):
    scenario = load_scenario(tiny.write(tmp_path))
    found = in_a_fork(lambda: episodes(scenario, count))
    assert len(found) == count and max(found[count // 10 :]) < GROWTH * found[count // 10]


def intervals(scenario, count):
    plant = SumoPlant(scenario, settings=settings(scenario))
    network = scenario.network
    controls = Controls(perimeter=np.where(network.adjacency, 0.5, 0.0), splits=network.nominal_splits)
    plant.reset(0)
    for _ in range(count):
        plant.step(controls)
        yield memory()
    plant.close()


def test_an_hour_in_a_tiny_city(tmp_path):
    """Its vehicles again and again: the same load in every interval."""
    result = CliRunner().invoke(
        main,
        [
            "import",
            str(tiny_city.city(tmp_path)),
            "--regions",
            "3",
            "--out",
            str(tmp_path / "networks" / "tiny"),
        ],
    )
    assert result.exit_code == 0, result.output
    scenario = load_scenario(tmp_path / "scenarios" / "tiny")
    network = scenario.network
    demand = np.full((40, network.regions, network.regions), 0.02)
    file = tmp_path / "scenarios" / "tiny" / "scenario.toml"
    lines = [line for line in file.read_text().splitlines() if not line.startswith(("routes", "background", "begin"))]
    file.write_text("\n".join(lines))
    scenario = replace(load_scenario(file.parent), steps=40, demand=demand)
    found = in_a_fork(lambda: intervals(scenario, 40))
    assert len(found) == 40 and max(found[10:]) < GROWTH * found[10]


@pytest.mark.slow
def test_a_day_on_grid7():
    """24 hours of 90 s, 150 vehicles an hour between every two neighbours of the centre, guided all the time."""
    scenario = load_scenario(PEAK)
    steps = 24 * 3600 // 90
    demand = np.zeros((steps, 7, 7))
    demand[:, 3, :] = demand[:, :, 3] = 0.01
    scenario = replace(scenario, steps=steps, demand=demand)
    found = in_a_fork(lambda: intervals(scenario, steps))
    first_hour = 3600 // 90
    print(f"after an hour {found[first_hour - 1]:.1f} MiB, at most {max(found):.1f}, at the end {found[-1]:.1f}")
    assert len(found) == steps and max(found[first_hour:]) < GROWTH * found[first_hour - 1]
