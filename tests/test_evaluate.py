"""cosim evaluate: order of the runs, what is kept and what is done again, failures, suites,
--check."""

import re
from functools import partial
from pathlib import Path

import copies
import made_up
import pandas as pd
import pytest
import trajectories
from commands import cosim, error_line, good
from filelock import FileLock, Timeout

from cosim.evaluation import evaluate, results
from cosim.plant.strategy import parse
from nmfd.api import load_scenario
from nmfd.errors import InputError
from nmfd.model.scenario import with_demand

STEPS = 30
CITY = "grid7_peak"


def change(file: Path, pattern: str, new: str) -> None:
    """Replace the first match in a file, which must have one."""
    text, count = re.subn(pattern, new, file.read_text(encoding="utf-8"), count=1)
    assert count == 1
    file.write_text(text, encoding="utf-8")


@pytest.fixture
def own(tmp_path):
    """The folder of a copy of grid7_peak that a test may change."""
    return copies.peak(tmp_path)


@pytest.fixture
def ran(monkeypatch):
    """The runs instead of SUMO's."""
    done = []

    def made(scenario, strategy, *, seed, demand):
        done.append((strategy.name, seed, demand))
        return trajectories.in_city(scenario, strategy, seed, demand, tts=900.0)

    made_up.instead_of_sumo(monkeypatch, made)
    return done


def evaluated(
    city,
    out,
    *,
    controllers=("no-control", "pi-gating"),
    seeds=(2000, 2001),
    levels=(1.0,),
    overwrite=False,
):
    scenario = with_demand(load_scenario(city), steps=STEPS)
    strategies = [parse(name) for name in controllers]
    runs = evaluate.plan([(scenario, levels)], strategies, seeds)
    return evaluate.evaluate(runs, out, overwrite=overwrite, progress=False)


def test_one_command_writes_into_a_folder_at_a_time(own, tmp_path, out, ran):
    evaluated(own, out, seeds=(2000,))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    for command in (
        "evaluate CITY --controllers no-control --demand 2 --out OUT",
        "run CITY --controller no-control --out OUT",
        "identify CITY --with own --out OUT",
        "report OUT",
        "compare OUT",
    ):
        words = [{"CITY": own, "OUT": out}.get(word, word) for word in command.split()]
        with FileLock(out / ".lock"):
            assert "out: another process is writing to it" in error_line(cosim(*words)), command
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}


def test_the_folder_is_held_until_its_figures_are_drawn(out, ran, monkeypatch):
    def draw(_):
        with pytest.raises(Timeout):
            FileLock(out / ".lock", timeout=0).acquire()

    monkeypatch.setattr("cosim.reporting.figures.draw_all", draw)
    good(cosim("evaluate", CITY, "--controllers no-control --seeds 1 --out", out))


def test_runs_come_seed_by_seed_and_are_kept(out, ran):
    rows = evaluated(CITY, out, levels=(0.8, 1.0))
    assert len(rows) == 8
    assert (rows["failure"] == "").all()
    assert ran[:4] == [
        (name, 2000, level) for level in (0.8, 1.0) for name in ("no-control", "pi-gating")
    ]
    assert [seed for _, seed, _ in ran] == [2000] * 4 + [2001] * 4
    ran.clear()
    evaluated(
        CITY, out, seeds=(2000, 2001, 2002), controllers=("mpc-pc", "no-control", "pi-gating")
    )
    expected = [("mpc-pc", 2000, 1.0), ("mpc-pc", 2001, 1.0)]
    assert ran == expected + [(name, 2002, 1.0) for name in ("mpc-pc", "no-control", "pi-gating")]
    assert [level.demand for level in results.read(out).levels] == [0.8, 1.0]


