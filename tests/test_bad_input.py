"""Hundreds of inputs with one thing wrong each: one clear line, exit status 2, no traceback, nothing left behind."""

import gzip
import io
import pickle
import random
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import corruptions
import numpy as np
import pytest
import tiny
import tiny_city
import torch
from commands import call, good

from cosim.sumo.recorded_trips import read_recorded_trips
from nmfd import closed_loop
from nmfd.api import load_scenario
from nmfd.controllers.dpc import training
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint
from nmfd.model.regional_model import load_network
from nmfd.studies import benchmark

ROOT = Path(__file__).parents[1]
HEXAGON, ECONOMIC = ROOT / "networks" / "hexagon7", ROOT / "scenarios" / "economic_mpc"
GRID, PEAK = ROOT / "networks" / "grid7", ROOT / "scenarios" / "grid7_peak"


class Accepted(BaseException):
    """The input was taken for good."""


@pytest.fixture(autouse=True)
def nothing_runs(monkeypatch):
    """What is accepted would run for long: here it says so instead."""

    def accepted(*_, **__):
        raise Accepted

    for module, name in ((closed_loop, "run"), (training, "train"), (benchmark, "draw_scenario")):
        monkeypatch.setattr(module, name, accepted)


def check(program: str, *arguments, names: str = "", out: Path) -> str:
    """The line that `program` answers with, and that there is nothing else; `names` is in it."""
    there = out.exists()
    try:
        result = call(program, *arguments)
        left = not there and out.exists()
    finally:
        if not there:
            shutil.rmtree(out, ignore_errors=True)
    assert result.exit_code == 2, (result.exit_code, repr(result.exception), result.output)
    assert re.fullmatch(f"{program}: error: [^\n]+\n", result.stderr), result.stderr
    assert result.stdout == "" and names in result.stderr, result.stderr
    assert not left and not list(out.parent.glob(f".{out.name}*"))
    return result.stderr


def params(cases):
    """pytest's parameters of (what is wrong, content), under what is wrong."""
    return [pytest.param(content, id=re.sub(r"[^!-~]+", " ", what)[:80].strip()) for what, content in cases]


def toml_cases(text: str, seed: int, required=()):
    yield from ((what, wrong.encode()) for what, wrong in corruptions.wrong_values(text))
    yield from ((what, wrong.encode()) for what, wrong in corruptions.missing_keys(text, set(required)))
    yield from corruptions.broken_files(text.encode(), seed)
    yield from corruptions.cut(text.encode(), seed)


SCENARIO_TEXT = (ECONOMIC / "scenario.toml").read_text().replace("../../networks", str(ROOT / "networks"))
SCENARIO_KEYS = [("", key) for key in ("name", "network", "step", "steps")] + [
    ("demand", key) for key in ("from", "to", "start", "peak", "ramp_up", "flat", "ramp_down")
]
NETWORKS = {
    source.name: (source / "network.toml").read_text().replace("../grid7", str(GRID))
    for source in (HEXAGON, GRID.with_name("grid7_guided"))
}
NETWORK_KEYS = [("", "name"), ("perimeter", "min"), ("mfd", "a"), ("regions", "adjacent"), ("regions.mfd", "jam")]
CITY_TEXT = (PEAK / "scenario.toml").read_text().replace("../../networks", str(ROOT / "networks"))
RECIPE = (GRID / "city.toml").read_text()
RECIPE_CASES = [
    *toml_cases(RECIPE, 4, [("centre", "x"), ("signals", "cycle")]),
    *(
        (f"regions {old!r} to {new!r}", RECIPE.replace(old, new, 1).encode())
        for old, new in (
            ("0 0 0 0 0 1", "0 0 0 0 9 1"),
            ("2 2 2 . . .", "2 2 2 . ."),
            ("2 2 2 . . .", "2 2 2 3 . ."),
            ("0 0 0", "0 . 0"),
        )
    ),
]


@pytest.mark.parametrize("content", params(toml_cases(SCENARIO_TEXT, 1, SCENARIO_KEYS)))
def test_every_key_of_a_scenario(tmp_path, content):
    (tmp_path / "scenario.toml").write_bytes(content)
    out = tmp_path / "out"
    names = "" if b"xxx" in content else "scenario.toml"  # the network that it names is missing
    check("nmfd", "benchmark", tmp_path, "--controllers", "no-control", "--out", out, names=names, out=out)


