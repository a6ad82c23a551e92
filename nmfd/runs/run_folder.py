"""Run folders: trajectories, summary.csv and manifest.json, written so that an interruption costs one run at most.

<folder>/manifest.json              configuration, controllers, and seeds, versions and commit of every session
<folder>/summary.csv                one row per finished run (metrics.summary)
<folder>/<controller>-<seed>.nc     all else of it (nmfd.types.Result, in SUMO cosim.plant.record.Record too)
                                    but wall times, so that the same run gives the same bytes; a netCDF file:
                                    xarray.open_dataset, with dimensions, units and long names
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from nmfd.errors import InputError
from nmfd.metrics import SUMMARY, summary
from nmfd.runs import files
from nmfd.runs.files import default_folder as default_folder
from nmfd.runs.run_many import provenance, run_name
from nmfd.types import Result

COLUMNS = {name: kind for name, (kind, _) in SUMMARY.items()}
LOCK = ".lock"  # of a run folder


def read_trajectory(path: Path) -> Result:
    """Return the run in the netCDF file `path`. Raises InputError."""
    return Result.read(path)


def refuse_old(folder: Path) -> None:
    """InputError for a folder of runs that an older version wrote."""
    if not any(folder.glob("*-[0-9]*.npz")):
        return
    command = "the command that made it"
    with suppress(InputError, LookupError):
        manifest = read_manifest(folder / "manifest.json")
        program = "cosim run, evaluate or sweep" if manifest["configuration"]["plant"] == "sumo" else "nmfd benchmark"
        command = f"{program} {manifest['sessions'][-1]['scenario_folder']}, with {', '.join(manifest['controllers'])}"
    raise InputError(f"{folder}: holds runs of an older version (.npz); delete it and run again: {command}")


def write_summary(path: Path, rows: list[dict]) -> None:
    """`rows` of metrics.summary as summary.csv, atomically."""
    files.write_rows(path, COLUMNS, rows)


def read_manifest(path: Path) -> dict:
    """manifest.json of a run folder: configuration, controllers, sessions. Raises InputError."""
    files.check_file(path, "choose another folder with --out")
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
    refuse_old(Path(path).parent)
    return files.read_rows(path, COLUMNS)


def run_path(folder: Path, controller: str, seed: int) -> Path:
    """The file of a run in its folder."""
    return folder / f"{run_name(controller, seed)}.nc"


def trajectories(folder: Path) -> list[Result]:
    """The runs in summary.csv of a run folder. Raises InputError."""
    rows = read_summary(folder / "summary.csv")
    return [read_trajectory(run_path(folder, row["controller"], row["seed"])) for row in rows]


class RunFolder:
    """A folder of runs of one configuration, open for more of them. Made by `open_folder`."""

    def __init__(self, path: Path, order: Sequence[tuple[str, int]], rows: list[dict]):
        self.path = path
        self._rows = {(row["controller"], row["seed"]): row for row in rows}
        self._order = [*(run for run in self._rows if run not in order), *order]

    @property
    def finished(self) -> list[tuple[str, int]]:
        """(controller, seed) of every run that is here with its row and its file; `order`'s own come last."""
        return [run for run in self._order if run in self._rows and self.trajectory_path(*run).is_file()]

    def position(self, controller: str, seed: int) -> int:
        """Of a run among all that are here or asked for, -1 for another one: as in summary.csv."""
        run = controller, seed
        return self._order.index(run) if run in self._order else -1

    def trajectory_path(self, controller: str, seed: int) -> Path:
        """Its file, there or not."""
        return run_path(self.path, controller, seed)

    def add(self, result: Result) -> None:
        """Write a finished run at once: its file, then summary.csv, which makes it count."""
        run = result.controller, result.seed
        result.write(self.trajectory_path(*run))
        row = summary(result)
        self._rows[run] = {name: row[name] for name in COLUMNS}
        write_summary(self.path / "summary.csv", self.rows())

    def rows(self) -> list[dict]:
        """The rows of summary.csv, one per finished run."""
        return [self._rows[run] for run in self._order if run in self._rows]

    def trajectories(self) -> list[Result]:
        """The finished runs."""
        return [read_trajectory(self.trajectory_path(*run)) for run in self.finished]


@contextmanager
def open_folder(
    path: Path,
    *,
    configuration: Mapping,
    order: Sequence[tuple[str, int]],
    controllers: Mapping[str, Mapping] | None = None,
    session: Mapping | None = None,
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

    def drop(changed: Mapping[str, str], tell: Callable[[str], None]) -> None:
        rows = read_summary(summary_path) if summary_path.is_file() else []
        for name, what in changed.items():
            if kept := sum(row["controller"] == name for row in rows):
                tell(
                    f"{path}: {name} has changed ({what}): its {kept} kept runs do not count any more, and those "
                    "asked for are run again"
                )
        if rows:
            write_summary(summary_path, [row for row in rows if row["controller"] not in changed])

    refuse_old(Path(path))
    with manifest(
        path,
        configuration=configuration,
        controllers=controllers,
        session=session,
        results=summary_path,
        renew=None if renew is None else partial(drop, tell=renew),
    ):
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
    path: Path,
    *,
    configuration: Mapping,
    results: Path,
    controllers: Mapping[str, Mapping] | None = None,
    session: Mapping | None = None,
    renew: Callable[[Mapping[str, str]], None] | None = None,
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
    if (
        path.is_dir()
        and not file.is_file()
        and any(found.name != LOCK and not files.TEMPORARY.fullmatch(found.name) for found in path.iterdir())
    ):
        raise InputError(f"{path}: is not empty and holds no manifest.json; choose another folder with --out")
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        with files.locked(path / LOCK, path):
            files.sweep(path)
            if file.is_file():
                sessions, controllers, changed = _continued(
                    file, configuration, controllers, renewable=renew is not None
                )
                if changed and renew is not None:
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
            for name, wanted in controllers.items()
            if name in known and known[name] != wanted
        }
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{manifest_path}: is no manifest of a run; choose another folder with --out") from None
    asked = {**controllers, **configuration}
    for key in {**asked, **there}:
        if asked.get(key) != there.get(key) and not (renewable and key in changed):
            raise InputError(
                f"{manifest_path.parent}: holds runs of another configuration ({key}: {json.dumps(there.get(key))} "
                f"there, {json.dumps(asked.get(key))} asked for); choose another folder with --out"
            )
    return sessions, {**known, **controllers}, changed


def labelled(result: Result, *, controller: str, plant: str) -> Result:
    """`result` under the names of the command line, which summary.csv shows."""
    return result.assign(controller=controller, plant=plant)
