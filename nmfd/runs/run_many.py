"""Many independent runs in a folder.

Finished ones are skipped. Each result is written whole or not at all.

<folder>/manifest.json    keys of all runs; commands, commits, versions and seeds of all sessions
<folder>/runs.csv         one row per run (nmfd.metrics.summary), the reason of a failure last
<folder>/.rows.json       rows and keys of finished runs, with size and time of their files
<folder>/[<subfolder>/]<controller>-<seed>.nc    Dataset of a run (nmfd.types.Result)
"""

import csv
import io
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple
from urllib.parse import unquote

from filelock import FileLock, Timeout
from pydantic import BaseModel, Field

from nmfd import __version__, metrics
from nmfd.errors import InputError, RunFailed, need
from nmfd.runs.files import (
    check_file,
    check_name,
    file_hash,
    run_name,
    write_if_changed,
    write_text,
)
from nmfd.runs.pool import attempt, in_processes, in_subprocess
from nmfd.runs.progress import Progress, watched
from nmfd.types import Result

if TYPE_CHECKING:
    import pandas as pd

    from nmfd.runs.frame import Table

MANIFEST = "manifest.json"
TABLE = "runs.csv"
ROWS = ".rows.json"
LOCK = ".lock"
DASK_PATIENCE_S = 10.0  # for the scheduler to answer
RUN_FILE = re.compile(r"((?P<folder>.+)/)?(?P<controller>[^/]+)-(?P<seed>\d+)\.nc")
LONGEST_NAME = 200  # of a run (bytes); systems allow 255, some of which temporary files need
LONGER = 10.0  # time limit of a run, in expected times
LEAST_LIMIT_S = 600.0
PACKAGES = ("numpy", "torch", "casadi", "libsumo")  # whose versions are in the manifest


class Place(NamedTuple):
    """Folder below that of all runs, controller and seed of a run."""

    folder: str
    controller: str
    seed: int


@dataclass(frozen=True)
class Run:
    """A run to do.

    name: stem of its file (`files.run_name`)
    key: everything the result depends on, as JSON types: hashes, settings, versions. Its item
        "controller" holds what only runs of this controller depend on; all else is the same for all
        runs of a folder
    job: function without arguments that returns the Result, or the reason why there is none; it
        can be pickled, by value if it is the user's
    folder: folder below that of all runs
    expected: wall time (s), 0 if unknown
    modules: those that its process needs besides that of its job
    """

    name: str
    key: Mapping[str, Any]
    job: Callable[[], Any]
    folder: str = ""
    expected: float = 0.0
    modules: tuple[str, ...] = ()

    @property
    def limit(self) -> float:
        """Time after which the run is ended (s)."""
        return max(LONGER * self.expected, LEAST_LIMIT_S)

    @property
    def place(self) -> Place:
        """Folder, controller and seed."""
        return place_of(self.file)

    @property
    def json_key(self) -> dict[str, Any]:
        """The key as it is read from a file."""
        return json.loads(json.dumps(self.key))

    @property
    def file(self) -> str:
        """Path of its file below the folder of all runs."""
        return file_of(self.folder, self.name)


