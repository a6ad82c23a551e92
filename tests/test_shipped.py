"""Scenarios and networks that come with the package: found by name, based on, listed, and never
written to."""

import re
import shutil
import tomllib
from pathlib import Path

import pytest
import tiny
from commands import call, error_line, good, nmfd
from copies import ROOT

from cosim.api import run as cosim_run
from nmfd import __version__
from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.api import run as nmfd_run
from nmfd.controllers.strategy import CONTROLLERS
from nmfd.errors import InputError
from nmfd.model.links.network import read_links
from nmfd.model.regional_model import load_network
from nmfd.runs import shipped


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """As in an installed package: data of its own, far from where the user is."""
    data = tmp_path / "site packages" / "nmfd" / "data"
    for kind, name in (
        ("scenarios", "economic_mpc"),
        ("scenarios", "grid7_peak"),
        ("networks", "hexagon7"),
        *(
            ("networks", f"grid7{variant}")
            for variant in ("", "_guided", "_max_pressure", "_rerouting")
        ),
    ):
        shutil.copytree(
            ROOT / kind / name, data / kind / name, ignore=shutil.ignore_patterns("reference")
        )
    monkeypatch.setattr(shipped, "_DATA", data)
    (tmp_path / "a folder").mkdir()
    monkeypatch.chdir(tmp_path / "a folder")
    before = sorted(data.rglob("*"))
    yield data
    assert sorted(data.rglob("*")) == before


def test_the_lists_of_packages_are_complete():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "setuptools"
    ]
    there = {
        ".".join(file.parent.relative_to(ROOT).parts)
        for name in ("nmfd", "cosim")
        for file in (ROOT / name).rglob("__init__.py")
    }
    assert set(listed["packages"]) == there | set(listed["package-dir"])
    assert not (ROOT / "nmfd" / "data").exists(), (
        "the data of a checkout are its folders scenarios and networks"
    )


def test_by_name_from_any_folder(installed):
    scenario = load_scenario("economic_mpc")
    assert scenario.folder == installed / "scenarios" / "economic_mpc"
    assert (
        load_network("hexagon7").hash
        == scenario.network.hash
        == load_scenario(scenario.folder).network.hash
    )
    assert len(nmfd_run("economic_mpc", "no-control", steps=2).accumulation) == 3
    with pytest.raises(InputError, match="grid7_pek: .* did you mean grid7_peak"):
        cosim_run("grid7_pek", "no-control")


def test_a_path_goes_before_a_name(installed):
    Path("economic_mpc").mkdir()  # some other folder, say of runs
    assert load_scenario("economic_mpc").steps == 240
    Path("economic_mpc").rmdir()
    tiny.write(Path())
    Path("scenario").rename("economic_mpc")
    assert load_scenario("economic_mpc").name == "tiny"


@pytest.mark.parametrize(
    "load, name, near",
    [
        (load_scenario, "grid7_peek", "grid7_peak"),
        (load_network, "hexagon", "hexagon7"),
        (load_scenario, "myne", "mine"),
    ],
    ids=["scenario", "network", "one of one's own"],
)
def test_a_misspelt_name(installed, load, name, near):
    tiny.write(Path())
    Path("scenario").rename("mine")
    with pytest.raises(
        InputError, match=f"{name}: no such folder .* did you mean {near}\\?; `nmfd show`"
    ):
        load(name)


def test_a_scenario_based_on_a_name_with_a_network_by_name(installed):
    Path("mine").mkdir()
    Path("mine/scenario.toml").write_text(
        'name = "mine"\nbase = "economic_mpc"\nsteps = 5\n', encoding="utf-8"
    )
    assert load_scenario("mine").network.folder.resolve() == installed / "networks" / "hexagon7"
    Path("mine/scenario.toml").write_text(
        tiny.SCENARIO.replace("../network", "hexagon7")
        + '[controllers.route-guidance]\nmodel = "hexagon7"\n',
        encoding="utf-8",
    )
    assert make_controller("route-guidance", load_scenario("mine"))
    assert load_scenario("mine").network.regions == 7


@pytest.mark.parametrize(
    "command, remedy",
    [
        (
            "nmfd train economic_mpc --controller dpc-pc",
            'give --out FILE, or make .* base = "economic_mpc"',
        ),
        ("nmfd bound economic_mpc --controller bound-pc", "give --out FILE"),
        ("cosim identify grid7_peak", "give another folder with --network"),
    ],
)
def test_nothing_is_written_into_the_package(installed, command, remedy):
    line = error_line(call(*command.split()), command.split()[0])
    assert "came with the package" in line
    assert re.search(remedy, line)


def test_a_missing_policy_is_trained_elsewhere(installed):
    scenario = load_scenario("economic_mpc")
    assert make_controller(
        "dpc-pc", scenario, policy=Path("economic_mpc/dpc-pc.pt")
    )  # as `nmfd show` calls it


def test_what_is_listed(installed):
    text = good(nmfd("show"))
    lines = {line.split()[0] for line in text.splitlines() if line.startswith("  ")}
    assert {
        "economic_mpc",
        "grid7_peak",
        "hexagon7",
        "grid7_guided",
        "economic_mpc/dpc-pc.pt",
    } <= lines
    assert {*CONTROLLERS} <= lines
    assert "none" not in lines
    assert all(len(line) < 170 for line in text.splitlines())
    assert good(nmfd("--version")).endswith(f"version {__version__}\n")
    assert good(nmfd("--cite")).startswith("cff-version: 1.2.0\n")


@pytest.mark.parametrize("name", ["grid7_peak", "bologna_lanes"])
def test_shipped_streets_can_be_read(name):
    assert len(read_links(ROOT / "scenarios" / name / "links.npz").length) > 100
