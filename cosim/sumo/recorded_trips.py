"""Vehicles of a city: those of its route files, varied by seed and demand factor, or trips made
from the demand."""

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Mapping, Sequence
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
from cosim.sumo.xml_files import attribute, read_xml
from nmfd.errors import InputError
from nmfd.runs import files

STREAM = 7102  # keeps these random numbers apart from others of the same seed
JITTER_S = 10.0  # departures are moved by up to this, either way, by a seed other than 0
MESOSCOPIC = {"mesosim": "true", "meso-junction-control": "true"}  # options of SUMO
PUBLIC = frozenset(
    [
        "bus",
        "coach",
        "tram",
        "rail",
        "rail_urban",
        "rail_electric",
        "rail_fast",
        "subway",
        "cable_car",
        "ship",
    ]
)
# Vehicle classes that keep to their lines, or do not use the road as cars do.
BOUND = PUBLIC.union(
    ["aircraft", "bicycle", "pedestrian", "scooter", "wheelchair", "container", "drone"]
)
QUEUED_AFTER = "queued_after"  # parameter of buses and the like: cars that depart at the same time and come first
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


@dataclass(frozen=True, kw_only=True)
class RecordedTrips:
    """N vehicles or trips. depart: (N,) [s], sorted; elements: their XML; types: own ones, others
    are elsewhere."""

    depart: PerTrip
    elements: tuple[ElementTree.Element, ...]
    types: tuple[ElementTree.Element, ...] = ()


@dataclass(frozen=True, kw_only=True)
class HeldTrips:
    """N metered trips, which SUMO gets one by one when they may begin, sorted by departure.

    depart: (N,) [s]; origin, destination: (N,) regions
    orders: N sets of arguments of `Session.begin_trip`; each names a route that SUMO knows
    """

    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    orders: tuple[Mapping[str, str], ...]


def read_recorded_trips(paths: Sequence[Path]) -> RecordedTrips:
    """Return the `vehicle` and `trip` elements of SUMO route files. Raises InputError."""
    elements = []
    for path in paths:
        root = read_xml(path)
        if root.tag != "routes":
            raise InputError(
                f"{path}: expected a SUMO route file, got a file of <{root.tag}> instead"
            )
        elements += [(path, element) for element in root]
    departs, ids = np.full(len(elements), np.nan), set()
    for n, (path, element) in enumerate(elements):
        if element.tag not in ("vehicle", "trip"):
            raise InputError(
                f"{path}: expected vehicle and trip elements only, got {element.tag} instead; move it to a file in "
                "sumo.background or sumo.additional, or let cosim import do so"
            )
        name = element.get("id")
        if not name or name in ids:
            raise InputError(
                f"{path}: {element.tag} {n}: id: expected a unique one, got {name!r} instead"
            )
        ids.add(name)
        with suppress(KeyError, ValueError):
            departs[n] = float(element.attrib["depart"])
        if not 0.0 <= departs[n] < math.inf:
            raise InputError(
                f"{path}: vehicle {name}: depart: expected a time from 0 s up, got {element.get('depart')!r} instead; "
                "move it to a file in sumo.background"
            )
    order = np.argsort(departs, kind="stable")
    return RecordedTrips(depart=departs[order], elements=tuple(elements[n][1] for n in order))


def as_recorded(trips: Trips) -> RecordedTrips:
    """Return trips that are made from a demand as vehicles v0, v1, ... by departure."""
    elements = []
    for n, (route, arrival) in enumerate(zip(trips.routes, trips.arrival, strict=True)):
        elements.append(
            ElementTree.Element("vehicle", MADE | {"id": f"v{n}", "arrivalPos": f"{arrival:.1f}"})
        )
        ElementTree.SubElement(elements[-1], "route", edges=" ".join(route))
    return RecordedTrips(
        depart=trips.depart,
        elements=tuple(elements),
        types=(ElementTree.Element("vType", id="car", sigma="0.2"),),
    )


