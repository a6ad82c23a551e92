"""What SUMO tells of every trip: how long it took, how long it waited to depart, what it emitted.

Trips under way, and those that could not depart, count with what they have spent until the end of the simulation.
Emissions are those of SUMO's own model for its default passenger car (HBEFA4, see CLASS), of every vehicle on the road
and in every step, idling included; a vehicle that waits to be inserted emits nothing.

How a trip ended is nowhere else to be had: what SUMO calls arrived may have been taken out by a calibrator, after a
collision, by a teleport beyond the end or by another program, and what that removes is not even called arrived.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Container
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from cosim.sumo.outputs import unfinished
from cosim.sumo.xml_files import BROKEN, attribute

CLASS = "HBEFA4/PC_petrol_Euro-4"
MILLIGRAMS = 1e-6  # kg


@dataclass(frozen=True, kw_only=True)
class TripFacts:
    """Of all trips that were due to depart before the end.

    trips: their number; completed: those that reached the last edge of their route; removed: those that were taken out
    on their way; travel_time: sum of the times on the road [s]; departure_delay: sum of the times between the wanted
    and the real departure [s]; time_loss: sum of the times lost on the road against driving freely [s]; co2, fuel: [kg]
    """

    trips: int = 0
    completed: int = 0
    removed: int = 0
    travel_time: float = 0.0
    departure_delay: float = 0.0
    time_loss: float = 0.0
    co2: float = 0.0
    fuel: float = 0.0


@dataclass(frozen=True, kw_only=True)
class End:
    """A vehicle has left the simulation. edge: where, "" if SUMO does not say; reason: why it is no completed trip
    (tripinfo's `vaporized`: calibrator, collision, teleport, traci ...), "" of one on the last edge of its route, as
    that was in the end; time_loss: on the road against driving freely [s]."""

    vehicle: str
    edge: str = ""
    reason: str = ""
    time_loss: float = 0.0


def trip_options(path: Path) -> tuple[str, ...]:
    """Options of SUMO that make it write `path`, for `TripReader`, complete when the simulation ends."""
    return (
        "--tripinfo-output",
        str(path),
        "--tripinfo-output.write-unfinished",
        "true",
        "--tripinfo-output.write-undeparted",
        "true",
        "--device.emissions.probability",
        "1",
    )


class TripReader:
    """Reads SUMO's tripinfo output while SUMO writes it.

    facts: of all that was read; prompt: whether SUMO had written all that it knew when it was last read
    under_way: vehicle -> what it had lost on the road [s], of those that were there at the end of the simulation
    """

    def __init__(self, path: Path, flush: Callable[[], bool] = lambda: False):
        """flush: has SUMO write what it keeps in memory (some 8 kB, about ten trips), False where it does not"""
        self._path, self._flush, self._offset = path, flush, 0
        self._parser: ElementTree.XMLPullParser[Element] = ElementTree.XMLPullParser()
        self.facts, self.prompt = TripFacts(), False
        self.under_way: dict[str, float] = {}

    def ends(self) -> list[End]:
        """Of the vehicles that SUMO has written since the last call. Raises RunFailed for a file that is broken."""
        self.prompt = self._flush()
        try:
            self._feed()
            return self._read(lambda vehicle: True)
        except BROKEN as error:
            raise unfinished(self._path, error) from None

    def finish(self, gone: Container[str] = ()) -> list[End]:
        """The last ones, when the simulation has ended: SUMO has written those under way then, too, but not those of
        `gone`, who had left before. Raises RunFailed for a file that is not whole."""
        try:
            self._feed()
            self._parser.close()
            return self._read(gone.__contains__)
        except BROKEN as error:
            raise unfinished(self._path, error) from None

    def _feed(self) -> None:
        with self._path.open("rb") as stream:
            stream.seek(self._offset)
            self._parser.feed(stream.read())
            self._offset = stream.tell()

    def _read(self, left: Callable[[str], bool]) -> list[End]:
        """left: whether a vehicle has left of which SUMO says that it has not arrived. So it says of one that the
        mesoscopic model teleports to the end of its route, too."""
        ends = []
        for event in self._parser.read_events():
            element = event[-1]
            if isinstance(element, Element) and element.tag == "tripinfo":
                ended = float(attribute(element, "arrival")) >= 0 or (
                    float(attribute(element, "depart")) >= 0 and left(element.get("id", ""))
                )
                reason = element.get("vaporized", "")
                self.facts = _added(self.facts, element, ended=ended, completed=ended and not reason)
                if ended:
                    ends.append(
                        End(
                            vehicle=element.get("id", ""),
                            edge=element.get("arrivalLane", "").rpartition("_")[0],
                            reason=reason,
                            time_loss=_time_loss(element),
                        )
                    )
                elif float(attribute(element, "depart")) >= 0:
                    self.under_way[element.get("id", "")] = _time_loss(element)
                element.clear()
        return ends


def read_trip_facts(path: Path) -> TripFacts:
    """Read SUMO's tripinfo output of a simulation that has ended. Raises RunFailed if it is not whole."""
    reader = TripReader(path)
    reader.finish()
    return reader.facts


def _time_loss(trip: Element) -> float:
    return max(float(trip.get("timeLoss", 0.0)), 0.0)


def _added(facts: TripFacts, trip: Element, *, ended: bool, completed: bool) -> TripFacts:
    co2, fuel = facts.co2, facts.fuel
    for emissions in trip.iter("emissions"):
        co2 += MILLIGRAMS * float(attribute(emissions, "CO2_abs"))
        fuel += MILLIGRAMS * float(attribute(emissions, "fuel_abs"))
    return TripFacts(
        trips=facts.trips + 1,
        completed=facts.completed + completed,
        removed=facts.removed + (ended and not completed),
        travel_time=facts.travel_time + max(float(attribute(trip, "duration")), 0.0),
        departure_delay=facts.departure_delay + float(attribute(trip, "departDelay")),
        time_loss=facts.time_loss + _time_loss(trip),
        co2=co2,
        fuel=fuel,
    )
