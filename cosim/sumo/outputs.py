"""SUMO's own output files of a run, on request: for tools that read them, beside what is recorded here."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

from cosim.sumo.xml_files import BROKEN, opened
from nmfd.errors import InputError, RunFailed, did_you_mean
from nmfd.runs.run_folder import run_name

# Kind -> ending of its file. The emissions of every vehicle in every step are gigabytes, unless compressed.
KINDS = {
    "tripinfo": "tripinfo.xml",
    "summary": "summary.xml",
    "edgedata": "edgedata.xml",
    "emission": "emission.xml.gz",
}
ZIPPED = "emission"  # where the disk is full, SUMO ends the process that it runs in
TAIL = 200  # bytes that are sure to hold the end tag of the root


def parse(text: str) -> tuple[str, ...]:
    """Kinds separated by commas. InputError for one that there is not."""
    kinds = tuple(dict.fromkeys(kind.strip() for kind in text.removesuffix(",").split(",")))
    check(kinds)
    return kinds


def check(kinds: Iterable[str]) -> None:
    """InputError for a kind that there is not."""
    for kind in kinds:
        if kind not in KINDS:
            raise InputError(
                f"--sumo-output: {kind!r} is unknown{did_you_mean(kind, KINDS)}; choose from "
                f"{', '.join(KINDS)}, separated by commas"
            )


def paths(kinds: tuple[str, ...], folder: Path, controller: str, seed: int) -> tuple[tuple[str, Path], ...]:
    """Kind and file in the run folder `folder`."""
    return tuple((kind, folder / f"{run_name(controller, seed)}.{KINDS[kind]}") for kind in kinds)


def options(outputs: Mapping[str, Path]) -> tuple[str, ...]:
    """Options of SUMO for `summary` and `emission`; tripinfo is written anyway (trip_facts)."""
    return tuple(
        part for kind in ("summary", "emission") if kind in outputs for part in (f"--{kind}-output", str(outputs[kind]))
    )


def check_whole(outputs: Mapping[str, Path]) -> None:
    """RunFailed for a file that SUMO, which says nothing of a full disk, could not write to its end."""
    for path in outputs.values():
        end = b""
        try:
            with opened(path) as stream:
                if path.suffix != ".gz":
                    stream.seek(max(path.stat().st_size - TAIL, 0))
                while part := stream.read(1 << 20):
                    end = (end + part)[-TAIL:]
        except BROKEN as error:
            raise unfinished(path, error) from None
        if not re.search(rb"</[\w-]+>\s*$", end):
            raise unfinished(path)


def unfinished(path: Path, error: Exception | None = None) -> RunFailed:
    """For a file of SUMO's that ends too early; error: how that was noticed"""
    noticed = "" if error is None else f" ({error})"
    return RunFailed(f"{path}: SUMO did not finish this file{noticed}: is the disk full?")


def write_edge_data(path: Path, target: Path, every: float) -> Path:
    """An additional file that makes SUMO write means per edge over every `every` [s] to `target`."""
    path.write_text(
        f'<additional><edgeData id="edgedata" freq="{every:g}" excludeEmpty="true" '
        f"file={quoteattr(str(target.resolve()))}/></additional>\n",
        encoding="utf-8",
    )
    return path
