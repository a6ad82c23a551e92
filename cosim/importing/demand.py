"""Traffic of a city: its private vehicles one by one, and all that runs beside them unchanged."""

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree, SubElement

import numpy as np

from cosim.importing.case import SumoInput, seconds
from cosim.importing.streets import Streets
from cosim.sumo.arrays import PerTrip, TripNumbers
from cosim.sumo.departures import Departure, read_departures
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
ENDLESS_FLOW_S = 3600.0  # length of a simulation without an end that has a flow without an end


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """Traffic of a city.

    vehicles: the demand, N `vehicle` and `trip` elements by departure
    depart: (N,) [s]; origin, destination: (N,) edges, numbers of Streets
    background: public transport, persons, and vehicles without a fixed departure
    shared: types, routes, stops, programmes and other contents of the additional files
    switched: signals whose programme a timetable (WAUT) changes
    notes: what was changed or left out -> count
    left_out: shares of SUMO's vehicles, and of the distance that they would drive [-], that are not
        taken over
    """

    vehicles: tuple[Element, ...]
    depart: PerTrip
    origin: TripNumbers
    destination: TripNumbers
    background: tuple[Element, ...] = ()
    shared: tuple[Element, ...] = ()
    switched: tuple[str, ...] = ()
    notes: Mapping[str, int] = field(default_factory=dict)
    left_out: tuple[float, float] = (0.0, 0.0)


def read_traffic(case: SumoInput, streets: Streets, seed: int) -> Traffic:
    """Return what SUMO reads from all route and additional files of a case.

    Flows become single vehicles; what is random is drawn by SUMO with `seed`. Raises InputError.
    """
    files: list[Element] = []
    shared, background, given = list[Element](), list[Element](), dict[str, Element]()
    switched: set[str] = set()
    end, notes, unknown = case.end, Counter[str](), 0
    for path in (*case.additional, *case.routes):
        files.append(Element("additional" if len(files) < len(case.additional) else "routes"))
        for element in map(_silent, read_xml(path)):
            if element.tag in DRIVERS:
                if not _edges(element) <= streets.number.keys():  # SUMO refuses the city for it
                    unknown += 1
                    continue
                given[element.get("id", "").strip()] = element
                if element.get("depart") in TRIGGERED:
                    background.append(element)
                    notes["vehicles without a time of departure, left alone"] += 1
                if (
                    element.tag == "flow"
                    and end is None
                    and not {"end", "number"} & set(element.keys())
                ):
                    end = case.begin + ENDLESS_FLOW_S
                    notes["s are simulated, as a flow has no end (--end for another time)"] = int(
                        ENDLESS_FLOW_S
                    )
            elif element.tag in OTHERS:
                background.append(element)
            elif element.tag not in DROPPED:
                switched |= {
                    name for e in element.iter("wautJunction") if (name := e.get("junctionID"))
                }
                shared.append(element)
            files[-1].append(element)
    departures = _read(case, files, seed, end)
    for element in shared:
        for kind in element.iter("vType"):
            kind.attrib.pop("scale", None)  # SUMO has multiplied the vehicles already
    names = {route.get("id", "") for element in shared for route in element.iter("route")}
    kept: list[tuple[float, int, int, Element]] = []
    queue = Counter[float]()  # time of departure -> vehicles of `kept`
    seen, metres = set[str](), np.zeros(2)  # that all vehicles would drive, and those left out
    for departed in departures:
        original = _original(departed.id, given)
        if original is not None and original.get("depart") in TRIGGERED:
            continue
        edges = [streets.number[edge] for edge in departed.edges if edge in streets.number]
        metres += streets.length[edges].sum()
        if not edges or not (departed.valid or case.gaps):
            unknown += 1
            continue
        if departed.id in seen:
            raise InputError(
                f"{case.source}: vehicle {departed.id}: another one has this id; rename one of them"
            )
        seen.add(departed.id)
        metres[1] -= streets.length[edges].sum()
        element = _single(departed, original, names)
        if departed.place is not None:
            notes["vehicles on the road in the loaded state, begin where they are"] += 1
        elif original is not None and original.tag == "flow":
            notes["vehicles from flows"] += 1
        # SUMO deletes a vehicle that cannot stop from its departure speed at a signal whose
        # programme never gives it green; a signal that is switched from outside has no programme
        # that does.
        if element.get("departSpeed", "max") not in SAFE_SPEEDS:
            element.set("departSpeed", "max")
            notes["fixed speeds at the departure, made the highest safe ones"] += 1
        if departed.line or departed.kind in BOUND:
            SubElement(
                element, "param", {"key": QUEUED_AFTER, "value": str(queue[departed.depart])}
            )
            background.append(element)
            notes["public transport and other classes left alone"] += 1
        else:
            first, last = (
                edges[int(place) if (place := element.get(key, "")).isdecimal() else default]
                for key, default in (("departEdge", 0), ("arrivalEdge", -1))
            )
            queue[departed.depart] += 1
            kept.append((departed.depart, first, last, element))
    if unknown:
        notes["vehicles without a route that SUMO could drive, left out"] = unknown
    if background:
        notes["persons, containers and vehicles left alone, in all"] = len(background)
    depart, origin, destination, elements = (
        zip(*sorted(kept, key=lambda row: row[0]), strict=True) if kept else ((),) * 4
    )
    return Traffic(
        vehicles=tuple(elements),
        depart=np.array(depart, dtype=float),
        origin=np.array(origin, dtype=int),
        destination=np.array(destination, dtype=int),
        background=tuple(sorted(background, key=departure)),
        shared=tuple(shared),
        switched=tuple(sorted(switched)),
        notes=dict(notes),
        left_out=(
            unknown / max(len(kept) + len(background) + unknown, 1),
            metres[1] / max(metres[0], 1.0),
        ),
    )


