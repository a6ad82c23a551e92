"""Streets of OpenStreetMap -> a network, by SUMO's own programs.

netconvert has the options that SUMO's documentation recommends for such data (sumo.dlr.de/docs/Networks/Import/
OpenStreetMap.html), and keeps the streets of cars. Signals come out actuated: OpenStreetMap knows where they are, not
what they show.
"""

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import sumo

from cosim.importing.baseline import run_sumo
from cosim.importing.case import SumoInput, read_sumo_input, root_of
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder

RECOMMENDED = (
    "--geometry.remove",
    "--ramps.guess",
    "--junctions.join",
    "--tls.guess-signals",
    "--tls.discard-simple",
    "--tls.join",
    "--tls.default-type",
    "actuated",
)
CARS = ("--keep-edges.by-vclass", "passenger", "--remove-edges.isolated", "--no-turnarounds.except-deadend")
LICENCE = (
    "The streets are those of OpenStreetMap: (c) OpenStreetMap contributors, Open Database License 1.0\n"
    "(SPDX ODbL-1.0, https://opendatacommons.org/licenses/odbl/1-0/), https://www.openstreetmap.org/copyright\n"
)
SERVERS = "hpi,oapi,pcoffee"  # osmGet.py's names of public ones
BY_HAND = "https://www.openstreetmap.org/export"
PATIENCE = 600.0  # s, for a server to answer
Box = tuple[float, float, float, float]


@contextmanager
def sumo_input(source: Path | Box, tell: Callable[[str], None], *, left_hand: bool = False) -> Iterator[SumoInput]:
    """What SUMO is given of `source`: a sumocfg, a net, a file of OpenStreetMap, or a box of it, (west, south, east,
    north) [degrees], which is fetched first. A network made here is there until the end of the block.
    Raises InputError."""
    if isinstance(source, Path) and source.suffix == ".pbf":
        raise InputError(
            f"{source}: SUMO does not read OpenStreetMap's pbf; convert it first: "
            f"osmium cat {source.name} -o {source.stem.removesuffix('.osm')}.osm"
        )
    if isinstance(source, Path) and root_of(source).tag != "osm":
        if left_hand:
            raise InputError(f"--left-hand: {source} says itself where it drives; omit it")
        yield read_sumo_input(source)
        return
    with temporary_folder() as folder:
        if not isinstance(source, Path):
            tell("fetching OpenStreetMap")
            source = fetched(source, folder)
        tell("netconvert")
        net = converted(source, folder / "osm.net.xml", left_hand=left_hand)
        yield SumoInput(source=source, net=net, notice=LICENCE)


def converted(osm: Path, net: Path, *, left_hand: bool = False) -> Path:
    """The network of a file of OpenStreetMap, written to `net`. Raises InputError with netconvert's own words."""
    if "," in str(osm):
        raise InputError(f"{osm}: SUMO reads no file with a comma in its path; rename it")
    types = Path(sumo.SUMO_HOME) / "data" / "typemap" / "osmNetconvert.typ.xml"
    run_sumo(
        "netconvert",
        "--osm-files",
        str(osm.resolve()),
        "--type-files",
        str(types),
        "--output-file",
        str(net),
        *RECOMMENDED,
        *CARS,
        *(["--lefthand"] if left_hand else []),
        "--no-warnings",
        where=str(osm),
    )
    net.write_bytes(re.sub(rb"<!--.*?-->\s*", b"", net.read_bytes(), count=1, flags=re.DOTALL))  # the date, this folder
    return net


def fetched(box: Box, folder: Path) -> Path:
    """The streets within `box`, by SUMO's osmGet.py from a public Overpass server. InputError where none answers."""
    program = Path(sumo.SUMO_HOME) / "tools" / "osmGet.py"
    where = ",".join(f"{value:g}" for value in box)
    try:
        done = subprocess.run(
            [
                sys.executable,
                str(program),
                f"--bbox={where}",
                "--output-dir",
                str(folder),
                "--prefix",
                "osm",
                "--gzip",
                "--road-types",
                '{"highway": ["."]}',
                "--url",
                SERVERS,
                "--retries",
                "2",
            ],
            capture_output=True,
            text=True,
            errors="replace",
            stdin=subprocess.DEVNULL,
            timeout=PATIENCE,
            check=False,
            env=os.environ | {"SUMO_HOME": sumo.SUMO_HOME},
        )
        reason = (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1] if done.returncode else ""
    except subprocess.TimeoutExpired:
        reason = f"no answer in {PATIENCE:g} s"
    file = folder / "osm_bbox.osm.xml.gz"
    if reason or not file.exists():
        raise InputError(
            f"--bbox: {where}: osmGet.py got nothing from OpenStreetMap ({reason}); without a network, "
            f"give a file of the area, such as {BY_HAND} makes on a machine that has one"
        )
    return file


def parse_box(text: str) -> Box:
    """--bbox. Raises InputError."""
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        west = south = east = north = 0.0
    if not (-180.0 <= west < east <= 180.0 and -90.0 <= south < north <= 90.0):
        raise InputError(
            f"--bbox: expected west,south,east,north in degrees, such as 11.32,44.48,11.36,44.50, got {text!r} instead"
        )
    return west, south, east, north
