"""Best plans: admissible, below closed loops. Lower bounds: relaxations that all trajectories meet.
The command."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from commands import good, nmfd

from nmfd import api
from nmfd.api import load_scenario
from nmfd.controllers import open_loop
from nmfd.errors import InputError
from nmfd.metrics import total_time_spent
from nmfd.model import dynamics
from nmfd.model.integration import SCHEMES
from nmfd.model.scenario import with_demand
from nmfd.studies import bound

ECONOMIC = "economic_mpc"


def closed(scenario, controller):
    return total_time_spent(api.run(scenario, controller))


@pytest.fixture
def free(scenario):
    """The scenario with hardly any demand, and the best plan for it."""
    empty = replace(scenario, demand=0.01 * scenario.demand, protected=())
    return empty, bound.compute(empty, "bound-pc", iterations=100)


def test_where_nothing_congests_the_bound_is_an_open_perimeter(free):
    empty, plan = free
    assert (
        plan.perimeter[:8, 0, 1].min() > 0.85
    )  # later intervals move vehicles that the horizon does not count
    uncontrolled = closed(empty, "no-control")
    assert closed(empty, plan) == pytest.approx(uncontrolled, rel=1e-3)


@pytest.mark.parametrize("name", bound.NAMES)
def test_plans_are_admissible_and_replayed_exactly(name):
    scenario = replace(
        with_demand(load_scenario(ECONOMIC), steps=40), folder=None
    )  # without its policies
    plan = bound.compute(scenario, name, iterations=20)
    network = scenario.network
    u = plan.perimeter[:, network.adjacency]
    assert u.min() >= network.u_min
    assert u.max() <= network.u_max
    assert (plan.perimeter[:, ~network.adjacency] == 0).all()
    if plan.splits is not None:
        assert (plan.splits[:, ~network.split_mask] == 0.0).all()
        np.testing.assert_allclose(
            plan.splits.sum(axis=2), [1.0 - np.eye(7)] * 40, rtol=0.0, atol=1e-12
        )
    assert closed(scenario, plan) == pytest.approx(plan.totals[plan.start], rel=1e-12)
    assert plan.totals[plan.start] == min(plan.totals.values())
    assert set(plan.totals) == {"open", "middle", "pi-gating"}


def test_the_bound_is_not_above_the_closed_loop_it_started_from(scenario):
    crowded = replace(scenario, demand=3.0 * scenario.demand)
    plan = bound.compute(crowded, "bound-pc", iterations=120)
    # A sigmoid never quite reaches the bounds of u.
    assert plan.totals[plan.start] <= (1.0 + 1e-4) * closed(crowded, "pi-gating")


def test_an_interrupted_descent_keeps_the_best_so_far(scenario):
    def interrupt(done, total, note):
        if done == 3:
            raise KeyboardInterrupt

    start = bound.neutral_starts(scenario.network, scenario.steps, guidance=False)
    short = bound.solve(scenario, start, guidance=False, iterations=50, progress=interrupt)
    first = bound.solve(scenario, start, guidance=False, iterations=1)
    assert all(short.totals[name] < first.totals[name] for name in start)


def test_a_plan_that_benchmark_replays(folder, out):
    text = api.bound_report(api.bound(folder, "bound-pcrg", iterations=20))
    assert "(kept)" in text
    assert "from pi-gating:" in text
    assert "the best plan is at most" in text
    text = good(nmfd("benchmark", folder, "--controllers no-control,bound-pcrg --out", out))
    assert "above the optimum" in text
    assert "≤ " in text
    assert any(line.startswith("bound-pcrg ") for line in text.splitlines())


def test_wrong_names(scenario):
    with pytest.raises(
        InputError, match="'dpc-pc' is no bound; choose one of bound-pc, bound-pcrg"
    ):
        bound.compute(scenario, "dpc-pc")


def test_files_that_do_not_fit(scenario, tmp_path):
    path = tmp_path / "p.npz"
    start = bound.neutral_starts(scenario.network, scenario.steps, guidance=False)
    open_loop.write(bound.solve(scenario, start, guidance=False, iterations=1), scenario, path)
    assert (
        open_loop.read(path, replace(scenario, measurement_std=9.0), guidance=False).start in start
    )
    with pytest.raises(InputError, match="another demand or network"):
        open_loop.read(path, replace(scenario, demand=2.0 * scenario.demand), guidance=False)
    with pytest.raises(InputError, match="is a plan of bound-pc"):
        open_loop.read(path, scenario, guidance=True)
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match="is no plan"):
        open_loop.read(path, scenario, guidance=False)


def unit_vector(lp, scenario, controls):
    """The variables of `lp` along the plant's trajectory under controls (T, R, R), (T, R, R, R),
    and its TTS."""
    p, x = dynamics.parameters(scenario.network), torch.from_numpy(scenario.start)
    weights, places = SCHEMES[scenario.integrator]
    here, onward, to = lp.turns.T
    states, outflows, transfers, spent = [], [], [], 0.0
    for k, (u, theta) in enumerate(zip(*map(torch.from_numpy, controls), strict=True)):
        spent += scenario.step * float(x.sum())
        for _ in range(scenario.substeps if k + 1 < scenario.steps else 1):
            total, slope = 0.0 * x, 0.0 * x
            for weight, place in zip(weights, places, strict=True):
                at = x + place * lp.step * slope
                slope = dynamics.derivative(p, at, torch.from_numpy(scenario.demand[k]), u, theta)[
                    0
                ]
                total = total + weight * slope
                leaving = dynamics.rate(p, at.sum(-1)).unsqueeze(-1) * at
                states.append(at.numpy()[*lp.pairs.T])
                outflows.append(
                    (leaving if p.exit_rates is None else leaving * p.exit_rates).numpy()[
                        *lp.pairs.T
                    ]
                )
                transfers.append(dynamics.flows(p, at, u, theta)[1].numpy()[here, onward, to])
                if k + 1 == scenario.steps:
                    break
            x = x + lp.step * total
    z = [np.ravel(states), lp.step * np.ravel(outflows), lp.step * np.ravel(transfers)]
    return np.concatenate(z) / lp.vehicles, spent


def random_controls(network, steps, random, *, guidance):
    shape = (steps, *network.adjacency.shape)
    u = np.where(network.adjacency, random.uniform(network.u_min, network.u_max, shape), 0.0)
    u = np.where(random.random(shape) < 0.3, np.where(network.adjacency, network.u_min, 0.0), u)
    if not guidance:
        return u, np.broadcast_to(network.nominal_splits, (steps, *network.split_mask.shape))
    theta = network.split_mask * random.exponential(size=(steps, *network.split_mask.shape)) ** 3
    return u, theta / np.maximum(theta.sum(axis=2, keepdims=True), 1e-300)


VARIANTS = ("euler", "substeps", "rk4", "exit rates", "capacity")


@pytest.mark.parametrize(
    "variant, guidance",
    [
        *((variant, False) for variant in VARIANTS),
        ("euler", True),
        *(pytest.param(variant, True, marks=pytest.mark.slow) for variant in VARIANTS[1:3]),
        *((variant, True) for variant in VARIANTS[3:]),
    ],
)
def test_every_trajectory_meets_the_relaxation(variant, guidance):
    """Random, neutral and greedy controls, into gridlock; and the optimum is below what they
    spend."""
    scenario = replace(with_demand(load_scenario(ECONOMIC), steps=12), initial=np.zeros((7, 7)))
    scenario.initial[3], scenario.initial[0] = 2500.0, 200.0
    network, random = scenario.network, np.random.default_rng(5)
    if variant == "exit rates":
        network = replace(network, exit_rates=random.uniform(0.5, 1.5, (7, 7)))
    if variant == "capacity":
        network = replace(network, capacity=1.5 * network.adjacency, storage=np.full(7, 9000.0))
    changes = {"substeps": {"substeps": 3}, "rk4": {"integrator": "rk4"}}.get(variant, {})
    scenario = replace(scenario, network=network, **changes)
    lp = bound.relaxation(scenario, guidance=guidance)
    bounded = bound.lower_bound(scenario, guidance=guidance)
    runs = list(bound.neutral_starts(network, 12, guidance=guidance).values())
    runs += [random_controls(network, 12, random, guidance=guidance) for _ in range(5)]
    for controls in runs:
        z, spent = unit_vector(lp, scenario, tuple(map(np.array, controls)))
        assert z.min() >= 0.0
        assert z.max() <= 1.0
        np.testing.assert_allclose(lp.equal @ z, lp.given, rtol=0.0, atol=1e-12)
        assert (lp.upper @ z - lp.most).max() <= 1e-12
        assert scenario.step * lp.vehicles * (lp.cost @ z) == pytest.approx(spent, rel=1e-12)
        assert bounded <= spent
    z[lp.cost > 0] *= 0.99  # vehicles that vanish
    assert abs(lp.equal @ z - lp.given).max() > 1e-6


def test_without_congestion_the_lower_bound_is_nearly_reached(free):
    empty, plan = free
    assert 0.97 * plan.totals[plan.start] < plan.lower <= plan.totals[plan.start]
    with pytest.raises(InputError, match="process_std: expected 0 for a lower bound, got 0.25"):
        bound.lower_bound(replace(empty, process_std=0.25), guidance=False)
