"""Sources of an import: a sumocfg, a bare network, or OpenStreetMap."""

import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote

from cosim.importing.osm import LICENCE, Box, convert, fetch
from cosim.sumo.programs import run_sumo
from cosim.sumo.xml_files import attribute, file_list, is_true, read_xml, seconds_of, stream_of
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder

ENDLESS_S = 1e9  # a later end is none
# Groups of options, in SUMO's own words, that change what is shown, but not the traffic.
SHOWING = {"configuration", "report", "gui_only"}
# Groups that change what is written: an import says that it does not take them over.
WRITING_GROUPS = {
    "output",
    "emissions",
    "traci_server",
    "random_number",
    "example_device",
    "ssm_device",
    "fcd_device",
    "tripinfo_device",
    "vehroutes_device",
}
WRITING = re.compile(r".*(output|threads)|scale-suffix")  # others of this kind
# SUMO draws a random number for every vehicle and every device with a probability, from one stream
# in the order in which it builds the vehicles. So all are drawn once, when the vehicles are read.
DRAWING = re.compile(r"device\.(\w+)\.(probability|deterministic)")
NOBODY = "1e-12"
EVERYBODY = "1"
# If it is not given at all, vehicles without a route are rerouted periodically.
REROUTING = "device.rerouting.probability"
GIVEN_FILES = ("net-file", "route-files", "additional-files")
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
VARIABLE = re.compile(r"\$\{(.+?)\}")  # of the environment, in a sumocfg
OWN_DEFAULTS = {"collision.action": "teleport"}  # of SUMO, where a scenario has others


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
    left_out: options that may change the traffic and are not taken over
    ignored: names of options that every run sets itself, or that only write files
    devices: kinds that SUMO gives to some vehicles by chance
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
    left_out: Mapping[str, str] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()
    devices: tuple[str, ...] = ()
    notice: str = ""

    def sumo_options(self) -> dict[str, object]:
        """Return SUMO's options but those of vehicles and additional files."""
        return {
            "net-file": file_list([self.net.absolute()]),
            "begin": self.begin,
            "step-length": self.step_length,
            "mesosim": str(self.mesoscopic).lower(),
            **self.options,
            **self.reading,
        }


@contextmanager
def sumo_input(
    source: Path | Box, progress: Progress, *, left_hand: bool = False
) -> Iterator[SumoInput]:
    """Provide the simulation of a source.

    A network that is built for it goes at the end of the block.
    source: a sumocfg, a net.xml(.gz), a file of OpenStreetMap, or a box of it
    left_hand: traffic keeps left in OpenStreetMap, which does not say so
    Raises: InputError for a source that cannot be read, or no answer for a box
    """
    if isinstance(source, Path) and source.suffix == ".pbf":
        osm = source.stem.removesuffix(".osm")
        raise InputError(f"{source}: convert pbf first: osmium cat {source.name} -o {osm}.osm")
    if isinstance(source, Path) and _root(source).tag != "osm":
        if left_hand:
            raise InputError(f"--left-hand: {source} says itself where traffic keeps; omit it")
        yield read_sumo_input(source)
        return
    with temporary_folder() as folder:
        if not isinstance(source, Path):
            progress("fetching OpenStreetMap")
            source = fetch(source, folder)
        progress("netconvert")
        net = convert(source, folder, left_hand=left_hand)
        yield SumoInput(source=source, net=net, notice=LICENCE)


