"""The benchmark scenario gives the published figures, as far as they are matched."""

from dataclasses import replace
from pathlib import Path

import pytest

from nmfd.api import load_scenario
from nmfd.closed_loop import run
from nmfd.controllers.rules import NoControl
from nmfd.metrics import summary
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant

SCENARIO = Path(__file__).parents[1] / "scenarios" / "economic_mpc"


@pytest.fixture(scope="module")
def scenario():
    return load_scenario(SCENARIO)


def no_control(scenario):
    return summary(run(NmfdPlant(scenario), NoControl(planning_model(scenario)), scenario, seed=0))


def test_demand_is_the_reconstruction(scenario):
    assert scenario.step * scenario.demand.sum() == pytest.approx(31_680)


def test_no_control_row(scenario):
    row = no_control(scenario)
    assert row["total_time_spent_veh_s"] == pytest.approx(1.773e8, rel=0.005)
    assert row["final_accumulation_veh"] == pytest.approx(25_526, rel=0.01)


def test_without_the_tail_the_figures_differ(scenario):
    bare = tuple(replace(mfd, jam=1e9) for mfd in scenario.network.mfds)
    row = no_control(replace(scenario, network=replace(scenario.network, mfds=bare)))
    assert row["final_accumulation_veh"] < 0.9 * 25_526
