"""A row of a published table, or of a run folder, made again from what is written beside it, and compared.

    manifest.json with summary.csv      runs on a regional model (nmfd benchmark), or in SUMO (cosim run)
    demand-<level>/                     such folders of an evaluation
    manifest.json with robustness.csv   nmfd robustness
    *.json                              entries of cosim compete
    runs.csv                            of an evaluation whose run folders are not there: by the commands in its trail

Figures are compared to the last digit, and a run that is kept to the byte; where version or commit is another one, or
not known, figures within ROUNDING, unless another share is asked for. Wall times and empty cells are not compared.
"""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

from cosim.compete import entry, run, task_set
from cosim.compete.asked import Asked
from cosim.compete.entry import Entry
from cosim.evaluation import evaluate, experiment, results
from cosim.evaluation.earlier import KEYS
from cosim.evaluation.simulate import Task
from nmfd.api import load_scenario
from nmfd.controllers import registry
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario, with_demand
from nmfd.runs import run_folder, trail
from nmfd.runs.files import check_file, file_hash
from nmfd.runs.provenance import provenance
from nmfd.runs.scratch import Scratch
from nmfd.studies import benchmark, robustness

Figures = Mapping[str, object]
ROUNDING = 1e-9  # as a share: what sums in another order may come to
CLOCK = (  # columns and metrics that are wall times, or depend on them
    "evaluation_time_s",
    "control_step_ms_median",
    "control_step_ms_max",
    "late_decisions",
    "wall_time_s",
    "sumo_time_s",
    "overhead_share",
    "setup_time_s",
    "decision_ms_median",
    "decision_ms_max",
    "notes",
)


@dataclass(frozen=True, kw_only=True)
class Row:
    """label: what tells it from the others; figures: as published; depends: what they depended on, versions and commit
    among it; file: the kept run, None without; again: makes it anew in a folder: figures, depends, file."""

    label: str
    figures: Figures
    depends: Figures
    file: Path | None
    again: Callable[[Path], tuple[Figures, Figures, Path | None]]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """differ: figure -> as published, as made again, of those that are further apart than `within`; depends: the same
    of what they depend on; same_bytes: of the runs' files, None without one; compared: how many figures, equal: how
    many of them are the same to the last digit."""

    label: str
    compared: int
    equal: int
    within: float
    differ: Mapping[str, tuple[object, object]]
    depends: Mapping[str, tuple[object, object]]
    same_bytes: bool | None

    @property
    def good(self) -> bool:
        """Whether it came out the same, as far as the versions are."""
        return not self.differ and (self.same_bytes is not False or self.another)

    @property
    def exact(self) -> bool:
        """Whether every figure is the same to the last digit."""
        return self.equal == self.compared

    @property
    def another(self) -> bool:
        """Whether it was made by another version, or one that is not known."""
        return any(not key.endswith("_hash") for key in self.depends)


def rows(folder: Path, scenario: Path | None = None) -> list[Row]:
    """All that can be made again. scenario: where it is now, if not where the folder says. InputError for a folder that
    does not say how, and for a scenario that is none."""
    given = None if scenario is None else load_scenario(scenario)
    if levels := evaluate.level_folders(folder):
        return [
            replace(row, label=f"{level:g},{row.label}") for level, at in levels.items() for row in rows(at, scenario)
        ]
    if (folder / "manifest.json").is_file():
        manifest = run_folder.read_manifest(folder / "manifest.json")
        at = scenario or results.scenario_folder(folder, manifest)
        loaded = given or load_scenario(at)
        if (folder / "robustness.csv").is_file():
            return _of_robustness(folder, manifest, loaded)
        if (folder / "summary.csv").is_file():
            return (
                _in_sumo(folder, manifest, loaded, at)
                if manifest["configuration"].get("plant") == "sumo"
                else (_regional(folder, manifest, loaded))
            )
    if files := sorted(file for file in folder.glob("*.json") if file.name != "manifest.json"):
        return [row for file in files for row in _of_entry(entry.read(file))]
    if (folder / "runs.csv").is_file():
        return _of_table(folder / "runs.csv", scenario)
    raise InputError(
        f"{folder}: does not say how its rows were made; give a folder with manifest.json and summary.csv or "
        "robustness.csv, one of an evaluation, or one of entries"
    )


