"""Opening SUMO's XML files, gzipped or not, and all that reading a broken one can raise."""

import gzip
import xml.etree.ElementTree as ElementTree
import zlib
from pathlib import Path

from nmfd.errors import InputError

# Of a file that is cut off, no XML, of an encoding that there is not, or whose attributes are missing or no numbers.
BROKEN = (OSError, EOFError, zlib.error, ElementTree.ParseError, LookupError, TypeError, ValueError)


def opened(path: Path):
    """A binary stream of a file, unzipped if its name ends in .gz."""
    return (gzip.open if path.suffix == ".gz" else open)(path, "rb")


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file. Raises InputError."""
    try:
        with opened(path) as stream:
            return ElementTree.parse(stream).getroot()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give the path of an existing one") from None
    except BROKEN as error:
        raise InputError(f"{path}: is not an XML file that SUMO could read ({error}); correct or replace it") from None
