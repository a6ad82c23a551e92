"""Traffic of a city: its private vehicles one by one, and all that runs beside them unchanged."""

import math
import re
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement

import numpy as np

from cosim.importing.case import SumoInput, seconds
from cosim.importing.streets import Streets
from cosim.sumo.arrays import PerTrip, TripNumbers
from cosim.sumo.departures import Departure, Departures, original, read_departures
from cosim.sumo.recorded_trips import BOUND, QUEUED_AFTER
from cosim.sumo.xml_files import file_list, read_xml
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder

FILES = {
    "additional": "additional-files",
    "routes": "route-files",
}  # root of a file -> option of SUMO
DRIVERS = ("vehicle", "trip", "flow")
OTHERS = ("person", "personFlow", "container", "containerFlow")
DROPPED = (
    "poly",
    "poi",
    "edgeData",
    "laneData",
    "timedEvent",
    "vTypeProbe",
    "interval",
)  # no traffic
ACTING = ("calibrator", "rerouter")  # they act on every run, and not on what SUMO reads
WRITERS = (
    "Detector",
    "Loop",
    "calibrator",
    "routeProbe",
)  # ends of names of elements that write files
WRITING = (
    "file",
    "has.ssm.device",
    "device.toc.file",
)  # parameters that only make SUMO write files
SAFE_SPEEDS = ("max", "random", "0", "0.0", "0.00")  # departure speeds that can wait for a green
FLOW = ("begin", "end", "number", "period", "vehsPerHour", "perHour", "probability")
ZONES = ("fromTaz", "toTaz", "fromJunction", "toJunction")
TRIGGERED = ("triggered", "containerTriggered", "split")  # departures without a time
DEFAULT_TYPE = "DEFAULT_VEHTYPE"
NAMES = re.compile(r"'[^']*'|[\d.]+")  # of things, in SUMO's words
SHORT_DELAY_S = 60.0  # of waiting to enter, after which SUMO gives up vehicles
ENDLESS_FLOW_S = 3600.0  # length of a simulation without an end that has a flow without an end
# What was changed or left out; a report counts it.
ENDLESS = "s are simulated, as a flow has no end (--end for another time)"
FAST = "fixed speeds at the departure, made the highest safe ones"
FROM_FLOWS = "vehicles from flows"
ON_ROAD = "vehicles on the road in the loaded state, begin where they are"
WAITING = "vehicles without a time of departure, left alone"
BUSES = "public transport and other classes left alone"
ALONE = "persons, containers and vehicles left alone, in all"
NOWHERE = "vehicles on edges that the network has not, left out"
NO_ROUTE = "vehicles without a route that SUMO could drive, left out"
UNREAD = "vehicles and flows that SUMO itself does not read"


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """Traffic of a city.

    vehicles: the demand, N `vehicle` and `trip` elements by departure
    depart: (N,) [s]; origin, destination: (N,) edges, numbers of Streets
    background: public transport, persons, and vehicles without a fixed departure
    shared: types, routes, stops, programmes and other contents of the additional files
    switched: signals whose programme a timetable (WAUT) changes
    notes: what was changed or left out -> count
    remarks: examples of what was left out, and SUMO's own words about the files
    left_out: shares of SUMO's vehicles, and of the distance that they would drive [-], that are not
        taken over
    unread: share of the vehicles and flows of the files that SUMO itself does not read [-]
    given: ids of all vehicles and flows of the files
    end: later vehicles were not read [s]
    """

    vehicles: tuple[Element, ...]
    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    background: tuple[Element, ...] = ()
    shared: tuple[Element, ...] = ()
    switched: tuple[str, ...] = ()
    notes: Mapping[str, int] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    left_out: tuple[float, float] = (0.0, 0.0)
    unread: float = 0.0
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
        return {element.get("id", "").strip() for element in self.background}


def read_traffic(case: SumoInput, streets: Streets, seed: int) -> Traffic:
    """Return what SUMO reads from all route and additional files of a case.

    Flows become single vehicles; what is random is drawn by SUMO with `seed`. Raises InputError.
    """
    reading = Reading(case, streets)
    for root in quiet_files(case):
        reading.file(root)
    reading.departed(reading.departures(seed))
    return reading.traffic()


def quiet_files(case: SumoInput) -> list[Element]:
    """Return the additional files of a case, then its route files, without output and decoration.

    Each is the root of an XML file, and its tag a key of FILES.
    """
    files = []
    for tag, paths in (("additional", case.additional), ("routes", case.routes)):
        for path in paths:
            root = Element(tag)
            for element in read_xml(path):
                if element.tag not in DROPPED:
                    root.append(_silent(element))
            files.append(root)
    return files


