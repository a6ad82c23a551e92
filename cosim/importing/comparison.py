"""Comparison of an imported city with plain SUMO, trip by trip."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

from cosim.importing import quiet_files
from cosim.importing.case import SumoInput
from cosim.sumo.programs import run_sumo
from cosim.sumo.recorded_trips import MESOSCOPIC
from cosim.sumo.xml_files import attribute, elements_of
from nmfd.runs.files import temporary_folder

# Options of SUMO beside tripinfo-output.
ALL_TRIPS = {
    "tripinfo-output.write-unfinished": "true",
    "tripinfo-output.write-undeparted": "true",
}
QUIET = {"no-step-log": "true", "no-warnings": "true"}
NEVER = math.inf


class Trip(NamedTuple):
    """Trip of a vehicle, in SUMO's time [s].

    due: when it was to depart; depart, arrival: NEVER if not until the end of the simulation
    metres: driven when it arrived; removed: SUMO took it out before the end of its route
    """

    due: float
    depart: float
    arrival: float
    metres: float
    removed: bool = False


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Comparison of the private trips of an import with those of plain SUMO.

    trips: in plain SUMO; equal: those with the same departure, arrival and length in the import
    spent: time of all in the import over that in plain SUMO, minus 1 [-]
    first: what happens to the first trip that differs, "" without any
    queue_model: both are in SUMO's queue model, although the city is not
    """

    trips: int
    equal: int
    spent: float
    first: str
    queue_model: bool = False

    def text(self, reasons: Sequence[str]) -> str:
        """Return the result in one sentence; reasons: why trips may differ."""
        percent = round(100.0 * self.spent, 1) + 0.0  # no -0.0
        counts = f"{self.equal:,} of {self.trips:,} trips, time spent {percent:+.1f} %"
        if self.queue_model:
            counts += ", both in SUMO's queue model"
        if not self.first:
            return f"same city: {counts}"
        why = "; ".join([self.first, *reasons])
        return f"not the same city as in plain SUMO: {counts}; {why}"


def read_trips(path: Path, end: float) -> dict[str, Trip]:
    """Read SUMO's tripinfo of a simulation: vehicle -> its trip.

    end: of the simulation [s]
    """
    trips = {}
    for element in elements_of(path, "tripinfo"):
        depart = float(attribute(element, "depart"))
        arrival = float(attribute(element, "arrival"))
        waited = float(attribute(element, "departDelay"))
        trip = Trip(end - waited, NEVER, NEVER, 0.0)
        if depart >= 0:
            trip = trip._replace(due=round(depart - waited, 3), depart=depart)
        if arrival >= 0:
            metres = float(attribute(element, "routeLength"))
            removed = bool(element.get("vaporized"))
            trip = trip._replace(arrival=arrival, metres=metres, removed=removed)
        trips[attribute(element, "id")] = trip
    return trips


def plain_trips(case: SumoInput, end: float, *, mesoscopic: bool) -> dict[str, Trip]:
    """Return the trips of SUMO on the files of a case, with seed 0.

    end: of the simulation [s]
    mesoscopic: in the model that the import simulates, even if the case has another one
    Raises: InputError with SUMO's own words if it refuses
    """
    options = case.sumo_options()
    if mesoscopic and not case.mesoscopic:
        options |= {**MESOSCOPIC, **case.options, **case.reading}
    options |= {
        "end": end,
        "time-to-teleport": case.time_to_teleport,
        "ignore-route-errors": str(case.gaps).lower(),
        "seed": 0,
        **QUIET,
        **ALL_TRIPS,
    }
    options |= {name: unquote(value) for name, value in case.left_out.items()}
    with temporary_folder() as folder:
        options |= quiet_files.write(quiet_files.read(case), folder)
        options["tripinfo-output"] = folder / "trips.xml"
        run_sumo("sumo", options, where=case.source.name)
        return read_trips(folder / "trips.xml", end)


def compare(
    plain: Mapping[str, Trip],
    imported: Mapping[str, Trip],
    *,
    is_private: Callable[[str], bool],
    end: float,
    step: float,
) -> Comparison:
    """Compare the private trips that may depart before `end` [s].

    step: of the simulation [s]
    """
    expected = _shown(plain, is_private, end, step)
    found = _shown(imported, is_private, end, step)
    changes = []  # time, vehicle, what happens to it
    for name, trip in expected.items():
        if name not in found:
            changes.append((trip.due, name, "is missing"))
        elif found[name][1:] != trip[1:]:
            changes.append((trip.due, name, _change(trip, found[name])))
    equal = len(expected) - len(changes)
    for name in found.keys() - expected.keys():
        changes.append((found[name].due, name, "does not run there"))
    first = ""
    if changes:
        _, vehicle, change = min(changes)
        first = f"vehicle {vehicle} {change}"
    before = _time_spent(expected, end)
    spent = _time_spent(found, end) / before - 1.0 if before else 0.0
    return Comparison(trips=len(expected), equal=equal, spent=spent, first=first)


def _shown(
    trips: Mapping[str, Trip], is_private: Callable[[str], bool], end: float, step: float
) -> dict[str, Trip]:
    """Return the private trips that may depart before `end` [s].

    They are as known then, and due in the first step in which they may depart.
    """
    shown = {}
    for name, trip in trips.items():
        due = math.ceil(round(trip.due / step, 6)) * step
        if due >= end or not is_private(name):
            continue
        shown[name] = trip._replace(due=due)
        if trip.arrival >= end:
            depart = trip.depart if trip.depart < end else NEVER
            shown[name] = Trip(due, depart, NEVER, 0.0)
    return shown


def _change(expected: Trip, found: Trip) -> str:
    """Return how a trip of the import differs from the one in plain SUMO."""
    if found.depart != expected.depart:
        return f"departs {_at(found.depart)} instead of {_at(expected.depart)}"
    if found.arrival != expected.arrival:
        return f"arrives {_at(found.arrival)} instead of {_at(expected.arrival)}"
    return f"takes another way of {found.metres:g} m instead of {expected.metres:g} m"


def _at(time: float) -> str:
    return "never" if time == NEVER else f"at {time:g} s"


def _time_spent(trips: Mapping[str, Trip], end: float) -> float:
    """Return the total time spent until `end` [s]."""
    return sum(max(min(trip.arrival, end) - trip.due, 0.0) for trip in trips.values())
