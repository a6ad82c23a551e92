"""The trail of a table or picture: what made it, in the file itself, as JSON.

    csv         a last column, `trail`, with the JSON in the first row and nothing below
    markdown    a comment at the end, <!-- trail: JSON -->
    parquet     attrs["trail"] of the frame that pandas reads
    png         a text called Trail (PIL.Image.open(file).info, or exiftool)
    gif, mp4    the last comment

`command`, `commit`, `dirty`, `versions` are those of the process that wrote the file, `runs` those of the sessions
that made the runs which it shows, with their seeds, as manifest.json has them; `hashes` what these runs depend on.
Options that change no result (where to write, on how many processes) are not in commands. null: not called by a
command, or not in a checkout; "unknown": made before files had a trail, and not known. Of such a file `readme` has
the commands that the README beside it gives, `published` the commit that it came into the repository with, `not_again`
patterns of controllers whose rows cannot be made again, and why.
"""

import csv
import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from nmfd.runs import command
from nmfd.runs.provenance import provenance

COLUMN = "trail"
UNKNOWN = "unknown"
WRITER = ("command", "commit", "dirty", "versions")
EARLIER = "earlier"  # the folder beside a table that has tables whose rows are in it


def session() -> dict:
    """Of this process: date, versions, commit, and the command that it was called by."""
    return {**provenance(), "command": command.present()}


def of(file: Path) -> dict:
    """That of a file which is written now: beside the manifest of its runs, or above the folders of several levels and
    beside earlier tables."""
    here = session()
    found = {key: here[key] for key in WRITER} | of_runs(file.parent)
    for table in earlier(file.parent):
        before = read(table)
        by_readme = ({**before, "command": command} for command in before.get("readme", ()))
        for one in (*before.get("runs", ()), *by_readme):
            _add(found.setdefault("runs", []), one)
        if "not_again" in before:
            found["not_again"] = before["not_again"] | found.get("not_again", {})
        for place, hashes in before.get("hashes", {}).items():
            there = found.setdefault("hashes", {})
            there[place] = {**hashes, **there.get(place, {})}
    return found


def of_runs(folder: Path) -> dict:
    """`runs` and `hashes` of a run folder, or of those of several levels."""
    found: dict = {}
    places = [folder] if (folder / "manifest.json").is_file() else sorted(folder.glob("demand-*"))
    for place in places:
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):  # others complain of a manifest
            manifest = json.loads((place / "manifest.json").read_text(encoding="utf-8"))
            for one in manifest["sessions"]:
                _add(found.setdefault("runs", []), one)
            hashes = {
                **_hashes(manifest["configuration"]),
                **{name: about for name, of in manifest["controllers"].items() if (about := _hashes(of))},
            }
            found.setdefault("hashes", {})[place.name if place != folder else "."] = hashes
    return found


def earlier(folder: Path) -> list[Path]:
    """Tables whose runs are not there any more, in the order in which they came (cosim.evaluation.earlier)."""
    return sorted((folder / EARLIER).glob("*.csv"))


def _add(runs: list[dict], one: Mapping) -> None:
    about = {"command": one.get("command", UNKNOWN), **{key: one.get(key) for key in WRITER[1:]}}
    for known in runs:
        if {key: known[key] for key in WRITER} == about:
            known["seeds"] = sorted({*known["seeds"], *one.get("seeds", ())})
            return
    runs.append({**about, "seeds": sorted(one.get("seeds", ()))})


def commands(trail: Mapping) -> list[tuple[str, Mapping]]:
    """Every command that made runs of a file, with what is known of its session; the last ones first. Of files from
    before they had a trail, the commands are those that the README beside them gives."""
    runs = [(one["command"], one) for one in trail.get("runs", ()) if one["command"] not in (None, UNKNOWN)]
    return [*runs[::-1], *((command, trail) for command in trail.get("readme", ()))]


def _hashes(about: Mapping) -> dict:
    return {key: value for key, value in about.items() if key.endswith("_hash") and value is not None}


def text(trail: Mapping) -> str:
    """On one line, in ASCII, that nothing takes for the end of a comment."""
    return json.dumps(trail, separators=(",", ":")).replace(">", "\\u003e")


def comment(file: Path) -> str:
    """The end of a markdown file."""
    return f"\n<!-- trail: {text(of(file))} -->\n"


def metadata(file: Path) -> dict[str, str]:
    """For matplotlib, of a picture in a format that can have it."""
    return {"Trail": text(of(file))} if file.suffix == ".png" else {}


def into_gif(picture: Path, trail: str) -> None:
    """Add a comment to a finished gif, before its last byte."""
    data, content = trail.encode("ascii"), picture.read_bytes()
    parts = [data[at : at + 255] for at in range(0, len(data), 255)]
    block = b"".join([b"\x21\xfe", *(bytes([len(part)]) + part for part in parts), b"\0"])
    picture.write_bytes(content[:-1] + block + content[-1:])


def read(file: Path) -> dict:
    """That of a csv file, {} where it has none."""
    with suppress(OSError, ValueError, csv.Error, StopIteration), file.open(newline="", encoding="utf-8") as stream:
        trail = json.loads(next(csv.DictReader(stream)).get(COLUMN) or "{}")
        return trail if isinstance(trail, dict) else {}
    return {}
