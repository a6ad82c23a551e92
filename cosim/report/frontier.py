"""The picture of a frontier (cosim.evaluation.frontier): who serves which demand, and what a trip takes there."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from cosim.evaluation.frontier import SERVED, TTS, highest
from nmfd.studies import plots

MARKERS = "o^sDvPX"


def draw(path: Path, table: pd.DataFrame) -> Path:
    """`table`: of cosim.evaluation.frontier.shares; the strategy that serves most comes first in the legend."""
    reached = highest(table)
    names = sorted(reached, key=lambda name: -reached[name])
    tones = plots.colours(names)
    drawing = plots.figure(7.6, 7.4)
    served, minutes = drawing.subplots(2, 1, sharex=True)
    for number, name in enumerate(names):
        part = table[table["controller"] == name].sort_values("demand")
        label = f"{name}: up to {reached[name]:g}" if reached[name] else f"{name}: at none"
        manner = {
            "color": tones[name],
            "marker": MARKERS[number % len(MARKERS)],
            "markersize": 5,
            "linewidth": 1.6,
            "capsize": 3,
            "label": label,
        }
        aside = 0.006 * (number - (len(names) - 1) / 2)  # so that points on one another can be told apart
        at, share = part["demand"].to_numpy() + aside, part["served_share"].to_numpy()
        served.errorbar(
            at, share, np.abs(np.stack([share - part["served_share_low"], part["served_share_high"] - share])), **manner
        )
        per_trip = 60.0 * part["mean_trips"].clip(lower=1.0)
        minutes.errorbar(
            at, part[f"mean_{TTS}"] / per_trip, (part[f"half_interval_{TTS}"] / per_trip).fillna(0.0), **manner
        )
    served.axhline(SERVED, color="#777777", linestyle="--", linewidth=1.0)
    served.set_ylabel("share of the seeds in which\nall trips are served [-]")
    served.set_ylim(-0.04, 1.04)
    minutes.set_ylabel("time per trip, waiting to\ndepart included [min]")
    minutes.set_ylim(bottom=0.0)
    minutes.set_xlabel("demand, multiple of the scenario's [-]")
    for ax in (served, minutes):
        _levels(ax, sorted(set(table["demand"])))
    seeds = f"{table['seeds'].min()}" + (f" to {table['seeds'].max()}" if table["seeds"].nunique() > 1 else "")
    drawing.suptitle(
        f"all trips served in {SERVED:.0%} of the seeds up to ... times the demand; {seeds} seeds, 95 % intervals",
        fontsize="medium",
    )
    plots.legend_below(drawing, [served], columns=2)
    return plots.save(drawing, path)


def _levels(ax: Axes, levels: list[float]) -> None:
    ax.set_xticks(levels, [f"{level:g}" for level in levels])
    ax.spines[["top", "right"]].set_visible(False)
