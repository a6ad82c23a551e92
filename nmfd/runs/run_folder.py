"""Run folders: trajectories, summary.csv and manifest.json, written so that an interruption costs one run at most.

    <folder>/manifest.json              configuration, controllers, and seeds, versions and commit of every session
    <folder>/summary.csv                one row per finished run (metrics.summary)
    <folder>/<controller>-<seed>.npz    its trajectory, without wall times: the same run gives the same bytes
"""

import hashlib
import json
import math
import platform
import subprocess
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from importlib import metadata
from pathlib import Path
from urllib.parse import quote

import numpy as np

from nmfd.errors import InputError
from nmfd.metrics import summary
from nmfd.model.scenario import Scenario
from nmfd.runs import files
from nmfd.types import Trajectory

COLUMNS = {
    "controller": str, "seed": int, "plant": str, "total_time_spent_veh_s": float, "final_accumulation_veh": float,
    "max_accumulation_veh": float, "completed_veh": float, "evaluation_time_s": float,
    "control_step_ms_median": float, "control_step_ms_max": float, "solver_failures": int, "fallbacks": int,
    "late_decisions": int, "sensor_faults": int, "plant_faults": int,
}
LOCK = ".lock"  # of a run folder
PACKAGES = ("numpy", "torch", "casadi", "libsumo", "perimeter-cosim")
# What NumPy raises for a file that is no .npz, cut off, changed, or without an array that it should have.
DAMAGED = (OSError, ValueError, KeyError, TypeError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error)
_ARRAYS = ("accumulation", "backlog", "completed", "observed", "observed_backlog", "perimeter", "splits", "status")


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """All of `trajectory` but its wall times in an .npz file without pickles, atomically."""
    with files.atomic(path) as temporary:
        np.savez_compressed(
            temporary, controller=np.array(trajectory.controller), plant=np.array(trajectory.plant),
            seed=np.array(trajectory.seed), step=np.array(trajectory.step),
            estimated=np.array(trajectory.estimated), note=np.array(trajectory.note),
            **{name: getattr(trajectory, name) for name in _ARRAYS})


def read_trajectory(path: Path) -> Trajectory:
    """What `write_trajectory` wrote; the wall times, which are in summary.csv, are NaN. Raises InputError."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return Trajectory(
                controller=str(file["controller"]), plant=str(file["plant"]), seed=int(file["seed"]),
                step=float(file["step"]), note=tuple(str(s) for s in file["note"]),
                decision_time=np.full(len(file["status"]), math.nan), wall_time=math.nan,
                estimated=bool(file["estimated"]),
                **{name: file[name] for name in _ARRAYS})
    except FileNotFoundError:
        raise InputError(f"{path}: no such trajectory; run it again") from None
    except DAMAGED as error:
        raise InputError(f"{path}: is no trajectory ({error}); delete it and run it again") from None


def write_summary(path: Path, rows: list[dict]) -> None:
    """`rows` of metrics.summary as summary.csv, atomically."""
    files.write_rows(path, COLUMNS, rows)


def read_manifest(path: Path) -> dict:
    """manifest.json of a run folder: configuration, controllers, sessions. Raises InputError."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content["configuration"], dict) or not isinstance(content["controllers"], dict):
            raise TypeError
        [session.keys() for session in content["sessions"]]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a folder that a run was written to") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f"{path}: is no manifest of a run; choose another folder with --out") from None
    return content


def read_summary(path: Path) -> list[dict]:
    """The rows of summary.csv with the types of metrics.summary. Raises InputError."""
    return files.read_rows(path, COLUMNS)


def scenario_hash(scenario: Scenario) -> str:
    """A fingerprint of all that a run on `scenario` depends on, whatever its files are called."""
    settings = [
        scenario.network.hash, scenario.step, scenario.steps, scenario.measurement_std, scenario.integrator,
        scenario.substeps, scenario.protected, scenario.controller_options]
    if scenario.forecast_error:
        settings.append([scenario.forecast_error, scenario.forecast_seed])
    if scenario.faults:
        settings.append(scenario.faults)
    text = json.dumps(settings, sort_keys=True, default=str)
    return hashlib.sha256(text.encode() + np.ascontiguousarray(scenario.demand).tobytes()).hexdigest()[:16]


