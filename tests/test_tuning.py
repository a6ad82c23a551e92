"""cosim tune: what is searched, what is kept and resumed; SUMO is not started."""

import math

import copies
import made_up
import numpy as np
import pandas as pd
import pytest
import trajectories
from commands import cosim, error_line, good

from cosim.evaluation import tuning
from cosim.plant.strategy import parse
from nmfd.api import load_scenario
from nmfd.errors import InputError, RunFailed
from nmfd.runs import config


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return load_scenario(copies.peak(tmp_path_factory.mktemp("city")))


@pytest.fixture
def runs(monkeypatch):
    """The runs instead of SUMO's; their total time spent is lowest at set point 300 and kp 2."""
    done, failing = [], set()

    def made(scenario, strategy, *, seed, demand):
        done.append((seed, demand))
        options = scenario.controller_options[strategy.table(scenario)]
        away = (options["set_point"][0] - 300.0) ** 2 / 1e4 + math.log(options["kp"] / 2.0) ** 2
        tts = 1e6 * demand * (1.0 + seed / 1e4) * (1.0 + away)
        if len(done) in failing:
            return "SUMO fell over"
        return trajectories.in_city(scenario, strategy, seed, demand, tts=tts)

    made_up.instead_of_sumo(monkeypatch, made)
    return done, failing


def order(city, out, *, trials=37, levels=(1.6,), **others):
    return tuning.Tuning(
        scenario=city,
        strategy=parse("pi-gating+guided+max-pressure"),
        options={"set_point[0]": (200.0, 600.0), "kp": (0.1, 10.0)},
        trials=trials,
        seeds=(1000,),
        levels=levels,
        out=out,
        **others,
    )


def tune(chosen):
    return tuning.tune(chosen, progress=False)


@pytest.mark.slow
def test_the_best_options_are_found_and_written(city, out, runs):
    done, _ = runs
    table = tune(order(city, out))
    assert len(table) == 37
    assert done == [(1000, 1.6)] * 37
    first, best = table.iloc[0], table.loc[table[tuning.SCORE].idxmin()]
    assert first["kp"] == pytest.approx(1.0)
    assert first["set_point[0]"] == 400.0
    floor = 1e6 * 1.1 * 1.6
    assert floor <= best["score_veh_s"] < 1.1 * floor < first["score_veh_s"]
    assert table["set_point[0]"].between(200.0, 600.0).all()
    assert table["kp"].between(0.1, 10.0).all()
    written = config.read(out / "tune.toml")["controllers"]["pi-gating+guided+max-pressure"]
    assert written["kp"] == pytest.approx(best["kp"], rel=1e-5)
    assert written["set_point"] == [pytest.approx(best["set_point[0]"], rel=1e-5)]


def test_numbers_of_a_list_without_a_range_stay_as_they_are(city, tmp_path):
    tuned = tuning.Tuning(
        scenario=city,
        strategy=parse("pricing-rule+max-pressure+guidance-period-60"),
        options={"numbers[3]": (2.0, 12.0), "numbers[6]": (1.0, 2.0)},
        out=tmp_path,
    )
    table = tuned.tuned({"numbers[3]": 7.0, "numbers[6]": 1.0}).controller_options[
        tuned.strategy.table(city)
    ]
    assert tuple(table["numbers"]) == (9.0, 1.0, 0.0, 7.0, 0.6, 0.5, 1.0, 1.2)


@pytest.mark.slow
def test_more_trials_continue_a_search(city, tmp_path, runs):
    done, _ = runs
    whole = tune(order(city, tmp_path / "whole", trials=13))
    tune(order(city, tmp_path / "parts", trials=7))
    before = len(done)
    parts = tune(order(city, tmp_path / "parts", trials=13))
    pd.testing.assert_frame_equal(whole, parts)
    assert len(done) - before == 6
    with pytest.raises(InputError, match="holds another search .search_seed."):
        tune(order(city, tmp_path / "parts", search_seed=1))
    other = tune(order(city, tmp_path / "other", trials=7, search_seed=1))
    assert not np.allclose(other["kp"][1:], whole["kp"][1:7])