def fitting(found: Sequence[Row], pattern: str | None) -> list[Row]:
    """Those whose label matches. InputError for none."""
    matching = [row for row in found if pattern is None or fnmatchcase(row.label, pattern)]
    if not matching:
        raise InputError(
            f"--row: no row matches {pattern!r}; there are {', '.join(row.label for row in found[:20])}"
            + (" ..." if len(found) > 20 else "")
        )
    return matching


def verify(row: Row, within: float | None = None) -> Verdict:
    """Make it again, in a scratch folder. within: by which share figures may differ; None: none, or ROUNDING in another
    version. InputError or RunFailed where that fails."""
    with Scratch("cosim-verify-") as scratch:
        figures, depends, file = row.again(Path(scratch) / "again")
        same = None if row.file is None or file is None else row.file.read_bytes() == file.read_bytes()
    keys = [key for key, value in row.figures.items() if key not in CLOCK and key in figures and not _empty(value)]
    verdict = Verdict(
        label=row.label,
        compared=len(keys),
        same_bytes=same,
        differ={},
        within=0.0,
        equal=sum(_same(row.figures[key], figures[key], 0.0) for key in keys),
        depends={
            key: (row.depends.get(key), depends.get(key))
            for key in {**row.depends, **depends}
            if row.depends.get(key) != depends.get(key)
        },
    )
    share = (ROUNDING if verdict.another else 0.0) if within is None else within
    return replace(
        verdict,
        within=share,
        differ={
            key: (row.figures[key], figures[key]) for key in keys if not _same(row.figures[key], figures[key], share)
        },
    )


def _empty(value: object) -> bool:
    """Not known, in a table of a version that did not record it."""
    return isinstance(value, float) and math.isnan(value)


def _same(a: object, b: object, within: float) -> bool:
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        return math.isclose(a, b, rel_tol=within)
    return a == b


def _of_run(folder: Path, manifest: Mapping, published: Mapping, make: Callable[[Path], Figures]) -> Row:
    """Of a run folder. make: makes the run in another one, and gives its row there."""
    name, seed = published["controller"], published["seed"]

    def again(out: Path) -> tuple[Figures, Figures, Path | None]:
        made = make(out)
        return made, _depends(run_folder.read_manifest(out / "manifest.json"), name), _kept(out, name, seed)

    return Row(
        label=f"{name},{seed}",
        figures=published,
        depends=_depends(manifest, name, seed),
        file=_kept(folder, name, seed),
        again=again,
    )


def _regional(folder: Path, manifest: Mapping, scenario: Scenario) -> list[Row]:
    """Of nmfd benchmark."""
    plant, noise = manifest["configuration"]["plant"], manifest["configuration"].get("demand_noise")
    scenario = with_demand(scenario, steps=manifest["configuration"]["steps"])

    def make(name: str, seed: int, out: Path) -> Figures:
        policy = _policy(scenario, manifest, name)
        made, failures = benchmark.perform(
            scenario,
            [name],
            [seed],
            plant,
            out=out,
            noise=benchmark.Noise(**noise) if noise else None,
            policies={name: policy} if policy else None,
        )
        if failures:
            raise InputError(f"{name}, seed {seed}: {failures[0][1].reason}")
        return made[0]

    return [
        _of_run(folder, manifest, published, partial(make, published["controller"], published["seed"]))
        for published in _read(folder / "summary.csv", run_folder.COLUMNS, str)
    ]


