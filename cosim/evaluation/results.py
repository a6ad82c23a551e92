"""Finished runs of a folder, with their scenario and city."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd

from cosim.plant.programmes import scenario_city
from cosim.plant.settings import settings
from cosim.plant.strategy import parse
from cosim.sumo.net import City, city_files
from nmfd.api import load_scenario
from nmfd.controllers.strategy import ControllerLike
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs.files import file_hash, file_name, run_name
from nmfd.runs.run_many import finished_table, read_manifest
from nmfd.types import Result

# Arrays of a run that tables and figures of many runs are made of.
MEASURES = (
    "accumulation",
    "backlog",
    "co2",
    "crossings",
    "departures",
    "guided",
    "passed",
    "perimeter",
    "queue_max",
    "time_loss",
    "trip_time_by_origin",
)


@dataclass(frozen=True, kw_only=True)
class Level:
    """Finished runs of one scenario at one demand level.

    rows: one per run
    key: what all runs depend on
    controllers: name -> what only its runs depend on
    """

    demand: float
    folder: Path
    rows: pd.DataFrame
    key: Mapping
    controllers: Mapping

    def results(self, *controllers: str) -> list[Result]:
        """Return the runs of these controllers, of all if there are none."""
        rows = self.rows
        if controllers:
            rows = rows[rows["controller"].isin(controllers)]
        return [self.read(row.controller, row.seed) for row in rows.itertuples()]

    def measures(self, *controllers: str) -> list[Result]:
        """Return `results` with the arrays MEASURES only; each file is read once."""
        return [run for run in self._measures if not controllers or run.controller in controllers]

    @cached_property
    def _measures(self) -> list[Result]:
        rows = self.rows.itertuples()
        return [self.read(row.controller, row.seed, MEASURES) for row in rows]

    def read(self, controller: str, seed: int, only: Collection[str] | None = None) -> Result:
        """Return a run; only: as in Result.read."""
        return Result.read(self.folder / f"{run_name(controller, seed)}.nc", only)


@dataclass(frozen=True, kw_only=True)
class Finished:
    """Finished runs of one scenario.

    levels: at least one, by demand
    sessions: those of manifest.json
    """

    path: Path
    levels: tuple[Level, ...]
    scenario: Scenario
    sessions: tuple[Mapping, ...]

    @property
    def rows(self) -> pd.DataFrame:
        """One row per run of all levels."""
        return pd.concat([level.rows for level in self.levels], ignore_index=True)

    def map(self) -> City:
        """Return the city. Raise InputError if it has changed since the runs."""
        files = city_files(self.scenario.network)
        for name, file in (("net_file_hash", files.net_file), ("regions_hash", files.regions_csv)):
            if self.levels[0].key[name] != file_hash(file):
                raise InputError(f"{self.path}: {file} has changed since the runs; run them again")
        return self._city

    @cached_property
    def _city(self) -> City:
        return scenario_city(self.scenario, settings(self.scenario))

    def level(self, demand: float = 1.0) -> Level:
        """Return the level nearest to `demand`."""
        return min(self.levels, key=lambda level: abs(level.demand - demand))


def read(path: Path, scenario: str | None = None) -> Finished:
    """Read the finished runs of a folder.

    scenario: name of one of several scenarios, the first if None
    Raises: InputError if it holds none in SUMO
    """
    rows = finished_rows(finished_table(path))
    if rows.empty or "sumo" not in set(rows["plant"]):
        raise InputError(
            f"{path}: holds no finished runs in SUMO; give a folder of `cosim run` or `cosim "
            "evaluate`"
        )
    manifest = read_manifest(path)
    rows = rows[rows["scenario"] == (scenario or rows["scenario"].iloc[0])]
    levels = []
    for demand, part in rows.groupby("demand", sort=True):
        folder = part["folder"].iloc[0]
        about = manifest["folders"][folder]
        own = part.reset_index(drop=True)
        levels.append(Level(demand=float(demand), folder=path / folder, rows=own, **about))
    run = levels[0].read(*rows.iloc[0][["controller", "seed"]])
    place = run.scenario_folder
    if not (Path(place) / "scenario.toml").is_file():
        place = run.scenario  # a shipped one; the run is from another machine
    return Finished(
        path=path,
        levels=tuple(levels),
        scenario=load_scenario(place),
        sessions=tuple(manifest["sessions"]),
    )


def finished_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of finished runs, sorted, with a column folder.

    Controllers keep the order of their first runs.
    """
    rows = rows[rows["failure"].isna() | (rows["failure"] == "")].drop(columns="failure")
    rows["folder"] = rows["folder"].fillna("") if "folder" in rows else ""
    order = [name for name in ("scenario", "demand", "controller", "seed") if name in rows]

    def ranks(column: pd.Series) -> pd.Series:
        return pd.factorize(column)[0] if column.name == "controller" else column

    return rows.sort_values(order, ignore_index=True, kind="stable", key=ranks)


def read_run(
    folder: Path | str,
    controller: ControllerLike,
    seed: int,
    *,
    demand: float | None = None,
    scenario: str | None = None,
) -> Result:
    """Return a finished run of a folder of `cosim run` or `cosim evaluate`.

    controller: its name, or options such as nmfd.PiGating(kp=2.0)
    seed: seed of the run
    demand, scenario: needed if the folder holds such runs of several demand levels or scenarios
    Raises: InputError if there is no such run, or if there are several
    """
    folder = Path(folder)
    name = controller if isinstance(controller, str) else parse(controller).name
    file = f"{run_name(name, seed)}.nc"
    candidates = [folder / file, *sorted(folder.rglob(f"*/{file}"))]
    places = [path for path in candidates if path.is_file()]
    if demand is not None:
        places = [path for path in places if path.parent.name == f"demand-{demand:g}"]
    if scenario is not None:
        above = file_name(scenario)
        places = [path for path in places if above in path.relative_to(folder).parts]
    if not places:
        raise InputError(f"{folder}: holds no finished run of {name} with seed {seed}")
    if len(places) > 1:
        where = ", ".join(path.parent.relative_to(folder).as_posix() for path in places)
        raise InputError(
            f"{folder}: holds several runs of {name} with seed {seed} ({where}); give demand or "
            "scenario"
        )
    return Result.read(places[0])
