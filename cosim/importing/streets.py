"""Road graph of a SUMO network as arrays, with signal programmes."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from cosim.importing.case import seconds
from cosim.sumo import signals
from cosim.sumo.arrays import EdgeMask, EdgeNumbers, PerEdge, Points
from cosim.sumo.net import NORMAL, for_cars, points_along, points_of, size, stem
from cosim.sumo.xml_files import attribute, network_root, read_xml
from nmfd.errors import InputError

Pairs = Int[np.ndarray, "_ 2"]
LinkMask = Bool[np.ndarray, " L"]


@dataclass(frozen=True, kw_only=True)
class Logic(signals.Logic):
    """Signal programme with its cycle [s].

    kind: SUMO's type, or "branching" if phases do not follow in order
    """

    cycle: float


class Inside(NamedTuple):
    """An internal edge of a junction.

    before: edge that it comes from
    length: (m)
    """

    before: str
    length: float


@dataclass(frozen=True, kw_only=True)
class Streets:
    """Road graph of E normal edges, sorted by id.

    It includes those closed to cars.
    drivable: (E,) bool, with a lane for cars
    length [m], lanes (those for cars), speed [m/s]: (E,)
    shapes: E arrays (n, 2) [m]; centre: (E, 2) [m], half way along
    junctions: (E, 2), numbers of the junctions where the edge begins and ends
    inside: internal edge -> what it comes from
    links: (L, 2) edges that a connection joins, both drivable, by lanes for cars
    all_links: the same for any vehicle
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
    inside: Mapping[str, Inside]
    links: Int[np.ndarray, "L 2"]
    all_links: Pairs
    link_signals: tuple[str | None, ...]
    roundabouts: tuple[tuple[int, ...], ...]
    logics: Mapping[str, Logic]
    left_hand: bool

    @cached_property
    def number(self) -> dict[str, int]:
        """Edge -> its number."""
        return {edge: n for n, edge in enumerate(self.edges)}

    @property
    def lane_metres(self) -> PerEdge:
        """Length times lanes for cars (E,) [m]."""
        return self.length * self.lanes

    @property
    def signalled(self) -> LinkMask:
        """Links that have a signal (L,)."""
        return np.array([signal is not None for signal in self.link_signals], dtype=bool)

    def controllable(self, left_alone: Collection[str]) -> LinkMask:
        """Return the links (L,) that perimeter control can hold.

        left_alone: signals that it does not use
        """
        signals = [signal and signal not in left_alone for signal in self.link_signals]
        return np.array(signals, dtype=bool)

    @property
    def main_links(self) -> Pairs:
        """Links within the main part."""
        return self.links[self.main_part[self.links].all(axis=1)]

    def joins(self, labels: EdgeNumbers) -> csr_array:
        """Return the number of links (U, U) that join two of U labels.

        Either way counts.

        labels: (E,), -1 for none
        """
        ends = labels[self.links]
        ends = ends[(ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])]
        found = graph(np.concatenate([ends, ends[:, ::-1]]), int(labels.max()) + 1)
        found.sum_duplicates()
        return found

    @property
    def parts(self) -> int:
        """Number of parts into which the drivable edges fall."""
        _, part = connected_components(graph(self.links, len(self.edges)), directed=False)
        return len(np.unique(part[self.drivable]))

    @cached_property
    def main_part(self) -> EdgeMask:
        """Drivable edges (E,) of the largest weakly connected part.

        That is the one with the most lane metres.
        """
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


def graph(pairs: Pairs, size: int) -> csr_array:
    """Return a matrix (size, size) with a one for every pair (n, 2)."""
    return csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))


class _Edge(NamedTuple):
    """Edge of the file.

    cars: indices of the lanes for them; start, end: junctions
    """

    cars: frozenset[int]
    length: float
    speed: float
    shape: Points
    start: str
    end: str


