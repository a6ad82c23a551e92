"""Many independent runs in a folder.

Finished ones are skipped. Each result is written whole or not at all.

<folder>/manifest.json    keys of all runs; commands, commits, versions and seeds of all sessions
<folder>/runs.csv         one row per run (nmfd.metrics.summary), the reason of a failure last
<folder>/[<subfolder>/]<controller>-<seed>.nc    Dataset of a run (nmfd.types.Result)
"""

import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from filelock import FileLock, Timeout

from nmfd import __version__
from nmfd.errors import InputError, RunFailed, need
from nmfd.metrics import summary
from nmfd.runs.files import check_name, write_table, write_text
from nmfd.runs.pool import attempt, in_processes, in_subprocess
from nmfd.runs.progress import Progress, watched
from nmfd.types import Result

if TYPE_CHECKING:
    import pandas as pd

MANIFEST = "manifest.json"
TABLE = "runs.csv"
LOCK = ".lock"
DASK_PATIENCE_S = 10.0  # for the scheduler to answer
LONGER = 10.0  # time limit of a run, in expected times
LEAST_LIMIT_S = 600.0
PACKAGES = ("numpy", "torch", "casadi", "libsumo")  # whose versions are in the manifest


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
    """

    name: str
    key: Mapping[str, Any]
    job: Callable[[], Any]
    folder: str = ""
    expected: float = 0.0

    @property
    def limit(self) -> float:
        """Time after which the run is ended (s)."""
        return max(LONGER * self.expected, LEAST_LIMIT_S)

    @property
    def file(self) -> str:
        """Path of its file below the folder of all runs."""
        return f"{self.folder}/{self.name}.nc" if self.folder else f"{self.name}.nc"


def run_many(
    runs: Sequence[Run],
    out: Path | str,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    time_limit: float | None = None,
    progress: Progress = None,
) -> "pd.DataFrame":
    """Do the runs whose files are not in a folder; return one row per run.

    Columns are those of `nmfd.metrics.summary`, `folder` if there are several, and `failure`: "" of
    a finished run, else the reason with file and line. Finished runs of earlier calls that share
    the keys come last.

    workers: runs at a time, each in a process of its own; 0: one after the other in this process
    scheduler: address of a Dask scheduler, whose workers do the runs; it takes TLS certificates
        from Dask's own configuration
    time_limit: wall time after which the process of a run is ended (s); if None, ten times the
        expected time, at least ten minutes. Runs in this process have none
    progress: None for a bar, False for none, or a function of done, total and the name of a run
    Raises: InputError if another process has the folder, or it is not a folder of runs
    """
    out = Path(out)
    with locked(out):
        keys = _write_manifest(out, runs, workers)
        rows = {}
        for file, key in keys.items():
            result = _finished(out / file, key)
            if result is not None:
                rows[file] = _row(file, result)
        todo = [run for run in runs if run.file not in rows]
        minutes = sum(run.expected for run in todo) / max(workers, 1) / 60.0
        said = minutes > 0.5 and scheduler is None
        if said:
            text = f"{len(todo)} runs take about {minutes:.0f} min, {workers} at a time"
            print(text, file=sys.stderr)
        try:
            with (
                watched("runs", progress, said=said) as show,
                closing(_outcomes(todo, workers, scheduler, time_limit)) as ended,
            ):
                if show and todo:
                    show(0, len(todo), "")
                for done, (run, outcome) in enumerate(ended, 1):
                    if isinstance(outcome, Result):
                        outcome = outcome.assign(key=json.dumps(keys[run.file]))
                        (out / run.file).parent.mkdir(parents=True, exist_ok=True)
                        outcome.write(out / run.file)
                    rows[run.file] = _row(run.file, outcome)
                    if show:
                        show(done, len(todo), run.name)
        except KeyboardInterrupt:
            kept = f"finished runs are in {out}; the same command with --out {out} goes on"
            raise KeyboardInterrupt(kept) from None
        finally:
            table = _table([rows[file] for file in keys if file in rows])
            write_table(out / TABLE, table)
    return table


def raise_failures(rows: "pd.DataFrame") -> None:
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
        limits = [time_limit or run.limit for run in todo]
        for number, outcome in in_processes([run.job for run in todo], workers, limits):
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
        problem = "another process is writing to it; wait for its end"
        raise InputError(f"{out}: {problem}, or {remedy}") from None


def read_manifest(folder: Path) -> dict:
    """Return manifest.json of a folder of runs: its folders and sessions.

    Raises: InputError
    """
    file = folder / MANIFEST
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        content["folders"].items()
        content["sessions"][0]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        remedy = "choose another folder with --out"
        raise InputError(f"{file}: is no manifest of runs; {remedy}") from None
    return content


def _write_manifest(out: Path, runs: Sequence[Run], workers: int) -> dict[str, dict]:
    """Add `runs` and this session to the manifest.

    Return file -> key: of these runs, then of others in the folders.
    """
    manifest: dict = {"folders": {}, "sessions": []}
    if (out / MANIFEST).is_file():
        manifest = read_manifest(out)
    folders = manifest["folders"]
    for run in runs:
        key = json.loads(json.dumps(run.key))
        own = key.pop("controller", None)
        if folders.get(run.folder, {}).get("key") != key:
            folders[run.folder] = {"key": key, "controllers": {}}
        folders[run.folder]["controllers"][_place(run.file)[1]] = own
    seeds = sorted({_place(run.file)[2] for run in runs})
    manifest["sessions"].append({**provenance(), "seeds": seeds, "workers": workers})
    write_text(out / MANIFEST, json.dumps(manifest, indent=2) + "\n")
    there = [run.file for run in runs]
    for name in folders:
        for path in sorted((out / name).glob("[!.]*-*.nc")):
            there.append(path.relative_to(out).as_posix())
    keys = {}
    for file in there:
        folder, controller, _ = _place(file)
        controllers = folders[folder]["controllers"]
        if controller in controllers:
            keys[file] = {**folders[folder]["key"], "controller": controllers[controller]}
    return keys


def _finished(path: Path, key: Mapping) -> Result | None:
    """Return the result in `path`; None if there is none with this key."""
    try:
        result = Result.read(path)
        kept = json.loads(result.key)
    except (InputError, AttributeError, ValueError):  # missing, cut off, or not of this package
        return None
    changed = sorted(name for name in {**kept, **key} if kept.get(name) != key.get(name))
    if changed:
        with suppress(BrokenPipeError):  # perhaps nobody reads on
            print(f"{path}: out of date, {', '.join(changed)} changed", file=sys.stderr)
        return None
    return result


def _row(file: str, outcome: Result | str) -> dict:
    folder, controller, seed = _place(file)
    row = {"folder": folder, "controller": controller, "seed": seed}
    if isinstance(outcome, str):
        return {**row, "failure": outcome}
    return {**row, **summary(outcome), "failure": ""}


def _place(file: str) -> tuple[str, str, int]:
    """Return folder, controller and seed of the file of a run."""
    folder, _, name = file.rpartition("/")
    controller, _, seed = name.removesuffix(".nc").rpartition("-")
    return folder, unquote(controller), int(seed)


def _table(rows: Sequence[dict]) -> "pd.DataFrame":
    import pandas as pd

    if not rows:
        return pd.DataFrame(columns=["controller", "seed", "failure"])
    table = pd.DataFrame(rows)
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
