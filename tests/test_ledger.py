"""The vehicle ledger of the regional plants: on in every run, and what it says when it is
broken."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny
from commands import good, last_words, nmfd

from nmfd import ledger
from nmfd.api import load_scenario
from nmfd.model import acyclic, dynamics
from nmfd.model.integration import counted
from nmfd.model.plant import AcyclicPlant, NmfdPlant

PLANTS = pytest.mark.parametrize("make", [NmfdPlant, AcyclicPlant])
SCHEMES = pytest.mark.parametrize(
    "integrator, substeps", [("euler", 1), ("euler", 3), ("rk4", 1), ("rk4", 2)]
)


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    return load_scenario(tiny.write(tmp_path_factory.mktemp("tiny"), network=tiny.row_network(3)))


@PLANTS
@SCHEMES
def test_it_holds_with_every_scheme(scenario, make, integrator, substeps):
    scenario = replace(scenario, integrator=integrator, substeps=substeps)
    plant = make(scenario)
    plant.reset(0)
    for k in range(scenario.steps):
        measurement = plant.step(tiny.gates_at(scenario, 0.9))
        entered = scenario.step * scenario.demand[: k + 1].sum()
        assert measurement.completed + measurement.accumulation.sum() == pytest.approx(
            entered, abs=1e-9
        )
    assert measurement.completed > 50.0


@pytest.mark.parametrize("integrator, substeps", [("euler", 2), ("rk4", 2)])
def test_what_is_counted_is_missing(scenario, integrator, substeps):
    """In the acyclic model; test_dynamics.py has the same of the other one."""
    random = np.random.default_rng(0)
    demand, perimeter = random.uniform(0.0, 1.0, (2, 3, 3))
    model = acyclic.build(scenario.network)
    theta, _ = acyclic.shares(model, scenario.network.nominal_splits)
    state = random.uniform(0.0, 50.0, len(model.region))
    options = {"integrator": integrator, "substeps": substeps}

    def slope(x):
        return acyclic.derivative(model, x, demand, perimeter, theta)

    after, ended = counted(slope, state, 30.0, **options)
    assert ended == pytest.approx(state.sum() + 30.0 * demand.sum() - after.sum(), abs=1e-9)


@PLANTS
@pytest.mark.parametrize("lost", [-0.5, 0.01, np.nan])
def test_a_vehicle_from_nowhere_stops_the_run(scenario, make, lost):
    plant = make(scenario)
    plant.reset(0)
    for _ in range(4):
        plant.step(tiny.gates_at(scenario, 0.9))
    plant._x = plant._x + lost * (plant._x > 0) / (plant._x > 0).sum()
    message = r"control step 5, 150 s: \d+\.\d+ vehicles entered, "
    message += r".* ended their trips and .* are inside, "
    with pytest.raises(ledger.LedgerError, match=message):
        plant.step(tiny.gates_at(scenario, 0.9))


@PLANTS
def test_controls_that_move_more_than_there_is_stop_the_run(scenario, make):
    plant = make(scenario)
    plant.reset(0)
    with pytest.raises(ledger.LedgerError, match="an accumulation is -"):
        for _ in range(scenario.steps):
            plant.step(tiny.gates_at(scenario, u=20.0))


def test_the_command_says_it_in_one_line_and_keeps_what_was_finished(tmp_path, out, monkeypatch):
    command = ("benchmark", tiny.write(tmp_path), "--controllers no-control --out", out)
    good(nmfd(*command, "--seeds 1"))
    honest = dynamics.advance_counted

    def leaking(*arguments, **options):
        x, ended = honest(*arguments, **options)
        return 0.999 * x, ended

    monkeypatch.setattr(dynamics, "advance_counted", leaking)
    line = last_words(nmfd(*command, "--seeds 2"), 1)
    assert "no-control, seed 1: LedgerError: vehicle ledger broken at control step" in line
    assert list(pd.read_csv(out / "runs.csv").query("failure.isna()")["seed"]) == [0]
