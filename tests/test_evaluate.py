"""cosim evaluate: order, what is kept and what is run again, failures, and one small evaluation in SUMO."""

import re
from pathlib import Path

import copies
import numpy as np
import pandas as pd
import pytest
import trajectories
from commands import cosim

from cosim.evaluation import evaluate, experiment
from cosim.evaluation.simulate import FACTS, Result
from cosim.report import figures
from nmfd.api import load_scenario
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.runs.workers import Failure

ROOT = Path(__file__).parents[1]


def change(file: Path, pattern: str, new: str) -> None:
    """Replace the first match in a file, which must have one."""
    text, count = re.subn(pattern, new, file.read_text(encoding="utf-8"), count=1)
    assert count == 1
    file.write_text(text, encoding="utf-8")


@pytest.fixture
def city(tmp_path):
    """A copy of grid7 and its scenario, which a test may change; the folder of the scenario."""
    return copies.peak(tmp_path)


@pytest.fixture
def ran(monkeypatch):
    """SUMO is not started: the tasks that would be run, and which of them fail."""
    tasks, failing = [], set()

    def outcomes(function, todo, workers, *, fresh, group=None, look=None):
        assert fresh
        for task in todo:
            tasks.append((task.controller, task.seed, task.demand_factor))
            yield task, Failure("SUMO fell over") if (task.controller, task.seed) in failing else made_up(task)

    monkeypatch.setattr(experiment, "outcomes", outcomes)
    return tasks, failing


def made_up(task) -> Result:
    trajectory = trajectories.made(
        controller=task.controller,
        plant="sumo",
        seed=task.seed,
        step=90.0,
        accumulation=np.ones((3, 7, 7)),
        backlog=np.zeros((3, 7, 7)),
        completed=np.zeros(3),
        perimeter=np.ones((2, 7, 7)),
        splits=np.zeros((2, 7, 7, 7)),
        decision_time=np.zeros(2),
        wall_time=1.0,
    )
    facts = {name: 0 for name in FACTS} | {"outside_training": "", "controller": task.controller, "seed": task.seed}
    return trajectories.recorded(trajectory, trajectories.record(2, regions=7), facts)


def evaluation(city, tmp_path, *, controllers=("no-control", "pi-gating"), seeds=(2000, 2001), **others):
    return evaluate.Evaluation(
        scenario=city, controllers=controllers, seeds=seeds, out=tmp_path / "out", steps=2, **others
    )


def test_runs_come_seed_by_seed_and_are_kept(city, tmp_path, ran):
    tasks, _ = ran
    table, failures = evaluate.evaluate(evaluation(city, tmp_path, levels=(0.8, 1.0)))
    assert not failures and list(table["seeds"]) == [2, 2, 2, 2]
    assert tasks[:4] == [
        ("no-control", 2000, 0.8),
        ("pi-gating", 2000, 0.8),
        ("no-control", 2000, 1.0),
        ("pi-gating", 2000, 1.0),
    ]
    assert [seed for _, seed, _ in tasks] == [2000] * 4 + [2001] * 4
    tasks.clear()
    wider = evaluation(city, tmp_path, seeds=(2000, 2001, 2002), controllers=("mpc-pc", "no-control", "pi-gating"))
    table, _ = evaluate.evaluate(wider)
    assert tasks == [("mpc-pc", 2000, 1.0), ("mpc-pc", 2001, 1.0)] + [
        (name, 2002, 1.0) for name in ("mpc-pc", "no-control", "pi-gating")
    ]
    assert list(table["controller"]) == ["no-control", "pi-gating", "mpc-pc", "no-control", "pi-gating"]


def test_a_failed_run_is_named_and_tried_again(city, tmp_path, ran):
    tasks, failing = ran
    failing.add(("pi-gating", 2000))
    table, failures = evaluate.evaluate(evaluation(city, tmp_path))
    assert failures == ["controller pi-gating, seed 2000: SUMO fell over"]
    assert dict(zip(table["controller"], table["seeds"], strict=True)) == {"no-control": 2, "pi-gating": 1}
    tasks.clear()
    failing.clear()
    assert evaluate.evaluate(evaluation(city, tmp_path))[1] == []
    assert tasks == [("pi-gating", 2000, 1.0)]


def test_nothing_is_left_where_every_run_failed(city, tmp_path, ran):
    ran[1].update({("no-control", 2000), ("pi-gating", 2000)})
    table, failures = evaluate.evaluate(evaluation(city, tmp_path, seeds=(2000,)))
    assert len(failures) == 2 and table.empty and not (tmp_path / "out").exists()


def test_another_option_of_one_controller_costs_its_own_runs_only(city, tmp_path, ran):
    tasks, _ = ran
    evaluate.evaluate(evaluation(city, tmp_path))
    tasks.clear()
    change(city / "scenario.toml", r"outflow_share = [\d.]+", "outflow_share = 0.9")
    said = []
    evaluate.evaluate(evaluation(city, tmp_path), tell=said.append)
    assert {name for name, _, _ in tasks} == {"pi-gating"} and len(tasks) == 2
    assert len(said) == 1 and "pi-gating has changed (options): its 2 kept runs do not" in said[0]


