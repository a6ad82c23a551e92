"""The finished runs in a folder of `cosim run` or `cosim evaluate`, with the city that they ran in."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from cosim.evaluation import evaluate, experiment
from cosim.sumo.build import SumoFiles, ensure_built
from cosim.sumo.net import City, load_city
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped
from nmfd.runs.files import check_file, file_hash


@dataclass(frozen=True, kw_only=True)
class Level:
    """The runs at one demand level: a run folder.

    rows: as in cosim.evaluation.statistics, with NaN for what an older version did not record; manifest: manifest.json
    """

    demand: float
    folder: Path
    rows: pd.DataFrame
    manifest: Mapping


@dataclass(frozen=True, kw_only=True)
class Finished:
    """levels: at least one, by demand; evaluation: whether `cosim evaluate` made the folder
    city: None where the city is no longer that of the runs, for the reason in `changed`"""

    path: Path
    levels: tuple[Level, ...]
    evaluation: bool
    scenario: Scenario
    city: City | None
    changed: str

    @property
    def rows(self) -> pd.DataFrame:
        """Of all levels, one below the other."""
        return pd.concat([level.rows for level in self.levels], ignore_index=True)

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.path.resolve().name

    def map(self) -> City:
        """The city. Raises InputError where it is no longer that of the runs."""
        if self.city is None:
            raise InputError(f"{self.path}: {self.changed}: there is no map of the runs any more; run them again")
        return self.city

    def level(self, demand: float | None) -> Level:
        """That of a demand, or the one nearest to the scenario's own. Raises InputError."""
        if demand is None:
            return min(self.levels, key=lambda level: abs(level.demand - 1.0))
        for level in self.levels:
            if abs(level.demand - demand) < 1e-9:
                return level
        there = ", ".join(f"{level.demand:g}" for level in self.levels)
        raise InputError(f"--demand: {self.path} has no runs at {demand:g}; choose one of {there}")


def read(path: Path, scenario: Path | None = None) -> Finished:
    """scenario: its folder, if not where the manifest says. Raises InputError for a folder without finished runs."""
    folders = evaluate.level_folders(path)
    evaluation = bool(folders)
    if not folders:
        if not (path / "manifest.json").is_file():
            raise InputError(f"{path}: holds no finished runs; give a folder of `cosim run` or `cosim evaluate`")
        if not (path / "summary.csv").is_file() or not (path / "sumo.csv").is_file():
            raise InputError(f"{path}: holds no finished runs in SUMO; finish one with `cosim run` or `cosim evaluate`")
        folders = {_manifest(path)["configuration"]["demand_factor"]: path}
    levels = tuple(_level(demand, folder, _order(path)) for demand, folder in folders.items())
    configuration = levels[0].manifest["configuration"]
    loaded = load_scenario(scenario or scenario_folder(levels[0].folder, levels[0].manifest))
    if configuration.get("scenario") != loaded.name:
        raise InputError(
            f"--scenario: the runs are of {configuration.get('scenario')}, not of {loaded.name}; give its folder"
        )
    files = ensure_built(loaded.network)
    changed = _changed(configuration, files)
    return Finished(
        path=path,
        levels=levels,
        evaluation=evaluation,
        scenario=loaded,
        changed=changed,
        city=None if changed else load_city(files.net_file, files.regions_csv, loaded.network.regions),
    )


def _order(path: Path) -> list[str]:
    """The controllers as `cosim evaluate` shows them; others follow as they come."""
    table = path / "runs.csv"
    if not table.is_file():
        return []
    try:
        return list(dict.fromkeys(pd.read_csv(table, usecols=["controller"], dtype=str)["controller"]))
    except (OSError, ValueError) as error:  # pandas' own errors are ValueErrors
        raise InputError(f"{table}: is no table of runs ({error}); delete it") from None


def _level(demand: float, folder: Path, order: Sequence[str]) -> Level:
    rows = experiment.overview(folder)
    if rows.empty:
        raise InputError(f"{folder}: holds no finished runs; run the command that began it again")
    rows.insert(0, "demand", float(demand))
    names = list(dict.fromkeys([*order, *rows["controller"]]))
    rows = rows.sort_values(
        ["controller", "seed"],
        ignore_index=True,
        key=lambda column: column.map(names.index) if column.name == "controller" else column,
    )
    return Level(demand=float(demand), folder=folder, rows=rows, manifest=_manifest(folder))


def _manifest(folder: Path) -> dict:
    path = folder / "manifest.json"
    check_file(path, "give a folder of `cosim run` or `cosim evaluate`")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        configuration, scenario = manifest["configuration"], manifest["sessions"][-1]["scenario_folder"]
        numbers = [configuration[key] for key in ("demand_factor", "steps", "step_s")]
        if not isinstance(scenario, str) or not all(isinstance(number, (int, float)) for number in numbers):
            raise TypeError
        return manifest
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a folder of `cosim run` or `cosim evaluate`") from None
    except (ValueError, KeyError, IndexError, TypeError):
        raise InputError(f"{path}: is no manifest of runs in SUMO; give a folder of `cosim run`") from None


def scenario_folder(folder: Path, manifest: Mapping) -> Path:
    """Of the runs in `folder`: where the manifest says, from here or from a folder above the runs, or as it came with
    the package. InputError."""
    return found_again(Path(manifest["sessions"][-1]["scenario_folder"]), folder, "manifest.json: scenario_folder")


def found_again(name: Path, folder: Path, said: str) -> Path:
    """The scenario `name`, of runs in `folder`; said: where that is written. Of a whole path that is not there, as on
    another machine, its end will do. InputError."""
    ends = [Path(*name.parts[-count:]) for count in (3, 2, 1)] if name.is_absolute() else []
    for end in (name, *ends):
        for above in (Path(), *folder.resolve().parents):
            if (above / end / "scenario.toml").is_file():
                return above / end
        if ((found := shipped.found(end, shipped.SCENARIO, beside=Path())) / "scenario.toml").is_file():
            return found
    raise InputError(f"{folder / said}: there is no {name}; give it with --scenario, or go to where it is")


def _changed(configuration: Mapping, files: SumoFiles) -> str:
    """Why the city is not the one of the runs; empty if it is."""
    for key, file in (("net_file_hash", files.net_file), ("regions_hash", files.regions_csv)):
        if configuration.get(key) not in (None, file_hash(file)):
            return f"{file} has changed since the runs were made"
    return ""
