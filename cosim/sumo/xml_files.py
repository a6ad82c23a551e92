"""SUMO's XML files: opening them, gzipped or not, all that reading a broken one can raise, naming several to SUMO."""

import gzip
import io
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Sequence
from pathlib import Path

from nmfd.errors import InputError
from nmfd.runs.files import check_file

# Of a file that is cut off, no XML, of an encoding that there is not, or whose attributes are missing or no numbers.
BROKEN = (OSError, EOFError, zlib.error, ElementTree.ParseError, LookupError, TypeError, ValueError)
DEEPEST = 20  # of files that include each other


def opened(path: Path) -> io.BufferedIOBase:
    """A binary stream of a file, unzipped if its name ends in .gz. Raises one of BROKEN."""
    check_file(path)
    return gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb")


class Missing(ValueError):
    """An XML element without something that it must have."""


def attribute(element: ElementTree.Element, name: str) -> str:
    """The text of an attribute that must be there. Raises Missing, one of BROKEN, which names element and attribute:
    whoever knows the file makes an InputError of it."""
    value = element.get(name)
    if value is None:
        raise Missing(f"{element.tag} {element.get('id', '')}".rstrip() + f": {name}: missing")
    return value


def child(element: ElementTree.Element, tag: str) -> ElementTree.Element:
    """The first element `tag` directly below one that must have it. Raises Missing, one of BROKEN."""
    found = element.find(tag)
    if found is None:
        raise Missing(f"{element.tag}: {tag}: missing")
    return found


def read_xml(path: Path, depth: int = 0) -> ElementTree.Element:
    """The root of an XML file, with what it includes of others (<include href="..."/>). Raises InputError."""
    try:
        with opened(path) as stream:
            root = ElementTree.parse(stream).getroot()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give the path of an existing one") from None
    except BROKEN as error:
        raise InputError(f"{path}: is not an XML file that SUMO could read ({error}); correct or replace it") from None
    if any(element.tag == "include" for element in root):
        if depth > DEEPEST:
            raise InputError(f"{path}: include: files include each other without end; remove one of the includes")
        parts = list(root)
        root[:] = [
            found
            for part in parts
            for found in (read_xml(path.parent / part.get("href", ""), depth + 1) if part.tag == "include" else [part])
        ]
    return root


def file_list(files: Sequence[Path]) -> str:
    """Files as an option of SUMO. InputError for a name with a comma, where SUMO would take the next one to begin."""
    for file in files:
        if "," in str(file):
            raise InputError(f"{file}: SUMO cannot read a file with a comma in its path; rename it, or its folder")
    return ",".join(map(str, files))
