"""Hundreds of inputs with one thing wrong each: one clear line, exit status 2, no traceback,
nothing left behind."""

import gzip
import io
import os
import pickle
import re
import shutil
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import corruptions
import numpy as np
import pytest
import tiny
import tiny_city
import torch
from commands import call, cosim, error_line, good, nmfd, problem
from copies import ROOT

from cosim.plant.settings import settings
from cosim.sumo.recorded_trips import read_recorded_trips
from nmfd.api import load_scenario
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint
from nmfd.model.regional_model import load_network

ECONOMIC, PEAK = ROOT / "scenarios" / "economic_mpc", ROOT / "scenarios" / "grid7_peak"
SCENARIO_TEXT, CITY_TEXT = (
    (folder / "scenario.toml").read_text().replace("../../networks", str(ROOT / "networks"))
    for folder in (ECONOMIC, PEAK)
)
NETWORK_TEXT = (ROOT / "networks" / "hexagon7" / "network.toml").read_text()
SCENARIO_KEYS = (
    *(("", key) for key in ("name", "network", "step", "steps")),
    *(("demand", key) for key in ("from", "to", "start", "peak", "ramp_up", "flat", "ramp_down")),
)
NETWORK_KEYS = (("", "name"), ("perimeter", "min"), ("mfd", "a"), ("regions", "adjacent"))


def params(cases):
    return [
        pytest.param(content, id=re.sub(r"[^!-~]+", " ", what)[:60].strip())
        for what, content in cases
    ]


@pytest.mark.parametrize("text", params(corruptions.wrong_files(SCENARIO_TEXT, SCENARIO_KEYS)))
def test_every_key_of_a_scenario(tmp_path, text):
    (tmp_path / "scenario.toml").write_text(text)
    assert "scenario.toml: " in problem(load_scenario, tmp_path)


@pytest.mark.parametrize("text", params(corruptions.wrong_files(NETWORK_TEXT, NETWORK_KEYS)))
def test_every_key_of_a_network(tmp_path, text):
    (tmp_path / "network.toml").write_text(text)
    assert "network.toml: " in problem(load_network, tmp_path)


@pytest.mark.parametrize(
    "text", params(c for c in corruptions.wrong_files(CITY_TEXT) if c[0].startswith("sumo."))
)
def test_every_key_of_a_sumo_table(tmp_path, text):
    (tmp_path / "scenario.toml").write_text(text)
    assert "scenario.toml: " in problem(lambda folder: settings(load_scenario(folder)), tmp_path)


ROW = tiny.row_network()
FILES = {
    "step too long": (tiny.SCENARIO.replace("step = 30.0", "step = 300.0"), ROW, "at most 238 s"),
    "own neighbour": (tiny.SCENARIO, ROW.replace("[0]", "[0, 1]"), "regions[1].adjacent: "),
    "controller": (
        tiny.SCENARIO + "\n[controllers.pi-gatin]\nkp = 1\n",
        ROW,
        "did you mean pi-gating?",
    ),
    "option": (
        tiny.SCENARIO + "\n[controllers.dpc-pc]\nwidht = 1\n",
        ROW,
        "controllers.dpc-pc.widht: unknown key",
    ),
}


@pytest.mark.parametrize("command", ["benchmark", "train", "show"])
@pytest.mark.parametrize("case", FILES)
def test_files_that_do_not_fit_together(tmp_path, case, command):
    scenario, network, expected = FILES[case]
    folder, out = tiny.write(tmp_path, scenario=scenario, network=network), tmp_path / "out"
    options = {
        "benchmark": "--controllers no-control",
        "train": "--controller dpc-pc",
        "show": "",
    }
    assert expected in error_line(nmfd(command, folder, options[command], "--out", out), "nmfd")
    assert not out.exists()


def npz(**arrays) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


class Evil:
    """Code in a pickle that must not run."""

    def __reduce__(self):
        return (Path.touch, (Path("executed"),))


def saved(content) -> bytes:
    out = io.BytesIO()
    torch.save(content, out)
    return out.getvalue()


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Return the content of a policy for tiny's network, and that of one for three regions."""
    contents = []
    for regions in (2, 3):
        folder = (
            tiny.write(tmp_path_factory.mktemp("policy"), network=tiny.row_network(regions)).parent
            / "network"
        )
        network = load_network(folder)
        contents.append(checkpoint(Policy(network, Architecture(width=4)), network, {}))
    return contents


