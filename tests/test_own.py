"""Controllers of the user's own: the template, options, checked controls, and mistakes with file
and line."""

import re

import commands
import copies
import numpy as np
import pytest
import tiny
from commands import good, problem
from commands import nmfd as command

import nmfd
from nmfd.controllers import template
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError

GOOD = tiny.CONTROLLER


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder to work in, with a scenario."""
    tiny.write(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_template_is_copied_runs_and_counts_in_the_fingerprint(place):
    assert command("new-controller mine.py").exit_code == 0
    assert (
        "--controllers no-control,pi-gating,mine.py:MyController" in (place / "mine.py").read_text()
    )
    assert command("new-controller mine.py").exit_code == 2
    scenario, strategy = nmfd.load_scenario(place / "scenario"), parse("mine.py:MyController")
    assert nmfd.run(scenario, "mine.py:MyController")["perimeter"][:, 0, 1].max() == 0.9
    before = strategy.fingerprint(scenario)
    with (place / "mine.py").open("a") as file:
        file.write("# changed\n")
    assert strategy.fingerprint(scenario) != before


def test_the_template_holds_regions_at_their_set_points():
    scenario = nmfd.load_scenario("economic_mpc")
    controller = nmfd.controller(f"{template.__file__}:MyController", scenario)
    accumulation = np.zeros((7, 7))
    accumulation[3, 0] = 2 * scenario.network.mfds[3].critical
    perimeter = controller.act(tiny.seen(accumulation)).perimeter
    entries = scenario.network.adjacency[:, 3]
    assert (perimeter[entries, 3] == scenario.network.u_min).all()
    assert (perimeter[3, entries] == scenario.network.u_max).all()


def test_it_has_a_table_of_its_own(place):
    with (place / "scenario" / "scenario.toml").open("a") as file:
        file.write("\n[controllers.own.my-controller]\ngain = 0.0\n")
    assert command("new-controller mine.py").exit_code == 0
    controller = nmfd.controller("mine.py:MyController", place / "scenario")
    assert (
        controller.act(tiny.seen(np.full((2, 2), 900.0))).perimeter[0, 1] == 0.9
    )  # without gain nothing is held


def test_tuned_options_replace_those_of_its_table(place):
    with (place / "scenario" / "scenario.toml").open("a") as file:
        file.write("\n[controllers.own.my-controller]\ngain = 0.0\nother = 3\n")
    assert command("new-controller mine.py").exit_code == 0
    strategy = parse("mine.py:MyController")
    scenario = nmfd.load_scenario(place / "scenario")
    tuned = scenario.with_options(strategy.table(scenario), {"gain": 2.0})
    assert strategy.fingerprint(tuned)["options"] == {"gain": 2.0, "other": 3}
    full = tiny.seen(np.full((2, 2), 900.0))
    assert strategy.make(scenario).act(full).perimeter[0, 1] == 0.9  # nothing is held
    assert strategy.make(tuned).act(full).perimeter[0, 1] < 0.9


def test_files_and_modules_beside_it(place):
    (place / "helper_of_mine.py").write_text("OPENING = 0.5\n")
    (place / "weights.txt").write_text("1")
    source = "from helper_of_mine import OPENING\n" + GOOD.replace("0.5", "OPENING")
    (place / "mine.py").write_text(
        source.replace("class Mine:\n", 'class Mine:\n    files = ("weights.txt",)\n')
    )
    scenario, strategy = nmfd.load_scenario(place / "scenario"), parse("mine.py:Mine")
    assert strategy.make(scenario).act(tiny.seen(np.zeros((2, 2)))).perimeter[0, 1] == 0.5
    before = strategy.fingerprint(scenario)
    (place / "weights.txt").write_text("2")
    assert strategy.fingerprint(scenario) != before


@pytest.mark.slow
def test_sumo_takes_it(place):
    (place / "mine.py").write_text(GOOD)
    copies.peak(place)
    name = "mine.py:Mine+max-pressure"
    assert name in good(
        commands.cosim("run scenarios/peak --controller", name, "--steps 2 --out out")
    )


@pytest.mark.parametrize(
    "source, expected",
    [
        (
            None,
            "mine.py: no such file for controller mine.py:Mine; write one with: "
            "nmfd new-controller ",
        ),
        ("class Other:\n    act = None\n", "mine.py: has no class Mine; write one"),
        (
            "import numpy\n\nclass Mine(:\n",
            r"mine\.py:3: mine\.py:Mine: import: SyntaxError: invalid syntax",
        ),
        (
            "\nimport nothing_of_the_kind\n",
            r"mine\.py:2: mine\.py:Mine: import: ModuleNotFoundError: No module named",
        ),
        ("import sys\nsys.exit('bye')\n", r"mine\.py:2: mine\.py:Mine: import: SystemExit: bye"),
        (GOOD.replace("self, scenario", "self"), "__init__: TypeError"),
        (GOOD.replace("def act", "def acts"), "act: AttributeError"),
        (GOOD.replace("pass", "1 / 0"), r"mine\.py:8: mine\.py:Mine: reset: ZeroDivisionError"),
        (
            GOOD.replace("0.5,", "measurement.nothing,"),
            r"mine\.py:10: mine\.py:Mine: act: AttributeError",
        ),
        (
            GOOD.replace("self.shape, 0.5", "3, 0.5"),
            "act: interval 0: perimeter: expected numbers of shape",
        ),
        (
            GOOD.replace("splits=None", "splits=np.zeros((2, 2, 2))"),
            "splits: expected a sum of 1 over h",
        ),
        (
            GOOD.replace("splits=None", "splits=np.ones((2, 2, 2))"),
            "splits[0, 0, 0]: expected 0 to 0, got 1 instead",
        ),
        (
            GOOD.replace("splits=None", "splits=None, prices=np.array([0.0, -1.0])"),
            "prices[1]: expected 0 to 100",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_mistakes(place, source, expected):
    if source is not None:
        (place / "mine.py").write_text(source)
    text = problem(nmfd.controller, "mine.py:Mine", place / "scenario")
    assert expected in text or re.search(expected, text), text


def test_a_mistake_in_mid_run_has_its_line(place):
    failing = GOOD.replace("        return", "        assert measurement.step < 3\n        return")
    (place / "mine.py").write_text(failing)
    with pytest.raises(InputError, match=r"mine\.py:10: mine\.py:Mine: act: AssertionError"):
        nmfd.run(place / "scenario", "mine.py:Mine")


def test_rounding_errors_of_float32_are_removed(place):
    elsewhere = "np.where(np.eye(2, dtype=bool)[:, None, :], 0.0, np.ones((2, 2, 2)))"
    splits = f"{elsewhere} * (1 - np.eye(2))[:, :, None]"
    (place / "mine.py").write_text(
        GOOD.replace("0.5", "0.9000005").replace("splits=None", f"splits={splits} * 1.000001")
    )
    result = nmfd.run(place / "scenario", "mine.py:Mine", steps=1)
    assert result["perimeter"][0, 0, 1] == 0.9
    assert result["perimeter"][0, 0, 0] == 0.0
    assert result["splits"][0, 0, 1, 1] == 1.0
