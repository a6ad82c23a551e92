"""Traffic of a city: private vehicles one by one, and all beside them."""

import math
import re
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from cosim.importing import quiet_files
from cosim.importing.case import SumoInput, seconds
from cosim.importing.streets import Streets
from cosim.sumo.arrays import PerTrip, TripNumbers
from cosim.sumo.departures import Departure, Departures, original, read_departures
from cosim.sumo.recorded_trips import BOUND, QUEUED_AFTER, named_edges
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder

DRIVERS = ("vehicle", "trip", "flow")
OTHERS = ("person", "personFlow", "container", "containerFlow")
ACTING = ("calibrator", "rerouter")  # they act on every run, and not on what SUMO reads
SAFE_SPEEDS = ("max", "random", "0", "0.0", "0.00")  # departure speeds that can wait for a green
FLOW = ("begin", "end", "number", "period", "vehsPerHour", "perHour", "probability")
ZONES = ("fromTaz", "toTaz", "fromJunction", "toJunction")
TRIGGERED = ("triggered", "containerTriggered", "split", "now")  # departures without a time
DEFAULT_TYPE = "DEFAULT_VEHTYPE"
ENDLESS_FLOW_S = 3600.0  # length of a simulation without an end that has a flow without an end
SHORT_DELAY_S = 60.0  # of waiting to enter, after which SUMO gives up vehicles
NAMES = re.compile(r"'[^']*'|[\d.]+")  # of things, in SUMO's words
# Notes: what was changed or left out, to be counted.
ENDLESS = "s are simulated, as a flow has no end (--end for another time)"
FAST = "fixed speeds at the departure, made the highest safe ones"
FROM_FLOWS = "vehicles from flows"
ON_ROAD = "vehicles on the road in the loaded state, begin where they are"
WAITING = "vehicles without a time of departure, left alone"
BUSES = "public transport and other classes left alone"
ALONE = "persons, containers and vehicles left alone, in all"
NOWHERE = "vehicles on edges that the network has not, left out"
NO_ROUTE = "vehicles without a route that SUMO could drive, left out"
EARLY = "vehicles that depart before the simulation begins"


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """Traffic of a city.

    vehicles: the demand, N `vehicle` and `trip` elements by departure
    depart: (N,) [s]; origin, destination: (N,) edges, numbers of Streets
    routes: edges -> number of vehicles of the demand
    background: public transport, persons, and vehicles without a fixed departure
    shared: types, routes, stops, programmes and other contents of the additional files
    notes: what was changed or left out -> count
    remarks: examples of what was left out, and SUMO's own words about the files
    left_out: shares of SUMO's vehicles, and of the distance that they would drive [-], that are not
        taken over
    given: all vehicles and flows of the files, by `_key`
    end: later vehicles were not read [s]
    """

    vehicles: tuple[Element, ...]
    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    routes: Mapping[tuple[int, ...], int] = field(default_factory=dict)
    background: tuple[Element, ...] = ()
    shared: tuple[Element, ...] = ()
    notes: Mapping[str, int] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    left_out: tuple[float, float] = (0.0, 0.0)
    given: frozenset[str] = frozenset()
    end: float = math.inf

    def is_private(self, vehicle: str) -> bool:
        """Return True for a trip of the demand, even if it was left out.

        Buses and the like, and vehicles that calibrators or persons make, are none.
        """
        source = original(vehicle, self.given)
        return bool(source) and not {vehicle, source} & self._beside

    @cached_property
    def _beside(self) -> set[str]:
        return set(map(_key, self.background))


class _Trip(NamedTuple):
    """Trip of the demand; first, last: numbers of edges."""

    depart: float
    first: int
    last: int
    element: Element


def read_traffic(case: SumoInput, streets: Streets, seed: int) -> Traffic:
    """Return what SUMO reads from all route and additional files of a case.

    Flows become single vehicles; what is random is drawn by SUMO with `seed`. Raises InputError.
    """
    reading = Reading(case, streets)
    for root in quiet_files.read(case):
        reading.file(root)
    departures = reading.departures(seed)
    reading.departed(departures)
    return reading.traffic(departures)


