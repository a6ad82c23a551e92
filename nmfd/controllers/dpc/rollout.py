"""Batched rollouts of the regional model under a policy, as tensors: the objective of training."""

import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, nn

from nmfd.controllers.dpc.policy import commanded
from nmfd.model import dynamics
from nmfd.model.planning import PlanningModel
from nmfd.model.scenario import pairs_with_demand
from nmfd.tensors import PerPair, PerRegion, PerTurn

States = Float[torch.Tensor, "B R R"]
Demands = Float[torch.Tensor, "T B R R"]  # or states over time
Levels = Float[torch.Tensor, " B"]


@dataclass(frozen=True, kw_only=True)
class Trajectories:
    """B rollouts of T control intervals of `step` (s), of which costs and constraints are
    functions.

    states, backlog: in region i, and waiting to enter it, at the beginning of each interval (veh,
        (T, B, R, R))
    demand: (veh/s, (T, B, R, R)); rate: outflow per vehicle q_i (1/s, (T, B, R)), in proportion to
        the mean speed
    perimeter, splits: (-, (T, B, R, R)), (-, (T, B, R, R, R)) in these states
    """

    step: float
    states: Demands
    backlog: Demands
    demand: Demands
    rate: Float[torch.Tensor, "T B R"]
    perimeter: Float[torch.Tensor, "T B R R"]
    splits: Float[torch.Tensor, "T B R R R"]

    @property
    def total_time_spent(self) -> Levels:
        """Total time spent (veh s, (B,))."""
        return self.step * (self.states + self.backlog).sum((0, -2, -1))


