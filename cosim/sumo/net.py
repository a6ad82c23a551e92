"""A SUMO network cut into regions, and the gateways between them."""

import csv
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from cosim.sumo.arrays import PerEdge, PerMove, Points
from cosim.sumo.xml_files import attribute, last_change, network_root
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import config
from nmfd.runs.config import Settings, Text, setting
from nmfd.runs.files import check_file

JAM_SPACING = 7.5  # m of lane per standing vehicle
NORMAL = "normal", "connector"  # functions of edges outside junctions


class CityTable(Settings):
    """The table [sumo] of network.toml."""

    net: Text = setting("SUMO's network, relative to the folder of network.toml")
    regions: Text = setting("csv with the columns edge, region")


class CityFiles(NamedTuple):
    """The files of a city: SUMO's network, and the region of every edge."""

    net_file: Path
    regions_csv: Path


@dataclass(frozen=True, kw_only=True)
class Gateway:
    """A boundary movement: a turn from one region into another.

    source, target: regions
    from_edge, to_edge: last edge in `source`, first edge in `target`
    signal: the signal that controls all of the turn; None where it leaks
    links: indices of the turn in the signal's state
    lanes: numbers of the lanes of `from_edge` that lead over the boundary
    """

    source: int
    target: int
    from_edge: str
    to_edge: str
    signal: str | None
    links: tuple[int, ...]
    lanes: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class City:
    """A SUMO network cut into regions 0 .. regions - 1.

    It holds only what cars may use; `region_of` holds the other edges, too.

    region_of: normal or internal edge -> region; an internal edge belongs to the region that it
        leads to
    edges: normal edges, sorted
    length, lanes, speed, lane_ids: edge -> length (m), number of lanes, limit (m/s), ids of lanes
    successors: edge -> following edges, sorted
    turn_time: (from_edge, to_edge) -> free-flow time on the junction (s), up to where a turn waits
    gateways: sorted by source, target, from_edge, to_edge
    signals: edge -> signal at its end
    over: (from_edge, to_edge) -> internal edges of this turn, in order
    inside: internal edge of a turn -> length (m)
    """

    net_file: Path
    regions: int
    region_of: Mapping[str, int]
    edges: tuple[str, ...]
    length: Mapping[str, float]
    lanes: Mapping[str, int]
    lane_ids: Mapping[str, tuple[str, ...]]
    speed: Mapping[str, float]
    successors: Mapping[str, tuple[str, ...]]
    turn_time: Mapping[tuple[str, str], float]
    gateways: tuple[Gateway, ...]
    signals: Mapping[str, str]
    over: Mapping[tuple[str, str], tuple[str, ...]] = field(default_factory=dict)
    inside: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def number(self) -> dict[str, int]:
        """Map each edge to its place in `edges`."""
        return {edge: n for n, edge in enumerate(self.edges)}

    @cached_property
    def before(self) -> dict[str, list[str]]:
        """Map each edge to the edges that lead there, sorted."""
        before: dict[str, list[str]] = {edge: [] for edge in self.edges}
        for edge, after in self.successors.items():
            for other in after:
                before[other].append(edge)
        return before

    @cached_property
    def edge_region(self) -> np.ndarray:
        """Region of each edge (E,)."""
        return np.array([self.region_of[edge] for edge in self.edges])

    @cached_property
    def lane_metres(self) -> PerEdge:
        """Length times lanes of each edge (m, (E,))."""
        return np.array([self.length[edge] * self.lanes[edge] for edge in self.edges])

    @cached_property
    def free_time(self) -> PerEdge:
        """Free-flow time on each edge (s, (E,))."""
        return np.array([self.length[edge] / self.speed[edge] for edge in self.edges])

    @cached_property
    def moves(self) -> tuple[tuple[str, str], ...]:
        """All M pairs of an edge and a following one."""
        pairs = []
        for edge, after in self.successors.items():
            pairs += [(edge, other) for other in after]
        return tuple(pairs)

    @cached_property
    def move_edges(self) -> Int[np.ndarray, "M 2"]:
        """Numbers of the edges that each move joins."""
        numbers = [(self.number[edge], self.number[other]) for edge, other in self.moves]
        return np.array(numbers, dtype=int).reshape(-1, 2)

    @cached_property
    def move_time(self) -> PerMove:
        """Free-flow time of each move over its junction (s, (M,))."""
        return np.array([self.turn_time[move] for move in self.moves], dtype=float)

    @property
    def room(self) -> PerEdge:
        """Standing vehicles that fit on each edge (veh, (E,))."""
        return np.maximum(self.lane_metres / JAM_SPACING, 1.0)