def write_files(files: Sequence[Element], folder: Path) -> dict[str, str]:
    """Write the roots of `quiet_files` into a folder; return SUMO's options that name them."""
    paths: dict[str, list[Path]] = {option: [] for option in FILES.values()}
    for n, root in enumerate(files):
        path = folder / f"{n}.xml"
        ElementTree(root).write(path)
        paths[FILES[root.tag]].append(path)
    return {option: file_list(names) for option, names in paths.items() if names}


class Reading:
    """Traffic of a case while it is read: its files, and then the vehicles that SUMO makes of
    them."""

    def __init__(self, case: SumoInput, streets: Streets):
        self._case, self._streets = case, streets
        self._files: list[Element] = []
        self._given: dict[str, Element] = {}
        self._background: list[Element] = []
        self._shared: list[Element] = []
        self._switched: set[str] = set()
        self._end = case.end
        self._latest = 0.0  # when the last vehicle, person or flow begins [s]
        self._notes = Counter[str]()
        self._remarks: list[str] = []
        self._astray: dict[str, str] = {}  # vehicle or flow -> an edge that does not exist
        self._routeless: list[str] = []
        self._unread: list[str] = []
        self._kept: list[tuple[float, int, int, Element]] = []
        self._ids: set[str] = set()
        self._metres = self._metres_kept = 0.0  # that all vehicles would drive, and those kept
        self._before = Counter[float]()  # departure -> kept vehicles
        delay = seconds(case.options.get("max-depart-delay", "-1"), f"{case.source}")
        self._patience = delay if delay >= 0.0 else math.inf  # of SUMO with waiting vehicles [s]
        self._queued: dict[int, float] = {}  # simulation step -> last departure in its queue

    def file(self, root: Element) -> None:
        """Take the contents of a file of `quiet_files`."""
        read = Element(root.tag)
        for element in root:
            if element.tag in DRIVERS:
                element = self._driver(element)
            elif element.tag in OTHERS:
                self._background.append(element)
            else:
                for part in element.iter("wautJunction"):
                    self._switched.add(part.get("junctionID", ""))
                self._shared.append(element)
            if element.tag in DRIVERS or element.tag in OTHERS:
                self._latest = max(self._latest, departure(element))
            if element.tag not in ACTING:
                read.append(element)
        self._files.append(read)

    def _driver(self, element: Element) -> Element:
        """Take a vehicle, trip or flow; return what SUMO shall read for it."""
        name = element.get("id", "").strip()
        self._given[name] = element
        if _waits(element):
            self._background.append(element)
        if (
            element.tag == "flow"
            and self._end is None
            and not {"end", "number"} & set(element.keys())
        ):
            self._end = self._case.begin + ENDLESS_FLOW_S
            self._notes[ENDLESS] = int(ENDLESS_FLOW_S)
        for edge in _edges(element):
            if edge not in self._streets.number:
                self._astray[name] = edge
                return _stand_in(element, self._streets)
        return element

    def departures(self, seed: int) -> Departures:
        """Let SUMO read the vehicles of all files."""
        case = self._case
        options = {
            "net-file": file_list([case.net.absolute()]),
            "begin": case.begin,
            "step-length": case.step_length,
            "mesosim": str(case.mesoscopic).lower(),
            "seed": seed,
            **case.options,
            **case.reading,
        }
        waits = {name: _waits(element) for name, element in self._given.items()}
        with temporary_folder() as folder:
            return read_departures(
                options | write_files(self._files, folder),
                given=waits,
                devices=case.devices,
                end=self._end,
                latest=self._latest,
                where=str(case.source),
            )

    def departed(self, read: Departures) -> None:
        """Take the vehicles that SUMO read."""
        shared = [part for element in self._shared for part in element.iter()]
        routes = {part.get("id", "") for part in shared if part.tag == "route"}
        for vehicle in read.vehicles:
            self._vehicle(vehicle, routes)
        self._notes[WAITING] = len(read.timeless)
        self._routeless += read.dropped
        self._find_unread(read)
        for part in shared:
            if part.tag == "vType":
                part.attrib.pop("scale", None)  # SUMO has multiplied its vehicles already
        self._remark(read.warnings)

    def _vehicle(self, vehicle: Departure, routes: Container[str]) -> None:
        """Take a vehicle that SUMO read; routes: ids of shared ones."""
        name = original(vehicle.id, self._given)
        source = self._given.get(name)
        if name in self._astray:
            self._notes[NOWHERE] += 1
            return
        if source is None and vehicle.place is None:
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
        element = _single(vehicle, source, routes)
        depart = self._place(vehicle)
        element.set("depart", f"{depart:.10g}")
        for device in vehicle.devices:
            SubElement(element, "param", {"key": f"has.{device}.device", "value": "true"})
        if vehicle.place is not None:
            self._notes[ON_ROAD] += 1
        elif source is not None and source.tag == "flow":
            self._notes[FROM_FLOWS] += 1
        # SUMO deletes a vehicle that cannot stop from its departure speed at a signal whose
        # programme never gives it green; a signal that is switched from outside has no programme
        # that does.
        if element.get("departSpeed", "max") not in SAFE_SPEEDS:
            element.set("departSpeed", "max")
            self._notes[FAST] += 1
        if vehicle.line or vehicle.kind in BOUND:
            ahead = str(self._before[depart])
            SubElement(element, "param", {"key": QUEUED_AFTER, "value": ahead})
            self._background.append(element)
            self._notes[BUSES] += 1
            return
        self._before[depart] += 1
        first = _index(element.get("departEdge", ""), 0)
        last = _index(element.get("arrivalEdge", ""), -1)
        self._kept.append((depart, edges[first], edges[last], element))

    def _place(self, vehicle: Departure) -> float:
        """Return a departure [s] with which the vehicle keeps its place in SUMO's queue.

        SUMO inserts the vehicles of a step in the order in which it built them, and a file is
        sorted by time: so none may have an earlier time than one before it in the queue. SUMO
        finds the route of a file's vehicle in the last step before its departure, but that of a
        flow's in the step that builds it. Where it soon gives up vehicles that wait, the exact
        departure matters more.
        """
        milliseconds = round(1000.0 * self._case.step_length)
        step = math.ceil(round(1000.0 * vehicle.depart) / milliseconds)
        depart = vehicle.depart
        if vehicle.routed and self._patience > SHORT_DELAY_S:
            depart = max(depart, min(vehicle.built, step * milliseconds / 1000.0))
        depart = max(depart, self._queued.get(step, depart))
        self._queued[step] = depart
        return depart

    def _find_unread(self, read: Departures) -> None:
        """Find the vehicles of the files that SUMO should have read and has not."""
        options = self._case.reading
        if float(options.get("scale", 1.0)) < 1.0 or "random-depart-offset" in options:
            return  # SUMO leaves some out on purpose
        names = chain((vehicle.id for vehicle in read.vehicles), read.timeless, read.dropped)
        seen = {original(name, self._given) for name in names}
        end = math.inf if self._end is None else self._end - self._case.step_length
        thinned = self._thinned_types()
        for name, element in self._given.items():
            if name in seen or element.get("type", DEFAULT_TYPE).strip() in thinned:
                continue
            if self._case.begin <= _first_departure(element) <= end:
                self._unread.append(name)
        self._notes[UNREAD] = len(self._unread)

    def _thinned_types(self) -> set[str]:
        """Return the types of which SUMO leaves out vehicles on purpose."""
        thinned = set()
        for element in self._shared:
            for kind in element.iter("vType"):
                if float(kind.get("scale", 1.0)) < 1.0:
                    thinned |= {kind.get("id", ""), element.get("id", "")}
        return thinned

    def _remark(self, warnings: Sequence[str]) -> None:
        """Give an example of all that was left out, and SUMO's words, alike ones once."""
        for name, edge in [*self._astray.items()][:1]:
            what = f"edge {edge} of {self._given[name].tag} {name} is not in {self._case.net.name}"
            self._remarks.append(what + _in_all(self._notes[NOWHERE]))
        for name in self._routeless[:1]:
            what = f"vehicle {name} has no route that SUMO could drive"
            self._remarks.append(what + _in_all(len(self._routeless)))
        for name in self._unread[:1]:
            what = f"{self._given[name].tag} {name} is not read by SUMO"
            self._remarks.append(what + _in_all(len(self._unread)))
        alike: dict[str, list[str]] = {}
        for words in warnings:
            alike.setdefault(NAMES.sub("", words), []).append(words)
        for several in alike.values():
            self._remarks.append(f"SUMO says: {several[0]}{_in_all(len(several))}")

    def traffic(self) -> Traffic:
        """Return all that was taken."""
        count = len(self._kept) + len(self._background)
        nowhere, routeless = self._notes[NOWHERE], len(self._routeless)
        self._notes[NO_ROUTE] = routeless
        self._notes[ALONE] = len(self._background)
        left = nowhere + routeless
        # How far those would drive that name an edge of another network is unknown: as the others.
        mean = self._metres / max(count + routeless, 1)
        metres = self._metres + nowhere * mean
        self._kept.sort(key=lambda row: row[0])
        return Traffic(
            vehicles=tuple(element for *_, element in self._kept),
            depart=np.array([depart for depart, *_ in self._kept], dtype=float),
            origin=np.array([first for _, first, *_ in self._kept], dtype=int),
            destination=np.array([last for *_, last, _ in self._kept], dtype=int),
            background=tuple(sorted(self._background, key=departure)),
            shared=tuple(self._shared),
            switched=tuple(sorted(self._switched - {""})),
            notes={note: number for note, number in self._notes.items() if number},
            remarks=tuple(self._remarks),
            left_out=(
                left / max(count + left, 1),
                (metres - self._metres_kept) / max(metres, 1.0),
            ),
            unread=len(self._unread) / max(len(self._given), 1),
            given=frozenset(self._given),
            end=math.inf if self._end is None else self._end,
        )