class Rollout:
    """Regional model of a scenario as tensors; random numbers are drawn on the CPU, so that devices
    agree."""

    def __init__(
        self,
        planning: PlanningModel,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
        *,
        detour_cost: float = 0.0,
        holding_cost: float = 0.0,
        process_std: float = 0.0,
    ):
        """detour_cost: time lost by a vehicle that is guided off the nominal split ratios (s)

        holding_cost: time lost by a vehicle that a gate holds (s)
        process_std: as of a scenario (veh)
        """

        def tensor(values: Any) -> torch.Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        network = planning.network
        self.detour_cost, self.holding_cost, self.process_std = (
            detour_cost,
            holding_cost,
            process_std,
        )
        self.planning, self.dtype, self.device = planning, dtype, torch.device(device)
        self.parameters = self._nominal = dynamics.parameters(network, dtype=dtype, device=device)
        self.demand = tensor(planning.forecast)
        self.nominal_splits = tensor(network.nominal_splits)
        self.bound = tensor(planning.destinations)
        self.start = (
            torch.zeros_like(self.demand[0])
            if planning.initial is None
            else tensor(planning.initial)
        )

    def random_start(
        self,
        batch: int,
        spread: float,
        share: float,
        generator: Generator,
        levels: tuple[float, float] = (1.0, 1.0),
    ) -> tuple[States, Demands]:
        """Return initial states (veh, (B, R, R)) and demands (veh/s, (T, B, R, R)).

        spread: every flow is scaled by a factor from 1 - spread to 1 + spread
        share: of the rollouts that start at a random time from a random state, with regions filled
            to at most 80 % of the jam accumulation; the others start as the scenario
        levels: range of one factor of all demand, per rollout
        """

        def uniform(*shape: int) -> torch.Tensor:
            return torch.rand(*shape, generator=generator, dtype=self.dtype).to(self.device)

        steps, regions = self.demand.shape[:2]
        rollout = torch.arange(batch, device=self.device)
        factor = 1.0 + spread * (2.0 * uniform(batch, regions, regions) - 1.0)
        shift = (uniform(batch) * steps * 0.5).long() * (rollout < share * batch)
        index = torch.arange(steps, device=self.device)[:, None] + shift
        padded = torch.cat([self.demand, torch.zeros_like(self.demand)])
        demand = padded[index] * factor
        weight = uniform(batch, regions, regions) ** 2 * self.bound
        total = uniform(batch, regions) * uniform(batch, 1) * 0.8 * self._nominal.mfd.jam
        x = total.unsqueeze(-1) * weight / weight.sum(-1, keepdim=True).clamp(min=1e-6)
        if levels[0] < levels[1]:
            demand = demand * (levels[0] + (levels[1] - levels[0]) * uniform(batch, 1, 1))
        return torch.where((rollout < share * batch)[:, None, None], x, self.start), demand

    def draw_model(
        self, batch: int, spread: float, generator: Generator, scale: float = 1.0
    ) -> None:
        """Draw a regional model for each of `batch` rollouts, around the nominal one.

        spread: standard deviation of the logarithm of every region's accumulation axis (jam,
            critical accumulation, storage), and half of that for its outflow and capacities (-)
        scale: factor of all accumulation axes (-)
        """
        p, regions = self._nominal, len(self._nominal.adjacency)
        if spread or scale != 1.0:

            def factor(*shape: int, share: float = 1.0) -> torch.Tensor:
                normal = torch.randn(batch, *shape, generator=generator, dtype=self.dtype).to(
                    self.device
                )
                return torch.exp(share * spread * normal.clamp(-2.0, 2.0))

            wide, high = scale * factor(regions), factor(regions, share=0.5)
            # No rate rises above the largest that the integration step was checked for.
            free = p.mfd.rate_up_to_jam(torch.zeros_like(p.mfd.jam), torch)
            fastest = free if p.exit_rates is None else free * p.exit_rates.amax(-1)
            high = high.clamp(max=1.0 / (fastest * self.planning.step / self.planning.substeps))
            p = replace(
                p,
                mfd=p.mfd.scaled(wide, high),
                capacity=None
                if p.capacity is None
                else p.capacity * factor(regions, regions, share=0.5),
                storage=None if p.storage is None else p.storage * wide,
            )
        self.parameters = p

    def perturb(
        self, demand: Demands, level: Levels, noise: float, generator: Generator
    ) -> Demands:
        """Add Gaussian noise of sigma `level` (B,) times `noise` to the pairs with demand, clipped
        at zero.

        demand: (T, B, R, R) [veh/s]
        """
        if not noise:
            return demand
        sigma = (
            level[:, None, None] * noise * torch.tensor(pairs_with_demand(self.planning.forecast))
        )
        normal = torch.randn(demand.shape, generator=generator, dtype=self.dtype)
        return (demand + (normal * sigma).to(self.device)).clamp(min=0.0)

    def step(self, policy: nn.Module, x: States, demand: States, noise: States) -> States:
        """Return the state one control interval after x (veh, (B, R, R)), which `policy` observes
        with `noise`."""
        perimeter, splits = commanded(policy, x + noise)
        splits = self.nominal_splits if splits is None else splits
        return dynamics.advance(
            self.parameters, x, demand, perimeter, splits, **self.planning.scheme
        )

    def states(
        self,
        policy: nn.Module,
        x: States,
        demand: Demands,
        generator: Generator,
        step: Callable | None = None,
    ) -> tuple[Demands, Demands, Demands]:
        """Return the states under `policy`, the observed ones, and the backlog (veh, (T, B, R, R)).

        policy: a Policy or any module: states -> perimeter or (perimeter, splits); it may have a
            method `metering`
        step: replaces `self.step`, such as its compiled form
        """
        noise = torch.randn(demand.shape, generator=generator, dtype=self.dtype).to(self.device)
        noise *= self.planning.measurement_std
        states, waiting, metering = (
            [x],
            [torch.zeros_like(x)],
            getattr(policy, "metering", lambda x: None),
        )
        for k in range(demand.shape[0] - 1):
            entering, backlog = demand[k], waiting[-1]
            if (rates := metering(states[-1] + noise[k])) is not None:
                entering, backlog = dynamics.admitted(backlog, entering, rates, self.planning.step)
            x = (step or self.step)(policy, states[-1], entering, noise[k])
            if self.process_std:
                shock = torch.randn(x.shape, generator=generator, dtype=self.dtype).to(self.device)
                x = torch.where(x > 0, (x + self.process_std * shock).clamp(min=0.0), x)
            states.append(x)
            waiting.append(backlog)
        exact = torch.stack(states)
        return exact, exact + noise, torch.stack(waiting)

    def trajectories(
        self,
        policy: nn.Module,
        x: States,
        demand: Demands,
        generator: Generator,
        step: Callable | None = None,
    ) -> "Trajectories":
        """Return the rollouts from x with their controls; arguments as `states`."""
        exact, seen, backlog = self.states(policy, x, demand, generator, step)
        perimeter, splits = commanded(policy, seen)
        given = {
            "states": exact,
            "backlog": backlog,
            "rate": dynamics.rate(self.parameters, exact.sum(-1)),
        }
        splits = (self.nominal_splits if splits is None else splits).expand(*exact.shape, -1)
        given |= {"perimeter": perimeter.expand_as(exact), "splits": splits}
        return Trajectories(step=self.planning.step, demand=demand, **given)

    def total_time_spent(
        self,
        policy: nn.Module,
        x: States,
        demand: Demands,
        generator: Generator,
        step: Callable | None = None,
    ) -> Levels:
        """Return the TTS (veh s, (B,)) of rollouts from x under `policy`, with both costs;
        arguments as `states`."""
        exact, seen, waiting = self.states(policy, x, demand, generator, step)
        vehicles = exact.sum((0, -2, -1)) + waiting.sum((-2, -1)).sum(0)
        if self.detour_cost or self.holding_cost:
            perimeter, splits = commanded(policy, seen)
            if self.detour_cost and splits is not None:
                vehicles = vehicles + self.detour_cost * self._diverted(exact, splits).sum(
                    (0, -2, -1)
                )
            if self.holding_cost:
                vehicles = vehicles + self.holding_cost * self._held(exact, perimeter).sum((0, -1))
        return self.planning.step * vehicles

    def _held(self, x: PerPair, perimeter: PerPair) -> PerRegion:
        """Return the flow out of a region times the mean share by which its boundaries are closed
        (veh/s, (..., R))."""
        p, network, vehicles = self.parameters, self.planning.network, x.sum(-1)
        closed = (network.u_max - perimeter) / (network.u_max - network.u_min) * p.adjacency
        return (
            dynamics.rate(p, vehicles)
            * vehicles
            * closed.sum(-1)
            / p.adjacency.sum(-1).clamp(min=1.0)
        )

    def _diverted(self, x: PerPair, splits: PerTurn) -> PerPair:
        """Return the flow that leaves a region off the nominal split ratios (veh/s, (..., R,
        R))."""
        p = self.parameters
        leaving = dynamics.rate(p, x.sum(-1)).unsqueeze(-1) * x
        if p.exit_rates is not None:
            leaving = leaving * p.exit_rates
        return 0.5 * (splits - self.nominal_splits).abs().sum(-2) * leaving


def can_compile(device: str = "cpu") -> bool:
    """Return True if torch.compile works on `device`: it needs a C++ compiler, headers, OpenMP, on
    a GPU Triton."""
    if shutil.which(os.environ.get("CXX", "g++")) is None:
        return False
    try:
        with warnings.catch_warnings():
            compiled_step(torch.neg)(torch.ones(1, device=device))
    except Exception:  # of the compiler, its tools, or the cache
        return False
    return True


def compiled_step(step: Callable) -> Callable:
    """Return `step`, compiled at its first call."""
    import torch._dynamo
    import torch._inductor.config

    warnings.filterwarnings("ignore", category=FutureWarning, module="torch._inductor")
    torch._inductor.config.compile_threads = 1  # no pool of processes beside one training
    torch._dynamo.reset()  # earlier trainings count towards a limit
    return torch.compile(step, dynamic=False)