class _Lane(NamedTuple):
    """A lane for cars: its length (m), speed limit (m/s) and id."""

    length: float
    speed: float
    id: str


class _Crossing(NamedTuple):
    """An internal edge of a junction: free-flow time on it (s), length (m)."""

    time: float
    length: float


class Connection(NamedTuple):
    """A connection from lane to lane.

    via: lane on the junction; None if there is none
    signal, link: the signal that controls it, and its index in the signal's state
    lane, to_lane: numbers of the lanes of `source` and `target`
    state: SUMO's letter of the right of way
    """

    source: str
    target: str
    via: str | None
    signal: str | None
    link: int
    lane: int
    to_lane: int
    state: str


class _Net(NamedTuple):
    """The content of a net.xml.

    lanes_of: normal edge -> its lanes for cars
    internal: internal edge -> its time and length
    """

    lanes_of: dict[str, list[_Lane]]
    internal: dict[str, _Crossing]
    connections: list[Connection]


def network_folder(network: RegionalModel) -> Path:
    """Return the folder of a network.

    Raises: InputError for a network that was not loaded from a file
    """
    if network.folder is None:
        raise InputError(
            f"network {network.name}: was not loaded from a folder; load it with load_network"
        )
    return network.folder


def city_files(network: RegionalModel) -> CityFiles:
    """Return the SUMO files of a network.

    Raises: InputError for a wrong table [sumo] or a missing file
    """
    folder = network_folder(network)
    path = folder / "network.toml"
    content = config.read(path)
    if "sumo" not in content:
        raise InputError(
            f"{path}: sumo: missing; this network has no city to simulate: use nmfd benchmark, or "
            "add [sumo] with net and regions"
        )
    table = config.checked(CityTable, content["sumo"], path, "sumo.")
    files = CityFiles(folder / table.net, folder / table.regions)
    for key, file in zip(("net", "regions"), files, strict=True):
        if not file.is_file():
            raise config.error(
                path, f"sumo.{key}", f"no such file: {file}; give the path of an existing one"
            )
    return files


def city_of(network: RegionalModel, opened: Collection[str] = ()) -> City:
    """Return the city of `network`; opened: as of `load_city`.

    Raises: InputError
    """
    return load_city(*city_files(network), network.regions, opened)


def load_city(
    net_file: Path, regions_csv: Path, regions: int, opened: Collection[str] = ()
) -> City:
    """Read a net.xml (or net.xml.gz) and the region of each of its edges.

    opened: edges that count as open to cars on all lanes, besides those that are

    Raises: InputError for a broken file, an unknown edge, an edge without a region, or a region
        without edges
    """
    net_file = Path(net_file)
    net = _net(net_file, opened)
    given = read_regions(Path(regions_csv), regions)
    edges = tuple(sorted(edge for edge, lanes in net.lanes_of.items() if lanes))
    for edge in given:
        if edge not in net.lanes_of and edge not in net.internal:
            raise InputError(
                f"{regions_csv}: edge {edge} is not in {net_file}; "
                "remove it or give the network it is of"
            )
    missing = [edge for edge in edges if edge not in given]
    if missing:
        raise InputError(
            f"{regions_csv}: edge {missing[0]} has no region ({len(missing)} such edges); "
            "add a line for every edge"
        )
    empty = set(range(regions)) - {given[edge] for edge in edges}
    if empty:
        raise InputError(
            f"{regions_csv}: region {min(empty)} has no edges; "
            f"every region from 0 to {regions - 1} needs one"
        )
    return _derived(net_file, net, edges, given, regions)