def provenance() -> dict:
    """Date, versions, and the commit of the checkout that this package lies in; commit is None outside one."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    here = Path(__file__).resolve()
    # An installed copy may lie inside somebody else's checkout: the commit counts only if this file is tracked.
    tracked = _git(here.parent, "ls-files", "--error-unmatch", here.name) is not None
    commit = _git(here.parent, "rev-parse", "HEAD") if tracked else None
    changes = _git(here.parent, "status", "--porcelain", "--untracked-files=no") if commit else None
    return {
        "date": datetime.now().astimezone().isoformat(timespec="seconds"), "versions": versions,
        "commit": commit, "dirty": None if changes is None else bool(changes)}


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", "-C", folder, *arguments], capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def run_name(controller: str, seed: int) -> str:
    """What the files of a run are called; of a controller in a file, path/to/file.py:Class, without the / and :."""
    return f"{quote(controller, safe='+,-._ ')}-{seed}"


def default_folder(scenario: Scenario) -> Path:
    """runs/<scenario>-<timestamp> in the current folder, a name not taken yet."""
    stem = f"{files.file_name(scenario.name)}-{datetime.now():%Y%m%d-%H%M%S}"
    candidates = (Path("runs") / (stem + (f"-{n}" if n > 1 else "")) for n in range(1, 1000))
    return next(folder for folder in candidates if not folder.exists())


class RunFolder:
    """A folder of runs of one configuration, open for more of them. Made by `open_folder`."""

    def __init__(self, path: Path, order: Sequence[tuple[str, int]], rows: list[dict]):
        self.path = path
        self._rows = {(row["controller"], row["seed"]): row for row in rows}
        self._order = [*(run for run in self._rows if run not in order), *order]

    @property
    def finished(self) -> list[tuple[str, int]]:
        """(controller, seed) of every run that is here with its row and its trajectory; `order`'s own come last."""
        return [run for run in self._order if run in self._rows and self.trajectory_path(*run).is_file()]

    def trajectory_path(self, controller: str, seed: int) -> Path:
        return self.path / f"{run_name(controller, seed)}.npz"

    def add(self, trajectory: Trajectory) -> None:
        """Write a finished run at once: its trajectory, then summary.csv, which is what makes it count."""
        run = trajectory.controller, trajectory.seed
        write_trajectory(self.trajectory_path(*run), trajectory)
        self._rows[run] = summary(trajectory)
        write_summary(self.path / "summary.csv", self.rows())

    def rows(self) -> list[dict]:
        """The rows of summary.csv, one per finished run."""
        return [self._rows[run] for run in self._order if run in self._rows]

    def trajectories(self) -> list[Trajectory]:
        """The finished runs."""
        return [read_trajectory(self.trajectory_path(*run)) for run in self.finished]


@contextmanager
def open_folder(
    path: Path, *, configuration: Mapping, order: Sequence[tuple[str, int]],
    controllers: Mapping[str, Mapping] | None = None, session: Mapping | None = None,
    renew: Callable[[str], None] | None = None,
) -> Iterator[RunFolder]:
    """A RunFolder at `path` for the runs `order`, as (controller, seed); made if it is not there.

    configuration: what all runs have in common; the same at every opening (JSON types only, as all of these)
    controllers: what the runs of each controller depend on besides, such as the hash of a policy; a later opening
        may add controllers, but change one only with `renew`
    session: added to the provenance that every opening leaves in manifest.json
    renew: takes one line for every controller that changed, whose runs here do not count any more; the others do

    Finished runs are kept. Raises InputError if the folder holds another configuration or is no run folder. When
    the body ends before any run is finished, everything made here is removed again.
    """
    summary_path = Path(path) / "summary.csv"
    session = {"seeds": sorted({seed for _, seed in order}), **(session or {})}

    def drop(changed: Mapping[str, str]) -> None:
        rows = read_summary(summary_path) if summary_path.is_file() else []
        for name, what in changed.items():
            if kept := sum(row["controller"] == name for row in rows):
                renew(f"{path}: {name} has changed ({what}): its {kept} kept runs do not count any more, and those "
                      "asked for are run again")
        if rows:
            write_summary(summary_path, [row for row in rows if row["controller"] not in changed])

    with manifest(path, configuration=configuration, controllers=controllers, session=session, results=summary_path,
                  renew=drop if renew else None):
        folder = RunFolder(Path(path), order, read_summary(summary_path) if summary_path.is_file() else [])
        try:
            yield folder
        except BaseException:
            if not summary_path.exists():
                for run in order:
                    with suppress(OSError):
                        folder.trajectory_path(*run).unlink()
            raise