def run_many(
    runs: Sequence[Run],
    out: Path | str,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    time_limit: float | None = None,
    overwrite: bool = False,
    progress: Progress = None,
) -> "Table":
    """Do the runs whose files are not in a folder; return one row per run.

    Columns are those of `nmfd.metrics.summary`, `folder` if there are several, and `failure`: "" of
    a finished run, else the reason with file and line. Finished runs of earlier calls that share
    the keys come last. The folder is `table.attrs["folder"]`.

    workers: runs at a time, each in a process of its own; 0: one after the other in this process
    scheduler: address of a Dask scheduler, whose workers do the runs; it takes TLS certificates
        from Dask's own configuration
    time_limit: wall time after which the process of a run is ended (s); if None, ten times the
        expected time, at least ten minutes. Runs in this process have none
    overwrite: do finished runs again whose keys have changed
    progress: None for a bar, False for none, or a function of done, total and the name of a run
    Raises: InputError if another process has the folder, it is not a folder of runs, or finished
        runs in it have other keys, without `overwrite`
    """
    out = Path(out)
    with locked(out):
        check_names(runs)
        kept = _kept_runs(out, [run.file for run in runs])
        if not overwrite:
            _check_kept(out, runs, kept)
        keys = _write_manifest(out, runs, workers, kept)
        rows: dict[str, dict[str, Any]] = {}
        for name, key in keys.items():
            if name not in kept:
                continue
            changed = _differing(kept[name].key, key)
            if changed:
                _say(f"{out / name}: out of date, {changed} changed")
            else:
                rows[name] = kept[name].row
        todo = [run for run in runs if run.file not in rows]
        minutes = sum(run.expected for run in todo) / max(workers, 1) / 60.0
        said = minutes > 0.5 and scheduler is None
        if said:
            _say(
                f"{len(todo)} runs take about {minutes:.0f} min, {workers} at a time, and longer "
                "where streets fill up"
            )
        try:
            with (
                watched("runs", progress, said=said) as show,
                closing(_outcomes(todo, workers, scheduler, time_limit)) as ended,
            ):
                if show and todo:
                    show(0, len(todo), "")
                for done, (run, outcome) in enumerate(ended, 1):
                    row = _row(run.file, outcome)
                    if isinstance(outcome, Result):
                        key = keys[run.file]
                        file = out / run.file
                        file.parent.mkdir(parents=True, exist_ok=True)
                        outcome.assign(key=json.dumps(key)).write(file)
                        kept[run.file] = Kept(row, key, _stamp(file))
                    rows[run.file] = row
                    if show:
                        show(done, len(todo), run.name)
        except KeyboardInterrupt:
            left = f"finished runs are in {out}; the same command with --out {out} goes on"
            raise KeyboardInterrupt(left) from None
        finally:
            table = _table([rows[name] for name in keys if name in rows])
            content = {"made_by": _made_by(), "runs": kept}
            write_text(out / ROWS, json.dumps(content, default=lambda numbers: numbers.tolist()))
            write_if_changed(out / TABLE, table.to_csv(index=False))
    table.attrs["folder"] = str(out)
    return table


def finished_table(out: Path) -> "pd.DataFrame":
    """Return the finished runs in a folder, as if read from runs.csv.

    Only their order is that of runs.csv. A row is that of ROWS if size and time of its file are as
    they were; else it is made of the file.
    """
    import pandas as pd  # takes half a second

    names = []
    with suppress(OSError, KeyError, TypeError, ValueError, csv.Error):
        for row in csv.DictReader((out / TABLE).read_text(encoding="utf-8").splitlines()):
            run = run_name(row["controller"], int(row["seed"]))
            names.append(file_of(row.get("folder", ""), run))
    kept = _kept_runs(out, names)
    rows = []
    for name, key in _keys(_manifest(out)["folders"], kept).items():
        if not _differing(kept[name].key, key):
            rows.append(kept[name].row)
    return pd.read_csv(io.StringIO(_table(rows).to_csv(index=False)))


def check_names(runs: Sequence[Run]) -> None:
    """Raise InputError for a run whose name is too long for a file."""
    for run in runs:
        if len(run.name.encode()) > LONGEST_NAME:
            raise InputError(
                f"controller {run.place.controller}: its name is longer than the {LONGEST_NAME} "
                "bytes that a file may have; shorten it"
            )


def raise_failures(rows: "Table") -> None:
    """Raise RunFailed that names all failed runs in the rows of `run_many`."""
    failed = rows[rows["failure"] != ""]
    if len(failed):
        runs = failed["controller"] + ", seed " + failed["seed"].astype(str)
        raise RunFailed("; ".join(runs + ": " + failed["failure"]))


def _outcomes(
    todo: Sequence[Run], workers: int, scheduler: str | None, time_limit: float | None
) -> Generator[tuple[Run, Any]]:
    """Yield runs as they end, with their result or reason of failure."""
    if scheduler is not None and todo:
        with _dask(scheduler) as executor:
            futures = {executor.submit(in_subprocess, run.job, os.getcwd()): run for run in todo}
            for future in as_completed(list(futures)):
                run = futures.pop(future)  # with its result, which may be large
                yield run, attempt(future.result)
    elif workers == 0:
        for run in todo:
            yield run, attempt(run.job)
    else:
        jobs = [run.job for run in todo]
        limits = [time_limit or run.limit for run in todo]
        modules = {name for run in todo for name in run.modules}
        for number, outcome in in_processes(jobs, workers, limits, modules=modules):
            yield todo[number], outcome


@contextmanager
def _dask(address: str) -> Iterator[Executor]:
    """Connect to a Dask scheduler.

    Its workers see the same files under the same paths. Raises: InputError
    """
    need("--scheduler", "dask", "distributed")
    from distributed import Client  # of an extra

    try:
        client = Client(address, timeout=DASK_PATIENCE_S, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"--scheduler: no Dask scheduler answers at {address!r} ({reason}); start one with "
            "'dask scheduler' and give its address, such as tcp://host:8786"
        ) from None
    executor = client.get_executor(pure=False)
    try:
        yield executor
    finally:
        executor.shutdown(wait=False)
        client.close()