@pytest.mark.parametrize(
    "case",
    params(
        (f"{name} {what}", (what, content))
        for name, text in NETWORKS.items()
        for what, content in toml_cases(text, 2, NETWORK_KEYS)
    ),
)
def test_every_key_of_a_network(tmp_path, case):
    what, content = case
    scenario, out = tmp_path / "scenario", tmp_path / "out"
    shutil.copytree(ECONOMIC, scenario, ignore=shutil.ignore_patterns("*.pt", "*.npz", "reference"))
    toml = scenario / "scenario.toml"
    toml.write_text(toml.read_text().replace("../../networks/hexagon7", str(tmp_path)))
    (tmp_path / "network.toml").write_bytes(content)
    program, *command = (
        ["cosim", "run", "--controller"] if what.startswith("sumo.") else ["nmfd", "benchmark", "--controllers"]
    )
    names = "" if "xxx" in what else "network.toml"  # the recipe that it names is missing
    check(program, *command, "no-control", scenario, "--out", out, names=names, out=out)


@pytest.mark.parametrize("content", params(case for case in toml_cases(CITY_TEXT, 3) if "sumo." in case[0]))
def test_every_key_of_a_sumo_table(tmp_path, content):
    file, out = tmp_path / "scenario.toml", tmp_path / "out"
    file.write_bytes(content)
    check("cosim", "run", tmp_path, "--controller", "no-control", "--out", out, names=file.name, out=out)


@pytest.mark.parametrize("content", params(RECIPE_CASES))
def test_every_key_of_a_recipe(tmp_path, content):
    shutil.copytree(GRID, tmp_path / "network", ignore=shutil.ignore_patterns("build"))
    file, out = tmp_path / "network" / "city.toml", tmp_path / "out"
    file.write_bytes(content)
    (tmp_path / "scenario.toml").write_text(CITY_TEXT.replace(str(GRID), "network"))
    check("cosim", "run", tmp_path, "--controller", "no-control", "--out", out, names=file.name, out=out)
    assert not (file.parent / "build").exists()


def test_there_are_hundreds_of_them():
    cases = [list(toml_cases(text, 0)) for text in (SCENARIO_TEXT, *NETWORKS.values(), CITY_TEXT, RECIPE)]
    assert all(len(found) > 80 for found in cases) and sum(map(len, cases)) > 700


@pytest.mark.parametrize("name", ["pi_gating", "pi-gatin", "dcp-pc", "dpc-pc-robst", "pi-gatng+max-pressure"])
def test_a_table_of_a_controller_that_is_misspelt(tmp_path, name):
    text, out = f'{tiny.SCENARIO}\n[controllers."{name}"]\nx = 1\n', tmp_path / "out"
    scenario = tiny.write(tmp_path, scenario=text)
    line = check("nmfd", "benchmark", scenario, "--controllers", "no-control", "--out", out, out=out)
    assert f"controllers.{name}: unknown controller; did you mean " in line and "?; choose from " in line


def test_a_table_of_a_controller_of_the_users_own_is_his_business(tmp_path):
    load_scenario(tiny.write(tmp_path, scenario=tiny.SCENARIO + "\n[controllers.own.my-controller]\ngain = 'x'\n"))


def npz(**arrays) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


class Evil:
    def __reduce__(self):
        return (Path.touch, (Path("executed"),))


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """The content of a policy for tiny's network, and its bytes."""
    network = load_network(tiny.write(tmp_path_factory.mktemp("policy")).parent / "network")
    torch.manual_seed(0)
    content = checkpoint(
        Policy(network, Architecture(width=4)),
        network,
        {},
        states={"mean": torch.zeros(4), "precision": torch.eye(4), "limit": torch.tensor(1.0)},
    )
    return content, saved(content)


def saved(content) -> bytes:
    out = io.BytesIO()
    torch.save(content, out)
    return out.getvalue()