def test_another_model_leaves_runs_without_control_alone(city, tmp_path, ran):
    tasks, _ = ran
    evaluate.evaluate(evaluation(city, tmp_path))
    tasks.clear()
    change(city.parent.parent / "networks" / "grid7" / "network.toml", r"\nmin = 0.1\n", "\nmin = 0.12\n")
    said = []
    evaluate.evaluate(evaluation(city, tmp_path), tell=said.append)
    assert {name for name, _, _ in tasks} == {"pi-gating"} and "model" in said[0]


@pytest.mark.parametrize(
    "old, new, key",
    [(r"peak = [\d.]+", "peak = 0.77", "demand_hash"), (r"compliance = [\d.]+", "compliance = 0.5", "sumo")],
)
def test_another_city_needs_another_folder(city, tmp_path, ran, old, new, key):
    evaluate.evaluate(evaluation(city, tmp_path))
    change(city / "scenario.toml", old, new)
    with pytest.raises(InputError, match=f"holds runs of another configuration .{key}: .*choose another folder"):
        evaluate.evaluate(evaluation(city, tmp_path), tell=print)


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (("--controllers", "no-control,nobody"), "controller 'nobody' is unknown"),
        (("--controllers", "no-control,no-control"), "--controllers: no-control is there twice"),
        (
            ("--controllers", "no-control", "--demand", "1,x"),
            "'--demand': expected a list of distinct numbers above 0 up to 10",
        ),
        (("--controllers", "no-control", "--demand", "1,1.0"), "'--demand': expected a list of distinct numbers"),
        (("--controllers", "no-control", "--policy", "dpc-pc=x.pt"), "--policy: 'dpc-pc' is not among --controllers"),
    ],
)
def test_command_line_errors(tmp_path, arguments, expected):
    result = cosim("evaluate", ROOT / "scenarios" / "grid7_peak", *(a.format(tmp=tmp_path) for a in arguments))
    assert result.exit_code == 2 and expected in result.stderr and result.stderr.count("\n") == 1


@pytest.mark.slow
def test_a_small_evaluation_in_sumo(city, tmp_path):
    file = city / "scenario.toml"
    file.write_text(re.sub(r"ramp_up = [\d.]+", "ramp_up = 60.0", file.read_text()))
    change(file, r"outflow_share = [\d.]+", "set_point = [20.0]")
    out = tmp_path / "out"
    arguments = (
        "evaluate",
        city,
        "--controllers",
        "no-control,pi-gating",
        "--seeds",
        "1",
        "--steps",
        "3",
        "--workers",
        "1",
        "--out",
        out,
    )
    result = cosim(*arguments)
    assert result.exit_code == 0, result.output + str(result.exception)
    rows = pd.read_csv(out / "runs.csv")
    assert list(rows["seed"]) == [2000, 2000] and (rows["co2_kg"] > 0).all()
    assert set(rows["controller"]) == {"no-control", "pi-gating"} and "teleports" in result.stdout
    level = out / "demand-1"
    for picture in ("total_accumulation", "region_accumulation", "perimeter"):
        assert (level / f"{picture}.png").stat().st_size > 10_000
    assert max(path.stat().st_size for path in level.glob("*.nc")) < 1_000_000
    before = {path: path.read_bytes() for path in level.glob("*.nc")}
    assert cosim(*arguments).exit_code == 0
    assert before == {path: path.read_bytes() for path in level.glob("*.nc")}


def test_titles_name_the_most_teleports():
    rows = pd.DataFrame([{"controller": f"c{n}", "teleports": 0} for n in (1, 2)])
    assert figures.teleports(rows) == "no teleport in any run"
    rows = pd.DataFrame(
        [{"controller": name, "teleports": count} for name, count in (("a", 1), ("b", 9), ("c", 4), ("d", 0), ("b", 2))]
    )
    assert figures.teleports(rows) == "teleports: b 11, c 4, others fewer"
    assert figures.teleports(rows[rows["controller"] != "a"]) == "teleports: b 11, c 4"


@pytest.mark.parametrize(
    "name, level, said",
    [
        ("dpc-pc", 1.3, ""),
        ("dpc-pc", 1.31, "1.31 is outside of what the policy was trained on, 0.8 to 1.3 times"),
        ("dpc-pc+rerouting-30", 1.6, ""),
        ("dpc-pcrg+max-pressure", 0.7, "0.7 is outside"),
        ("pi-gating", 9.0, ""),
    ],
)
def test_a_run_outside_of_what_its_policy_was_trained_on_says_so(name, level, said):
    found = parse(name).outside_training(load_scenario(ROOT / "scenarios" / "grid7_peak"), level)
    assert said in found and bool(said) == bool(found)


def test_remarks_name_every_controller_once():
    rows = pd.DataFrame({"controller": ["a", "a", "b", "c"], "outside_training": ["far", "far", np.nan, ""]})
    assert experiment.remarks(rows) == ["a: far"]
    assert experiment.remarks(rows.drop(columns="outside_training")) == []
