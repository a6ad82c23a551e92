"""Perturbed demand, the comparison over it, and the guard that falls back to PI gating."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from commands import nmfd

from nmfd import closed_loop
from nmfd.api import controller as make_controller
from nmfd.api import load_scenario
from nmfd.controllers.dpc import fallback, training
from nmfd.controllers.dpc import policy as dpc
from nmfd.controllers.dpc.policy import Architecture, Policy
from nmfd.controllers.dpc.policy_file import checkpoint
from nmfd.controllers.rules import PiGating
from nmfd.metrics import total_time_spent
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.model.scenario import WHERE, perturbed, perturbed_entries
from nmfd.studies import robustness
from nmfd.types import Observation, Status

BENCHMARK = Path(__file__).parents[1] / "scenarios" / "economic_mpc"


@pytest.fixture
def folder(tmp_path):
    return tiny.write(tmp_path)


@pytest.fixture
def scenario(folder):
    return load_scenario(folder)


@pytest.mark.parametrize("where", WHERE)
def test_noise_has_the_declared_size_and_place(scenario, where):
    long = replace(scenario, demand=np.tile(10.0 * np.sign(scenario.demand), (200, 1, 1)))
    noisy = perturbed(long, 1.0, 0, where=where)
    change, touched = noisy.demand - long.demand, perturbed_entries(long.demand, where)
    assert (change[~touched] == 0.0).all() and noisy.demand.min() >= 0.0
    assert change[long.demand > 0].std() == pytest.approx(1.0, rel=0.05)
    added = noisy.demand[touched & (long.demand == 0)]
    if where == "planned":
        assert added.size == 0
    else:  # half of a normal distribution
        assert added.mean() == pytest.approx(1.0 / np.sqrt(2.0 * np.pi), rel=0.05)


def test_noise_is_common_to_all_sigmas_and_follows_its_seed(scenario):
    high = replace(scenario, demand=scenario.demand + 100.0)
    one, two = (perturbed(high, sigma, 3, where="all").demand - high.demand for sigma in (1.0, 2.0))
    np.testing.assert_allclose(two, 2.0 * one, atol=1e-10)
    np.testing.assert_array_equal(perturbed(high, 0.0, 3, where="all").demand, high.demand)
    assert not np.array_equal(perturbed(high, 1.0, 4, where="all").demand - high.demand, one)


def test_training_noise_is_that_of_the_evaluation(scenario):
    """Even rollouts: on the pairs in use; odd ones: everywhere; sigma the level times the setting."""
    rollout = training.Rollout(planning_model(scenario))
    nominal = 50.0 + rollout.demand.unsqueeze(1).repeat(50, 400, 1, 1)
    level = torch.full((400,), 0.5)
    change = rollout.perturb(nominal, level, 2.0, 0.5, torch.Generator().manual_seed(0)) - nominal
    assert change[:, 0::2, 0, 1].std().item() == pytest.approx(1.0, rel=0.02)
    assert change[:, 0::2, 1, 0].abs().max().item() == 0.0
    assert change[:, 1::2, 0, 1].std().item() == pytest.approx(0.25, rel=0.02)
    assert change[:, 1::2, 1, 0].std().item() == pytest.approx(0.25, rel=0.02)
    assert rollout.perturb(nominal, level, 0.0, 0.0, torch.Generator()) is nominal


def command(folder, out, *more):
    return [
        "robustness",
        folder,
        "--controllers",
        "pi-gating",
        "--sigmas",
        "0,1",
        "--scenarios",
        2,
        "--out",
        out,
        *more,
    ]


def test_command_writes_rows_figure_and_manifest(folder, tmp_path):
    result = nmfd(*command(folder, tmp_path / "out"))
    assert result.exit_code == 0, result.stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"robustness.csv", "robustness.png", "manifest.json"}
    rows = robustness.read(tmp_path / "out" / "robustness.csv")
    assert [tuple(row.values())[:3] for row in rows] == [
        (sigma, number, name) for sigma in (0.0, 1.0) for number in (0, 1) for name in ("no-control", "pi-gating")
    ]
    assert rows[0]["trips_veh"] == pytest.approx(360.0) and rows[-1]["trips_veh"] > 400.0
    assert "pi-gating" in result.stdout and "±" in result.stdout


def test_improvement_is_over_no_control_in_the_same_scenario():
    rows = [
        {
            "sigma_veh_per_s": 1.0,
            "scenario": number,
            "controller": name,
            "trips_veh": 1.0,
            "total_time_spent_veh_s": total,
        }
        for number, name, total in (
            (0, "no-control", 100.0),
            (0, "pi-gating", 50.0),
            (1, "no-control", 1000.0),
            (1, "pi-gating", 700.0),
            (2, "pi-gating", 1.0),
        )
    ]
    mean, half = robustness.improvements(rows, "pi-gating")[1.0]
    assert mean == pytest.approx(40.0) and half == pytest.approx(12.706 * 10.0, rel=1e-3)


def test_an_interrupted_comparison_goes_on_and_workers_change_nothing(folder, tmp_path, monkeypatch):
    assert nmfd(*command(folder, tmp_path / "whole")).exit_code == 0
    assert nmfd(*command(folder, tmp_path / "two", "--workers", 2)).exit_code == 0
    original, calls = closed_loop.run, []

    def run(*arguments, **options):
        calls.append(None)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return original(*arguments, **options)

    monkeypatch.setattr(closed_loop, "run", run)
    result = nmfd(*command(folder, tmp_path / "out"))
    assert result.exit_code == 130 and result.stderr.count("\n") == 1 and "goes on" in result.stderr
    assert len(robustness.read(tmp_path / "out" / "robustness.csv")) == 3
    assert nmfd(*command(folder, tmp_path / "out")).exit_code == 0
    assert len(calls) == 9  # three, the interrupted one, and the five that were left
    files = [(tmp_path / name / "robustness.csv").read_bytes() for name in ("whole", "two", "out")]
    assert files[0] == files[1] == files[2]


def test_interrupted_before_the_first_run_leaves_nothing(folder, tmp_path, monkeypatch):
    def run(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(closed_loop, "run", run)
    result = nmfd(*command(folder, tmp_path / "a" / "b"))
    assert result.exit_code == 130 and "nothing is kept" in result.stderr and not (tmp_path / "a").exists()


@pytest.mark.parametrize("sigmas", ["", "1,x", "-1", "1,1", "inf"])
def test_wrong_sigmas(folder, tmp_path, sigmas):
    result = nmfd("robustness", folder, "--controllers", "pi-gating", f"--sigmas={sigmas}", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "'--sigmas': expected a list of distinct numbers from 0 up" in result.stderr


def test_a_folder_of_another_noise_is_refused(folder, tmp_path):
    assert nmfd(*command(folder, tmp_path / "out")).exit_code == 0
    result = nmfd(*command(folder, tmp_path / "out", "--where", "all"))
    assert result.exit_code == 2 and 'where: "pairs" there, "all" asked for' in result.stderr


def constant_policy(scenario, logit):
    made = Policy(scenario.network, Architecture(width=4))
    with torch.no_grad():
        made.perimeter_decoder.bias.fill_(logit)
        made.perimeter_decoder.weight.fill_(0.0)
    return made


def guard(scenario, spread=0.1):
    policy = constant_policy(scenario, 20.0)
    states = 0.5 + spread * np.random.default_rng(0).standard_normal((5000, 4))
    return fallback.Guarded(policy, fallback.statistics(states), planning_model(scenario))


def at(scenario, value, step=0):
    critical = scenario.network.mfds[0].critical
    return Observation(
        step=step, time=30.0 * step, accumulation=np.full((2, 2), value * critical), backlog=np.zeros((2, 2))
    )


def test_the_guard_takes_over_outside_and_hands_back_inside(scenario, monkeypatch):
    monkeypatch.setattr(fallback, "MOST_ERROR", np.inf)  # the states here jump
    watched, gating = guard(scenario), PiGating(planning_model(scenario))
    assert watched.act(at(scenario, 0.5)).status == Status.OK
    gating.reset()
    for step in (1, 2):
        controls = watched.act(at(scenario, 2.0, step))
        assert controls.note.startswith("guard: ")
        np.testing.assert_array_equal(controls.perimeter, gating.act(at(scenario, 2.0, step)).perimeter)
    statuses = [watched.act(at(scenario, 0.5, step)).note for step in range(3, 3 + fallback.PATIENCE)]
    assert all(statuses[:-1]) and not statuses[-1]


def wrong_policy(scenario):
    """All perimeters as good as closed, whatever the state."""
    return constant_policy(scenario, -20.0)


def test_a_wrong_policy_does_not_make_it_worse_in_silence():
    """Closed gates in an empty city: the states are those of its own training, and still it is found out."""
    benchmark = load_scenario(BENCHMARK)
    scenario = replace(benchmark, measurement_std=0.0, steps=120, demand=0.4 * benchmark.demand)
    made = wrong_policy(scenario)
    alone = closed_loop.run(NmfdPlant(scenario), dpc.DpcController(made), scenario, seed=0)
    states = (alone.accumulation[:-1] / made.scale.numpy()).reshape(-1, 49)
    watched = fallback.Guarded(made, fallback.statistics(np.repeat(states, 4, axis=0)), planning_model(scenario))
    kept = closed_loop.run(NmfdPlant(scenario), watched, scenario, seed=0)
    nobody = closed_loop.run(NmfdPlant(scenario), make_controller("no-control", scenario), scenario, seed=0)
    assert total_time_spent(alone) > 1.2 * total_time_spent(nobody)
    assert total_time_spent(kept) <= total_time_spent(nobody)
    assert any("more time than no control, pi-gating in control" in status for status in kept.note)


def test_a_city_that_the_model_does_not_predict_is_noticed(scenario):
    """It is told once that nothing has changed, where the model has seen everybody leave."""
    watched = guard(scenario)
    assert watched.act(at(scenario, 0.5, 0)).status == Status.OK
    watched._predicted = watched._predicted + 0.5 * scenario.network.mfds[0].critical
    status = watched.act(at(scenario, 0.5, 1)).note
    assert "predictions miss by" in status and "pi-gating in control" in status
    watched.reset()
    assert watched.act(at(scenario, 0.5, 0)).status == Status.OK


def foreseen(policy, gates):
    ahead = np.ones(fallback.LOOK_AHEAD)
    return fallback.Foreseen(policy=policy * ahead, gates=gates * ahead, none=gates * ahead)


@pytest.mark.parametrize(
    ("with_them", "without", "kept"),
    [
        pytest.param(1.0, 1.0, True, id="as foreseen"),
        pytest.param(1.2, 1.0, False, id="worse than foreseen"),
        pytest.param(1.2, 1.2, True, id="model wrong either way"),
        pytest.param(1.05, 1.0, True, id="half the gain"),
    ],
)
def test_split_ratios_stay_while_they_pay(with_them, without, kept):
    """Foreseen: 90 vehicles instead of 100, after a time when more were expected with them, so that both are seen.
    Measured: so many times what was foreseen, with them and without."""
    judge, commanded = fallback.Judge(), []
    for step in range(80):
        ahead = foreseen(90.0 if step >= 20 else 110.0, 100.0)
        commanded.append(not judge.problem(ahead))
        vehicles = 90.0 * with_them if commanded[-1] else 100.0 * without
        now = Observation(step=step, time=0.0, accumulation=np.array([[vehicles]]), backlog=np.zeros((1, 1)))
        judge.command(commanded[-1], ahead, now)
        judge.see(now)
    assert not any(commanded[:20]) and commanded[20] and commanded[-1] == all(commanded[20:]) == kept, commanded


def test_demand_that_is_not_as_forecast_is_no_fault_of_split_ratios():
    """They were always commanded: nothing says what would have come without."""
    judge, ahead = fallback.Judge(), foreseen(90.0, 100.0)
    for step in range(60):
        assert not judge.problem(ahead)
        now = Observation(step=step, time=0.0, accumulation=np.array([[150.0]]), backlog=np.zeros((1, 1)))
        judge.command(True, ahead, now)
        judge.see(now)


def test_split_ratios_that_cost_time_are_left_to_the_drivers():
    """A policy that sends everybody round: its guard leaves guidance by travel times, not less."""
    benchmark = replace(load_scenario(BENCHMARK), measurement_std=0.0, steps=60)
    torch.manual_seed(0)
    astray = Policy(benchmark.network, Architecture(width=4, layers=1, guidance=True))
    with torch.no_grad():
        astray.perimeter_decoder.bias += 20.0
    states = np.random.default_rng(0).uniform(0.0, 1.0, (4000, 49))
    watched = fallback.Guarded(astray, fallback.statistics(states), planning_model(benchmark))
    alone, kept, guided = (
        total_time_spent(closed_loop.run(NmfdPlant(benchmark), controller, benchmark, seed=0))
        for controller in (dpc.DpcController(astray), watched, make_controller("route-guidance", benchmark))
    )
    assert alone > 1.05 * guided and kept < 1.01 * guided


def test_the_limit_lets_the_training_states_pass(scenario):
    watched, critical = guard(scenario), scenario.network.mfds[0].critical
    states = critical * (0.5 + 0.1 * np.random.default_rng(1).standard_normal((4000, 2, 2)))
    outside = np.mean([watched.distance(state) > 1.0 for state in states])
    assert outside == pytest.approx(1.0 - fallback.QUANTILE, abs=2e-3)


def test_the_guard_reads_the_statistics_of_a_trained_policy(folder, scenario, tmp_path):
    file = training.train(scenario, "dpc-pc", seed=0, out=tmp_path / "p.pt", steps=1)
    controller = make_controller("dpc-pc-guarded", scenario, policy=file)
    assert controller.name == "dpc-pc-guarded" and controller.distance(at(scenario, 0.0).accumulation) < 1.0
    torch.save(checkpoint(Policy(scenario.network, Architecture(width=4)), scenario.network, {}), tmp_path / "old.pt")
    result = nmfd(
        "benchmark",
        folder,
        "--controllers",
        "dpc-pc-guarded",
        "--policy",
        f"dpc-pc-guarded={tmp_path / 'old.pt'}",
        "--out",
        tmp_path / "out",
    )
    assert result.exit_code == 2 and "holds no statistics of its training states" in result.stderr


def test_a_damaged_csv_is_one_line(folder, tmp_path):
    assert nmfd(*command(folder, tmp_path / "out")).exit_code == 0
    file = tmp_path / "out" / "robustness.csv"
    with file.open("a", newline="") as text:
        csv.writer(text).writerow(["x", "y"])
    result = nmfd(*command(folder, tmp_path / "out"))
    assert result.exit_code == 2 and result.stderr.count("\n") == 1 and str(file) in result.stderr
