"""Regions as SUMO files that sumo-gui and netedit show: a TAZ file and a polygon file."""

import io
from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers, Points

CELLS = 160  # along the longer side of the map
SPACING = 40.0  # m between the points that stand for an edge
COLOURS = ("#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#76b7b2", "#b07aa1", "#edc948", "#9c755f", "#ff9da7", "#8cd17d")


def colour(region: int) -> str:
    """The colour of a region on maps, as #rrggbb."""
    return COLOURS[region % len(COLOURS)]


def taz_xml(streets: Streets, regions: EdgeNumbers, names: tuple[str, ...]) -> str:
    """An additional file with a TAZ per region, of all its edges."""
    out = io.StringIO()
    out.write("<additional>\n")
    for region, name in enumerate(names):
        edges = " ".join(streets.edges[n] for n in np.flatnonzero(regions == region))
        out.write(
            f'  <taz id="region{region}" name={quoteattr(name)} color="{_rgb(region)}" edges={quoteattr(edges)}/>\n'
        )
    out.write("</additional>\n")
    return out.getvalue()


def polygons_xml(streets: Streets, regions: EdgeNumbers, names: tuple[str, ...]) -> str:
    """An additional file with the outline of every region; one of several parts has several polygons."""
    out = io.StringIO()
    out.write("<additional>\n")
    for region, rings in enumerate(outlines(streets, regions)):
        for n, ring in enumerate(rings):
            shape = " ".join(f"{x:.1f},{y:.1f}" for x, y in ring)
            mark = f"region{region}" + (f".{n}" if n else "")
            out.write(
                f'  <poly id="{mark}" type={quoteattr(names[region])} color="{_rgb(region)},90" fill="1" '
                f'layer="-1" shape="{shape}"/>\n'
            )
    out.write("</additional>\n")
    return out.getvalue()


def outlines(streets: Streets, regions: EdgeNumbers) -> list[list[Points]]:
    """Rings (n, 2) [m] round every region, the largest first: the places nearer to its streets than to others'."""
    return rings_round(streets.shapes, streets.drivable, regions)


def rings_round(
    shapes: Sequence[Points], members: np.ndarray, regions: EdgeNumbers, blocks: float = 0.0
) -> list[list[Points]]:
    """The same of `members`, (E,) bool, of some edges: E `shapes` (n, 2) [m], and their `regions`.

    blocks: the share of the map's extent that is between streets and still no hole
    """
    points, of = sampled(shapes, members)
    low, high = points.min(axis=0), points.max(axis=0)
    cell = max(float((high - low).max()) / CELLS, 1.0)
    # Beyond, a place belongs to no street; the map must end there, or rings stay open.
    reach = max(2.5 * max(cell, SPACING), blocks * float((high - low).max()))
    x, y = (np.arange(low[a] - reach - 2 * cell, high[a] + reach + 3 * cell, cell) for a in (0, 1))
    distance, nearest = cKDTree(points).query(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    label = np.where(distance < reach, regions[of[nearest]], -1).reshape(len(y), len(x))
    ax = Figure().subplots()
    found = []
    for region in range(int(regions.max()) + 1):
        rings = ax.contour(x, y, (label == region).astype(float), levels=[0.5]).allsegs[0]
        rings.sort(key=lambda ring: -abs(area(ring)))
        rings = [ring for ring in rings if area(ring) * area(rings[0]) > 0]  # the others run round holes
        found.append([ring for ring in rings if area(ring) / area(rings[0]) > 0.02])
    return found


def sampled(shapes: Sequence[Points], members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) points along the shapes of some edges, and (n,) the edges they stand for."""
    points, of = [], []
    for n in np.flatnonzero(members):
        shape = shapes[n]
        steps = np.hypot(*np.diff(shape, axis=0).T) if len(shape) > 1 else np.zeros(0)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        marks = np.linspace(0.0, along[-1], max(2, int(along[-1] / SPACING) + 1))
        points.append(np.stack([np.interp(marks, along, shape[:, axis]) for axis in (0, 1)], axis=1))
        of.append(np.full(len(marks), n))
    return np.concatenate(points), np.concatenate(of)


def area(ring: Points) -> float:
    """[m^2] of a polygon (n, 2) [m]; negative if it runs clockwise."""
    x, y = ring[:, 0], ring[:, 1]
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2


def _rgb(region: int) -> str:
    text = colour(region)
    return ",".join(str(int(text[n : n + 2], 16)) for n in (1, 3, 5))
