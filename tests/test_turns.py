"""The regional model by its turns against nmfd.model.dynamics, its gradient against autograd;
projected gradients."""

import time
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import tiny
import torch

from nmfd.controllers.mpc import edge_model
from nmfd.controllers.mpc.controller import Admissible
from nmfd.controllers.mpc.projected_gradient import minimise
from nmfd.model import dynamics
from nmfd.model.regional_model import load_network

NETWORK = load_network("hexagon7")
LIMITED = tiny.limited(NETWORK)
BOTH = pytest.mark.parametrize("guidance", [False, True], ids=["pc", "pcrg"])
EVERY, SOME = np.arange(7), np.array([1, 2, 6])


def problem(model, *, moves=3, horizon=4, seed=0, guidance=True):
    """start (C,), demand (H, C) and an admissible plan; some regions are beyond the jam
    accumulation."""
    random, cells = np.random.default_rng(seed), len(model.region)
    plan = random.uniform(0.0, 1.0, (moves, len(model.edges) + len(model.turns)))
    return (
        random.uniform(0.0, 2e4 / len(model.destinations), cells),
        random.uniform(0.0, 3.0, (horizon, cells)),
        Admissible(NETWORK, model, guidance=guidance).project(plan),
    )


def by_dynamics(network, model, start, demand, plan, *, step, substeps, integrator):
    """The same sum by nmfd.model.dynamics, as a tensor that knows its gradient with respect to
    `plan`."""

    def cells(vector):
        full = torch.zeros(7, 7, dtype=torch.float64)
        full[:, model.destinations] = torch.from_numpy(vector.reshape(7, -1))
        return full

    p, x, total, edges = dynamics.parameters(network), cells(start), 0.0, len(model.edges)
    for k in range(len(demand)):
        row = plan[min(k, len(plan) - 1)]
        perimeter, splits = (
            torch.zeros((7,) * len(at.T), dtype=torch.float64).index_put(
                tuple(torch.from_numpy(at.T)), values
            )
            for at, values in ((model.edges, row[:edges]), (model.turns, row[edges:]))
        )
        x = dynamics.advance(
            p,
            x,
            cells(demand[k]),
            perimeter,
            splits,
            step,
            integrator=integrator,
            substeps=substeps,
        )
        total = total + x.sum()
    return total


@BOTH
@pytest.mark.parametrize(
    "network", [NETWORK, LIMITED, tiny.mixed(NETWORK)], ids=["published", "limited", "mixed"]
)
@pytest.mark.parametrize("used", [EVERY, SOME], ids=["every", "some"])
@pytest.mark.parametrize(
    "scheme",
    [
        {"step": 30.0, "substeps": 1, "integrator": "euler"},
        {"step": 90.0, "substeps": 3, "integrator": "euler"},
        {"step": 60.0, "substeps": 2, "integrator": "rk4"},
    ],
)
def test_the_twin_of_dynamics_and_its_gradient(scheme, used, network, guidance):
    model = edge_model.build(network, used, guidance=guidance, **scheme)
    start, demand, plan = problem(model, guidance=guidance)
    tensor = torch.tensor(plan, requires_grad=True)
    expected = by_dynamics(network, model, start, demand, tensor, **scheme)
    expected.backward()
    value, gradient = edge_model.vehicle_steps(model, start, demand, plan, gradient=True)
    assert value == pytest.approx(expected.item(), rel=1e-12)
    np.testing.assert_allclose(
        gradient, tensor.grad.numpy(), rtol=1e-9, atol=1e-9 * np.abs(gradient).max()
    )


def test_the_gradient_of_the_rounded_kink():
    """Central differences where a region crosses its jam accumulation."""
    model = replace(edge_model.build(NETWORK, EVERY, guidance=True, step=30.0), rounding=50.0)
    start, demand, plan = problem(model)
    start *= 10_000.0 / start[:7].sum()
    _, gradient = edge_model.vehicle_steps(model, start, demand, plan, gradient=True)
    random = np.random.default_rng(1)
    for _ in range(5):
        way = random.standard_normal(plan.shape)
        ahead, behind = (
            edge_model.vehicle_steps(model, start, demand, plan + s * way)[0] for s in (1e-5, -1e-5)
        )
        assert (ahead - behind) / 2e-5 == pytest.approx((gradient * way).sum(), rel=1e-5)


