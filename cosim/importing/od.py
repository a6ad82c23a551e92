"""Origin-destination matrices between TAZ, as SUMO's od2trips reads them, and the trips that follow from them.

Three formats: tazRelation (or edgeRelation) elements in the intervals of an XML file; PTV VISUM's O-format ($O...), a
line per pair; its V-format ($V...), a line per origin. Any of them may be gzipped.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from cosim.importing.case import seconds
from cosim.sumo.xml_files import opened, read_xml
from nmfd.errors import InputError

COUNTS = ("count", "value")  # attributes of a relation that may hold the number of vehicles


@dataclass(frozen=True, kw_only=True)
class Cell:
    """count vehicles from origin to destination, departures evenly between begin and end [s].

    zones: these are TAZ, else edges; type: of the vehicles, or None; where: file, for errors
    """

    begin: float
    end: float
    origin: str
    destination: str
    count: float
    zones: bool = True
    type: str | None = None
    where: str = ""


def read_od(path: Path) -> list[Cell]:
    """The cells of a matrix file that are not zero. Raises InputError."""
    try:
        with opened(path) as stream:
            start = stream.read(200).lstrip()
    except FileNotFoundError:
        raise InputError(f"--od: no such file: {path}; give the path of an existing one") from None
    except (OSError, EOFError) as error:
        raise InputError(f"{path}: cannot be read ({error}); give an OD matrix") from None
    if start.startswith(b"$"):
        return _read_lines(path)
    if start.startswith((b"<", b"\xef\xbb\xbf<")):
        cells = relations(read_xml(path), path)
        if cells:
            return cells
    raise InputError(
        f"{path}: is no OD matrix: expected tazRelation elements in intervals, or $O... or $V... in the first line"
    )


def relations(root: Element, path: Path) -> list[Cell]:
    """The tazRelation and edgeRelation elements below `root`. Raises InputError."""
    found = []
    for interval in root.iter("interval"):
        for element in interval:
            if element.tag in ("tazRelation", "edgeRelation"):
                where = f"{path}: {element.tag} from {element.get('from')} to {element.get('to')}"
                times = [seconds(interval.get(key, ""), f"{path}: interval: {key}") for key in ("begin", "end")]
                text = next((element.get(key) for key in COUNTS if element.get(key) is not None), None)
                found.append(
                    Cell(
                        begin=times[0],
                        end=times[1],
                        origin=element.get("from", ""),
                        destination=element.get("to", ""),
                        count=_number(text, f"{where}: count"),
                        zones=element.tag == "tazRelation",
                        type=element.get("type"),
                        where=str(path),
                    )
                )
    return _checked(found)


def _read_lines(path: Path) -> list[Cell]:
    """O-format and V-format."""
    with opened(path) as stream:
        lines = stream.read().decode("utf-8", errors="replace").splitlines()
    head = lines[0].strip().lstrip("$").split(";")[0].upper()
    rows = iter([line.strip() for line in lines[1:] if line.strip() and not line.lstrip().startswith("*")])
    if head[:1] not in ("O", "V"):
        raise InputError(f"{path}: line 1: expected $O... or $V..., got {lines[0].strip()!r} instead")
    kind = _next(rows, path, "vehicle type") if "M" in head else None
    times = _next(rows, path, "from-time to-time").split()
    if len(times) != 2:
        raise InputError(f"{path}: expected from-time and to-time, such as 7.00 8.00, got {' '.join(times)!r} instead")
    factor = _number(_next(rows, path, "factor"), f"{path}: factor")
    shared: dict = {"begin": _hours(times[0], path), "end": _hours(times[1], path), "type": kind, "where": str(path)}
    found = []
    if head[0] == "O":
        for row in rows:
            parts = row.split()
            if len(parts) < 3:
                raise InputError(f"{path}: expected from, to and a number in every line, got {row!r} instead")
            count = factor * _number(parts[2], f"{path}: {parts[0]} to {parts[1]}")
            found.append(Cell(origin=parts[0], destination=parts[1], count=count, **shared))
        return _checked(found)
    size = int(_number(_next(rows, path, "number of zones"), f"{path}: number of zones"))
    words = [word for row in rows for word in row.split()]
    names, values = words[:size], words[size:]
    if len(values) != size * size:
        raise InputError(f"{path}: expected {size} names and {size} x {size} numbers, got {len(words)} entries instead")
    for n, text in enumerate(values):
        origin, destination = names[n // size], names[n % size]
        count = factor * _number(text, f"{path}: {origin} to {destination}")
        found.append(Cell(origin=origin, destination=destination, count=count, **shared))
    return _checked(found)


def _next(rows: Iterator[str], path: Path, what: str) -> str:
    row = next(rows, None)
    if row is None:
        raise InputError(f"{path}: ends before the line with the {what}; add it")
    return row


def _hours(text: str, path: Path) -> float:
    """[s] of hours.minutes, 7.30 is half past seven, or of hours:minutes:seconds."""
    if ":" in text:
        return seconds(text, f"{path}: time")
    hours, _, minutes = text.partition(".")
    try:
        return 3600.0 * int(hours) + 60.0 * int(minutes.ljust(2, "0")[:2] if minutes else 0)
    except ValueError:
        raise InputError(f"{path}: time: expected hours.minutes, such as 7.30, got {text!r} instead") from None


def _number(text: str | None, where: str) -> float:
    try:
        value = float(text or "")
        if not 0.0 <= value < np.inf:
            raise ValueError
    except ValueError:
        raise InputError(f"{where}: expected a number from 0 up, got {text!r} instead") from None
    return value


def _checked(cells: Sequence[Cell]) -> list[Cell]:
    for cell in cells:
        if cell.end <= cell.begin:
            raise InputError(
                f"{cell.where}: an interval ends at {cell.end:g} s, but begins at {cell.begin:g} s; correct the times"
            )
    return [cell for cell in cells if cell.count > 0]


def trips(
    cells: Sequence[Cell], random: np.random.Generator, types: Collection[str], note: Callable[[str, int], None]
) -> list[Element]:
    """`trip` elements od0, od1, ...; a part of a vehicle drives with that probability. Types that nobody defines are
    left away. note(what, how often) is told what was done."""
    found: list[Element] = []
    for cell in cells:
        count = int(cell.count + random.random())
        ends = ("fromTaz", "toTaz") if cell.zones else ("from", "to")
        shared = dict(zip(ends, (cell.origin, cell.destination), strict=True))
        if cell.type is not None and cell.type in types:
            shared["type"] = cell.type
        for n in range(count):
            depart = cell.begin + (cell.end - cell.begin) * (n + random.random()) / count
            found.append(
                Element(
                    "trip",
                    {
                        "id": f"od{len(found)}",
                        "depart": f"{depart:.2f}",
                        "departLane": "best",
                        "departSpeed": "max",
                        "departPos": "random_free",
                        **shared,
                    },
                )
            )
    note("trips drawn from OD matrices", len(found))
    if unknown := {cell.type for cell in cells if cell.type and cell.type not in types}:
        note(f"types of OD matrices that no vType defines, driven as cars ({', '.join(sorted(unknown))})", len(unknown))
    return found