def check_edges(originals: RecordedTrips, city: City, where: str) -> None:
    """Raise InputError for a vehicle on an unknown edge, which SUMO would drop silently."""
    for element in originals.elements:
        route = element.find("route")
        ends = [element.get(key) for key in ("from", "to") if element.get(key)]
        edges = [
            *ends,
            *element.get("via", "").split(),
            *("" if route is None else route.get("edges", "")).split(),
        ]
        for edge in edges:
            if edge not in city.region_of:
                raise InputError(
                    f"{where}: {element.tag} {element.get('id')}: edge {edge} is not in {city.net_file}; remove the "
                    "vehicle, or give the routes of this network"
                )


def read_routes(paths: Sequence[Path]) -> dict[str, tuple[str, ...]]:
    """Return id -> edges of the shared routes in additional files; of a distribution, its first
    route."""
    shared: dict[str, tuple[str, ...]] = {}
    for path in paths:
        root = read_xml(path)
        for route in root.iter("route"):
            name, edges = route.get("id"), route.get("edges")
            if name and edges:
                shared[name] = tuple(edges.split())
        for distribution in root.iter("routeDistribution"):
            routes = [
                tuple(edges.split())
                for r in distribution.iter("route")
                if (edges := r.get("edges"))
            ]
            routes += [
                shared[name] for name in distribution.get("routes", "").split() if name in shared
            ]
            if routes and (name := distribution.get("id")):
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
    """Return (the edges of a vehicle's route, True), or (the edges that it must pass, False)."""
    route = element.find("route")
    if route is not None:
        return route.get("edges", "").split(), True
    if name := element.get("route"):
        return shared.get(name, ()), True
    return [edge for key in ("from", "via", "to") for edge in element.get(key, "").split()], False


def own_flows(
    city: City, originals: RecordedTrips, shared: Mapping[str, Sequence[str]], factor: float
) -> Mapping[tuple[str, str], float]:
    """Return (edge, next edge) -> flow [veh/s] of recorded trips in their busiest quarter of an
    hour.

    Trips without a route take a fastest one. shared: `read_routes`; factor: multiplies the flows
    """
    peak = [
        edges_of(element, shared)
        for element in originals.elements[busiest(originals.depart, PEAK_S)]
    ]
    known = set(city.edges)
    turns: Counter[tuple[str, str]] = Counter()
    legs: list[tuple[str, str]] = []
    for edges, driven in peak:
        pairs = [pair for pair in pairwise(edges) if known.issuperset(pair)]
        if driven:
            turns.update(pairs)
        else:
            legs += [leg for leg in pairs if leg[0] != leg[1]]
    if legs:
        random = np.random.default_rng(PLANNING_SEEDS[0])
        begin, end = np.array([[city.number[edge] for edge in leg] for leg in legs]).T
        noise = perception(len(city.edges), random)
        for route in routes_in(
            city, (begin, end), random.integers(DRIVER_CLASSES, size=len(legs)), noise
        ):
            turns.update(pairwise(route))
    return {turn: factor * count / PEAK_S for turn, count in turns.items()}


