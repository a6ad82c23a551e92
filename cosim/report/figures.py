"""Figures of an evaluation in SUMO; the manners of nmfd.studies.plots: draw into `ax`, return it, simulate nothing."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Real
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize

from cosim.sumo.arrays import EdgeNumbers, PerEdge, Points, Series
from nmfd.arrays import PerPair, Positions
from nmfd.model.regional_model import RegionalModel
from nmfd.studies import plots
from nmfd.studies.benchmark import REFERENCE

JAM_DENSITY = 1000.0 / 7.5  # veh/km and lane
DENSITIES = ScalarMappable(
    Normalize(0.0, JAM_DENSITY),
    LinearSegmentedColormap.from_list("density", ["#d9d9d9", "#fecc5c", "#e31a1c", "#4d0010"]),
)
ASIDE = 0.007  # of the map's width: how far the lines of the two directions of a street are drawn apart
LEAST_FLOW, WIDEST_FLOW = 0.05, 4.5  # of the largest one; points
SATURATION = 0.5  # veh/s and lane
COMMANDED, GREEN_SHOWN, FLOWED = "#333333", "#009e73", "#0059a8"


def link_densities(
    ax: Axes, shapes: Sequence[Points], density: PerEdge, lanes: EdgeNumbers, region: EdgeNumbers
) -> Axes:
    """A map of the edges in the colours of DENSITIES.

    shapes: E lines (n, 2) [m]; density: (E,) [veh/km and lane]; lanes, region: (E,)
    """
    points = np.concatenate(shapes)
    apart = ASIDE * np.ptp(points[:, 0])
    order = np.argsort(density, kind="stable")  # the full ones on top
    ax.add_collection(
        LineCollection(
            [_to_the_right(shapes[n], apart) for n in order],
            colors=DENSITIES.to_rgba(density[order]),
            linewidths=0.5 + 0.4 * lanes[order],
            capstyle="butt",
        )
    )
    for r in np.unique(region):
        middle = np.mean([shapes[n].mean(axis=0) for n in np.flatnonzero(region == r)], axis=0)
        ax.text(
            *middle,
            str(r),
            fontsize=8,
            fontweight="bold",
            ha="center",
            va="center",
            bbox={"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": "#30506f", "linewidth": 0.8},
        )
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    return ax


def _to_the_right(shape: Points, distance: float) -> Points:
    """The line moved sideways, as seen in its direction."""
    along = shape[-1] - shape[0]
    return shape + distance * np.array([along[1], -along[0]]) / max(np.hypot(*along), 1e-9)


def flow_arrows(ax: Axes, places: Positions, trips: PerPair) -> Axes:
    """The demand between regions on a map: arrows as wide as their trips.

    places: (R, 2) [m]; trips: (R, R) [veh], those within a region and below LEAST_FLOW of the most are not drawn
    """
    between = trips * ~np.eye(len(trips), dtype=bool)
    most = float(between.max(initial=0.0))
    for i, j in np.argwhere((between > 0) & (between >= LEAST_FLOW * most)):
        ax.annotate(
            "",
            places[j],
            places[i],
            zorder=4,
            arrowprops={
                "arrowstyle": "-|>",
                "connectionstyle": "arc3,rad=0.15",
                "color": "black",
                "alpha": 0.35,
                "shrinkA": 14,
                "shrinkB": 14,
                "linewidth": WIDEST_FLOW * between[i, j] / most,
            },
        )
    if most:
        ax.set_title(f"demand between regions, widest arrow {most:,.0f} trips", fontsize="medium")
    return ax


def perimeter(ax: Axes, step: float, commanded: Series, green: Series, flow: Series) -> Axes:
    """One boundary over time: u (T,) as commanded, green as a share of the original programme's, and flow as a share
    of what passes in that at saturation."""
    time = plots.time_axis(ax, step * np.arange(len(commanded) + 1))
    for values, tone, label, width in (
        (flow, FLOWED, "flow / saturation flow of the original green", 1.2),
        (green, GREEN_SHOWN, "green shown / original green", 1.6),
        (commanded, COMMANDED, "commanded u", 1.6),
    ):
        ax.stairs(values, time, color=tone, linewidth=width, label=label, baseline=None)
    ax.set_ylim(0.0, max(1.08, 1.05 * float(np.nanmax([green, flow], initial=1.0))))
    ax.set_ylabel("share [-]")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def by_region(
    ax: Axes, step: float, values: Float[np.ndarray, "T R"], regions: Sequence[int], network: RegionalModel, label: str
) -> Axes:
    """Something of these regions over time: `values` (T, R), one per control interval; `label` of the axis."""
    time = plots.time_axis(ax, step * np.arange(len(values) + 1))
    for region in regions:
        ax.stairs(
            values[:, region],
            time,
            color=colormaps["tab10"](region % 10),
            linewidth=1.6,
            baseline=None,
            label=plots.region_title(network, region),
        )
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel(label)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def green_against_command(ax: Axes, commanded: Float[np.ndarray, " n"], green: Float[np.ndarray, " n"]) -> Axes:
    """Every boundary and interval: share of the original green that was shown against the commanded u, both (n,)."""
    ax.scatter(commanded, green, s=5, color=GREEN_SHOWN, alpha=0.35, linewidths=0)
    ax.set_xlabel("commanded u [-]")
    ax.set_ylabel("green shown / original [-]")
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(0.0, max(1.08, 1.05 * float(np.nanmax(green, initial=1.0))))
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def splits(
    ax: Axes,
    step: float,
    commanded: Float[np.ndarray, "T H"],
    realised: Float[np.ndarray, "T H"],
    neighbours: Sequence[int],
) -> Axes:
    """The vehicles of one region for one destination over time: theta (T, H) as commanded (lines) and the shares that
    left by each of the H neighbours (dots; NaN where nobody left)."""
    time = plots.time_axis(ax, step * np.arange(len(commanded) + 1))
    for n, h in enumerate(neighbours):
        tone = colormaps["tab10"](h % 10)
        ax.stairs(commanded[:, n], time, color=tone, linewidth=1.5, label=f"by {h}", baseline=None)
        ax.plot(time[:-1] + np.diff(time) / 2, realised[:, n], "o", color=tone, markersize=3)
    ax.set_ylim(-0.04, 1.04)
    ax.set_ylabel("share [-]")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def split_totals(
    ax: Axes, commanded: Float[np.ndarray, " n"], realised: Float[np.ndarray, " n"], vehicles: Real[np.ndarray, " n"]
) -> Axes:
    """theta as commanded against as realised, (n,) each, over the whole run; area by `vehicles` (n,)."""
    ax.plot([0, 1], [0, 1], color="#bbbbbb", linewidth=1.0, zorder=1)
    ax.scatter(
        commanded,
        realised,
        s=90.0 * vehicles / max(vehicles.max(initial=0.0), 1.0) + 3.0,
        color=FLOWED,
        alpha=0.45,
        linewidths=0,
        zorder=2,
    )
    ax.set_xlabel("commanded θ [-], mean of the run")
    ax.set_ylabel("share that went there [-]")
    ax.set_xlim(-0.04, 1.04)
    ax.set_ylim(-0.04, 1.04)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def over_demand(ax: Axes, ratios: Mapping[str, Mapping[float, tuple[float, float]]], against: str = REFERENCE) -> Axes:
    """Total time spent as a share of that of `against`, over the demand level: controller -> level -> mean over seeds
    and half of its 95 % interval (NaN of a single seed)."""
    tones = plots.colours([against, *ratios])
    ax.axhline(1.0, color=tones[against], linewidth=1.0)
    levels = sorted({level for points in ratios.values() for level in points})
    aside = 0.012 * max(levels[-1] - levels[0], 0.1)  # so that intervals do not hide each other
    for number, (controller, points) in enumerate(ratios.items()):
        mean, half = np.array(list(points.values())).reshape(-1, 2).T
        ax.errorbar(
            np.array(list(points)) + aside * (number - (len(ratios) - 1) / 2),
            mean,
            np.nan_to_num(half),
            color=tones[controller],
            linewidth=1.6,
            capsize=3,
            marker="o^sDv"[number % 5],
            markersize=4,
            label=controller,
        )
    ax.set_xticks(levels, [f"{level:g}" for level in levels])
    ax.set_xlabel("demand, multiple of the scenario's")
    ax.set_ylabel(f"total time spent / that of {against} [-]")
    ax.set_ylim(bottom=0.0)
    ax.spines[["top", "right"]].set_visible(False)
    return ax
