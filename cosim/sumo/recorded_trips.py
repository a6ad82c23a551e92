"""Vehicles of a city: of its route files, or made from the demand.

Those of files are varied by seed and demand factor.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from cosim.sumo.arrays import PerTrip, TripNumbers
from cosim.sumo.net import City
from cosim.sumo.trips import (
    DRIVER_CLASSES,
    PEAK_S,
    PLANNING_SEEDS,
    Trips,
    busiest,
    perception,
    routes_in,
)
from cosim.sumo.xml_files import attribute, read_xml, xml_text
from nmfd.errors import InputError
from nmfd.runs import files

STREAM = 7102  # keeps these random numbers apart from others of the same seed
JITTER_S = 10.0  # departures are moved by up to this, either way, by a seed other than 0
MESOSCOPIC = {"mesosim": "true", "meso-junction-control": "true"}  # options of SUMO
RAIL = ("tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car")
PUBLIC = frozenset(["bus", "coach", "ship", *RAIL])
# Vehicle classes that keep to their lines, or do not use the road as cars do.
BOUND = PUBLIC.union(
    ["aircraft", "bicycle", "pedestrian", "scooter", "wheelchair", "container", "drone"]
)
# Parameter of buses and the like: number of cars that depart at the same time and come first.
QUEUED_AFTER = "queued_after"
DrawnTrip = tuple[float, int, str]  # departure [s], number of the vehicle, id
# Attributes of all vehicles that are made from a demand.
MADE = {"type": "car", "departLane": "best", "departSpeed": "max", "departPos": "random_free"}
HELD = "held."  # prefix of the ids of routes that only one vehicle uses
# Attribute of a vehicle -> argument of Session.begin_trip, whose defaults are those of the
# attributes.
ALIKE = (
    "departLane",
    "departPos",
    "departSpeed",
    "arrivalLane",
    "arrivalPos",
    "arrivalSpeed",
    "speedFactor",
)
ORDERED = {"type": "typeID"} | {name: name for name in ALIKE}
# What vehicles under metering may have. SUMO writes `arrival`, and does not read it.
METERABLE = frozenset(["id", "depart", "route", "from", "to", "color", "arrival", *ORDERED])


@dataclass(frozen=True, kw_only=True)
class RecordedTrips:
    """N vehicles or trips.

    depart: (N,) [s], sorted; elements: their XML; types: own ones, others are elsewhere
    """

    depart: PerTrip
    elements: tuple[ElementTree.Element, ...]
    types: tuple[ElementTree.Element, ...] = ()


@dataclass(frozen=True, kw_only=True)
class HeldTrips:
    """N metered trips, sorted by departure; SUMO gets each when it may begin.

    depart: (N,) [s]; origin, destination: (N,) regions
    orders: N sets of arguments of `Session.begin_trip`; each names a route that SUMO knows
    """

    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    orders: tuple[Mapping[str, str], ...]


def read_recorded_trips(paths: Sequence[Path]) -> RecordedTrips:
    """Return the `vehicle` and `trip` elements of SUMO route files.

    Raises: InputError
    """
    elements: list[ElementTree.Element] = []
    departs = []
    known = set()
    for path in paths:
        root = read_xml(path)
        if root.tag != "routes":
            raise InputError(
                f"{path}: expected a SUMO route file, got a file of <{root.tag}> instead"
            )
        for element in root:
            if element.tag not in ("vehicle", "trip"):
                raise InputError(
                    f"{path}: expected vehicle and trip elements only, got {element.tag} instead; "
                    "move it to a file in sumo.background or sumo.additional, or let cosim import "
                    "do so"
                )
            name = element.get("id")
            if not name or name in known:
                raise InputError(
                    f"{path}: {element.tag} {len(elements)}: id: expected a unique one, got "
                    f"{name!r} instead"
                )
            known.add(name)
            elements.append(element)
            departs.append(_departure(element, path))
    order = np.argsort(departs, kind="stable")
    depart = np.array(departs, dtype=float)
    return RecordedTrips(depart=depart[order], elements=tuple(elements[n] for n in order))


def _departure(element: ElementTree.Element, path: Path) -> float:
    """Return when a vehicle departs [s]. Raises InputError."""
    depart = math.nan
    with suppress(KeyError, ValueError):
        depart = float(element.attrib["depart"])
    if not 0.0 <= depart < math.inf:
        raise InputError(
            f"{path}: vehicle {element.get('id')}: depart: expected a time from 0 s up, got "
            f"{element.get('depart')!r} instead; move it to a file in sumo.background"
        )
    return depart


def as_recorded(trips: Trips) -> RecordedTrips:
    """Return trips made from a demand as vehicles v0, v1, ..."""
    elements = []
    for n, (route, arrival) in enumerate(zip(trips.routes, trips.arrival, strict=True)):
        own = {"id": f"v{n}", "arrivalPos": f"{arrival:.1f}"}
        vehicle = ElementTree.Element("vehicle", MADE | own)
        ElementTree.SubElement(vehicle, "route", edges=" ".join(route))
        elements.append(vehicle)
    return RecordedTrips(
        depart=trips.depart,
        elements=tuple(elements),
        types=(ElementTree.Element("vType", id="car", sigma="0.2"),),
    )


def check_edges(originals: RecordedTrips, city: City, where: str) -> None:
    """Raise InputError for a vehicle on an unknown edge.

    SUMO would drop it silently.
    """
    for element in originals.elements:
        for edge in named_edges(element):
            if edge not in city.region_of:
                raise InputError(
                    f"{where}: {element.tag} {element.get('id')}: edge {edge} is not in "
                    f"{city.net_file}; remove the vehicle, or give the routes of this network"
                )


def named_edges(element: ElementTree.Element) -> list[str]:
    """Return the edges that a vehicle names, without those of shared routes."""
    texts = [element.get(key, "") for key in ("from", "to", "via")]
    texts += [route.get("edges", "") for route in element.iter("route")]
    return " ".join(texts).split()


def read_routes(paths: Sequence[Path]) -> dict[str, tuple[str, ...]]:
    """Return id -> edges of the shared routes in additional files.

    A distribution stands for its first route.
    """
    shared: dict[str, tuple[str, ...]] = {}
    for path in paths:
        root = read_xml(path)
        for route in root.iter("route"):
            name = route.get("id")
            edges = route.get("edges", "").split()
            if name and edges:
                shared[name] = tuple(edges)
        for distribution in root.iter("routeDistribution"):
            routes = []
            for route in distribution.iter("route"):
                edges = route.get("edges", "").split()
                if edges:
                    routes.append(tuple(edges))
            for name in distribution.get("routes", "").split():
                if name in shared:
                    routes.append(shared[name])
            name = distribution.get("id")
            if routes and name:
                shared[name] = routes[0]
    return shared


def ids(paths: Sequence[Path]) -> frozenset[str]:
    """Return the ids of the vehicles and flows in SUMO's files."""
    found = set()
    for path in paths:
        for element in read_xml(path):
            if element.tag in ("vehicle", "trip", "flow"):
                found.add(element.get("id", "").strip())
    return frozenset(found)


