"""SUMO's edgeData: what happened on every edge in every interval."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from cosim.sumo.xml_files import attribute, seconds_of, stream_of
from nmfd.errors import InputError

KIND = "SUMO's edgeData"
REMEDY = (
    'put <edgeData id="all" freq="300" file="edges.xml"/> into an additional file of SUMO, and '
    "give what it writes"
)
ON_JUNCTION = ":"  # how ids of internal edges begin


class EdgeRow(NamedTuple):
    """One edge in one interval.

    begin, end: of the interval (s)
    density: of all lanes (veh/km)
    distance: driven by all vehicles there (veh m)
    entered, left: vehicles that came from another edge, and went on to another one
    arrived: vehicles that ended their trip there
    """

    begin: float
    end: float
    edge: str
    density: float
    distance: float
    entered: float
    left: float
    arrived: float


def read_edge_data(
    path: Path, needed: str = "sampledSeconds", *, junctions: bool = False
) -> pd.DataFrame:
    """Return edges as rows with the columns of EdgeRow.

    density and distance count a vehicle where its front is; sampledSeconds counts it on every edge
    that it covers.

    needed: attribute that every edge must have
    junctions: with internal edges

    Raises: InputError for another file, or overlapping intervals
    """
    rows = []
    last = -float("inf")
    with stream_of(path, KIND, REMEDY) as stream:
        events = ElementTree.iterparse(stream, events=("start", "end"))
        _, root = next(events)
        if root.tag != "meandata":
            raise ValueError(f"expected <meandata>, got a file of <{root.tag}> instead")
        for event, element in events:
            if event == "start" or element.tag != "interval":
                continue
            begin = seconds_of(attribute(element, "begin"))
            end = seconds_of(attribute(element, "end"))
            if begin < last or end <= begin:
                raise ValueError(f"interval of {begin:g} s to {end:g} s begins before {last:g} s")
            last = end
            for edge in element.iter("edge"):
                if junctions or not attribute(edge, "id").startswith(ON_JUNCTION):
                    attribute(edge, needed)
                    rows.append(_row(edge, begin, end))
            element.clear()
    if not rows:
        raise InputError(f"{path}: has no edges; {REMEDY}")
    return pd.DataFrame(rows)


def _row(edge: ElementTree.Element, begin: float, end: float) -> EdgeRow:
    """Return an <edge>; attributes that are not there are 0.

    Raises: ValueError for a time without a density, or without a distance and a speed
    """
    density = 0.0
    distance = 0.0
    time = float(edge.get("sampledSeconds", 0.0))
    if time > 0.0:
        density = float(attribute(edge, "density"))
        if "distance" in edge.attrib:
            distance = float(attribute(edge, "distance"))
        else:  # of an older SUMO
            distance = time * float(attribute(edge, "speed"))
    return EdgeRow(
        begin=begin,
        end=end,
        edge=attribute(edge, "id"),
        density=density,
        distance=distance,
        entered=float(edge.get("entered", 0.0)),
        left=float(edge.get("left", 0.0)),
        arrived=float(edge.get("arrived", 0.0)),
    )