def _derived(
    net_file: Path, net: _Net, edges: tuple[str, ...], given: Mapping[str, int], regions: int
) -> City:
    """Return the city of a network whose edges have a region each.

    edges: those for cars, sorted; given: edge -> region, of others, too
    """
    region_of = {edge: given[edge] for edge in edges}
    for edge, region in given.items():
        if not edge.startswith(":"):
            region_of[edge] = region
    links = _links_for_cars(net)
    successors: dict[str, list[str]] = {edge: [] for edge in edges}
    for source, target in sorted({(link.source, link.target) for link in links}):
        successors[source].append(target)
    turn_time = {}
    for link in links:
        time = net.internal[stem(link.via)].time if link.via else 0.0
        turn_time[link.source, link.target] = time
    over = _turns_over_junctions(links, net.connections)
    inside = {}
    for edge in sorted(set().union(*over.values())):
        length = net.internal[edge].length
        if length > 0.0:
            inside[edge] = length
    lanes = {edge: net.lanes_of[edge] for edge in edges}
    return City(
        net_file=net_file,
        regions=regions,
        region_of=region_of | _internal_regions(net, region_of),
        edges=edges,
        length={edge: own[0].length for edge, own in lanes.items()},
        lanes={edge: len(own) for edge, own in lanes.items()},
        lane_ids={edge: tuple(lane.id for lane in own) for edge, own in lanes.items()},
        speed={edge: max(lane.speed for lane in own) for edge, own in lanes.items()},
        successors={edge: tuple(after) for edge, after in successors.items()},
        turn_time=turn_time,
        gateways=_gateways(links, region_of),
        signals={link.source: link.signal for link in links if link.signal},
        over=over,
        inside=inside,
    )


def check_adjacency(city: City, network: RegionalModel) -> None:
    """Raise InputError unless gateways join exactly the adjacent regions.

    Which regions are adjacent is in network.toml.
    """
    where = f"{network.folder}/network.toml: regions"
    joined = np.zeros((city.regions, city.regions), dtype=bool)
    for gateway in city.gateways:
        i = gateway.source
        h = gateway.target
        if not network.adjacency[i, h]:
            raise InputError(
                f"{where}[{i}].adjacent: region {h} is missing, although edge {gateway.from_edge} "
                f"leads to {gateway.to_edge}; add it, or move the edges to other regions"
            )
        joined[i, h] = True
    for i, h in np.argwhere(network.adjacency & ~joined):
        raise InputError(
            f"{where}[{i}].adjacent: lists {h}, but no edge leads from region {i} to region {h} "
            f"in {city.net_file}; remove it, or change the regions of edges"
        )


def edge_shapes(city: City) -> list[Points]:
    """Return the line of every edge on the map, (n, 2) (m).

    It lies midway between the outermost lanes for cars.
    """
    shapes = {}
    with network_root(city.net_file) as root:
        for edge in root.iterfind("edge"):
            lanes = [attribute(lane, "shape") for lane in edge.iter("lane") if for_cars(lane)]
            if not lanes:
                continue
            shape = points_of(lanes[0])
            last = points_of(lanes[-1])
            if len(shape) == len(last):
                shape = (shape + last) / 2
            shapes[attribute(edge, "id")] = shape
    return [shapes[edge] for edge in city.edges]


def points_of(shape: str) -> Points:
    """Return a line of a SUMO network, (n, 2) (m), without heights."""
    return np.array([point.split(",")[:2] for point in shape.split()], dtype=float)


def points_along(shape: Points, marks: Callable[[float], ArrayLike]) -> Float[np.ndarray, "*n 2"]:
    """Return points (..., 2) on a line.

    shape: the line (m, (n, 2))
    marks: length of the line (m) -> distances of the points from its beginning (m)
    """
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(shape, axis=0).T)))
    at = marks(float(along[-1]))
    return np.stack([np.interp(at, along, axis) for axis in shape.T], axis=-1)


