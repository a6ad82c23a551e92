"""Figures of the scaling experiment; the manners of nmfd.studies.plots."""

import math
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator, ScalarFormatter

from nmfd.studies import plots

MARKERS = {"dpc-pc": "o", "dpc-pcrg": "s", "mpc-pc": "^", "mpc-pcrg": "D", "dpc-pc-local": "v"}
PUBLISHED_LIMITS = {"mpc-pc": 16, "mpc-pcrg": 8}  # regions, the most that the published MPC solved


def decision_times(ax: Axes, rows: Sequence[Mapping], *, interval: float, published: bool = False) -> Axes:
    """Median time of a decision [s] against regions, the first decision dashed, log-log.

    rows: of scaling.csv, of one family and load; interval: the control interval [s]
    published: mark how many regions the published MPC could solve
    """
    _curves(ax, rows, "median_decision_s", "-")
    _curves(ax, rows, "first_decision_s", ":")
    ax.axhline(interval, color=plots.RED, linewidth=1.2)
    ax.annotate(
        f"control interval, {interval:g} s",
        (0.02, interval),
        xycoords=("axes fraction", "data"),
        xytext=(0, 3),
        textcoords="offset points",
        fontsize="small",
        color=plots.RED,
    )
    ax.plot([], [], linestyle=":", color="#555555", label="first decision")
    if published:
        for name, most in PUBLISHED_LIMITS.items():
            if any(row["controller"] == name and row["regions"] >= most for row in rows):
                ax.axvline(most, color=plots.colour(name), linewidth=1.0, linestyle="--", alpha=0.8)
                ax.annotate(
                    f"published {name} fails beyond {most}",
                    (most, 0.9),
                    xycoords=("data", "axes fraction"),
                    xytext=(-3, 0),
                    textcoords="offset points",
                    fontsize="small",
                    rotation=90,
                    ha="right",
                    va="top",
                    color="#444444",
                )
    ax.set_ylabel("time of a decision [s]")
    return ax


def memory(ax: Axes, rows: Sequence[Mapping]) -> Axes:
    """Peak memory of the process [MiB] against regions, log-log."""
    _curves(ax, rows, "peak_memory_mib", "-")
    ax.set_ylabel("peak memory [MiB]")
    ax.set_xlabel("regions")
    return ax


def _curves(ax: Axes, rows: Sequence[Mapping], quantity: str, style: str) -> None:
    counts = sorted({row["regions"] for row in rows})
    for name in dict.fromkeys(row["controller"] for row in rows):
        points = sorted((row["regions"], row[quantity]) for row in rows if row["controller"] == name)
        points = [point for point in points if not math.isnan(point[1])]
        if points:  # matplotlib cannot do without, on a logarithmic axis
            ax.set_yscale("log")
        ax.plot(
            *zip(*points, strict=True) if points else ([], []),
            style,
            color=plots.colour(name),
            linewidth=1.6,
            marker=MARKERS[name] if style == "-" else None,
            markersize=4,
            label=name if style == "-" else None,
        )
    ax.set_xscale("log")
    ax.set_xlim(0.9 * counts[0], 1.1 * counts[-1])
    ax.set_xticks(counts)
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_minor_locator(NullLocator())
    ax.grid(axis="y", color="#dddddd", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
