"""The leaderboard: many entries side by side, and the rule by which they are ranked.

In a task an entry is worth its total time spent over that of no control, paired by seed: the geometric mean over the
seeds. Overall it is worth the geometric mean over all tasks of the set, each counted the same. Whoever is worth less is
better. Only an entry whose every run in every task counts has a rank; nobody's worth depends on who else is there but
no control.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import pandas as pd

from cosim.compete import entry
from cosim.compete.entry import Entry, Outcome
from cosim.compete.metrics import METRICS, TTS
from cosim.compete.task_set import HERE, names
from nmfd.errors import InputError
from nmfd.metrics import COUNTED
from nmfd.runs.files import write_table
from nmfd.studies.benchmark import REFERENCE

ALL = "all tasks"
RULE = (
    "Worth: total time spent over that of no control with the same seed, geometric mean over the seeds of a task, and "
    "over the tasks, each counted the same; less is better. An entry has a rank in a task, or overall, if its every "
    "run there counts, and those of no control."
)
SUMMED = ("teleports", *COUNTED)  # of the metrics, those that are summed over seeds


@dataclass(frozen=True, kw_only=True)
class Row:
    """An entry in a task, or in all of them.

    name: the controller's, with its file where several have it; place: file of the entry; rank: None without one;
    worth: see above, None where it is not defined; runs, failed, missing: numbers of runs; metrics: mean over the runs
    that count, or sum (SUMMED); reasons: of failed runs
    """

    name: str
    place: Path
    task: str
    rank: int | None
    worth: float | None
    runs: int
    failed: int
    missing: int
    metrics: Mapping[str, float | None]
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Leaderboard:
    """tasks: id -> what it asks; overall, by_task: rows, the best first; entries: by name"""

    title: str
    hash: str
    released: bool
    tasks: Mapping[str, Outcome]
    overall: tuple[Row, ...]
    by_task: Mapping[str, tuple[Row, ...]]
    entries: Mapping[str, Entry]


def read(places: Sequence[str]) -> Leaderboard:
    """The entries in these folders, or those that come with the package where a task set is named. InputError for none,
    and for entries that cannot be compared."""
    files = [file for place in places for file in _files(place)]
    found = {file: entry.read(file) for file in files}
    _check(found)
    told = [one.controller for one in found.values()]
    by_name = {
        one.controller if told.count(one.controller) == 1 else f"{one.controller} ({file})": (file, one)
        for file, one in found.items()
    }
    first = next(iter(found.values()))
    tasks = {outcome.task: outcome for outcome in first.tasks}
    by_task = {}
    for task in tasks:
        without = next(
            (
                outcome
                for one in found.values()
                if one.controller == REFERENCE and (outcome := one.outcome(task)) is not None and outcome.complete
            ),
            None,
        )
        by_task[task] = _ranked([_row(name, file, one, task, without) for name, (file, one) in by_name.items()])
    overall = _ranked(
        [
            _all(name, file, [row for task in tasks for row in by_task[task] if row.name == name])
            for name, (file, _) in by_name.items()
        ]
    )
    return Leaderboard(
        title=first.task_set.name,
        hash=first.task_set.hash,
        released=first.task_set.released,
        tasks=tasks,
        overall=overall,
        by_task=by_task,
        entries={name: one for name, (_, one) in by_name.items()},
    )


def write_csv(path: Path, board: Leaderboard) -> None:
    """A row per entry and task, and one for all tasks together; empty: not known."""
    rows = [row for group in (board.overall, *board.by_task.values()) for row in group]
    frame = pd.DataFrame(
        [
            {
                "task": row.task,
                "controller": row.name,
                "entry": row.place.as_posix(),
                "rank": row.rank,
                "worth": row.worth,
                "runs": row.runs,
                "failed": row.failed,
                "missing": row.missing,
                **{name: row.metrics.get(name) for name in METRICS},
                "reasons": "; ".join(row.reasons),
            }
            for row in rows
        ]
    )
    write_table(path, frame.astype({"rank": "Int64"}))


def _files(place: str) -> list[Path]:
    folder = HERE / place if place in names() else Path(place)
    files = sorted(folder.glob("*.json"))
    if not files:
        raise InputError(
            f"--table: {place}: holds no entries; give a folder that cosim compete has written to, or one "
            f"of {', '.join(names())}"
        )
    return files


def _check(found: Mapping[Path, Entry]) -> None:
    """InputError for entries of different task sets, or of worlds that differ."""
    (first, one), *others = found.items()
    worlds = _worlds(one)
    for file, other in others:
        for what, here, there in (
            ("task set", one.task_set.name, other.task_set.name),
            ("hash", one.task_set.hash, other.task_set.hash),
        ):
            if here != there:
                raise InputError(
                    f"{file}: its {what} is {there}, but that of {first} is {here}: they cannot be "
                    "compared; put entries of each task set in a folder of their own"
                )
        theirs = _worlds(other)
        if different := [task for task in {**worlds, **theirs} if worlds.get(task) != theirs.get(task)]:
            raise InputError(
                f"{file}: {different[0]}: is another task there than in {first} ({theirs.get(different[0])}, not "
                f"{worlds.get(different[0])}): its scenario or network has changed; run one of them again"
            )


def _worlds(one: Entry) -> dict[str, tuple]:
    return {outcome.task: (outcome.world, outcome.seeds) for outcome in one.tasks}


def _row(name: str, file: Path, one: Entry, task: str, reference: Outcome | None) -> Row:
    outcome = one.outcome(task)
    assert outcome is not None  # `_check`
    means = {}
    for metric in METRICS:
        values = [run.metrics.get(metric) for run in outcome.runs]
        there = [value for value in values if value is not None]
        whole = len(there) == len(values) > 0
        means[metric] = (sum(there) if metric in SUMMED else fmean(there)) if whole else None
    return Row(
        name=name,
        place=file,
        task=task,
        rank=None,
        runs=len(outcome.runs),
        failed=len(outcome.failed),
        missing=len(outcome.missing),
        metrics=means,
        reasons=tuple(f"{task}, seed {failure.seed}: {failure.reason}" for failure in outcome.failed),
        worth=_worth(outcome, reference),
    )


def _worth(outcome: Outcome, reference: Outcome | None) -> float | None:
    """Against no control, whose runs are all there; None where there is none such, where a run is missing, or one took
    no time at all."""
    if reference is None or not outcome.complete:
        return None
    spent, without = ({run.seed: run.metrics.get(TTS) or 0.0 for run in one.runs} for one in (outcome, reference))
    if not all((*spent.values(), *without.values())):
        return None
    return math.exp(fmean(math.log(spent[seed] / without[seed]) for seed in outcome.seeds))


def _all(name: str, file: Path, rows: Sequence[Row]) -> Row:
    """All tasks together."""
    worths = [row.worth for row in rows if row.worth is not None]
    return Row(
        name=name,
        place=file,
        task=ALL,
        rank=None,
        runs=sum(row.runs for row in rows),
        failed=sum(row.failed for row in rows),
        missing=sum(row.missing for row in rows),
        metrics={metric: sum(row.metrics[metric] or 0.0 for row in rows) for metric in COUNTED},
        reasons=tuple(reason for row in rows for reason in row.reasons),
        worth=math.exp(fmean(map(math.log, worths))) if len(worths) == len(rows) else None,
    )


def _ranked(rows: Sequence[Row]) -> tuple[Row, ...]:
    """With ranks, the best first; who has none comes last. Equal to ten digits is equal."""
    worths = sorted(round(row.worth, 10) for row in rows if row.worth is not None)
    placed = [replace(row, rank=None if row.worth is None else 1 + worths.index(round(row.worth, 10))) for row in rows]
    return tuple(sorted(placed, key=lambda row: (row.rank is None, row.rank or 0, row.name)))