def edges_of(
    element: ElementTree.Element, shared: Mapping[str, Sequence[str]]
) -> tuple[Sequence[str], bool]:
    """Return (edges of a vehicle's route, True), or (edges to pass, False)."""
    route = element.find("route")
    if route is not None:
        return route.get("edges", "").split(), True
    if element.get("route"):
        return shared.get(attribute(element, "route"), ()), True
    ends = [element.get(key, "") for key in ("from", "via", "to")]
    return " ".join(ends).split(), False


def own_flows(
    city: City, originals: RecordedTrips, shared: Mapping[str, Sequence[str]], factor: float
) -> Mapping[tuple[str, str], float]:
    """Return (edge, next edge) -> flow [veh/s] in the peak.

    That is the busiest quarter of an hour.
    Trips without a route take a fastest one.
    shared: `read_routes`; factor: multiplies the flows
    """
    known = set(city.edges)
    turns: Counter[tuple[str, str]] = Counter()
    legs: list[tuple[int, int]] = []  # edges between which a fastest way leads
    for element in originals.elements[busiest(originals.depart, PEAK_S)]:
        edges, driven = edges_of(element, shared)
        for pair in pairwise(edges):
            if not known.issuperset(pair):
                continue
            if driven:
                turns[pair] += 1
            elif pair[0] != pair[1]:
                legs.append((city.number[pair[0]], city.number[pair[1]]))
    if legs:
        random = np.random.default_rng(PLANNING_SEEDS[0])
        begin, end = np.array(legs).T
        noise = perception(len(city.edges), random)
        tastes = random.integers(DRIVER_CLASSES, size=len(legs))
        for route in routes_in(city, (begin, end), tastes, noise):
            turns.update(pairwise(route))
    return {turn: factor * count / PEAK_S for turn, count in turns.items()}


def draw(
    originals: RecordedTrips, *, seed: int, factor: float, jitter: float, begin: float
) -> list[DrawnTrip]:
    """Return departure [s], number and id of the vehicles of one run.

    They are sorted by departure.
    factor: vehicles are left out, or drive several times (ids with .1, .2 ...), by seeded choice
    jitter: departures are moved by up to this, either way, but not before `begin` [s]
    """
    rng = np.random.default_rng([seed, STREAM])
    count = len(originals.depart)
    copies = np.full(count, int(factor))
    copies[rng.permutation(count)[: round((factor - int(factor)) * count)]] += 1
    shifts = rng.uniform(-jitter, jitter, size=(max(int(copies.max(initial=0)), 1), count))
    names = [attribute(element, "id") for element in originals.elements]
    taken = set(names)
    digits = 2 if jitter else 3
    drawn = []
    for n, times in enumerate(copies):
        recorded = float(originals.depart[n])
        for copy in range(times):
            depart = max(float(recorded + shifts[copy, n]), min(begin, recorded))
            name = names[n]
            if copy:
                stem = name
                name = f"{stem}.{copy}"
                while name in taken:
                    stem += "."
                    name = f"{stem}.{copy}"
            drawn.append((round(depart, digits), n, name))
    return sorted(drawn, key=lambda vehicle: vehicle[:2])