@contextmanager
def locked(out: Path, mark: str = MANIFEST) -> Iterator[None]:
    """Make a folder and hold it against other processes.

    It is removed if nothing comes into it. A command holds its folder around its runs, tables and
    figures.

    mark: file that a folder with other files must hold
    Raises: InputError
    """
    check_name(out)
    remedy = "choose another folder with --out"
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; {remedy}")
    out.mkdir(parents=True, exist_ok=True)
    if not (out / mark).is_file() and list(out.glob("[!.]*")):
        raise InputError(f"{out}: is not empty and holds no {mark}; {remedy}")
    try:
        with FileLock(out / LOCK, timeout=0, is_singleton=True):
            try:
                yield
            finally:
                if [path.name for path in out.glob("*")] == [LOCK]:
                    shutil.rmtree(out, ignore_errors=True)
    except Timeout:
        raise InputError(
            f"{out}: another process is writing to it; wait for its end, or {remedy}"
        ) from None


class FolderOfRuns(BaseModel):
    """Entry of a manifest.

    key: what all runs of a folder depend on
    controllers: what those of a controller depend on in addition
    """

    key: dict[str, Any]
    controllers: dict[str, Any]


class Manifest(BaseModel):
    """Content of manifest.json."""

    folders: dict[str, FolderOfRuns]
    sessions: Annotated[list[dict[str, Any]], Field(min_length=1)]


def read_manifest(folder: Path) -> dict:
    """Return manifest.json of a folder of runs: its folders and sessions.

    Raises: InputError
    """
    file = folder / MANIFEST
    check_file(file)
    try:
        manifest = Manifest.model_validate_json(file.read_bytes())
    except (OSError, ValueError):
        raise InputError(
            f"{file}: is no manifest of runs, or damaged; choose another folder with --out"
        ) from None
    return manifest.model_dump()


def _write_manifest(
    out: Path, runs: Sequence[Run], workers: int, kept: Iterable[str]
) -> dict[str, dict]:
    """Add `runs` and this session to the manifest.

    kept: files of finished runs
    Return file -> key of these runs, then of others in the folders.
    """
    manifest = _manifest(out)
    folders = manifest["folders"]
    for run in runs:
        key = dict(run.json_key)
        own = key.pop("controller", None)
        if folders.get(run.folder, {}).get("key") != key:
            folders[run.folder] = {"key": key, "controllers": {}}
        folders[run.folder]["controllers"][run.place.controller] = own
    seeds = sorted({run.place.seed for run in runs})
    manifest["sessions"].append({**provenance(), "seeds": seeds, "workers": workers})
    write_text(out / MANIFEST, json.dumps(manifest, indent=2) + "\n")
    return _keys(folders, (*(run.file for run in runs), *kept))


def _keys(folders: Mapping[str, Mapping], names: Iterable[str]) -> dict[str, dict]:
    """Return file -> key of the runs that a manifest knows.

    folders: its entry of that name
    """
    keys = {}
    for name in names:
        folder, controller, _ = place_of(name)
        entry = folders[folder]
        if controller in entry["controllers"]:
            keys[name] = {**entry["key"], "controller": entry["controllers"][controller]}
    return keys


def _manifest(out: Path) -> dict[str, Any]:
    """Return the manifest of a folder, an empty one if there is none.

    Raises: InputError
    """
    if (out / MANIFEST).exists():
        return read_manifest(out)
    return {"folders": {}, "sessions": []}


def _stamp(file: Path) -> list[int]:
    """Return size and time of the last change (ns) of a file."""
    about = file.stat()
    return [about.st_size, about.st_mtime_ns]


class Kept(NamedTuple):
    """A finished run.

    row: its row of the table
    key: everything that it depends on
    stamp: `_stamp` of its file
    """

    row: dict[str, Any]
    key: dict[str, Any]
    stamp: list[int]


def _known_rows(out: Path) -> dict[str, Kept]:
    """Return the rows of finished runs from an earlier call by file.

    There are none if another version of `nmfd.metrics` has made them.
    """
    try:
        content = json.loads((out / ROWS).read_bytes())
        if content["made_by"] != _made_by():
            return {}
        return {file: Kept(*entry) for file, entry in content["runs"].items()}
    except (OSError, ValueError, TypeError, KeyError):  # missing or damaged
        return {}


