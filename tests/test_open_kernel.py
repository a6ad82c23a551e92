"""Examples of what a user brings: network, plant, policy, cost, constraint and days;
tiny.Exponential is an MFD."""

import numpy as np
import pytest
import torch
from tiny import Exponential

import nmfd
from nmfd.controllers.dpc.policy_file import load_policy
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.model.planning import planning_model


def ring():
    """A network and scenario from arrays: four regions in a ring, trips to the other side, two
    kinds of MFDs."""
    beside = np.eye(4, k=1) + np.eye(4, k=-1) + np.eye(4, k=3) + np.eye(4, k=-3) > 0
    wide = Exponential(free=0.004, middle=300.0, jam=1000.0)
    network = nmfd.RegionalModel(
        name="ring",
        region_names=tuple("ABCD"),
        positions=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        adjacency=beside,
        mfds=(wide, wide, wide, nmfd.trapezoid(free=0.004, capacity=0.4, wave=0.001, jam=1000.0)),
        u_min=0.1,
        u_max=0.9,
    )
    demand = np.zeros((60, 4, 4))
    demand[:8, 0, 2] = 1.2
    options = {"dpc-pcrg": {"learning_rate": 0.03}}
    given = {"demand": demand, "protected": (3,), "controller_options": options}
    return nmfd.Scenario(name="ring", network=network, step=30.0, steps=60, **given)


class Linear(torch.nn.Module):
    """A policy: one layer for gates and splits, and at most half a vehicle per second into each
    region."""

    def __init__(self, network):
        super().__init__()
        r, self.scale = network.regions, float(network.critical.mean())
        self.gates, self.turns = torch.nn.Linear(r * r, r * r), torch.nn.Linear(r * r, r**3)
        self.box, self.simplex = nmfd.PerimeterLayer(network), nmfd.SplitsLayer(network)

    def forward(self, x):
        r, x = x.shape[-1], x.flatten(-2) / self.scale
        return self.box(self.gates(x).unflatten(-1, (r, r))), self.simplex(
            self.turns(x).unflatten(-1, (r, r, r))
        )

    def metering(self, x):
        return torch.full_like(x[..., 0], 0.5)


class TripBased:
    """A plant: a bathtub per region, where every vehicle drives the mean trip length at one
    speed."""

    def __init__(self, scenario):
        self.scenario = scenario

    def reset(self, seed):
        self.k = 0
        self.ended = 0.0
        self.groups = []  # i, j, share of the trip length that is left, vehicles
        return self.state()

    def step(self, controls):
        s, moved = self.scenario, []
        splits = s.network.nominal_splits if controls.splits is None else controls.splits
        speed = [
            mfd.rate(n)
            for mfd, n in zip(s.network.mfds, self.state().accumulation.sum(1), strict=True)
        ]
        for i, j, left, vehicles in self.groups:
            left -= s.step * speed[i]
            if left <= 0.0 and i == j:
                self.ended += vehicles
            elif left <= 0.0:
                going = vehicles * controls.perimeter[i] * splits[i, :, j]
                moved += [(h, j, 1.0, going[h]) for h in np.flatnonzero(going)]
                moved.append((i, j, 0.0, vehicles - going.sum()))
            else:
                moved.append((i, j, left, vehicles))
        demand = s.step * s.demand[self.k]
        self.k += 1
        self.groups = moved + [(i, j, 1.0, demand[i, j]) for i, j in np.argwhere(demand > 0)]
        return self.state()

    def state(self):
        x = np.zeros((4, 4))
        for i, j, _, vehicles in self.groups:
            x[i, j] += vehicles
        return nmfd.State(
            step=self.k, time=30.0 * self.k, accumulation=x, backlog=0.0 * x, completed=self.ended
        )

    def observe(self):
        return None


def burnt(run):
    """A cost: fuel, that of idling and more with the square of the speed."""
    return (run.step * run.states.sum(-1) * (0.3 + 0.7 * (run.rate / run.rate.max()) ** 2)).sum(
        (0, -1)
    )


def crowded(run):
    """A soft constraint: vehicles in region B beyond 20."""
    return (run.states.sum(-1)[..., 1] - 20.0).clamp(min=0.0).mean(0)


def days(generator, batch):
    """Days: the demand there or back, by chance, from a nearly empty city."""
    there = torch.tensor(ring().demand).unsqueeze(1).expand(-1, batch, -1, -1)
    back = torch.rand(batch, 1, 1, generator=generator) < 0.5
    return 5.0 * torch.rand(batch, 4, 4, generator=generator), torch.where(back, there.mT, there)


