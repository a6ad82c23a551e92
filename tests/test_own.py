"""Controllers of one's own: the template, files and entry points, in both command lines, and one line per mistake."""

import re
from importlib import metadata
from pathlib import Path

import copies
import numpy as np
import pytest
import tiny
from click.testing import CliRunner
from commands import nmfd

import cosim.cli.main
from cosim.plant.strategy import parse
from nmfd.api import load_scenario
from nmfd.controllers import custom, registry
from nmfd.controllers.template import MyController
from nmfd.errors import InputError
from nmfd.runs import run_folder
from nmfd.runs.workers import Watch

ROOT = Path(__file__).parents[1]
GOOD = tiny.CONTROLLER


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder to work in, with a scenario."""
    tiny.write(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_the_template_runs_beside_the_others_and_a_changed_file_does_not_count(place):
    (place / "sub").mkdir()
    assert nmfd("new-controller", "sub/mine.py").exit_code == 0
    name, command = "sub/mine.py:MyController", ("benchmark", "scenario", "--out", "out", "--seeds", "2")
    done = nmfd(*command, "--controllers", f"no-control,{name}")
    assert done.exit_code == 0 and name in done.output, done.output
    assert f"--controllers no-control,pi-gating,{name}" in (place / "sub" / "mine.py").read_text()
    rows = run_folder.read_summary(place / "out" / "summary.csv")
    assert [(row["controller"], row["seed"]) for row in rows] == [
        ("no-control", 0),
        ("no-control", 1),
        (name, 0),
        (name, 1),
    ]
    assert nmfd(*command, "--controllers", name, "--workers", "2").exit_code == 0  # all there, under its own name
    assert nmfd("new-controller", "sub/mine.py").exit_code == 2
    with (place / "sub" / "mine.py").open("a") as file:
        file.write("# changed\n")
    again = nmfd(*command, "--controllers", name)
    assert again.exit_code == 2 and "source_hash" in again.stderr and again.stderr.count("\n") == 1


def test_the_template_holds_regions_at_their_set_points():
    scenario = load_scenario(ROOT / "scenarios" / "economic_mpc")
    controller = custom.make(f"{custom.__file__.replace('custom.py', 'template.py')}:MyController", scenario)
    accumulation = np.zeros((7, 7))
    accumulation[3, 0] = 2 * scenario.network.mfds[3].critical
    perimeter = controller.act(
        custom.Observation(step=0, time=0.0, accumulation=accumulation, backlog=np.zeros((7, 7)))
    ).perimeter
    entries = scenario.network.adjacency[:, 3]
    assert (perimeter[entries, 3] == scenario.network.u_min).all()
    assert (perimeter[3, entries] == scenario.network.u_max).all()
    assert MyController.name == "my-controller"


def test_it_has_a_table_of_its_own(place):
    with (place / "scenario" / "scenario.toml").open("a") as file:
        file.write("\n[controllers.own.my-controller]\ngain = 0.0\n")
    assert nmfd("new-controller", "mine.py").exit_code == 0
    controller = custom.make("mine.py:MyController", load_scenario(place / "scenario"))
    full = np.full((2, 2), 900.0)
    perimeter = controller.act(custom.Observation(step=0, time=0.0, accumulation=full, backlog=0 * full)).perimeter
    assert perimeter[0, 1] == 0.9  # without gain nothing is held back


@pytest.mark.slow
def test_processes_and_sumo_take_it(place):
    (place / "mine.py").write_text(GOOD)
    copies.peak(place)
    done = CliRunner().invoke(
        cosim.cli.main.main,
        ["run", "scenarios/peak", "--controller", "mine.py:Mine+max-pressure", "--steps", "2", "--out", "out"],
    )
    assert done.exit_code == 0 and "mine.py:Mine+max-pressure" in done.output, done.output
    name = run_folder.run_name("mine.py:Mine+max-pressure", 0)
    trajectory = run_folder.read_trajectory(place / "out" / f"{name}.nc")
    assert (trajectory.perimeter[trajectory.perimeter > 0] == 0.5).all()
    benchmark = nmfd("benchmark", "scenario", "--controllers", "mine.py:Mine", "--seeds", 2, "--workers", 2)
    assert benchmark.exit_code == 0, benchmark.output


@pytest.mark.parametrize(
    "name, controller, options",
    [
        ("a.py:Gate", "a.py:Gate", {}),
        ("a+b/c d.py:Gate+actuated+rerouting-30", "a+b/c d.py:Gate", {"signals": "actuated", "rerouting": 0.3}),
    ],
)
def test_in_strategies(place, name, controller, options):
    path = place / controller.split(":")[0]
    path.parent.mkdir(exist_ok=True)
    path.write_text(GOOD)
    strategy = parse(name)
    assert strategy.controller == controller and strategy.overrides == {"gateways_fixed": True, **options}
    assert "/" not in run_folder.run_name(name, 0)


@pytest.mark.parametrize(
    "source, expected",
    [
        (None, "mine.py: no such file for controller mine.py:Mine; write one with: nmfd new-controller mine.py"),
        ("class Other:\n    act = None\n", "mine.py: has no class Mine; choose from Other"),
        ("x = 1\n", "mine.py: has no class Mine; it has none with a method act: write one"),
        ("Mine = 3\n", "mine.py:Mine: expected a class, got 3 instead"),
        ("import numpy\n\nclass Mine(:\n", r"mine\.py:3: mine\.py:Mine: import: SyntaxError: invalid syntax"),
        ("\nimport nothing_of_the_kind\n", r"mine\.py:2: mine\.py:Mine: import: ModuleNotFoundError: No module named"),
        ("import sys\nsys.exit('bye')\n", r"mine\.py:2: mine\.py:Mine: import: SystemExit: bye"),
        (GOOD.replace("self, scenario", "self"), "made with one argument, the planning model, but too many positional"),
        (GOOD.replace("def act", "def acts"), "mine.py:Mine: has no method act"),
        (GOOD.replace("def reset", "def rest"), "mine.py:Mine: has no method reset"),
        (GOOD.replace("pass", "1 / 0"), r"mine\.py:8: mine\.py:Mine: reset: ZeroDivisionError"),
        (GOOD.replace("0.5,", "measurement.nothing,"), r"mine\.py:10: mine\.py:Mine: act: AttributeError"),
        (GOOD.replace("self.shape, 0.5", "3, 0.5"), r"mine\.py:10: mine\.py:Mine: act|act: perimeter: expected finite"),
        (
            GOOD.replace("0.5", "np.nan"),
            "act: perimeter: expected finite numbers of shape (2, 2), got numbers that are",
        ),
        (GOOD.replace("0.5", "1.5"), "act: perimeter[0, 1]: expected a number in [0.1, 0.9], got 1.5 instead"),
        (
            GOOD.replace("splits=None", "splits=np.zeros((2, 2))"),
            "act: splits: expected finite numbers of shape (2, 2, 2)",
        ),
        (
            GOOD.replace("splits=None", "splits=np.zeros((2, 2, 2))"),
            "splits[0, :, 1]: expected shares with sum 1, got 0",
        ),
        (
            GOOD.replace("splits=None", "splits=np.ones((2, 2, 2))"),
            "splits[0, 0, 0]: expected 0 (no way), got 1 instead",
        ),
        (
            GOOD.replace("splits=None", "splits=None, prices=np.array([0.0, -1.0])"),
            "prices[1]: expected a number from 0",
        ),
        (GOOD.replace("splits=None", "splits=None, prices=1.0"), "act: prices: expected finite numbers of shape (2,)"),
        (GOOD.replace("return Controls(", "return dict("), "act: expected nmfd.Controls, got dict instead"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_mistakes(place, source, expected):
    if source is not None:
        (place / "mine.py").write_text(source)
    done = nmfd("benchmark", "scenario", "--controllers", "no-control,mine.py:Mine", "--out", "out")
    assert done.exit_code == 2 and done.stderr.count("\n") == 1 and not (place / "out").exists(), done.output
    assert expected in done.stderr or re.search(expected, done.stderr), done.stderr


def test_a_mistake_in_mid_run_is_a_failed_run_with_its_line(place):
    failing = GOOD.replace("        return", "        assert measurement.step < 3\n        return")
    (place / "mine.py").write_text(failing)
    done = nmfd("benchmark", "scenario", "--controllers", "no-control,mine.py:Mine", "--out", "out")
    assert done.exit_code == 2 and "mine.py:10: mine.py:Mine: act: AssertionError" in done.stderr
    assert [row["controller"] for row in run_folder.read_summary(place / "out" / "summary.csv")] == ["no-control"]


@pytest.mark.parametrize(
    "name, expected",
    [("mine.py", "controller 'mine.py' is unknown"), ("mine.py:", "is unknown"), ("mine.py:1a", "or file.py:Class")],
)
def test_names_that_mean_nothing(place, name, expected):
    for parsed in (registry.check, parse):
        with pytest.raises(InputError, match=expected):
            parsed(name)


def test_entry_points(place, monkeypatch):
    point = metadata.EntryPoint("the-template", "nmfd.controllers.template:MyController", custom.GROUP)
    monkeypatch.setattr(custom, "entry_points", lambda: {"the-template": point})
    monkeypatch.setattr("nmfd.runs.workers._here", Watch())  # it is not installed: other processes do not know it
    monkeypatch.setattr(registry, "runs_apart", lambda name: False)
    done = nmfd("benchmark", "scenario", "--controllers", "no-control,the-template", "--out", "out")
    assert done.exit_code == 0 and "the-template" in done.output
    assert parse("the-template+actuated").controller == "the-template"
    assert "the-template" in nmfd("benchmark", "scenario", "--controllers", "nobody").stderr
    policy = nmfd("benchmark", "scenario", "--controllers", "the-template", "--policy", "the-template=x.pt")
    assert policy.exit_code == 2 and "reads no policy" in policy.stderr
