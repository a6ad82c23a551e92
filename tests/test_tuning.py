"""cosim tune: what is searched, what is kept, what is told; SUMO is not started."""

import math
from functools import cache
from pathlib import Path

import copies
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from trajectories import in_city

from cosim.cli import main
from cosim.evaluation import experiment, statistics, tuning
from nmfd.errors import InputError
from nmfd.runs import config
from nmfd.runs.workers import Failure

ROOT = Path(__file__).parents[1]
TRIPS = 100


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return copies.peak(tmp_path_factory.mktemp("city"))


@pytest.fixture(autouse=True)
def read_once(monkeypatch):
    """The city, which is the same for every run folder."""
    monkeypatch.setattr(experiment, "load_city", cache(experiment.load_city))
    monkeypatch.setattr(experiment, "read_signals", lambda city, *_: ([], []))
    monkeypatch.setattr(experiment, "check_strategy", lambda *_: None)


@pytest.fixture
def runs(monkeypatch):
    """The tasks that are run; their total time spent is lowest at set point 300 and kp 2."""
    tasks, failing = [], set()

    def outcomes(function, todo, workers, *, fresh, group=None, look=None):
        for task in todo:
            tasks.append(task)
            options = dict(task.options)
            away = (options["set_point"][0] - 300.0) ** 2 / 1e4 + math.log(options["kp"] / 2.0) ** 2
            yield (
                task,
                Failure("SUMO fell over")
                if len(tasks) in failing
                else in_city(task, 1e6 * task.demand_factor * (1.0 + task.seed / 1e4) * (1.0 + away), TRIPS, TRIPS),
            )

    monkeypatch.setattr(experiment, "outcomes", outcomes)
    return tasks, failing


def order(city, out, *, candidates=37, levels=(1.6,), **others):
    return tuning.Tuning(
        scenario=city,
        controller="pi-gating+guided+max-pressure",
        candidates=candidates,
        seeds=(1000,),
        out=out,
        knobs=(tuning.knob("set_point[0]=200:600"), tuning.knob("kp=0.1:10")),
        levels=levels,
        population=6,
        **others,
    )


def test_the_best_options_are_found_and_written(city, tmp_path, runs):
    tasks, _ = runs
    table = tuning.tune(order(city, tmp_path / "out"))
    assert len(table) == 37 and len(tasks) == 37
    assert {(task.seed, task.demand_factor) for task in tasks} == {(1000, 1.6)}
    first, best = table.iloc[0], tuning.best(table)
    assert first["kp"] == pytest.approx(1.0) and first["set_point[0]"] == 400.0  # the scenario's, the middle
    assert best["set_point[0]"] == pytest.approx(300.0, abs=20.0) and best["kp"] == pytest.approx(2.0, rel=0.2)
    floor = 1e6 * 1.1 * 1.6
    assert floor <= best["score_veh_s"] < 1.05 * floor < first["score_veh_s"]
    assert table["set_point[0]"].between(200.0, 600.0).all() and table["kp"].between(0.1, 10.0).all()
    written = config.read(tmp_path / "out" / "tune.toml")["controllers"]["pi-gating+guided+max-pressure"]
    assert written == {"set_point": [best["set_point[0]"]], "kp": best["kp"]}


def test_numbers_of_a_list_without_a_range_stay_as_they_are(city, tmp_path):
    tuned = tuning.Tuning(
        scenario=city,
        controller="dpc-pcrg+max-pressure+guidance-period-60",
        candidates=1,
        seeds=(1000,),
        out=tmp_path,
        knobs=(tuning.knob("numbers[3]=2:12"), tuning.knob("numbers[6]=1:2")),
    )
    assert dict(tuned.options((0.5, 0.0)))["numbers"] == (9.0, 1.0, 0.0, 7.0, 0.6, 0.5, 1.0, 1.2)


