"""Road graph of a SUMO network as arrays, with shapes and signal programmes."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from cosim.importing.case import seconds
from cosim.sumo import signals
from cosim.sumo.arrays import EdgeMask, EdgeNumbers, PerEdge, Points
from cosim.sumo.net import NORMAL, for_cars, points_along, size
from cosim.sumo.xml_files import attribute, network_root, read_xml
from nmfd.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Logic(signals.Logic):
    """Signal programme with its cycle [s]; kind: SUMO's type, or "branching" if phases do not
    follow in order."""

    cycle: float


@dataclass(frozen=True, kw_only=True)
class Streets:
    """Road graph of E normal edges, sorted by id, including those closed to cars.

    drivable: (E,) bool, with a lane for cars
    length [m], lanes (those for cars), speed [m/s]: (E,)
    shapes: E arrays (n, 2) [m]; centre: (E, 2) [m], half way along
    junctions: (E, 2), numbers of the junctions where the edge begins and ends
    links: (L, 2) edges that a connection joins, both drivable, by lanes for cars; all_links: for
        any vehicle
    link_signals: L signals, of each of the links, None without one
    roundabouts: lists of edges
    logics: signal -> the programme that runs, which is the last one
    left_hand: the traffic keeps left
    """

    path: Path
    edges: tuple[str, ...]
    drivable: EdgeMask
    length: PerEdge
    lanes: EdgeNumbers
    speed: PerEdge
    shapes: tuple[Points, ...]
    centre: Float[np.ndarray, "E 2"]
    junctions: Int[np.ndarray, "E 2"]
    links: Int[np.ndarray, "L 2"]
    all_links: Int[np.ndarray, "_ 2"]
    link_signals: tuple[str | None, ...]
    roundabouts: tuple[tuple[int, ...], ...]
    logics: Mapping[str, Logic]
    left_hand: bool

    @cached_property
    def number(self) -> dict[str, int]:
        return {edge: n for n, edge in enumerate(self.edges)}

    @property
    def lane_metres(self) -> PerEdge:
        """Length times lanes for cars (E,) [m]."""
        return self.length * self.lanes

    @cached_property
    def main_part(self) -> EdgeMask:
        """Drivable edges (E,) of the weakly connected part with the most lane metres."""
        return self._largest("weak")

    @cached_property
    def core(self) -> EdgeMask:
        """Largest set of edges (E,) of which each can be reached from each."""
        return self._largest("strong")

    def _largest(self, kind: str) -> EdgeMask:
        count, part = connected_components(
            graph(self.links, len(self.edges)), directed=True, connection=kind
        )
        weight = np.bincount(part, self.lane_metres * self.drivable, count)
        return (part == np.argmax(weight)) & self.drivable


def graph(pairs: Int[np.ndarray, "_ 2"], size: int) -> csr_array:
    """Return a matrix (size, size) with a one for every pair (n, 2)."""
    return csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))


class _Edge(NamedTuple):
    """Edge of the file; cars: indices of the lanes for them; start, end: junctions."""

    cars: frozenset[int]
    length: float
    speed: float
    shape: Points
    start: str
    end: str


def read_streets(net: Path, additional: Iterable[Path] = ()) -> Streets:
    """Read a net.xml(.gz), and signal programmes of additional files, which replace those there.
    Raises InputError."""
    with network_root(net) as root:
        normal = (
            edge for edge in root.iterfind("edge") if edge.get("function", "normal") in NORMAL
        )
        rows = {attribute(edge, "id"): _edge(edge) for edge in normal}
        links = [
            link.attrib
            for link in root.iterfind("connection")
            if not attribute(link, "from").startswith(":")
        ]
        roundabouts = [ring.get("edges", "").split() for ring in root.iterfind("roundabout")]
        logics = {
            attribute(element, "id"): _logic(element, net) for element in root.iterfind("tlLogic")
        }
    for path in additional:
        logics |= {
            attribute(element, "id"): _logic(element, path)
            for element in read_xml(path).iter("tlLogic")
        }
    if not any(row.cars for row in rows.values()):
        raise InputError(f"{net}: has no edge that cars may use; give a road network")
    edges = tuple(sorted(rows))
    number = {edge: n for n, edge in enumerate(edges)}
    ends = np.array([(rows[edge].start, rows[edge].end) for edge in edges])
    every, signal_of = set(), {}
    for link in links:
        if link["from"] in number and link["to"] in number:
            pair = number[link["from"]], number[link["to"]]
            every.add(pair)
            if (
                int(link["fromLane"]) in rows[link["from"]].cars
                and int(link["toLane"]) in rows[link["to"]].cars
            ):
                signal_of[pair] = link.get("tl")
    cars = sorted(signal_of)
    return Streets(
        path=net,
        edges=edges,
        drivable=np.array([bool(rows[edge].cars) for edge in edges]),
        length=np.array([rows[edge].length for edge in edges]),
        lanes=np.array([len(rows[edge].cars) for edge in edges]),
        speed=np.array([rows[edge].speed for edge in edges]),
        shapes=tuple(rows[edge].shape for edge in edges),
        centre=np.array(
            [points_along(rows[edge].shape, lambda length: length / 2) for edge in edges]
        ),
        junctions=np.unique(ends, return_inverse=True)[1].reshape(-1, 2),
        links=np.array(cars, dtype=int).reshape(-1, 2),
        all_links=np.array(sorted(every), dtype=int).reshape(-1, 2),
        link_signals=tuple(signal_of[pair] for pair in cars),
        roundabouts=tuple(tuple(number[e] for e in ring if e in number) for ring in roundabouts),
        logics=dict(sorted(logics.items())),
        left_hand=root.get("lefthand") == "true",
    )


def _edge(element: ElementTree.Element) -> _Edge:
    lanes = list(element.iter("lane"))
    cars = {int(attribute(lane, "index")): lane for lane in lanes if for_cars(lane)}
    shape = element.get("shape") or attribute(lanes[len(lanes) // 2], "shape")
    return _Edge(
        cars=frozenset(cars),
        length=size(next(iter(cars.values()), lanes[0]), "length"),
        speed=max(size(lane, "speed") for lane in cars.values() or lanes),
        shape=np.array([[float(x) for x in point.split(",")[:2]] for point in shape.split()]),
        start=attribute(element, "from"),
        end=attribute(element, "to"),
    )


def _logic(element: ElementTree.Element, path: Path) -> Logic:
    phases = list(element.iter("phase"))
    where = f"{path}: tlLogic {element.get('id')}: phase duration"
    kind = element.get("type", "static")
    if kind == "static" and any(phase.get("next") for phase in phases):
        kind = "branching"
    cycle = sum(seconds(phase.get("duration", "0"), where) for phase in phases)
    states = tuple(phase.get("state", "") for phase in phases)
    return Logic(programme=element.get("programID", "0"), kind=kind, cycle=cycle, states=states)
