"""What drives in the city: its private vehicles one by one, and all that is left alone."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TypeVar
from xml.etree.ElementTree import Element

import numpy as np

from cosim.importing.case import SumoInput, seconds
from cosim.importing.harmless import silent, softened
from cosim.importing.od import Cell, read_od, relations, trips
from cosim.importing.streets import Streets
from cosim.sumo.arrays import PerTrip, TripNumbers
from cosim.sumo.recorded_trips import BOUND
from cosim.sumo.xml_files import Missing, attribute, read_xml
from nmfd.errors import InputError

DRIVERS = ("vehicle", "trip", "flow")
OTHERS = ("person", "personFlow", "container", "containerFlow")
DROPPED = ("poly", "poi", "edgeData", "laneData", "timedEvent", "vTypeProbe")  # only draw or write
FLOW = ("begin", "end", "number", "period", "vehsPerHour", "perHour", "probability")
ENDS = {"from": ("fromTaz", "fromJunction"), "to": ("toTaz", "toJunction")}
What = TypeVar("What")
OPEN_END = 3600.0  # s, of a flow that never ends in a simulation that never ends


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """vehicles: the demand, `vehicle` and `trip` elements by departure
    depart: (N,) [s]; origin, destination: (N,) edges, numbers of Streets
    background: public transport, persons and whatever departs at no fixed time, by begin
    shared: what these refer to, and the contents of the additional files: types, routes, stops, programmes
    switched: signals whose programme a timetable (WAUT) changes
    notes: what was found and left out, in words -> how often
    """

    vehicles: tuple[Element, ...]
    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    background: tuple[Element, ...] = ()
    shared: tuple[Element, ...] = ()
    switched: tuple[str, ...] = ()
    notes: Mapping[str, int] = field(default_factory=dict)


def read_traffic(
    case: SumoInput, streets: Streets, seed: int, od: Sequence[Path] = (), zones: Sequence[Path] = ()
) -> Traffic:
    """All route and additional files of the case, and the OD matrices `od` between TAZ of these or of `zones`. Flows
    and matrices become single vehicles, and TAZ and junctions the edges drawn for them (by `seed`); all else stays as
    it is. Raises InputError for a file that is no XML, a broken time, and matrices beside vehicles."""
    return _Reader(case, streets, np.random.default_rng([seed, 0x696D70])).read(od, zones)


class _Reader:
    def __init__(self, case: SumoInput, streets: Streets, random: np.random.Generator):
        self._case, self._streets, self._random = case, streets, random
        self._moves, self._car_moves = set(map(tuple, streets.all_links)), set(map(tuple, streets.links))
        self._classes: dict[str, str] = {"DEFAULT_BIKETYPE": "bicycle", "DEFAULT_PEDTYPE": "pedestrian"}
        self._routes: dict[str, list[str]] = {}
        self._zones: dict[str, dict[str, list[tuple[str, float]]]] = {}
        self._notes: Counter[str] = Counter()

    def read(self, od: Sequence[Path], zones: Sequence[Path]) -> Traffic:
        drivers: list[tuple[Element, Path]] = []
        shared: list[Element] = []
        others: list[Element] = []
        switched: set[str] = set()
        cells: list[Cell] = []
        for path in zones:
            self._learn(read_xml(path), path)
        for path in (*self._case.additional, *self._case.routes):
            for element in map(silent, read_xml(path)):
                if element.tag in DRIVERS:
                    drivers.append((element, path))
                elif element.tag in OTHERS:
                    others.append(element)
                elif element.tag == "interval":
                    cells += relations(wrapped([element], "data"), path)
                elif element.tag not in DROPPED:
                    self._learn(element, path)
                    switched |= {name for e in element.iter("wautJunction") if (name := e.get("junctionID"))}
                    shared.append(element)
        vehicles, background = [], others
        for element, path in drivers:
            if softened(element):
                self._notes["fixed speeds at the departure, made the highest safe ones"] += 1
            if element.get("line") or self._classes.get(element.get("type", ""), "passenger") in BOUND:
                background.append(element)
                self._notes[f"public transport and other classes left alone ({element.tag})"] += 1
            elif element.tag == "flow":
                vehicles += [(single, path) for single in self._expand(element, path)]
            else:
                vehicles.append((element, path))
        vehicles += self._from_matrices(cells, od, len(vehicles))
        return self._checked(vehicles, background, shared, switched)

    def _from_matrices(self, cells: list[Cell], od: Sequence[Path], vehicles: int) -> list[tuple[Element, Path]]:
        """Trips of the matrices, those of the case's own files only where it has no vehicles."""
        if vehicles and od:
            raise InputError(
                f"--od: {self._case.source} has {vehicles:,} vehicles of its own; omit --od, or give the network alone"
            )
        if vehicles and cells:
            self._notes["relations between zones, left out: there are vehicles"] = len(cells)
            return []
        cells = cells + [cell for path in od for cell in read_od(path)]
        for cell in cells:
            for name in (cell.origin, cell.destination):
                if name not in (self._zones if cell.zones else self._streets.number):
                    kind, remedy = ("TAZ", "define it in a file for --zones") if cell.zones else ("edge", "correct it")
                    raise InputError(f"{cell.where}: {kind} {name!r} is unknown; {remedy}")
        made = trips(cells, self._random, self._classes.keys(), self._notes.__setitem__) if cells else []
        return [(trip, self._case.source) for trip in made]

    def _learn(self, element: Element, path: Path) -> None:
        """Types, routes and zones that vehicles refer to."""
        try:
            self._learn_one(element)
        except Missing as error:
            raise InputError(f"{path}: {error}; add it") from None
        except ValueError as error:
            raise _no_number(element, path, error) from None

    def _learn_one(self, element: Element) -> None:
        if element.tag == "vType":
            self._classes[attribute(element, "id")] = element.get("vClass", "passenger")
        elif element.tag == "vTypeDistribution":
            members = [e.get("vClass", "passenger") for e in element.iter("vType")]
            members += [self._classes.get(name, "passenger") for name in element.get("vTypes", "").split()]
            first = members[0] if members else "passenger"
            if first == "passenger":  # what lorries among them may drive is not held against the cars
                first = next((kind for kind in members if kind not in (first, *BOUND)), first)
            self._classes[attribute(element, "id")] = first
            for member in element.iter("vType"):
                self._classes[attribute(member, "id")] = member.get("vClass", "passenger")
        elif element.tag in ("route", "routeDistribution"):
            for route in element.iter("route"):
                if edges := route.get("edges"):
                    self._routes[route.get("id", "")] = edges.split()
            if element.tag == "routeDistribution":
                self._routes[attribute(element, "id")] = self._likeliest(element)
        for zone in element.iter("taz"):
            inside = [(edge, 1.0) for edge in zone.get("edges", "").split()]
            self._zones[attribute(zone, "id")] = {
                key: inside + [(attribute(e, "id"), float(e.get("weight", 1.0))) for e in zone.iter(tag)]
                for key, tag in (("from", "tazSource"), ("to", "tazSink"))
            }

    def _likeliest(self, distribution: Element) -> list[str]:
        """The edges of the route in a distribution that is driven most."""
        return max(self._distribution(distribution), key=lambda route: route[0], default=(0.0, []))[1]

    def _distribution(self, distribution: Element) -> list[tuple[float, list[str]]]:
        """(probability, edges) of every route in a distribution."""
        routes = [
            (float(r.get("probability", 1.0)), r.get("edges", "").split() or self._routes.get(r.get("refId", ""), []))
            for r in distribution.iter("route")
        ]
        names = distribution.get("routes", "").split()
        shares = [float(p) for p in distribution.get("probabilities", "").split()] or [1.0] * len(names)
        return routes + [(p, self._routes.get(name, [])) for p, name in zip(shares, names, strict=False)]

    def _expand(self, flow: Element, path: Path) -> list[Element]:
        """The single vehicles of a flow."""
        where = f"{path}: flow {flow.get('id')}"
        begin = seconds(flow.get("begin", str(self._case.begin)), f"{where}: begin")
        end = seconds(text, f"{where}: end") if (text := flow.get("end")) else None
        stop = min(end if end is not None else self._case.end or begin + OPEN_END, self._case.end or np.inf)
        per_hour, period = flow.get("vehsPerHour") or flow.get("perHour"), flow.get("period")
        probability = flow.get("probability")
        try:
            number = int(text) if (text := flow.get("number")) else None
            if number == 0 or 0.0 in [float(rate) for rate in (per_hour, probability) if rate]:
                return []
            if match := re.fullmatch(r"exp\((.+)\)", period or ""):
                rate = float(match[1])
                gaps = self._random.exponential(1.0 / rate, size=number or int(3 * rate * (stop - begin) + 30))
                times = begin + np.cumsum(gaps) - (gaps[0] if number else 0.0)
            elif probability:
                seconds_of = np.arange(begin, stop)
                times = seconds_of[self._random.random(len(seconds_of)) < float(probability)]
            else:
                if per_hour:
                    gap = 3600.0 / float(per_hour)
                elif period:
                    gap = float(period)
                elif number is None:
                    raise ValueError
                else:
                    gap = ((end if end is not None else stop) - begin) / number
                times = begin + gap * np.arange(int(np.ceil((stop - begin) / gap - 1e-9)))
        except (ValueError, ZeroDivisionError):
            raise InputError(
                f"{where}: expected a number, period, vehsPerHour or probability above 0; correct it"
            ) from None
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

    def _checked(
        self,
        vehicles: Iterable[tuple[Element, Path]],
        background: list[Element],
        shared: Sequence[Element],
        switched: Iterable[str],
    ) -> Traffic:
        """Only what can be driven from its first to its last edge within the simulation."""
        number = self._streets.number
        kept: list[tuple[float, int, int, bool, Element]] = []
        begin, end = self._case.begin, np.inf if self._case.end is None else self._case.end
        files: dict[str, Path] = {}
        for element, path in vehicles:
            try:
                depart = begin if element.get("depart") == "begin" else seconds(element.get("depart", ""), "")
            except InputError:
                background.append(element)
                self._notes["vehicles without a time of departure, left alone"] += 1
                continue
            if not begin <= depart < end:
                self._notes["vehicles outside the simulated time, left out"] += 1
                continue
            try:
                edges, driven = self._edges(element)
            except ValueError as error:
                raise _no_number(element, path, error) from None
            if not edges and any(key.endswith(("XY", "LonLat")) for key in element.keys()):
                self._notes["trips between coordinates, left out: give them edges with duarouter"] += 1
            elif not edges or any(edge not in number for edge in edges):
                self._notes["vehicles with unknown edges or none, left out"] += 1
            elif driven and not self._moves.issuperset(pairwise(map(number.get, edges))):
                self._notes["vehicles on routes with gaps, left out"] += 1
            elif self._is_car(element) and not self._open_to_cars([number[edge] for edge in edges], driven):
                self._notes["cars on streets that are closed to cars, left out"] += 1
            else:
                name = element.get("id")
                if not name or name in files:
                    raise InputError(
                        f"{path}: {element.tag}: id: expected one that no other vehicle has, got {name!r}"
                        + (f", which {files[name]} has too" if name else "")
                        + "; give it another one"
                    )
                files[name] = path
                element.set("depart", f"{depart:.2f}")
                kept.append((depart, number[edges[0]], number[edges[-1]], driven, element))
        kept.sort(key=lambda row: row[0])
        kept = self._reachable(kept)
        background.sort(key=_begin)
        if background:
            self._notes["persons, containers and vehicles left alone, in all"] = len(background)
        columns = (np.array([row[n] for row in kept], dtype=kind) for n, kind in ((0, float), (1, int), (2, int)))
        depart, origin, destination = columns
        return Traffic(
            vehicles=tuple(row[4] for row in kept),
            depart=depart,
            origin=origin,
            destination=destination,
            background=tuple(background),
            shared=tuple(shared),
            switched=tuple(sorted(switched)),
            notes=dict(self._notes),
        )

    def _is_car(self, element: Element) -> bool:
        return self._classes.get(element.get("type", ""), "passenger") == "passenger"

    def _open_to_cars(self, edges: Sequence[int], driven: bool) -> bool:
        return bool(self._streets.drivable[list(edges)].all()) and (
            not driven or self._car_moves.issuperset(pairwise(edges))
        )

    def _edges(self, element: Element) -> tuple[list[str], bool]:
        """(the edges of a vehicle's route, True), or (those that a trip must pass, False)."""
        nested = element.find("routeDistribution")
        route = element.find("route") if nested is None else None
        if nested is not None:  # as marouter and duarouter write them: a vehicle keeps the route drawn for it here
            edges = self._pick([(edges, share) for share, edges in self._distribution(nested)]) or []
            element.remove(nested)
            element.append(Element("route", {"edges": " ".join(edges)}))
            for other in (*ENDS["from"], *ENDS["to"]):
                element.attrib.pop(other, None)
            return edges, True
        if route is not None:
            route.attrib.pop("id", None)
            return route.get("edges", "").split(), True
        if name := element.get("route"):
            return self._routes.get(name, []), True
        for key, alike in ENDS.items():
            if not element.get(key):
                chosen = self._draw(element, key, alike)
                for other in alike:
                    element.attrib.pop(other, None)
                if chosen is None:
                    return [], False
                element.set(key, chosen)
        return [attribute(element, "from"), *element.get("via", "").split(), attribute(element, "to")], False

    def _draw(self, element: Element, key: str, alike: tuple[str, str]) -> str | None:
        """An edge of the zone, or at the junction, where a trip begins or ends."""
        zone, junction = (element.get(name) for name in alike)
        if zone in self._zones:
            options = self._usable(self._zones[zone][key], key)
        else:
            place = self._streets.places.get(junction or "", -1)
            at = self._streets.junctions[:, 0 if key == "from" else 1] == place
            options = [(self._streets.edges[n], 1.0) for n in np.flatnonzero(at & self._streets.drivable)]
        return self._pick(options)

    def _pick(self, options: Sequence[tuple[What, float]]) -> What | None:
        """One of (what, weight), drawn by weight; None where there is none."""
        weights = np.cumsum([weight for _, weight in options])
        if not options or weights[-1] <= 0:
            return None
        return options[int(np.searchsorted(weights, self._random.random() * weights[-1], side="right"))][0]

    def _usable(self, options: list[tuple[str, float]], key: str) -> list[tuple[str, float]]:
        """Of the edges of a zone those of cars; of these, if there are any, those that are joined to the rest."""
        number, joined = self._streets.number, self._streets.onward if key == "from" else self._streets.reached
        options = [
            (edge, weight) for edge, weight in options if edge in number and self._streets.drivable[number[edge]]
        ]
        return [option for option in options if joined[number[option[0]]]] or options

    def _reachable(
        self, kept: list[tuple[float, int, int, bool, Element]]
    ) -> list[tuple[float, int, int, bool, Element]]:
        """Without trips whose end cannot be reached from their beginning by any vehicle, or that of cars by cars."""
        lost = set()
        for cars in (False, True):
            pairs = {row[1:3] for row in kept if not row[3] and self._is_car(row[4]) == cars}
            lost |= {(*pair, cars) for pair, ok in self._streets.connected(pairs, cars=cars).items() if not ok}
        good = [row for row in kept if row[3] or (*row[1:3], self._is_car(row[4])) not in lost]
        if len(good) < len(kept):
            self._notes["trips without a way to their end, left out"] += len(kept) - len(good)
        return good


def _no_number(element: Element, path: Path, error: ValueError) -> InputError:
    return InputError(
        f"{path}: {element.tag} {element.get('id')}: weight or probability: expected a number ({error}); correct it"
    )


def _begin(element: Element) -> float:
    try:
        return seconds(element.get("depart") or element.get("begin") or "0", "")
    except InputError:
        return 0.0


def wrapped(elements: Iterable[Element], tag: str) -> Element:
    """The elements under a common root."""
    root = Element(tag)
    root.extend(elements)
    return root