class Reading:
    """Traffic of a case while it is read.

    First come its files, and then the vehicles that SUMO makes of them.
    """

    def __init__(self, case: SumoInput, streets: Streets):
        self._case = case
        self._streets = streets
        # What the files hold.
        self._files: list[Element] = []  # for SUMO to read
        self._given: dict[str, Element] = {}  # vehicles, trips and flows by `_key`
        self._astray: dict[str, str] = {}  # of these, those on an edge that does not exist
        self._background: list[Element] = []
        self._shared: list[Element] = []
        self._end = case.end
        self._latest = 0.0  # when the last vehicle, person or flow begins [s]
        # What SUMO makes of it.
        self._trips: list[_Trip] = []
        self._ids: set[str] = set()
        self._routeless: list[str] = []
        self._metres = 0.0  # that all vehicles would drive
        self._metres_kept = 0.0
        self._queued: dict[int, float] = {}  # step of the simulation -> last departure
        self._cars_at = Counter[float]()  # departure -> trips
        self._routes = Counter[tuple[int, ...]]()
        self._notes = Counter[str]()

    def file(self, root: Element) -> None:
        """Take the contents of a file of quiet_files."""
        for_sumo = Element(root.tag)
        for element in root:
            read = element
            if element.tag in DRIVERS:
                read = self._driver(element)
            elif element.tag in OTHERS:
                self._background.append(element)
            else:
                self._shared.append(element)
            if element.tag in (*DRIVERS, *OTHERS):
                self._latest = max(self._latest, departure(element))
            if element.tag not in ACTING:
                for_sumo.append(read)
        self._files.append(for_sumo)

    def _driver(self, element: Element) -> Element:
        """Take a vehicle, trip or flow; return what SUMO shall read for it."""
        name = _key(element)
        self._given[name] = element
        if _waits(element):
            self._background.append(element)
        is_endless = element.tag == "flow" and not {"end", "number"} & element.attrib.keys()
        if is_endless and self._end is None:
            self._end = self._case.begin + ENDLESS_FLOW_S
            self._notes[ENDLESS] = int(ENDLESS_FLOW_S)
        for edge in named_edges(element):
            if edge not in self._streets.number:
                self._astray[name] = edge
                return _stand_in(element, self._streets)
        return element

    def departures(self, seed: int) -> Departures:
        """Let SUMO read the vehicles of all files. Raises InputError."""
        case = self._case
        options = case.sumo_options() | {"seed": seed}
        with temporary_folder() as folder:
            options |= quiet_files.write(self._files, folder)
            return read_departures(
                options,
                given={name: _waits(element) for name, element in self._given.items()},
                devices=case.devices,
                end=self._end,
                latest=self._latest,
                where=str(case.source),
            )

    def departed(self, departures: Departures) -> None:
        """Take the vehicles that SUMO read. Raises InputError if two have one id."""
        parts = [part for element in self._shared for part in element.iter()]
        routes = {part.get("id", "") for part in parts if part.tag == "route"}
        for part in parts:
            if part.tag == "vType":
                part.attrib.pop("scale", None)  # SUMO has multiplied its vehicles already
        for vehicle in departures.vehicles:
            self._vehicle(vehicle, routes)
        self._routeless += departures.dropped
        self._notes[WAITING] = len(departures.timeless)

    def _vehicle(self, vehicle: Departure, routes: Container[str]) -> None:
        """Take a vehicle that SUMO read; routes: ids of shared ones."""
        name = original(vehicle.id, self._given)
        if name in self._astray:
            self._notes[NOWHERE] += 1
            return
        if not name and vehicle.place is None:
            return  # of a person, who makes it in every run
        number = self._streets.number
        edges = [number[edge] for edge in vehicle.edges if edge in number]
        metres = float(self._streets.length[edges].sum())
        self._metres += metres
        if not edges or not (vehicle.valid or self._case.gaps):
            self._routeless.append(vehicle.id)
            return
        if vehicle.id in self._ids:
            raise InputError(
                f"{self._case.source}: vehicle {vehicle.id}: another one has this id; rename one "
                "of them"
            )
        self._ids.add(vehicle.id)
        self._metres_kept += metres
        depart = self._place(vehicle)
        element = self._element(vehicle, self._given.get(name), routes)
        element.set("depart", f"{depart:.10g}")
        if vehicle.line or vehicle.kind in BOUND:
            cars_before = str(self._cars_at[depart])
            SubElement(element, "param", {"key": QUEUED_AFTER, "value": cars_before})
            self._background.append(element)
            self._notes[BUSES] += 1
            return
        self._cars_at[depart] += 1
        self._routes[tuple(edges)] += 1
        first = edges[_index(element.get("departEdge", ""), 0)]
        last = edges[_index(element.get("arrivalEdge", ""), -1)]
        self._trips.append(_Trip(depart, first, last, element))

    def _place(self, vehicle: Departure) -> float:
        """Return a departure [s] that keeps the place in SUMO's queue.

        SUMO inserts the vehicles of a step in the order in which it built them, and a file is
        sorted by time: so none may have an earlier time than one before it in the queue. SUMO
        finds the route of a file's vehicle in the last step before its departure, but that of a
        flow's in the step that builds it. Where it soon gives up vehicles that wait, the exact
        departure matters more.
        """
        depart = vehicle.depart
        milliseconds = round(1000.0 * self._case.step_length)
        step = math.ceil(round(1000.0 * depart) / milliseconds)
        patience = self._case.options.get("max-depart-delay", "-1")
        gives_up = 0.0 <= seconds(patience, str(self._case.source)) <= SHORT_DELAY_S
        if vehicle.routed and not gives_up:
            depart = max(depart, min(vehicle.built, step * milliseconds / 1000.0))
        depart = max(depart, self._queued.get(step, depart))
        self._queued[step] = depart
        return depart

    def _element(
        self, vehicle: Departure, source: Element | None, routes: Container[str]
    ) -> Element:
        """Return a vehicle for the scenario, and note what was changed.

        source: its element, or that of its flow; routes: ids of shared ones
        """
        if vehicle.place is not None or source is None:
            lane, position = vehicle.place or ("best", "base")
            place = {"departLane": lane, "departPos": position, "departSpeed": "max"}
            element = Element("vehicle", {**_drawn(vehicle), "type": vehicle.type, **place})
            SubElement(element, "route", {"edges": " ".join(vehicle.edges)})
            self._notes[ON_ROAD] += 1
        else:
            element = _single(vehicle, source, routes)
            self._notes[FROM_FLOWS] += source.tag == "flow"
        # SUMO deletes a vehicle that cannot stop from its departure speed at a signal whose
        # programme never gives it green; a signal that is switched from outside has no programme
        # that does.
        if element.get("departSpeed", "max") not in SAFE_SPEEDS:
            element.set("departSpeed", "max")
            self._notes[FAST] += 1
        for device in vehicle.devices:
            SubElement(element, "param", {"key": f"has.{device}.device", "value": "true"})
        return element

    def traffic(self, departures: Departures) -> Traffic:
        """Return all that was taken."""
        trips = sorted(self._trips, key=lambda trip: trip.depart)
        self._notes[NO_ROUTE] = len(self._routeless)
        if not trips:
            single = [element for element in self._given.values() if element.tag != "flow"]
            self._notes[EARLY] = sum(departure(one) < self._case.begin for one in single)
        self._notes[ALONE] = len(self._background)
        return Traffic(
            vehicles=tuple(trip.element for trip in trips),
            depart=np.array([trip.depart for trip in trips], dtype=float),
            origin=np.array([trip.first for trip in trips], dtype=int),
            destination=np.array([trip.last for trip in trips], dtype=int),
            routes=self._routes,
            background=tuple(sorted(self._background, key=departure)),
            shared=tuple(self._shared),
            notes={note: count for note, count in self._notes.items() if count},
            remarks=tuple(self._remarks(departures.warnings)),
            left_out=self._left_out(),
            given=frozenset(self._given),
            end=math.inf if self._end is None else self._end,
        )

    def _left_out(self) -> tuple[float, float]:
        """Return Traffic.left_out."""
        nowhere = self._notes[NOWHERE]
        left = nowhere + len(self._routeless)
        known = len(self._trips) + len(self._background) + len(self._routeless)
        # Those on edges of another network would drive as far as the others.
        metres = self._metres * (1.0 + nowhere / max(known, 1))
        distance = (metres - self._metres_kept) / max(metres, 1.0)
        return left / max(known + nowhere, 1), distance

    def _remarks(self, warnings: Sequence[str]) -> list[str]:
        """Return examples of what was left out, and SUMO's words.

        Alike words are there once.
        """
        remarks = []
        if self._astray:
            name, edge = next(iter(self._astray.items()))
            given = self._given[name]
            what = f"edge {edge} of {given.tag} {given.get('id')} is not in {self._case.net.name}"
            remarks.append(what + _in_all(self._notes[NOWHERE]))
        if self._routeless:
            what = f"vehicle {self._routeless[0]} has no route that SUMO could drive"
            remarks.append(what + _in_all(len(self._routeless)))
        alike: dict[str, list[str]] = {}
        for words in warnings:
            alike.setdefault(NAMES.sub("", words), []).append(words)
        for several in alike.values():
            remarks.append(f"SUMO says: {several[0]}{_in_all(len(several))}")
        return remarks


