"""The bound: admissible plans below every closed loop and an exact optimum, plan files, and the command."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from commands import good, nmfd

from nmfd import api, closed_loop
from nmfd.api import load_scenario
from nmfd.controllers import open_loop
from nmfd.controllers.rules import NoControl, PiGating
from nmfd.errors import InputError
from nmfd.metrics import total_time_spent
from nmfd.model.planning import planning_model
from nmfd.model.plant import NmfdPlant
from nmfd.model.scenario import with_demand
from nmfd.studies import bound

ECONOMIC = Path(__file__).parents[1] / "scenarios" / "economic_mpc"


@pytest.fixture
def folder(tmp_path):
    return tiny.write(tmp_path)


@pytest.fixture
def scenario(folder):
    return load_scenario(folder)


def closed(scenario, controller):
    return total_time_spent(closed_loop.run(NmfdPlant(scenario), controller, scenario, seed=0))


def test_where_nothing_congests_the_bound_is_an_open_perimeter(scenario):
    free = replace(scenario, demand=0.01 * scenario.demand, protected=())
    plan = bound.compute(free, "bound-pc", iterations=100)
    assert plan.perimeter[:8, 0, 1].min() > 0.85  # later intervals move vehicles that the horizon does not count
    uncontrolled = closed(free, NoControl(planning_model(free)))
    assert closed(free, plan) == pytest.approx(uncontrolled, rel=1e-3)


@pytest.mark.parametrize("name", bound.NAMES)
def test_plans_are_admissible_and_replayed_exactly(name):
    scenario = replace(with_demand(load_scenario(ECONOMIC), steps=40), folder=None)  # without its policies
    plan = bound.compute(scenario, name, iterations=20)
    network = scenario.network
    u = plan.perimeter[:, network.adjacency]
    assert u.min() >= network.u_min and u.max() <= network.u_max and (plan.perimeter[:, ~network.adjacency] == 0).all()
    if plan.splits is not None:
        assert (plan.splits[:, ~network.split_mask] == 0.0).all()
        np.testing.assert_allclose(plan.splits.sum(axis=2), [1.0 - np.eye(7)] * 40, rtol=0.0, atol=1e-12)
    assert closed(scenario, plan) == pytest.approx(plan.totals[plan.start], rel=1e-12)
    assert plan.totals[plan.start] == min(plan.totals.values())
    assert set(plan.totals) == {"open", "middle", "pi-gating"}


def test_the_bound_is_not_above_the_closed_loop_it_started_from(scenario):
    crowded = replace(scenario, demand=3.0 * scenario.demand)
    plan = bound.compute(crowded, "bound-pc", iterations=200)
    # A sigmoid never quite reaches the bounds of u.
    assert plan.totals[plan.start] <= (1.0 + 1e-4) * closed(crowded, PiGating(planning_model(crowded)))


def test_an_interrupted_descent_keeps_the_best_so_far(scenario):
    def interrupt(done, total, note):
        if done == 3:
            raise KeyboardInterrupt

    start = bound.neutral_starts(scenario.network, scenario.steps, guidance=False)
    short = bound.solve(scenario, start, guidance=False, iterations=50, progress=interrupt)
    first = bound.solve(scenario, start, guidance=False, iterations=1)
    assert all(short.totals[name] < first.totals[name] for name in start)


def test_a_plan_that_benchmark_replays(folder, tmp_path):
    text = api.bound(folder, "bound-pcrg", iterations=20)
    assert "(kept)" in text and "from pi-gating:" in text
    text = good(nmfd("benchmark", folder, "--controllers", "no-control,bound-pcrg", "--out", tmp_path / "out"))
    assert "above bound" in text and any(line.startswith("bound-pcrg ") for line in text.splitlines())


def test_wrong_names(scenario):
    with pytest.raises(InputError, match="'dpc-pc' is no bound; choose one of bound-pc, bound-pcrg"):
        bound.compute(scenario, "dpc-pc")


def test_files_that_do_not_fit(scenario, tmp_path):
    path, start = tmp_path / "p.npz", bound.neutral_starts(scenario.network, scenario.steps, guidance=False)
    open_loop.write(bound.solve(scenario, start, guidance=False, iterations=1), scenario, path)
    assert open_loop.read(path, replace(scenario, measurement_std=9.0), guidance=False).start in start
    with pytest.raises(InputError, match="another demand or network"):
        open_loop.read(path, replace(scenario, demand=2.0 * scenario.demand), guidance=False)
    with pytest.raises(InputError, match="is a plan of bound-pc"):
        open_loop.read(path, scenario, guidance=True)
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match="is no plan"):
        open_loop.read(path, scenario, guidance=False)