def _in_all(count: int) -> str:
    return f" ({count:,} in all)" if count > 1 else ""


def _index(text: str, default: int) -> int:
    """Return a departEdge or arrivalEdge; `default` if it is a word such as "random"."""
    return int(text) if text.isdecimal() else default


def _waits(element: Element) -> bool:
    """Return True for a vehicle or flow that departs when somebody else comes."""
    return element.get("depart", element.get("begin")) in TRIGGERED


def _first_departure(element: Element) -> float:
    """Return when a vehicle, or the first one of a flow, departs for sure [s]; inf if unknown."""
    if element.get("number") == "0" or element.get("probability"):
        return math.inf
    if element.get("period", "").startswith("exp"):
        return math.inf
    try:
        return seconds(element.get("depart") or element.get("begin") or "0", "")
    except InputError:  # triggered, or some other word
        return math.inf


def _stand_in(element: Element, streets: Streets) -> Element:
    """Return what SUMO can read for a vehicle on an edge that the network has not.

    SUMO then counts its vehicles, and draws the same random numbers for all others.
    """
    kept = ("id", "depart", "type", *FLOW)
    attributes = {key: value for key, value in element.attrib.items() if key in kept}
    single = Element("flow" if element.tag == "flow" else "vehicle", attributes)
    edge = streets.edges[int(np.argmax(streets.drivable))]
    SubElement(single, "route", {"edges": edge})
    return single


