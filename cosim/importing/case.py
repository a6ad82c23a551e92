"""Sources of an import: a sumocfg with all it names, a bare network, OpenStreetMap as a file or a
box."""

import math
import re
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote

import numpy as np

from cosim.sumo.programs import HOME, run_sumo, run_tool
from cosim.sumo.xml_files import attribute, file_list, read_xml, stream_of
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder

ENDLESS_S = 1e9  # a later end is none
# Groups of options, in SUMO's own words, that change what is written or shown, or how it is read,
# but not the traffic.
IDLE = set(
    [
        "configuration",
        "output",
        "report",
        "emissions",
        "traci_server",
        "random_number",
        "gui_only",
        "example_device",
        "ssm_device",
        "fcd_device",
        "tripinfo_device",
        "vehroutes_device",
    ]
)
WRITING = re.compile(r".*(output|threads)|xml-validation.*|scale-suffix")  # others of this kind
READ = (
    "load-state",
    "load-state.offset",
    "load-state.remove-vehicles",
    "scale",
    "random-depart-offset",
)
FILES = re.compile(
    r"weight-files|astar\..*|pedestrian\.jupedsim\..*|phemlight-path|device\.fcd-replay\..*"
)
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
LICENCE = (
    "The streets are those of OpenStreetMap: (c) OpenStreetMap contributors, Open Database License 1.0\n"
    "(SPDX ODbL-1.0, https://opendatacommons.org/licenses/odbl/1-0/), https://www.openstreetmap.org/copyright\n"
)
LEFT_HAND = Path(__file__).with_name("left_hand.csv")
SERVERS = "hpi,oapi,pcoffee"  # osmGet.py's names of public ones
SERVER_TIME_LIMIT_S = 600.0
OWN_DEFAULTS = {"collision.action": "teleport"}  # of SUMO, where a scenario has others
Box = tuple[float, float, float, float]  # west, south, east, north [degrees]


class Progress(Protocol):
    """Callback with the current stage and its finished share [-]."""

    def __call__(self, stage: str, share: float = 0.0) -> None: ...


@dataclass(frozen=True, kw_only=True)
class SumoInput:
    """A simulation as its owner set it up.

    source: the given file; net; routes and additional in SUMO's order
    begin, end: [s]; end is None if it is open
    step_length [s]; mesoscopic: by SUMO's queue model
    time_to_teleport: waiting time before a teleport [s], -1 for never
    options: all others that change the traffic; reading: those that matter only to the reading of
        vehicles
    gaps: SUMO drives routes with gaps
    left_out: options that may change the traffic and are not taken over, as NAME = VALUE
    notice: required by the licence of the data
    """

    source: Path
    net: Path
    routes: tuple[Path, ...] = ()
    additional: tuple[Path, ...] = ()
    begin: float = 0.0
    end: float | None = None
    step_length: float = 1.0
    time_to_teleport: float = 300.0
    mesoscopic: bool = False
    options: Mapping[str, str] = field(default_factory=lambda: dict(OWN_DEFAULTS))
    reading: Mapping[str, str] = field(default_factory=dict)
    gaps: bool = False
    left_out: tuple[str, ...] = ()
    notice: str = ""


@contextmanager
def sumo_input(source: Path | Box, progress: Progress) -> Iterator[SumoInput]:
    """Provide the simulation of a source; a network that is built for it goes at the end of the
    block.

    source: a sumocfg, a net.xml(.gz), a file of OpenStreetMap, or a box of it
    Raises: InputError for a source that cannot be read, or no answer for a box
    """
    if isinstance(source, Path) and source.suffix == ".pbf":
        osm = source.stem.removesuffix(".osm")
        raise InputError(f"{source}: convert pbf first: osmium cat {source.name} -o {osm}.osm")
    if isinstance(source, Path) and _root(source).tag != "osm":
        yield read_sumo_input(source)
        return
    with temporary_folder() as folder:
        if not isinstance(source, Path):
            progress("fetching OpenStreetMap")
            source = fetch_osm(source, folder)
        progress("netconvert")
        net, types = folder / "osm.net.xml", HOME / "data" / "typemap" / "osmNetconvert.typ.xml"
        options = {
            "osm-files": file_list([source.resolve()]),
            "type-files": types,
            "output-file": net,
        }
        run_sumo("netconvert", options, *NETCONVERT, where=str(source))
        west, south, east, north = map(
            float, _root(net, "location").attrib["origBoundary"].split(",")
        )
        if keeps_left((west + east) / 2, (south + north) / 2):
            run_sumo("netconvert", options, *NETCONVERT, "--lefthand", where=str(source))
        net.write_bytes(
            re.sub(rb"<!--.*?-->\s*", b"", net.read_bytes(), count=1, flags=re.DOTALL)
        )  # date and folder
        yield SumoInput(source=source, net=net, notice=LICENCE)


