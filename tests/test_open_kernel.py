"""Examples of what a user brings: MFD, network, plant, policy, cost, constraint and days, each in at most 40 lines."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

import nmfd
from nmfd.controllers.dpc.rollout import Rollout
from nmfd.model.planning import planning_model


@dataclass(frozen=True, kw_only=True)
class Underwood(nmfd.Mfd):
    """An MFD of your own: speed falls exponentially, g = free n exp(-n / middle)."""

    free: float
    middle: float
    jam: float

    def rate_up_to_jam(self, accumulation, xp=np):
        return self.free * xp.exp(-accumulation / self.middle)


def ring(regions=4, peak=1.2):
    """A network and scenario of your own, from arrays: a ring with trips to the other side."""
    next_to = (
        np.eye(regions, k=1) + np.eye(regions, k=-1) + np.eye(regions, k=regions - 1) + np.eye(regions, k=1 - regions)
    )
    network = nmfd.RegionalModel(
        name="ring",
        region_names=tuple("ABCD"),
        positions=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        adjacency=next_to > 0,
        mfds=(Underwood(free=0.004, middle=300.0, jam=1000.0),) * 3
        + (nmfd.trapezoid(free=0.004, capacity=0.4, wave=0.001, jam=1000.0),),
        u_min=0.1,
        u_max=0.9,
    )
    demand = np.zeros((60, regions, regions))
    demand[:8, 0, 2] = peak
    others = {"protected": (3,), "controller_options": {"dpc-pcrg": {"learning_rate": 0.03}}}
    return nmfd.Scenario(name="ring", network=network, step=30.0, steps=60, demand=demand, **others)


class Gates(torch.nn.Module):
    """A policy of your own: one linear layer for gates and splits."""

    def __init__(self, network):
        super().__init__()
        self.regions, self.scale = network.regions, float(network.critical.mean())
        self.linear = torch.nn.Linear(self.regions**2, self.regions**2 + self.regions**3)
        self.box, self.simplex = nmfd.PerimeterLayer(network), nmfd.SplitsLayer(network)

    def forward(self, x):
        r, numbers = self.regions, self.linear(x.flatten(-2) / self.scale)
        return self.box(numbers[..., : r * r].unflatten(-1, (r, r))), self.simplex(
            numbers[..., r * r :].unflatten(-1, (r, r, r))
        )


class TripBased:
    """A plant of your own: a bathtub per region, where every vehicle drives the mean trip length at one speed."""

    def __init__(self, scenario):
        self.scenario = scenario

    def reset(self, seed):
        self.k, self.ended, self.groups = 0, 0.0, []  # i, j, share of the trip length that is left, vehicles
        return self.state()

    def step(self, controls):
        s, moved = self.scenario, []
        splits = s.network.nominal_splits if controls.splits is None else controls.splits
        speed = [mfd.rate(n) for mfd, n in zip(s.network.mfds, self.state().accumulation.sum(1), strict=True)]
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
        self.groups = moved + [(i, j, 1.0, demand[i, j]) for i, j in np.argwhere(demand > 0)]
        self.k += 1
        return self.state()

    def state(self):
        x = np.zeros(self.scenario.demand.shape[1:])
        for i, j, _, vehicles in self.groups:
            x[i, j] += vehicles
        return nmfd.State(step=self.k, time=30.0 * self.k, accumulation=x, backlog=0.0 * x, completed=self.ended)

    def observe(self):
        return None

    def close(self):
        pass


def burnt(run):
    """A cost of your own: fuel per second of a vehicle, idling plus a share of its speed, of each rollout."""
    speed = run.rate / run.rate.max()
    return (run.step * run.states.sum(-1) * (0.3 + 0.7 * speed**2)).sum((0, -1))


def crowded(run):
    """A constraint of your own, soft: vehicles in region B beyond 20."""
    return (run.states.sum(-1)[..., 1] - 20.0).clamp(min=0.0).mean(0)


def days(scenario, batch, generator):
    """Days of your own: one of two demands, by chance, from a nearly empty city."""
    usual = torch.tensor(scenario.demand, dtype=torch.float32)[:, None].expand(-1, batch, -1, -1)
    evening = torch.rand(batch, 1, 1, generator=generator) < 0.5
    start = 5.0 * torch.rand(batch, *usual.shape[2:], generator=generator)
    return start, torch.where(evening, usual.transpose(-1, -2), usual)


def test_a_network_and_mfd_of_ones_own_serve_plants_rules_and_mpc():
    scenario = ring()
    for controller in ("no-control", "pi-gating", "mpc-pc", "mpc-pcrg"):
        result = nmfd.run(scenario, controller, progress=False)
        entered = 30.0 * scenario.demand.sum()
        assert (
            result.completed[-1] + result.accumulation[-1].sum() == pytest.approx(entered) and result.completed[-1] > 50
        )
    acyclic = nmfd.run(scenario, "no-control", plant="acyclic", progress=False)
    free = nmfd.run(scenario, "no-control", progress=False)
    np.testing.assert_allclose(acyclic.accumulation, free.accumulation, atol=1e-6)
    changed = replace(
        scenario.network, mfds=(replace(scenario.network.mfds[0], free=0.005), *scenario.network.mfds[1:])
    )
    assert changed.hash != scenario.network.hash


def test_a_plant_of_ones_own():
    scenario = ring()
    result = nmfd.run(scenario, "pi-gating", plant=TripBased(scenario), progress=False)
    assert result.completed[-1] + result.accumulation[-1].sum() == pytest.approx(30.0 * scenario.demand.sum())
    assert result.completed[-1] > 50 and not result.completed[9]  # no trip ends before its length is driven


def test_a_policy_cost_constraint_and_days_of_ones_own():
    """Fuel falls by training; with the constraint most vehicles go round region B."""
    scenario, most = ring(), {}
    for weight in (0.0, 1e4):
        torch.manual_seed(0)
        gates = Gates(scenario.network)
        before = nmfd.run(scenario, nmfd.ModuleController(gates, scenario), progress=False)
        trained = nmfd.train(
            scenario,
            policy=gates,
            cost=burnt,
            sample=lambda generator, batch: days(scenario, batch, generator),
            constraints=[(crowded, weight)],
            steps=40,
            progress=False,
        )
        assert trained is gates and not trained.training
        after = nmfd.run(scenario, nmfd.ModuleController(trained, scenario), progress=False)
        most[weight] = after.accumulation[:, 1].sum(-1).max()
        assert nmfd.total_time_spent(after) < nmfd.total_time_spent(before)
    assert most[1e4] < 0.5 * most[0.0]


class Metered(Gates):
    def forward(self, x):
        return *super().forward(x), torch.full(x.shape[:-1], 0.5, dtype=x.dtype)


def test_training_drives_as_the_plant_does():
    """Rollouts without noise are the closed loop; the default cost is its total time spent, with those who wait."""
    scenario = ring()
    gates, rollout = Metered(scenario.network).double(), Rollout(planning_model(scenario), dtype=torch.float64)
    run = rollout.trajectories(gates, rollout.start[None], rollout.demand[:, None], torch.Generator())
    result = nmfd.run(scenario, nmfd.ModuleController(gates, scenario), progress=False)
    np.testing.assert_allclose(run.states[:, 0].detach(), result.accumulation[:-1], atol=1e-9)
    assert run.backlog.max() > 1.0 and run.total_time_spent.item() == pytest.approx(nmfd.total_time_spent(result))


@pytest.mark.parametrize(
    "given, message",
    [
        ({"policy": torch.nn.Identity()}, "Identity: interval 0: perimeter.*expected 0.1 to 0.9, got 0 instead"),
        ({"cost": burnt}, "cost, sample and constraints: train a module of your own; add policy=module"),
        ({"policy": None, "sample": days}, "add policy=module"),
        ({"out": "mine.pt"}, "policy: a module is returned, not written"),
        ({"sample": lambda generator, batch: (torch.zeros(batch, 4, 4),) * 2}, r"sample: expected start \(16, R, R\)"),
        ({"cost": lambda run: run.states.detach().sum()}, "cost: has no gradient"),
    ],
)
def test_wrong_parts_of_ones_own_are_one_line(given, message):
    scenario = ring()
    given = {"policy": Gates(scenario.network), **given} if given != {"cost": burnt} else given
    with pytest.raises(nmfd.InputError, match=message):
        nmfd.train(scenario, steps=1, progress=False, **given)
