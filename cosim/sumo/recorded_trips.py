"""The city's own vehicles, as its route file has them: read once, then varied by seed and by demand factor."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.sumo.arrays import PerTrip
from cosim.sumo.net import City
from cosim.sumo.trips import HeldTrips
from cosim.sumo.xml_files import attribute, read_xml
from nmfd.errors import InputError
from nmfd.runs import files

STREAM = 7102  # keeps these random numbers apart from others of the same seed
MESOSCOPIC = ("--mesosim", "true", "--meso-junction-control", "true")  # options of SUMO
# Vehicle classes that keep to their lines, or do not use the road as cars do.
BOUND = frozenset(
    {
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
        "aircraft",
        "bicycle",
        "pedestrian",
        "scooter",
        "wheelchair",
        "container",
        "drone",
    }
)
DrawnTrip = tuple[float, int, str]  # departure [s], number of the vehicle, id
HELD = "held."  # names of routes that vehicles in the file have to themselves
# Attributes of a vehicle -> arguments of libsumo.vehicle.add, whose defaults are those of the attributes.
ORDERED = {
    "type": "typeID",
    "departLane": "departLane",
    "departPos": "departPos",
    "departSpeed": "departSpeed",
    "arrivalLane": "arrivalLane",
    "arrivalPos": "arrivalPos",
    "arrivalSpeed": "arrivalSpeed",
}


@dataclass(frozen=True, kw_only=True)
class RecordedTrips:
    """N vehicles or trips. depart: (N,) [s]; elements: their XML, without anything that another one repeats."""

    depart: PerTrip
    elements: tuple[ElementTree.Element, ...]


def read_recorded_trips(paths: Sequence[Path]) -> RecordedTrips:
    """The `vehicle` and `trip` elements of SUMO route files. Raises InputError.

    Every one must have a time as its depart; types and routes that several share belong to an additional file.
    """
    elements = []
    for path in paths:
        root = read_xml(path)
        if root.tag != "routes":
            raise InputError(f"{path}: expected a SUMO route file, got a file of <{root.tag}> instead")
        elements += [(path, element) for element in root]
    departs, ids = np.empty(len(elements)), set()
    for n, (path, element) in enumerate(elements):
        if element.tag not in ("vehicle", "trip"):
            raise InputError(
                f"{path}: expected vehicle and trip elements only, got {element.tag} instead; move it to a file in "
                "sumo.background or sumo.additional, or let cosim import do so"
            )
        name = element.get("id")
        if not name or name in ids:
            raise InputError(f"{path}: {element.tag} {n}: id: expected one that no other has, got {name!r} instead")
        ids.add(name)
        try:
            departs[n] = float(element.attrib["depart"])
            if not 0.0 <= departs[n] < math.inf:
                raise ValueError
        except (KeyError, ValueError):
            raise InputError(
                f"{path}: vehicle {element.get('id')}: depart: expected a time from 0 s up, got "
                f"{element.get('depart')!r} instead; move it to a file in sumo.background"
            ) from None
    order = np.argsort(departs, kind="stable")
    return RecordedTrips(depart=departs[order], elements=tuple(elements[n][1] for n in order))


def check_edges(originals: RecordedTrips, city: City, where: str) -> None:
    """InputError for a vehicle on an edge that the city does not have: SUMO would leave it out without a word."""
    for element in originals.elements:
        route = element.find("route")
        ends = [element.get(key) for key in ("from", "to") if element.get(key)]
        edges = [*ends, *element.get("via", "").split(), *("" if route is None else route.get("edges", "")).split()]
        for edge in edges:
            if edge not in city.region_of:
                raise InputError(
                    f"{where}: {element.tag} {element.get('id')}: edge {edge} is not in {city.net_file}; remove the "
                    "vehicle, or give the routes of this network"
                )


def read_routes(paths: Sequence[Path]) -> dict[str, tuple[str, ...]]:
    """Name -> edges of the routes that additional files define for vehicles to share; of a distribution, its first."""
    found: dict[str, tuple[str, ...]] = {}
    for path in paths:
        root = read_xml(path)
        for route in root.iter("route"):
            name, edges = route.get("id"), route.get("edges")
            if name and edges:
                found[name] = tuple(edges.split())
        for distribution in root.iter("routeDistribution"):
            routes = [tuple(edges.split()) for r in distribution.iter("route") if (edges := r.get("edges"))]
            routes += [found[name] for name in distribution.get("routes", "").split() if name in found]
            if routes and (name := distribution.get("id")):
                found[name] = routes[0]
    return found


def edges_of(element: ElementTree.Element, routes: Mapping[str, Sequence[str]]) -> tuple[Sequence[str], bool]:
    """(the edges of a vehicle's route, True), or (those that it must pass, False)."""
    route = element.find("route")
    if route is not None:
        return route.get("edges", "").split(), True
    if name := element.get("route"):
        return routes.get(name, ()), True
    return [edge for key in ("from", "via", "to") for edge in element.get(key, "").split()], False


def draw(originals: RecordedTrips, *, seed: int, factor: float, jitter: float, begin: float) -> list[DrawnTrip]:
    """(departure [s], number of the vehicle, its id) sorted by departure, for one run.

    factor: the demand is multiplied by it. Vehicles are left out, or driven twice or more (ids with .1, .2 and so on),
    by seeded choice; 1 is every vehicle once.
    jitter: every departure is moved by up to this [s], either way, but not before `begin` [s].
    """
    rng = np.random.default_rng([seed, STREAM])
    count = len(originals.depart)
    chosen = np.full(count, int(factor))
    chosen[rng.permutation(count)[: round((factor - int(factor)) * count)]] += 1
    shifts = rng.uniform(-jitter, jitter, size=(max(int(chosen.max(initial=0)), 1), count))
    names = [attribute(element, "id") for element in originals.elements]
    taken = set(names)
    drawn = []
    for n, times in enumerate(chosen):
        name = names[n]
        for copy in range(times):
            depart = max(float(originals.depart[n] + shifts[copy, n]), min(begin, float(originals.depart[n])))
            drawn.append((round(depart, 2), n, _copy(name, copy, taken) if copy else name))
    return sorted(drawn, key=lambda vehicle: vehicle[:2])


def _copy(name: str, number: int, taken: set[str]) -> str:
    """An id that no other vehicle has: the flow x has an x.1 of its own, and so may a vehicle x."""
    while (found := f"{name}.{number}") in taken:
        name += "."
    return found


def write_recorded_trips(originals: RecordedTrips, drawn: Sequence[DrawnTrip], path: Path) -> None:
    """Write the vehicles of one run to a SUMO route file. The same ones give the same bytes."""
    _write(path, [_departing(originals.elements[n], name, depart) for depart, n, name in drawn])


def write_held_trips(
    originals: RecordedTrips,
    drawn: Sequence[DrawnTrip],
    path: Path,
    shared: Mapping[str, tuple[str, ...]],
    region_of: Mapping[str, int],
) -> HeldTrips:
    """Those of one run that can be made to wait; their routes and all other vehicles are written to a SUMO route file.

    shared: `read_routes`; region_of: of edges. Who stops on the way, goes by way of certain edges, or has an attribute
    that cannot be told to SUMO while it runs, is a vehicle of the file.
    """
    elements, written, held = [], set[int](), list[tuple[float, tuple[str, ...], dict[str, str]]]()
    for depart, n, name in drawn:
        element = originals.elements[n]
        route = _waiting_route(element, shared)
        if not route:
            elements.append(_departing(element, name, depart))
            continue
        known = element.get("route", f"{HELD}{n}")
        if "route" not in element.attrib and n not in written:
            written.add(n)
            elements.append(ElementTree.Element("route", id=known, edges=" ".join(route)))
        order = {ORDERED[key]: value for key, value in element.attrib.items() if key in ORDERED}
        held.append((depart, route, {"vehID": name, "routeID": known, **order}))
    _write(path, elements)
    return HeldTrips(
        depart=np.array([depart for depart, _, _ in held]),
        origin=np.array([region_of[route[0]] for _, route, _ in held], dtype=int),
        destination=np.array([region_of[route[-1]] for _, route, _ in held], dtype=int),
        routes=tuple(route for _, route, _ in held),
        orders=tuple(order for _, _, order in held),
    )


def _waiting_route(element: ElementTree.Element, shared: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """The edges of a vehicle that a program can let begin; none of one that it cannot. Between two edges that do not
    meet SUMO looks for the way."""
    if not {"id", "depart", "route", "from", "to", "color", *ORDERED}.issuperset(element.attrib):
        return ()
    brings = int(element.tag == "vehicle" and "route" not in element.attrib)  # a route of its own
    if len(element) > brings or any(
        one.tag != "route" or len(one) or not {"edges", "color"}.issuperset(one.attrib) for one in element
    ):
        return ()
    edges, driven = edges_of(element, shared)
    if driven:
        return tuple(edges)
    return tuple(dict.fromkeys(edges)) if element.tag == "trip" and len(edges) == 2 else ()


def _departing(element: ElementTree.Element, name: str, depart: float) -> ElementTree.Element:
    copy = ElementTree.Element(element.tag, {**element.attrib, "id": name, "depart": f"{depart:.2f}"})
    copy.extend(element)
    copy.text = element.text
    return copy


def _write(path: Path, elements: Sequence[ElementTree.Element]) -> None:
    lines = [f"  {ElementTree.tostring(element, encoding='unicode').strip()}\n" for element in elements]
    files.write_text(path, "".join(["<routes>\n", *lines, "</routes>\n"]))
