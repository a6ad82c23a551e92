"""Cities of others, with where they are published and under which licence: what `cosim get` knows.

Addresses name a version that does not change: a release of PyPI, or a commit of GitHub. PyPI publishes hashes. Of
GitHub's archives nobody does: the first download records the hash, and later ones are held against it
(cosim.importing.download).
"""

from collections.abc import Mapping
from dataclasses import dataclass

SUMO_RL = (
    "https://files.pythonhosted.org/packages/e9/76/892e7b2e314887f21958a9c5b215c689a2e50cc134e49ec6654efef66751/"
    "sumo_rl-1.4.5.tar.gz"
)
SUMO_RL_HASH = "230979fb77969a76839cd36027db2ac1aea0e2a41d9b38000f592287c3d12c11"
RESCO = "GPL-3.0, by the RESCO benchmark (github.com/Pi-Star-Lab/RESCO); this copy is of the package sumo-rl"


@dataclass(frozen=True, kw_only=True)
class Published:
    """A city as its owner publishes it.

    about: what it is; owner: their page; licence: SPDX id and who grants it
    address: of a .zip or .tar.gz; folder: the part of it that is kept
    sha256: of the archive; None where its publisher names none
    start: the file to import, and the options of `cosim import` that it needs
    """

    about: str
    owner: str
    licence: str
    address: str
    folder: str
    start: str
    sha256: str | None = None


def _github(repository: str, commit: str, folder: str, **rest: str) -> Published:
    name = repository.partition("/")[2]
    return Published(
        owner=f"https://github.com/{repository}",
        folder=f"{name}-{commit}/{folder}",
        address=f"https://github.com/{repository}/archive/{commit}.zip",
        **rest,
    )


CITIES: Mapping[str, Published] = {
    "cologne8": Published(
        about="Cologne, a corridor of 8 signals, 7:00 to 8:00, demand of TAPASCologne",
        owner="https://pypi.org/project/sumo-rl/1.4.5/",
        licence=RESCO,
        address=SUMO_RL,
        sha256=SUMO_RL_HASH,
        folder="sumo_rl-1.4.5/sumo_rl/nets/RESCO/cologne8",
        start="cologne8.sumocfg --regions 3",
    ),
    "ingolstadt21": Published(
        about="Ingolstadt, a corridor of 21 signals, 16:00 to 17:00, from InTAS",
        owner="https://pypi.org/project/sumo-rl/1.4.5/",
        licence=RESCO,
        address=SUMO_RL,
        sha256=SUMO_RL_HASH,
        folder="sumo_rl-1.4.5/sumo_rl/nets/RESCO/ingolstadt21",
        start="ingolstadt21.sumocfg --regions 4",
    ),
    "lust": _github(
        "lcodeca/LuSTScenario",
        "10e1e42d01a9446c488915b9be936edb9d82b197",
        "scenario",
        about="Luxembourg with the demand of a day (LuST 2.0), SUMO 0.26 to 0.27",
        licence="MIT, by its authors",
        start="dua.static.sumocfg --regions 6 --mesoscopic --begin 7:00:00 --end 9:00:00",
    ),
    "most": _github(
        "lcodeca/MoSTScenario",
        "088f97195e9b4a7e2b17a46d7afd3f84e71c73a1",
        "scenario",
        about="Monaco, 4:00 to 14:00, with public transport and persons (MoST)",
        licence="GPL-3.0-or-later, by its authors",
        start="most.sumocfg --regions 4 --begin 7:00:00 --end 9:00:00",
    ),
    "intas": _github(
        "silaslobo/InTAS",
        "2c11f1582f5badc8dfdce994d6681e9b44d8de1f",
        "scenario",
        about="All of Ingolstadt, a day (InTAS)",
        licence="GPL-3.0-or-later, by its authors",
        start="InTAS.sumocfg --regions 5 --mesoscopic --begin 7:00:00 --end 9:00:00",
    ),
}