def write_recorded_trips(originals: RecordedTrips, drawn: Sequence[DrawnTrip], path: Path) -> None:
    """Write the vehicles of one run to a SUMO route file."""
    texts = [xml_text(element) for element in originals.types]
    for depart, n, name in drawn:
        texts.append(_departing(originals.elements[n], name, depart))
    _write(path, texts)


def run_files(path: Path, beside: Sequence[Path], seed: int) -> list[Path]:
    """Return the route files of one run.

    path: of its private vehicles; beside: of all others
    With seed 0 vehicles queue as in the city's own files (`merge`, which changes `path`).
    """
    if beside and not seed:
        return merge(path, beside, path.with_name("beside.rou.xml"))
    return [path, *beside]


def merge(path: Path, beside: Sequence[Path], rest: Path) -> list[Path]:
    """Put timed vehicles of the files `beside` into the file `path`.

    rest: for all else of them
    In one file vehicles queue in the order of their departures and, at the same time, of
    QUEUED_AFTER, as in the city's own files. Returns both files, types first.
    """
    queue: list[tuple[float, float, ElementTree.Element]] = []  # time, place among those then
    others = []
    places = Counter[float]()
    for element in read_xml(path):
        depart = float(element.get("depart", 0))
        queue.append((depart, places[depart] + 0.5, element))
        places[depart] += 1
    for file in beside:
        for element in read_xml(file):
            time = element.get("depart", "")
            is_timed = time.replace(".", "", 1).isdecimal()
            if element.tag not in ("vehicle", "trip") or not is_timed:
                others.append(element)
                continue
            place = math.inf
            parameter = element.find(f"param[@key='{QUEUED_AFTER}']")
            if parameter is not None:
                place = float(attribute(parameter, "value"))
            queue.append((float(time), place, element))
    queue.sort(key=lambda row: row[:2])
    _write(path, [xml_text(element) for _, _, element in queue])
    _write(rest, map(xml_text, others))
    return [rest, path]


def write_held_trips(
    originals: RecordedTrips,
    drawn: Sequence[DrawnTrip],
    path: Path,
    shared: Mapping[str, tuple[str, ...]],
    region_of: Mapping[str, int],
) -> HeldTrips:
    """Return the metered trips of one run.

    Write their routes and all other vehicles to a SUMO route file. A vehicle with stops, via edges
    or attributes that libsumo.vehicle.add does not take is not metered.
    shared: `read_routes`; region_of: edge -> region
    """
    texts = [xml_text(element) for element in originals.types]
    written = set[int]()
    departs = []
    origins = []
    destinations = []
    orders: list[Mapping[str, str]] = []
    for depart, n, name in drawn:
        element = originals.elements[n]
        route = _meterable_route(element, shared)
        if not route:
            texts.append(_departing(element, name, depart))
            continue
        known = element.get("route", f"{HELD}{n}")
        if "route" not in element.attrib and n not in written:
            written.add(n)
            texts.append(xml_text(ElementTree.Element("route", id=known, edges=" ".join(route))))
        order = {"vehID": name, "routeID": known}
        for key, value in element.attrib.items():
            if key in ORDERED:
                order[ORDERED[key]] = value
        orders.append(order)
        departs.append(depart)
        origins.append(region_of[route[0]])
        destinations.append(region_of[route[-1]])
    _write(path, texts)
    return HeldTrips(
        depart=np.array(departs, dtype=float),
        origin=np.array(origins, dtype=int),
        destination=np.array(destinations, dtype=int),
        orders=tuple(orders),
    )


def _meterable_route(
    element: ElementTree.Element, shared: Mapping[str, tuple[str, ...]]
) -> tuple[str, ...]:
    """Return the edges of a vehicle that can be metered, () of others.

    SUMO connects the two edges of a trip.
    """
    if not METERABLE.issuperset(element.attrib):
        return ()
    has_own_route = element.tag == "vehicle" and "route" not in element.attrib
    if len(element) > int(has_own_route):
        return ()
    for part in element:
        if part.tag != "route" or len(part) or not {"edges", "color"}.issuperset(part.attrib):
            return ()
    edges, driven = edges_of(element, shared)
    if driven:
        return tuple(edges)
    if element.tag == "trip" and len(edges) == 2:
        return tuple(dict.fromkeys(edges))
    return ()


def _departing(element: ElementTree.Element, name: str, depart: float) -> str:
    """Return a vehicle under another name, at another time [s], as text."""
    return xml_text(element, {"id": name, "depart": f"{depart:.10g}"})


def _write(path: Path, texts: Iterable[str]) -> None:
    lines = [f"  {text.strip()}\n" for text in texts]
    files.write_text(path, f"<routes>\n{''.join(lines)}</routes>\n")
