"""An entry: what one controller came to in a task set, as one JSON file that says how it was made."""

import json
from pathlib import Path
from typing import Any, Literal

from cosim.compete.metrics import METRICS
from nmfd import __version__
from nmfd.errors import InputError
from nmfd.runs import config
from nmfd.runs.config import Rows, Settings, Text, setting, whole
from nmfd.runs.files import check_file, write_text
from nmfd.runs.run_folder import controller_name

MOST = 10**7  # bytes of a file: a hundred times what one has


class Run(Settings):
    """A run that ended well."""

    seed: int = whole("of trips, drivers and noise")
    session: int | None = whole("in which it was made, of `sessions`; null: in one before this file was there", None)
    metrics: dict[str, float | None] = setting("cosim.compete.metrics; null: not known of this plant")


class Failure(Settings):
    """A run that does not count."""

    seed: int = whole("of trips, drivers and noise")
    reason: str = setting("why, in one line")


class Outcome(Settings):
    """Of one task."""

    task: Text = setting("its id")
    text: Text = setting("what it asks of controllers")
    strategy: Text = setting("what was run: the controller with the signals of the task")
    plant: Text = setting("what was driven")
    scenario: Text = setting("its name")
    scenario_hash: Text = setting("of all that regional models and controllers are given (Scenario.hash)")
    network: Text = setting("its name")
    network_hash: Text = setting("of the regional model")
    world: Text = setting("of all that happens, whatever controllers are given (cosim.compete.task_set.world)")
    demand: float = setting("multiple of the scenario's", ge=0.0)
    time_limit: float = setting("of a decision", unit="s", ge=0.0)
    depends_on: dict[str, Any] = setting("what the controller's own runs depend on: options, hashes of files, versions")
    seeds: tuple[int, ...] = setting("that the task has", strict=False)
    runs: Rows[Run] = setting("those that count")
    failed: Rows[Failure] = setting("those that do not")
    missing: tuple[int, ...] = setting("seeds that were not run yet", strict=False)

    @property
    def complete(self) -> bool:
        """Whether every seed has a run that counts."""
        return {run.seed for run in self.runs} == set(self.seeds)


class TaskSetName(Settings):
    """Which tasks."""

    name: Text = setting("of the task set")
    named: Text = setting("as --tasks has it")
    hash: Text = setting("of what it says")
    released: bool = setting("whether it came with the package and was released")


class Entry(Settings):
    """The file."""

    format: Literal[1] = setting("of this file", 1)
    controller: Text = setting("its name")
    task_set: TaskSetName = setting("which tasks")
    command: Text = setting("that makes it again, with the same files and versions")
    sessions: tuple[dict[str, Any], ...] = setting(
        "date, versions and commit of every one that made runs", strict=False
    )
    tasks: Rows[Outcome] = setting("every task of the set")
    missing: tuple[str, ...] = setting("tasks that are not complete", strict=False)
    metrics: dict[str, dict[str, str]] = setting("what the metrics are, and what RESCO and LibSignal call them")

    def outcome(self, task: str) -> Outcome | None:
        """Of a task."""
        return next((one for one in self.tasks if one.task == task), None)


def about_metrics() -> dict[str, dict[str, str]]:
    """`Entry.metrics`."""
    return {
        name: {"what": metric.text, "RESCO": metric.resco, "LibSignal": metric.libsignal}
        for name, metric in METRICS.items()
    }


def path(folder: Path, controller: str) -> Path:
    """Where the entry of a controller lies."""
    return folder / f"{controller_name(controller)}.json"


def write(file: Path, entry: Entry) -> None:
    """Atomically."""
    write_text(file, json.dumps(entry.model_dump(mode="json"), indent=1, allow_nan=False) + "\n")


def read(file: Path) -> Entry:
    """Raises InputError for what is no entry."""
    remedy = "give a file that cosim compete has written, or remove it"
    check_file(file, remedy)
    try:
        if file.stat().st_size > MOST:
            raise ValueError(f"more than {MOST} bytes")
        content = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError("no table")
    except (OSError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{file}: is no entry ({reason}); {remedy}") from None
    found = config.checked(Entry, content, file)
    for outcome in found.tasks:
        for run in outcome.runs:
            if unknown := set(run.metrics) - set(METRICS):
                raise InputError(
                    f"{file}: {outcome.task}: {min(unknown)!r} is no metric of version {__version__}; "
                    "read it with the version that wrote it"
                )
    return found
