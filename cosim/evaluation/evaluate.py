"""Evaluation: controllers x seeds x demand levels of one or several scenarios in SUMO, in one
ranked table.

    <out>/[<scenario>/]demand-<level>/   results of the runs
    <out>/runs.csv, manifest.json        one row per run; commands, commits, versions, seeds and hashes (run_many)
    <out>/evaluate.md                    tables paired by seed, and why; of several scenarios the ranking first

A suite is a TOML file: `seeds = [2000, 2001]` and a table [scenarios] of demand levels, `grid7_peak
= [0.8, 1.0]`.
"""

import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import pandas as pd
from pydantic import Field

from cosim.evaluation import explain, results, statistics
from cosim.evaluation.runs import city_key, runs_of
from cosim.plant.strategy import Strategy
from nmfd.api import load_scenario
from nmfd.model.scenario import Scenario
from nmfd.runs import config, files
from nmfd.runs.frame import Table
from nmfd.runs.run_many import TABLE, Run, read_manifest, run_many
from nmfd.runs.tables import markdown_table
from nmfd.types import HOST_TIMES

Planned: TypeAlias = list[tuple[Scenario, Sequence[float]]]  # with demand levels


class Suite(config.Settings):
    """Content of a suite: seeds, and scenario -> demand levels."""

    seeds: Annotated[list[int], Field(min_length=1)]
    scenarios: dict[
        str, Annotated[list[Annotated[float, Field(gt=0.0, le=10.0)]], Field(min_length=1)]
    ]


def read_suite(
    file: Path, settings: Mapping[str, Any] | None = None
) -> tuple[Planned, Sequence[int]]:
    """Read the scenarios with their demand levels, and the seeds, of a suite.

    Scenarios are shipped names, or folders seen from that of the file. Raises InputError.
    """
    suite = config.checked(Suite, config.read(file), file)
    beside = {name: file.parent / name for name in suite.scenarios}
    folders = {
        name: path if (path / "scenario.toml").is_file() else Path(name)
        for name, path in beside.items()
    }
    scenarios: Planned = []
    for name, levels in suite.scenarios.items():
        scenarios.append((load_scenario(folders[name], settings), levels))
    return scenarios, suite.seeds


def evaluate(runs: Sequence[Run], out: Path, **how: Any) -> Table:
    """Do the runs that are not in `out`, write the tables, and return one row per run; how: see
    nmfd.runs.run_many."""
    rows = run_many(runs, out, **how)
    if len(done := results.finished_rows(rows)):
        files.write_text(out / "evaluate.md", report(out, done))
    return rows


def plan(
    scenarios: Planned,
    strategies: Sequence[Strategy],
    seeds: Sequence[int],
    policies: Mapping[str, Path] | None = None,
) -> list[Run]:
    """Return all runs of an evaluation, seed by seed; policies: strategy name -> file instead of
    the scenario's."""
    runs = []
    for scenario, levels in scenarios:
        city = city_key(scenario, strategies)
        above = f"{files.file_name(scenario.name)}/" if len(scenarios) > 1 else ""
        for level in levels:
            folder = f"{above}demand-{level:g}"
            runs += runs_of(
                scenario,
                strategies,
                seeds,
                city=city,
                demand=level,
                policies=policies,
                folder=folder,
            )
    return sorted(runs, key=lambda run: seeds.index(int(run.name.rpartition("-")[2])))


def report(out: Path, rows: pd.DataFrame) -> str:
    """Return evaluate.md for the finished runs."""
    names = list(dict.fromkeys(rows["scenario"]))
    parts = [] if len(names) == 1 else [statistics.ranking(rows)]
    for name in names:
        finished = results.read(out, name)
        parts += [f"# {name}"] if len(names) > 1 else []
        parts += [
            statistics.markdown(finished.rows),
            *(explain.text(level, finished) for level in finished.levels),
        ]
    return "\n\n".join(parts)


def ranking(rows: pd.DataFrame) -> str:
    """Return controllers by their mean change of TTS over scenarios and demand levels, as
    markdown."""
    changes: dict[str, list[float]] = {}
    for _, part in rows.groupby("scenario", sort=False):
        for row in statistics.statistics(part).to_dict("records"):
            same = row["controller"] == row["against"]
            changes.setdefault(row["controller"], []).append(0.0 if same else row["change_percent"])
    order = sorted(changes.items(), key=lambda item: float(np.mean(item[1])))
    table = [
        [place, name, f"{np.mean(each):+.1f} %", len(each)]
        for place, (name, each) in enumerate(order, 1)
    ]
    return markdown_table(
        ["rank", "controller", "mean change of TTS", "scenarios and demand levels"], table
    )


def check(runs: Sequence[Run], out: Path, number: int, *, workers: int = 1) -> list[str]:
    """Do `number` runs of a table again, by a fixed draw, and return a line per difference.

    out: folder with runs.csv and manifest.json, with or without the results
    """
    kept = results.finished_rows(pd.read_csv(out / TABLE)).to_dict("records")
    rows = {(row["folder"], row["controller"], row["seed"]): row for row in kept}
    keys = {name: folder["key"] for name, folder in read_manifest(out)["folders"].items()}
    chosen = random.Random(0).sample(list(runs), min(number, len(runs)))
    lines = [
        f"{run.file}: {name} was {keys.get(run.folder, {}).get(name)}, is {value}"
        for run in chosen
        for name, value in run.key.items()
        if name != "controller" and keys.get(run.folder, {}).get(name) != value
    ]
    with files.temporary_folder() as folder:
        run_many(chosen, folder, workers=workers)
        again = pd.read_csv(folder / TABLE)  # as the kept table went through a file
    own = {*HOST_TIMES, "evaluation_time_s", "wall_time_s"}.union(
        name for name in again if "_ms" in name
    )
    for row in again.to_dict("records"):
        old = rows.get((row.get("folder", ""), row["controller"], row["seed"]), {})
        for name, value in row.items():
            before = old.get(name, np.nan)
            if name not in own and before != value and not (pd.isna(value) and pd.isna(before)):
                lines.append(
                    f"{row['controller']}, seed {row['seed']}: {name} was {before}, is {value}"
                )
    return lines
