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
from scipy.sparse.csgraph import breadth_first_order, connected_components

from cosim.importing.case import seconds
from cosim.sumo.arrays import EdgeMask, EdgeNumbers, PerEdge, Points
from cosim.sumo.net import for_cars, size
from cosim.sumo.xml_files import BROKEN, attribute, opened, read_xml
from nmfd.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Logic:
    """Signal programme.

    kind: SUMO's type, such as "static", or "branching" for a static one whose phases do not follow in order
    cycle [s]
    """

    signal: str
    programme: str
    kind: str
    cycle: float


@dataclass(frozen=True, kw_only=True)
class Streets:
    """Road graph of E normal edges, sorted by id, including those closed to cars.

    drivable: (E,) bool, with a lane for cars
    length [m], lanes (those for cars), speed [m/s]: (E,)
    shapes: E arrays (n, 2) [m]; centre: (E, 2) [m], half way along
    junctions: (E, 2), numbers of the junctions where the edge begins and ends; places: junction -> its number
    links: (L, 2) edges that a connection joins, both drivable, by lanes for cars; all_links: for any vehicle
    link_signals: L signals, of each of the links, None without one
    roundabouts: lists of edges
    logics: signal -> its programmes, the one that runs last
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
    places: Mapping[str, int]
    links: Int[np.ndarray, "L 2"]
    all_links: Int[np.ndarray, "_ 2"]
    link_signals: tuple[str | None, ...]
    roundabouts: tuple[tuple[int, ...], ...]
    logics: Mapping[str, tuple[Logic, ...]]
    left_hand: bool

    @cached_property
    def number(self) -> dict[str, int]:
        """Number of an edge in `edges`."""
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

    @cached_property
    def onward(self) -> EdgeMask:
        """Edges (E,) from which the core can be reached."""
        return self._reached(self.links[:, ::-1])

    @cached_property
    def reached(self) -> EdgeMask:
        """Edges (E,) that can be reached from the core."""
        return self._reached(self.links)

    def _reached(self, links: Int[np.ndarray, "L 2"]) -> EdgeMask:
        found = np.zeros(len(self.edges), dtype=bool)
        found[
            breadth_first_order(graph(links, len(self.edges)), int(np.argmax(self.core)), return_predecessors=False)
        ] = True
        return found

    def connected(self, pairs: Iterable[tuple[int, int]], *, cars: bool) -> dict[tuple[int, int], bool]:
        """Return pair -> a path leads from its first edge to its second, for cars, or for any vehicle."""
        onward = graph(self.links if cars else self.all_links, len(self.edges))
        wanted: dict[int, list[int]] = {}
        for first, last in sorted(set(pairs)):
            wanted.setdefault(first, []).append(last)
        found: dict[tuple[int, int], bool] = {}
        for first, ends in wanted.items():
            reached = np.zeros(len(self.edges), dtype=bool)
            reached[breadth_first_order(onward, first, return_predecessors=False)] = True
            found |= {(first, last): bool(reached[last]) for last in ends}
        return found

    def _largest(self, kind: str) -> EdgeMask:
        count, part = connected_components(graph(self.links, len(self.edges)), directed=True, connection=kind)
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


class _Link(NamedTuple):
    """Connection from a lane of one edge to a lane of another, and its signal."""

    source: str
    target: str
    lane: int
    to_lane: int
    signal: str | None


def read_streets(net: Path, additional: Iterable[Path] = ()) -> Streets:
    """Read a net.xml(.gz), and the signal programmes of additional files, which replace those of the network.

    Raises:
        InputError: for a file that is no network, or has no edge for cars.
    """
    rows: dict[str, _Edge] = {}
    links: list[_Link] = []
    roundabouts: list[list[str]] = []
    logics: dict[str, list[Logic]] = {}
    try:
        with opened(net) as stream:
            events = ElementTree.iterparse(stream, events=("start", "end"))
            (_, root), depth = next(events), 1
            if root.tag != "net":
                raise InputError(f"{net}: expected a SUMO network, got a file of <{root.tag}> instead")
            left_hand = root.get("lefthand") == "true"
            for event, element in events:
                depth += 1 if event == "start" else -1
                if event == "start" or depth != 1:
                    continue
                if element.tag == "edge" and element.get("function", "normal") in ("normal", "connector"):
                    rows[attribute(element, "id")] = _edge(element)
                elif element.tag == "connection" and not attribute(element, "from").startswith(":"):
                    links.append(
                        _Link(
                            attribute(element, "from"),
                            attribute(element, "to"),
                            int(attribute(element, "fromLane")),
                            int(attribute(element, "toLane")),
                            element.get("tl"),
                        )
                    )
                elif element.tag == "roundabout":
                    roundabouts.append(element.get("edges", "").split())
                elif element.tag == "tlLogic":
                    logics.setdefault(attribute(element, "id"), []).append(_logic(element, net))
                element.clear()
                root.clear()
    except BROKEN as error:
        raise InputError(f"{net}: is not a SUMO network ({error}); build it with netconvert") from None
    for path in additional:
        for element in read_xml(path).iter("tlLogic"):
            logic = _logic(element, path)
            logics.setdefault(logic.signal, []).append(logic)
    if not any(row.cars for row in rows.values()):
        raise InputError(f"{net}: has no edge that cars may use; give a road network")
    return _streets(net, rows, links, roundabouts, logics, left_hand)


def _edge(element: ElementTree.Element) -> _Edge:
    lanes = list(element.iter("lane"))
    cars = {int(attribute(lane, "index")): lane for lane in lanes if for_cars(lane)}
    lane = next(iter(cars.values()), lanes[0])
    shape = element.get("shape") or attribute(lanes[len(lanes) // 2], "shape")
    points = np.array([[float(x) for x in point.split(",")[:2]] for point in shape.split()])
    speed = max(size(lane, "speed") for lane in cars.values() or lanes)
    return _Edge(
        cars=frozenset(cars),
        length=size(lane, "length"),
        speed=speed,
        shape=points,
        start=attribute(element, "from"),
        end=attribute(element, "to"),
    )


def _logic(element: ElementTree.Element, path: Path) -> Logic:
    phases = list(element.iter("phase"))
    where = f"{path}: tlLogic {element.get('id')}: phase duration"
    kind = element.get("type", "static")
    if kind == "static" and any(phase.get("next") for phase in phases):
        kind = "branching"
    return Logic(
        signal=attribute(element, "id"),
        programme=element.get("programID", "0"),
        kind=kind,
        cycle=sum(seconds(phase.get("duration", "0"), where) for phase in phases),
    )


def _streets(
    net: Path,
    rows: Mapping[str, _Edge],
    links: Iterable[_Link],
    roundabouts: Iterable[Iterable[str]],
    logics: Mapping[str, list[Logic]],
    left_hand: bool,
) -> Streets:
    edges = tuple(sorted(rows))
    number = {edge: n for n, edge in enumerate(edges)}
    places: dict[str, int] = {}
    ends = np.array(
        [[places.setdefault(name, len(places)) for name in (rows[edge].start, rows[edge].end)] for edge in edges]
    )
    known = [link for link in links if link.source in number and link.target in number]
    every = sorted({(number[link.source], number[link.target]) for link in known})
    signal_of = {
        (number[link.source], number[link.target]): link.signal
        for link in known
        if link.lane in rows[link.source].cars and link.to_lane in rows[link.target].cars
    }
    cars = sorted(signal_of)
    shapes = tuple(rows[edge].shape for edge in edges)
    return Streets(
        path=net,
        edges=edges,
        drivable=np.array([bool(rows[edge].cars) for edge in edges]),
        length=np.array([rows[edge].length for edge in edges]),
        lanes=np.array([len(rows[edge].cars) for edge in edges]),
        speed=np.array([rows[edge].speed for edge in edges]),
        shapes=shapes,
        centre=np.array([_middle(shape) for shape in shapes]),
        junctions=ends,
        places=places,
        links=np.array(cars, dtype=int).reshape(-1, 2),
        all_links=np.array(every, dtype=int).reshape(-1, 2),
        link_signals=tuple(signal_of[pair] for pair in cars),
        roundabouts=tuple(tuple(number[e] for e in ring if e in number) for ring in roundabouts),
        logics={signal: tuple(found) for signal, found in sorted(logics.items())},
        left_hand=left_hand,
    )


def _middle(shape: Points) -> Float[np.ndarray, " 2"]:
    """Return the point half way along a line (n, 2)."""
    steps = np.hypot(*np.diff(shape, axis=0).T) if len(shape) > 1 else np.zeros(0)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    return np.array([np.interp(along[-1] / 2, along, shape[:, axis]) for axis in (0, 1)]) if along[-1] else shape[0]
