"""Published cities, fetched with their licences: `cosim get`."""

import os
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from cosim.importing.cut import Plan, cut
from cosim.sumo.programs import last_words
from nmfd.errors import InputError, did_you_mean
from nmfd.runs import config
from nmfd.runs.files import temporary_folder

SERVER_TIME_LIMIT_S = 60.0  # without a byte


@cache
def published() -> Mapping[str, Mapping[str, Any]]:
    """Return name -> entry of cities.toml, whose comments explain the fields."""
    return config.read(Path(__file__).with_name("cities.toml"))


def get(name: str, out: Path) -> str:
    """Fetch a city into a new folder; return its licence and the next step.

    It comes whole or not at all.
    Raises: InputError
    """
    cities = published()
    if name not in cities:
        raise InputError(
            f"cosim get: expected one of {', '.join(cities)}, got {name!r}"
            + did_you_mean(name, cities)
        )
    if out.exists():
        raise InputError(f"--out: {out} exists; choose another folder, or remove it")
    city = cities[name]
    out.parent.mkdir(parents=True, exist_ok=True)
    contents = city["folder"]
    notice = f"{name}: {city['about']}\nLicence: {city['licence']}\n"
    with temporary_folder(f".{out.name}-", where=out.parent) as folder:
        try:
            for source in city["sources"]:
                notice += f"Fetched from {source}\n"
                _fetch(source, folder)
            if "cut" in city:
                cut(Plan(**city["cut"]), folder, folder / contents)
            if "regions" in city:
                table = city["regions"]
                shutil.copy(Path(__file__).with_name(table), folder / contents / table)
            (folder / contents / "NOTICE.cosim.txt").write_text(notice, encoding="utf-8")
            os.replace(folder / contents, out)
        except (OSError, StopIteration, subprocess.CalledProcessError) as error:
            raise InputError(
                f"{name}: {contents} of {source} cannot be fetched ({last_words(error)}); try "
                "again with internet access"
            ) from None
    start = str(out / city["start"])
    if "regions" in city:
        start += f" --regions {out / city['regions']}"
    return f"{notice}Next: cosim import {start} --out networks/{name}"


def _fetch(source: str, folder: Path) -> None:
    """Download an .xml file into a folder, or unpack an archive there."""
    if "://" in source:
        file = folder / source.rpartition("/")[2]
        with urllib.request.urlopen(source, timeout=SERVER_TIME_LIMIT_S) as answer:
            file.write_bytes(answer.read())
    else:
        pip = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary", ":all:"]
        subprocess.run(
            [*pip, "--dest", str(folder), source], check=True, capture_output=True, text=True
        )
        file = next(folder.glob("*.whl"))
    if file.suffix != ".xml":
        shutil.unpack_archive(file, folder, "zip")


def listed() -> str:
    """Return the catalogue, a city with its licence on two lines."""
    lines = []
    for name, city in published().items():
        lines += [f"{name:<14}{city['about']}", f"{'':<14}{city['licence']}"]
    return "\n".join(lines)