def _net(path: Path, opened: Collection[str] = ()) -> _Net:
    """Return a SUMO network, read anew only if its file has changed.

    opened: as of `load_city`
    Raises: InputError
    """
    return _read_net(path, frozenset(opened), last_change(path))


@lru_cache(maxsize=2)  # a large city takes seconds
def _read_net(path: Path, opened: Collection[str], _: int) -> _Net:
    """Read a SUMO network.

    The last argument is the time of its file's last change, for the cache.
    """
    lanes_of: dict[str, list[_Lane]] = {}
    internal: dict[str, _Crossing] = {}
    connections = []
    with network_root(path) as root:
        for element in root.iterfind("edge"):
            edge = attribute(element, "id")
            rows = [lane for lane in element.iter("lane") if for_cars(lane)]
            if not rows and edge in opened:
                rows = list(element.iter("lane"))
            lanes = [
                _Lane(size(lane, "length"), size(lane, "speed"), attribute(lane, "id"))
                for lane in rows
            ]
            if element.get("function", "normal") in NORMAL:
                lanes_of[edge] = lanes
                continue
            times = [_Crossing(lane.length / lane.speed, lane.length) for lane in lanes]
            internal[edge] = max(times, default=_Crossing(0.0, 0.0))
        for element in root.iterfind("connection"):
            source = attribute(element, "from")
            via = element.get("via")
            if via and stem(via) not in internal:
                raise LookupError(f"connection from {source} by way of {via}: no such edge")
            connection = Connection(
                source=source,
                target=attribute(element, "to"),
                via=via,
                signal=element.get("tl"),
                link=int(element.get("linkIndex", "-1")),
                lane=int(attribute(element, "fromLane")),
                to_lane=int(attribute(element, "toLane")),
                state=element.get("state", "M"),
            )
            connections.append(connection)
    if not lanes_of:
        raise InputError(f"{path}: has no edges; build it with netconvert")
    return _Net(lanes_of, internal, connections)


def stem(name: str) -> str:
    """Return the edge of a lane, or the junction of an internal edge."""
    return name.rpartition("_")[0]


def size(lane: ElementTree.Element, name: str) -> float:
    """Return the length (m) or speed (m/s) of a <lane>.

    Raises: ValueError unless it is above 0 and finite
    """
    value = float(attribute(lane, name))
    if not 0.0 < value < math.inf:
        raise ValueError(
            f"lane {lane.get('id')}: {name}: expected a number above 0, got {value:g} instead"
        )
    return value


def for_cars(lane: ElementTree.Element) -> bool:
    """Return True if cars may use a <lane>."""
    cars = {"all", "passenger"}
    allowed = lane.get("allow")
    if allowed is not None:
        return bool(cars & set(allowed.split()))
    return not cars & set(lane.get("disallow", "").split())


def read_regions(path: Path, regions: int = 10**6) -> dict[str, int]:
    """Return edge -> region of a csv file with the columns edge,region.

    Raises: InputError, also for a region that is not less than `regions`
    """
    check_file(path, "give a table with the columns edge,region")
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            header, *rows = list(csv.reader(stream, skipinitialspace=True)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{path}: cannot be read ({error}); give a table with the columns edge,region"
        ) from None
    if header != ["edge", "region"]:
        raise InputError(
            f"{path}: line 1: expected edge,region, got {','.join(header) or 'nothing'} instead"
        )
    region_of = {}
    for number, row in enumerate(rows, start=2):
        if not row:
            continue
        if len(row) != 2 or not row[1].isdecimal() or len(row[1]) > 9 or int(row[1]) >= regions:
            raise InputError(
                f"{path}: line {number}: expected an edge and a region from 0 to {regions - 1}, "
                f"got {','.join(row)} instead"
            )
        if row[0] in region_of:
            raise InputError(
                f"{path}: line {number}: edge {row[0]} appears twice; remove one of the lines"
            )
        region_of[row[0]] = int(row[1])
    return region_of