# What a policy file holds besides: name -> the file, from its content and its bytes. None of it may be executed.
WEIGHTS = (
    "scale",
    "backbone.0.weight",
    "backbone.0.bias",
    "backbone.2.weight",
    "backbone.2.bias",
    "perimeter_decoder.weight",
    "perimeter_decoder.bias",
)
POLICIES = {
    "empty": lambda content, whole: b"",
    "text": lambda content, whole: b"no policy",
    "pickled code": lambda content, whole: pickle.dumps(Evil()),
    "pickled code in torch's format": lambda content, whole: saved(Evil()),
    "pickled code among the weights": lambda content, whole: saved({**content, "weights": {"scale": Evil()}}),
    "a plan": lambda content, whole: npz(perimeter=np.zeros(3)),
    **{
        f"cut at {share}": lambda content, whole, share=share: whole[: int(share * len(whole))]
        for share in (0.1, 0.5, 0.9, 0.99)
    },
    **{f"noise {seed}": lambda content, whole, seed=seed: noisy(whole, random.Random(seed)) for seed in range(10)},
    **{
        f"{key} missing": lambda content, whole, key=key: saved(without(content, key))
        for key in ("format", "network_hash", "architecture", "weights")
    },
    **{
        f"{key} = {value}": lambda content, whole, key=key, value=value: saved({**content, key: value})
        for key in ("format", "network_hash", "architecture", "weights")
        for value in (None, 17, "x", [1], {})
    },
    **{
        f"architecture {key} = {value}": lambda content, whole, key=key, value=value: saved(
            {**content, "architecture": {**content["architecture"], key: value}}
        )
        for key, value in (
            ("width", 10**9),
            ("width", -1),
            ("width", "4"),
            ("layers", 10**9),
            ("layers", 0),
            ("activation", "sine"),
            ("guidance", True),
            ("depth", 3),
            ("sparse", []),
        )
    },
    **{
        f"weight {key} missing": lambda content, whole, key=key: saved(
            {**content, "weights": without(content["weights"], key)}
        )
        for key in WEIGHTS
    },
    **{
        f"weight {key} of another shape": lambda content, whole, key=key: saved(
            {**content, "weights": {**content["weights"], key: torch.zeros(3, 3, 3)}}
        )
        for key in WEIGHTS
    },
    **{f"only {value}": lambda content, whole, value=value: saved(value) for value in ([1, 2], "x", 5.0)},
    "only a tensor": lambda content, whole: saved(torch.zeros(3)),
}


def without(table: dict, key: str) -> dict:
    return {name: value for name, value in table.items() if name != key}


