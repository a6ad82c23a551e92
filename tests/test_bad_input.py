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
from click.testing import CliRunner

import cosim.cli.main
import nmfd.cli.main
from nmfd import closed_loop
from nmfd.api import load_scenario
from nmfd.controllers.dpc import training
from nmfd.controllers.dpc.policy import Architecture, Policy, checkpoint
from nmfd.model.regional_model import load_network
from nmfd.studies import benchmark

ROOT = Path(__file__).parents[1]
MAINS = {"nmfd": nmfd.cli.main.main, "cosim": cosim.cli.main.main}
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
        result = CliRunner().invoke(MAINS[program], [str(argument) for argument in arguments])
        left = not there and out.exists()
    finally:
        if not there:
            shutil.rmtree(out, ignore_errors=True)
    assert result.exit_code == 2, (result.exit_code, repr(result.exception), result.output)
    assert re.fullmatch(f"{program}: error: [^\n]+\n", result.stderr), result.stderr
    assert result.stdout == "" and names in result.stderr, result.stderr
    assert not left and not list(out.parent.glob(f".{out.name}*"))
    return result.stderr


def every(cases, test) -> int:
    """Run `test` for all (what is wrong, content); fail with all that failed. Returns how many there were."""
    failed, count = [], 0
    for what, content in cases:
        count += 1
        try:
            test(content)
        except (AssertionError, Accepted) as error:
            failed.append(f"{what}: {type(error).__name__} {str(error)[:300]!a}")
    assert not failed, "\n".join([f"{len(failed)} of {count}:", *failed])
    return count


def toml_cases(text: str, seed: int, required=()):
    yield from ((what, wrong.encode()) for what, wrong in corruptions.wrong_values(text))
    yield from ((what, wrong.encode()) for what, wrong in corruptions.missing_keys(text, set(required)))
    yield from corruptions.broken_files(text.encode(), seed)
    yield from corruptions.cut(text.encode(), seed)


def test_every_key_of_a_scenario(tmp_path):
    text = (ECONOMIC / "scenario.toml").read_text().replace("../../networks", str(ROOT / "networks"))
    file, out = tmp_path / "scenario.toml", tmp_path / "out"
    required = [("", key) for key in ("name", "network", "step", "steps")] + [
        ("demand", key) for key in ("from", "to", "start", "peak", "ramp_up", "flat", "ramp_down")]

    def test(content):
        file.write_bytes(content)
        names = "" if b"xxx" in content else "scenario.toml"  # the network that it names is missing
        check("nmfd", "benchmark", tmp_path, "--controllers", "no-control", "--out", out, names=names, out=out)

    assert every(toml_cases(text, 1, required), test) > 300


@pytest.mark.parametrize("source", [HEXAGON, GRID.with_name("grid7_guided")], ids=lambda path: path.name)
def test_every_key_of_a_network(tmp_path, source):
    text = (source / "network.toml").read_text().replace("../grid7", str(GRID))
    scenario, out = tmp_path / "scenario", tmp_path / "out"
    shutil.copytree(ECONOMIC, scenario, ignore=shutil.ignore_patterns("*.pt", "*.npz", "reference"))
    toml = scenario / "scenario.toml"
    toml.write_text(toml.read_text().replace("../../networks/hexagon7", str(tmp_path)))
    required = [("", "name"), ("perimeter", "min"), ("mfd", "a"), ("regions", "adjacent"), ("regions.mfd", "jam")]

    def test(case):
        what, content = case
        (tmp_path / "network.toml").write_bytes(content)
        program, *command = ["cosim", "run", "--controller"] if what.startswith("sumo.") else [
            "nmfd", "benchmark", "--controllers"]
        names = "" if "xxx" in what else "network.toml"  # the recipe that it names is missing
        check(program, *command, "no-control", scenario, "--out", out, names=names, out=out)

    assert every(((case[0], case) for case in toml_cases(text, 2, required)), test) > 100


