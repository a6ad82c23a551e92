"""What the user gives: a sumocfg with all it names, or a bare network."""

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cosim.sumo.xml_files import BROKEN, opened, read_xml
from nmfd.errors import InputError

# Names that SUMO gives the same option.
FILES = {
    "net-file": ("net-file", "net", "n"),
    "route-files": ("route-files", "routes", "r"),
    "additional-files": ("additional-files", "additional", "a"),
    "begin": ("begin", "b"),
    "end": ("end", "e"),
}
FOREVER = 1e9  # s; a later end is none
TAKEN = ("step-length", "time-to-teleport", "scale", "mesosim")
# Options that change what is written or shown, or how fast, but not what drives: all others are worth a word.
IDLE = re.compile(
    r".*output.*|.*log.*|.*threads|(verbose|no-warnings|quit|start|delay|seed|random|precision|version|remote|xml|gui|"
    r"window|tracker|breakpoints|print|human|save|summary|tripinfo|vehroute|fcd|netstate|statistic|queue|emission|"
    r"device\.emissions|link|save-|load|osg|demo|game|language|registry|meso-).*"
)


@dataclass(frozen=True, kw_only=True)
class SumoInput:
    """A simulation as its owner set it up.

    source: the file that was given; net; routes and additional in SUMO's order
    begin, end: [s]; end is None where it is open
    options: all other options of the sumocfg
    notice: what the licence of its data wants to be said; "" where nothing is known
    """

    source: Path
    net: Path
    routes: tuple[Path, ...] = ()
    additional: tuple[Path, ...] = ()
    begin: float = 0.0
    end: float | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    notice: str = ""

    @property
    def scale(self) -> float:
        """What SUMO multiplies the vehicles by. Raises InputError."""
        text = self.options.get("scale", "1")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not 0.0 < value <= 100.0:
            raise InputError(f"{self.source}: scale: expected a number above 0 up to 100, got {text!r} instead")
        return value

    @property
    def step_length(self) -> float:
        """[s] of SUMO's own steps. Raises InputError."""
        return seconds(self.options.get("step-length", "1"), f"{self.source}: step-length")

    @property
    def time_to_teleport(self) -> float:
        """[s], -1 for never. Raises InputError."""
        given = seconds(self.options.get("time-to-teleport", "300"), f"{self.source}: time-to-teleport")
        return given if given > 0 else -1.0

    @property
    def mesoscopic(self) -> bool:
        """Whether it runs SUMO's queue model."""
        return self.options.get("mesosim", "false").lower() in ("true", "1", "yes", "on", "x")

    @property
    def left_out(self) -> list[str]:
        """Options that are not taken over although they may change what drives, as NAME = VALUE."""
        return [
            f"{name} = {value}"
            for name, value in sorted(self.options.items())
            if name not in TAKEN and not IDLE.fullmatch(name)
        ]


def read_sumo_input(path: Path) -> SumoInput:
    """Read a sumocfg, or take a net.xml(.gz) as a case without demand. Raises InputError, also for a file it names
    that is missing."""
    root = root_of(path)
    if root.tag == "net":
        return SumoInput(source=path, net=path)
    if root.tag not in ("configuration", "sumoConfiguration"):
        raise InputError(
            f"{path}: expected a sumocfg, a net.xml or a file of OpenStreetMap, got a file of <{root.tag}> instead"
        )
    given = {}
    for element in read_xml(path).iter():
        value = element.get("value", element.get("v"))
        if value is not None:
            given[element.tag] = value
    options = {}
    for name, alike in FILES.items():
        options[name] = next((given.pop(other) for other in alike if other in given), "")
    if not options["net-file"]:
        raise InputError(f'{path}: net-file: missing; add <net-file value="city.net.xml"/> to its <input>')
    end = seconds(options["end"] or "-1", f"{path}: end")
    return SumoInput(
        source=path,
        net=_files(path, "net-file", options["net-file"])[0],
        routes=_files(path, "route-files", options["route-files"]),
        additional=_files(path, "additional-files", options["additional-files"]),
        begin=seconds(options["begin"] or "0", f"{path}: begin"),
        end=end if 0 < end < FOREVER else None,
        options=given,
    )


def _files(config: Path, key: str, value: str) -> tuple[Path, ...]:
    """Files separated by commas, as seen from the sumocfg; ${NAME} stands for a variable of the environment."""
    found = []
    value = re.sub(r"\$\{(\w+)\}", lambda name: os.environ.get(name[1], name[0]), value)
    for name in value.replace(";", ",").split(","):
        if name := name.strip():
            file = config.parent / name
            if not file.is_file():
                raise InputError(f"{config}: {key}: no such file: {file}; correct the name or add the file")
            found.append(file)
    return tuple(found)


def seconds(text: str, where: str) -> float:
    """A SUMO time, in seconds or as [days:]hours:minutes:seconds, in seconds. InputError names `where`."""
    try:
        parts = [float(part) for part in text.split(":")]
        if not 1 <= len(parts) <= 4 or len(parts) == 2 or not all(map(math.isfinite, parts)):
            raise ValueError
    except ValueError:
        raise InputError(f"{where}: expected seconds or hours:minutes:seconds, got {text!r} instead") from None
    size = sum(abs(part) * unit for part, unit in zip(reversed(parts), (1.0, 60.0, 3600.0, 86400.0), strict=False))
    return -size if text.startswith("-") else size


def root_of(path: Path) -> ElementTree.Element:
    """The root element of an XML file, with its attributes only. Raises InputError."""
    try:
        with opened(path) as stream:
            _, element = next(iter(ElementTree.iterparse(stream, events=("start",))))
            return element
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give the path of an existing one") from None
    except BROKEN as error:
        raise InputError(f"{path}: is not an XML file that SUMO could read ({error}); correct or replace it") from None
