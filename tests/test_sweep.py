"""cosim sweep: one tidy table, failures as rows, resumption."""

import re
from pathlib import Path

import copies
import numpy as np
import pandas as pd
import pytest
import trajectories
from click.testing import CliRunner
from commands import killed

from cosim.cli.main import main
from cosim.evaluation import experiment, sweeps
from cosim.evaluation.simulate import FACTS, Result
from nmfd.errors import InputError
from nmfd.runs.run_folder import read_summary
from nmfd.runs.workers import Failure

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def peak(tmp_path_factory):
    folder = copies.peak(tmp_path_factory.mktemp("city"))
    file = folder / "scenario.toml"
    file.write_text(re.sub(r"ramp_up = [\d.]+", "ramp_up = 90.0", file.read_text()))
    return folder


def sweep(*arguments):
    return CliRunner().invoke(main, ["sweep", *(str(argument) for argument in arguments)])


@pytest.fixture
def ran(monkeypatch):
    """SUMO is not started: the tasks that would be run, and which of them fail."""
    tasks, failing = [], set()

    def outcomes(function, todo, workers, *, fresh, group=None, look=None):
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
        completed=np.arange(3.0),
        perimeter=np.zeros((2, 7, 7)),
        splits=np.zeros((2, 7, 7, 7)),
        decision_time=np.ones(2),
        wall_time=1.0,
    )
    facts = {**dict.fromkeys(FACTS, 1.0), "outside_training": "", "controller": task.controller, "seed": task.seed}
    return Result(trajectory=trajectory, record=trajectories.record(2, regions=7), facts=facts)


def test_a_failed_run_is_a_row_and_is_tried_again(peak, tmp_path, ran):
    tasks, failing = ran
    failing.add(("probing-pcrg+compliance-50", 1))
    arguments = (
        peak,
        "--controllers",
        "route-guidance,probing-pcrg",
        "--seeds",
        2,
        "--demand",
        "0.8,1.0",
        "--compliance",
        "50,100",
        "--out",
        tmp_path / "out",
    )
    done = sweep(*arguments)
    assert done.exit_code == 0 and "2 of 16 runs failed" in done.stderr, done.output + str(done.exception)
    rows = pd.read_parquet(tmp_path / "out" / "sweep.parquet")
    assert list(rows.columns[:7]) == ["strategy", "controller", "seed", "demand", "compliance", "status", "reason"]
    assert len(rows) == 16 and not rows.duplicated(["controller", "seed", "demand", "compliance"]).any()
    bad = rows[rows["status"] == "failed"]
    assert set(bad["reason"]) == {"SUMO fell over"} and set(bad["demand"]) == {0.8, 1.0}
    assert (bad[["controller", "seed", "compliance"]] == ["probing-pcrg", 1, 0.5]).all(axis=None)
    assert bad["total_time_spent_veh_s"].isna().all()
    good = rows[rows["status"] == "ok"]
    assert (good["total_time_spent_veh_s"] == 2 * 90.0 * 49).all() and (good["co2_kg"] == 1.0).all()
    tasks.clear(), failing.clear()
    assert sweep(*arguments).exit_code == 0
    assert sorted(tasks) == [("probing-pcrg+compliance-50", 1, 0.8), ("probing-pcrg+compliance-50", 1, 1.0)]
    assert (pd.read_parquet(tmp_path / "out" / "sweep.parquet")["status"] == "ok").all()


def test_more_is_added_and_an_interruption_keeps_what_is_there(peak, tmp_path, ran, monkeypatch):
    tasks, failing = ran
    failing.add(("no-control", 0))
    out = tmp_path / "out"
    done = sweep(peak, "--controllers", "no-control", "--out", out)
    assert done.exit_code == 1 and "seed 0: SUMO fell over" in done.stderr  # all there was
    plain = experiment.outcomes

    def interrupted(*arguments, **options):
        yield from list(plain(*arguments, **options))[:1]
        raise KeyboardInterrupt

    monkeypatch.setattr(experiment, "outcomes", interrupted)
    done = sweep(peak, "--controllers", "pi-gating,max-pressure", "--out", out)
    assert done.exit_code == 130 and "the same command with --out" in done.stderr
    rows = pd.read_parquet(out / "sweep.parquet")
    assert rows[["controller", "status"]].values.tolist() == [["no-control", "failed"], ["pi-gating", "ok"]]
    assert rows["compliance"].tolist() == [1.0, 1.0]  # the scenario's


