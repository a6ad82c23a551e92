"""Traffic of a city: its private vehicles one by one, and all that runs beside them unchanged."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from cosim.importing.case import SumoInput, seconds
from cosim.importing.streets import Streets
from cosim.sumo.arrays import PerTrip, TripNumbers
from cosim.sumo.recorded_trips import BOUND
from cosim.sumo.xml_files import read_xml
from nmfd.errors import InputError

DRIVERS = ("vehicle", "trip", "flow")
OTHERS = ("person", "personFlow", "container", "containerFlow")
DROPPED = ("poly", "poi", "edgeData", "laneData", "timedEvent", "vTypeProbe", "interval")  # no traffic
WRITERS = ("Detector", "Loop", "calibrator", "routeProbe")  # ends of names of elements that write files
WRITING = ("file", "has.ssm.device", "device.toc.file")  # parameters that only make SUMO write files
SAFE_SPEEDS = ("max", "random", "0", "0.0", "0.00")  # departure speeds that can wait for a green
FLOW = ("begin", "end", "number", "period", "vehsPerHour", "perHour", "probability")
ZONES = ("fromTaz", "toTaz", "fromJunction", "toJunction")
ENDLESS_FLOW_S = 3600.0  # length of a flow without an end in a simulation without an end
Kept = tuple[float, int, int, bool, Element]  # departure [s], first and last edge, has a route, vehicle


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """Traffic of a city.

    vehicles: the demand, N `vehicle` and `trip` elements by departure
    depart: (N,) [s]; origin, destination: (N,) edges, numbers of Streets
    background: public transport, persons, and vehicles without a fixed departure
    shared: types, routes, stops, programmes and other contents of the additional files
    switched: signals whose programme a timetable (WAUT) changes
    notes: what was changed or left out -> count
    """

    vehicles: tuple[Element, ...]
    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    background: tuple[Element, ...] = ()
    shared: tuple[Element, ...] = ()
    switched: tuple[str, ...] = ()
    notes: Mapping[str, int] = field(default_factory=dict)


def read_traffic(case: SumoInput, streets: Streets, seed: int) -> Traffic:
    """Read all route and additional files of a case.

    Flows become single vehicles, with departures and routes drawn by `seed` where they are random. Raises InputError.
    """
    return _Reader(case, streets, np.random.default_rng([seed, 0x696D70])).read()


class _Reader:
    def __init__(self, case: SumoInput, streets: Streets, random: np.random.Generator):
        self._case, self._streets, self._random = case, streets, random
        self._moves, self._car_moves = set(map(tuple, streets.all_links)), set(map(tuple, streets.links))
        self._classes: dict[str, str] = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_PEDTYPE": "pedestrian"}
        self._routes: dict[str, list[str]] = {}
        self._notes: Counter[str] = Counter()
        self._background: list[Element] = []

    def read(self) -> Traffic:
        drivers: list[tuple[Element, Path]] = []
        shared: list[Element] = []
        switched: set[str] = set()
        for path in (*self._case.additional, *self._case.routes):
            for element in map(_silent, read_xml(path)):
                if element.tag in DRIVERS:
                    drivers.append((element, path))
                elif element.tag in OTHERS:
                    self._background.append(element)
                elif element.tag not in DROPPED:
                    self._learn(element, path)
                    switched |= {name for e in element.iter("wautJunction") if (name := e.get("junctionID"))}
                    shared.append(element)
        vehicles = []
        for element, path in drivers:
            # SUMO deletes a vehicle that cannot stop from its departure speed at a signal whose programme never gives
            # it green; a signal that is switched from outside has no programme that does.
            if element.get("departSpeed", "max") not in SAFE_SPEEDS:
                element.set("departSpeed", "max")
                self._notes["fixed speeds at the departure, made the highest safe ones"] += 1
            if element.get("line") or self._classes.get(element.get("type", ""), "passenger") in BOUND:
                self._background.append(element)
                self._notes[f"public transport and other classes left alone ({element.tag})"] += 1
            elif element.tag == "flow":
                vehicles += [(single, path) for single in self._expand(element, path)]
            else:
                vehicles.append((element, path))
        kept = self._checked(vehicles)
        if self._background:
            self._notes["persons, containers and vehicles left alone, in all"] = len(self._background)
        depart, origin, destination, _, elements = zip(*kept, strict=True) if kept else ((),) * 5
        return Traffic(
            vehicles=tuple(elements),
            depart=np.array(depart, dtype=float),
            origin=np.array(origin, dtype=int),
            destination=np.array(destination, dtype=int),
            background=tuple(sorted(self._background, key=_begin)),
            shared=tuple(shared),
            switched=tuple(sorted(switched)),
            notes=dict(self._notes),
        )

    def _learn(self, element: Element, path: Path) -> None:
        """Store types and routes that vehicles refer to."""
        name = element.get("id", "")
        if element.tag == "vType":
            self._classes[name] = element.get("vClass", "passenger")
        elif element.tag == "vTypeDistribution":
            members = [e.get("vClass", "passenger") for e in element.iter("vType")]
            members += [self._classes.get(name, "passenger") for name in element.get("vTypes", "").split()]
            first = members[0] if members else "passenger"
            if first == "passenger":  # what lorries among them may drive is not held against the cars
                first = next((kind for kind in members if kind not in (first, *BOUND)), first)
            self._classes[name] = first
            for member in element.iter("vType"):
                self._classes[member.get("id", "")] = member.get("vClass", "passenger")
        elif element.tag in ("route", "routeDistribution"):
            for route in element.iter("route"):
                if edges := route.get("edges"):
                    self._routes[route.get("id", "")] = edges.split()
            if element.tag == "routeDistribution":
                likeliest = max(self._distribution(element, path), key=lambda route: route[0], default=(0.0, []))
                self._routes[name] = likeliest[1]

    def _distribution(self, distribution: Element, path: Path) -> list[tuple[float, list[str]]]:
        """Return (probability, edges) of every route in a distribution. Raises InputError."""
        try:
            routes = [
                (float(route.get("probability", 1.0)), route.get("edges", "").split() or self._named(route, "refId"))
                for route in distribution.iter("route")
            ]
            names = distribution.get("routes", "").split()
            shares = [float(p) for p in distribution.get("probabilities", "").split()] or [1.0] * len(names)
        except ValueError as error:
            raise InputError(f"{path}: routeDistribution: {error}; correct its probability") from None
        return routes + [(p, self._routes.get(name, [])) for p, name in zip(shares, names, strict=False)]

    def _named(self, element: Element, key: str) -> list[str]:
        return self._routes.get(element.get(key, ""), [])

    def _expand(self, flow: Element, path: Path) -> list[Element]:
        """Return the single vehicles of a flow. Raises InputError."""
        where = f"{path}: flow {flow.get('id')}"
        begin = seconds(flow.get("begin", str(self._case.begin)), f"{where}: begin")
        end = seconds(text, f"{where}: end") if (text := flow.get("end")) else None
        stop = min(end if end is not None else self._case.end or begin + ENDLESS_FLOW_S, self._case.end or np.inf)
        per_hour, period = flow.get("vehsPerHour") or flow.get("perHour"), flow.get("period") or ""
        probability = flow.get("probability")
        try:
            number = int(text) if (text := flow.get("number")) else None
            if number == 0 or 0.0 in [float(rate) for rate in (per_hour, probability) if rate]:
                return []
            if match := re.fullmatch(r"exp\((.+)\)", period):
                rate = float(match[1])
                gaps = self._random.exponential(1.0 / rate, size=number or int(3 * rate * (stop - begin) + 30))
                times = begin + np.cumsum(gaps) - (gaps[0] if number else 0.0)
            elif probability:
                times = np.arange(begin, stop)
                times = times[self._random.random(len(times)) < float(probability)]
            else:
                if per_hour:
                    gap = 3600.0 / float(per_hour)
                else:
                    gap = float(period) if period else ((stop if end is None else end) - begin) / (number or 0)
                times = begin + gap * np.arange(int(np.ceil((stop - begin) / gap - 1e-9)))
        except (ValueError, ZeroDivisionError):
            remedy = "expected a number, period, vehsPerHour or probability above 0; correct it"
            raise InputError(f"{where}: {remedy}") from None
        times = times[times < stop][:number]
        routed = flow.get("route") or any(flow.find(tag) is not None for tag in ("route", "routeDistribution"))
        tag = "vehicle" if routed else "trip"
        kept = {key: value for key, value in flow.attrib.items() if key not in FLOW}
        singles = []
        for n, time in enumerate(times):
            single = Element(tag, kept | {"id": f"{flow.get('id')}.{n}", "depart": f"{time:.2f}"})
            single.extend(flow)
            singles.append(single)
        self._notes["vehicles from flows"] += len(singles)
        return singles

    def _checked(self, vehicles: Iterable[tuple[Element, Path]]) -> list[Kept]:
        """Keep vehicles that can drive from their first to their last edge within the simulation, by departure."""
        number, kept, names = self._streets.number, list[Kept](), set[str]()
        begin, end = self._case.begin, self._case.end or np.inf
        for element, path in vehicles:
            try:
                depart = begin if element.get("depart") == "begin" else seconds(element.get("depart", ""), "")
            except InputError:
                self._background.append(element)
                self._notes["vehicles without a time of departure, left alone"] += 1
                continue
            edges, driven = self._edges(element, path)
            if (reason := self._reason(element, depart, begin, end, edges, driven)) is not None:
                self._notes[f"{reason}, left out"] += 1
                continue
            name = element.get("id", "")
            if not name or name in names:
                raise InputError(f"{path}: {element.tag}: id: expected one that no other vehicle has, got {name!r}")
            names.add(name)
            element.set("depart", f"{depart:.2f}")
            kept.append((depart, number[edges[0]], number[edges[-1]], driven, element))
        return self._reachable(sorted(kept, key=lambda row: row[0]))

    def _reason(
        self, element: Element, depart: float, begin: float, end: float, edges: Sequence[str], driven: bool
    ) -> str | None:
        """Return the reason why a vehicle is left out, None without any."""
        number, streets = self._streets.number, self._streets
        if not begin <= depart < end:
            return "vehicles outside the simulated time"
        if not edges and any(key in ZONES or key.endswith(("XY", "LonLat")) for key in element.keys()):
            return "trips between zones, junctions or coordinates, which duarouter would give edges"
        if not edges or any(edge not in number for edge in edges):
            return "vehicles with unknown edges or none"
        numbers = [number[edge] for edge in edges]
        if driven and not self._moves.issuperset(pairwise(numbers)):
            return "vehicles on routes with gaps"
        closed = not streets.drivable[numbers].all() or (driven and not self._car_moves.issuperset(pairwise(numbers)))
        return "cars on streets that are closed to cars" if closed and self._is_car(element) else None

    def _is_car(self, element: Element) -> bool:
        return self._classes.get(element.get("type", ""), "passenger") == "passenger"

    def _edges(self, element: Element, path: Path) -> tuple[list[str], bool]:
        """Return (edges of a vehicle's route, True), or (edges that a trip must pass, False)."""
        nested = element.find("routeDistribution")
        route = element.find("route") if nested is None else None
        if nested is not None:  # as marouter and duarouter write them: a vehicle keeps the route drawn for it here
            routes = self._distribution(nested, path)
            shares = np.cumsum([share for share, _ in routes])
            edges = []
            if routes and shares[-1] > 0:
                edges = routes[int(np.searchsorted(shares, self._random.random() * shares[-1], side="right"))][1]
            element.remove(nested)
            element.append(Element("route", {"edges": " ".join(edges)}))
            for zone in ZONES:
                element.attrib.pop(zone, None)
            return edges, True
        if route is not None:
            route.attrib.pop("id", None)
            return route.get("edges", "").split(), True
        if element.get("route"):
            return self._named(element, "route"), True
        if not element.get("from") or not element.get("to"):
            return [], False
        return [element.get("from", ""), *element.get("via", "").split(), element.get("to", "")], False

    def _reachable(self, kept: list[Kept]) -> list[Kept]:
        """Leave out trips without a path from their first to their last edge."""
        connected = set()
        for cars in (False, True):
            pairs = {row[1:3] for row in kept if not row[3] and self._is_car(row[4]) == cars}
            connected |= {(*pair, cars) for pair in self._streets.connected(pairs, cars=cars)}
        good = [row for row in kept if row[3] or (*row[1:3], self._is_car(row[4])) in connected]
        if len(good) < len(kept):
            self._notes["trips without a way to their end, left out"] += len(kept) - len(good)
        return good


def _silent(element: Element) -> Element:
    """Redirect the files that an element writes to nowhere; return it."""
    for part in element.iter():
        if part.tag.endswith(WRITERS):
            for key in {"file", "output"} & set(part.keys()):
                part.set(key, "NUL")
        for parameter in part.findall("param"):
            if parameter.get("key") in WRITING:
                part.remove(parameter)
    return element


def _begin(element: Element) -> float:
    try:
        return seconds(element.get("depart") or element.get("begin") or "0", "")
    except InputError:
        return 0.0


def wrapped(elements: Iterable[Element], tag: str) -> Element:
    """Put the elements under a common root."""
    root = Element(tag)
    root.extend(elements)
    return root
