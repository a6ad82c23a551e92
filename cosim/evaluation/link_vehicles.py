"""Vehicles of the link model: routes, and the average vehicle."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias
from xml.etree.ElementTree import Element

import numpy as np

from cosim.plant.settings import Settings, own_files
from cosim.sumo import recorded_trips as recorded
from cosim.sumo.net import City
from cosim.sumo.programs import run_sumo
from cosim.sumo.recorded_trips import RecordedTrips
from cosim.sumo.trips import make_trips
from cosim.sumo.xml_files import attribute, child, file_list, read_xml, seconds_of
from nmfd.model.scenario import Scenario
from nmfd.runs.files import temporary_folder

Route: TypeAlias = tuple[str, ...]
# Attributes of a vType, and what SUMO's cars have without them.
CAR = {"length": 5.0, "minGap": 2.5, "tau": 1.0, "sigma": 0.5, "accel": 2.6}
MOST_BLOCKED = 0.9  # share of the time
STOPPING_S = 6.0  # that a vehicle loses as it brakes for a stop and starts again
# Word for a position -> share of the length of the street; others mean its beginning.
PLACES = {"random": 0.5, "random_free": 0.5, "center": 0.5, "max": 1.0}


class Drive(NamedTuple):
    """A trip on its way.

    depart: when it is due (s)
    first, last: shares of its first and last streets that it drives (-)
    """

    depart: float
    route: Route
    first: float
    last: float


def draws_of(
    scenario: Scenario, settings: Settings, city: City, seeds: Sequence[int]
) -> list[RecordedTrips]:
    """Return the trips of each seed; one draw of recorded trips."""
    if settings.routes:
        return [recorded.read_recorded_trips(own_files(scenario, settings.routes))]
    made = [make_trips(city, scenario.demand, scenario.step, seed) for seed in seeds]
    return [recorded.as_recorded(trips) for trips in made]


def drives_of(
    trips: RecordedTrips, shared: Mapping[str, Sequence[str]], files: Sequence[Path], city: City
) -> list[Drive]:
    """Return the trips over two or more edges of the city.

    Those without a route take the fastest one in free flow.
    shared: routes of several vehicles; files: with vehicle types
    Raises: InputError
    """
    found = [recorded.edges_of(element, shared) for element in trips.elements]
    ways: dict[str, Route] = {}
    without = [n for n, (_, driven) in enumerate(found) if not driven]
    if without:
        ways = _fastest(trips, without, files, city)
    drives = []
    parts = zip(trips.depart.tolist(), trips.elements, found, strict=True)
    for depart, element, (edges, driven) in parts:
        route = tuple(edges)
        if not driven:
            route = ways.get(attribute(element, "id"), ())
        if len(route) > 1 and city.number.keys() >= set(route):
            begin = _place(element.get("departPos", "base"), city.length[route[0]])
            end = _place(element.get("arrivalPos", "max"), city.length[route[-1]])
            drives.append(Drive(depart, route, 1.0 - begin, end))
    return drives


def _fastest(
    trips: RecordedTrips, numbers: Sequence[int], files: Sequence[Path], city: City
) -> dict[str, Route]:
    """Return vehicle -> its fastest route in free flow.

    Vehicles that have none are left out.
    numbers: of the vehicles
    """
    with temporary_folder() as folder:
        given = folder / "given.rou.xml"
        found = folder / "found.rou.xml"
        drawn = [(float(trips.depart[n]), n, attribute(trips.elements[n], "id")) for n in numbers]
        recorded.write_recorded_trips(trips, drawn, given)
        options: dict[str, object] = {
            "net-file": file_list([city.net_file]),
            "route-files": given,
            "output-file": found,
        }
        if files:
            options["additional-files"] = file_list(files)
        run_sumo("duarouter", options, "--ignore-errors", "--no-warnings", where=str(city.net_file))
        routes = {}
        for vehicle in read_xml(found).iter("vehicle"):
            edges = attribute(child(vehicle, "route"), "edges")
            routes[attribute(vehicle, "id")] = tuple(edges.split())
        return routes


def means_of(trips: RecordedTrips, files: Sequence[Path]) -> dict[str, float]:
    """Return the attributes CAR of the average vehicle.

    files: with vehicle types
    """
    roots = [read_xml(path) for path in files]
    known = {}
    for part in [*trips.types, *roots]:
        for one in part.iter("vType"):
            known[attribute(one, "id")] = _values([one])
        for several in part.iter("vTypeDistribution"):
            known[attribute(several, "id")] = _values(several.iter("vType"))
    usual = _values([])
    own = [known.get(element.get("type", ""), usual) for element in trips.elements]
    return dict(zip(CAR, np.mean(own, axis=0).tolist(), strict=True))


def blocked(
    background: Sequence[Path], additional: Sequence[Path], period: float
) -> dict[str, float]:
    """Return the share of the time in which stopping vehicles block a lane.

    The result has one entry for each lane with stops; those of flows are left out.

    background: files with them, such as buses; additional: files with bus stops
    period: in which they drive (s)
    """
    driving = [read_xml(path) for path in background]
    lane_of = {}
    for root in (*driving, *map(read_xml, additional)):
        for stop in root.iter("busStop"):
            lane_of[attribute(stop, "id")] = attribute(stop, "lane")
    stood: dict[str, float] = defaultdict(float)
    for root in driving:
        for vehicle in (*root.iter("vehicle"), *root.iter("trip")):
            for stop in vehicle.iter("stop"):
                lane = stop.get("lane", lane_of.get(stop.get("busStop", "")))
                duration = seconds_of(stop.get("duration", "0"))
                if lane is not None and duration > 0.0:
                    stood[lane] += duration + STOPPING_S
    return {lane: min(seconds / period, MOST_BLOCKED) for lane, seconds in stood.items()}


def _values(types: Iterable[Element]) -> np.ndarray:
    """Return the attributes CAR, the mean of some vTypes by their probability."""
    rows = []
    weights = []
    for one in types:
        rows.append([float(one.get(name, usual)) for name, usual in CAR.items()])
        weights.append(float(one.get("probability", 1.0)))
    if not rows:
        return np.array(list(CAR.values()))
    return np.average(rows, axis=0, weights=weights)


def _place(text: str, length: float) -> float:
    """Return a position on a street as a share of its length (-).

    text: SUMO's departPos or arrivalPos
    length: (m)
    """
    try:
        place = float(text)
    except ValueError:
        return PLACES.get(text, 0.0)
    if place < 0.0:
        place += length
    return min(max(place / length, 0.0), 1.0)
