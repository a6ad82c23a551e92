"""The physics of the regional model, and its torch and CasADi twins against each other."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import tiny
import torch
from tiny import random_controls

from nmfd.controllers.mpc import ipopt
from nmfd.model import dynamics
from nmfd.model.integration import SCHEMES
from nmfd.model.mfd import Cubic
from nmfd.model.regional_model import LEAST_ROOM, load_network

STEP = 30.0
NETWORK = load_network("hexagon7")
PARAMETERS = dynamics.parameters(NETWORK)
LIMITED = tiny.limited(NETWORK)
KINDS = pytest.mark.parametrize(
    "network", [NETWORK, LIMITED, tiny.mixed(NETWORK)], ids=["published", "limited", "mixed"]
)


def random_tensors(seed, *, filling, batch=()):
    """State, demand, perimeter, splits; regions hold up to `filling` [veh]."""
    random = np.random.default_rng(seed)
    x = random.uniform(size=(*batch, 7, 7)) * random.uniform(0.0, filling / 3.5, (*batch, 7, 1))
    demand = random.uniform(0.0, 3.0, (*batch, 7, 7))
    return tuple(
        torch.from_numpy(array) for array in (x, demand, *random_controls(random, NETWORK, batch))
    )


@KINDS
@pytest.mark.parametrize("integrator", SCHEMES)
def test_no_vehicle_is_negative_or_lost_inside(integrator, network):
    """Without trips that end, the vehicles only move: their number grows by the demand exactly."""
    p = dynamics.parameters(network)
    x, demand, perimeter, splits = random_tensors(1, filling=25_000.0, batch=(40,))
    off = PARAMETERS.off_diagonal
    x, demand = x * off, demand * off
    # A split that never delivers: nobody is sent to a region that is their destination.
    splits = splits * (1.0 - torch.eye(7, dtype=torch.float64))
    total = x.sum((-2, -1))
    for _ in range(60):
        x = dynamics.advance(p, x, demand, perimeter, splits, STEP, integrator=integrator)
        total = total + STEP * demand.sum((-2, -1))
        assert x.min() >= 0.0
        torch.testing.assert_close(x.sum((-2, -1)), total, rtol=0.0, atol=1e-6)


def test_vehicles_leave_as_their_trips_end():
    x, demand, perimeter, splits = random_tensors(2, filling=25_000.0, batch=(40,))
    completions, _ = dynamics.flows(PARAMETERS, x, perimeter, splits)
    after = dynamics.advance(PARAMETERS, x, demand, perimeter, splits, STEP)
    expected = x.sum((-2, -1)) + STEP * (demand.sum((-2, -1)) - completions.sum(-1))
    torch.testing.assert_close(after.sum((-2, -1)), expected, rtol=0.0, atol=1e-9)


@KINDS
def test_who_is_where_he_wants_to_be_is_not_sent_on(network):
    """Whatever the splits say of those who have arrived."""
    x, _, perimeter, splits = random_tensors(10, filling=6000.0)
    p, here = dynamics.parameters(network), torch.arange(7)
    _, transfers = dynamics.flows(p, x, perimeter, torch.ones_like(splits))
    assert (transfers[here, :, here] == 0.0).all()
    assert (transfers > 0.0).any()


def test_one_region_with_a_linear_mfd_decays_exponentially():
    mfds = (Cubic(a=0.0, b=0.0, c=0.0042, jam=10_000.0),)
    adjacency = np.zeros((1, 1), dtype=bool)
    p = dynamics.parameters(
        replace(NETWORK, region_names=("only",), adjacency=adjacency, mfds=mfds)
    )
    none = torch.zeros(1, 1, dtype=torch.float64)
    x = dynamics.advance(
        p, none + 5000.0, none, none, none[None], 600.0, integrator="rk4", substeps=600
    )
    assert x.item() == pytest.approx(5000.0 * np.exp(-0.0042 * 600.0), rel=1e-8)


@pytest.mark.parametrize(
    "order", [[6, 5, 4, 3, 2, 1, 0], [1, 0, 4, 3, 2, 6, 5]], ids=["turned", "mirrored"]
)
def test_a_turned_or_mirrored_hexagon_is_the_same_hexagon(order):
    x, demand, perimeter, splits = random_tensors(3, filling=20_000.0)
    assert (NETWORK.adjacency[order][:, order] == NETWORK.adjacency).all()
    plain = dynamics.advance(PARAMETERS, x, demand, perimeter, splits, STEP, substeps=3)
    inputs = [matrix[order][:, order] for matrix in (x, demand, perimeter)]
    turned = dynamics.advance(
        PARAMETERS, *inputs, splits[order][:, order][:, :, order], STEP, substeps=3
    )
    torch.testing.assert_close(turned, plain[order][:, order], rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("integrator, order", [("euler", 1), ("rk4", 4)])
def test_order_of_convergence(integrator, order):
    """Below the jam: at its kink the right-hand side is not smooth, and no scheme keeps its
    order."""
    x, demand, *controls = random_tensors(4, filling=6000.0)
    state = x, 0.05 * demand, *controls
    exact = dynamics.advance(PARAMETERS, *state, 1200.0, integrator="rk4", substeps=1000)
    error = [
        (dynamics.advance(PARAMETERS, *state, 1200.0, integrator=integrator, substeps=n) - exact)
        .abs()
        .max()
        .item()
        for n in (10, 20)
    ]
    assert np.log2(error[0] / error[1]) == pytest.approx(order, abs=0.3)


@KINDS
@pytest.mark.parametrize("filling", [3000.0, 30_000.0], ids=["free", "jammed"])
@pytest.mark.parametrize("integrator", SCHEMES)
def test_gradients_against_finite_differences(integrator, filling, network):
    """In vehicles by the thousand, so that one step of differences suits states and controls."""
    x, demand, perimeter, splits = random_tensors(5, filling=filling)
    inputs = tuple(
        tensor.clone().requires_grad_() for tensor in (x / 1000.0, demand, perimeter, splits)
    )

    def advanced(x, *others):
        return (
            dynamics.advance(
                dynamics.parameters(network), 1000.0 * x, *others, STEP, integrator=integrator
            )
            / 1000.0
        )

    assert torch.autograd.gradcheck(advanced, inputs, fast_mode=True)


@KINDS
@pytest.mark.parametrize(
    "integrator, substeps",
    [("euler", 1), ("euler", 3), ("rk4", 1), pytest.param("rk4", 3, marks=pytest.mark.slow)],
)
def test_torch_and_casadi_agree(integrator, substeps, network):
    """Over a rollout into the jam and beyond, with new controls in every interval."""
    random = np.random.default_rng(6)
    p = ipopt.parameters(network)
    x = torch.zeros(7, 7, dtype=torch.float64)
    twin = ca.DM(7, 7)
    most = 0.0
    for _ in range(50):
        demand = random.uniform(0.0, 5.0, (7, 7))
        perimeter, splits = random_controls(random, NETWORK)
        scheme = {"step": STEP, "integrator": integrator, "substeps": substeps}
        inputs = (torch.from_numpy(array) for array in (demand, perimeter, splits))
        x = dynamics.advance(dynamics.parameters(network), x, *inputs, **scheme)
        inputs = ca.DM(demand), ca.DM(perimeter), [ca.sparsify(ca.DM(rows)) for rows in splits]
        twin = ipopt.advance(p, twin, *inputs, **scheme)
        most = max(most, x.sum(-1).max().item())
        np.testing.assert_allclose(twin.full(), x.numpy(), rtol=0.0, atol=1e-9)
    assert most > 1.5 * NETWORK.mfds[0].jam


@KINDS
def test_both_rates_are_those_of_the_mfd(network):
    accumulation = np.linspace(0.0, 20_000.0, 7)
    expected = [mfd.rate(n) for mfd, n in zip(network.mfds, accumulation, strict=True)]
    torch_rate = dynamics.rate(dynamics.parameters(network), torch.from_numpy(accumulation)).numpy()
    casadi_rate = ipopt.rate(ipopt.parameters(network), ca.DM(accumulation)).full().ravel()
    np.testing.assert_allclose(torch_rate, expected, rtol=1e-13)
    np.testing.assert_allclose(casadi_rate, expected, rtol=1e-13)


def test_a_boundary_passes_the_smaller_of_wish_and_limit():
    """Far from each other the smooth minimum is the smaller one; a region that is full takes next
    to nobody."""
    p = dynamics.parameters(LIMITED)
    perimeter, empty = torch.tensor(0.5 * NETWORK.adjacency), torch.zeros(7, dtype=torch.float64)
    limit = perimeter * p.capacity
    few = dynamics.passing(p, 0.1 * limit, perimeter, empty)
    many = dynamics.passing(p, 10.0 * limit, perimeter, empty) * 10.0 * limit
    used = torch.tensor(NETWORK.adjacency)
    torch.testing.assert_close(few[used], torch.ones_like(few[used]), rtol=1e-4, atol=0.0)
    torch.testing.assert_close(many[used], limit[used], rtol=1e-4, atol=0.0)
    full = dynamics.passing(p, 10.0 * limit, perimeter, 2.0 * p.storage) * 10.0 * limit
    torch.testing.assert_close(full[used], LEAST_ROOM * limit[used], rtol=1e-3, atol=0.0)


def test_exit_rates_scale_what_leaves():
    """By kind of trip: an exit rate of two is a trip half as long."""
    x, _, perimeter, splits = random_tensors(7, filling=6000.0)
    rates = np.random.default_rng(8).uniform(0.5, 2.0, (7, 7))
    plain = dynamics.flows(PARAMETERS, x, perimeter, splits)
    scaled = dynamics.flows(
        dynamics.parameters(replace(NETWORK, exit_rates=rates)), x, perimeter, splits
    )
    torch.testing.assert_close(scaled[0], plain[0] * torch.from_numpy(rates.diagonal().copy()))
    torch.testing.assert_close(scaled[1], plain[1] * torch.from_numpy(rates)[:, None, :])


def test_ways_in_use_take_the_same_time_in_free_flow():
    """From 0 to 2 straight, or by 1: of four rates only the mean time to 2 is left to the ways."""
    network = replace(
        load_network("two_regions"),
        region_names=("0", "1", "2"),
        positions=np.zeros((3, 2)),
        adjacency=~np.eye(3, dtype=bool),
        mfds=(NETWORK.mfds[0],) * 3,
        observed_split_ratios={(0, 2): {1: 0.5, 2: 0.5}},
        exit_rates=np.array([[1.0, 2.0, 1.0], [1.0, 1.0, 2.0], [1.0, 1.0, 1.0]]),
        equal_ways=True,
    )
    # Times in units of 1 / q: 1 in region 0 on the way to 2, and 0.5 more in region 1 for half.
    detours = network.detours
    assert detours is not None
    assert detours[0, :, 2] == pytest.approx([0.0, -0.25, 0.25])
    p = dynamics.parameters(network)
    x = torch.zeros(3, 3, dtype=torch.float64)
    x[0, 2] = 1.0
    splits = torch.tensor(network.nominal_splits)
    perimeter = torch.tensor(network.open_perimeter) / network.u_max
    q = dynamics.rate(p, x.sum(-1))[0]
    for share, time in ((0.5, 1.0), (0.0, 1.25), (1.0, 0.75)):
        splits[0, :, 2] = torch.tensor([0.0, share, 1.0 - share])
        _, transfers = dynamics.flows(p, x, perimeter, splits)
        assert float(transfers.sum()) == pytest.approx(float(q) / time)


@pytest.mark.parametrize("integrator", SCHEMES)
def test_an_interval_that_counts_is_the_same_interval(integrator):
    """And what it counts is what is missing at its end."""
    x, demand, perimeter, splits = random_tensors(9, filling=6000.0)
    options = {"integrator": integrator, "substeps": 2}
    plain = dynamics.advance(PARAMETERS, x, demand, perimeter, splits, STEP, **options)
    after, ended = dynamics.advance_counted(
        PARAMETERS, x, demand, perimeter, splits, STEP, **options
    )
    torch.testing.assert_close(after, plain, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(ended, (x + STEP * demand - after).sum(), rtol=1e-9, atol=0.0)


def test_metering_admits_in_proportion_and_keeps_the_rest_waiting():
    """Two regions: 30 vehicles wait and 1 veh/s comes, in the first, where 1 veh/s may depart."""
    backlog = torch.tensor([[10.0, 20.0], [0.0, 0.0]])
    demand = torch.tensor([[0.0, 1.0], [0.2, 0.0]])
    admitted, waiting = dynamics.admitted(backlog, demand, torch.tensor([1.0, 1.0]), 20.0)
    torch.testing.assert_close(admitted, torch.tensor([[0.2, 0.8], [0.2, 0.0]]))
    torch.testing.assert_close(waiting, torch.tensor([[6.0, 24.0], [0.0, 0.0]]))
    admitted, waiting = dynamics.admitted(backlog, demand, None, 20.0)
    torch.testing.assert_close(admitted, torch.tensor([[0.5, 2.0], [0.2, 0.0]]))
    assert not waiting.any()