def test_every_key_of_a_sumo_table(tmp_path):
    text = (PEAK / "scenario.toml").read_text().replace("../../networks", str(ROOT / "networks"))
    file, out = tmp_path / "scenario.toml", tmp_path / "out"

    def test(content):
        file.write_bytes(content)
        check("cosim", "run", tmp_path, "--controller", "no-control", "--out", out, names=file.name, out=out)

    cases = [case for case in toml_cases(text, 3) if "sumo." in case[0]]
    assert every(cases, test) > 70


def test_every_key_of_a_recipe(tmp_path):
    shutil.copytree(GRID, tmp_path / "network", ignore=shutil.ignore_patterns("build"))
    file, out = tmp_path / "network" / "city.toml", tmp_path / "out"
    text = file.read_text()
    scenario = tmp_path / "scenario.toml"
    scenario.write_text((PEAK / "scenario.toml").read_text().replace("../../networks/grid7\"", "network\""))

    def test(content):
        file.write_bytes(content)
        check("cosim", "run", tmp_path, "--controller", "no-control", "--out", out, names=file.name, out=out)
        assert not (file.parent / "build").exists()

    changes = (("0 0 0 0 0 1", "0 0 0 0 9 1"), ("2 2 2 . . .", "2 2 2 . ."), ("2 2 2 . . .", "2 2 2 3 . ."),
               ("0 0 0", "0 . 0"))
    pictures = [(f"regions {old!r} -> {new!r}", text.replace(old, new, 1).encode()) for old, new in changes]
    assert every([*toml_cases(text, 4, [("centre", "x"), ("signals", "cycle")]), *pictures], test) > 80


@pytest.mark.parametrize("name", ["pi_gating", "pi-gatin", "dcp-pc", "dpc-pc-robst", "pi-gatng+max-pressure"])
def test_a_table_of_a_controller_that_is_misspelt(tmp_path, name):
    text, out = f'{tiny.SCENARIO}\n[controllers."{name}"]\nx = 1\n', tmp_path / "out"
    scenario = tiny.write(tmp_path, scenario=text)
    line = check("nmfd", "benchmark", scenario, "--controllers", "no-control", "--out", out, out=out)
    assert f"controllers.{name}: unknown controller; choose from " in line


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
    content = checkpoint(Policy(network, Architecture(width=4)), network, {}, states={
        "mean": torch.zeros(4), "precision": torch.eye(4), "limit": torch.tensor(1.0)})
    return content, saved(content)


def saved(content) -> bytes:
    out = io.BytesIO()
    torch.save(content, out)
    return out.getvalue()