def noisy(whole: bytes, draw: random.Random) -> bytes:
    """Noise from somewhere in the first quarter on."""
    at = draw.randrange(len(whole) // 4)
    return whole[:at] + draw.randbytes(len(whole) - at)


def test_the_weights_of_a_policy(policy):
    assert set(policy[0]["weights"]) == set(WEIGHTS)


@pytest.mark.parametrize("name", POLICIES)
def test_policies(tmp_path, policy, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    scenario, file, out = tiny.write(tmp_path), tmp_path / "p.pt", tmp_path / "out"
    file.write_bytes(POLICIES[name](*policy))
    check(
        "nmfd",
        "benchmark",
        scenario,
        "--controllers",
        "dpc-pc",
        "--policy",
        f"dpc-pc={file}",
        "--out",
        out,
        names=file.name,
        out=out,
    )
    assert not Path("executed").exists()


@pytest.mark.parametrize("states", [None, {}, 5, [1], {"mean": 1}, "no limit"], ids=str)
def test_policies_for_the_guard(tmp_path, policy, states):
    scenario, file, out = tiny.write(tmp_path), tmp_path / "p.pt", tmp_path / "out"
    content, _ = policy
    file.write_bytes(
        saved({**content, "states": {**content["states"], "limit": None} if states == "no limit" else states})
    )
    check(
        "nmfd",
        "benchmark",
        scenario,
        "--controllers",
        "dpc-pc-guarded",
        "--policy",
        f"dpc-pc-guarded={file}",
        "--out",
        out,
        names=file.name,
        out=out,
    )


PLANS = {
    "empty": lambda: b"",
    "text": lambda: b"x",
    "other arrays": lambda: npz(a=np.zeros(3)),
    "pickle": lambda: pickle.dumps(Evil()),
    "objects": lambda: npz(perimeter=np.array([{}], dtype=object)),
    "a zip": lambda: zipped(),
    "torch": lambda: saved({"configuration": {}}),
    "torch list": lambda: saved([1]),
}


@pytest.mark.parametrize("name", PLANS)
def test_plans(tmp_path, name):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    plan = scenario / "bound-pc.npz"
    plan.write_bytes(PLANS[name]())
    check("nmfd", "benchmark", scenario, "--controllers", "bound-pc", "--out", out, names=str(plan), out=out)


def zipped() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        file.writestr("a.txt", "x")
    return out.getvalue()


DEMANDS = {
    "no header": "0,0,1,2.0\n",
    "another header": "k,i,j,q\n0,0,1,1\n",
    "empty": "",
    "text": "interval,from,to,veh_s\na,b,c,d\n",
    "three columns": "interval,from,to,veh_s\n0,0,1\n",
    "five columns": "interval,from,to,veh_s\n0,0,1,1,1\n",
    "negative": "interval,from,to,veh_s\n0,0,1,-1\n",
    "nan": "interval,from,to,veh_s\n0,0,1,nan\n",
    "inf": "interval,from,to,veh_s\n0,0,1,inf\n",
    "huge": "interval,from,to,veh_s\n0,0,1,1e300\n",
    "region": "interval,from,to,veh_s\n0,0,9,1\n",
    "negative region": "interval,from,to,veh_s\n0,-1,1,1\n",
    "interval": "interval,from,to,veh_s\n-1,0,1,1\n",
    "digits": f"interval,from,to,veh_s\n{'9' * 5000},0,1,1\n",
    "fraction": "interval,from,to,veh_s\n0.5,0,1,1\n",
    "zeros": "\0\0\0",
    "quote": 'interval,from,to,veh_s\n"0,0,1,1\n',
}


@pytest.mark.parametrize("content", params(DEMANDS.items()))
def test_demand_files(tmp_path, content):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    file = scenario / "demand.csv"
    (scenario / "scenario.toml").write_text('demand_file = "demand.csv"\n' + tiny.SCENARIO.split("[[demand]]")[0])
    file.write_text(content)
    check("nmfd", "show", scenario, "--out", out, names=file.name, out=out)


MANIFESTS = {
    "empty": "",
    "cut": "{",
    "a list": "[]",
    "null": "null",
    "a number": "5",
    "nested": "[" * 5000,
    "no table": '{"configuration": 1, "controllers": {}, "sessions": []}',
    "no list": '{"configuration": {}, "controllers": {}, "sessions": 1}',
    "no controllers": '{"configuration": {}, "sessions": []}',
}


@pytest.mark.parametrize("program", ["nmfd", "cosim"])
@pytest.mark.parametrize("text", params(MANIFESTS.items()))
def test_results_of_another_program(tmp_path, text, program):
    """A run folder whose files were damaged is not written to and not taken for finished."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "manifest.json").write_text(text)
    command = (
        ["compare", out]
        if program == "cosim"
        else ["benchmark", tiny.write(tmp_path), "--controllers", "no-control", "--out", out]
    )
    check(program, *command, names="manifest.json", out=out)
    assert [path.name for path in out.iterdir()] == ["manifest.json"]


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """The folders of an imported network and its scenario, and a scratch folder for a copy."""
    folder = tmp_path_factory.mktemp("city")
    config = tiny_city.city(folder)
    project = tmp_path_factory.mktemp("project")
    good(call("cosim", "import", config, "--regions", 3, "--out", project / "networks" / "tiny"))
    return project


@pytest.fixture
def copied(city, tmp_path):
    shutil.copytree(city, tmp_path / "project")
    return tmp_path / "project"


def run_city(copied, *arguments, names):
    out = copied / "out"
    return check(
        "cosim",
        "run",
        copied / "scenarios" / "tiny",
        "--controller",
        "no-control",
        "--steps",
        "1",
        "--out",
        out,
        *arguments,
        names=names,
        out=out,
    )


REGIONS = {
    "empty": "",
    "header": "a,b\n",
    "no regions": "edge,region\n",
    "unknown edge": "edge,region\nnowhere,0\n",
    "twice": None,
    "text": "edge,region\nA0A1,x\n",
    "negative": "edge,region\nA0A1,-1\n",
    "gap": "edge,region\nA0A1,7\n",
    "columns": "edge,region\nA0A1\n",
    "digits": f"edge,region\nA0A1,{'1' * 5000}\n",
    "zeros": "\0" * 10,
}


@pytest.mark.parametrize("content", params(REGIONS.items()))
def test_regions(copied, content):
    file = copied / "networks" / "tiny" / "regions.csv"
    whole = file.read_text()
    file.write_text(whole + whole.splitlines()[1] + "\n" if content is None else content)
    run_city(copied, names=file.name)


def test_an_edge_without_a_region(copied):
    file = copied / "networks" / "tiny" / "regions.csv"
    file.write_text("\n".join(file.read_text().splitlines()[:-1]) + "\n")
    run_city(copied, names="has no region")


# What is wrong -> the file from the whole one: what to replace by what once, or another text altogether.
NETS = {
    "empty": "",
    "no XML": "city",
    "another root": "<routes/>",
    "no edges": "<net></net>",
    "encoding": "<?xml version='1.0' encoding='utf-77'?><net/>",
    **{
        f"{attribute} = {value}": (rf'( {attribute})="[^"]+"', rf'\1="{value}"')
        for attribute in ("length", "speed")
        for value in ("0", "-5", "nan", "inf", "fast", "")
    },
    **{f"{attribute} missing": (rf' {attribute}="[^"]+"', "") for attribute in ("length", "speed")},
    **{
        f"connection {attribute} missing": (rf'(<connection[^>]*?) {attribute}="[^"]+"', r"\1")
        for attribute in ("from", "to", "fromLane", "toLane")
    },
    "via": (r' via="[^"]+"', ' via=":nowhere_0_0"'),
    "link index": (r' linkIndex="[^"]+"', ' linkIndex="x"'),
    "phase": (r'<phase duration="[^"]+"', '<phase duration="long"'),
    "state": (r'(<phase [^>]*) state="[^"]+"', r"\1"),
    "offset": (r'(<tlLogic [^>]*) offset="[^"]+"', r'\1 offset="late"'),
    "edge id": (r'<edge id="A0A1"', "<edge"),
    **{f"cut at {share}": share for share in (0.01, 0.3, 0.5, 0.8, 0.99)},
}
DAMAGES = {
    "cut gzip": lambda whole, packed: packed[: len(packed) // 2],
    "no gzip": lambda whole, packed: whole,
    "noise": lambda whole, packed: packed[:20] + bytes(99),
}


def changed(whole: str, change) -> str:
    match change:
        case (old, new):
            return re.sub(old, new, whole, count=1)
        case float():
            return whole[: int(change * len(whole))]
    return change


@pytest.mark.parametrize("change", params(NETS.items()))
def test_networks_of_sumo(copied, change):
    file = copied / "networks" / "tiny" / "city.net.xml.gz"
    file.write_bytes(gzip.compress(changed(gzip.decompress(file.read_bytes()).decode(), change).encode()))
    run_city(copied, names=file.name)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_network_of_sumo(copied, damage):
    file = copied / "networks" / "tiny" / "city.net.xml.gz"
    whole = gzip.decompress(file.read_bytes())
    file.write_bytes(DAMAGES[damage](whole, gzip.compress(whole)))
    run_city(copied, names=file.name)


ROUTES = {
    "empty": "",
    "no XML": "routes",
    "another root": "<net/>",
    "cut": 0.5,
    "a flow": "<routes><flow id='f' begin='0' end='9' number='3' from='A0A1' to='A1A2'/></routes>",
    **{
        f"depart = {value}": (r'depart="[^"]+"', f'depart="{value}"')
        for value in ("-5", "nan", "inf", "triggered", "soon", "")
    },
    "no depart": (r' depart="[^"]+"', ""),
    "no id": (r'(<(?:vehicle|trip)[^>]*?) id="[^"]+"', r"\1"),
    "id twice": None,
    "unknown edge": (r'(edges|from)="\w+', r'\1="nowhere'),
    "unknown end": "<routes><trip id='t' depart='700' from='A0A1' to='nowhere'/></routes>",
    "unknown way": "<routes><trip id='t' depart='700' from='A0A1' to='D1D2' via='nowhere'/></routes>",
}


@pytest.mark.parametrize("name", ROUTES)
def test_route_files(copied, name):
    file = copied / "scenarios" / "tiny" / "vehicles.rou.xml.gz"
    whole = gzip.decompress(file.read_bytes()).decode()
    content = re.sub(r' id="[^"]+"', ' id="same"', whole) if name == "id twice" else changed(whole, ROUTES[name])
    file.write_bytes(gzip.compress(content.encode()))
    run_city(copied, names="nowhere" if "unknown" in name else file.name)


@pytest.mark.parametrize("damage", ["empty", "no gzip", "no XML", "cut"])
@pytest.mark.parametrize("name", ["background.rou.xml.gz", "city.add.xml.gz"])
def test_other_files_of_sumo(copied, name, damage):
    file = copied / "scenarios" / "tiny" / name
    file.write_bytes(
        {"empty": b"", "no gzip": b"<routes/>", "no XML": gzip.compress(b"x"), "cut": file.read_bytes()[:50]}[damage]
    )
    run_city(copied, names=name)


def test_unsorted_routes_are_sorted(copied):
    """What SUMO would refuse is no mistake here: vehicles are sorted by departure."""
    file = copied / "scenarios" / "tiny" / "vehicles.rou.xml.gz"
    root = gzip.decompress(file.read_bytes()).decode()
    vehicles = [ElementTree.tostring(vehicle, encoding="unicode") for vehicle in ElementTree.fromstring(root)]
    (copied / "r.rou.xml").write_text(f"<routes>{''.join(reversed(vehicles))}</routes>")
    assert (np.diff(read_recorded_trips([copied / "r.rou.xml"]).depart) >= 0).all()


LINES = {
    "nmfd": """
        benchmark {s} --controllers no-control --seeds 0|-1|1.5|nan|x|99999999999
        benchmark {s} --controllers no-control --workers 0|-1|all
        benchmark {s} --controllers ,|no-control,,|none|no-control,no-control|no-control;pi-gating|x*
        benchmark {s} --controllers no-control --plant x
        benchmark {s} --controllers no-control --plant
        benchmark {s} --controllers dpc-pc
        benchmark {s} --controllers no-control --policy a=b
        benchmark {s} --controllers dpc-pc --policy dpc-pc=|=x|dpc-pc|dpc-pc={s}|dpc-pc=/dev/null
        benchmark {s} --controllers no-control --out /dev/null|/dev/null/x|{s}/scenario.toml|{s}|/proc/x
        benchmark {s} {s} --controllers no-control
        benchmark
        benchmark {s}/scenario.toml --controllers no-control
        benchmark {none} --controllers no-control
        train {s} --controller pi-gating|mpc-pc|x
        train {s} --controller dpc-pc --seed -1|x|1e3|99999999999999999999
        train {s} --controller dpc-pc --steps 0|-5|x|1e9
        train {s} --controller dpc-pc --device tpu
        train {s} --controller dpc-pc --out {none}/x.pt|{s}
        train {none} --controller dpc-pc
        train
        show {none}
        show {s} --out {s}/scenario.toml|/dev/null/x
        robustness {s} --controllers no-control --sigmas a|-1|nan|inf|1,1|,|1;2
        robustness {s} --controllers no-control --scenarios 0|x
        robustness {s} --controllers no-control --where here
        robustness {s} --controllers nobody
        bound {s} --controller dpc-pc|x
        bound {s} --controller bound-pc --from nobody|,
        bound {s} --controller bound-pc --iterations 0|x
        bound {s} --controller bound-pc --out {none}/x.npz
        new-controller {s}/scenario.toml|{none}/x.py|/dev/null/x.py
        new-controller
        benchmark {s} --controllers {none}.py:Mine|{s}/scenario.toml:Mine|mine.py
        nonsense
        --nonsense
    """,
    "cosim": """
        run {g} --controller x|pi-gating+|+|pi-gating+x|rerouting-0|rerouting-101|webster+actuated|compliance-1.5
        run {g} --controller dpc-pcrg+guidance-period-0|guidance-period-2.5
        run {g} --controller
        run {g}
        run
        run {none} --controller no-control
        run {g} --controller no-control --against x
        run {g} --controller no-control --seed -1|x|3000000000
        run {g} --controller no-control --steps 0|x|-1
        run {g} --controller no-control --policy {none}
        run {g} --controller dpc-pc --policy {none}|/dev/null
        run {g} --controller no-control --out /dev/null/x|{g}/scenario.toml|{g}
        run {s} --controller no-control
        evaluate {g} --controllers x|no-control,no-control|,
        evaluate {g} --controllers no-control --seeds 0|x
        evaluate {g} --controllers no-control --first-seed -1|x
        evaluate {g} --controllers no-control --demand 0|-1|nan|inf|x|1,1|99
        evaluate {g} --controllers no-control --workers 0|x
        evaluate {g} --controllers dpc-pc --policy x|dpc-pc={none}
        evaluate {none} --controllers no-control
        compare {none}
        compare {g} --controller x
        compare {g} --seed -1
        compare
        report {none}|{g}
        report
        watch {none} --controller no-control
        watch {g} --controller x
        watch {g} --controller no-control --delay nan|-1|x
        watch {g} --controller no-control --demand nan|0|11
        watch {g} --controller no-control --seed -1
        watch {g} --controller no-control --steps 0
        run {g} --controller {none}.py:Mine
        identify {none}
        identify {g} --levels 0|x|nan|1,1
        identify {g} --seeds 0|x
        identify {g} --iterations 0
        identify {g} --guided
        identify {g} --network /dev/null|{g}/scenario.toml|/dev/null/x
        import {none} --regions 3 --out {out}
        import {net} --regions 1|x --out {out}
        import {net} --out {out}
        import {net} --regions 3
        import {net} --regions 3 --out {out}
        import {net} --regions 3 --out {out} --begin x|nan|inf|1:2
        import {net} --regions 3 --out {out} --demand peak --level 0|nan|x|-1
        import {net} --regions 3 --out {out} --demand peak --iterations -1|x
        import {net} --regions 3 --out {out} --demand peak --gap -1|2|x|nan
        import {net} --regions 3 --out {out} --seeds 0|x
        import {net} --regions 3 --out {out} --method magic
        import {net} --regions 3 --out {out}
        import {net} --edges {none} --out {out} --demand peak
        import {net} --edges {net} --out {out} --demand peak
        import {net} --taz {net} --out {out} --demand peak
        import {net} --polygons {net} --out {out} --demand peak
        import {net} --edges a --taz b --out {out}
        drive
        --drive
    """,
}


def lines(program: str):
    """The command lines: of every one, each of the alternatives of its last word."""
    for line in filter(None, map(str.strip, LINES[program].splitlines())):
        *words, last = line.split()
        for alternative in last.split("|"):
            yield [*words, alternative]


@pytest.mark.parametrize(
    "program, words",
    [
        pytest.param(program, words, id=" ".join([program, *words])[:80])
        for program in LINES
        for words in lines(program)
    ],
)
def test_command_lines(tmp_path, program, words, city, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places = {
        "s": tiny.write(tmp_path / "tiny"),
        "g": PEAK,
        "none": tmp_path / "none",
        "out": tmp_path / "out",
        "net": city / "networks" / "tiny" / "city.net.xml.gz",
    }
    before = sorted(tmp_path.rglob("*"))
    filled = [word.format(**places) for word in words]
    if program == "nmfd" and filled[0] in ("benchmark", "show", "robustness") and "--out" not in filled:
        filled += ["--out", str(places["out"])]
    check(program, *filled, out=places["out"])
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "words",
    [
        ["nmfd", "benchmark", "{s}", "--controllers", "none"],
        ["nmfd", "show", "{none}"],
        ["cosim", "run", "{none}"],
        ["cosim", "compare", "{none}"],
    ],
    ids=" ".join,
)
def test_the_same_in_a_process_of_its_own(tmp_path, words):
    """CliRunner is not the shell: status and stderr are those of a process."""
    places = {"s": tiny.write(tmp_path), "none": tmp_path / "none"}
    program, *arguments = words
    done = subprocess.run(
        [sys.executable, "-m", program, *(a.format(**places) for a in arguments)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 2 and done.stdout == ""
    assert re.fullmatch(f"{program}: error: [^\n]+\n", done.stderr), done.stderr
