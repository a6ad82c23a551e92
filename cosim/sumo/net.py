"""A SUMO network cut into regions: edge -> region, and the gateways between regions."""

import csv
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from cosim.sumo.arrays import PerEdge, Points
from cosim.sumo.xml_files import attribute, network_root
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
    """A boundary movement from an edge in region `source` over a junction to an edge in region
    `target`.

    signal: the one that controls all of it, None where it leaks; links: its indices in the
        signal's state
    lanes: numbers of those that it comes from
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
    """A SUMO network cut into regions 0 .. regions - 1; only what cars may use, except in
    region_of.

    edges: normal ones, sorted; length [m], lanes, speed [m/s], lane_ids: by these
    region_of: normal and internal edge -> region; an internal edge has that of the edge that it
        leads to
    successors: edge -> following edges, sorted
    turn_time: (from_edge, to_edge) -> free-flow time on the junction [s], as far as where a turn
        waits
    over: (from_edge, to_edge) -> internal edges of this turn, in order; inside: internal edge of a
        turn -> length [m]
    gateways: sorted by source, target, from_edge, to_edge; signals: edge -> signal at its end
    number: edge -> its place in `edges`; before: edge -> edges that lead there, sorted
    edge_region, lane_metres, room: by number, (E,) the region, length times lanes [m], and [veh] at
        JAM_SPACING
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
        return {edge: n for n, edge in enumerate(self.edges)}

    @cached_property
    def before(self) -> dict[str, list[str]]:
        before: dict[str, list[str]] = {edge: [] for edge in self.edges}
        for edge, after in self.successors.items():
            for other in after:
                before[other].append(edge)
        return before

    @cached_property
    def edge_region(self) -> np.ndarray:
        return np.array([self.region_of[edge] for edge in self.edges])

    @cached_property
    def lane_metres(self) -> PerEdge:
        return np.array([self.length[edge] * self.lanes[edge] for edge in self.edges])

    @property
    def room(self) -> PerEdge:
        return np.maximum(self.lane_metres / JAM_SPACING, 1.0)


_Lane: TypeAlias = tuple[float, float, str]  # length [m], speed [m/s], id


class _Connection(NamedTuple):
    """A link from lane to lane; via: lane on the junction; link: index in the signal's state."""

    source: str
    target: str
    via: str | None
    signal: str | None
    link: int
    lane: int
    to_lane: int


def network_folder(network: RegionalModel) -> Path:
    """Return the folder of `network`. Raises InputError for one that was not loaded from a file."""
    if network.folder is None:
        raise InputError(
            f"network {network.name}: was not loaded from a folder; load it with load_network"
        )
    return network.folder


def city_files(network: RegionalModel) -> CityFiles:
    """Return the SUMO files of `network`. Raises InputError for a wrong table [sumo] or a missing
    file."""
    folder = network_folder(network)
    path = folder / "network.toml"
    content = config.read(path)
    if "sumo" not in content:
        what = "this network has no city to simulate: use nmfd benchmark, or add [sumo] with net and regions"
        raise InputError(f"{path}: sumo: missing; {what}")
    table = config.checked(CityTable, content["sumo"], path, "sumo.")
    files = CityFiles(folder / table.net, folder / table.regions)
    for key, file in zip(("net", "regions"), files, strict=True):
        if not file.is_file():
            raise config.error(
                path, f"sumo.{key}", f"no such file: {file}; give the path of an existing one"
            )
    return files


def city_of(network: RegionalModel) -> City:
    """Return the city of `network`. Raises InputError."""
    return load_city(*city_files(network), network.regions)


