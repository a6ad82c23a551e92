"""The city's own vehicles, as its route file has them: read once, then varied by seed and by demand factor."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.sumo.arrays import PerTrip
from cosim.sumo.net import City
from cosim.sumo.xml_files import attribute, read_xml
from nmfd.errors import InputError
from nmfd.runs import files

STREAM = 7102  # keeps these random numbers apart from others of the same seed
MESOSCOPIC = ("--mesosim", "true", "--meso-junction-control", "true")  # options of SUMO
# Vehicle classes that keep to their lines, or do not use the road as cars do.
BOUND = frozenset({
    "bus", "coach", "tram", "rail", "rail_urban", "rail_electric", "rail_fast", "subway", "cable_car", "ship",
    "aircraft", "bicycle", "pedestrian", "scooter", "wheelchair", "container", "drone"})


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
                "sumo.background or sumo.additional, or let cosim import do so")
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
                f"{element.get('depart')!r} instead; move it to a file in sumo.background") from None
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
                    "vehicle, or give the routes of this network")


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


def draw(
    originals: RecordedTrips, *, seed: int, factor: float, jitter: float, begin: float,
) -> list[tuple[float, int, str]]:
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


def write_recorded_trips(
    originals: RecordedTrips, path: Path, *, seed: int, factor: float, jitter: float, begin: float,
) -> list[str]:
    """Write the vehicles of one run to a SUMO route file; returns their ids. The same seed gives the same bytes."""
    drawn = draw(originals, seed=seed, factor=factor, jitter=jitter, begin=begin)
    lines = ["<routes>\n"]
    for depart, n, name in drawn:
        element = originals.elements[n]
        before = dict(element.attrib)
        element.attrib.update(id=name, depart=f"{depart:.2f}")
        lines.append(f"  {ElementTree.tostring(element, encoding='unicode').strip()}\n")
        element.attrib.update(before)
    files.write_text(path, "".join([*lines, "</routes>\n"]))
    return [name for _, _, name in drawn]
