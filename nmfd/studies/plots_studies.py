"""Figures of robustness and ablations; the manners of nmfd.studies.plots."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullLocator, ScalarFormatter, StrMethodFormatter

from nmfd.studies import plots

METHOD_COLOURS = {"alternating": "#882255", "joint": "#44aa99"}


def improvement(ax: Axes, gains: Mapping[str, Mapping[float, tuple[float, float]]]) -> Axes:
    """Improvement over no control [%] against sigma of the demand noise [veh/s], with 95 % intervals.

    gains: controller -> sigma -> mean and half interval (nmfd.studies.robustness.improvements)
    """
    ax.axhline(0.0, color=plots.CONTROLLER_COLOURS["no-control"], linewidth=1.0)
    for number, (controller, points) in enumerate(gains.items()):
        mean, half = np.array(list(points.values())).reshape(-1, 2).T
        ax.errorbar(
            list(points),
            mean,
            np.nan_to_num(half),
            color=plots.colour(controller),
            linewidth=1.6,
            capsize=3,
            marker="o^sDv"[number % 5],
            markersize=4,
            label=controller,
        )
    ax.set_ylabel("total time spent saved\nagainst no-control [%]")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def trips(ax: Axes, counts: Mapping[float, float]) -> Axes:
    """Vehicles of the whole scenario against sigma of the demand noise [veh/s]."""
    ax.plot(list(counts), list(counts.values()), color=plots.CONTROLLER_COLOURS["no-control"], marker="o", markersize=4)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("standard deviation of the noise on the demand [veh/s]")
    ax.set_ylabel("trips [veh]")
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def training_curves(ax: Axes, rows: Sequence[Mapping]) -> Axes:
    """The best validation so far [veh s] against Adam steps: mean over seeds and their range, one curve per method.

    rows: of validation.csv (nmfd.studies.ablation)
    """
    for method in dict.fromkeys(row["method"] for row in rows):
        seeds: dict[int, dict[int, float]] = {}
        for row in rows:
            if row["method"] == method:
                seeds.setdefault(row["seed"], {})[row["adam_step"]] = row["total_time_spent_veh_s"]
        steps = list(next(iter(seeds.values())))
        best = np.stack([np.minimum.accumulate(list(values.values())) for values in seeds.values()])
        ax.plot(
            steps,
            best.mean(axis=0),
            color=METHOD_COLOURS[method],
            linewidth=1.6,
            label=f"{method}, mean and range of {len(best)} seed{'s' * (len(best) > 1)}",
        )
        ax.fill_between(steps, best.min(axis=0), best.max(axis=0), color=METHOD_COLOURS[method], alpha=0.2, linewidth=0)
    ax.set_xscale("log")  # most is gained early
    if any(row["total_time_spent_veh_s"] > 0 for row in rows):
        ax.set_yscale("log")
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(2.0, 0.5)))
    ax.set_xlabel("Adam steps")
    ax.set_ylabel("best total time spent in validation [veh s]")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def learning_curve(ax: Axes, controller: str, rows: Sequence[tuple[int, float, float]]) -> Axes:
    """Total time spent [veh s] against Adam steps: of the training's own rollouts, and in validation, the best marked.

    rows: steps, training, validation
    """
    steps, trained, validated = np.array(rows, dtype=float).T
    colour, best = plots.colour(controller), int(np.nanargmin(validated))
    ax.plot(steps, trained, color=colour, alpha=0.4, linewidth=1.2, label="training: random starts and demand")
    ax.plot(steps, validated, color=colour, linewidth=1.8, marker=".", label="validation: the scenario itself")
    ax.plot(
        steps[best],
        validated[best],
        "o",
        color=colour,
        markersize=9,
        fillstyle="none",
        label=f"kept: {validated[best]:.4g} veh s after {steps[best]:.0f} steps",
    )
    if (np.concatenate([trained, validated]) > 0.0).all():
        ax.set_yscale("log")
        ax.yaxis.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(2.0, 0.5)))
    ax.set_title(f"Training of {controller}", loc="left", fontsize="medium")
    ax.set_xlabel("Adam steps")
    ax.set_ylabel("total time spent [veh s]")
    ax.legend(frameon=False, fontsize="small")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def trained(ax: Axes, rows: Sequence[Mapping]) -> Axes:
    """Total time spent [veh s] of every finished policy on the plant, one column per method, with the mean over seeds.

    rows: of training.csv (nmfd.studies.ablation)
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for place, method in enumerate(methods):
        totals = [row["total_time_spent_veh_s"] for row in rows if row["method"] == method]
        across = place + np.linspace(-0.12, 0.12, len(totals)) if len(totals) > 1 else [place]
        ax.plot(across, totals, "o", color=METHOD_COLOURS[method], markersize=5)
        ax.hlines(np.mean(totals), place - 0.3, place + 0.3, color=METHOD_COLOURS[method], linewidth=1.6)
    ax.set_xticks(range(len(methods)), methods)
    ax.set_xlim(-0.6, len(methods) - 0.4)
    ax.set_ylabel("total time spent on the plant [veh s]")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def over_horizon(ax: Axes, rows: Sequence[Mapping], column: str, label: str) -> Axes:
    """`column` of horizon.csv (nmfd.studies.ablation) against the horizon of MPC, one curve per controller."""
    for controller in dict.fromkeys(row["controller"] for row in rows):
        points = [(row["horizon"], row[column]) for row in rows if row["controller"] == controller]
        ax.plot(
            *zip(*points, strict=True),
            color=plots.colour(controller),
            marker="o",
            markersize=4,
            linewidth=1.6,
            label=controller,
        )
    ax.set_xlabel("horizon [control intervals]")
    ax.set_ylabel(label)
    ax.spines[["top", "right"]].set_visible(False)
    return ax
