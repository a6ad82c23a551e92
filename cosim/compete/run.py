"""Controllers x tasks: run what is not there yet, and write an entry for each controller.

    <folder>/<controller>.json    its entry (cosim.compete.entry), new after every run in SUMO and every regional task
    <folder>/<task>/              the run folder of a task, of all controllers: nmfd.runs.run_folder

Runs are made and kept by nmfd.studies.benchmark and cosim.evaluation.experiment. What is wrong with one controller ends
up in its own entry; the others go on. An entry that is there counts without the run folders, too, as long as the task
and all that the controller depends on are what they were: so entries grow over sessions and machines.
"""

import json
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path

from cosim.compete import entry, metrics
from cosim.compete.entry import Entry, Failure, Outcome, Run, TaskSetName
from cosim.compete.task_set import SUMO, Loaded, TaskTable, noise_of, world
from cosim.evaluation import dask_cluster, experiment
from cosim.evaluation.simulate import Task
from cosim.plant.settings import FIXED, SIGNALS
from cosim.plant.strategy import ALONE, parse
from nmfd.controllers import registry
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs import run_folder, shipped
from nmfd.runs.files import locked
from nmfd.runs.provenance import provenance
from nmfd.runs.workers import Source
from nmfd.studies import benchmark
from nmfd.studies.benchmark import happening

Tell = Callable[[str], None]
Progress = Callable[[int, int, str], None]
Key = tuple[str, str, int]  # controller, task, seed


@dataclass(frozen=True, kw_only=True)
class Order:
    """task_set; controllers: strategies; only: patterns of tasks, all if none; out: the folder."""

    task_set: Loaded
    controllers: tuple[str, ...]
    out: Path
    only: tuple[str, ...] = ()

    def chosen(self) -> list[TaskTable]:
        """The tasks that are to be run. InputError for a pattern without a match."""
        tasks = self.task_set.tasks.tasks
        for pattern in self.only:
            if not any(fnmatchcase(task.id, pattern) for task in tasks):
                raise InputError(f"--only: no task matches {pattern!r}; there are {', '.join(t.id for t in tasks)}")
        return [task for task in tasks if not self.only or any(fnmatchcase(task.id, p) for p in self.only)]


def strategy(controller: str, task: TaskTable) -> str:
    """What is run for an entry in a task: on a regional model its controller alone, for there are no signals and no
    drivers; where signals are part of the plant, with these instead of its own."""
    if task.plant != SUMO:
        return parse(controller).controller
    if task.signals == FIXED:
        return controller
    first, options = registry.split(controller)
    return "+".join([*(word for word in (first, *options) if word not in (*SIGNALS, ALONE)), task.signals])


def compete(
    order: Order,
    *,
    workers: int = 1,
    scheduler: dask_cluster.Scheduler | None = None,
    progress: Progress | None = None,
    tell: Tell | None = None,
) -> list[Entry]:
    """Run what is not there yet of the chosen tasks; returns the entries, which are in the folder.

    Failed runs are tried again. scheduler: of a Dask cluster, which does the runs instead of `workers` processes
    here. Raises InputError for what concerns every controller: a task that is not as it was released, a
    folder of another task set.
    """
    tasks = order.chosen()
    scenarios = {task.id: order.task_set.scenario(task) for task in order.task_set.tasks.tasks}
    worlds = {task.id: world(task, scenarios[task.id]) for task in order.task_set.tasks.tasks}
    for task in tasks:
        order.task_set.check_world(task, worlds[task.id])
    source = dask_cluster.source(scheduler, tell)
    order.out.mkdir(parents=True, exist_ok=True)
    with locked(order.out / run_folder.LOCK, order.out):
        books = _Books(order, scenarios, worlds)
        for task in tasks:
            if task.plant != SUMO:
                _regional(books, task, workers=workers, progress=progress, tell=tell, source=source)
        _in_sumo(
            books,
            [task for task in tasks if task.plant == SUMO],
            workers=workers,
            progress=progress,
            tell=tell,
            source=source,
        )
        return books.write()