@cache
def _made_by() -> str:
    """Return a fingerprint of the code that makes the rows."""
    return file_hash(Path(metrics.__file__))


def _kept_runs(out: Path, names: Sequence[str]) -> dict[str, Kept]:
    """Return the finished runs in the folder: the files `names`, then others."""
    names = list(names)
    known = _known_rows(out)
    for folder in _manifest(out)["folders"]:
        for path in sorted((out / folder).glob("[!.]*-*.nc")):
            names.append(path.relative_to(out).as_posix())
    found = {}
    for name in dict.fromkeys(names):
        kept = _kept(out / name, name, known.get(name))
        if kept is not None:
            found[name] = kept
    return found


def _kept(path: Path, name: str, known: Kept | None) -> Kept | None:
    """Return the finished run in `path`.

    None if there is none, or one of another controller or seed than its name says.
    known: from an earlier call, right if the file still has its size and time
    """
    if not path.is_file() or not RUN_FILE.fullmatch(name):
        return None
    stamp = _stamp(path)
    if known is not None and known.stamp == stamp:
        return known
    try:
        result = Result.read(path)
        key = json.loads(result.attrs["key"])
        found = result.controller, result.seed
    except (InputError, KeyError, ValueError):  # cut off, or not of this package
        return None
    if found != place_of(name)[1:]:
        _say(f"{path}: is the run of {found[0]} with seed {found[1]}, not that of its name")
        return None
    return Kept(_row(name, result), key, stamp)


def _check_kept(out: Path, runs: Sequence[Run], kept: Mapping[str, Kept]) -> None:
    """Raise InputError if a finished run with another key would be replaced."""
    for run in runs:
        if run.file not in kept:
            continue
        changed = _differing(kept[run.file].key, run.json_key)
        if changed:
            raise InputError(
                f"{out / run.file}: is a run with other settings ({changed} changed); choose "
                "another folder with --out, or add --overwrite to do it again"
            )


def _differing(one: Mapping, other: Mapping) -> str:
    """Return the names of the items in which two keys differ."""
    names = [name for name in {**one, **other} if one.get(name) != other.get(name)]
    return ", ".join(sorted(names))


def _say(text: str) -> None:
    with suppress(BrokenPipeError):  # perhaps nobody reads on
        print(text, file=sys.stderr)


def _row(file: str, outcome: Result | str) -> dict:
    row = place_of(file)._asdict()
    if isinstance(outcome, str):
        return {**row, "failure": outcome}
    return {**row, **metrics.summary(outcome), "failure": ""}


def file_of(folder: str, name: str) -> str:
    """Return the path of the file of a run below the folder of all runs."""
    return f"{folder}/{name}.nc" if folder else f"{name}.nc"


def place_of(file: str) -> Place:
    """Return the place of the file of a run.

    Raises: ValueError for another name
    """
    match = RUN_FILE.fullmatch(file)
    if match is None:
        raise ValueError(f"{file}: is not the name of a run")
    return Place(match["folder"] or "", unquote(match["controller"]), int(match["seed"]))


def _table(rows: Sequence[dict]) -> "Table":
    from nmfd.runs.frame import Table  # pandas takes half a second

    if not rows:
        return Table(columns=["controller", "seed", "failure"])
    table = Table(rows)
    table.insert(len(table.columns) - 1, "failure", table.pop("failure"))
    if not any(table["folder"]):
        del table["folder"]
    return table


def provenance() -> dict:
    """Return date, command, versions, and the commit of the checkout.

    The commit is None outside a checkout.
    """
    commit, dirty = _checkout()
    versions = {"python": platform.python_version(), "perimeter-cosim": __version__}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return {
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "commit": commit,
        "dirty": dirty,
        "versions": versions,
    }


@cache
def _checkout() -> tuple[str | None, bool | None]:
    """Return the commit of this package, and True if files differ from it.

    Both are those at the first call.
    """
    here = Path(__file__).resolve()

    def git(*arguments: str) -> str:
        command = ["git", "--no-optional-locks", *arguments]
        done = subprocess.run(
            command, cwd=here.parent, capture_output=True, text=True, timeout=10, check=True
        )
        return done.stdout.strip()

    try:
        # An installed copy may lie inside another checkout, which does not track this file.
        git("ls-files", "--error-unmatch", here.name)
        return git("rev-parse", "HEAD"), bool(git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None, None
