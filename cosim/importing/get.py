"""Cities of others, fetched from their owners with their licences: `cosim get`.

Addresses name a version that does not change: a commit of GitHub, or a release of a package that pip downloads.
"""

import os
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nmfd.errors import InputError, did_you_mean
from nmfd.runs.files import temporary_folder

RESCO = "GPL-3.0, by the RESCO benchmark (github.com/Pi-Star-Lab/RESCO); this copy is of the package sumo-rl"
SERVER_TIME_LIMIT_S = 60.0  # without a byte


@dataclass(frozen=True, kw_only=True)
class Published:
    """A city as its owner publishes it.

    licence: SPDX id and grantor; source: address of a .zip, or NAME==VERSION of a package
    folder: the kept part of the archive; start: file to import, with the options of `cosim import` that it needs
    """

    about: str
    licence: str
    source: str
    folder: str
    start: str


def _github(repository: str, commit: str, folder: str = "scenario", **rest: str) -> Published:
    folder = f"{repository.partition('/')[2]}-{commit}/{folder}"
    return Published(source=f"https://github.com/{repository}/archive/{commit}.zip", folder=folder, **rest)


def _resco(name: str, about: str, regions: int) -> Published:
    source, start = "sumo-rl==1.4.5", f"{name}.sumocfg --regions {regions}"
    return Published(about=about, licence=RESCO, source=source, folder=f"sumo_rl/nets/RESCO/{name}", start=start)


def _dlr(folder: str, **rest: str) -> Published:
    commit, licence = "629e34cb444db1c7c48c852760af7b4349248837", "EPL-2.0, by DLR, Institute of Transportation Systems"
    return _github("DLR-TS/sumo-scenarios", commit, folder, licence=licence, **rest)


CITIES: Mapping[str, Published] = {
    "bologna": _dlr("bologna/joined", about="Bologna, measured demand of a peak hour", start="run.sumocfg --regions 4"),
    "hamburg": _dlr(
        "TAVF-Hamburg",
        about="Hamburg, the test field for automated driving, 43 signals, an hour",
        start="run_simulation.sumocfg --regions 3 --end 1:00:00",
    ),
    "cologne8": _resco("cologne8", "Cologne, a corridor of 8 signals, 7:00 to 8:00, demand of TAPASCologne", 3),
    "ingolstadt21": _resco("ingolstadt21", "Ingolstadt, a corridor of 21 signals, 16:00 to 17:00, from InTAS", 4),
    "lust": _github(
        "lcodeca/LuSTScenario",
        "10e1e42d01a9446c488915b9be936edb9d82b197",
        about="Luxembourg with the demand of a day (LuST 2.0), SUMO 0.26 to 0.27",
        licence="MIT, by its authors",
        start="dua.static.sumocfg --regions 6 --mesoscopic --begin 7:00:00 --end 9:00:00",
    ),
    "most": _github(
        "lcodeca/MoSTScenario",
        "088f97195e9b4a7e2b17a46d7afd3f84e71c73a1",
        about="Monaco, 4:00 to 14:00, with public transport and persons (MoST)",
        licence="GPL-3.0-or-later, by its authors",
        start="most.sumocfg --regions 4 --begin 7:00:00 --end 9:00:00",
    ),
    "intas": _github(
        "silaslobo/InTAS",
        "2c11f1582f5badc8dfdce994d6681e9b44d8de1f",
        about="All of Ingolstadt, a day (InTAS)",
        licence="GPL-3.0-or-later, by its authors",
        start="InTAS.sumocfg --regions 5 --mesoscopic --begin 7:00:00 --end 9:00:00",
    ),
}


def get(name: str, out: Path) -> str:
    """Fetch a city into a new folder, whole or not at all; return its licence and the next step. Raises InputError."""
    if name not in CITIES:
        raise InputError(f"cosim get: expected one of {', '.join(CITIES)}, got {name!r}" + did_you_mean(name, CITIES))
    if out.exists():
        raise InputError(f"--out: {out} exists; choose another folder, or remove it")
    city = CITIES[name]
    out.parent.mkdir(parents=True, exist_ok=True)
    notice = f"{name}: {city.about}\nLicence: {city.licence}\nFetched from {city.source}\n"
    with temporary_folder(f".{out.name}-", where=out.parent) as folder:
        archive = folder / "archive.whl"
        pip = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary", ":all:", "--dest", str(folder)]
        try:
            if "://" in city.source:
                with urllib.request.urlopen(city.source, timeout=SERVER_TIME_LIMIT_S) as answer:
                    archive.write_bytes(answer.read())
            else:
                subprocess.run([*pip, city.source], check=True, capture_output=True, text=True)
                archive = next(folder.glob("*.whl"))
            shutil.unpack_archive(archive, folder, "zip")
            (folder / city.folder / "NOTICE.cosim.txt").write_text(notice, encoding="utf-8")
            os.replace(folder / city.folder, out)
        except (OSError, StopIteration, subprocess.CalledProcessError) as error:
            reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1:]
            raise InputError(
                f"{name}: {city.folder} of {city.source} cannot be fetched ({' '.join(reason)}); try again with "
                "internet access"
            ) from None
    return f"{notice}Next: cosim import {out / city.start} --out networks/{name}"


def listed() -> str:
    """Return the catalogue, a city with its licence on two lines."""
    return "\n".join(f"{name:<14}{city.about}\n{'':<14}{city.licence}" for name, city in CITIES.items())