@dataclass
class _Books:
    """What is known of the runs of an order; failed: why, of those that failed and were not made since."""

    order: Order
    scenarios: Mapping[str, Scenario]
    worlds: Mapping[str, str]
    failed: dict[Key, str] = field(default_factory=dict)
    _depends: dict[tuple[str, str], dict] = field(default_factory=dict)
    _held: dict[tuple[str, str], frozenset[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._session = provenance()
        self._before = {name: self._old(name) for name in self.order.controllers}
        self._source = {name: _source(name) for name in self.order.controllers}
        for name, old in self._before.items():
            for outcome in old.tasks if old else ():
                self.failed |= {(name, outcome.task, one.seed): one.reason for one in outcome.failed}
        self._there = self._rows()
        self.write()

    def _rows(self) -> dict[str, dict[tuple[str, int], dict]]:
        """Task -> (strategy, seed) -> row, of the finished runs."""
        return {task.id: _rows(self.order.out / task.id, task) for task in self.order.task_set.tasks.tasks}

    def _old(self, name: str) -> Entry | None:
        """The entry that is there. InputError for one in another task set."""
        file = entry.path(self.order.out, name)
        if not file.is_file():
            return None
        found, now = entry.read(file), self.order.task_set
        if (found.task_set.name, found.task_set.hash) != (now.tasks.name, now.hash):
            raise InputError(
                f"{file}: is an entry in {found.task_set.name} ({found.task_set.hash}), not in {now.tasks.name} "
                f"({now.hash}); choose another folder with --out"
            )
        return found

    def fail(self, name: str, task: TaskTable, reason: str, seeds: Sequence[int]) -> None:
        """Book runs that failed; where this package lies is nobody's business."""
        told = reason.replace(f"{shipped.root()}{os.sep}", "")
        self.failed |= {(name, task.id, seed): told for seed in seeds}

    def depends(self, name: str, task: TaskTable) -> dict:
        """What the runs of a controller in a task depend on now. InputError for one that cannot be made."""
        if (key := (name, task.id)) not in self._depends:
            called, scenario = strategy(name, task), self.scenarios[task.id]
            if task.plant == SUMO:
                _, found = experiment.shared_configuration([_task(self, task, name, task.seeds[0])])
            else:
                registry.verify(called, scenario)
                _, found = benchmark.configuration(scenario, [called], task.plant, {})
            self._depends[key] = json.loads(json.dumps(found[called]))
        return self._depends[key]

    def held(self, name: str, task: TaskTable) -> frozenset[int]:
        """Seeds of runs that the entry has from before, and that are not in the run folder."""
        if (key := (name, task.id)) not in self._held:
            self._held[key] = self._still_good(name, task)
        return self._held[key]

    def _still_good(self, name: str, task: TaskTable) -> frozenset[int]:
        before = self._before[name]
        old = before.outcome(task.id) if before else None
        if old is None or not old.runs or old.world != self.worlds[task.id]:
            return frozenset()
        try:
            if old.depends_on != self.depends(name, task):
                return frozenset()
        except InputError:
            return frozenset()
        there = self._there[task.id]
        return frozenset(run.seed for run in old.runs if (strategy(name, task), run.seed) not in there)

    def begin(self, name: str, task: TaskTable) -> None:
        """Failed runs are tried again."""
        for seed in task.seeds:
            self.failed.pop((name, task.id, seed), None)

    def write(self) -> list[Entry]:
        """The entries, in the folder."""
        found, rows = [], self._rows()
        for name in self.order.controllers:
            made = self._entry(name, rows)
            entry.write(entry.path(self.order.out, name), made)
            self._before[name] = made
            found.append(made)
        return found

    def _entry(self, name: str, rows: Mapping[str, Mapping[tuple[str, int], dict]]) -> Entry:
        loaded, before = self.order.task_set, self._before[name]
        sessions = [*(before.sessions if before else ())]
        if self._session not in sessions:
            sessions.append(self._session)
        now = sessions.index(self._session)
        tasks = tuple(self._outcome(name, task, rows[task.id], now) for task in loaded.tasks.tasks)
        used = sorted({run.session for outcome in tasks for run in outcome.runs if run.session is not None})
        tasks = tuple(
            outcome.changed(
                runs=tuple(
                    run if run.session is None else run.changed(session=used.index(run.session)) for run in outcome.runs
                )
            )
            for outcome in tasks
        )
        return Entry(
            controller=name,
            command=shlex.join(["cosim", "compete", name, "--tasks", loaded.named]),
            task_set=TaskSetName(
                name=loaded.tasks.name, named=loaded.named, hash=loaded.hash, released=loaded.worlds is not None
            ),
            sessions=tuple(sessions[number] for number in used),
            tasks=tasks,
            metrics=entry.about_metrics(),
            missing=tuple(outcome.task for outcome in tasks if not outcome.complete),
        )

    def _outcome(self, name: str, task: TaskTable, rows: Mapping[tuple[str, int], dict], session: int) -> Outcome:
        """Of one task, by the rows of its run folder."""
        folder, scenario, called = self.order.out / task.id, self.scenarios[task.id], strategy(name, task)
        before, depends = self._before[name], _depends(folder, called)
        old = before.outcome(task.id) if before else None
        if any(depends.get(key) != value for key, value in self._source[name].items()):
            rows = {}  # of the file as it was before
        held = self.held(name, task)
        if held and not depends:  # it has no run folder
            depends = self.depends(name, task)
        known = {run.seed: run for run in old.runs} if old and old.depends_on == depends else {}
        runs, failed = [], []
        for seed in task.seeds:
            row, kept = rows.get((called, seed)), known.get(seed)
            if row is None and kept is not None and seed in held:
                runs.append(kept)
            elif row is None:
                if (reason := self.failed.get((name, task.id, seed))) is not None:
                    failed.append(Failure(seed=seed, reason=reason))
            elif (longest := row["control_step_ms_max"] / 1e3) > task.time_limit:
                failed.append(
                    Failure(
                        seed=seed,
                        reason=(f"a decision took {longest:.3g} s, longer than the {task.time_limit:g} s of the task"),
                    )
                )
            elif kept is not None and kept.metrics[metrics.TTS] == row[metrics.TTS]:
                runs.append(kept)
            else:
                here = self._there[task.id].get((called, seed), {}).get("evaluation_time_s")
                runs.append(
                    Run(
                        seed=seed,
                        session=None if here == row["evaluation_time_s"] else session,
                        metrics=_metrics(task, scenario, row, folder),
                    )
                )
        ended = {*(one.seed for one in runs), *(one.seed for one in failed)}
        return Outcome(
            task=task.id,
            text=task.text,
            strategy=called,
            plant=task.plant,
            scenario=scenario.name,
            scenario_hash=scenario.hash,
            network=scenario.network.name,
            network_hash=scenario.network.hash,
            world=self.worlds[task.id],
            demand=task.demand,
            time_limit=task.time_limit,
            depends_on=depends,
            seeds=task.seeds,
            runs=tuple(runs),
            failed=tuple(failed),
            missing=tuple(seed for seed in task.seeds if seed not in ended),
        )


def _regional(
    books: _Books, task: TaskTable, *, workers: int, progress: Progress | None, tell: Tell | None, source: Source | None
) -> None:
    """The runs of all controllers on a regional model."""
    entrants: dict[str, list[str]] = {}
    for name in _able(books, task):
        entrants.setdefault(strategy(name, task), []).append(name)  # two entries may come to the same
    if not entrants:
        books.write()
        return
    try:
        _, failures = benchmark.perform(
            books.scenarios[task.id],
            list(entrants),
            task.seeds,
            task.plant,
            out=books.order.out / task.id,
            noise=noise_of(task),
            workers=workers,
            progress=progress,
            renew=tell or _silent,
            source=source,
            omit={(called, seed) for called, names in entrants.items() for seed in books.held(names[0], task)},
        )
        for (called, seed), failure in failures:
            for name in entrants[called]:
                books.fail(name, task, failure.reason, [seed])
    except InputError as error:
        for name in chain.from_iterable(entrants.values()):
            books.fail(name, task, str(error), task.seeds)
    finally:
        books.write()


def _in_sumo(
    books: _Books,
    tasks: Sequence[TaskTable],
    *,
    workers: int,
    progress: Progress | None,
    tell: Tell | None,
    source: Source | None,
) -> None:
    """The runs in SUMO of all controllers, seed by seed."""
    entrants: dict[Task, list[tuple[str, TaskTable]]] = {}
    plan: list[tuple[Path, Task]] = []
    for task in tasks:
        able = _able(books, task)
        for seed in task.seeds:
            for name in able:
                if seed in books.held(name, task):
                    continue
                one = _task(books, task, name, seed)
                if one not in entrants:  # two entries may come to the same
                    plan.append((books.order.out / task.id, one))
                entrants.setdefault(one, []).append((name, task))

    def failed(one: Task, reason: str) -> None:
        for name, task in entrants[one]:
            books.fail(name, task, reason, [one.seed])
        books.write()

    experiment.perform(
        plan,
        workers=workers,
        fresh=True,
        progress=progress,
        tell=tell or _silent,
        kept=books.write,
        failed=failed,
        source=source,
    )


def _able(books: _Books, task: TaskTable) -> list[str]:
    """The controllers that can be made for a task; the others have failed in it."""
    found = []
    for name in books.order.controllers:
        books.begin(name, task)
        try:
            books.depends(name, task)
            found.append(name)
        except InputError as error:
            books.fail(name, task, str(error), task.seeds)
    return found


def _task(books: _Books, task: TaskTable, name: str, seed: int) -> Task:
    return Task(
        scenario=books.order.task_set.folder(task),
        controller=strategy(name, task),
        seed=seed,
        steps=task.steps,
        demand_factor=task.demand,
        time_limit=task.time_limit,
    )


def _rows(folder: Path, task: TaskTable) -> dict[tuple[str, int], dict]:
    """(strategy, seed) -> row, of the finished runs of a task."""
    if not (folder / "summary.csv").is_file():
        return {}
    if task.plant == SUMO:
        rows = experiment.overview(folder).to_dict("records")
    else:
        rows = run_folder.read_summary(folder / "summary.csv")
    return {(row["controller"], row["seed"]): row for row in rows}


def _source(name: str) -> dict:
    """Fingerprints of the files of a controller of one's own, the same in every task: an entry is of one version."""
    first = parse(name).controller
    if not registry.is_own(first):
        return {}
    try:
        return registry.fingerprint(first, None)
    except InputError:  # it fails wherever it is run
        return {"source_hash": None}


def _depends(folder: Path, called: str) -> dict:
    """What its runs depend on, as its run folder has it."""
    if not (folder / "manifest.json").is_file():
        return {}
    return run_folder.read_manifest(folder / "manifest.json")["controllers"].get(called, {})


def _metrics(task: TaskTable, scenario: Scenario, row: Mapping, folder: Path) -> metrics.Metrics:
    if task.plant == SUMO:
        return metrics.of_city(row, scenario.step * scenario.steps)
    trajectory = run_folder.read_trajectory(run_folder.run_path(folder, row["controller"], row["seed"]))
    actual = happening(scenario, noise_of(task), row["seed"])
    return metrics.of_region(row, actual, trajectory, task.plant == "acyclic")


def _silent(line: str) -> None:
    pass
