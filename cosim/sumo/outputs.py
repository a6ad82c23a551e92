"""SUMO's output files: tripinfo, read while SUMO writes it, and emissions by edge."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Container
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element
from xml.sax.saxutils import quoteattr

from cosim.sumo.xml_files import BROKEN, attribute
from nmfd.errors import RunFailed

KG_PER_MG = 1e-6


class End(NamedTuple):
    """The end of a vehicle's trip.

    time: [s], of the simulation; edge: last one, "" if unknown
    reason: tripinfo's `vaporized`, "" at the end of the route; time_loss: [s]
    """

    vehicle: str
    time: float
    edge: str = ""
    reason: str = ""
    time_loss: float = math.nan


class TripReader:
    """Reader of SUMO's tripinfo output while SUMO writes it.

    completed, removed: vehicles so far, at the last edge of their route or before
    under_way: vehicle on the road at the end of the simulation -> time loss [s]
    """

    def __init__(self, path: Path, flush: Callable[[], None] = lambda: None):
        """flush: makes SUMO write what it buffers (about ten trips)"""
        self._path, self._flush, self._offset = path, flush, 0
        self._parser: ElementTree.XMLPullParser[Element] = ElementTree.XMLPullParser()
        self.completed = self.removed = 0
        self.under_way: dict[str, float] = {}

    def ends(self) -> list[End]:
        """Return the trips that ended since the last call. Raises RunFailed for a broken file."""
        self._flush()
        return self._read(lambda vehicle: True)

    def finish(self, gone: Container[str] = ()) -> list[End]:
        """Return the last ends after the simulation; SUMO lists vehicles under way then, too,
        `gone` are none of these.

        Raises RunFailed for a file that is not whole.
        """
        return self._read(gone.__contains__, last=True)

    def _read(self, left: Callable[[str], bool], last: bool = False) -> list[End]:
        """left: a vehicle of which SUMO says that it has not arrived has left, as after a teleport
        to its end."""
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._offset)
                self._parser.feed(stream.read())
                self._offset = stream.tell()
            if last:
                self._parser.close()
            elements = [event[-1] for event in self._parser.read_events()]
            trips = [
                self._trip(e, left)
                for e in elements
                if isinstance(e, Element) and e.tag == "tripinfo"
            ]
        except BROKEN as error:
            raise unfinished(self._path, error) from None
        return [end for end in trips if end is not None]

    def _trip(self, element: Element, left: Callable[[str], bool]) -> End | None:
        vehicle, reason = element.get("id", ""), element.get("vaporized", "")
        depart, loss = (
            float(attribute(element, "depart")),
            max(float(element.get("timeLoss", 0.0)), 0.0),
        )
        ended = float(attribute(element, "arrival")) >= 0 or (depart >= 0 and left(vehicle))
        edge, time = (
            element.get("arrivalLane", "").rpartition("_")[0],
            depart + float(attribute(element, "duration")),
        )
        element.clear()
        if ended:
            self.completed, self.removed = (
                self.completed + (not reason),
                self.removed + bool(reason),
            )
            return End(vehicle, time, edge, reason, loss)
        if depart >= 0:
            self.under_way[vehicle] = loss
        return None


def options(trip_file: Path, *, detailed: bool, drawn: bool = False) -> list[str]:
    """Return SUMO's options for a `trip_file` that `TripReader` can read.

    detailed: with emissions of every trip
    drawn: SUMO draws a random number per vehicle, detailed or not. Without it, the numbers that
        decide who has a rerouting device are those of a run without emissions.
    """
    texts = ["--tripinfo-output", str(trip_file)]
    texts += ["--tripinfo-output.write-unfinished", "true"]
    texts += ["--tripinfo-output.write-undeparted", "true"]
    if drawn:
        texts += ["--device.emissions.probability", "1" if detailed else "1e-12"]
    elif detailed:
        texts += ["--device.emissions.probability", "1", "--device.emissions.deterministic", "true"]
    return texts


def write_emission_data(path: Path, target: Path) -> None:
    """Write an additional file that makes SUMO write emissions by edge over the whole run to
    `target`."""
    data = f'id="cosim" type="emissions" withInternal="true" excludeEmpty="true" file={quoteattr(str(target))}'
    path.write_text(f"<additional><edgeData {data}/></additional>\n", encoding="utf-8")


def edge_emissions(path: Path) -> dict[str, tuple[float, float]]:
    """Return edge, normal or on a junction -> CO2 and fuel [kg] of all vehicles.

    path: file of `write_emission_data`, complete at the end of the simulation
    Raises: RunFailed for a file that is not whole
    """
    try:
        edges = [edge.attrib for edge in ElementTree.parse(path).iter("edge")]
        return {
            edge["id"]: (KG_PER_MG * float(edge["CO2_abs"]), KG_PER_MG * float(edge["fuel_abs"]))
            for edge in edges
        }
    except BROKEN as error:
        raise unfinished(path, error) from None


def unfinished(path: Path, error: Exception) -> RunFailed:
    """Return the error of a file of SUMO's that ends too early."""
    return RunFailed(f"{path}: SUMO did not finish this file ({error}): is the disk full?")