@pytest.mark.slow
def test_an_interrupted_search_goes_on_as_if_it_had_not_been(city, tmp_path, runs):
    tasks, _ = runs
    whole = tuning.tune(order(city, tmp_path / "whole", candidates=13))
    np.random.seed(5)  # what others draw makes no difference
    tuning.tune(order(city, tmp_path / "parts", candidates=8))
    done = len(tasks)
    np.random.seed(7)
    parts = tuning.tune(order(city, tmp_path / "parts", candidates=13))
    pd.testing.assert_frame_equal(whole, parts)
    assert len(tasks) - done == 5
    with pytest.raises(InputError, match="another configuration"):
        tuning.tune(order(city, tmp_path / "parts", search_seed=1))
    other = tuning.tune(order(city, tmp_path / "other", candidates=7, search_seed=1))
    assert not np.allclose(other["kp"][1:], whole["kp"][1:7])


def test_a_candidate_whose_run_failed_has_no_score(city, tmp_path, runs):
    _, failing = runs
    failing.update({3, 6})  # one run of candidate 1, one of 2
    table = tuning.tune(order(city, tmp_path / "out", candidates=7, levels=(1.0, 1.6)))
    assert list(np.flatnonzero(table["score_veh_s"].isna())) == [1, 2]
    assert tuning.best(table)["candidate"] not in (1, 2)


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (["--option", "kp"], "expected KEY=LOW:HIGH"),
        (["--option", "kp=2:1"], "LOW below HIGH"),
        (["--option", "kp=1:nan"], "LOW below HIGH"),
        (["--option", "kp[x]=1:2"], "expected KEY=LOW:HIGH"),
        (["--option", "kP=1:2"], "controllers.pi-gating.kP: unknown key; allowed here: regions, set_point"),
        (["--option", "kp=1:2", "--option", "kp=1:3"], "kp is there twice"),
        (["--option", "set_point[1]=1:2"], "set_point[0], set_point[1]"),
        (["--option", "kp=-1:2"], "kp: should be greater"),
    ],
)
def test_one_line_for_what_cannot_be_tuned(city, tmp_path, arguments, expected):
    done = CliRunner().invoke(
        main, ["tune", str(city), "--controller", "pi-gating", *arguments, "--out", str(tmp_path / "out")]
    )
    assert done.exit_code != 0 and expected in done.stderr, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and not (tmp_path / "out").exists()


def test_options_that_train_a_policy_train_one_for_every_candidate(city, tmp_path, monkeypatch):
    seen = []

    def outcomes(function, todo, workers, *, fresh, group=None, look=None):
        for task in todo:
            seen.append(task.policy)
            yield task, in_city(task, 1e6 * dict(task.options)["mfd_scale"], TRIPS, TRIPS)

    monkeypatch.setattr(experiment, "outcomes", outcomes)
    monkeypatch.setattr(
        tuning, "outcomes", lambda function, todo, workers, look: [(task, function(task)) for task in todo]
    )
    asked = tuning.Tuning(
        scenario=city,
        controller="dpc-pcrg",
        candidates=2,
        seeds=(1000,),
        out=tmp_path / "out",
        population=2,
        knobs=(tuning.knob("mfd_scale=0.6:1"), tuning.knob("steps=1:1.4")),
    )
    table = tuning.tune(asked)
    assert list(table["steps"]) == [1.0, 1.0]  # a whole number
    assert len(set(seen)) == 2 and all(path.is_file() for path in seen)
    assert seen[0].read_bytes() != seen[1].read_bytes()


def test_the_interval_of_a_share_is_never_empty():
    rows = pd.DataFrame(
        {"demand": 1.0, "controller": "a", "completed_veh": [9, 9], "trips": [9, 9], statistics.TTS: [1.0, 3.0]}
    )
    (row,) = statistics.shares(rows).to_dict("records")
    assert row["served_share_low"] == pytest.approx(1.0 / (1.0 + 1.96**2 / 2), rel=1e-3)  # Wilson, both of two
    assert row["served_share_high"] == pytest.approx(1.0)