def _edges(element: Element) -> list[str]:
    """Return the edges that a vehicle names, without those of shared routes."""
    texts = [element.get(key, "") for key in ("from", "to", "via")]
    texts += [route.get("edges", "") for route in element.iter("route")]
    return " ".join(texts).split()


def _single(departure: Departure, source: Element | None, names: Container[str]) -> Element:
    """Return the vehicle of a departure, as it was given, with what SUMO drew for it.

    source: its element, or that of its flow; names: ids of shared routes
    """
    own = {
        "id": departure.id,
        "depart": f"{departure.depart:.10g}",
        "speedFactor": f"{departure.speed_factor:.6g}",
    }
    route = Element("route", {"edges": " ".join(departure.edges)})
    if source is None or departure.place is not None:
        lane, position = departure.place or ("best", "base")
        own |= {
            "type": departure.type,
            "departLane": lane,
            "departPos": position,
            "departSpeed": "max",
        }
        single = Element("vehicle", own)
        single.append(route)
        return single
    parts = [part for part in source if part.tag not in ("route", "routeDistribution")]
    routed = source.get("route") is not None or len(parts) < len(source)
    out = {*FLOW, *(ZONES if routed else ())}
    kept = {key: " ".join(value.split()) for key, value in source.attrib.items() if key not in out}
    single = Element("vehicle" if routed else "trip", kept | own)
    if departure.type != source.get("type", DEFAULT_TYPE).strip():
        single.set("type", departure.type)
    if routed and (nested := source.find("route")) is not None:
        nested.attrib.pop("id", None)
        parts.insert(0, nested)
    elif routed and departure.route in names:
        single.set("route", departure.route)
    elif routed:
        single.attrib.pop("route", None)
        parts.insert(0, route)
    single.extend(parts)
    return single


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


def departure(element: Element) -> float:
    """Return the time [s] at which a vehicle, person or flow of them begins, 0 if that is no
    time."""
    try:
        return seconds(element.get("depart") or element.get("begin") or "0", "")
    except InputError:
        return 0.0


def wrapped(elements: Iterable[Element], tag: str) -> Element:
    """Put the elements under a common root."""
    root = Element(tag)
    root.extend(elements)
    return root
