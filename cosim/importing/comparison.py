"""Comparison of an imported city with the city as SUMO itself runs it, trip by trip."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

from cosim.importing.case import SumoInput
from cosim.importing.demand import quiet_files, write_files
from cosim.sumo.programs import run_sumo
from cosim.sumo.recorded_trips import MESOSCOPIC
from cosim.sumo.xml_files import attribute, file_list
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

    def until(self, end: float) -> "Trip":
        """Return the trip as a simulation shows it that ends at `end` [s]."""
        if self.arrival < end:
            return self
        depart = self.depart if self.depart < end else NEVER
        return Trip(self.due, depart, NEVER, 0.0)


def read_trips(path: Path, end: float) -> dict[str, Trip]:
    """Read SUMO's tripinfo of a simulation until `end` [s]: vehicle -> its trip."""
    trips = {}
    for _, element in ElementTree.iterparse(path):
        if element.tag != "tripinfo":
            continue
        depart = float(attribute(element, "depart"))
        arrival = float(attribute(element, "arrival"))
        begun = depart if depart >= 0 else end
        trips[attribute(element, "id")] = Trip(
            due=round(begun - float(attribute(element, "departDelay")), 3),
            depart=depart if depart >= 0 else NEVER,
            arrival=arrival if arrival >= 0 else NEVER,
            metres=float(attribute(element, "routeLength")) if arrival >= 0 else 0.0,
            removed=arrival >= 0 and bool(element.get("vaporized")),
        )
        element.clear()
    return trips


def plain_trips(case: SumoInput, end: float, *, mesoscopic: bool) -> dict[str, Trip]:
    """Run the files of a case in SUMO with seed 0 until `end` [s], and return the trips.

    mesoscopic: in the model that the import simulates, even if the case has another one
    Raises: InputError with SUMO's own words if it refuses
    """
    options: dict[str, object] = {
        "net-file": file_list([case.net.absolute()]),
        "begin": case.begin,
        "end": end,
        "step-length": case.step_length,
        "time-to-teleport": case.time_to_teleport,
        "ignore-route-errors": str(case.gaps).lower(),
        "mesosim": str(case.mesoscopic).lower(),
        "seed": 0,
    }
    if mesoscopic and not case.mesoscopic:
        options |= MESOSCOPIC
    options |= {**case.options, **case.reading, **QUIET, **ALL_TRIPS}
    options |= {name: unquote(value) for name, value in case.left_out.items()}
    with temporary_folder() as folder:
        options |= write_files(quiet_files(case), folder)
        options["tripinfo-output"] = folder / "trips.xml"
        run_sumo("sumo", options, where=str(case.source))
        return read_trips(folder / "trips.xml", end)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Comparison of the private trips of an import with those of plain SUMO.

    trips: in plain SUMO; equal: those with the same departure, arrival and length in the import
    spent: time of all in the import over that in plain SUMO, minus 1 [-]
    first: what happens to the first trip that differs, "" without any
    """

    trips: int
    equal: int
    spent: float
    first: str

    def text(self, reasons: Sequence[str]) -> str:
        """Return the result in one sentence; reasons: why trips may differ."""
        percent = 100.0 * self.spent
        if abs(percent) < 0.05:
            percent = 0.0
        counts = f"{self.equal:,} of {self.trips:,} trips, time spent {percent:+.1f} %"
        if not self.first:
            return f"same city: {counts}"
        why = "; ".join([self.first, *reasons])
        return f"not the same city as in plain SUMO: {counts}; {why}"


def compare(
    plain: Mapping[str, Trip],
    imported: Mapping[str, Trip],
    *,
    is_private: Callable[[str], bool],
    end: float,
    step: float,
) -> Comparison:
    """Compare the private trips that may depart before `end` [s]; step: of the simulation [s]."""
    expected = _shown(plain, is_private, end, step)
    found = _shown(imported, is_private, end, step)
    changes = []  # departure, vehicle, what happens to it
    for name, trip in expected.items():
        other = found.get(name)
        if other is None:
            changes.append((trip.due, name, "is missing"))
        elif other[1:] != trip[1:]:
            changes.append((min(trip.depart, other.depart), name, _change(trip, other)))
    equal = len(expected) - len(changes)
    for name in found.keys() - expected.keys():
        changes.append((found[name].due, name, "does not run there"))
    spent = _time_spent(expected, end, step)
    first = ""
    if changes:
        _, name, change = min(changes)
        first = f"vehicle {name} {change}"
    return Comparison(
        trips=len(expected),
        equal=equal,
        spent=_time_spent(found, end, step) / spent - 1.0 if spent else 0.0,
        first=first,
    )


def _shown(
    trips: Mapping[str, Trip], is_private: Callable[[str], bool], end: float, step: float
) -> dict[str, Trip]:
    """Return the private trips that may depart before `end` [s], as shown then."""
    shown = {}
    for name, trip in trips.items():
        if _first_step(trip, step) < end and is_private(name):
            shown[name] = trip.until(end)
    return shown


def _first_step(trip: Trip, step: float) -> float:
    """Return the first step of the simulation in which a vehicle may depart [s]."""
    return math.ceil(round(trip.due / step, 6)) * step


def _change(expected: Trip, found: Trip) -> str:
    """Return how a trip of the import differs from the one in plain SUMO."""
    if found.depart != expected.depart:
        return f"departs {_at(found.depart)} instead of {_at(expected.depart)}"
    if found.removed != expected.removed:
        return "is removed on its way, or not, other than there"
    if found.arrival != expected.arrival:
        return f"arrives {_at(found.arrival)} instead of {_at(expected.arrival)}"
    return f"drives {found.metres:g} m instead of {expected.metres:g} m"


def _at(time: float) -> str:
    return "never" if time == NEVER else f"at {time:g} s"


def _time_spent(trips: Mapping[str, Trip], end: float, step: float) -> float:
    """Return the total time spent until `end` [s], from the first step in which a vehicle may
    depart."""
    total = 0.0
    for trip in trips.values():
        total += max(min(trip.arrival, end) - _first_step(trip, step), 0.0)
    return total