def read_sumo_input(path: Path) -> SumoInput:
    """Read a sumocfg, or take a net.xml(.gz) as a simulation without demand. Raises InputError."""
    root = _root(path)
    if root.tag == "net":
        return SumoInput(source=path, net=path)
    if root.tag not in ("configuration", "sumoConfiguration"):
        raise InputError(
            f"{path}: expected a sumocfg, a net.xml or a file of OpenStreetMap, got a file of <{root.tag}> instead"
        )
    with temporary_folder() as folder:
        saved = folder / "read.sumocfg"
        run_sumo(
            "sumo",
            {"configuration-file": path.absolute(), "save-configuration": saved},
            where=str(path),
        )
        groups = read_xml(saved)
    options = {
        e.tag: attribute(e, "value") for group in groups if group.tag not in IDLE for e in group
    }
    options = {name: value for name, value in options.items() if not WRITING.fullmatch(name)}
    files: dict[str, tuple[Path, ...]] = {}
    for key in ("net-file", "route-files", "additional-files"):
        names = [
            unquote(name).split("/")
            for name in options.pop(key, "").split(",")
            if unquote(name).strip()
        ]
        files[key] = tuple(Path("/".join(part.strip() for part in parts)) for parts in names)
        for file in files[key]:
            if not file.is_file():
                raise InputError(
                    f"{path}: {key}: no such file: {file}; correct the name or add the file"
                )
    if not files["net-file"]:
        raise InputError(
            f'{path}: net-file: missing; add <net-file value="city.net.xml"/> to its <input>'
        )

    def number(name: str, default: str) -> float:
        return seconds(options.pop(name, default), f"{path}: {name}")

    end, teleport = number("end", "-1"), number("time-to-teleport", "300")
    begin = "0"
    if state := options.get("load-state"):
        options["load-state"] = unquote(state)
        begin = _root(Path(options["load-state"])).get("time", begin)
    mesoscopic, gaps = (
        options.pop(name, "").lower() in ("true", "1", "yes", "on", "x")
        for name in ("mesosim", "ignore-route-errors")
    )
    own = OWN_DEFAULTS | ({"meso-junction-control": "false"} if mesoscopic else {})
    return SumoInput(
        source=path,
        net=files["net-file"][0],
        routes=files["route-files"],
        additional=files["additional-files"],
        begin=number("begin", begin),
        end=end if 0 < end < ENDLESS_S else None,
        step_length=number("step-length", "1"),
        time_to_teleport=teleport if teleport > 0 else -1.0,
        mesoscopic=mesoscopic,
        options=own
        | {k: v for k, v in options.items() if k not in READ and not FILES.fullmatch(k)},
        reading={name: options[name] for name in READ if name in options},
        gaps=gaps,
        left_out=tuple(
            f"{name} = {value}" for name, value in sorted(options.items()) if FILES.fullmatch(name)
        ),
    )


def seconds(text: str, where: str) -> float:
    """Convert a SUMO time, seconds or [days:]hours:minutes:seconds; `where` is named by an
    InputError."""
    try:
        parts = [float(part) for part in text.split(":")]
        if not 1 <= len(parts) <= 4 or len(parts) == 2 or not all(map(math.isfinite, parts)):
            raise ValueError
    except ValueError:
        raise InputError(
            f"{where}: expected seconds or hours:minutes:seconds, got {text!r} instead"
        ) from None
    size = sum(
        abs(part) * unit
        for part, unit in zip(reversed(parts), (1.0, 60.0, 3600.0, 86400.0), strict=False)
    )
    return -size if text.startswith("-") else size


def keeps_left(longitude: float, latitude: float) -> bool:
    """Return True if traffic keeps left at a place [degrees], as in the nearest city of LEFT_HAND.

    >>> keeps_left(100.5, 13.75), keeps_left(102.6, 17.97)  # Bangkok, Vientiane
    (True, False)
    """
    east, north, left = np.loadtxt(LEFT_HAND, delimiter=",", skiprows=2, unpack=True)
    a, b, turn = np.radians(latitude), np.radians(north), np.radians(east - longitude)
    nearness = np.sin(a) * np.sin(b) + np.cos(a) * np.cos(b) * np.cos(
        turn
    )  # cosine of the angle between both
    return bool(left[np.argmax(nearness)])


def parse_box(text: str) -> Box:
    """Parse --bbox. Raises InputError."""
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        west = south = east = north = 0.0
    if not (-180.0 <= west < east <= 180.0 and -90.0 <= south < north <= 90.0):
        raise InputError(
            f"--bbox: expected west,south,east,north in degrees, such as 11.32,44.48,11.36,44.50, got {text!r} instead"
        )
    return west, south, east, north


def fetch_osm(box: Box, folder: Path) -> Path:
    """Fetch the streets within a box by SUMO's osmGet.py from a public server. Raises
    InputError."""
    where = ",".join(f"{value:g}" for value in box)
    options = [f"--bbox={where}", "--prefix", "osm", "--gzip", "--url", SERVERS, "--retries", "2"]
    options += ["--road-types", '{"highway": ["."]}']
    try:
        run_tool(
            "osmGet.py", *options, folder=folder, seconds=SERVER_TIME_LIMIT_S
        ).check_returncode()
        return next(folder.glob("osm_bbox.osm.xml.gz"))
    except (subprocess.SubprocessError, StopIteration) as error:
        reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1:]
        raise InputError(
            f"--bbox: {where}: osmGet.py got nothing from OpenStreetMap ({' '.join(reason)}); without internet access "
            "give a file of the area, exported at https://www.openstreetmap.org/export"
        ) from None


def _root(path: Path, tag: str | None = None) -> ElementTree.Element:
    """Read the root of an XML file, or its first element `tag`, with its attributes only. Raises
    InputError."""
    with stream_of(path) as stream:
        elements = (element for _, element in ElementTree.iterparse(stream, events=("start",)))
        return next(element for element in elements if tag in (None, element.tag))
