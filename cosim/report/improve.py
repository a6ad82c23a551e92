"""The picture of an improvement (cosim.evaluation.improve): time spent over the runs that it learned from."""

from pathlib import Path

import pandas as pd
from matplotlib.ticker import MaxNLocator

from cosim.evaluation.scores import SCORE
from nmfd.studies import plots


def draw(path: Path, table: pd.DataFrame, *, runs: int) -> Path:
    """`table`: of cosim.evaluation.improve; runs: of every round."""
    drawing = plots.figure(7.2, 4.2)
    ax = drawing.subplots()
    at, kept = runs * (table["round"] + 1), table["kept"].astype(bool)
    first = float(table[SCORE].iloc[0])
    change = 100.0 * (table[SCORE] / first - 1.0)
    ax.step(at, change.where(kept).ffill(), where="post", color="#1f6f8b", linewidth=1.8, label="best so far")
    ax.scatter(at[kept], change[kept], color="#1f6f8b", s=36, zorder=3, label="kept")
    ax.scatter(at[~kept], change[~kept], facecolors="none", edgecolors="#b3541e", s=36, zorder=3, label="not kept")
    ax.axhline(0.0, color="#777777", linestyle="--", linewidth=1.0)
    ax.set_xlabel("runs in SUMO [-]")
    ax.set_ylabel("total time spent, geometric mean over\nseeds and levels, against round 0 [%]")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.spines[["top", "right"]].set_visible(False)
    plots.legend_below(drawing, [ax], columns=3)
    return plots.save(drawing, path)
