"""Figures of an evaluation in SUMO, of one or several demand levels."""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.evaluation import model_validation, statistics
from cosim.evaluation.results import Finished, Level
from nmfd.studies import plots
from nmfd.studies.benchmark import draw_accumulations, interval

# Controller -> level -> mean and half of its 95 % interval.
Points = Mapping[str, Mapping[float, tuple[float, float]]]


def ranked(rows: pd.DataFrame) -> list[str]:
    """Return the controllers of one demand level, the best first.

    They are ranked by paired change, or else by mean time spent, on the seeds that all have.
    """
    table = statistics.statistics(statistics.on_common_seeds(rows)).set_index("controller")
    score = table["change_percent"].mask(table.index == table["against"], 0.0)
    score = score.fillna(table[statistics.TTS])
    return list(score.sort_values(kind="stable").index)


def pair(rows: pd.DataFrame) -> list[str]:
    """Return the reference and the best other controller, if there is one."""
    against = statistics.compared_with(rows)
    return [against, *(name for name in ranked(rows) if name != against)][:2]


def draw_all(finished: Finished) -> None:
    """Draw the pictures of every demand level into its folder.

    Those of several levels are beside the folders.
    """
    for level in finished.levels:
        draw_level(level.folder, finished, level)
    if len(finished.levels) > 1:
        draw_levels(finished.path, finished.rows)


def draw_level(out: Path, finished: Finished, level: Level) -> None:
    """Draw all pictures of one demand level into a folder."""
    rows = level.rows
    network = finished.scenario.network
    # The first seed that most controllers have.
    seed = int(rows["seed"].value_counts().sort_index().idxmax())
    runs = level.measures()
    title = f"seed {seed}"
    if rows["seed"].nunique() > 1:
        title += ", shaded: all seeds"
    draw_accumulations(out, finished.scenario, runs, seed=seed, title=title)
    samples: list[dict] = [{} for _ in range(network.regions)]
    for name in pair(rows[rows["seed"] == seed]):
        clouds = model_validation.outflow_samples(network, [level.read(name, seed)])
        for of_region, cloud in zip(samples, clouds, strict=True):
            of_region[name] = np.concatenate([*cloud.values()])
    plots.draw_mfds(out / "mfd.png", network, samples)


def draw_levels(out: Path, rows: pd.DataFrame) -> None:
    """Draw trips served (the frontier) and time spent over demand levels.

    out: folder of the files
    """
    against = statistics.compared_with(rows)
    ratios: dict[str, dict] = defaultdict(dict)
    shares: dict[str, dict] = defaultdict(dict)
    for level, here in rows.groupby("demand", sort=True):
        reference = statistics.by_seed(rows, level, against)
        for name, part in here.groupby("controller", sort=False):
            served = part["completed_veh"] / part["trips"].clip(lower=1)
            shares[name][level] = served.mean(), interval(list(served))
            pair = statistics.paired(statistics.by_seed(rows, level, name), reference)
            if name != against and not np.isnan(pair.percent):
                ratios[name][level] = 1.0 + pair.percent / 100.0, pair.percent_half / 100.0
    _draw_over_levels(out / "frontier.png", shares, "trips served / trips due [-]")
    _draw_over_levels(out / "demand.png", ratios, f"total time spent / that of {against} [-]")


def _draw_over_levels(file: Path, values: Points, label: str) -> None:
    """Draw a quantity over the demand level into a file, unless it is unknown."""
    if not values:
        return
    drawing = plots.figure(7.5, 4.8)
    ax = plots.with_intervals(drawing.subplots(), values)
    levels = sorted({level for points in values.values() for level in points})
    ax.axhline(1.0, color="#777777", linestyle="--", linewidth=1.0)
    ax.set_xticks(levels, [f"{level:g}" for level in levels])
    ax.set_ylim(bottom=0.0)
    ax.set(xlabel="demand, multiple of the scenario's", ylabel=label)
    drawing.suptitle("mean over seeds, 95 % intervals", fontsize="medium")
    plots.legend_below(drawing, [ax])
    plots.save(drawing, file)