def policies(content: dict, whole: bytes):
    draw = random.Random(5)
    yield "empty", b""
    yield "text", b"no policy"
    yield "pickled code", pickle.dumps(Evil())
    yield "pickled code in torch's format", saved(Evil())
    yield "pickled code among the weights", saved({**content, "weights": {"scale": Evil()}})
    for share in (0.1, 0.5, 0.9, 0.99):
        yield f"cut at {share}", whole[: int(share * len(whole))]
    for _ in range(10):
        at = draw.randrange(len(whole) // 4)
        yield f"noise from {at}", whole[:at] + draw.randbytes(len(whole) - at)
    for key in ("format", "network_hash", "network", "architecture", "weights"):
        if key != "network":
            yield f"{key} missing", saved({name: value for name, value in content.items() if name != key})
        for value in (None, 17, "x", [1], {}):
            if key != "network":
                yield f"{key} = {value}", saved({**content, key: value})
    for key, value in (("width", 10**9), ("width", -1), ("width", "4"), ("layers", 10**9), ("layers", 0),
                       ("activation", "sine"), ("guidance", True), ("depth", 3), ("sparse", [])):
        yield f"architecture {key} = {value}", saved(
            {**content, "architecture": {**content["architecture"], key: value}})
    for key in content["weights"]:
        yield f"weight {key} missing", saved(
            {**content, "weights": {k: v for k, v in content["weights"].items() if k != key}})
        yield f"weight {key} of another shape", saved(
            {**content, "weights": {**content["weights"], key: torch.zeros(3, 3, 3)}})
    for value in ([1, 2], "x", torch.zeros(3), 5.0):
        yield f"only {value}", saved(value)
    yield "a plan", npz(perimeter=np.zeros(3))


def test_policies(tmp_path, policy, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scenario, file, out = tiny.write(tmp_path), tmp_path / "p.pt", tmp_path / "out"

    def test(content):
        file.write_bytes(content)
        check("nmfd", "benchmark", scenario, "--controllers", "dpc-pc", "--policy", f"dpc-pc={file}", "--out", out,
              names=file.name, out=out)
        assert not Path("executed").exists()

    assert every(policies(*policy), test) > 50


def test_policies_for_the_guard(tmp_path, policy):
    scenario, file, out = tiny.write(tmp_path), tmp_path / "p.pt", tmp_path / "out"
    content, _ = policy

    def test(states):
        file.write_bytes(saved({**content, "states": states}))
        check("nmfd", "benchmark", scenario, "--controllers", "dpc-pc-guarded", "--policy", f"dpc-pc-guarded={file}",
              "--out", out, names=file.name, out=out)

    every([(str(states), states) for states in (None, {}, 5, [1], {"mean": 1}, {**content["states"], "limit": None})],
          test)


def test_plans(tmp_path):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    plan = scenario / "bound-pc.npz"
    cases = [("empty", b""), ("text", b"x"), ("other arrays", npz(a=np.zeros(3))), ("pickle", pickle.dumps(Evil())),
             ("objects", npz(perimeter=np.array([{}], dtype=object))), ("a zip", zipped()),
             ("torch", saved({"configuration": {}})), ("torch list", saved([1]))]

    def replay(content):
        plan.write_bytes(content)
        check("nmfd", "benchmark", scenario, "--controllers", "bound-pc", "--out", out, names=str(plan), out=out)

    every(cases, replay)


def zipped() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        file.writestr("a.txt", "x")
    return out.getvalue()


DEMANDS = {
    "no header": "0,0,1,2.0\n", "another header": "k,i,j,q\n0,0,1,1\n", "empty": "",
    "text": "interval,from,to,veh_s\na,b,c,d\n",
    "three columns": "interval,from,to,veh_s\n0,0,1\n", "five columns": "interval,from,to,veh_s\n0,0,1,1,1\n",
    "negative": "interval,from,to,veh_s\n0,0,1,-1\n", "nan": "interval,from,to,veh_s\n0,0,1,nan\n",
    "inf": "interval,from,to,veh_s\n0,0,1,inf\n", "huge": "interval,from,to,veh_s\n0,0,1,1e300\n",
    "region": "interval,from,to,veh_s\n0,0,9,1\n", "negative region": "interval,from,to,veh_s\n0,-1,1,1\n",
    "interval": "interval,from,to,veh_s\n-1,0,1,1\n", "digits": f"interval,from,to,veh_s\n{'9' * 5000},0,1,1\n",
    "fraction": "interval,from,to,veh_s\n0.5,0,1,1\n", "zeros": "\0\0\0", "quote": 'interval,from,to,veh_s\n"0,0,1,1\n'}


def test_demand_files(tmp_path):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    file = scenario / "demand.csv"
    (scenario / "scenario.toml").write_text('demand_file = "demand.csv"\n' + tiny.SCENARIO.split("[[demand]]")[0])

    def test(content):
        file.write_text(content)
        check("nmfd", "show", scenario, "--out", out, names=file.name, out=out)

    every(DEMANDS.items(), test)


def test_results_of_another_program(tmp_path):
    """A run folder whose files were damaged is not written to and not taken for finished."""
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    manifests = ["", "{", "[]", "null", "5", '{"configuration": 1, "controllers": {}, "sessions": []}', "[" * 5000,
                 '{"configuration": {}, "controllers": {}, "sessions": 1}', '{"configuration": {}, "sessions": []}']
    out.mkdir()
    for number, text in enumerate(manifests):
        (out / "manifest.json").write_text(text)
        for program, command in (("nmfd", ["benchmark", scenario, "--controllers", "no-control", "--out", out]),
                                 ("cosim", ["compare", out])):
            result = CliRunner().invoke(MAINS[program], [str(a) for a in command])
            assert result.exit_code == 2 and result.stderr.count("\n") == 1, (number, result.stderr, result.exception)
            assert "manifest.json" in result.stderr
        assert [path.name for path in out.iterdir()] == ["manifest.json"]


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """The folders of an imported network and its scenario, and a scratch folder for a copy."""
    folder = tmp_path_factory.mktemp("city")
    config = tiny_city.city(folder)
    project = tmp_path_factory.mktemp("project")
    result = CliRunner().invoke(MAINS["cosim"], [
        "import", str(config), "--regions", "3", "--out", str(project / "networks" / "tiny")])
    assert result.exit_code == 0, result.output
    return project


@pytest.fixture
def copied(city, tmp_path):
    shutil.copytree(city, tmp_path / "project")
    return tmp_path / "project"


def run_city(copied, *arguments, names):
    out = copied / "out"
    return check("cosim", "run", copied / "scenarios" / "tiny", "--controller", "no-control", "--steps", "1", "--out",
                 out, *arguments, names=names, out=out)


REGIONS = {
    "empty": "", "header": "a,b\n", "no regions": "edge,region\n", "unknown edge": "edge,region\nnowhere,0\n",
    "twice": None, "text": "edge,region\nA0A1,x\n", "negative": "edge,region\nA0A1,-1\n",
    "gap": "edge,region\nA0A1,7\n",
    "columns": "edge,region\nA0A1\n", "digits": f"edge,region\nA0A1,{'1' * 5000}\n", "zeros": "\0" * 10}


def test_regions(copied):
    file = copied / "networks" / "tiny" / "regions.csv"
    whole = file.read_text()

    def test(content):
        file.write_text(whole + whole.splitlines()[1] + "\n" if content is None else content)
        run_city(copied, names=file.name)

    every(REGIONS.items(), test)
    lines = whole.splitlines()
    file.write_text("\n".join(lines[:-1]) + "\n")
    run_city(copied, names="has no region")


def nets(whole: str):
    draw = random.Random(7)
    yield "empty", ""
    yield "no XML", "city"
    yield "another root", "<routes/>"
    yield "no edges", "<net></net>"
    yield "encoding", "<?xml version='1.0' encoding='utf-77'?><net/>"
    for attribute in ("length", "speed"):
        for value in ("0", "-5", "nan", "inf", "fast", ""):
            yield f"{attribute} = {value}", re.sub(rf'( {attribute})="[^"]+"', rf'\1="{value}"', whole, count=1)
        yield f"{attribute} missing", re.sub(rf' {attribute}="[^"]+"', "", whole, count=1)
    for attribute in ("from", "to", "fromLane", "toLane"):
        yield f"connection {attribute} missing", re.sub(
            rf'(<connection[^>]*?) {attribute}="[^"]+"', r"\1", whole, count=1)
    yield "via", re.sub(r' via="[^"]+"', ' via=":nowhere_0_0"', whole, count=1)
    yield "link index", re.sub(r' linkIndex="[^"]+"', ' linkIndex="x"', whole, count=1)
    yield "phase", re.sub(r'<phase duration="[^"]+"', '<phase duration="long"', whole, count=1)
    yield "state", re.sub(r'(<phase [^>]*) state="[^"]+"', r"\1", whole, count=1)
    yield "offset", re.sub(r'(<tlLogic [^>]*) offset="[^"]+"', r'\1 offset="late"', whole, count=1)
    yield "edge id", re.sub(r'<edge id="A0A1"', "<edge", whole, count=1)
    for _ in range(5):
        at = draw.randrange(200, len(whole) - 200)
        yield f"cut at {at}", whole[:at]


def test_networks_of_sumo(copied):
    file = copied / "networks" / "tiny" / "city.net.xml.gz"
    whole = gzip.decompress(file.read_bytes()).decode()

    def test(content):
        file.write_bytes(content if isinstance(content, bytes) else gzip.compress(content.encode()))
        run_city(copied, names=file.name)

    packed = gzip.compress(whole.encode())
    broken = [("cut gzip", packed[: len(packed) // 2]), ("no gzip", whole.encode()), ("noise", packed[:20] + bytes(99))]
    assert every([*nets(whole), *broken], test) > 30


def routes(whole: str):
    first = re.search(r'<(?:vehicle|trip)[^>]*id="([^"]+)"', whole)[1]
    yield "empty", ""
    yield "no XML", "routes"
    yield "another root", "<net/>"
    yield "cut", whole[: len(whole) // 2]
    yield "a flow", "<routes><flow id='f' begin='0' end='9' number='3' from='A0A1' to='A1A2'/></routes>"
    for value in ("-5", "nan", "inf", "triggered", "soon", ""):
        yield f"depart = {value}", re.sub(r'depart="[^"]+"', f'depart="{value}"', whole, count=1)
    yield "no depart", re.sub(r' depart="[^"]+"', "", whole, count=1)
    yield "no id", whole.replace(f' id="{first}"', "", 1)
    yield "id twice", re.sub(r' id="[^"]+"', f' id="{first}"', whole)
    yield "unknown edge", re.sub(r'(edges|from)="\w+', r'\1="nowhere', whole, count=1)
    yield "unknown end", "<routes><trip id='t' depart='700' from='A0A1' to='nowhere'/></routes>"
    yield "unknown way", "<routes><trip id='t' depart='700' from='A0A1' to='D1D2' via='nowhere'/></routes>"


def test_route_files(copied):
    file = copied / "scenarios" / "tiny" / "vehicles.rou.xml.gz"
    whole = gzip.decompress(file.read_bytes()).decode()

    def test(content):
        file.write_bytes(gzip.compress(content.encode()))
        run_city(copied, names="vehicles.rou.xml.gz" if "nowhere" not in content else "nowhere")

    every(routes(whole), test)


@pytest.mark.parametrize("name", ["background.rou.xml.gz", "city.add.xml.gz"])
def test_other_files_of_sumo(copied, name):
    file = copied / "scenarios" / "tiny" / name

    def test(content):
        file.write_bytes(content)
        run_city(copied, names=name)

    every([("empty", b""), ("no gzip", b"<routes/>"), ("no XML", gzip.compress(b"x")),
           ("cut", file.read_bytes()[:50])], test)


def test_unsorted_routes_are_sorted(copied):
    """What SUMO would refuse is no mistake here: vehicles are sorted by departure."""
    from cosim.sumo.recorded_trips import read_originals

    file = copied / "scenarios" / "tiny" / "vehicles.rou.xml.gz"
    root = gzip.decompress(file.read_bytes()).decode()
    vehicles = [ElementTree.tostring(vehicle, encoding="unicode") for vehicle in ElementTree.fromstring(root)]
    (copied / "r.rou.xml").write_text(f"<routes>{''.join(reversed(vehicles))}</routes>")
    assert (np.diff(read_originals([copied / "r.rou.xml"]).depart) >= 0).all()


LINES = {
    "nmfd": """
        benchmark {s} --controllers no-control --seeds 0|-1|1.5|nan|x|99999999999
        benchmark {s} --controllers no-control --workers 0|-1|all
        benchmark {s} --controllers ,|no-control,,|none|no-control,no-control|no-control;pi-gating|*
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
        show
        show {s} --out {s}/scenario.toml|/dev/null/x
        robustness {s} --controllers no-control --sigmas a|-1|nan|inf|1,1|,|1;2
        robustness {s} --controllers no-control --scenarios 0|x
        robustness {s} --controllers no-control --where here
        robustness {s} --controllers nobody
        bound {s} --controller dpc-pc|x
        bound {s} --controller bound-pc --from nobody|,
        bound {s} --controller bound-pc --iterations 0|x
        bound {s} --controller bound-pc --out {none}/x.npz
        ablation horizon {s} --horizons 1|a|2,2|-3|""" + "9" * 5000 + """
        ablation horizon {s} --controllers dpc-pc|pi-gating
        ablation sideways {s}
        ablation training {s} --controller dpc-pc|pi-gating
        ablation training {s} --seeds 0
        scaling --regions 1|a|2,2|2.5
        scaling --controllers pi-gating|x --out {none}
        scaling --family square --out {none}
        scaling --memory 0|nan|-1|x --out {none}
        scaling --time-limit 0|nan|x --out {none}
        export {none} --out {out}
        export {s}/scenario.toml --out {out}
        export {s}/scenario.toml
        new-controller {s}/scenario.toml|{none}/x.py|/dev/null/x.py
        new-controller
        benchmark {s} --controllers {none}.py:Mine|{s}/scenario.toml:Mine|mine.py
        benchmark {s} --controllers no-control --fault x|frozen:1|closed:a
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
        evaluate {g} --controllers no-control --reference x
        evaluate {g} --controllers no-control --workers 0|x
        evaluate {g} --controllers dpc-pc --policy x|dpc-pc={none}
        evaluate {none} --controllers no-control
        compare {none}
        compare {g} --controller x
        compare {g} --seed -1
        compare
        report {none}|{g}
        report
        report {none} --reference x
        sweep {g} --controllers x|no-control,no-control|,
        sweep {g} --controllers no-control --seeds 0|x|99999999999
        sweep {g} --controllers no-control --first-seed -1|9999999999
        sweep {g} --controllers no-control --demand 0|nan|x|1,1
        sweep {g} --controllers no-control --compliance -1|101|nan|x|1,1
        sweep {g} --controllers dpc-pc --policy x|dpc-pc={none}
        sweep {g} --controllers no-control --scheduler nowhere
        sweep {none} --controllers no-control
        video {none}|{g}
        video {g} --rate 0|x
        video {g} --demand nan|0|11
        watch {none} --controller no-control
        watch {g} --controller x
        watch {g} --controller no-control --delay nan|-1|x
        watch {g} --controller no-control --demand nan|0|11
        watch {g} --controller no-control --seed -1
        watch {g} --controller no-control --steps 0
        run {g} --controller no-control --fault x|closed:nowhere|signal:nobody|missing:7
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
        import {net} --regions 3 --out {out} --method magic
        import {net} --regions 3 --out {out} --no-run
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


@pytest.mark.parametrize("program", LINES)
def test_command_lines(tmp_path, program, city, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places = {"s": tiny.write(tmp_path / "tiny"), "g": PEAK, "none": tmp_path / "none", "out": tmp_path / "out",
              "net": city / "networks" / "tiny" / "city.net.xml.gz"}
    before = sorted(tmp_path.rglob("*"))

    def test(words):
        filled = [word.format(**places) for word in words]
        if program == "nmfd" and filled[0] in ("benchmark", "show", "robustness", "ablation") and "--out" not in filled:
            filled += ["--out", str(places["out"])]
        check(program, *filled, out=places["out"])
        assert sorted(tmp_path.rglob("*")) == before

    assert every([(" ".join(words)[:150], words) for words in lines(program)], test) > 60


@pytest.mark.parametrize("call", [
    ["nmfd", "benchmark", "{s}", "--controllers", "none"], ["nmfd", "show", "{none}"], ["cosim", "run", "{none}"],
    ["cosim", "compare", "{none}"]])
def test_the_same_in_a_process_of_its_own(tmp_path, call):
    """CliRunner is not the shell: status and stderr are those of a process."""
    places = {"s": tiny.write(tmp_path), "none": tmp_path / "none"}
    program, *arguments = call
    done = subprocess.run(
        [sys.executable, "-m", program, *(a.format(**places) for a in arguments)], capture_output=True,
        text=True, cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    assert re.fullmatch(f"{program}: error: [^\n]+\n", done.stderr), done.stderr
