"""Perturbed demand, and the comparison of controllers over it."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny

from nmfd.api import robustness
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model.scenario import pairs_with_demand, perturbed
from nmfd.studies import benchmark as study


def test_noise_has_the_declared_size_and_place(scenario):
    many = np.tile(10.0 * np.sign(scenario.demand), (200, 1, 1))
    long = replace(scenario, steps=len(many), demand=many)
    noisy = perturbed(long, 1.0, 0)
    change, pairs = noisy.demand - long.demand, pairs_with_demand(long.demand)
    assert (change[:, ~pairs] == 0.0).all()
    assert noisy.demand.min() >= 0.0
    assert change[long.demand > 0].std() == pytest.approx(1.0, rel=0.05)
    added = noisy.demand[:, pairs][long.demand[:, pairs] == 0]
    assert added.mean() == pytest.approx(
        1.0 / np.sqrt(2.0 * np.pi), rel=0.05
    )  # half of a normal distribution


def test_noise_is_common_to_all_sigmas_and_follows_its_seed(scenario):
    high = replace(scenario, demand=scenario.demand + 100.0)
    one, two = (perturbed(high, sigma, 3).demand - high.demand for sigma in (1.0, 2.0))
    np.testing.assert_allclose(two, 2.0 * one, atol=1e-10)
    np.testing.assert_array_equal(perturbed(high, 0.0, 3).demand, high.demand)
    assert not np.array_equal(perturbed(high, 1.0, 4).demand - high.demand, one)


def test_noise_with_the_trips_of_the_scenario(scenario):
    noisy = perturbed(scenario, 5.0, 0, "demand-total")
    np.testing.assert_allclose(noisy.demand.sum(axis=0), scenario.demand.sum(axis=0))
    assert noisy.demand.min() >= 0.0
    assert np.abs(noisy.demand - scenario.demand).max() > 0.5


@pytest.mark.parametrize("kinds", [lambda network: network, tiny.mixed], ids=["cubic", "mixed"])
@pytest.mark.parametrize("kind, power", [("mfd-scale", 0), ("mfd-axis", 1)])
def test_other_mfds_have_the_declared_spread_and_the_plant_follows_them(
    scenario, kinds, kind, power
):
    scenario, logs, totals = replace(scenario, network=kinds(scenario.network), substeps=4), [], []
    for seed in range(60):
        other = perturbed(scenario, 0.1, seed, kind)
        for mfd, own in zip(other.network.mfds, scenario.network.mfds, strict=True):
            wide = mfd.jam / own.jam
            high = mfd.rate(0.6 * wide * own.jam) / own.rate(0.6 * own.jam)
            assert (wide if power == 0 else high) == pytest.approx(1.0)
            logs.append(np.log(wide * high))
    for actual in (scenario, other):
        run = study.closed_loop_of(
            parse("no-control"), 0, scenario=scenario, plant="acyclic", actual=actual
        )
        totals.append(run.accumulation.sum())
    assert np.std(logs) == pytest.approx(0.1, rel=0.2)
    assert abs(np.mean(logs)) < 0.03
    assert totals[0] != totals[1]


def test_trip_lengths_stay_within_the_integration_step_and_a_wrong_kind_is_one_line(scenario):
    rates = [
        perturbed(scenario, sigma, 0, "trip-lengths").network.exit_rates
        for sigma in (0.1, 0.2, 9.0)
    ]
    np.testing.assert_allclose(rates[1], rates[0] ** 2)
    assert rates[2].max() * scenario.network.mfds[0].rate(0.0) == pytest.approx(
        scenario.substeps / scenario.step
    )
    with pytest.raises(InputError, match="kind: expected one of demand, .* got 'weather'"):
        perturbed(scenario, 0.1, 0, "weather")


def test_rows_and_picture_of_a_comparison(folder, tmp_path):
    out, options = tmp_path / "out", {"sigmas": [0.0, 1.0], "seeds": 2}
    rows = robustness(folder, ["pi-gating"], out=out, **options)
    assert {path.name for path in out.iterdir()} >= {
        "runs.csv",
        "robustness.png",
        "manifest.json",
        "demand-1",
    }
    assert [tuple(row) for row in rows[["sigma", "seed", "controller"]].to_numpy()] == [
        (sigma, number, name)
        for sigma in (0.0, 1.0)
        for number in (0, 1)
        for name in ("no-control", "pi-gating")
    ]
    assert rows["trips_veh"].iloc[0] == pytest.approx(360.0)
    assert rows["trips_veh"].iloc[-1] > 400.0
    table = study.improvement_table(rows)
    assert "pi-gating" in table
    assert "±" in table
    more = robustness(folder, ["greedy"], out=out, sigmas=[1.0], seeds=1)
    assert len(more) == 9
    assert set(more["failure"]) == {""}
    other = robustness(folder, ["pi-gating"], kind="trip-lengths", out=out, sigmas=[0.1], seeds=1)
    table = study.improvement_table(other)
    assert "360" in table
    assert "sigma of trip-lengths: spread" in table
    assert "greedy" not in table


def test_improvement_is_over_no_control_in_the_same_scenario():
    totals = {
        (0, "no-control"): 100.0,
        (0, "pi-gating"): 50.0,
        (1, "no-control"): 1000.0,
        (1, "pi-gating"): 700.0,
    }
    rows = pd.DataFrame(
        [(*run, total) for run, total in [*totals.items(), ((2, "pi-gating"), 1.0)]],
        columns=["seed", "controller", "total_time_spent_veh_s"],
    ).assign(sigma=1, failure="", kind="demand")
    mean, half = study.improvements(rows, "pi-gating")[1.0]
    assert mean == pytest.approx(40.0)
    assert half == pytest.approx(12.706 * 10.0, rel=1e-3)