def test_vehicles_at_stake():
    model = edge_model.build(NETWORK, SOME, guidance=True, step=30.0)
    start, demand, plan = problem(model, moves=1, horizon=1)
    stake = edge_model.affected_vehicles(model, start, demand, plan)[0]
    q = edge_model.rate(model, start.reshape(7, -1).sum(axis=1))[0]
    leaving = 30.0 * q[model.region] * start
    edges = len(model.edges)
    np.testing.assert_allclose(stake[edges:], leaving[model.source])
    # Every vehicle that is not at its destination wants to cross one boundary.
    assert stake[:edges].sum() == pytest.approx(leaving[~model.ends].sum())


@BOTH
def test_projection_is_admissible_nearest_and_idempotent(guidance):
    model = edge_model.build(NETWORK, EVERY, guidance=guidance, step=30.0)
    admissible, random = Admissible(NETWORK, model, guidance=guidance), np.random.default_rng(0)
    edges = len(model.edges)
    for spread in (0.1, 3.0, 1e6):
        far = spread * random.standard_normal((2, edges + len(model.turns)))
        near = admissible.project(far)
        assert NETWORK.u_min <= near[:, :edges].min()
        assert near[:, :edges].max() <= NETWORK.u_max
        assert near[:, edges:].min() >= 0.0
        for row in near[:, edges:]:
            np.testing.assert_allclose(np.bincount(model.source, row)[model.source], 1.0, atol=1e-9)
        np.testing.assert_allclose(admissible.project(near), near, atol=1e-12)
        # Variational inequality: no admissible point lies on the far side of the nearest one.
        for _ in range(20):
            other = admissible.project(random.uniform(0.0, 1.0, far.shape))
            if not guidance:
                far[:, edges:] = near[:, edges:]
            assert ((far - near) * (other - near)).sum() <= 1e-9 * spread


@BOTH
def test_the_gap_is_what_the_best_plan_saves(guidance):
    model = edge_model.build(NETWORK, EVERY, guidance=guidance, step=30.0)
    admissible, random = Admissible(NETWORK, model, guidance=guidance), np.random.default_rng(0)
    plan = admissible.project(random.uniform(0.0, 1.0, (2, len(model.edges) + len(model.turns))))
    gradient = random.standard_normal(plan.shape)
    best = admissible.project(plan - 1e6 * gradient)  # far enough: a vertex
    assert admissible.gap(plan, gradient) == pytest.approx(
        (gradient * (plan - best)).sum(), rel=1e-6
    )
    assert admissible.gap(best, gradient) == pytest.approx(0.0, abs=1e-3)


def quadratic(curvature, centre):
    def function(x):
        return 1.0 + float((curvature * (x - centre) ** 2).sum()), 2.0 * curvature * (x - centre)

    return function


def in_box(x):
    return np.clip(x, 0.0, 1.0)


def box_gap(x, gradient):
    return float((gradient * (x - (gradient < 0))).sum())


def test_minimise_a_quadratic_in_a_box():
    curvature, centre = 10.0 ** np.linspace(-2, 2, 30), np.linspace(-1.0, 2.0, 30)
    limits = {"tolerance": 1e-10, "iterations": 1000, "seconds": 10.0}
    for metric, most in ((1.0, 1000), (curvature, 5)):  # the exact metric makes it one step
        function = Mock(side_effect=quadratic(curvature, centre))
        found = minimise(function, in_box, box_gap, np.full(30, 0.5), metric=metric, **limits)
        assert found.reason is None
        assert function.call_count <= most
        np.testing.assert_allclose(found.point, in_box(centre), atol=1e-3)


def test_minimise_says_why_it_stopped():
    def search(function, **limits):
        limits = {"iterations": 100, "seconds": 10.0, **limits}
        return minimise(function, in_box, box_gap, np.array([0.0, 0.0]), tolerance=1e-12, **limits)

    hard = quadratic(np.array([1.0, 1e4]), np.array([0.5, 0.5]))
    assert search(hard, iterations=1).reason == "iteration limit"
    assert search(hard, seconds=0.0).reason == "time limit"
    assert search(lambda x: (np.nan, x)).reason == "not a number"

    # Rising from everywhere: the line search would go on for long.
    rising = Mock(side_effect=lambda x: time.sleep(0.01) or (float((x != 0.0).any()), -np.ones(2)))
    search(rising, seconds=0.025)
    assert rising.call_count <= 3
    wrong = search(lambda x: (1.0 + x.sum(), -np.ones(2)))
    assert wrong.reason == "no further descent"
    assert (wrong.point == 0.0).all()
