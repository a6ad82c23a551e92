"""What `cosim run` does, as functions of a few arguments; exported by the package `cosim`."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from cosim.evaluation import experiment
from cosim.evaluation.simulate import Result, Task, drive
from cosim.sumo.outputs import check
from nmfd.api import load_scenario
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario, with_demand
from nmfd.runs.progress import Progress, watched
from nmfd.types import Controller


def run(
    scenario: Scenario | Path | str,
    controller: str | Controller,
    *,
    seed: int = 0,
    steps: int | None = None,
    demand_factor: float = 1.0,
    policy: Path | str | None = None,
    city: str = "",
    sumo_output: Mapping[str, Path | str] | None = None,
    progress: Progress = None,
) -> Result:
    """One closed loop in SUMO, in this process and without a run folder.

        >>> result = cosim.run("grid7_peak", "pi-gating+rerouting-30", seed=3, steps=2)
        >>> result.accumulation.shape, result.crossings.shape
        ((3, 7, 7), (2, 7, 7, 7))
        >>> int(result.teleports.sum())
        0

    scenario: a name of `cosim list`, the folder of a scenario.toml, or what nmfd.load_scenario made of it
    controller: a strategy as on the command line, or an object with `reset` and `act` (nmfd.Controller)
    seed: of the trips, the drivers and the guidance
    steps: control intervals; the scenario's if None
    demand_factor: multiplies all flows
    policy: of a DPC controller by name, if not SCENARIO/NAME.pt
    city: what else the city does, with a controller that is an object: "max-pressure+rerouting-30"
    sumo_output: files of SUMO's own outputs: {"tripinfo": "trips.xml"}, also summary, edgedata, emission
    progress: None for a bar in a notebook or on a terminal, False for none, or your own, which is called as
        progress(done, steps) after every control interval

    The result holds the arrays of cosim.plant.record.Record too, and the columns of sumo.csv as attributes. The same seed gives the same result, but for wall times. Raises InputError, and RuntimeError while
    another simulation is open in this process.
    """
    strategy = parse(controller, city)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    if steps is not None and steps < 1:
        raise InputError(f"steps: expected 1 or more control intervals, got {steps} instead")
    if not 0.0 < demand_factor <= 10.0:
        raise InputError(f"demand_factor: expected a number above 0 up to 10, got {demand_factor:g} instead")
    scenario = with_demand(scenario, steps=steps, factor=demand_factor)
    outputs = {kind: Path(file) for kind, file in (sumo_output or {}).items()}
    check(outputs)
    with watched(strategy.name, progress) as show:
        return drive(
            scenario,
            strategy,
            strategy.make(scenario, None if policy is None else Path(policy)),
            seed=seed,
            progress=show,
            outputs=outputs,
            planning=strategy.planning(scenario),
        )


def run_tasks(
    tasks: Task | Sequence[Task],
    *,
    out: Path | str,
    workers: int = 1,
    progress: Progress = None,
    tell: Callable[[str], None] | None = None,
) -> pd.DataFrame:
    """Closed loops in SUMO with a run folder: those that are not yet in `out`; returns a row for every run there.

    Columns: those of summary.csv and sumo.csv, with units in their names; progress: as in `run`, and called as
    progress(done, tasks, what); tell: takes one line where the runs of a controller do not count any more because it
    changed, None: an InputError. Raises InputError, and nmfd.runs.workers.RunFailed at the end if runs failed.
    """
    with watched("cosim", progress) as show:
        return experiment.experiment(
            [tasks] if isinstance(tasks, Task) else list(tasks),
            out=Path(out),
            workers=workers,
            progress=show,
            tell=tell,
        )


def read_run(folder: Path | str, controller: str, seed: int) -> Result:
    """Return a finished run of a run folder. Raises InputError."""
    return experiment.read_run(Path(folder), controller, seed)