def load_city(net_file: Path, regions_csv: Path, regions: int) -> City:
    """Read a net.xml (or net.xml.gz) and the region of each of its edges.

    Raises InputError for a broken file, an unknown edge, an edge without a region and a region
    without edges.
    """
    lanes_of, internal, connections = _read_net(Path(net_file))
    given = read_regions(Path(regions_csv), regions)
    for edge in given:
        if edge not in lanes_of and edge not in internal:
            raise InputError(
                f"{regions_csv}: edge {edge} is not in {net_file}; remove it or give the network it is of"
            )
    edges = tuple(sorted(edge for edge, lanes in lanes_of.items() if lanes))
    if missing := [edge for edge in edges if edge not in given]:
        raise InputError(
            f"{regions_csv}: edge {missing[0]} has no region ({len(missing)} such edges); add a line for every edge"
        )
    if empty := set(range(regions)) - {given[edge] for edge in edges}:
        raise InputError(
            f"{regions_csv}: region {min(empty)} has no edges; every region from 0 to {regions - 1} needs one"
        )
    cars = {lane for lanes in lanes_of.values() for _, _, lane in lanes}
    links = [
        c
        for c in connections
        if cars.issuperset((f"{c.source}_{c.lane}", f"{c.target}_{c.to_lane}"))
    ]
    over = _turns_over_junctions(links, connections)
    successors: dict[str, list[str]] = {edge: [] for edge in edges}
    for source, target in sorted({(c.source, c.target) for c in links}):
        successors[source].append(target)
    region_of = {edge: given[edge] for edge in edges}
    all_regions = region_of | {
        edge: region for edge, region in given.items() if not edge.startswith(":")
    }
    return City(
        net_file=Path(net_file),
        regions=regions,
        region_of=all_regions | _internal_regions(connections, all_regions, internal),
        edges=edges,
        length={e: lanes_of[e][0][0] for e in edges},
        lanes={e: len(lanes_of[e]) for e in edges},
        lane_ids={e: tuple(lane for _, _, lane in lanes_of[e]) for e in edges},
        speed={e: max(speed for _, speed, _ in lanes_of[e]) for e in edges},
        successors={edge: tuple(after) for edge, after in successors.items()},
        turn_time={
            (c.source, c.target): internal[c.via.rpartition("_")[0]][0] if c.via else 0.0
            for c in links
        },
        gateways=_gateways(links, region_of),
        signals={c.source: c.signal for c in links if c.signal},
        over=over,
        inside={
            edge: internal[edge][1]
            for edge in sorted(set().union(*over.values()))
            if internal[edge][1] > 0.0
        },
    )


def check_adjacency(city: City, network: RegionalModel) -> None:
    """Raise InputError unless the gateways join exactly the regions that network.toml calls
    adjacent."""
    where = f"{network.folder}/network.toml: regions"
    joined = np.zeros((city.regions, city.regions), dtype=bool)
    for gateway in city.gateways:
        i, h, ends = (
            gateway.source,
            gateway.target,
            f"edge {gateway.from_edge} leads to {gateway.to_edge}",
        )
        if not network.adjacency[i, h]:
            raise InputError(
                f"{where}[{i}].adjacent: region {h} is missing, although {ends}; add it, or move the edges to other "
                "regions"
            )
        joined[i, h] = True
    for i, h in np.argwhere(network.adjacency & ~joined):
        raise InputError(
            f"{where}[{i}].adjacent: lists {h}, but no edge leads from region {i} to region {h} in {city.net_file}; "
            "remove it, or change the regions of edges"
        )


def edge_shapes(city: City) -> list[Points]:
    """Return (n, 2) [m] for every edge: its line on the map, midway between its outermost lanes."""
    shapes: dict[str, Points] = {}
    with network_root(city.net_file) as root:
        for edge in root.iterfind("edge"):
            lanes = [
                np.array(
                    [point.split(",")[:2] for point in attribute(lane, "shape").split()],
                    dtype=float,
                )
                for lane in edge.iter("lane")
                if for_cars(lane)
            ]
            if lanes:
                same = len(lanes[0]) == len(lanes[-1])
                shapes[attribute(edge, "id")] = (lanes[0] + lanes[-1]) / 2 if same else lanes[0]
    return [shapes[edge] for edge in city.edges]


def points_along(shape: Points, marks: Callable[[float], ArrayLike]) -> Float[np.ndarray, "*n 2"]:
    """Return points (..., 2) [m] on a line (n, 2) [m]; marks: its length [m] -> their distances
    from its beginning."""
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(shape, axis=0).T)))
    at = marks(float(along[-1]))
    return np.stack([np.interp(at, along, axis) for axis in shape.T], axis=-1)


def _read_net(
    path: Path,
) -> tuple[dict[str, list[_Lane]], dict[str, tuple[float, float]], list[_Connection]]:
    """Return edge -> lanes for cars; internal edge -> (time [s], length [m]); connections."""
    lanes_of: dict[str, list[_Lane]] = {}
    internal: dict[str, tuple[float, float]] = {}
    connections: list[_Connection] = []
    with network_root(path) as root:
        for element in root.iterfind("edge"):
            edge, open_lanes = attribute(element, "id"), filter(for_cars, element.iter("lane"))
            lanes = [
                (size(one, "length"), size(one, "speed"), attribute(one, "id"))
                for one in open_lanes
            ]
            if element.get("function", "normal") in NORMAL:
                lanes_of[edge] = lanes
            else:
                internal[edge] = max(
                    ((long / speed, long) for long, speed, _ in lanes), default=(0.0, 0.0)
                )
        for element in root.iterfind("connection"):
            source, target, via = (
                attribute(element, "from"),
                attribute(element, "to"),
                element.get("via"),
            )
            numbers = (
                element.get("linkIndex", "-1"),
                attribute(element, "fromLane"),
                attribute(element, "toLane"),
            )
            if via and via.rpartition("_")[0] not in internal:
                raise LookupError(f"connection from {source} by way of {via}: no such edge")
            connections.append(
                _Connection(source, target, via, element.get("tl"), *map(int, numbers))
            )
    if not lanes_of:
        raise InputError(f"{path}: has no edges; build it with netconvert")
    return lanes_of, internal, connections