@pytest.mark.parametrize(
    "controller", ["pi-gating", "mpc-pc", pytest.param("mpc-pcrg", marks=pytest.mark.slow)]
)
def test_a_network_and_mfd_serve_plants_rules_and_mpc(controller):
    for plant in ("nmfd", "acyclic", TripBased(ring())):
        result = nmfd.run(ring(), controller, plant=plant)
        assert result["completed"][-1] + result["accumulation"][-1].sum() == pytest.approx(
            30.0 * ring().demand.sum()
        )
        assert result["completed"][-1] > 50
        assert (result["status"] == 0).all()
    assert not result["completed"][:10].any()  # no trip ends before its length is driven


@pytest.mark.slow
def test_a_policy_cost_constraint_and_days():
    """Training saves fuel; with the constraint most vehicles go round region B."""
    scenario, most = ring(), {}
    for weight in (0.0, 1e4):
        torch.manual_seed(0)
        policy = Linear(scenario.network)
        before = nmfd.run(scenario, nmfd.ModuleController(policy, scenario))
        own = {"cost": burnt, "sample": days, "constraints": [(crowded, weight)]}
        trained = nmfd.train(scenario, policy=policy, **own, steps=15)
        after = nmfd.run(scenario, nmfd.ModuleController(trained, scenario))
        most[weight] = after["accumulation"][:, 1].sum(-1).max()
        assert trained is policy
        assert nmfd.total_time_spent(after) < nmfd.total_time_spent(before)
    assert most[1e4] < 0.6 * most[0.0]


def test_rollouts_are_the_closed_loop():
    policy = Linear(ring().network).double()
    rollout = Rollout(planning_model(ring()), dtype=torch.float64)
    run = rollout.trajectories(
        policy, rollout.start[None], rollout.demand[:, None], torch.Generator()
    )
    result = nmfd.run(ring(), nmfd.ModuleController(policy, ring()))
    np.testing.assert_allclose(run.states[:, 0].detach(), result["accumulation"][:-1], atol=1e-9)
    np.testing.assert_allclose(run.perimeter[:, 0].detach(), result["perimeter"], atol=1e-9)
    assert run.backlog.max() > 1.0
    assert run.total_time_spent.item() == pytest.approx(nmfd.total_time_spent(result))


class Plan(torch.nn.Linear):
    """A policy: float64 gates that no state changes."""

    def forward(self, x):
        return [0.9 - 0.8 * torch.sigmoid(self.weight), None]


def test_a_policy_may_ignore_the_state():
    plan = Plan(4, 4).double()
    before = plan.weight.detach().clone()
    nmfd.train(
        ring(),
        policy=plan,
        cost=lambda run: run.perimeter.mean((0, 2, 3)),
        steps=40,
    )
    assert (plan.weight > before + 0.5).all()


def test_a_named_policy_takes_a_cost_too(tmp_path):
    file = nmfd.train(ring(), cost=burnt, out=tmp_path / "mine.pt", steps=1)
    assert load_policy(file, ring().network)[1]["configuration"]["task"] == "burnt"


@pytest.mark.parametrize(
    "given, message",
    [
        (
            {"policy": torch.nn.LayerNorm(4)},
            "LayerNorm: interval 0: perimeter.*expected 0.1 to 0.9, got 0 instead",
        ),
        ({"policy": torch.nn.Identity()}, "policy: expected an nn.Module with weights to train"),
        ({"cost": "time"}, "cost, sample: expected functions, got 'time'"),
        ({"out": "mine.pt"}, "policy: a module is returned, not written"),
        (
            {"sample": lambda generator, batch: (torch.zeros(batch, 4, 4),) * 2},
            r"sample: expected start \(16, R, R\)",
        ),
        ({"cost": lambda run: run.states.detach().sum()}, "cost: has no gradient"),
        (
            {"cost": lambda run: run.total_time_spent / 0 * 0},
            "lambda>: in step 0 the cost is nan and .* own functions",
        ),
        (
            {"cost": lambda run: (0 * run.perimeter).sqrt()},
            "the cost is 0 and the norm of its gradient nan; look for",
        ),
        (
            {"constraints": [crowded]},
            r"constraints: expected pairs \(function, weight\), got <function crowded",
        ),
    ],
)
def test_wrong_parts_are_one_line(given, message, unchecked):
    with pytest.raises(nmfd.InputError, match=message):
        nmfd.train(ring(), steps=1, **{"policy": Linear(ring().network), **given})
