"""SUMO's output files: tripinfo, read while SUMO writes it, and others on request."""

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Container, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element
from xml.sax.saxutils import quoteattr

from cosim.sumo.xml_files import BROKEN, attribute, opened
from nmfd.errors import InputError, RunFailed, did_you_mean
from nmfd.runs.files import run_name

# Kind -> ending of its file. Emissions in every step are gigabytes, unless compressed.
KINDS = {
    "tripinfo": "tripinfo.xml",
    "summary": "summary.xml",
    "edgedata": "edgedata.xml",
    "emission": "emission.xml.gz",
}
KG_PER_MG = 1e-6
EMISSION_DATA = {"type": "emissions", "withInternal": "true"}  # attributes of SUMO's edge data over the whole run
END_TAG_BYTES = 200  # these last bytes of a file hold the end tag of its root


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
        """Return the last ends after the simulation; SUMO lists vehicles under way then, too, `gone` are none of these.

        Raises RunFailed for a file that is not whole.
        """
        return self._read(gone.__contains__, last=True)

    def _read(self, left: Callable[[str], bool], last: bool = False) -> list[End]:
        """left: a vehicle of which SUMO says that it has not arrived has left, as after a teleport to its end."""
        try:
            with self._path.open("rb") as stream:
                stream.seek(self._offset)
                self._parser.feed(stream.read())
                self._offset = stream.tell()
            if last:
                self._parser.close()
            elements = [event[-1] for event in self._parser.read_events()]
            trips = [self._trip(e, left) for e in elements if isinstance(e, Element) and e.tag == "tripinfo"]
        except BROKEN as error:
            raise unfinished(self._path, error) from None
        return [end for end in trips if end is not None]

    def _trip(self, element: Element, left: Callable[[str], bool]) -> End | None:
        vehicle, reason = element.get("id", ""), element.get("vaporized", "")
        depart, loss = float(attribute(element, "depart")), max(float(element.get("timeLoss", 0.0)), 0.0)
        ended = float(attribute(element, "arrival")) >= 0 or (depart >= 0 and left(vehicle))
        edge, time = element.get("arrivalLane", "").rpartition("_")[0], depart + float(attribute(element, "duration"))
        element.clear()
        if ended:
            self.completed, self.removed = self.completed + (not reason), self.removed + bool(reason)
            return End(vehicle, time, edge, reason, loss)
        if depart >= 0:
            self.under_way[vehicle] = loss
        return None


def check(kinds: Iterable[str]) -> None:
    """Raise InputError for an unknown kind of output."""
    for kind in kinds:
        if kind not in KINDS:
            raise InputError(
                f"--sumo-output: {kind!r} is unknown{did_you_mean(kind, KINDS)}; choose from "
                f"{', '.join(KINDS)}, separated by commas"
            )


def paths(kinds: tuple[str, ...], folder: Path, controller: str, seed: int) -> tuple[tuple[str, Path], ...]:
    """Return kind and file of the outputs in a run folder."""
    return tuple((kind, folder / f"{run_name(controller, seed)}.{KINDS[kind]}") for kind in kinds)


def options(trip_file: Path, outputs: Mapping[str, Path]) -> list[str]:
    """Return the options with which SUMO writes `trip_file`, for `TripReader`, and `outputs`, kind -> file."""
    files = {"tripinfo": trip_file, **{kind: outputs[kind] for kind in ("summary", "emission") if kind in outputs}}
    others = "--tripinfo-output.write-unfinished true --tripinfo-output.write-undeparted true"
    written = [word for kind, file in files.items() for word in (f"--{kind}-output", str(file))]
    # Not 0: SUMO draws a random number for every vehicle unless it is 0, and others decide who has a rerouting device.
    emitting = "1" if "tripinfo" in outputs or "emission" in outputs else "1e-12"
    return [*written, *others.split(), "--device.emissions.probability", emitting]


def write_edge_data(path: Path, target: Path, name: str, **attributes: str) -> None:
    """Write an additional file that makes SUMO write data `name` per edge with `attributes` to `target`."""
    given = {"id": name, "excludeEmpty": "true", "file": str(target.resolve()), **attributes}
    words = " ".join(f"{key}={quoteattr(value)}" for key, value in given.items())
    path.write_text(f"<additional><edgeData {words}/></additional>\n", encoding="utf-8")


def edge_emissions(path: Path) -> dict[str, tuple[float, float]]:
    """Return edge, normal or on a junction -> CO2 and fuel [kg] of all vehicles.

    path: file of EMISSION_DATA, complete at the end of the simulation
    Raises: RunFailed for a file that is not whole
    """
    try:
        edges = [edge.attrib for edge in ElementTree.parse(path).iter("edge")]
        return {edge["id"]: (KG_PER_MG * float(edge["CO2_abs"]), KG_PER_MG * float(edge["fuel_abs"])) for edge in edges}
    except BROKEN as error:
        raise unfinished(path, error) from None


def check_whole(outputs: Mapping[str, Path]) -> None:
    """Raise RunFailed for a file that SUMO could not finish, of which it says nothing."""
    for path in outputs.values():
        end = b""
        try:
            with opened(path) as stream:
                while part := stream.read(1 << 20):
                    end = (end + part)[-END_TAG_BYTES:]
        except BROKEN as error:
            raise unfinished(path, error) from None
        if not re.search(rb"</[\w-]+>\s*$", end):
            raise unfinished(path)


def unfinished(path: Path, error: Exception | None = None) -> RunFailed:
    """Return the error of a file of SUMO's that ends too early."""
    return RunFailed(f"{path}: SUMO did not finish this file{f' ({error})' if error else ''}: is the disk full?")
