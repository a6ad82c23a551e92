"""Cities that are not ours: the demos that come with SUMO, and real ones if they lie beside the
project or in $CITIES.

Each must give a network and a scenario that run, or one clear line.
"""

import gzip
import os
from pathlib import Path

import pandas as pd
import pytest
import sumo
from commands import cosim, error_line, good
from copies import ROOT
from tiny_city import driven, pieces

from cosim.evaluation.simulate import Simulation, simulate
from cosim.importing.streets import read_streets
from cosim.plant.strategy import parse
from nmfd.api import load_scenario
from nmfd.metrics import total_time_spent

GAMES = Path(sumo.SUMO_HOME) / "tools" / "game"
CITIES = Path(os.environ.get("CITIES", ROOT.parent / "shared" / "cities"))
REAL = {
    "bologna": ("bologna/run.sumocfg", 4),
    "ingolstadt": ("ingolstadt21/ingolstadt21.sumocfg", 3),
    "luxembourg": ("luxembourg/luxembourg.net.xml.gz", 6),
}
COMMITTED = sorted(notice.parent.name for notice in (ROOT / "networks").glob("*/NOTICE.txt"))


def check(folder: Path, name: str, intervals: int) -> None:
    """Every edge in one region, all connected; vehicles enter, and the ledger, checked in every
    interval, is exact."""
    network = folder / "networks" / name
    streets = read_streets(network / "city.net.xml.gz")
    table = pd.read_csv(network / "regions.csv", dtype={"edge": str})
    assert list(table["edge"]) == list(streets.edges)
    regions = table["region"].to_numpy()
    for region in range(regions.max() + 1):
        assert pieces(streets, streets.main_part & (regions == region)) == 1
    _, departed, arrived, inside, _ = driven(
        load_scenario(folder / "scenarios" / name), intervals, 0.3
    )
    assert departed > 0
    assert departed - arrived == inside


@pytest.mark.skipif(not GAMES.is_dir(), reason="this SUMO comes without its demos")
@pytest.mark.parametrize(
    "name, expected",
    [
        pytest.param("cross", None, marks=pytest.mark.slow),
        pytest.param("grid6", None, marks=pytest.mark.slow),
        pytest.param("corridor", None, marks=pytest.mark.slow),
        ("DRT", "names no vehicles for the streets of cars"),
        pytest.param("ramp", "no two regions can be made", marks=pytest.mark.slow),
        ("rail", "has no edge that cars may use"),
    ],
)
def test_demos_of_sumo(tmp_path, name, expected):
    result = cosim(
        "import",
        GAMES / f"{name}.sumocfg",
        "--regions 3 --seeds 1 --out",
        tmp_path / "networks" / name,
    )
    if expected is None:
        good(result)
        check(tmp_path, name, 2)
    else:
        assert expected in error_line(result)
        assert not list((tmp_path / "networks").glob("*"))
        assert not list((tmp_path / "scenarios").glob("*"))


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
def test_real_cities(tmp_path, name):
    source, count = REAL[name]
    if not (CITIES / source).is_file():
        pytest.skip(f"no real city: {CITIES / source} is not there")
    peak = "--demand peak --level 0.05" if name == "luxembourg" else ""
    out = tmp_path / "networks" / name
    text = good(cosim("import", CITIES / source, "--regions", count, peak, "--out", out))
    assert "regions instead of" not in text
    check(tmp_path, name, 2)


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.5, 1.0])
@pytest.mark.parametrize("name", ["cologne8", "ingolstadt21", "bologna"])
def test_max_pressure_takes_no_longer_than_fixed_time(tmp_path, name, level):
    """With lanes that movements share, bus lanes and streets of buses; all trips end."""
    (config,) = (CITIES / name).glob("*.sumocfg") if (CITIES / name).is_dir() else (None,)
    if config is None:
        pytest.skip(f"no real city: {CITIES / name} is not there")
    good(cosim("import", config, "--regions 3 --out", tmp_path / "networks" / name))
    spent = {}
    for signals in ("no-control", "max-pressure"):
        run = simulate(
            Simulation(
                load_scenario(tmp_path / "scenarios" / name), parse(signals), seed=1, demand=level
            )
        )
        spent[signals] = total_time_spent(run)
        assert run.completed_veh == run.trips, signals
    assert max(spent, key=spent.get) == "no-control", spent


@pytest.mark.parametrize("name", COMMITTED)
def test_committed_cities_are_small_and_need_nothing_else(name):
    load_scenario(ROOT / "scenarios" / name)
    assert "SPDX" in (ROOT / "networks" / name / "NOTICE.txt").read_text()
    size = 0
    for folder in (ROOT / "networks" / name, ROOT / "scenarios" / name):
        assert (folder / "NOTICE.txt").is_file()
        for file in (
            file for file in folder.rglob("*") if file.is_file() and "reference" not in file.parts
        ):
            content = (
                gzip.decompress(file.read_bytes()) if file.suffix == ".gz" else file.read_bytes()
            )
            assert b"/work/" not in content, file
            assert b"shared/cities" not in content, file
            size += file.stat().st_size
    assert size < 5e6


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMITTED)
def test_committed_cities_run_under_their_policies(tmp_path, name):
    scenario = ROOT / "scenarios" / name
    for strategy in ("route-guidance", *(policy.stem for policy in scenario.glob("*.pt"))):
        good(
            cosim("run", scenario, "--controller", strategy, "--steps 2 --out", tmp_path / strategy)
        )