WEIGHT = "backbone.0.weight"
POLICIES = {
    "missing": lambda own, other: None,
    "empty": lambda own, other: b"",
    "text": lambda own, other: b"no policy",
    "of another network": lambda own, other: saved(other),
    "pickled code": lambda own, other: pickle.dumps(Evil()),
    "pickled code in torch's format": lambda own, other: saved(
        {**own, "weights": {"scale": Evil()}}
    ),
    "a plan": lambda own, other: npz(perimeter=np.zeros(3)),
    "cut": lambda own, other: saved(own)[:1000],
    "a list": lambda own, other: saved([1, 2]),
    "no weights": lambda own, other: saved({key: own[key] for key in own if key != "weights"}),
    "no numbers": lambda own, other: saved({**own, "weights": None}),
    "another shape": lambda own, other: saved(
        {**own, "weights": {**own["weights"], WEIGHT: torch.zeros(3)}}
    ),
}


@pytest.mark.parametrize("name", POLICIES)
def test_policies(tmp_path, policy, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    scenario = tiny.write(tmp_path)
    if (content := POLICIES[name](*policy)) is not None:
        Path("p.pt").write_bytes(content)
    done = nmfd("benchmark", scenario, "--controllers dpc-pc --out out --policy dpc-pc=p.pt")
    assert "p.pt: " in error_line(done, "nmfd")
    assert not Path("executed").exists()
    assert not Path("out").exists()


@pytest.mark.parametrize(
    "content",
    params(
        [
            ("empty", b""),
            ("text", b"x"),
            ("other arrays", npz(a=np.zeros(3))),
            ("pickle", pickle.dumps(Evil())),
        ]
    ),
)
def test_plans(tmp_path, out, content):
    scenario = tiny.write(tmp_path)
    (scenario / "bound-pc.npz").write_bytes(content)
    done = nmfd("benchmark", scenario, "--controllers bound-pc --out", out)
    assert "bound-pc.npz: " in error_line(done, "nmfd")
    assert not out.exists()


HEAD = "interval,from,to,veh_s\n"
DEMANDS = (
    "",
    "k,i,j,q\n0,0,1,1\n",
    *(HEAD + row for row in ("a,b,c,d", "0,0,1", "0,0,1,-1", "0,0,1,nan", "0,0,9,1")),
)


@pytest.mark.parametrize("content", DEMANDS)
def test_demand_files(tmp_path, content):
    scenario = tiny.write(tmp_path)
    (scenario / "scenario.toml").write_text(
        'demand_file = "demand.csv"\n' + tiny.SCENARIO.split("[[demand]]")[0]
    )
    (scenario / "demand.csv").write_text(content)
    assert "demand.csv: " in problem(load_scenario, scenario)


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """Return the folder of a city, a controller, and the network and scenario imported from it."""
    project = tmp_path_factory.mktemp("project")
    tiny_city.imported(project)
    good(nmfd("new-controller", project / "mine.py"))
    return project


def gone(pattern: str):
    return lambda text: re.sub(pattern, "", text, count=1)


def changed(attribute: str, value: str):
    return lambda text: re.sub(rf'( {attribute})="[^"]+"', rf'\1="{value}"', text, count=1)


DAMAGES = {
    "networks/tiny/regions.csv": {
        "empty": lambda text: "",
        "an edge without a region": lambda text: "\n".join(text.splitlines()[:-1]) + "\n",
    },
    "networks/tiny/city.net.xml.gz": {
        "empty": lambda text: "",
        "no XML": lambda text: "city",
        "another root": lambda text: "<routes/>",
        "length": changed("length", "-5"),
        "no speed": gone(r' speed="[^"]+"'),
        "no edge id": gone(r'(?<=<edge) id="A0A1"'),
        "cut": lambda text: text[: len(text) // 2],
    },
    "scenarios/tiny/vehicles.rou.xml.gz": {
        "no XML": lambda text: "routes",
        "depart": changed("depart", "soon"),
        "no depart": gone(r' depart="[^"]+"'),
        "same id": lambda text: re.sub(r' id="[^"]+"', ' id="same"', text),
        "unknown edge": lambda text: re.sub(r'(edges|from)="\w+', r'\1="nowhere', text, count=1),
        "cut": lambda text: text[: len(text) // 2],
    },
}


@pytest.mark.parametrize("file, name", [(file, name) for file in DAMAGES for name in DAMAGES[file]])
def test_files_of_a_city(city, tmp_path, file, name):
    shutil.copytree(city, tmp_path / "project")
    path, out = tmp_path / "project" / file, tmp_path / "out"
    packed = path.suffix == ".gz"
    text = DAMAGES[file][name](
        gzip.decompress(path.read_bytes()).decode() if packed else path.read_text()
    )
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    scenario = tmp_path / "project" / "scenarios" / "tiny"
    line = error_line(cosim("run", scenario, "--controller no-control --set steps=1 --out", out))
    assert path.name in line or "nowhere" in line or "has no region" in line
    assert not out.exists()


NOT_UTF_8 = os.fsdecode(b"b\xe4d")  # as Windows of old wrote "bäd"
REPLACED = "a${HOME}b"  # SUMO puts the variable's value there
IN_ODD_FOLDERS = [
    "import {odd}/city.sumocfg --regions 3 --out {good}/networks/new",
    "import {good}/city.sumocfg --regions 3 --out {odd}/networks/new",
    "run {odd}/scenarios/tiny --controller no-control --out {good}/out",
    "evaluate {odd}/scenarios/tiny --controllers no-control --out {good}/out",
    "watch {odd}/scenarios/tiny --controller no-control",
    "identify {odd}/scenarios/tiny --out {good}/out",
]
IN_WRONG_FOLDERS = [
    "run {good}/scenarios/tiny --controller no-control --out {odd}/out",
    "run {good}/scenarios/tiny --controller {odd}/mine.py:MyController --out {good}/out",
    "tune {good}/scenarios/tiny --controller pi-gating --option kp=0.1:1 --out {odd}/out",
]


@pytest.mark.skipif(sys.platform == "darwin", reason="file names are UTF-8")
@pytest.mark.parametrize(
    "command, name, expected",
    [
        pytest.param(
            command,
            name,
            expected,
            marks=pytest.mark.slow if command.startswith("watch") else (),
        )
        for commands, name, expected in (
            (IN_ODD_FOLDERS + IN_WRONG_FOLDERS, NOT_UTF_8, "the name is not UTF-8"),
            (IN_ODD_FOLDERS, REPLACED, "SUMO puts variables"),
        )
        for command in commands
    ],
)
def test_folders_that_sumo_cannot_open(city, tmp_path, command, name, expected):
    for folder in (tmp_path / "good", tmp_path / name):
        shutil.copytree(city, folder)
    before = sorted(tmp_path.rglob("*"))
    words = [word.format(odd=tmp_path / name, good=tmp_path / "good") for word in command.split()]
    assert expected in error_line(cosim(*words))
    assert sorted(tmp_path.rglob("*")) == before


def test_unsorted_routes_are_sorted(city, tmp_path):
    root = gzip.decompress(
        (city / "scenarios" / "tiny" / "vehicles.rou.xml.gz").read_bytes()
    ).decode()
    vehicles = [
        ElementTree.tostring(vehicle, encoding="unicode")
        for vehicle in ElementTree.fromstring(root)
    ]
    (tmp_path / "r.rou.xml").write_text(f"<routes>{''.join(reversed(vehicles))}</routes>")
    assert (np.diff(read_recorded_trips([tmp_path / "r.rou.xml"]).depart) >= 0).all()


LINES = """
    benchmark {s} --controllers no-control --seeds 0|x
    benchmark {s} --controllers no-control --workers 0
    benchmark {s} --controllers ,|none|no-control,no-control|x*|mine.py|{none}.py:Mine
    benchmark {s} --controllers no-control --plant x
    benchmark {s} --controllers dpc-pc
    benchmark {s} --controllers dpc-pc --policy dpc-pc=|=x|dpc-pc|pi-gating=x
    benchmark {s} --controllers no-control --out /dev/null/x|{s}/scenario.toml
    benchmark {s} --controllers no-control --set x|x=1|=1
    benchmark {none} --controllers no-control
    benchmark
    train {s} --controller pi-gating|x
    train {s} --controller dpc-pc --steps 0
    train {s} --controller dpc-pc --device tpu
    train {s} --controller dpc-pc --out {none}/x.pt
    train {s} --controller dpc-pc --steps 1 --resume
    show {none}
    show {s} --out /dev/null/x
    robustness {s} --controllers no-control --sigmas a|-1|nan
    robustness {s} --controllers nobody
    bound {s} --controller dpc-pc
    bound {s} --controller bound-pc --out {none}/x.npz
    identify {none} --out {none}
    nonsense
    --nonsense
"""
WORDS = [
    [*words, alternative]
    for *words, last in map(str.split, filter(str.strip, LINES.splitlines()))
    for alternative in last.split("|")
]


@pytest.mark.parametrize("words", WORDS, ids=" ".join)
def test_command_lines(tmp_path, words):
    scenario = tiny.write(tmp_path)
    filled = [word.format(s=scenario, none=tmp_path / "none") for word in words]
    if filled[0] in ("benchmark", "robustness") and "--out" not in filled:
        filled += ["--out", str(tmp_path / "out")]
    before = sorted(tmp_path.rglob("*"))
    error_line(call("nmfd", *filled), "nmfd")
    assert sorted(tmp_path.rglob("*")) == before
