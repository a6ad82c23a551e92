"""Evaluation of controllers x seeds x demand levels in SUMO.

It compares controllers in one or several scenarios.

    <out>/[<scenario>/]demand-<level>/   results of the runs
    <out>/runs.csv                       one row per run
    <out>/manifest.json                  commands, commits, versions, seeds and hashes (run_many)
    <out>/evaluate.md                    tables paired by seed, with reasons; the ranking of
                                         several scenarios first

A suite is a TOML file: `seeds = [2000, 2001]` and a table [scenarios] of demand levels,
`grid7_peak = [0.8, 1.0]`.
"""

import random
from collections.abc import Callable, Mapping, Sequence
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
    scenarios: Planned = []
    for name, levels in suite.scenarios.items():
        folder = file.parent / name
        if not (folder / "scenario.toml").is_file():
            folder = Path(name)
        scenarios.append((load_scenario(folder, settings), levels))
    return scenarios, suite.seeds


def evaluate(
    runs: Sequence[Run],
    out: Path,
    draw: Callable[[results.Finished], None] | None = None,
    **how: Any,
) -> Table:
    """Do the runs that are not in `out`, write tables, return a row per run.

    draw: called with the finished runs of every scenario
    how: see nmfd.runs.run_many
    """
    rows = run_many(runs, out, **how)
    done = results.finished_rows(rows)
    if len(done):
        finished = {name: results.read(out, name) for name in done["scenario"].unique()}
        files.write_text(out / "evaluate.md", report(done, finished))
        if draw:
            for one in finished.values():
                draw(one)
    return rows


def plan(
    scenarios: Planned,
    strategies: Sequence[Strategy],
    seeds: Sequence[int],
    policies: Mapping[str, Path] | None = None,
) -> list[Run]:
    """Return all runs of an evaluation, seed by seed.

    policies: strategy name -> file instead of the scenario's
    """
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


def report(rows: pd.DataFrame, scenarios: Mapping[str, results.Finished]) -> str:
    """Return evaluate.md for the finished runs of scenarios."""
    several = len(scenarios) > 1
    parts = []
    if several:
        parts.append(statistics.ranking(rows))
    for name, finished in scenarios.items():
        if several:
            parts.append(f"# {name}")
        parts.append(statistics.markdown(finished.rows))
        for level in finished.levels:
            parts.append(explain.text(level, finished))
    return "\n\n".join(parts)


def check(runs: Sequence[Run], out: Path, number: int, *, workers: int = 1) -> list[str]:
    """Repeat `number` runs of a table, and return a line per difference.

    The runs are chosen by a fixed draw.

    out: folder with runs.csv and manifest.json, with or without the results
    """
    kept = results.finished_rows(pd.read_csv(out / TABLE)).to_dict("records")
    rows = {(row["folder"], row["controller"], row["seed"]): row for row in kept}
    folders = read_manifest(out)["folders"]
    chosen = random.Random(0).sample(list(runs), min(number, len(runs)))
    lines = []
    for run in chosen:
        key = folders.get(run.folder, {}).get("key", {})
        for name, value in run.key.items():
            if name != "controller" and key.get(name) != value:
                lines.append(f"{run.file}: {name} was {key.get(name)}, is {value}")
    with files.temporary_folder() as folder:
        run_many(chosen, folder, workers=workers)
        again = pd.read_csv(folder / TABLE)  # as the kept table went through a file
    times = [*HOST_TIMES, "evaluation_time_s", "wall_time_s"]  # differ from run to run
    times += [name for name in again if "_ms" in name]
    again = again.drop(columns=times, errors="ignore")
    for row in again.to_dict("records"):
        old = rows.get((row.get("folder", ""), row["controller"], row["seed"]), {})
        for name, value in row.items():
            before = old.get(name, np.nan)
            missing = pd.isna(value) and pd.isna(before)
            if before != value and not missing:
                run_label = f"{row['controller']}, seed {row['seed']}"
                lines.append(f"{run_label}: {name} was {before}, is {value}")
    return lines
