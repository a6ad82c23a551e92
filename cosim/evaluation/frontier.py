"""The frontier: up to which demand every strategy serves all trips.

    <folder>/frontier.csv    one row per strategy and demand level: share of the seeds in which all trips were served
                             within the horizon, completed trips, total time spent, each with its 95 % interval
    <folder>/frontier.md     the same beside the highest demand that was served in SERVED of the seeds
    <folder>/demand-<level>/ the runs, as of an evaluation (cosim.evaluation.evaluate)

A strategy that serves all trips in none of the seeds of a level is not asked for more, unless it shall be: locked runs
are the slowest of all, and they say no more than that.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import pandas as pd
from scipy.stats import binomtest

from cosim.evaluation import dask_cluster, earlier, experiment
from cosim.evaluation.evaluate import Evaluation, all_runs, check_folder, kept_runs
from cosim.evaluation.statistics import TTS
from nmfd.runs import files, trail
from nmfd.runs.tables import markdown_table, text_table
from nmfd.runs.workers import ended
from nmfd.studies.benchmark import interval

SERVED = 0.9  # share of the seeds
CAPTION = (
    "served: runs in which every trip was completed within the horizon, of all runs; TTS: total time spent, running "
    f"and waiting to be inserted, mean over seeds ± 95 % interval; highest demand served: in {SERVED:.0%} of the seeds "
    "or more, at this level and at every lower one that was run"
)


def frontier(
    order: Evaluation,
    *,
    everything: bool = False,
    workers: int = 1,
    scheduler: dask_cluster.Scheduler | str | None = None,
    progress: experiment.Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> tuple[pd.DataFrame, list[str]]:
    """Run what is not there yet, from the lowest level up; returns the table of frontier.csv and a line per failed run.

    everything: every strategy at every level; scheduler: a Dask scheduler or its address, whose workers do the runs
    instead of `workers` processes here. The table is of all runs in the folder. Raises InputError, and RunFailed
    if no run went well.
    """
    check_folder(order.out)
    earlier.add(order.out, order.earlier, kept_runs(order))
    failed: list[str] = []
    source = dask_cluster.source(scheduler, tell)
    left = list(order.controllers)
    for level in sorted(order.levels):
        here = replace(order, levels=(level,), controllers=tuple(left))
        failures = experiment.perform(
            here.plan(), workers=workers, fresh=True, source=source, progress=progress, tell=tell
        )
        rows = all_runs(order)
        if failures and rows.empty:
            raise ended([(experiment.label(task), failure) for task, failure in failures[:1]])
        failed += [f"{experiment.label(task)}: {failure.reason}" for task, failure in failures]
        table = _write(order, rows)
        if not everything:
            now = table[(table["demand"] == level) & (table["served_runs"] == 0)]
            left = [name for name in left if name not in set(now["controller"])]
        if not left:
            break
    return table, failed


def shares(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per demand level and controller of `rows`, which are those of `evaluate.all_runs`."""
    out = []
    for (level, name), part in rows.groupby(["demand", "controller"], sort=False):
        served = int((part["completed_veh"] >= part["trips"]).sum())
        between = binomtest(served, len(part)).proportion_ci(method="wilson")
        out.append(
            {
                "demand": level,
                "controller": name,
                "seeds": len(part),
                "served_runs": served,
                "served_share": served / len(part),
                "served_share_low": between.low,
                "served_share_high": between.high,
                "completed_share": float((part["completed_veh"] / part["trips"].clip(lower=1)).mean()),
                "mean_trips": float(part["trips"].mean()),
                f"mean_{TTS}": float(part[TTS].mean()),
                f"half_interval_{TTS}": interval(list(part[TTS])),
            }
        )
    return pd.DataFrame(out)


def highest(table: pd.DataFrame) -> dict[str, float]:
    """Controller -> the highest demand level up to which every level that was run was SERVED; 0 for none."""
    found = {}
    for name, part in table.sort_values("demand").groupby("controller", sort=False):
        good = part["served_share"] >= SERVED - 1e-9
        found[str(name)] = float(part["demand"][good.cummin()].max()) if good.iloc[0] else 0.0
    return found


def lines(table: pd.DataFrame) -> list[dict[str, object]]:
    """For the terminal and the markdown: one row per controller, the one that serves most first."""
    reached, levels = highest(table), sorted(set(table["demand"]))
    cells = {(row["controller"], row["demand"]): row for row in table.to_dict("records")}
    out = []
    for name in sorted(reached, key=lambda name: (-reached[name], list(reached).index(name))):
        row: dict[str, object] = {"controller": name, "highest demand served": f"{reached[name]:g}"}
        for level in levels:
            row[f"at {level:g}: served, TTS [veh s]"] = _cell(cells.get((name, level)))
        out.append(row)
    return out


def _cell(row: dict | None) -> str:
    if row is None:
        return "not run"
    half = row[f"half_interval_{TTS}"]
    spread = "" if math.isnan(half) else f" ± {half:.1e}"
    return f"{row['served_runs']} of {row['seeds']}, {row[f'mean_{TTS}']:.3g}{spread}"


def text(table: pd.DataFrame) -> str:
    """For the terminal."""
    return text_table(lines(table), CAPTION)


def _write(order: Evaluation, rows: pd.DataFrame) -> pd.DataFrame:
    table, folder = shares(rows), order.out
    files.write_table(folder / "runs.csv", rows)
    files.write_table(folder / "frontier.csv", table)
    shown = lines(table)
    body = markdown_table(list(shown[0]), [list(row.values()) for row in shown])
    files.write_text(folder / "frontier.md", f"{body}\n\n{CAPTION}\n{trail.comment(folder / 'frontier.md')}")
    return table