def _value(text: str) -> object:
    """A number exactly as it is written, which pandas does not promise; NaN of an empty cell."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text or "nan")
    return text


def _read(file: Path, columns: Mapping[str, Callable], others: Callable) -> list[dict]:
    """The rows of a table, with the columns that the version had which wrote it. InputError."""
    check_file(file)
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            return [
                {name: columns.get(name, others)(value) for name, value in row.items() if name != trail.COLUMN}
                for row in csv.DictReader(stream)
            ]
    except (OSError, ValueError, TypeError, csv.Error) as error:
        raise InputError(f"{file}: is no table of runs ({error}); give a folder that holds one") from None


def _in_sumo(folder: Path, manifest: Mapping, scenario: Scenario, at: Path) -> list[Row]:
    """Of cosim run, or a level of cosim evaluate. at: the folder of the scenario"""
    about = manifest["configuration"]
    faults = tuple(fault for fault in about.get("faults", ()) if fault not in scenario.faults)

    def make(name: str, seed: int, out: Path) -> Figures:
        return _simulated(
            Task(
                scenario=at,
                controller=name,
                seed=seed,
                steps=about["steps"],
                demand_factor=about["demand_factor"],
                faults=faults,
                policy=_policy(scenario, manifest, name),
            ),
            out,
        )

    return [
        _of_run(folder, manifest, published, partial(make, published["controller"], published["seed"]))
        for published in experiment.overview(folder).to_dict("records")
    ]


def _policy(scenario: Scenario, manifest: Mapping, name: str) -> Path | None:
    """The file that it was run with, which may have been given with --policy: of those in the scenario's folder and in
    the one above it, that with the fingerprint in the manifest. None without a policy, and where that is gone."""
    wanted, at = manifest["controllers"].get(name, {}).get("policy_hash"), scenario.folder
    if wanted is None or at is None:
        return None
    files = (
        file
        for folder in (at, at.parent)
        for kind in (registry.POLICY, registry.PLAN)
        for file in sorted(folder.glob(f"*.{kind.suffix}"))
    )
    return next((file for file in files if file_hash(file) == wanted), None)


def _simulated(task: Task, out: Path) -> Figures:
    """Its row."""
    if failures := experiment.perform([(out, task)], fresh=True):
        raise InputError(f"{experiment.label(task)}: {failures[0][1].reason}")
    return experiment.overview(out).to_dict("records")[0]


def _of_table(file: Path, scenario: Path | None) -> list[Row]:
    """Of cosim evaluate, by the commands that its trail names; rows that none of them asked for cannot be made."""
    found = trail.read(file)
    refused = found.get("not_again", {})  # patterns of controllers, and why
    there = [order for one in trail.commands(found) if (order := Asked.by(*one, file, scenario))]

    def row(published: Mapping, asked: Asked) -> Row:
        place = f"demand-{published['demand']:g}"
        task = asked.task(published["controller"], published["seed"], published["demand"])
        depends = {**_of_session(asked.session), **_hashes(found, place, task.controller)}

        def again(out: Path) -> tuple[Figures, Figures, Path | None]:
            made, now = _simulated(task, out), trail.of(out / file.name)
            now = {**_of_session(now), **_hashes(now, ".", task.controller)}
            return made, {key: now.get(key) for key in depends}, None

        return Row(
            label=f"{published['demand']:g},{task.controller},{task.seed}",
            figures=published,
            file=None,
            depends=depends,
            again=again,
        )

    records = _read(file, KEYS, _value)
    if not all(KEYS.keys() <= one.keys() for one in records):
        raise InputError(f"{file}: is no table of runs (expected {', '.join(KEYS)}); give a folder that holds one")
    asked = [(one, next((each for each in there if each.covers(one)), None)) for one in records]
    why = [reason for one, _ in asked for name, reason in refused.items() if fnmatchcase(one["controller"], name)]
    if rows := [
        row(one, by) for one, by in asked if by and not any(fnmatchcase(one["controller"], name) for name in refused)
    ]:
        return rows
    if why:
        raise InputError(f"{file}: cannot be made again: {why[0]}")
    raise InputError(
        f"{file}: names no command (cosim evaluate) that asked for its rows; give a folder with the "
        "run folders of the evaluation, demand-*"
    )


def _hashes(found: Mapping, place: str, controller: str) -> dict:
    """Of a trail: those of a run folder, and of a controller in it."""
    there = found.get("hashes", {}).get(place, {})
    return {**{key: value for key, value in there.items() if isinstance(value, str)}, **there.get(controller, {})}


def _of_robustness(folder: Path, manifest: Mapping, scenario: Scenario) -> list[Row]:
    """Of nmfd robustness."""
    plant, where = manifest["configuration"]["plant"], manifest["configuration"]["where"]

    def row(published: Mapping) -> Row:
        one = robustness.Run(published["sigma_veh_per_s"], published["scenario"], published["controller"])

        def again(out: Path) -> tuple[Figures, Figures, Path | None]:
            made = robustness.run_one(one, scenario=scenario, plant=plant, where=where, policies={})
            common, settings = benchmark.configuration(scenario, [one.controller], plant, {})
            now = {"configuration": {**common, "where": where}, "controllers": settings, "sessions": [provenance()]}
            return made, _depends(now, one.controller), None

        return Row(
            label=f"{one.sigma:g},{one.scenario},{one.controller}",
            figures=published,
            file=None,
            depends=_depends(manifest, one.controller),
            again=again,
        )

    return [row(published) for published in robustness.read(folder / "robustness.csv")]


def _of_entry(one: Entry) -> list[Row]:
    """Of cosim compete."""
    loaded = task_set.read(one.task_set.named)
    if loaded.hash != one.task_set.hash:
        raise InputError(
            f"{one.controller}: is an entry in {one.task_set.name} {one.task_set.hash}, but that is "
            f"{loaded.hash} here; verify it with the version of that release"
        )
    tasks = {task.id: task for task in loaded.tasks.tasks}

    def row(outcome: entry.Outcome, kept: entry.Run) -> Row:
        alone = tasks[outcome.task].changed(seeds=(kept.seed,))
        order = run.Order(
            task_set=replace(loaded, worlds=None, tasks=loaded.tasks.changed(tasks=(alone,))),
            controllers=(one.controller,),
            out=Path(),
        )

        def again(out: Path) -> tuple[Figures, Figures, Path | None]:
            made = run.compete(replace(order, out=out))[0]
            found = made.tasks[0]
            if found.failed:
                raise InputError(f"{one.controller}, {outcome.task}: {found.failed[0].reason}")
            return found.runs[0].metrics, _of_outcome(found, made.sessions[0]), None

        session = {} if kept.session is None else one.sessions[kept.session]
        return Row(
            label=f"{one.controller},{outcome.task},{kept.seed}",
            figures=kept.metrics,
            file=None,
            depends=_of_outcome(outcome, session),
            again=again,
        )

    return [row(outcome, kept) for outcome in one.tasks for kept in outcome.runs]


def _of_outcome(outcome: entry.Outcome, session: Mapping) -> Figures:
    about = {key: getattr(outcome, key) for key in ("scenario_hash", "network_hash", "strategy")}
    return {**about, **outcome.depends_on, **_of_session(session)}


def _depends(manifest: Mapping, name: str, seed: int | None = None) -> Figures:
    """What a row depended on; seed: of the last session that asked for it."""
    sessions = [one for one in manifest["sessions"] if seed is None or seed in one.get("seeds", ())]
    return {
        **manifest["configuration"],
        **manifest["controllers"].get(name, {}),
        **_of_session((sessions or manifest["sessions"])[-1]),
    }


def _of_session(session: Mapping) -> Figures:
    versions = session.get("versions", {})
    if not isinstance(versions, Mapping):  # unknown
        versions = dict.fromkeys(provenance()["versions"], versions)
    return {**versions, "commit": session.get("commit"), "uncommitted changes": session.get("dirty")}


def _kept(folder: Path, name: str, seed: int) -> Path | None:
    file = run_folder.run_path(folder, name, seed)
    return file if file.is_file() else None
