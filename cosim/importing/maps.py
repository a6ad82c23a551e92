"""Maps of regions: streets in the colour of their region, gateways, outlines."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from cosim.importing.quality import CONTROLLED, Tables
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers, Points
from cosim.sumo.net import points_along
from nmfd.arrays import Positions

CELLS = 160  # along the longer side of the raster for outlines
POINT_SPACING_M = 40.0  # between the points that stand for an edge
SMALLEST_RING_SHARE = 0.02  # of the area of the largest ring
COLOURS = (
    "#4e79a7",
    "#f28e2b",
    "#59a14f",
    "#e15759",
    "#76b7b2",
    "#b07aa1",
    "#edc948",
    "#9c755f",
    "#ff9da7",
    "#8cd17d",
)


def region_map(
    ax: Axes,
    streets: Streets,
    regions: EdgeNumbers,
    names: Sequence[str],
    places: Positions,
    tables: Tables,
) -> Axes:
    """Draw streets in the colour of their region, and gateways, filled if a controllable signal
    stands there."""
    members = np.flatnonzero(streets.drivable)
    lines = LineCollection(
        [streets.shapes[n] for n in members],
        linewidths=0.6 + 0.5 * np.minimum(streets.lanes[members], 4),
        capstyle="round",
        colors=[COLOURS[region % len(COLOURS)] for region in regions[members]],
    )
    ax.add_collection(lines)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    for region, (x, y) in enumerate(places):
        colour, title = COLOURS[region % len(COLOURS)], f"{region} {names[region]}"
        box = {
            "boxstyle": "round,pad=0.25",
            "facecolor": "white",
            "edgecolor": colour,
            "alpha": 0.85,
        }
        ax.text(x, y, title, ha="center", va="center", fontsize="small", zorder=5, bbox=box)
    for controlled, face, label in (
        (True, "black", "gateway with a signal"),
        (False, "white", "without control"),
    ):
        edges = sorted(
            {g["from_edge"] for g in tables.gateways if (g["control"] == CONTROLLED) == controlled}
        )
        x, y = (
            np.array([streets.shapes[streets.number[edge]][-1] for edge in edges]).reshape(-1, 2).T
        )
        if len(x):
            ax.scatter(
                x, y, s=14, facecolor=face, edgecolor="black", linewidths=0.8, zorder=4, label=label
            )
    if tables.gateways:
        ax.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.01),
            ncols=2,
            frameon=False,
            fontsize="small",
        )
    return ax


def rings_round(
    shapes: Sequence[Points], regions: EdgeNumbers, blocks: float
) -> list[list[Points]]:
    """Return the outlines of every region, the largest first: rings (n, 2) [m] round the places
    nearest to its edges.

    shapes: of E edges, (n, 2) [m]; blocks: share of the map's extent between streets that is still
        no hole
    """
    points, of = _sampled(shapes)
    low, high = points.min(axis=0), points.max(axis=0)
    cell = max(float((high - low).max()) / CELLS, 1.0)
    # Beyond this distance a place belongs to no street; the map must end there, or rings stay open.
    reach = max(2.5 * max(cell, POINT_SPACING_M), blocks * float((high - low).max()))
    x, y = (np.arange(low[a] - reach - 2 * cell, high[a] + reach + 3 * cell, cell) for a in (0, 1))
    distance, nearest = cKDTree(points).query(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    label = np.where(distance < reach, regions[of[nearest]], -1).reshape(len(y), len(x))
    ax = Figure().subplots()
    outlines = []
    for region in range(int(regions.max()) + 1):
        rings = ax.contour(x, y, (label == region).astype(float), levels=[0.5]).allsegs[0]
        rings.sort(key=lambda ring: -abs(_area(ring)))
        # Rings round holes run the other way: their area has the other sign.
        outlines.append(
            [ring for ring in rings if _area(ring) / _area(rings[0]) > SMALLEST_RING_SHARE]
        )
    return outlines


def _sampled(shapes: Sequence[Points]) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 2) along the shapes of the edges, and the edge (n,) of each point."""

    def marks(length: float) -> np.ndarray:
        return np.linspace(0.0, length, max(2, int(length / POINT_SPACING_M) + 1))

    points = [points_along(shape, marks) for shape in shapes]
    return np.concatenate(points), np.arange(len(shapes)).repeat([*map(len, points)])


def _area(ring: Points) -> float:
    """Return the area [m^2] of a polygon (n, 2) [m]; negative if it runs clockwise."""
    x, y = ring.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2