def read_sumo_input(path: Path) -> SumoInput:
    """Read a sumocfg, or take a net.xml(.gz) as a case without demand.

    Raises: InputError
    """
    root = _root(path)
    if root.tag == "net":
        return SumoInput(source=path, net=path)
    if root.tag not in ("configuration", "sumoConfiguration"):
        raise InputError(
            f"{path}: expected a sumocfg, a net.xml or a file of OpenStreetMap, got a file of "
            f"<{root.tag}> instead"
        )
    options, ignored = _options(path)
    files = {key: _files(path, key, options.pop(key, "")) for key in GIVEN_FILES}
    if not files["net-file"]:
        raise InputError(
            f'{path}: net-file: missing; add <net-file value="city.net.xml"/> to its <input>'
        )
    loaded = "0"
    if "load-state" in options:
        state = _file(path, options["load-state"])
        options["load-state"] = state
        loaded = _root(Path(state)).get("time", loaded)

    def time(name: str, default: str) -> float:
        return seconds(options.pop(name, default), f"{path}: {name}")

    begin = time("begin", loaded)
    end = time("end", "-1")
    step_length = time("step-length", "1")
    teleport = time("time-to-teleport", "300")
    mesoscopic = is_true(options.pop("mesosim", ""))
    gaps = is_true(options.pop("ignore-route-errors", ""))
    driven = dict(OWN_DEFAULTS)
    reading = {}
    left_out = {}
    if mesoscopic:
        driven["meso-junction-control"] = "false"
    devices = []
    for name, value in options.items():
        device = DRAWING.fullmatch(name)
        if device:
            reading[name] = value
            devices.append(device[1])
            if name == REROUTING:
                driven[name] = "0"
        elif name in READ:
            reading[name] = value
        elif FILES.fullmatch(name):
            left_out[name] = value
        else:
            driven[name] = value
    return SumoInput(
        source=path,
        net=files["net-file"][0],
        routes=files["route-files"],
        additional=files["additional-files"],
        begin=begin,
        end=end if 0 < end < ENDLESS_S else None,
        step_length=step_length,
        time_to_teleport=teleport if teleport > 0 else -1.0,
        mesoscopic=mesoscopic,
        options=driven,
        reading=reading,
        gaps=gaps,
        left_out=left_out,
        ignored=ignored,
        devices=tuple(sorted(set(devices))),
    )


def _options(path: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the options of a sumocfg that change the traffic.

    And the names of those that write files or that every run sets itself.
    """
    with temporary_folder() as folder:
        saved = folder / "read.sumocfg"
        given = {"configuration-file": path.absolute(), "save-configuration": saved}
        run_sumo("sumo", given, where=str(path))
        groups = read_xml(saved)
    options = {}
    ignored = []
    for group in groups:
        for element in group:
            name = element.tag
            value = attribute(element, "value")
            if group.tag in WRITING_GROUPS or WRITING.fullmatch(name):
                ignored.append(name)
            elif name in (*GIVEN_FILES, "load-state"):
                options[name] = value
            elif group.tag not in SHOWING:
                options[name] = _substituted(value)
            if group.tag in WRITING_GROUPS and name.endswith(".probability"):
                options[name] = EVERYBODY if group.tag == "tripinfo_device" else NOBODY
    for name in ignored:  # such a device needs no random number
        if name.endswith(".deterministic"):
            options.pop(f"{name.removesuffix('.deterministic')}.probability", None)
    return options, tuple(sorted(ignored))


def _files(path: Path, key: str, names: str) -> tuple[Path, ...]:
    """Return the files of an option of a sumocfg.

    Raises: InputError if one is not there
    """
    files = []
    for name in names.split(","):
        parts = [part.strip() for part in _file(path, name).split("/")]
        if not any(parts):
            continue
        file = Path("/".join(parts))
        if not file.is_file():
            raise InputError(
                f"{path}: {key}: no such file: {file}; correct the name or add the file"
            )
        files.append(file)
    return tuple(files)


def _file(path: Path, name: str) -> str:
    """Return a file that the saved form of a sumocfg names.

    SUMO has put the folder before every name that looked relative, even if it began with an
    environment variable that holds a whole path.
    """
    text = unquote(name)
    own = text.removeprefix(f"{path.absolute().parent}/").strip()
    if own.startswith("${") and Path(_substituted(own)).is_absolute():
        return _substituted(own)
    return _substituted(text)


def _substituted(text: str) -> str:
    """Replace ${NAME} by the environment variable, as SUMO does.

    An unknown one is empty.
    """
    return VARIABLE.sub(lambda name: os.environ.get(name[1], ""), text)


def seconds(text: str, where: str) -> float:
    """Convert a SUMO time: seconds or [days:]hours:minutes:seconds.

    where: named by an error
    Raises: InputError
    """
    try:
        return seconds_of(text)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None


def _root(path: Path) -> ElementTree.Element:
    """Read the root of an XML file, with its attributes only.

    Raises: InputError
    """
    with stream_of(path) as stream:
        _, root = next(iter(ElementTree.iterparse(stream, events=("start",))))
        return root
