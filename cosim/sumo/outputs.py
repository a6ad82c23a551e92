"""SUMO's output files: tripinfo while it is written, totals by edge."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element
from xml.sax.saxutils import quoteattr

from cosim.sumo.xml_files import BROKEN, attribute, elements_of
from nmfd.errors import RunFailed

KG_PER_MG = 1e-6


class End(NamedTuple):
    """The end of a vehicle's trip.

    time: of the simulation (s)
    edge: the last one; "" if unknown
    reason: tripinfo's `vaporized`; "" at the end of the route
    time_loss: against driving freely (s)
    """

    vehicle: str
    time: float
    edge: str = ""
    reason: str = ""
    time_loss: float = math.nan


class TripReader:
    """Reader of SUMO's tripinfo output while SUMO writes it.

    completed: vehicles that reached the last edge of their route so far
    removed: vehicles that ended before it so far
    under_way: vehicle on the road at the end of the simulation -> time loss (s)
    """

    def __init__(self, path: Path, flush: Callable[[], None] = lambda: None):
        """Prepare to read the file.

        flush: makes SUMO write what it buffers (about ten trips)
        """
        self._path = path
        self._flush = flush
        self._offset = 0
        self._parser: ElementTree.XMLPullParser[Element] = ElementTree.XMLPullParser()
        self.completed = 0
        self.removed = 0
        self.under_way: dict[str, float] = {}

    def ends(self) -> list[End]:
        """Return the trips that ended since the last call.

        Raises: RunFailed for a broken file
        """
        self._flush()
        return self._read(lambda vehicle: True)

    def finish(self, gone: Container[str] = ()) -> list[End]:
        """Return the trips that ended last, after the end of the simulation.

        gone: vehicles that have left, although SUMO lists them as under way
        Raises: RunFailed for a file that is not whole
        """
        return self._read(gone.__contains__, last=True)

    def _read(self, left: Callable[[str], bool], last: bool = False) -> list[End]:
        """Return the ends in what SUMO has written since the last call.

        left: says of a vehicle without an arrival that it has left, as after a teleport to its end
        last: the file must be whole
        """
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._offset)
                self._parser.feed(stream.read())
                self._offset = stream.tell()
            if last:
                self._parser.close()
            ends = []
            for event in self._parser.read_events():
                element = event[-1]
                if isinstance(element, Element) and element.tag == "tripinfo":
                    end = self._trip(element, left)
                    if end is not None:
                        ends.append(end)
        except BROKEN as error:
            raise unfinished(self._path, error) from None
        return ends

    def _trip(self, element: Element, left: Callable[[str], bool]) -> End | None:
        """Count a <tripinfo>; return its end, None if it is under way."""
        vehicle = element.get("id", "")
        reason = element.get("vaporized", "")
        depart = float(attribute(element, "depart"))
        time_loss = max(float(element.get("timeLoss", 0.0)), 0.0)
        ended = float(attribute(element, "arrival")) >= 0 or (depart >= 0 and left(vehicle))
        edge = element.get("arrivalLane", "").rpartition("_")[0]
        time = depart + float(attribute(element, "duration"))
        element.clear()  # the tree of a long run would take much memory
        if not ended:
            if depart >= 0:
                self.under_way[vehicle] = time_loss
            return None
        if reason:
            self.removed += 1
        else:
            self.completed += 1
        return End(vehicle, time, edge, reason, time_loss)


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


def write_edge_outputs(path: Path, emissions: Path, traffic: Path) -> None:
    """Write an additional file for two outputs over the whole run.

    emissions, traffic: SUMO's outputs by edge; emissions also of edges on junctions
    """
    polluted = quoteattr(str(emissions))
    driven = quoteattr(str(traffic))
    text = f"""<additional>
<edgeData id="emissions" type="emissions" withInternal="true" excludeEmpty="true" file={polluted}/>
<edgeData id="traffic" excludeEmpty="true" file={driven}/>
</additional>
"""
    path.write_text(text, encoding="utf-8")


def edge_emissions(path: Path) -> dict[str, tuple[float, float]]:
    """Return CO2 and fuel of all vehicles (kg) by edge, also on junctions.

    path: of `write_edge_outputs`, complete at the end of the simulation
    Raises: RunFailed for a file that is not whole
    """
    emissions = {}
    for edge in _edges(path):
        co2 = KG_PER_MG * float(edge["CO2_abs"])
        fuel = KG_PER_MG * float(edge["fuel_abs"])
        emissions[edge["id"]] = (co2, fuel)
    return emissions


def edge_traffic(path: Path) -> dict[str, tuple[float, float]]:
    """Return time loss (veh s) and vehicles that passed (veh) by edge.

    The time is against driving freely. Vehicles passed that left the edge or ended there.

    path: of `write_edge_outputs`, complete at the end of the simulation
    Raises: RunFailed for a file that is not whole
    """
    traffic = {}
    for edge in _edges(path):
        passed = float(edge["left"]) + float(edge["arrived"])
        time_loss = float(edge.get("timeLoss", 0.0))  # not there if nobody drove on the edge
        traffic[edge["id"]] = (time_loss, passed)
    return traffic


def _edges(path: Path) -> Iterator[Mapping[str, str]]:
    """Yield the attributes of every edge in an output of SUMO."""
    try:
        for edge in elements_of(path, "edge"):
            yield edge.attrib
    except BROKEN as error:
        raise unfinished(path, error) from None


def unfinished(path: Path, error: Exception) -> RunFailed:
    """Return the error of a file of SUMO's that ends too early."""
    return RunFailed(f"{path}: SUMO did not finish this file ({error}): is the disk full?")