@pytest.mark.parametrize(
    "old, new, again",
    [
        (r"outflow_share = [\d.]+", "outflow_share = 0.9", {"pi-gating"}),
        (r"peak = [\d.]+", "peak = 0.77", {"no-control", "pi-gating"}),
    ],
)
def test_only_runs_that_a_change_concerns_are_done_again(own, out, ran, old, new, again):
    evaluated(own, out, seeds=(2000,))
    ran.clear()
    change(own / "scenario.toml", old, new)
    with pytest.raises(InputError, match="is a run with other settings"):
        evaluated(own, out, seeds=(2000,))
    evaluated(own, out, seeds=(2000,), overwrite=True)
    assert {name for name, _, _ in ran} == again


def test_a_suite_is_one_ranked_table(own, tmp_path, out, ran):
    suite = tmp_path / "suite.toml"
    suite.write_text('seeds = [2000]\n[scenarios]\n"scenarios/peak" = [1.0, 1.2]\ndemo = [1.0]\n')
    chosen, seeds = evaluate.read_suite(suite, {"steps": 1})
    runs = evaluate.plan(chosen, [parse("no-control"), parse("pi-gating")], seeds)
    evaluate.evaluate(runs, out, progress=False)
    text = (out / "evaluate.md").read_text()
    assert "| 1 | no-control | +0.0 % | 3 |" in text
    assert "# demo" in text
    assert [level.demand for level in results.read(out, "grid7_peak").levels] == [
        1.0,
        1.2,
    ]
    suite.write_text("seeds = []\n[scenarios]\ndemo = [1.0]\n")
    with pytest.raises(InputError, match="seeds: "):
        evaluate.read_suite(suite)


def test_check_does_runs_again_and_names_what_differs(out, ran):
    evaluated(CITY, out)
    runs = evaluate.plan(
        [(with_demand(load_scenario(CITY), steps=STEPS), (1.0,))],
        [parse("pi-gating")],
        [2000, 2001],
    )
    assert evaluate.check(runs, out, 2) == []
    change(out / "runs.csv", r"pi-gating,2000,sumo,900.0", "pi-gating,2000,sumo,901.0")
    lines = evaluate.check(runs, out, 2)
    assert lines == ["pi-gating, seed 2000: total_time_spent_veh_s was 901.0, is 900.0"]


@pytest.mark.slow
def test_a_small_evaluation_in_sumo(own, out):
    file = own / "scenario.toml"
    file.write_text(re.sub(r"ramp_up = [\d.]+", "ramp_up = 60.0", file.read_text()))
    change(file, r"outflow_share = [\d.]+", "set_point = [20.0]")
    arguments = (
        "evaluate",
        own,
        "--controllers no-control,pi-gating --seeds 1 --steps 3 --out",
        out,
    )
    said = good(cosim(*arguments))
    rows = pd.read_csv(out / "runs.csv")
    assert list(rows["seed"]) == [2000, 2000]
    assert (rows["co2_kg"] > 0).all()
    assert "teleports" in said
    for picture in ("total_accumulation", "region_accumulation", "mfd"):
        assert (out / "demand-1" / f"{picture}.png").stat().st_size > 10_000
    before = {path: path.read_bytes() for path in out.glob("*/*.nc")}
    good(cosim(*arguments))
    assert before == {path: path.read_bytes() for path in out.glob("*/*.nc")}
    assert len(before) == 2
    assert "no difference" in good(cosim(*arguments, "--check 1"))


def test_cosim_run_compares_with_what_against_names(out, monkeypatch):
    city = made_up.city_of(load_scenario(made_up.SCENARIO).network)
    made_up.instead_of_sumo(monkeypatch, partial(made_up.result, city=city))
    arguments = ("run", made_up.SCENARIO, "--controller dpc-pcrg --against pi-gating --steps 5")
    said = good(cosim(*arguments, "--out", out))
    assert "against pi-gating" in said
    assert re.search(r"^dpc-pcrg +1 +\S+ +-\d", said, re.M)
    assert (out / "total_accumulation.png").is_file()
