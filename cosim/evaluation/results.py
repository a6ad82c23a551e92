"""Finished runs in a folder of `cosim run` or `cosim evaluate`, with scenario and city."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from cosim.sumo.build import ensure_built
from cosim.sumo.net import City, city_of
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped
from nmfd.runs.files import file_hash, read_table
from nmfd.runs.run_many import TABLE, read_manifest, run_name
from nmfd.types import Result


@dataclass(frozen=True, kw_only=True)
class Level:
    """Runs of one scenario at one demand level.

    demand: multiple of the scenario's demand; folder: of the result files; rows: one per run; key: what all runs depend
    on; controllers: name -> what only its runs depend on
    """

    demand: float
    folder: Path
    rows: pd.DataFrame
    key: Mapping
    controllers: Mapping

    def read(self, controller: str, seed: int) -> Result:
        """Return a finished run. Raises InputError."""
        return read_run(self.folder, controller, seed)


@dataclass(frozen=True, kw_only=True)
class Finished:
    """Finished runs of one scenario: at least one level, by demand; sessions: of manifest.json."""

    path: Path
    levels: tuple[Level, ...]
    scenario: Scenario
    sessions: tuple[Mapping, ...]

    @property
    def rows(self) -> pd.DataFrame:
        """One row per run of all levels."""
        return pd.concat([level.rows for level in self.levels], ignore_index=True)

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.path.resolve().name

    def map(self) -> City:
        """Return the city. Raises InputError if it has changed since the runs."""
        files = ensure_built(self.scenario.network)
        for key, file in (("net_file_hash", files.net_file), ("regions_hash", files.regions_csv)):
            if self.levels[0].key[key] != file_hash(file):
                raise InputError(f"{self.path}: {file} has changed since the runs; run them again")
        return city_of(self.scenario.network)

    def level(self, demand: float | None = None) -> Level:
        """Return the level of `demand`, nearest to 1 if None. Raises InputError."""
        if demand is None:
            return min(self.levels, key=lambda level: abs(level.demand - 1.0))
        for level in self.levels:
            if abs(level.demand - demand) < 1e-9:
                return level
        raise InputError(f"{self.path}: has no runs at demand {demand:g}")


def read(path: Path, scenario: str | None = None) -> Finished:
    """Read the finished runs of a folder.

    scenario: name of one of several scenarios, the first if None

    Raises:
        InputError: the folder holds no finished runs in SUMO
    """
    if not (path / TABLE).is_file():
        raise InputError(f"{path}: holds no finished runs; give a folder of `cosim run` or `cosim evaluate`")
    manifest, rows = read_manifest(path), read_table(path / TABLE, {}, "run again")
    rows = finished_rows(rows)
    if rows.empty or "scenario" not in rows:
        raise InputError(f"{path}: holds no finished runs in SUMO; finish one with `cosim run` or `cosim evaluate`")
    rows = rows[rows["scenario"] == (scenario or rows["scenario"].iloc[0])]
    levels = [
        Level(
            demand=float(demand),
            folder=path / part["folder"].iloc[0],
            rows=part.reset_index(drop=True),
            key=manifest["folders"][part["folder"].iloc[0]]["key"],
            controllers=manifest["folders"][part["folder"].iloc[0]]["controllers"],
        )
        for demand, part in rows.groupby("demand", sort=True)
    ]
    first = levels[0].read(rows_of(levels[0])[0][0], rows_of(levels[0])[0][1])
    return Finished(
        path=path,
        levels=tuple(levels),
        scenario=load_scenario(_scenario_folder(Path(first.scenario_folder), first.scenario, path)),
        sessions=tuple(manifest["sessions"]),
    )


def finished_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of finished runs, controllers together, with a column folder."""
    rows = rows[rows["failure"].isna() | (rows["failure"] == "")].drop(columns="failure")
    if "folder" not in rows:
        rows.insert(0, "folder", "")
    rows["folder"] = rows["folder"].fillna("")
    order = list(dict.fromkeys(rows["controller"]))
    return rows.sort_values(
        [name for name in ("scenario", "demand", "controller", "seed") if name in rows],
        ignore_index=True,
        kind="stable",
        key=lambda column: column.map(order.index) if column.name == "controller" else column,
    )


def rows_of(level: Level) -> list[tuple[str, int]]:
    """Return controller and seed of every run."""
    return list(zip(level.rows["controller"], map(int, level.rows["seed"]), strict=True))


def read_run(folder: Path, controller: str, seed: int) -> Result:
    """Return a finished run. Raises InputError."""
    return Result.read(folder / f"{run_name(controller, seed)}.nc")


def _scenario_folder(folder: Path, name: str, runs: Path) -> Path:
    """Return where the scenario of `runs` is, shipped or in its folder. Raises InputError."""
    for place in (folder, shipped.found(name, shipped.SCENARIO, beside=Path())):
        if (place / "scenario.toml").is_file():
            return place
    raise InputError(f"{runs}: its scenario {folder} is not there any more")