def _in_all(count: int) -> str:
    return f" ({count:,} in all)" if count > 1 else ""


def _index(text: str, default: int) -> int:
    """Return a departEdge or arrivalEdge; `default` for a word."""
    return int(text) if text.isdecimal() else default


def _waits(element: Element) -> bool:
    """Return True for a vehicle or flow that departs when somebody else comes."""
    return element.get("depart", element.get("begin")) in TRIGGERED


def _stand_in(element: Element, streets: Streets) -> Element:
    """Return what SUMO can read for a vehicle on an unknown edge.

    SUMO then counts its vehicles, and draws the same random numbers for all others.
    """
    single = Element("flow" if element.tag == "flow" else "vehicle")
    for key in ("id", "depart", "type", *FLOW):
        if key in element.attrib:
            single.set(key, element.attrib[key])
    edge = streets.edges[int(np.argmax(streets.drivable))]
    SubElement(single, "route", {"edges": edge})
    return single


def _drawn(vehicle: Departure) -> dict[str, str]:
    """Return the attributes that SUMO gave to a vehicle."""
    return {
        "id": vehicle.id,
        "depart": f"{vehicle.depart:.10g}",
        "speedFactor": f"{vehicle.speed_factor:.6g}",
    }


def _single(vehicle: Departure, source: Element, routes: Container[str]) -> Element:
    """Return a vehicle as it was given, with what SUMO drew for it.

    source: its element, or that of its flow; routes: ids of shared ones
    """
    parts = [part for part in source if part.tag not in ("route", "routeDistribution")]
    routed = source.get("route") is not None or len(parts) < len(source)
    single = Element("vehicle" if routed else "trip")
    for key, value in source.attrib.items():
        if key not in FLOW and not (routed and key in ZONES):
            single.set(key, " ".join(value.split()))
    single.attrib.update(_drawn(vehicle))
    if vehicle.type != source.get("type", DEFAULT_TYPE).strip():
        single.set("type", vehicle.type)
    if routed:
        nested = source.find("route")
        if nested is not None:
            nested.attrib.pop("id", None)
            single.append(nested)
        elif vehicle.route in routes:
            single.set("route", vehicle.route)
        else:  # of a distribution
            single.attrib.pop("route", None)
            SubElement(single, "route", {"edges": " ".join(vehicle.edges)})
    single.extend(parts)
    return single


def _key(element: Element) -> str:
    """Return an id, of a flow with a dot: a vehicle may have the same one."""
    name = element.get("id", "").strip()
    return f"{name}." if element.tag == "flow" else name


def departure(element: Element) -> float:
    """Return when a vehicle, person or flow begins [s], 0 if unknown."""
    try:
        return seconds(element.get("depart") or element.get("begin") or "0", "")
    except InputError:
        return 0.0


def wrapped(elements: Iterable[Element], tag: str) -> Element:
    """Put the elements under a common root."""
    root = Element(tag)
    root.extend(elements)
    return root
