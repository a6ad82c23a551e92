"""Trips of a network inside a smaller network."""

import gzip
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from cosim.importing.demand import wrapped
from cosim.importing.streets import Streets, read_streets
from cosim.sumo.xml_files import attribute, read_xml

DELAY = 1.35  # travel time outside the smaller network, in free-flow times
UNKNOWN_SPEED = 12.0  # on streets of none of the networks, which have the mean length [m/s]
VEHICLE_TYPE = {"id": "HDC", "vClass": "passenger", "tau": "1.2", "lcStrategic": "0.5"}
BEGUN_INSIDE = {"departPos": "random_free", "departSpeed": "0"}
BEGUN_OUTSIDE = {"departPos": "base", "departSpeed": "max"}
EVERY = {"type": VEHICLE_TYPE["id"], "departLane": "best", "arrivalPos": "max"}
CONFIGURATION = """<configuration>
    <input><net-file value="{name}.net.xml.gz"/><route-files value="{name}.rou.xml.gz"/></input>
    <time><begin value="{begin}"/><end value="{end}"/><step-length value="1"/></time>
    <processing><time-to-teleport value="-1"/></processing>
</configuration>
"""


class Plan(NamedTuple):
    """Files of a cut.

    net: the smaller network; around: networks of streets outside
    trips: without their ends .rou.xml (routes) and _vehicles.add.xml
    begin, end: of the simulation (s)
    """

    net: str
    around: Sequence[str]
    trips: Sequence[str]
    begin: int
    end: int


class Trip(NamedTuple):
    """A vehicle, its departure (s) and its edges.

    entered: True if it has driven elsewhere before the first edge
    """

    vehicle: str
    depart: float
    edges: Sequence[str]
    entered: bool = False


def cut(plan: Plan, folder: Path, out: Path) -> None:
    """Write a network, the trips inside it and their sumocfg to `out`.

    folder: above the files of the plan; out: a new folder, whose name becomes that of the files
    Raises: InputError
    """
    streets = read_streets(folder / plan.net)
    around = [read_streets(folder / net) for net in plan.around]
    trips: list[Trip] = []
    for name in plan.trips:
        trips += read_trips(folder / f"{name}.rou.xml", folder / f"{name}_vehicles.add.xml")
    inside = trips_inside(trips, streets, around)
    root = wrapped([Element("vType", VEHICLE_TYPE), *map(_vehicle, inside)], "routes")
    indent(root)
    out.mkdir()
    name = out.name
    network = (folder / plan.net).read_bytes()
    (out / f"{name}.net.xml.gz").write_bytes(gzip.compress(network, mtime=0))
    (out / f"{name}.rou.xml.gz").write_bytes(gzip.compress(tostring(root), mtime=0))
    text = CONFIGURATION.format(name=name, begin=plan.begin, end=plan.end)
    (out / f"{name}.sumocfg").write_text(text, encoding="utf-8")


def read_trips(routes: Path, vehicles: Path) -> Iterator[Trip]:
    """Yield the vehicles of a file with their routes of another one.

    Raises: InputError
    """
    edges = {}
    for route in read_xml(routes).iter("route"):
        edges[attribute(route, "id")] = attribute(route, "edges").split()
    for vehicle in read_xml(vehicles).iter("vehicle"):
        depart = float(attribute(vehicle, "depart"))
        yield Trip(attribute(vehicle, "id"), depart, edges[attribute(vehicle, "route")])


def trips_inside(
    trips: Iterable[Trip], streets: Streets, around: Iterable[Streets] = ()
) -> list[Trip]:
    """Return the longest connected stretch of every trip, by departure.

    Stretches have two edges or more. The first trip of a vehicle counts. Its departure is later by
    the time on the edges before.
    around: streets outside whose lengths and speeds are known
    """
    lengths: dict[str, float] = {}
    times: dict[str, float] = {}
    for part in (*around, streets):
        lengths.update(zip(part.edges, part.length, strict=True))
        times.update(zip(part.edges, part.length / part.speed, strict=True))
    unknown = float(np.mean(list(lengths.values()))) / UNKNOWN_SPEED
    links = set()
    for source, target in streets.all_links:
        links.add((streets.edges[source], streets.edges[target]))
    inside = {}
    for trip in trips:
        stretch = longest_stretch(trip.edges, streets.number, links)
        if trip.vehicle in inside or len(stretch) < 2:
            continue
        before = trip.edges[: stretch.start]
        outside = sum(times.get(edge, unknown) for edge in before)
        depart = trip.depart + DELAY * outside
        edges = trip.edges[stretch.start : stretch.stop]
        inside[trip.vehicle] = Trip(trip.vehicle, depart, edges, bool(before))
    return sorted(inside.values(), key=lambda trip: (trip.depart, trip.vehicle))


def longest_stretch(
    edges: Sequence[str], known: Mapping[str, int], links: set[tuple[str, str]]
) -> range:
    """Return the numbers of the longest stretch of edges that links join.

    All its edges are known. It is the first of equals.
    """
    best = range(0)
    begin = 0
    for n, edge in enumerate(edges):
        if edge not in known:
            begin = n + 1
        elif n > begin and (edges[n - 1], edge) not in links:
            begin = n
        stretch = range(begin, n + 1)
        if len(stretch) > len(best):
            best = stretch
    return best


def _vehicle(trip: Trip) -> Element:
    """Return the element of a trip."""
    start = BEGUN_INSIDE
    if trip.entered:
        start = BEGUN_OUTSIDE
    own = {"id": trip.vehicle, "depart": f"{trip.depart:.1f}"}
    vehicle = Element("vehicle", {**own, **EVERY, **start})
    SubElement(vehicle, "route", {"edges": " ".join(trip.edges)})
    return vehicle
