"""Planned routes, by first and last edge and quarter of an hour.

A plan is a table of begin of the quarter [s], number of drivers, and route (edges with a space
between them). The vehicles of a run need not be those that the plan was made for: they take the
routes between their own first and last edges in the shares of the plan. Where every run draws other
trips from a demand between regions, those whose ends no route has take parts of routes.
"""

import xml.etree.ElementTree as ElementTree
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from cosim.sumo.arrays import PerTrip
from cosim.sumo.net import City
from cosim.sumo.recorded_trips import DrawnTrip, RecordedTrips, edges_of
from cosim.sumo.xml_files import stream_of
from nmfd.errors import InputError
from nmfd.runs import files

QUARTER_S = 900.0
STREAM = 7103  # keeps these random numbers apart from others of the same seed
COLUMNS = ("begin", "drivers", "route")
Route: TypeAlias = tuple[str, ...]


class Ends(NamedTuple):
    """First and last edge of a trip."""

    first: str
    last: str


class RoutePlan:
    """Drivers by the ends of their trips, quarter of an hour and route."""

    def __init__(self) -> None:
        self._drivers: dict[Ends, dict[int, Counter[Route]]] = {}

    def add(self, depart: float, route: Route, drivers: int = 1) -> None:
        """Add drivers of a route. depart: time of departure (s)"""
        quarters = self._drivers.setdefault(Ends(route[0], route[-1]), {})
        routes = quarters.setdefault(int(depart // QUARTER_S), Counter())
        routes[route] += drivers

    def add_parts(self, trips: Iterable[Ends | None]) -> None:
        """Give trips without a plan the parts of routes between their ends.

        A part of a route of least cost has least cost, too (Bellman's principle of optimality).
        """
        wanted: dict[str, set[str]] = defaultdict(set)
        for ends in trips:
            if ends is not None and ends not in self._drivers:
                wanted[ends.first].add(ends.last)
        for quarters in list(self._drivers.values()):
            for quarter, routes in quarters.items():
                for route, drivers in routes.items():
                    for part in _parts(route, wanted):
                        self.add(quarter * QUARTER_S, part, drivers)

    def quarter(self, ends: Ends, depart: float) -> int | None:
        """Return the nearest planned quarter of an hour; None without a plan.

        depart: time of departure (s)
        """
        quarters = self._drivers.get(ends)
        if not quarters:
            return None
        own = int(depart // QUARTER_S)
        return min(quarters, key=lambda quarter: abs(quarter - own))

    def shared_out(self, ends: Ends, quarter: int, count: int, phase: float) -> list[Route]:
        """Return the routes of so many drivers, in the order of their departures.

        phase: random number from 0 to 1 that decides who gets a share of less than a driver
        """
        routes = self._drivers[ends][quarter]
        cumulated = np.cumsum(list(routes.values()))
        places = (np.arange(count) + phase) / count * cumulated[-1]
        numbers = np.searchsorted(cumulated, places, side="right")
        choices = list(routes)
        return [choices[n] for n in numbers]

    def write(self, path: Path) -> None:
        """Write the plan, by quarter of an hour."""
        import pandas as pd  # slow to import

        rows = []
        for quarters in self._drivers.values():
            for quarter, routes in quarters.items():
                for route, drivers in routes.items():
                    rows.append((quarter * QUARTER_S, drivers, " ".join(route)))
        table = pd.DataFrame(rows, columns=COLUMNS).sort_values("begin", kind="stable")
        with files.atomic(path) as temporary:
            how = {"method": "gzip", "mtime": 0}  # the same plan gives the same bytes
            table.to_csv(temporary, index=False, compression=how)


def read_plan(paths: Iterable[Path], city: City) -> RoutePlan:
    """Return the sum of some plans.

    Raises: InputError for a file that is none, or for a route on edges that are not in the city
    """
    import pandas as pd

    plan = RoutePlan()
    for path in paths:
        with stream_of(path, "a plan of routes", "make it with cosim plan") as stream:
            table = pd.read_csv(stream, usecols=COLUMNS, dtype={"drivers": int, "route": str})
        for row in table.itertuples():
            route = tuple(row.route.split())
            unknown = [edge for edge in route if edge not in city.number]
            if unknown:
                raise InputError(
                    f"{path}: row {row.Index}: edge {unknown[0]} is not in {city.net_file}; make "
                    "it with cosim plan"
                )
            plan.add(row.begin, route, row.drivers)
    return plan


def _parts(route: Route, wanted: Mapping[str, Container[str]]) -> Iterator[Route]:
    """Yield the parts of a route between wanted ends.

    wanted: first edge -> last edges
    """
    for start, first in enumerate(route):
        lasts = wanted.get(first, ())
        for end in range(start + 1, len(route)):
            if route[end] in lasts:
                yield route[start : end + 1]


def ends_of(element: ElementTree.Element, shared: Mapping[str, Sequence[str]]) -> Ends | None:
    """Return the ends of a vehicle that may get another route.

    It is None if the vehicle stops on its way, passes given edges, names no edges, or comes back to
    where it began.
    shared: `recorded_trips.read_routes`
    """
    if element.get("via") or element.find("stop") is not None:
        return None
    edges, _ = edges_of(element, shared)
    if not edges or edges[0] == edges[-1]:
        return None
    return Ends(edges[0], edges[-1])


@dataclass(frozen=True, kw_only=True)
class PlannedTrips:
    """Vehicles of one run, of which some have planned routes.

    originals, drawn: as `recorded_trips.draw` takes and returns them
    planned: ids of those with a plan, whether they follow it or not
    """

    originals: RecordedTrips
    drawn: list[DrawnTrip]
    planned: frozenset[str]


def planned_trips(
    plan: RoutePlan,
    originals: RecordedTrips,
    drawn: Sequence[DrawnTrip],
    shared: Mapping[str, Sequence[str]],
    *,
    seed: int,
    compliance: float,
) -> PlannedTrips:
    """Return the vehicles of one run with planned routes.

    shared: `recorded_trips.read_routes`
    compliance: probability that a driver takes the planned route (-)
    """
    random = np.random.default_rng([seed, STREAM])
    alike: dict[tuple[Ends, int], list[int]] = defaultdict(list)
    for place, (depart, n, _) in enumerate(drawn):
        ends = ends_of(originals.elements[n], shared)
        quarter = None if ends is None else plan.quarter(ends, depart)
        if ends is not None and quarter is not None:
            alike[ends, quarter].append(place)
    routes: dict[int, Route] = {}
    for (ends, quarter), places in alike.items():
        given = plan.shared_out(ends, quarter, len(places), random.random())
        routes.update(zip(places, given, strict=True))
    follows = random.random(len(drawn)) < compliance
    elements = []
    for place, (_, n, _) in enumerate(drawn):
        element = originals.elements[n]
        if place in routes and follows[place]:
            element = _on_route(element, routes[place])
        elements.append(element)
    departures: PerTrip = np.array([row[0] for row in drawn])
    return PlannedTrips(
        originals=RecordedTrips(depart=departures, elements=tuple(elements), types=originals.types),
        drawn=[(row[0], place, row[2]) for place, row in enumerate(drawn)],
        planned=frozenset(drawn[place][2] for place in routes),
    )


def _on_route(element: ElementTree.Element, route: Route) -> ElementTree.Element:
    """Return a vehicle with another route."""
    kept = {}
    for key, value in element.attrib.items():
        if key not in ("route", "from", "to"):
            kept[key] = value
    vehicle = ElementTree.Element("vehicle", kept)
    ElementTree.SubElement(vehicle, "route", edges=" ".join(route))
    vehicle.extend(part for part in element if part.tag != "route")
    return vehicle