def read_streets(net: Path, additional: Iterable[Path] = ()) -> Streets:
    """Read a net.xml(.gz), and signal programmes of additional files.

    The latter replace those of the network.
    Raises: InputError
    """
    rows = {}
    internal = {}
    links: list[Mapping[str, str]] = []
    roundabouts: list[list[str]] = []
    logics = {}
    with network_root(net) as root:
        for element in root:
            if element.tag == "edge" and element.get("function", "normal") in NORMAL:
                rows[attribute(element, "id")] = _edge(element)
            elif element.tag == "edge" and element.get("function") == "internal":
                internal[attribute(element, "id")] = size(next(element.iter("lane")), "length")
            elif element.tag == "connection":
                for name in ("from", "to", "fromLane", "toLane"):
                    attribute(element, name)
                links.append(element.attrib)
            elif element.tag == "roundabout":
                roundabouts.append(element.get("edges", "").split())
            elif element.tag == "tlLogic":
                logics[attribute(element, "id")] = _logic(element, net)
    for path in additional:
        for element in read_xml(path).iter("tlLogic"):
            signal = element.get("id")
            if signal is None:
                raise InputError(f"{path}: tlLogic: id: missing; add that of a signal")
            logics[signal] = _logic(element, path)
    if not any(row.cars for row in rows.values()):
        raise InputError(f"{net}: has no edge that cars may use; give a road network")
    left_hand = root.get("lefthand") == "true"
    return _from_rows(net, rows, internal, links, roundabouts, logics, left_hand=left_hand)


def numbers_of(edges: pd.Series, streets: Streets, path: Path) -> pd.Series:
    """Return the numbers of edges that a file names. Raises InputError."""
    numbers = edges.map(streets.number)
    unknown = edges[numbers.isna()]
    if len(unknown):
        raise InputError(
            f"{path}: edge {unknown.iloc[0]} is not in {streets.path}; give the network it is of"
        )
    return numbers.astype(int)


def _from_rows(
    path: Path,
    rows: Mapping[str, _Edge],
    internal: Mapping[str, float],
    links: Iterable[Mapping[str, str]],
    roundabouts: Iterable[Sequence[str]],
    logics: Mapping[str, Logic],
    *,
    left_hand: bool,
) -> Streets:
    """Return the streets of a network.

    rows: id -> edge; internal: id -> length (m); links: attributes of connections; roundabouts:
        their edges
    """
    edges = tuple(sorted(rows))
    number = {edge: n for n, edge in enumerate(edges)}
    own = [rows[edge] for edge in edges]
    pairs: set[tuple[int, int]] = set()
    inside: dict[str, Inside] = {}
    signal_of: dict[tuple[int, int], str | None] = {}  # pair of edges, for cars -> signal
    for link in links:
        source = link["from"]
        target = link["to"]
        way = stem(link.get("via", ""))
        if way in internal and source in number:
            inside[way] = Inside(source, internal[way])
        elif way in internal and source in inside:  # after a halt on the junction
            inside[way] = Inside(inside[source].before, internal[way])
        if source not in number or target not in number:
            continue
        pair = number[source], number[target]
        pairs.add(pair)
        from_cars = int(link["fromLane"]) in rows[source].cars
        if from_cars and int(link["toLane"]) in rows[target].cars:
            signal_of[pair] = link.get("tl")
    car_links = sorted(signal_of)
    _, junctions = np.unique([(row.start, row.end) for row in own], return_inverse=True)
    rings = []
    for ring in roundabouts:
        rings.append(tuple(number[edge] for edge in ring if edge in number))
    return Streets(
        path=path,
        edges=edges,
        drivable=np.array([bool(row.cars) for row in own]),
        length=np.array([row.length for row in own]),
        lanes=np.array([len(row.cars) for row in own]),
        speed=np.array([row.speed for row in own]),
        shapes=tuple(row.shape for row in own),
        centre=np.array([points_along(row.shape, lambda length: length / 2) for row in own]),
        junctions=junctions.reshape(-1, 2),
        inside=inside,
        links=np.array(car_links, dtype=int).reshape(-1, 2),
        all_links=np.array(sorted(pairs), dtype=int).reshape(-1, 2),
        link_signals=tuple(signal_of[pair] for pair in car_links),
        roundabouts=tuple(rings),
        logics=dict(sorted(logics.items())),
        left_hand=left_hand,
    )


def _edge(element: ElementTree.Element) -> _Edge:
    lanes = list(element.iter("lane"))
    car_lanes = [lane for lane in lanes if for_cars(lane)]
    shape = element.get("shape") or attribute(lanes[len(lanes) // 2], "shape")
    return _Edge(
        cars=frozenset(int(attribute(lane, "index")) for lane in car_lanes),
        length=size((car_lanes or lanes)[0], "length"),
        speed=max(size(lane, "speed") for lane in car_lanes or lanes),
        shape=points_of(shape),
        start=attribute(element, "from"),
        end=attribute(element, "to"),
    )


def _logic(element: ElementTree.Element, path: Path) -> Logic:
    where = f"{path}: tlLogic {element.get('id')}: phase duration"
    cycle = sum(seconds(phase.get("duration", "0"), where) for phase in element.iter("phase"))
    return Logic(**vars(signals.logic_of(element)), cycle=cycle)
