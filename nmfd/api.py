"""What the command line `nmfd` does, as functions of a few arguments; exported by the package `nmfd`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nmfd import closed_loop
from nmfd.controllers.dpc import training
from nmfd.controllers.strategy import check_tables, parse, parse_many
from nmfd.errors import InputError, did_you_mean
from nmfd.model.scenario import Scenario, read_scenario, with_demand
from nmfd.runs import config
from nmfd.runs.files import default_folder
from nmfd.runs.progress import Progress, watched
from nmfd.studies import benchmark as benchmark_study
from nmfd.studies import measured
from nmfd.studies.benchmark import PLANTS
from nmfd.studies.measured import Identified
from nmfd.studies.settings import Measured
from nmfd.types import Controller, Plant, Result

if TYPE_CHECKING:
    import pandas as pd


def load_scenario(folder: Path | str, settings: Mapping[str, Any] | None = None) -> Scenario:
    """Read the scenario in `folder`, or a shipped one by its name, and check its options. Raises InputError.

    settings: dotted key -> value instead of that in the file, such as {"steps": 12, "controllers.pi-gating.kp": 2.0}

        >>> nmfd.load_scenario("economic_mpc").network.region_names
        ('north-west', 'north-east', 'west', 'centre', 'east', 'south-west', 'south-east')
    """
    scenario = read_scenario(folder, settings)
    check_tables(scenario)
    return scenario


def controller(name: str, scenario: Scenario | Path | str, *, policy: Path | str | None = None) -> Controller:
    """The controller `name` for `scenario`, with `reset` and `act`.

    name: as on the command line: "pi-gating", "dpc-pcrg", ..., or "path/to/file.py:Class"
    policy: the file of a policy or plan, if not SCENARIO/NAME.pt or .npz

        >>> nmfd.controller("pi-gating", "economic_mpc").regions  # that it protects
        array([3])

    Raises InputError for an unknown name, a wrong option, or a policy that is missing or made for another network.
    """
    return parse(name).make(_loaded(scenario), None if policy is None else Path(policy))


def run(
    scenario: Scenario | Path | str,
    controller: str | Controller,
    *,
    seed: int = 0,
    plant: str | Plant = "nmfd",
    steps: int | None = None,
    policy: Path | str | None = None,
    progress: Progress = None,
) -> Result:
    """One closed loop on a regional model.

        >>> trajectory = nmfd.run("economic_mpc", "pi-gating", steps=20)
        >>> trajectory.accumulation.shape  # states, regions, destinations
        (21, 7, 7)
        >>> bool(trajectory.observed[20].sum() == trajectory.accumulation[20].sum())  # observed with noise
        False

    scenario: a name of `nmfd list`, the folder of a scenario.toml, or what load_scenario made of it
    controller: a name as on the command line, or an object with `reset` and `act` (nmfd.Controller)
    seed: of the measurement noise
    plant: "nmfd", "acyclic", or an object with `reset`, `step`, `completed` and `close` (nmfd.Plant)
    steps: control intervals; the scenario's if None
    policy: as in `nmfd.controller`
    progress: None for a bar in a notebook or on a terminal, False for none, or your own, which is called as
        progress(done, steps) after every control interval

    The same seed gives the same trajectory (but for wall times). Raises InputError.
    """
    strategy, scenario = parse(controller).regional(), _loaded(scenario)
    if steps is not None:
        if steps < 1:
            raise InputError(f"steps: expected 1 or more control intervals, got {steps} instead")
        scenario = with_demand(scenario, steps=steps)
    if isinstance(plant, str):
        _check_plant(plant, ", or give an object")
    acting = strategy.make(scenario, None if policy is None else Path(policy))
    driven = PLANTS[plant](scenario) if isinstance(plant, str) else plant
    with watched(strategy.name, progress) as show:
        result = closed_loop.run(driven, acting, scenario, seed=seed, progress=show)
    return result.assign(controller=strategy.name, plant=plant if isinstance(plant, str) else type(plant).__name__)


def benchmark(
    scenario: Scenario | Path | str,
    controllers: str | Sequence[str],
    *,
    seeds: int | Sequence[int] = 1,
    plant: str = "nmfd",
    out: Path | str | None = None,
    policies: Mapping[str, Path | str] | None = None,
    workers: int = 1,
    progress: Progress = None,
) -> "pd.DataFrame":
    """Run controllers x seeds with a run folder, as `nmfd benchmark`; return one row per run.

        >>> rows = nmfd.benchmark("economic_mpc", ["no-control", "dpc-*"])  # doctest: +SKIP
        >>> rows.groupby("controller")["total_time_spent_veh_s"].mean()  # doctest: +SKIP

    controllers: a name, several, or patterns, which stand for the controllers that can be made for this scenario
    seeds: how many, from 0, or which
    out: the run folder, runs/<scenario>-<time> if None; finished runs in it are kept
    policies: controller -> file, if not SCENARIO/NAME.pt
    workers: runs at a time
    progress: as in `nmfd.run`; your own is called as progress(done, runs, name)

    The column `failure` is "" of a finished run, else its reason. Raises InputError.
    """
    scenario, files = _loaded(scenario), {name: Path(file) for name, file in (policies or {}).items()}
    _check_plant(plant)
    return benchmark_study.benchmark(
        scenario,
        parse_many(controllers, scenario, regional=True),
        range(seeds) if isinstance(seeds, int) else list(seeds),
        plant,
        out=default_folder(scenario.name) if out is None else Path(out),
        policies=files,
        workers=workers,
        progress=progress,
    )


def train(
    scenario: Scenario | Path | str,
    controller: str,
    *,
    out: Path | str,
    seed: int = 0,
    steps: int | None = None,
    resume: bool = False,
    anyway: bool = False,
    progress: Progress = None,
) -> Path:
    """`nmfd train` on the CPU: train the DPC policy `controller` and write it to the file `out`, which is returned.

    steps: Adam steps; what scenario.toml says, else 400, if None; anyway: even on placeholder MFDs, or where no gateway
    can be controlled; progress: as in `benchmark`. Raises InputError.
    """
    with watched(controller, progress) as show:
        return training.train(
            _loaded(scenario),
            parse(controller),
            seed=seed,
            out=Path(out),
            steps=steps,
            resume=resume,
            anyway=anyway,
            progress=show,
        )


def identify(
    counts: Path | str,
    *,
    out: Path | str,
    detectors: Path | str | None = None,
    regions: Path | str | None = None,
    about: Path | str | None = None,
    adjacency: Path | str | None = None,
    city: str | None = None,
    skip_bad: bool = False,
    name: str | None = None,
    force: bool = False,
    **settings: float,
) -> Identified:
    """`nmfd identify`: measured counts and occupancies -> MFDs per region, and a network.toml in the folder `out`.

        found = nmfd.identify("counts.csv", detectors="detectors.csv", regions="regions.csv", trip_length=1500.0,
                              out="networks/mine")
        print(found.text), found.network.mfds, found.to_frame()

    counts, detectors, regions, about: tables as UTD19 has them (nmfd.model.detector_tables); adjacency: a table
    region,neighbour or the network.toml of the same regions; settings: vehicle_length, trip_length [m], least_share [-]
    of nmfd.studies.settings.Measured. Raises InputError.
    """
    given = {"detectors": detectors, "regions": regions, "about": about, "adjacency": adjacency}
    return measured.identify(
        measured.Sources(
            counts=Path(counts),
            city=city,
            skip_bad=skip_bad,
            **{key: None if file is None else Path(file) for key, file in given.items()},
        ),
        config.checked(Measured, settings, "identify"),
        out=Path(out),
        name=name,
        force=force,
    )


def _check_plant(plant: str, more: str = "") -> None:
    """InputError for an unknown name; more: what else is allowed."""
    if plant not in PLANTS:
        raise InputError(
            f"plant {plant!r} is unknown{did_you_mean(plant, PLANTS)}; choose from {', '.join(PLANTS)}{more}"
        )


def _loaded(scenario: Scenario | Path | str) -> Scenario:
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
