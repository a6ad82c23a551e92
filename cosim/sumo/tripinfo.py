"""What SUMO tells of every trip: how long it took, how long it waited to depart, what it emitted.

Trips under way, and those that could not depart, count with what they have spent until the end of the simulation.
Emissions are those of SUMO's own model for its default passenger car (HBEFA4, see CLASS), of every vehicle on the road
and in every step, idling included; a vehicle that waits to be inserted emits nothing.
"""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

from cosim.sumo.outputs import unfinished
from cosim.sumo.xml_files import BROKEN, attribute

CLASS = "HBEFA4/PC_petrol_Euro-4"
MILLIGRAMS = 1e-6  # kg


@dataclass(frozen=True, kw_only=True)
class TripFacts:
    """Of all trips that were due to depart before the end.

    trips, completed: their number; travel_time: sum of the times on the road [s]; departure_delay: sum of the times
    between the wanted and the real departure [s]; co2, fuel: [kg]
    """

    trips: int
    completed: int
    travel_time: float
    departure_delay: float
    co2: float
    fuel: float


def trip_options(path: Path) -> tuple[str, ...]:
    """Options of SUMO that make it write `path`, for `read_trip_facts`, when the simulation ends."""
    return (
        "--tripinfo-output", str(path), "--tripinfo-output.write-unfinished", "true",
        "--tripinfo-output.write-undeparted", "true", "--device.emissions.probability", "1")


def read_trip_facts(path: Path) -> TripFacts:
    """Read SUMO's tripinfo output of a simulation that has ended. Raises RunFailed if it is not whole."""
    try:
        return _read(path)
    except BROKEN as error:
        raise unfinished(path, error) from None


def _read(path: Path) -> TripFacts:
    trips = completed = 0
    travel_time = departure_delay = co2 = fuel = 0.0
    for _, element in ElementTree.iterparse(path):
        if element.tag == "tripinfo":
            trips += 1
            completed += float(attribute(element, "arrival")) >= 0
            travel_time += max(float(attribute(element, "duration")), 0.0)
            departure_delay += float(attribute(element, "departDelay"))
            for emissions in element.iter("emissions"):
                co2 += MILLIGRAMS * float(attribute(emissions, "CO2_abs"))
                fuel += MILLIGRAMS * float(attribute(emissions, "fuel_abs"))
            element.clear()
    return TripFacts(
        trips=trips, completed=completed, travel_time=travel_time, departure_delay=departure_delay, co2=co2, fuel=fuel)