@contextmanager
def manifest(
    path: Path, *, configuration: Mapping, results: Path, controllers: Mapping[str, Mapping] | None = None,
    session: Mapping | None = None, renew: Callable[[Mapping[str, str]], None] | None = None,
) -> Iterator[None]:
    """manifest.json in the folder `path`, which is made if it is not there; arguments as in `open_folder`.

    renew: takes the controllers that changed, and what of them, before the manifest says so; without it they are an
        error
    results: the file in `path` that holds what is finished. If the body fails at the first opening before this file
    is there, everything made here is removed again. Raises InputError as `open_folder`, and while another process has
    the folder.
    """
    path = Path(path)
    configuration, controllers = json.loads(json.dumps([configuration, controllers or {}]))
    file, sessions = path / "manifest.json", []
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; choose another folder with --out")
    if path.is_dir() and not file.is_file() and any(
            found.name != LOCK and not files.TEMPORARY.fullmatch(found.name) for found in path.iterdir()):
        raise InputError(f"{path}: is not empty and holds no manifest.json; choose another folder with --out")
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        with files.locked(path / LOCK, path):
            files.sweep(path)
            if file.is_file():
                sessions, controllers, changed = _continued(
                    file, configuration, controllers, renewable=renew is not None)
                if changed:
                    renew(changed)
            first = not sessions
            sessions.append({**provenance(), **(session or {})})
            content = {"configuration": configuration, "controllers": controllers, "sessions": sessions}
            try:
                files.write_text(file, json.dumps(content, indent=2) + "\n")
                yield
            finally:
                if not results.exists() and first:
                    files.sweep(path)  # what a process that died at work for this one has left
                    with suppress(OSError):
                        file.unlink()
    finally:
        for parent in made:  # those that are empty
            with suppress(OSError):
                parent.rmdir()


def _continued(manifest_path: Path, configuration: Mapping, controllers: Mapping, *, renewable: bool) -> tuple:
    """The sessions so far, the controllers there and in `controllers`, and those that changed -> what of them.

    InputError where the configurations, or without `renewable` the controllers, do not agree.
    """
    manifest = read_manifest(manifest_path)
    sessions, known = manifest["sessions"], manifest["controllers"]
    try:
        there = {**{name: known.get(name, controllers[name]) for name in controllers}, **manifest["configuration"]}
        changed = {
            name: ", ".join(key for key in {**known[name], **wanted} if known[name].get(key) != wanted.get(key))
            for name, wanted in controllers.items() if name in known and known[name] != wanted}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{manifest_path}: is no manifest of a run; choose another folder with --out") from None
    asked = {**controllers, **configuration}
    for key in {**asked, **there}:
        if asked.get(key) != there.get(key) and not (renewable and key in changed):
            raise InputError(
                f"{manifest_path.parent}: holds runs of another configuration ({key}: {json.dumps(there.get(key))} "
                f"there, {json.dumps(asked.get(key))} asked for); choose another folder with --out")
    return sessions, {**known, **controllers}, changed


def labelled(trajectory: Trajectory, *, controller: str, plant: str) -> Trajectory:
    """`trajectory` under the names of the command line, which summary.csv shows."""
    return replace(trajectory, controller=controller, plant=plant)
