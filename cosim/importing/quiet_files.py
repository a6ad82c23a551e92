"""Copies of a city's vehicle and additional files that write nothing."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, ElementTree

from cosim.importing.case import SumoInput
from cosim.sumo.xml_files import file_list, read_xml

# Root of a file -> option of SUMO.
OPTIONS = {"additional": "additional-files", "routes": "route-files"}
# Elements that change no traffic.
DROPPED = ("poly", "poi", "edgeData", "laneData", "timedEvent", "vTypeProbe", "interval")
# Ends of names of elements that write files.
WRITERS = ("Detector", "Loop", "calibrator", "routeProbe")
# Parameters that only make SUMO write files.
WRITING = ("file", "has.ssm.device", "device.toc.file")


def read(case: SumoInput) -> list[Element]:
    """Return the additional files of a case, then its route files.

    Their tags are keys of OPTIONS.
    Raises: InputError
    """
    files = []
    for tag, paths in (("additional", case.additional), ("routes", case.routes)):
        for path in paths:
            root = Element(tag)
            root.extend(element for element in read_xml(path) if element.tag not in DROPPED)
            _silence(root)
            files.append(root)
    return files


def write(files: Sequence[Element], folder: Path) -> dict[str, str]:
    """Write files into a folder; return the options of SUMO that name them."""
    paths: dict[str, list[Path]] = {}
    for n, root in enumerate(files):
        path = folder / f"{n}.xml"
        ElementTree(root).write(path)
        paths.setdefault(OPTIONS[root.tag], []).append(path)
    return {option: file_list(names) for option, names in paths.items()}


def _silence(root: Element) -> None:
    """Redirect the files that elements write to nowhere."""
    for part in root.iter():
        if part.tag.endswith(WRITERS):
            for key in ("file", "output"):
                if key in part.attrib:
                    part.set(key, "NUL")
        for parameter in part.findall("param"):
            if parameter.get("key") in WRITING:
                part.remove(parameter)
