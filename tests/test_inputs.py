"""Bad input: one clear line that names the file and the key, exit status 2, nothing left behind."""

import pytest
import tiny
import torch
from commands import nmfd

from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint
from nmfd.model.regional_model import load_network

TO_1 = "to = 1"
BENCHMARK = ["benchmark", "{scenario}", "--out", "{out}", "--controllers"]


def assert_one_line(result, *fragments):
    assert result.exit_code == 2
    assert result.stderr.startswith("nmfd: error: ") and result.stderr.count("\n") == 1, result.stderr
    for fragment in fragments:
        assert fragment in result.stderr
    assert result.stdout == ""


SCENARIO_ERRORS = {
    "unknown key": (
        tiny.SCENARIO.replace("steps =", "stepz = 20\nsteps ="),
        ["scenario.toml: stepz: unknown key", "steps"],
    ),
    "wrong type": (tiny.SCENARIO.replace("steps = 20", 'steps = "20"'), ["scenario.toml: steps:", "got '20' instead"]),
    "missing key": (tiny.SCENARIO.replace("step = 30.0", ""), ["scenario.toml: step: missing"]),
    "out of range": (tiny.SCENARIO.replace("peak = 2.0", "peak = -2.0"), ["scenario.toml: demand[0].peak:", "-2.0"]),
    "demand for an unknown region": (
        tiny.SCENARIO.replace(TO_1, "to = 7"),
        ["scenario.toml: demand[0].to: region 7 is unknown", "0 to 1"],
    ),
    "unknown key in a table": (
        tiny.SCENARIO.replace(TO_1, TO_1 + "\nfrm = 0"),
        ["scenario.toml: demand[0].frm: unknown key"],
    ),
    "no TOML": ("name = tiny", ["scenario.toml: is not valid TOML"]),
    "step too long": (tiny.SCENARIO.replace("step = 30.0", "step = 300.0"), ["scenario.toml: step:", "at most 238 s"]),
    "network missing": (tiny.SCENARIO.replace("../network", "../none"), ["network.toml: no such file"]),
}
NETWORK_ERRORS = {
    "own neighbour": (tiny.row_network().replace("[0]", "[0, 1]"), ["network.toml: regions[1].adjacent:", "itself"]),
    "neighbour unknown": (tiny.row_network().replace("[0]", "[5]"), ["network.toml: regions[1].adjacent:", "[5]"]),
    "no way": (
        tiny.row_network().replace("adjacent = [0]", "adjacent = []").replace("adjacent = [1]", "adjacent = []"),
        ["network.toml: regions:", "cannot be reached"],
    ),
    "unknown key": (tiny.row_network().replace("max =", "mx = 1\nmax ="), ["network.toml: perimeter.mx: unknown key"]),
    "wrong type": (tiny.row_network().replace("jam = 1000.0", "jam = true"), ["network.toml: mfd.jam:", "got True"]),
    "no MFD": (tiny.row_network().replace("c = 0.0042", "c = -1"), ["network.toml: mfd.c: c must be positive"]),
    "bounds": (tiny.row_network().replace("max = 0.9", "max = 0.1"), ["network.toml: perimeter: min must be less"]),
}


@pytest.mark.parametrize("command", ["benchmark", "train", "show"])
@pytest.mark.parametrize("case", SCENARIO_ERRORS)
def test_scenario_errors(tmp_path, case, command):
    text, fragments = SCENARIO_ERRORS[case]
    check_file_error(tiny.write(tmp_path, scenario=text), command, fragments)


@pytest.mark.parametrize("command", ["benchmark", "train", "show"])
@pytest.mark.parametrize("case", NETWORK_ERRORS)
def test_network_errors(tmp_path, case, command):
    text, fragments = NETWORK_ERRORS[case]
    check_file_error(tiny.write(tmp_path, network=text), command, fragments)


@pytest.mark.parametrize("command, controller, key", [("benchmark", "pi-gating", "kq"), ("train", "dpc-pc", "widht")])
def test_controller_option_errors(tmp_path, command, controller, key):
    text = tiny.SCENARIO + f"\n[controllers.{controller}]\n{key} = 1.0\n"
    check_file_error(
        tiny.write(tmp_path, scenario=text), command, [f"scenario.toml: controllers.{controller}.{key}: unknown key"]
    )


def check_file_error(scenario, command, fragments):
    options = {"benchmark": ["--controllers", "no-control,pi-gating"], "train": ["--controller", "dpc-pc"], "show": []}
    out = scenario.parent / "out"
    assert_one_line(nmfd(command, scenario, *options[command], "--out", out), *fragments)
    assert not out.exists()


