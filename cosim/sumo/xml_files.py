"""SUMO's XML files: how they are read, and named to SUMO."""

import gzip
import io
import math
import re
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from xml.sax.saxutils import escape

from nmfd.errors import InputError
from nmfd.runs.files import check_file, check_name

# Errors of a file that is cut off, no XML, in an unknown encoding, or without an attribute.
BROKEN = (OSError, EOFError, zlib.error, ElementTree.ParseError, LookupError, TypeError, ValueError)
UNITS_S = (1.0, 60.0, 3600.0, 86400.0)  # of the parts of a time, the last one first
IN_ATTRIBUTES = {'"': "&quot;", "\r": "&#13;", "\n": "&#10;", "\t": "&#09;"}
ESCAPED = re.compile('[&<>"\r\n\t]')
MAX_INCLUDE_DEPTH = 20  # of files that include each other


def attribute(element: ElementTree.Element, name: str) -> str:
    """Return the text of a required attribute. Raises ValueError."""
    value = element.get(name)
    if value is None:
        raise ValueError(f"{element.tag} {element.get('id', '')}".rstrip() + f": {name}: missing")
    return value


def child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    """Return the first element `tag` directly below. Raises ValueError."""
    below = element.find(tag)
    if below is None:
        raise ValueError(f"{element.tag}: {tag}: missing")
    return below


def is_true(value: str) -> bool:
    """Return True for a word that SUMO takes as true."""
    return value.lower() in ("true", "1", "yes", "on", "x", "t")


def seconds_of(text: str) -> float:
    """Convert a time of SUMO: seconds, or [days:]hours:minutes:seconds.

    Raises: ValueError
    """
    parts = [_number(part) for part in text.split(":")]
    if len(parts) not in (1, 3, 4) or not all(map(math.isfinite, parts)):
        raise ValueError(f"expected seconds or hours:minutes:seconds, got {text!r} instead")
    size = 0.0
    for part, unit in zip(reversed(parts), UNITS_S, strict=False):
        size += abs(part) * unit
    return -size if text.startswith("-") else size


def _number(text: str) -> float:
    """Return a number, NaN for a text that is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def read_xml(path: Path, depth: int = 0) -> ElementTree.Element:
    """Return the root of an XML file with the files that it includes.

    depth: number of files above it that include it, <include href="..."/>
    Raises: InputError
    """
    with stream_of(path) as stream:
        root = ElementTree.parse(stream).getroot()
    if depth > MAX_INCLUDE_DEPTH:
        raise InputError(
            f"{path}: include: files include each other without end; remove one of the includes"
        )
    parts: list[ElementTree.Element] = []
    for part in root:
        if part.tag == "include":
            parts += read_xml(path.parent / part.get("href", ""), depth + 1)
        else:
            parts.append(part)
    root[:] = parts
    return root


def elements_of(path: Path, tag: str) -> Iterator[ElementTree.Element]:
    """Yield the elements `tag` of a large file of SUMO's, and forget each."""
    for _, element in ElementTree.iterparse(path):
        if element.tag == tag:
            yield element
            element.clear()


def xml_text(element: ElementTree.Element, own: Mapping[str, str] = {}) -> str:
    """Return an element as ElementTree.tostring does, in less time.

    own: attributes instead of those of the element
    """
    attributes = ""
    for key, value in {**element.attrib, **own}.items():
        text = escape(value, IN_ATTRIBUTES) if ESCAPED.search(value) else value
        attributes += f' {key}="{text}"'
    content = escape(element.text or "")
    for part in element:
        content += xml_text(part) + escape(part.tail or "")
    if not content:
        return f"<{element.tag}{attributes} />"
    return f"<{element.tag}{attributes}>{content}</{element.tag}>"


def last_change(path: Path) -> int:
    """Return the time of a file's last change (ns), 0 if there is none."""
    return path.stat().st_mtime_ns if path.is_file() else 0


@contextmanager
def stream_of(
    path: Path,
    kind: str = "an XML file that SUMO could read",
    remedy: str = "correct or replace it",
) -> Iterator[io.BufferedIOBase]:
    """Yield a binary stream of a file, unzipped if it is a .gz file.

    kind, remedy: for the message of an error
    Raises: InputError, also for one of BROKEN in the block
    """
    check_path(path)
    check_file(path)
    try:
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as stream:
            yield stream
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give the path of an existing one") from None
    except BROKEN as error:
        raise InputError(f"{path}: is not {kind} ({error}); {remedy}") from None


@contextmanager
def network_root(net: Path) -> Iterator[ElementTree.Element]:
    """Yield the root of a SUMO network.

    Raises: InputError if the file is none, or if the block misses a part of it
    """
    with stream_of(net, "a SUMO network", "build it with netconvert") as stream:
        root = ElementTree.parse(stream).getroot()
        if root.tag != "net":
            raise ValueError(f"expected <net>, got a file of <{root.tag}> instead")
        yield root


def check_path(path: Path) -> None:
    """Check that SUMO can open a path.

    Raises: InputError for a name that is not UTF-8, or that SUMO would change
    """
    check_name(path)
    if "${" in str(path.absolute()):
        raise InputError(
            f"{path}: SUMO puts variables of the system for ${{...}} in a path; rename the file or "
            "folder"
        )


def file_list(files: Sequence[Path]) -> str:
    """Return files as an option of SUMO, which separates them by commas.

    Raises: InputError for a path with a comma
    """
    for file in files:
        check_path(file)
        if "," in str(file):
            raise InputError(
                f"{file}: SUMO cannot read a file with a comma in its path; "
                "rename it, or its folder"
            )
    return ",".join(map(str, files))