def size(lane: ElementTree.Element, name: str) -> float:
    """Return the length [m] or speed [m/s] of a <lane>. Raises ValueError unless it is above 0 and
    finite."""
    value = float(attribute(lane, name))
    if not 0.0 < value < math.inf:
        raise ValueError(
            f"lane {lane.get('id')}: {name}: expected a number above 0, got {value:g} instead"
        )
    return value


def for_cars(lane: ElementTree.Element) -> bool:
    """Return True if cars may use a <lane>."""
    if (allowed := lane.get("allow")) is not None:
        return bool({"all", "passenger"} & set(allowed.split()))
    return not {"all", "passenger"} & set(lane.get("disallow", "").split())


def read_regions(path: Path, regions: int = 10**6) -> dict[str, int]:
    """Return edge -> region, less than `regions`, of a csv file edge,region. Raises InputError."""
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
    region_of: dict[str, int] = {}
    for number, row in enumerate(rows, start=2):
        if not row:
            continue
        if len(row) != 2 or not row[1].isdecimal() or len(row[1]) > 9 or int(row[1]) >= regions:
            expected = f"an edge and a region from 0 to {regions - 1}"
            raise InputError(
                f"{path}: line {number}: expected {expected}, got {','.join(row)} instead"
            )
        if row[0] in region_of:
            raise InputError(
                f"{path}: line {number}: edge {row[0]} appears twice; remove one of the lines"
            )
        region_of[row[0]] = int(row[1])
    return region_of


def _internal_regions(
    connections: Sequence[_Connection], region_of: Mapping[str, int], internal: Collection[str]
) -> dict[str, int]:
    """Return internal edge -> region of the edge it leads to; without cars, that of any edge of the
    junction."""
    regions: dict[str, int] = {}
    of_junction: dict[str, int] = {}
    for connection in connections:
        if (target := region_of.get(connection.target)) is not None:
            if connection.via:
                regions[connection.via.rpartition("_")[0]] = target
            if connection.source.startswith(":"):
                regions[connection.source] = target
    for edge, region in regions.items():
        of_junction.setdefault(edge.rpartition("_")[0], region)
    return {
        edge: regions.get(edge, of_junction.get(edge.rpartition("_")[0], 0)) for edge in internal
    }


def _turns_over_junctions(
    links: Sequence[_Connection], connections: Sequence[_Connection]
) -> dict[tuple[str, str], tuple[str, ...]]:
    """Return (from_edge, to_edge) -> internal edges in between; two if the turn waits in the middle
    of a junction."""
    onward = {(c.source, c.lane): c.via for c in connections if c.source.startswith(":")}
    over: dict[tuple[str, str], tuple[str, ...]] = {}
    for link in links:
        way, via = [], link.via
        while via:
            edge, _, lane = via.rpartition("_")
            way.append(edge)
            via = onward.get((edge, int(lane)))
        if way:
            over[link.source, link.target] = tuple(way)
    return over


def _gateways(links: list[_Connection], region_of: dict[str, int]) -> tuple[Gateway, ...]:
    movements: dict[tuple[int, int, str, str], list[_Connection]] = {}
    for link in links:
        source, target = region_of[link.source], region_of[link.target]
        if source != target:
            movements.setdefault((source, target, link.source, link.target), []).append(link)
    return tuple(
        Gateway(
            source=key[0],
            target=key[1],
            from_edge=key[2],
            to_edge=key[3],
            signal=_common_signal(members),
            links=tuple(sorted(link.link for link in members if link.signal)),
            lanes=tuple(sorted({link.lane for link in members})),
        )
        for key, members in sorted(movements.items())
    )


def _common_signal(links: list[_Connection]) -> str | None:
    """Return the signal that controls all links of a movement, None if there is none."""
    signals = {link.signal for link in links}
    return signals.pop() if len(signals) == 1 else None


def gateway_movements(city: City) -> dict[str, dict[int, int]]:
    """Return signal -> link index -> number of the gateway, of the links that lead over a
    boundary."""
    movements: dict[str, dict[int, int]] = {}
    for number, gateway in enumerate(city.gateways):
        if gateway.signal is not None:
            movements.setdefault(gateway.signal, {}).update(dict.fromkeys(gateway.links, number))
    return movements


def gateway_room_taken(
    edge_vehicles: Float[np.ndarray, "*intervals E"], city: City
) -> Float[np.ndarray, "*intervals G"]:
    """Return (..., G) [-], the share of the room before each gateway that edge_vehicles (..., E)
    [veh] take."""
    before = [city.number[gateway.from_edge] for gateway in city.gateways]
    return edge_vehicles[..., before] / city.room[before]