def draw(
    originals: RecordedTrips, *, seed: int, factor: float, jitter: float, begin: float
) -> list[DrawnTrip]:
    """Return (departure [s], number of the vehicle, its id) of one run, sorted by departure.

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
    drawn = []
    for n, times in enumerate(copies):
        for copy in range(times):
            depart = max(
                float(originals.depart[n] + shifts[copy, n]), min(begin, float(originals.depart[n]))
            )
            stem, name = names[n], f"{names[n]}.{copy}" if copy else names[n]
            while copy and name in taken:
                stem += "."
                name = f"{stem}.{copy}"
            drawn.append((round(depart, 2 if jitter else 3), n, name))
    return sorted(drawn, key=lambda vehicle: vehicle[:2])


def write_recorded_trips(originals: RecordedTrips, drawn: Sequence[DrawnTrip], path: Path) -> None:
    """Write the vehicles of one run to a SUMO route file."""
    _write(
        path,
        [
            *originals.types,
            *(_departing(originals.elements[n], name, depart) for depart, n, name in drawn),
        ],
    )


def run_files(path: Path, beside: Sequence[Path], seed: int) -> list[Path]:
    """Return the route files of one run: that of its private vehicles and those `beside` it.

    With seed 0 vehicles queue as in the city's own files (`merge`, which changes `path`).
    """
    if beside and not seed:
        return merge(path, beside, path.with_name("beside.rou.xml"))
    return [path, *beside]


def merge(path: Path, beside: Sequence[Path], rest: Path) -> list[Path]:
    """Put the timed vehicles of the files `beside` into the route file `path`, and all else of them
    into `rest`.

    In one file vehicles queue in the order of their departures and, at the same time, of
    QUEUED_AFTER, as in the city's own files. Returns both files, types first.
    """
    queue = list[tuple[float, float, ElementTree.Element]]()  # time, place among those of that time
    others, places = list[ElementTree.Element](), Counter[float]()
    for element in read_xml(path):
        depart = float(element.get("depart", 0))
        queue.append((depart, places[depart] + 0.5, element))
        places[depart] += 1
    for element in (element for file in beside for element in read_xml(file)):
        if (
            element.tag in ("vehicle", "trip")
            and element.get("depart", "").replace(".", "", 1).isdecimal()
        ):
            place = element.find(f"param[@key='{QUEUED_AFTER}']")
            first = math.inf if place is None else float(attribute(place, "value"))
            queue.append((float(attribute(element, "depart")), first, element))
        else:
            others.append(element)
    _write(path, [element for *_, element in sorted(queue, key=lambda row: row[:2])])
    _write(rest, others)
    return [rest, path]


def write_held_trips(
    originals: RecordedTrips,
    drawn: Sequence[DrawnTrip],
    path: Path,
    shared: Mapping[str, tuple[str, ...]],
    region_of: Mapping[str, int],
) -> HeldTrips:
    """Return the metered trips of one run; write their routes and all other vehicles to a SUMO
    route file.

    A vehicle with stops, via edges or attributes that libsumo.vehicle.add does not take is not
    metered.
    shared: `read_routes`; region_of: edge -> region
    """
    elements, written = list(originals.types), set[int]()
    departs, routes, orders = [], [], []
    for depart, n, name in drawn:
        element = originals.elements[n]
        route = _meterable_route(element, shared)
        if not route:
            elements.append(_departing(element, name, depart))
            continue
        known = element.get("route", f"{HELD}{n}")
        if "route" not in element.attrib and n not in written:
            written.add(n)
            elements.append(ElementTree.Element("route", id=known, edges=" ".join(route)))
        order = {ORDERED[key]: value for key, value in element.attrib.items() if key in ORDERED}
        orders.append({"vehID": name, "routeID": known, **order})
        departs.append(depart)
        routes.append(route)
    _write(path, elements)
    return HeldTrips(
        depart=np.array(departs, dtype=float),
        origin=np.array([region_of[route[0]] for route in routes], dtype=int),
        destination=np.array([region_of[route[-1]] for route in routes], dtype=int),
        orders=tuple(orders),
    )


def _meterable_route(
    element: ElementTree.Element, shared: Mapping[str, tuple[str, ...]]
) -> tuple[str, ...]:
    """Return the edges of a vehicle that can be metered, () of others; SUMO connects the two edges
    of a trip."""
    if not {"id", "depart", "route", "from", "to", "color", *ORDERED}.issuperset(element.attrib):
        return ()
    own = int(element.tag == "vehicle" and "route" not in element.attrib)  # a route of its own
    if len(element) > own or any(
        child.tag != "route" or len(child) or not {"edges", "color"}.issuperset(child.attrib)
        for child in element
    ):
        return ()
    edges, driven = edges_of(element, shared)
    if driven:
        return tuple(edges)
    return tuple(dict.fromkeys(edges)) if element.tag == "trip" and len(edges) == 2 else ()


def _departing(element: ElementTree.Element, name: str, depart: float) -> ElementTree.Element:
    copy = ElementTree.Element(
        element.tag, {**element.attrib, "id": name, "depart": f"{depart:.10g}"}
    )
    copy.extend(element)
    copy.text = element.text
    return copy


def _write(path: Path, elements: Sequence[ElementTree.Element]) -> None:
    lines = [
        f"  {ElementTree.tostring(element, encoding='unicode').strip()}\n" for element in elements
    ]
    files.write_text(path, "".join(["<routes>\n", *lines, "</routes>\n"]))