def test_who_guides_nobody_is_run_once(peak, tmp_path, ran):
    """Whatever share of the drivers would follow; of a controller of the user's own nobody knows."""
    own = tmp_path / "mine.py"
    own.write_text("class Mine:\n    def __init__(self, scenario):\n        pass\n")
    names = ["no-control", "rerouting-30+webster", "pi-gating+max-pressure", "dpc-pc", "route-guidance", f"{own}:Mine"]
    order = sweeps.Sweep(scenario=peak, controllers=tuple(names), seeds=[0], out=tmp_path, compliance=(0.0, 0.5))
    assert list(order.strategies()) == [
        *names[:4],
        "route-guidance+compliance-0",
        "route-guidance+compliance-50",
        f"{own}:Mine+compliance-0",
        f"{own}:Mine+compliance-50",
    ]
    assert len(order.plan()) == 8
    tasks, _ = ran
    done = sweep(peak, "--controllers", "no-control", "--compliance", "0,50", "--out", tmp_path / "out")
    assert done.exit_code == 0 and tasks == [("no-control", 0, 1.0)]
    assert pd.read_parquet(tmp_path / "out" / "sweep.parquet")["compliance"].tolist() == [1.0]  # the scenario's


@pytest.mark.parametrize("write, behind", [(4, False), (6, True)])
def test_killed_it_goes_on(peak, tmp_path, ran, write, behind):
    """kill -9 beside a write: table and run folder stay readable, and only what was not finished is run again."""
    tasks, _ = ran
    out = tmp_path / "out"
    arguments = ("sweep", peak, "--controllers", "no-control", "--seeds", 3, "--out", out)
    assert killed("cosim", *arguments, write=write, behind=behind)
    if (out / "sweep.parquet").exists():
        assert (pd.read_parquet(out / "sweep.parquet")["status"] == "ok").all()
    summary = out / "demand-1" / "summary.csv"
    finished = [row["seed"] for row in read_summary(summary)] if summary.exists() else []
    assert sweep(*arguments[1:]).exit_code == 0
    assert [seed for _, seed, _ in tasks] == [seed for seed in range(3) if seed not in finished]
    assert pd.read_parquet(out / "sweep.parquet")["seed"].tolist() == [0, 1, 2]
    assert not [path for path in out.rglob(".*")]


@pytest.mark.slow
def test_one_run_for_real(peak, tmp_path):
    done = sweep(peak, "--controllers", "actuated", "--steps", 2, "--workers", 1, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output + str(done.exception)
    row = pd.read_parquet(tmp_path / "out" / "sweep.parquet").iloc[0]
    assert row["status"] == "ok" and row["departed_veh"] - row["completed_veh"] == row["final_accumulation_veh"] > 0


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (("--controllers", "nobody"), "'nobody' is unknown"),
        (("--controllers", "no-control", "--compliance", "0.5"), "'--compliance': expected a list of distinct whole"),
        (("--controllers", "no-control", "--compliance", "5,05"), "'--compliance': expected a list of distinct"),
        (("--controllers", "dpc-pcrg+compliance-50", "--compliance", "0"), "exclude each other"),
        (("--controllers", "no-control", "--workers", "2", "--scheduler", "tcp://x:1"), "omit one"),
    ],
)
def test_mistakes(peak, tmp_path, arguments, expected):
    done = sweep(peak, *arguments, "--out", tmp_path / "out")
    assert done.exit_code == 2 and expected in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"", b"\0\xff" * 50, None])
def test_a_damaged_table_is_one_line(peak, tmp_path, content):
    file = tmp_path / "sweep.parquet"
    pd.DataFrame({"a": [1]}).to_parquet(file) if content is None else file.write_bytes(content)
    done = sweep(peak, "--controllers", "no-control", "--out", tmp_path)
    assert done.exit_code == 2 and done.stderr.count("\n") == 1, done.stderr + repr(done.exception)
    assert f"{file}: is no table of a sweep" in done.stderr and [p.name for p in tmp_path.iterdir()] == [file.name]


def test_compliance_needs_whole_percentages_from_python_too(peak, tmp_path):
    with pytest.raises(InputError, match="compliance-57.5"):
        sweeps.Sweep(scenario=peak, controllers=("dpc-pcrg",), seeds=[0], out=tmp_path, compliance=(0.575,)).plan()