@pytest.mark.parametrize(
    "arguments, fragment",
    [
        pytest.param(*case, id=" ".join(case[0])[:80])
        for case in (
            (["benchmark", "{tmp}/none", "--controllers", "no-control"], "none/scenario.toml: no such file"),
            (["show", "{tmp}/none"], "none/scenario.toml: no such file"),
            (
                [*BENCHMARK, "none"],
                "controller 'none' is unknown; choose from no-control, route-guidance, pi-gating, greedy",
            ),
            ([*BENCHMARK, ""], "--controllers: expected at least one controller, got none"),
            ([*BENCHMARK, "no-control,no-control"], "no-control is there twice"),
            (
                [*BENCHMARK, "no-control", "--seeds", "0"],
                "'--seeds': expected a whole number from 1 to 1000000, got '0'",
            ),
            (
                [*BENCHMARK, "no-control", "--seeds", "two"],
                "'--seeds': expected a whole number from 1 to 1000000, got 'two'",
            ),
            (
                [*BENCHMARK, "no-control", "--workers", "-1"],
                "'--workers': expected a whole number from 1 to 1000000, got '-1'",
            ),
            ([*BENCHMARK, "no-control", "--plant", "sumo"], "'--plant': expected one of nmfd, acyclic, got 'sumo'"),
            (
                [*BENCHMARK, "no-control", "--policy", "x"],
                "expected NAME=FILE, such as dpc-pc=mine.pt, got 'x' instead",
            ),
            ([*BENCHMARK, "no-control", "--policy", "dpc-pc=x"], "'dpc-pc' is not among --controllers no-control"),
            ([*BENCHMARK, "no-control", "--policy", "no-control=x"], "x: controller no-control reads no policy"),
            ([*BENCHMARK, "dpc-pc"], "dpc-pc.pt: no such policy for dpc-pc; train one with: nmfd train"),
            (["benchmark", "{scenario}"], "Missing option '--controllers'"),
            (["benchmark"], "Missing argument 'SCENARIO'"),
            (["benchmrk"], "No such command 'benchmrk'"),
            (["show", "{scenario}", "--colour"], "--colour"),
            (
                ["train", "{scenario}", "--controller", "pi-gating"],
                "'pi-gating' cannot be trained; choose one of dpc-pc",
            ),
            (
                ["train", "{scenario}", "--controller", "dpc-pc", "--out", "{tmp}/no/x.pt"],
                "no: no such folder for the policy",
            ),
            (["train", "{scenario}", "--controller", "dpc-pc", "--resume"], "dpc-pc.pt.resume: nothing to resume"),
            (
                ["train", "{scenario}", "--controller", "dpc-pc", "--steps", "0"],
                "'--steps': expected a whole number from 1 to 10000000, got '0'",
            ),
            (["show", "{scenario}", "--out", "/dev/null/x"], "/dev/null/x: Not a directory"),
            (["benchmark", "{scenario}", "--controllers", "no-control", "--out", "/dev/null/x"], "/dev/null/x"),
        )
    ],
)
def test_command_line_errors(tmp_path, arguments, fragment):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    result = nmfd(*[a.format(scenario=scenario, out=out, tmp=tmp_path) for a in arguments])
    assert_one_line(result, fragment)
    assert {path.name for path in tmp_path.iterdir()} == {"network", "scenario"}


@pytest.fixture(scope="module")
def policies(tmp_path_factory):
    """The folder of a scenario with two regions, and of policies for it, for another network, and for none."""
    folder = tmp_path_factory.mktemp("policies")
    scenario = tiny.write(folder / "two")
    other = tiny.write(folder / "three", network=tiny.row_network(3)).parent / "network"
    for name, network in (("own", scenario.parent / "network"), ("other", other)):
        network = load_network(network)
        torch.save(checkpoint(Policy(network, Architecture(width=4)), network, {}), folder / f"{name}.pt")
    (folder / "text.pt").write_text("no policy")
    torch.save({"weights": 1}, folder / "damaged.pt")
    return scenario, folder


@pytest.mark.parametrize(
    "name, file, fragment",
    [
        ("dpc-pc", "other.pt", "was trained for network 'row3'"),
        ("dpc-pc", "text.pt", "is not a policy file"),
        ("dpc-pc", "damaged.pt", "is damaged or of another version"),
        ("dpc-pc", "none.pt", "no such policy"),
        ("dpc-pcrg", "own.pt", "is a dpc-pc policy, not dpc-pcrg"),
    ],
    ids=["of another network", "text", "damaged", "missing", "of another controller"],
)
def test_policy_errors(tmp_path, policies, name, file, fragment):
    scenario, folder = policies
    result = nmfd(
        "benchmark",
        scenario,
        "--controllers",
        f"no-control,{name}",
        "--out",
        tmp_path / "out",
        "--policy",
        f"{name}={folder / file}",
    )
    assert_one_line(result, f"{folder / file}: ", fragment)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "content, fragment",
    [
        ({"notes.txt": "mine"}, "is not empty and holds no manifest.json"),
        ({"manifest.json": "{"}, "manifest.json: is no manifest of a run"),
        ({"manifest.json": "[]"}, "manifest.json: is no manifest of a run"),
    ],
    ids=["a file", "cut off", "a list"],
)
def test_a_folder_with_something_else_is_left_alone(tmp_path, content, fragment):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    out.mkdir()
    for name, text in content.items():
        (out / name).write_text(text)
    assert_one_line(nmfd("benchmark", scenario, "--controllers", "no-control", "--out", out), fragment)
    assert {path.name: path.read_text() for path in out.iterdir()} == content