def connections_for_cars(net_file: Path, opened: Collection[str] = ()) -> list[Connection]:
    """Return the connections from a lane for cars to a lane for cars.

    opened: as of `load_city`
    Raises: InputError
    """
    return _links_for_cars(_net(net_file, opened))


def _links_for_cars(net: _Net) -> list[Connection]:
    """Return the connections from a lane for cars to a lane for cars."""
    cars: set[str] = set()
    for lanes in net.lanes_of.values():
        cars.update(lane.id for lane in lanes)
    links = []
    for connection in net.connections:
        source_lane = f"{connection.source}_{connection.lane}"
        target_lane = f"{connection.target}_{connection.to_lane}"
        if source_lane in cars and target_lane in cars:
            links.append(connection)
    return links


def _internal_regions(net: _Net, region_of: Mapping[str, int]) -> dict[str, int]:
    """Return internal edge -> region of the edge that it leads to.

    An internal edge without cars gets the region of another one of its junction.
    """
    regions: dict[str, int] = {}
    for connection in net.connections:
        target = region_of.get(connection.target)
        if target is None:
            continue
        if connection.via:
            regions[stem(connection.via)] = target
        if connection.source.startswith(":"):
            regions[connection.source] = target
    of_junction: dict[str, int] = {}
    for edge, region in regions.items():
        of_junction.setdefault(stem(edge), region)
    return {edge: regions.get(edge, of_junction.get(stem(edge), 0)) for edge in net.internal}


def _turns_over_junctions(
    links: Sequence[Connection], connections: Sequence[Connection]
) -> dict[tuple[str, str], tuple[str, ...]]:
    """Return (from_edge, to_edge) -> internal edges in between.

    There are two if the turn waits in the middle of the junction.
    """
    onward = {}
    for connection in connections:
        if connection.source.startswith(":"):
            onward[f"{connection.source}_{connection.lane}"] = connection.via
    over: dict[tuple[str, str], tuple[str, ...]] = {}
    for link in links:
        way = []
        via = link.via
        while via:
            way.append(stem(via))
            via = onward.get(via)
        if way:
            over[link.source, link.target] = tuple(way)
    return over


def _gateways(links: Sequence[Connection], region_of: Mapping[str, int]) -> tuple[Gateway, ...]:
    """Return the links from region to region, those of a turn together."""
    movements: dict[tuple[int, int, str, str], list[Connection]] = {}
    for link in links:
        source = region_of[link.source]
        target = region_of[link.target]
        if source != target:
            movements.setdefault((source, target, link.source, link.target), []).append(link)
    gateways = []
    for (source, target, from_edge, to_edge), members in sorted(movements.items()):
        signals = {link.signal for link in members}
        gateway = Gateway(
            source=source,
            target=target,
            from_edge=from_edge,
            to_edge=to_edge,
            signal=signals.pop() if len(signals) == 1 else None,
            links=tuple(sorted(link.link for link in members if link.signal)),
            lanes=tuple(sorted({link.lane for link in members})),
        )
        gateways.append(gateway)
    return tuple(gateways)


def gateway_movements(city: City) -> dict[str, dict[int, int]]:
    """Return signal -> link index -> number of the gateway.

    Only links that lead over a boundary are there.
    """
    movements: dict[str, dict[int, int]] = {}
    for number, gateway in enumerate(city.gateways):
        if gateway.signal is not None:
            movements.setdefault(gateway.signal, {}).update(dict.fromkeys(gateway.links, number))
    return movements


def gateway_room_taken(
    edge_vehicles: Float[np.ndarray, "*intervals E"], city: City
) -> Float[np.ndarray, "*intervals G"]:
    """Return the taken share of the room before each gateway, (..., G).

    edge_vehicles: vehicles on each edge (veh, (..., E))
    """
    before = [city.number[gateway.from_edge] for gateway in city.gateways]
    return edge_vehicles[..., before] / city.room[before]
