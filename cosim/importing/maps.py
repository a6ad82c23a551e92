"""Maps of regions, with gateways and outlines."""

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from cosim.importing.quality import CONTROLLED, Tables
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers, Points
from cosim.sumo.net import points_along
from nmfd.arrays import Positions

CELLS = 160  # along the longer side of the raster for outlines
POINT_SPACING_M = 40.0  # between the points that stand for an edge
REACH = 0.05  # of the map's extent: places farther from all streets belong to no region
PALE = 0.2  # share of its colour in the land of a region; the rest is white
SMALLEST_RING_SHARE = 0.02  # of the area of the largest ring
BOX = {"boxstyle": "round,pad=0.25", "facecolor": "white", "alpha": 0.85}  # of a region's name
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
    """Draw regions, their streets, and gateways.

    A gateway is an arrow in the colour of the region that it leads into, filled if a controllable
    signal stands there.
    """
    members = np.flatnonzero(streets.drivable)
    outlines = rings_round([streets.shapes[n] for n in members], regions[members], REACH)
    for region, ring in largest_first(outlines):
        ax.fill(*ring.T, facecolor=pale(region), edgecolor=colour(region), linewidth=0.6, zorder=0)
    lines = LineCollection(
        [streets.shapes[n] for n in members],
        linewidths=0.6 + 0.5 * np.minimum(streets.lanes[members], 4),
        capstyle="round",
        colors=[colour(region) for region in regions[members]],
    )
    ax.add_collection(lines)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    for region, (x, y) in enumerate(places):
        title = f"{region} {names[region]}"
        box = BOX | {"edgecolor": colour(region)}
        ax.text(x, y, title, ha="center", va="center", fontsize="small", zorder=5, bbox=box)
    arrows = {}
    for gateway in tables.gateways:
        tone = colour(gateway["target"])
        face = tone if gateway["control"] == CONTROLLED else "white"
        arrows[gateway["from_edge"], face] = tone
    for (edge, face), tone in sorted(arrows.items()):
        _arrow(ax, streets.shapes[streets.number[edge]], face, tone)
    if arrows:
        key = "Arrows: gateways, in the colour of the region they lead into; white: without control"
        ax.text(0.5, -0.02, key, ha="center", va="top", fontsize="small", transform=ax.transAxes)
    return ax


def _arrow(ax: Axes, shape: Points, face: str, rim: str) -> None:
    """Draw an arrow at the end of a street."""
    x, y = shape[-1]
    along = shape[-1] - shape[-2]
    up = np.degrees(np.arctan2(along[1], along[0])) - 90.0
    style = {"facecolor": face, "edgecolor": "black", "linewidths": 0.7, "zorder": 4}
    if face == "white":
        style["edgecolor"] = rim
    ax.scatter(x, y, s=34, marker=(3, 0, up), **style)


def colour(region: int) -> str:
    """Return the colour of a region."""
    return COLOURS[region % len(COLOURS)]


def pale(region: int) -> str:
    """Return the colour of a region's land."""
    return to_hex(1.0 - PALE * (1.0 - np.array(to_rgb(colour(region)))))


def largest_first(outlines: Iterable[Iterable[Points]]) -> list[tuple[int, Points]]:
    """Return region and ring of all outlines, to be drawn in this order.

    A region in the midst of another is not hidden by it.
    """
    rings = []
    for region, outline in enumerate(outlines):
        rings += [(region, ring) for ring in outline]
    return sorted(rings, key=lambda pair: -abs(_area(pair[1])))


def rings_round(
    shapes: Sequence[Points], regions: EdgeNumbers, blocks: float
) -> list[list[Points]]:
    """Return the outlines of every region, the largest first.

    They are rings (n, 2) [m] round the places nearest to its edges.
    shapes: of E edges, (n, 2) [m]
    blocks: share of the map's extent between streets that is still no hole
    """
    points, of = _sampled(shapes)
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high - low).max())
    cell = max(extent / CELLS, 1.0)
    # Beyond this distance a place belongs to no street; the map must end there, or rings stay open.
    reach = max(2.5 * max(cell, POINT_SPACING_M), blocks * extent)
    x = np.arange(low[0] - reach - 2 * cell, high[0] + reach + 3 * cell, cell)
    y = np.arange(low[1] - reach - 2 * cell, high[1] + reach + 3 * cell, cell)
    raster = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    distance, nearest = cKDTree(points).query(raster)
    label = np.where(distance < reach, regions[of[nearest]], -1).reshape(len(y), len(x))
    ax = Figure().subplots()
    outlines = []
    for region in range(int(regions.max()) + 1):
        rings = ax.contour(x, y, (label == region).astype(float), levels=[0.5]).allsegs[0]
        rings.sort(key=lambda ring: -abs(_area(ring)))
        large = []
        for ring in rings:
            # Rings round holes run the other way: their area has the other sign.
            if _area(ring) / _area(rings[0]) > SMALLEST_RING_SHARE:
                large.append(ring)
        outlines.append(large)
    return outlines


def _sampled(shapes: Sequence[Points]) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 2) along the edges, and their edges (n,)."""

    def marks(length: float) -> np.ndarray:
        return np.linspace(0.0, length, max(2, int(length / POINT_SPACING_M) + 1))

    points = [points_along(shape, marks) for shape in shapes]
    return np.concatenate(points), np.arange(len(shapes)).repeat([*map(len, points)])


def _area(ring: Points) -> float:
    """Return the area [m^2] of a ring (n, 2) [m], < 0 if clockwise."""
    x, y = ring.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2
