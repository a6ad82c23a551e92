"""Counting on runs whose truth is known, made by the regional model itself; and models that are
refused because they predict worse than that nothing changes."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny
import torch
import trajectories

import nmfd
from cosim.evaluation import identify
from cosim.evaluation.free_flow import crossing_times
from cosim.evaluation.identify import Trial
from cosim.sumo.net import city_of
from nmfd.api import load_scenario
from nmfd.controllers.mpc.controller import EconomicMpc
from nmfd.controllers.strategy import parse
from nmfd.controllers.training import check, train
from nmfd.errors import InputError
from nmfd.model.counting import counted, mfd_of
from nmfd.model.identification import Observed, prediction_errors
from nmfd.model.mfd import RoundedLinear, trapezoid
from nmfd.model.regional_model import Errors, HeldOut, load_network, network_toml
from nmfd.model.scenario import Scenario
from nmfd.runs.config import Problem
from nmfd.types import Controls

SCHEME = {"step": 30.0, "substeps": 1, "integrator": "euler"}
STEPS = 120
LANE_KM = np.full(7, 100.0)  # jam: 8,000 veh
WORSE = HeldOut(ahead=900.0, flowing=Errors(2.0, 5.0), congested=Errors(7.0, 6.0))


@pytest.fixture(scope="module")
def truth():
    """Seven regions with trapezoids, other exit rates for every destination, wide boundaries."""
    network = load_network("hexagon7")
    random = np.random.default_rng(0)
    curve = trapezoid(free=0.003, capacity=3.0, wave=0.0005, jam=8000.0)
    rates = random.uniform(0.7, 1.4, network.adjacency.shape)
    return replace(
        network,
        mfds=(curve,) * 7,
        exit_rates=rates / rates.mean(axis=1, keepdims=True),
        capacity=np.where(network.adjacency, 8.0, 0.0),
        storage=np.full(7, 8000.0),
        equal_ways=True,
    )


def drive(network, factor, seed):
    """Return a run of the regional model under random gates, with what left each region."""
    random = np.random.default_rng(seed)
    wave = np.sin(np.linspace(0.0, np.pi, STEPS)) ** 2
    demand = factor * random.uniform(0.02, 0.1, (7, 7)) * wave[:, None, None]
    scenario = Scenario(name="driven", network=network, step=30.0, steps=STEPS, demand=demand)
    gates = tiny.Acting(lambda _: Controls(perimeter=random.uniform(0.6, 0.9) * network.adjacency))
    run = nmfd.run(scenario, gates)
    completions, transfers = trajectories.flows(scenario, run)
    left = transfers.sum(axis=2) + completions[:, :, None] * np.eye(7)
    return Observed(
        accumulation=run["accumulation"],
        inside=0.5 * (run["accumulation"][1:] + run["accumulation"][:-1]),
        demand=demand,
        perimeter=run["perimeter"],
        splits=run["splits"],
        crossings=30.0 * transfers.sum(axis=3),
        exits=30.0 * left,
    )


def count(truth, runs, fastest=1.0 / 30.0):
    blank = replace(truth, exit_rates=None, capacity=None, storage=None)
    return counted(
        blank,
        runs,
        scheme=SCHEME,
        fastest=np.full(7, fastest),
        saturation=truth.capacity,
        lane_km=LANE_KM,
    )


@pytest.fixture(scope="module")
def runs(truth):
    return [drive(truth, factor, seed) for seed, factor in enumerate((3.0, 4.5, 6.0))]


@pytest.fixture(scope="module")
def found(truth, runs):
    """The model counted from the runs of least and most demand."""
    return count(truth, [runs[0], runs[2]])


def test_counting_finds_rates_and_curves(truth, runs, found):
    np.testing.assert_allclose(found.exit_rates, truth.exit_rates, rtol=0.15)
    seen = np.linspace(50.0, min(1000.0, runs[2].accumulation.sum(axis=2).max()), 20)
    for curve, model in zip(truth.mfds, found.mfds, strict=True):
        np.testing.assert_allclose(model.outflow(seen), curve.outflow(seen), rtol=0.15)


def test_counting_predicts_a_run_that_it_has_not_seen(runs, found):
    off = prediction_errors(found, runs[1:2], 30, **SCHEME)
    state = runs[1].accumulation.sum(axis=2)
    unchanged = state[:-30] - state[30:]
    assert np.sqrt((off**2).mean()) < 0.2 * np.sqrt((unchanged**2).mean())


def test_no_rate_is_above_the_limit(truth, runs):
    found = count(truth, runs[:1], fastest=1.0 / 400.0)
    free = np.array([curve.rate(0.0) for curve in found.mfds])
    assert (found.exit_rates * free[:, None]).max() <= (1.0 + 1e-9) / 400.0


def test_what_was_not_seen_is_a_guess_above(truth):
    light = drive(truth, 1.0, seed=5)
    found = count(truth, [light])
    most = light.accumulation.sum(axis=2).max(axis=0)
    assert set(found.critical_above) == set(range(7))
    assert (found.critical >= 0.9 * most).all()


@pytest.mark.parametrize("locks", [False, True])
def test_a_plateau_ends_only_where_locked_states_were_seen(locks):
    n = np.linspace(10.0, 1000.0, 200)
    exits = np.minimum(0.01 * n, 3.01)  # the mean of many such floats is another one
    if locks:
        n = np.concatenate([n, np.linspace(1000.0, 1200.0, 50)])
        exits = np.concatenate([exits, np.linspace(3.01, 0.05, 50)])
    curve, flowing, seen = mfd_of(n, exits, n, jam=2000.0)
    assert seen
    assert curve.problem() is None
    assert curve.critical == pytest.approx(301.0, rel=0.1)
    assert curve.outflow(900.0) == pytest.approx(3.01, rel=0.05)
    if locks:
        assert curve.outflow(1190.0) < 1.0
        assert not flowing[-10:].any()
    else:
        assert curve.outflow(1500.0) == pytest.approx(3.01, rel=0.05)
        assert curve.jam > 1500.0
        assert flowing.all()


@pytest.mark.parametrize("fallen", [5, 20])
def test_a_fall_in_few_intervals_may_be_chance(fallen):
    n = np.concatenate([np.linspace(10.0, 500.0, 200), np.linspace(505.0, 520.0, fallen)])
    exits = np.where(n <= 500.0, 0.006 * n, 2.5)
    curve, _, seen = mfd_of(n, exits, n, jam=2000.0)
    assert seen == (fallen == 20)
    assert (curve.critical < 510.0) == seen


def test_a_counted_model_comes_back_from_its_file(found, tmp_path):
    dispersion = np.arange(20.0, 69.0).reshape(7, 7)
    found = replace(found, held_out=WORSE, dispersion=dispersion, longest_delay=1.5)
    (tmp_path / "network.toml").write_text(network_toml(found, {}, "a test"))
    again = load_network(tmp_path)
    assert again.held_out == WORSE
    assert again.longest_delay == 1.5
    assert (again.dispersion == dispersion).all()
    for here, there in zip(found.mfds, again.mfds, strict=True):
        assert isinstance(there, RoundedLinear)
        np.testing.assert_allclose(there.accumulations, here.accumulations, rtol=1e-5)
        np.testing.assert_allclose(there.outflows, here.outflows, rtol=1e-5)
    text = (tmp_path / "network.toml").read_text()
    both = text.replace("[regions.piecewise_mfd]", "[regions.mfd]\na = 0.0\nb = 0.0\nc = 0.01\n"
                        "jam = 9.0\n\n[regions.piecewise_mfd]", 1)  # fmt: skip
    (tmp_path / "network.toml").write_text(both)
    with pytest.raises(InputError, match="there is piecewise_mfd, too; remove one"):
        load_network(tmp_path)


@pytest.mark.slow
def test_mpc_solves_its_plans_on_a_counted_model(truth, runs):
    """Kinks are rounded: at sharp ones the solver of MPC stops."""
    scenario = load_scenario("economic_mpc")
    city = replace(scenario, network=count(truth, runs), measurement_std=0.0)
    result = nmfd.run(city, "mpc-pc", steps=40)
    assert (result["status"] == 0).all()


def test_a_model_worse_than_as_now_is_refused(tmp_path, three_regions):
    poor = replace(three_regions, network=replace(three_regions.network, held_out=WORSE))
    worse = r"beyond critical its error is 7 veh, of 6; .*--anyway"
    with pytest.raises(InputError, match=worse):
        check(poor, parse("dpc-pc"))
    check(three_regions, parse("dpc-pc"))
    with pytest.raises(InputError, match="predicts worse.*; set anyway = true to plan with it"):
        parse("mpc-pc").make(poor)
    forced = parse(EconomicMpc(anyway=True))
    forced.make(poor)
    assert forced.name == "mpc-pc(anyway=true)"  # in all tables of results
    assert "beyond critical" in forced.model_warning(poor)
    assert parse("pi-gating").model_warning(poor) == ""
    assert parse("mpc-pc").model_warning(three_regions) == ""
    assert isinstance(EconomicMpc().misfit(parse("no-control").own_planning(poor)), Problem)
    file = train(poor, parse("dpc-pc"), seed=0, out=tmp_path / "p.pt", steps=1, anyway=True)
    known = torch.load(file, weights_only=True)["configuration"]
    assert "beyond critical its error is 7 veh" in known["model_warning"]


def trial(method, flowing, congested):
    """Return a trial whose errors are 10 veh for "as now", in one region."""
    errors = {"ahead_s": 900.0}
    for name, error in (("flowing", flowing), ("congested", congested)):
        errors[f"{name}_states"] = 5
        errors[f"{name}_rmse_veh"] = error
        errors[f"{name}_persistence_rmse_veh"] = 10.0
    return Trial(method=method, model=None, errors=pd.DataFrame([errors]))


@pytest.mark.parametrize(
    ("counted_errors", "fitted_errors", "chosen"),
    [
        ((4.9, 9.9), (1.0, 1.0), "counted"),  # good: no fit is made
        ((5.1, 9.9), (4.0, 9.0), "fitted"),
        ((4.0, 10.1), (9.0, 9.0), "counted"),  # the fit is worse in all states together
    ],
)
def test_a_fit_is_made_only_if_counting_falls_short(counted_errors, fitted_errors, chosen):
    errors = {"counted": counted_errors, "fitted": fitted_errors}
    made = []

    class Task:
        def trial(self, method, static, runs):
            made.append(method)
            return trial(method, *errors[method])

    assert identify.Task.best(Task(), None, []).method == chosen
    needed = not trial("counted", *counted_errors).good
    assert made == (["counted", "fitted"] if needed else ["counted"])


def test_crossing_times_are_those_of_the_streets():
    """The four sides of the demo's ring are alike; its centre is smaller."""
    times = crossing_times(city_of(load_network("demo")))
    np.testing.assert_allclose(times[:4], times[0], rtol=0.02)
    assert 10.0 < times[4] < times[0] < 120.0
