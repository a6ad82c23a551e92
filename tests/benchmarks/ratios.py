"""What is ours costs, as ratios of processor times: python tests/benchmarks/ratios.py

SUMO without us, libraries without us, and files read whole are 1. SUMO alone has the same traffic
only without control; other strategies are compared with their own run. It takes two minutes."""

import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from functools import partial
from pathlib import Path

import libsumo

from cosim.evaluation.results import MEASURES
from cosim.evaluation.simulate import Simulation, simulate
from cosim.plant.plant import SumoPlant
from cosim.plant.strategy import parse
from cosim.sumo.recorded_trips import as_recorded
from cosim.sumo.trips import make_trips
from cosim.sumo.xml_files import xml_text
from nmfd import closed_loop
from nmfd.api import loaded
from nmfd.runs.files import run_name
from nmfd.runs.run_many import Run, run_many
from nmfd.types import Result

UNCONTROLLED = "no-control"
STRATEGIES = (UNCONTROLLED, "pi-gating", "route-guidance+max-pressure+guidance-period-60")
LIBRARIES = "libsumo, numpy, pandas, scipy.sparse.csgraph, xarray, pydantic, jaxtyping"
RUNS = 100


def main() -> None:
    """Print a line per figure."""
    scenario = loaded("demo", steps=20)
    show("run of demo, no-control, over bare SUMO", *run_and_bare(scenario, UNCONTROLLED))
    for name in STRATEGIES:
        run = simulate(Simulation(scenario, parse(name), 1))
        show(f"outside SUMO's steps: demo, {name}", run.overhead_share, 1.0)
    libraries = imported(LIBRARIES)
    for module in ("cosim.evaluation.simulate", "cosim.api"):
        show(f"import of {module} over its libraries", imported(module), libraries)
    show("trips as text over ElementTree", *trips_and_library(scenario))
    with tempfile.TemporaryDirectory() as folder:
        resumed, measures, whole = many_runs(scenario, Path(folder))
        show("finished run in a resume over its file", resumed, whole)
        show("finished run in a report over its file", measures, whole)


def show(what: str, ours: float, other: float) -> None:
    print(f"{what:60} {ours / other:6.2f}", flush=True)


def processor(work) -> float:
    """Return the processor time of a call (s)."""
    before = time.process_time()
    work()
    return time.process_time() - before


def run_and_bare(scenario, name: str) -> tuple[float, float]:
    """Return processor times (s) of a closed loop, and of SUMO with the same command."""
    strategy = parse(name)
    settings = strategy.settings(scenario)
    plant = SumoPlant(scenario, settings=settings, planning=strategy.planning(scenario))
    controller = strategy.make(scenario)
    ours = processor(lambda: closed_loop.run(plant, controller, scenario, seed=1))
    plant.reset(1)  # writes the same files again
    command = plant._session.command
    plant._session.close()

    def bare() -> None:
        libsumo.start(command)
        end = settings.begin + scenario.steps * scenario.step
        while libsumo.simulation.getTime() < end:
            libsumo.simulationStep()
        libsumo.close()

    alone = processor(bare)
    plant.close()
    return ours, alone


def imported(modules: str) -> float:
    """Return the least processor time (s) of three processes that import modules."""
    code = f"import time; import {modules}; print(time.process_time())"
    command = [sys.executable, "-c", code]
    return min(float(subprocess.check_output(command, text=True)) for _ in range(3))


def trips_and_library(scenario) -> tuple[float, float]:
    """Return processor times (s) of trips as text, ours and that of ElementTree."""
    plant = SumoPlant(scenario)
    trips = as_recorded(make_trips(plant.city, scenario.demand, scenario.step, 1)).elements
    ours = processor(lambda: list(map(xml_text, trips)))
    return ours, processor(lambda: list(map(ElementTree.tostring, trips)))


def many_runs(scenario, folder: Path) -> tuple[float, float, float]:
    """Return processor times (s) of a resume, of a report's arrays, and of whole files."""
    result = simulate(Simulation(loaded(scenario, steps=2), parse("no-control"), 0))
    runs = []
    for seed in range(RUNS):
        job = partial(result.assign, seed=seed)
        runs.append(Run(run_name("no-control", seed), {"controller": {}}, job))
    run_many(runs, folder, workers=0, progress=False)
    files = [folder / run.file for run in runs]
    resumed = processor(lambda: run_many(runs, folder, workers=0, progress=False))
    measures = processor(lambda: [Result.read(file, only=MEASURES) for file in files])
    return resumed, measures, processor(lambda: [Result.read(file) for file in files])


if __name__ == "__main__":
    main()