def _read(
    case: SumoInput, files: Sequence[Element], seed: int, end: float | None
) -> list[Departure]:
    """Let SUMO read the vehicles. files: contents of the additional files, and of the route
    files"""
    with temporary_folder() as folder:
        paths: dict[str, list[Path]] = {"additional": [], "routes": []}
        for n, root in enumerate(files):
            for element in [
                *root.findall("calibrator"),
                *root.findall("rerouter"),
            ]:  # act on every run
                root.remove(element)
            paths[root.tag].append(folder / f"{n}.xml")
            ElementTree(root).write(paths[root.tag][-1])
        options = {
            "net-file": file_list([case.net.absolute()]),
            "begin": case.begin,
            "step-length": case.step_length,
        }
        options |= {FILES[key]: file_list(names) for key, names in paths.items() if names}
        options |= {
            "mesosim": str(case.mesoscopic).lower(),
            "seed": seed,
            **case.options,
            **case.reading,
        }
        return read_departures(options, end=end, where=str(case.source))


def _edges(element: Element) -> set[str]:
    """Return the edges that a vehicle names, without those of shared routes."""
    texts = [element.get(key, "") for key in ("from", "to", "via")]
    texts += [route.get("edges", "") for route in element.iter("route")]
    return set(" ".join(texts).split())


def _original(name: str, given: Mapping[str, Element]) -> Element | None:
    """Return the element that a vehicle comes from: of its id, or that of a flow or a multiplied
    vehicle."""
    while name and name not in given:
        name = name.rpartition(".")[0]
    return given.get(name)


def _single(departure: Departure, original: Element | None, names: Container[str]) -> Element:
    """Return the vehicle of a departure, as it was given, with what SUMO drew for it.

    names: ids of shared routes
    """
    own = {
        "id": departure.id,
        "depart": f"{departure.depart:.10g}",
        "speedFactor": f"{departure.speed_factor:.6g}",
    }
    route = Element("route", {"edges": " ".join(departure.edges)})
    if original is None or departure.place is not None:
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
    parts = [part for part in original if part.tag not in ("route", "routeDistribution")]
    routed = original.get("route") is not None or len(parts) < len(original)
    out = {*FLOW, *(ZONES if routed else ())}
    kept = {
        key: " ".join(value.split()) for key, value in original.attrib.items() if key not in out
    }
    single = Element("vehicle" if routed else "trip", kept | own)
    if departure.type != original.get("type", DEFAULT_TYPE).strip():
        single.set("type", departure.type)
    if routed and (nested := original.find("route")) is not None:
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
