"""Streets of OpenStreetMap, converted to a SUMO network."""

import re
import subprocess
from pathlib import Path

from cosim.sumo.programs import HOME, last_words, run_sumo, run_tool
from cosim.sumo.xml_files import file_list
from nmfd.errors import InputError

# As SUMO's documentation recommends: sumo.dlr.de/docs/Networks/Import/OpenStreetMap.html.
# OpenStreetMap does not say what signals show: they come out actuated.
NETCONVERT = [
    "--geometry.remove",
    "--ramps.guess",
    "--junctions.join",
    "--tls.guess-signals",
    "--tls.discard-simple",
    "--tls.join",
    "--tls.default-type",
    "actuated",
    "--keep-edges.by-vclass",
    "passenger",
    "--remove-edges.isolated",
    "--no-turnarounds.except-deadend",
    "--no-warnings",
]
TYPES = HOME / "data" / "typemap" / "osmNetconvert.typ.xml"
LICENCE = (
    "The streets are those of OpenStreetMap: (c) OpenStreetMap contributors, Open Database License "
    "1.0\n(SPDX ODbL-1.0, https://opendatacommons.org/licenses/odbl/1-0/), "
    "https://www.openstreetmap.org/copyright\n"
)
SERVERS = "hpi,oapi,pcoffee"  # osmGet.py's names of public ones
SERVER_TIME_LIMIT_S = 600.0
Box = tuple[float, float, float, float]  # west, south, east, north [degrees]


def parse_box(text: str) -> Box:
    """Parse --bbox. Raises InputError."""
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        west = south = east = north = 0.0
    if not (-180.0 <= west < east <= 180.0 and -90.0 <= south < north <= 90.0):
        raise InputError(
            "--bbox: expected west,south,east,north in degrees, such as 11.32,44.48,11.36,44.50, "
            f"got {text!r} instead"
        )
    return west, south, east, north


def fetch(box: Box, folder: Path) -> Path:
    """Fetch the streets within a box by SUMO's osmGet.py from a public server.

    Raises: InputError
    """
    where = ",".join(f"{value:g}" for value in box)
    options = [f"--bbox={where}", "--prefix", "osm", "--gzip", "--url", SERVERS, "--retries", "2"]
    options += ["--road-types", '{"highway": ["."]}']
    try:
        run_tool(
            "osmGet.py", *options, folder=folder, seconds=SERVER_TIME_LIMIT_S
        ).check_returncode()
        return next(folder.glob("osm_bbox.osm.xml.gz"))
    except (subprocess.SubprocessError, StopIteration) as error:
        raise InputError(
            f"--bbox: {where}: osmGet.py got nothing from OpenStreetMap ({last_words(error)}); "
            "without internet access give a file of the area, exported at "
            "https://www.openstreetmap.org/export"
        ) from None


def convert(source: Path, folder: Path, *, left_hand: bool) -> Path:
    """Convert a file of OpenStreetMap to a network in a folder."""
    net = folder / "osm.net.xml"
    options = {
        "osm-files": file_list([source.resolve()]),
        "type-files": TYPES,
        "output-file": net,
    }
    flags = list(NETCONVERT)
    if left_hand:
        flags.append("--lefthand")
    run_sumo("netconvert", options, *flags, where=str(source))
    # The first comment has the date and the folder.
    content = re.sub(rb"<!--.*?-->\s*", b"", net.read_bytes(), count=1, flags=re.DOTALL)
    net.write_bytes(content)
    return net
