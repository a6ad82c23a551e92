"""The map of an import: regions with their gateways, and the densities that they were cut by."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from cosim.importing.layers import colour
from cosim.importing.quality import Tables
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers, PerEdge
from nmfd.arrays import Positions
from nmfd.studies import plots


def draw_map(
    path: Path,
    streets: Streets,
    regions: EdgeNumbers,
    names: Sequence[str],
    places: Positions,
    tables: Tables,
    density: PerEdge | None,
) -> None:
    """density: (E,) [veh per lane-km], or None."""
    width, height = np.ptp(streets.centre, axis=0) + 1.0
    count = 1 if density is None else 2
    drawing = plots.figure(6.2 * count, float(np.clip(6.2 * height / width, 3.0, 8.0)) + 0.8)
    axes = np.atleast_1d(drawing.subplots(1, count))
    region_map(axes[0], streets, regions, names, places)
    gateway_marks(axes[0], streets, tables)
    if density is not None:
        lines = _streets(axes[1], streets, array=np.minimum(density, 120.0), cmap="viridis_r")
        drawing.colorbar(lines, ax=axes[1], shrink=0.7, label="density [veh per lane-km]")
        axes[1].set_title("busiest quarter of an hour, no control", fontsize="medium")
    drawing.savefig(path, dpi=130, metadata={"Software": None})


def region_map(ax: Axes, streets: Streets, regions: EdgeNumbers, names: Sequence[str], places: Positions) -> Axes:
    """Every street in the colour of its region, with a scale bar."""
    _streets(ax, streets, colors=[colour(region) for region in regions[streets.drivable]])
    for region, (x, y) in enumerate(places):
        ax.text(
            x,
            y,
            f"{region} {names[region]}",
            ha="center",
            va="center",
            fontsize="small",
            zorder=5,
            bbox={"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": colour(region), "alpha": 0.85},
        )
    left, right = ax.get_xlim()
    length = 10.0 ** np.floor(np.log10(0.4 * (right - left)))
    bottom = ax.get_ylim()[0]
    ax.plot([left, left + length], [bottom, bottom], color="black", linewidth=2)
    text = f"{length:g} m" if length < 1000 else f"{length / 1000:g} km"
    ax.annotate(
        text, (left + length / 2, bottom), xytext=(0, 3), textcoords="offset points", ha="center", fontsize="small"
    )
    return ax


def gateway_marks(ax: Axes, streets: Streets, tables: Tables) -> Axes:
    """A dot where an edge ends at a boundary: controlled by a signal, or not."""
    for controlled, face, label in ((True, "black", "gateway with a signal"), (False, "white", "without control")):
        edges = sorted({g["from_edge"] for g in tables.gateways if (g["control"] == "controlled") == controlled})
        points = np.array([streets.shapes[streets.number[edge]][-1] for edge in edges]).reshape(-1, 2)
        if len(points):
            ax.scatter(
                points[:, 0],
                points[:, 1],
                s=14,
                facecolor=face,
                edgecolor="black",
                linewidths=0.8,
                zorder=4,
                label=label,
            )
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=2, frameon=False, fontsize="small")
    return ax


def _streets(ax: Axes, streets: Streets, array: np.ndarray | None = None, **style: Any) -> LineCollection:
    members = np.flatnonzero(streets.drivable)
    lines = LineCollection(
        [streets.shapes[n] for n in members],
        linewidths=0.6 + 0.5 * np.minimum(streets.lanes[members], 4),
        capstyle="round",
        **style,
    )
    if array is not None:
        lines.set_array(array[members])
    ax.add_collection(lines)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    return lines