def test_an_interrupt_in_a_generation_keeps_its_candidates(city, tmp_path, runs, monkeypatch):
    whole = tune(order(city, tmp_path / "whole", trials=6))
    run_many, calls = tuning.run_many, []

    def interrupted(*arguments, **options):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return run_many(*arguments, **options)

    monkeypatch.setattr(tuning, "run_many", interrupted)
    with pytest.raises(KeyboardInterrupt, match="parts; the same command goes on"):
        tune(order(city, tmp_path / "parts", trials=6))
    pd.testing.assert_frame_equal(whole, tune(order(city, tmp_path / "parts", trials=6)))


def test_a_candidate_whose_run_failed_has_no_score(city, tmp_path, runs):
    _, failing = runs
    failing.update({3, 6})  # one run of candidate 1, one of 2
    table = tune(order(city, tmp_path / "out", trials=6, levels=(1.0, 1.6)))
    assert list(np.flatnonzero(table["score_veh_s"].isna())) == [1, 2]
    assert table.loc[table[tuning.SCORE].idxmin()]["candidate"] not in (1, 2)
    failing.update(range(len(runs[0]) + 1, len(runs[0]) + 3))
    with pytest.raises(RunFailed, match="SUMO fell over"):
        tune(order(city, tmp_path / "other", trials=1, levels=(1.0, 1.6)))


def test_a_failed_first_candidate_has_no_number(city, tmp_path, runs):
    _, failing = runs
    failing.add(1)
    for words in ("SUMO fell over", "no candidate has a score"):
        with pytest.raises(RunFailed, match=words):
            tune(order(city, tmp_path, trials=1))
    tune(order(city, tmp_path, trials=2))
    head = (tmp_path / "tune.toml").read_text().splitlines()[0]
    assert head.startswith("# Best of 2 candidates: ")
    assert head.endswith(" veh s; the first: failed")


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (["kp"], "expected KEY=LOW:HIGH"),
        (["kp=2:1"], "LOW below HIGH"),
        (["kp=1:nan"], "LOW below HIGH"),
        (["kp[x]=1:2"], "expected KEY=LOW:HIGH"),
        (["nothing=1:2"], "nothing"),
        (["set_point[1]=1:2"], "set_point[1]"),
        (["kp=-1:2"], "kp"),
    ],
)
def test_one_line_for_what_cannot_be_tuned(city, out, arguments, expected):
    options = [f"--option {text}" for text in arguments]
    done = cosim("tune", city.folder, "--controller pi-gating", *options, "--out", out)
    assert expected in error_line(done)
    assert not out.exists()


def test_the_command(city, out, runs):
    options = "--option set_point[0]=200:600 --option kp=0.1:10 --candidates 3 --seeds 1 --out"
    said = good(cosim("tune", city.folder, "--controller pi-gating", options, out))
    assert "# Best of 3 candidates: " in said
    assert "set_point = [" in said
    assert len(pd.read_csv(out / "tune.csv")) == 3


def test_options_that_train_a_policy_train_one_for_every_candidate(city, out, monkeypatch):
    seen = []

    def made(scenario, strategy, *, seed, demand):
        seen.append(scenario.controller_options["dpc-pcrg"]["mfd_scale"])
        return trajectories.in_city(scenario, strategy, seed, demand, tts=1e6 * seen[-1])

    monkeypatch.setattr(
        tuning, "in_processes", lambda jobs, *_: [(n, job()) for n, job in enumerate(jobs)]
    )
    made_up.instead_of_sumo(monkeypatch, made)
    chosen = tuning.Tuning(
        scenario=city,
        strategy=parse("dpc-pcrg"),
        options={"mfd_scale": (0.6, 1.0), "steps": (1, 1.4)},
        trials=2,
        seeds=(1000,),
        out=out,
    )
    table = tune(chosen)
    assert list(table["steps"]) == [1, 1]  # a whole number
    assert len(set(seen)) == 2
    assert chosen.policy(0).read_bytes() != chosen.policy(1).read_bytes()
