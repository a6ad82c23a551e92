"""The vehicle ledger of the regional plants: on in every run, and what it says when it is
broken."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny
import torch
from click.testing import CliRunner

from nmfd import ledger
from nmfd.api import load_scenario
from nmfd.cli import main
from nmfd.model import acyclic, dynamics
from nmfd.model.plant import AcyclicPlant, NmfdPlant
from nmfd.types import Controls

PLANTS = pytest.mark.parametrize("make", [NmfdPlant, AcyclicPlant])
SCHEMES = pytest.mark.parametrize(
    "integrator, substeps", [("euler", 1), ("euler", 3), ("rk4", 1), ("rk4", 2)]
)


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    return load_scenario(tiny.write(tmp_path_factory.mktemp("tiny"), network=tiny.row_network(3)))


def opened(scenario, u=0.9):
    return Controls(perimeter=np.where(scenario.network.adjacency, u, 0.0), splits=None)


@PLANTS
@SCHEMES
def test_it_holds_with_every_scheme(scenario, make, integrator, substeps):
    scenario = replace(scenario, integrator=integrator, substeps=substeps)
    plant = make(scenario)
    plant.reset(0)
    for k in range(scenario.steps):
        measurement = plant.step(opened(scenario))
        entered = scenario.step * scenario.demand[: k + 1].sum()
        assert measurement.completed + measurement.accumulation.sum() == pytest.approx(
            entered, abs=1e-9
        )
    assert measurement.completed > 50.0


@pytest.mark.parametrize("integrator, substeps", [("euler", 2), ("rk4", 2)])
def test_counting_changes_nothing(scenario, integrator, substeps):
    random = np.random.default_rng(0)
    p = dynamics.parameters(scenario.network)
    x = torch.from_numpy(random.uniform(0.0, 300.0, (5, 3, 3)))
    demand, perimeter = (torch.from_numpy(random.uniform(0.0, 1.0, (5, 3, 3))) for _ in range(2))
    splits = torch.from_numpy(scenario.network.nominal_splits)
    options = {"integrator": integrator, "substeps": substeps}
    plain = dynamics.advance(p, x, demand, perimeter, splits, 30.0, **options)
    counted, ended = dynamics.advance_counted(p, x, demand, perimeter, splits, 30.0, **options)
    torch.testing.assert_close(counted, plain, rtol=1e-13, atol=1e-10)
    single, _ = dynamics.advance_counted(p, x[0], demand[0], perimeter[0], splits, 30.0, **options)
    torch.testing.assert_close(single, plain[0], rtol=1e-13, atol=1e-10)
    lost = (x + 30.0 * demand - counted).sum((-2, -1))
    torch.testing.assert_close(ended, lost, rtol=1e-12, atol=1e-9)
    model = acyclic.build(scenario.network)
    theta, _ = acyclic.shares(model, scenario.network.nominal_splits)
    state = random.uniform(0.0, 50.0, len(model.region))
    arguments = model, state, demand[0].numpy(), perimeter[0].numpy(), theta, 30.0
    after, ended = acyclic.advance_counted(*arguments, **options)
    assert ended == pytest.approx(
        state.sum() + 30.0 * demand[0].sum().item() - after.sum(), abs=1e-9
    )


@PLANTS
@pytest.mark.parametrize("lost", [-0.5, 0.01, np.nan])
def test_a_vehicle_from_nowhere_stops_the_run(scenario, make, lost):
    plant = make(scenario)
    plant.reset(0)
    for _ in range(4):
        plant.step(opened(scenario))
    plant._x = plant._x + lost * (plant._x > 0) / (plant._x > 0).sum()
    message = r"control step 5, 150 s: \d+\.\d+ vehicles entered, "
    message += r".* ended their trips and .* are inside, "
    with pytest.raises(ledger.LedgerError, match=message):
        plant.step(opened(scenario))


@PLANTS
def test_controls_that_move_more_than_there_is_stop_the_run(scenario, make):
    plant = make(scenario)
    plant.reset(0)
    with pytest.raises(ledger.LedgerError, match="an accumulation is -"):
        for _ in range(scenario.steps):
            plant.step(opened(scenario, u=20.0))


@pytest.mark.parametrize("plant", ["nmfd", pytest.param("acyclic", marks=pytest.mark.slow)])
def test_the_command_says_it_in_one_line_and_keeps_what_was_finished(tmp_path, monkeypatch, plant):
    scenario, out = tiny.write(tmp_path), tmp_path / "out"
    command = [
        "benchmark",
        scenario,
        "--controllers",
        "no-control",
        "--plant",
        plant,
        "--out",
        out,
        "--seeds",
    ]
    assert CliRunner().invoke(main, [str(a) for a in [*command, 1]]).exit_code == 0
    module = {"nmfd": dynamics, "acyclic": acyclic}[plant]
    honest = module.advance_counted

    def leaking(*arguments, **options):
        x, ended = honest(*arguments, **options)
        return 0.999 * x, ended

    monkeypatch.setattr(module, "advance_counted", leaking)
    result = CliRunner().invoke(main, [str(a) for a in [*command, 2]])
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "no-control, seed 1: LedgerError: vehicle ledger broken at control step" in result.stderr
    assert list(pd.read_csv(out / "runs.csv").query("failure.isna()")["seed"]) == [0]
