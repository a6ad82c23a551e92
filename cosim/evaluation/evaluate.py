"""The evaluation: controllers x seeds x demand levels in SUMO, paired by seed, with tables.

<folder>/demand-<level>/    the run folder of a demand level (cosim.evaluation.experiment)
<folder>/evaluate.md, evaluate.csv, pairs.csv, runs.csv    the tables (statistics), new after every run; in the
    first,  at the end, why (explain)
what is drawn of a level lies in its folder, what is drawn across levels here (cosim.report.figures)
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from cosim.evaluation import experiment, explain, statistics
from cosim.evaluation.simulate import Task
from nmfd.api import load_scenario
from nmfd.errors import InputError, did_you_mean
from nmfd.runs import files
from nmfd.runs.workers import ended


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """scenario: its folder; controllers: strategies; levels: multiples of the scenario's demand; steps: control
    intervals, all if None; policies: controller -> file instead of the scenario's own; reference: a controller to
    pair with, besides no control; time_limit: of controllers of the user's own, instead of the scenario's; out: the
    folder of the evaluation."""

    scenario: Path
    controllers: tuple[str, ...]
    seeds: Sequence[int]
    out: Path
    levels: tuple[float, ...] = (1.0,)
    settings: tuple[tuple[str, object], ...] = ()
    steps: int | None = None
    policies: Mapping[str, Path] = field(default_factory=dict)
    time_limit: float | None = None
    reference: str | None = None

    def plan(self) -> list[tuple[Path, Task]]:
        """Every run with its run folder, seed by seed, so that whatever is finished compares like with like."""
        return [
            (
                experiment.level_folder(self.out, level),
                Task(
                    scenario=self.scenario,
                    settings=self.settings,
                    controller=name,
                    seed=seed,
                    policy=self.policies.get(name),
                    steps=self.steps,
                    demand_factor=level,
                    time_limit=self.time_limit,
                ),
            )
            for seed in self.seeds
            for level in self.levels
            for name in self.controllers
        ]


def evaluate(
    evaluation: Evaluation,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    tell: Callable[[str], None] | None = None,
) -> tuple[pd.DataFrame, list[str]]:
    """Run what is not there yet and write tables; returns `tables.statistics` and a line per failed run.

    The tables are of all runs in the folder. progress, tell: as in `experiment.perform`. Raises InputError.
    """
    out = evaluation.out
    check_folder(out)
    known = {*evaluation.controllers, *kept_runs(evaluation)["controller"]}
    if evaluation.reference is not None and evaluation.reference not in known:
        raise InputError(
            f"--reference: {evaluation.reference!r} is neither among --controllers nor in {out}"
            f"{did_you_mean(evaluation.reference, known)}; add it to them"
        )
    failures = experiment.perform(
        evaluation.plan(),
        workers=workers,
        fresh=True,
        progress=progress,
        tell=tell,
        kept=lambda: statistics.write_tables(out, kept_runs(evaluation), None),
    )
    rows, table = kept_runs(evaluation), pd.DataFrame()
    if len(rows):
        table = statistics.write_tables(out, rows, evaluation.reference)
        scenario = load_scenario(evaluation.scenario, dict(evaluation.settings))
        why = explain.text(level_folders(out), scenario.network, kept_runs(evaluation))
        remarks = "".join(f"- {line}\n" for line in experiment.remarks(rows))
        files.write_text(
            out / "evaluate.md",
            "\n".join(filter(None, (statistics.markdown(table, evaluation.reference), remarks, why))),
        )
    if failures and table.empty and all(failure.mistake for _, failure in failures):
        raise ended([(experiment.label(task), failure) for task, failure in failures[:1]])
    return table, [f"{experiment.label(task)}: {failure.reason}" for task, failure in failures]


def check_folder(out: Path) -> None:
    """InputError for a folder that is a run folder itself, instead of holding one for each demand level."""
    if (out / "manifest.json").is_file():
        raise InputError(f"{out}: is the folder of another command; choose another folder with --out")


def level_folders(out: Path) -> dict[float, Path]:
    """Demand level -> its run folder, those in `out` that hold finished runs."""
    found = {}
    for path in out.glob("demand-*/summary.csv"):
        if re.fullmatch(r"demand-[\d.e+-]+", path.parent.name) and (path.parent / "sumo.csv").is_file():
            found[float(path.parent.name.removeprefix("demand-"))] = path.parent
    return dict(sorted(found.items()))


def kept_runs(evaluation: Evaluation) -> pd.DataFrame:
    """`experiment.overview` of every demand level, with a column demand; controllers in the order asked for."""
    parts = []
    for level, folder in level_folders(evaluation.out).items():
        rows = experiment.overview(folder)
        rows.insert(0, "demand", level)
        parts.append(rows)
    return _ordered(
        evaluation,
        pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=["demand", "controller", "seed"]),
    )


def _ordered(evaluation: Evaluation, rows: pd.DataFrame) -> pd.DataFrame:
    names = list(dict.fromkeys([*evaluation.controllers, *rows["controller"]]))
    return rows.sort_values(
        ["demand", "controller", "seed"],
        ignore_index=True,
        key=lambda column: column.map(names.index) if column.name == "controller" else column,
    )
