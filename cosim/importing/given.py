"""Regions of the user's own: an edge list, a TAZ file or polygons."""

import csv
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from matplotlib.path import Path as Outline

from cosim.importing.layers import area
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers
from cosim.sumo.xml_files import read_xml
from nmfd.errors import InputError
from nmfd.runs.files import check_file


def read_given(streets: Streets, path: Path, method: str) -> EdgeNumbers:
    """(E,) region of every edge, -1 where the file names none. Raises InputError.

    method: "edges", a csv with the columns edge,region, regions from 0 without a gap; "taz" and "polygons", additional
    files, whose n-th TAZ or polygon is region n; polygons of one name but for what follows a dot are one region.
    """
    labels = {"edges": _edges, "taz": _taz, "polygons": _polygons}[method](streets, path)
    used = np.unique(labels[streets.drivable & (labels >= 0)])
    if len(used) < 2:
        raise InputError(f"{path}: gives streets to {len(used)} region(s); expected two or more")
    if missing := set(range(int(labels.max()) + 1)) - set(used.tolist()):
        raise InputError(f"{path}: region {min(missing)} has no edge that cars may use; remove it or give it one")
    return labels


def _edges(streets: Streets, path: Path) -> np.ndarray:
    check_file(path, "give a csv with the columns edge,region")
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:  # spreadsheets begin with a mark
            rows = [(number, row) for number, row in enumerate(csv.reader(stream), start=1) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); give a csv with the columns edge,region") from None
    if not rows or [cell.strip() for cell in rows[0][1]] != ["edge", "region"]:
        raise InputError(
            f"{path}: line 1: expected edge,region, got {','.join(rows[0][1]) if rows else 'nothing'} instead"
        )
    labels = np.full(len(streets.edges), -1)
    for number, row in rows[1:]:
        if len(row) != 2 or not row[1].strip().isdecimal() or len(row[1].strip()) > 6:
            raise InputError(
                f"{path}: line {number}: expected an edge and a region from 0 up, got {','.join(row)} instead"
            )
        _assign(labels, streets, row[0].strip(), int(row[1]), f"{path}: line {number}")
    return labels


def _taz(streets: Streets, path: Path) -> np.ndarray:
    labels, zones = np.full(len(streets.edges), -1), list(read_xml(path).iter("taz"))
    for region, zone in enumerate(zones):
        edges = zone.get("edges", "").split() + [
            part.get("id", "") for part in zone if part.tag in ("tazSource", "tazSink")
        ]
        for edge in dict.fromkeys(edges):
            _assign(labels, streets, edge, region, f"{path}: taz {zone.get('id')}")
    if not zones:
        raise InputError(f"{path}: has no taz; give an additional file with one per region")
    return labels


def _assign(labels: np.ndarray, streets: Streets, edge: str, region: int, where: str) -> None:
    if edge.startswith(":"):  # junctions follow the edges around them
        return
    if edge not in streets.number:
        raise InputError(f"{where}: edge {edge} is not in {streets.path}; remove it or give the network it is of")
    n = streets.number[edge]
    if labels[n] not in (-1, region):
        raise InputError(f"{where}: edge {edge} is in region {labels[n]} too; leave it in one")
    labels[n] = region


def _polygons(streets: Streets, path: Path) -> np.ndarray:
    """An edge is in the region in which its middle lies; the smallest polygon counts where several do."""
    labels = np.full(len(streets.edges), -1)
    regions: dict[str, int] = {}
    found: list[tuple[float, int, int, np.ndarray]] = []
    for polygon in read_xml(path).iter("poly"):
        region = regions.setdefault(polygon.get("id", "").partition(".")[0], len(regions))
        corners = _corners(polygon, path, streets)
        found.append((abs(area(corners)), len(found), region, corners))
    for _, _, region, corners in sorted(found, key=lambda polygon: polygon[:2]):
        labels[Outline(corners).contains_points(streets.centre) & (labels < 0)] = region
    if not regions:
        raise InputError(f"{path}: has no poly; give an additional file with one or more per region")
    return labels


def _corners(polygon: Element, path: Path, streets: Streets) -> np.ndarray:
    where = f"{path}: poly {polygon.get('id')}"
    if polygon.get("geo") in ("true", "1"):
        raise InputError(f"{where}: has longitudes and latitudes; convert it to the network's metres with polyconvert")
    try:
        corners = np.array([[float(x) for x in point.split(",")[:2]] for point in polygon.get("shape", "").split()])
        if corners.ndim != 2 or len(corners) < 3:
            raise ValueError
    except ValueError:
        raise InputError(f"{where}: shape: expected three or more corners x,y; correct it") from None
    return corners
