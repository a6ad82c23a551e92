"""Batched rollouts of the regional model under a policy, for training."""

import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Generator, nn

from nmfd.controllers.dpc.policy import commanded
from nmfd.model import dynamics
from nmfd.model.planning import PlanningModel
from nmfd.model.scenario import pairs_with_demand
from nmfd.tensors import PerPair, PerRegion

States = Float[torch.Tensor, "B R R"]
Demands = Float[torch.Tensor, "T B R R"]  # or states over time
Levels = Float[torch.Tensor, " B"]


@dataclass(frozen=True, kw_only=True)
class Trajectories:
    """B rollouts of T control intervals, for costs and constraints.

    step: control interval (s)
    states: in region i at the beginning of each interval (veh, (T, B, R, R))
    backlog: waiting to enter region i, as `states` (veh, (T, B, R, R))
    demand: (veh/s, (T, B, R, R))
    rate: outflow per vehicle q_i, in proportion to the mean speed (1/s, (T, B, R))
    perimeter: in these states (-, (T, B, R, R))
    splits: in these states (-, (T, B, R, R, R))
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
    """Regional model of a scenario as tensors.

    Random numbers are drawn on the CPU, so that devices agree.

    rough: True if rollouts of the same demand differ, and their total may jump
    batch: rollouts in an Adam step; None: those of the settings
    """

    rough: ClassVar[bool] = False
    batch: int | None = None

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
        """Make the tensors.

        detour_cost: time lost by a vehicle that is guided off the nominal split ratios (s)
        holding_cost: time lost by a vehicle that a gate holds (s)
        process_std: standard deviation of the noise on each x_ij that is not empty (veh)
        """
        network = planning.network
        self.planning = planning
        self.dtype = dtype
        self.device = torch.device(device)
        self.detour_cost = detour_cost
        self.holding_cost = holding_cost
        self.process_std = process_std
        self._nominal = dynamics.parameters(network, dtype=dtype, device=device)
        self.parameters = self._nominal
        self.demand = self._tensor(planning.forecast)
        self.nominal_splits = self._tensor(network.nominal_splits)
        self.bound = self._tensor(planning.destinations)
        self.start = torch.zeros_like(self.demand[0])
        if planning.initial is not None:
            self.start = self._tensor(planning.initial)

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.tensor(values, dtype=self.dtype, device=self.device)

    def _uniform(self, generator: Generator, *shape: int) -> torch.Tensor:
        """Return random numbers from 0 to 1."""
        return torch.rand(*shape, generator=generator, dtype=self.dtype).to(self.device)

    def _normal(self, generator: Generator, *shape: int) -> torch.Tensor:
        """Return random numbers of the standard normal distribution."""
        return torch.randn(*shape, generator=generator, dtype=self.dtype).to(self.device)

    def _factor(self, generator: Generator, spread: float, *shape: int) -> torch.Tensor:
        """Return random factors.

        spread: standard deviation of their logarithm (-)
        """
        return torch.exp(spread * self._normal(generator, *shape).clamp(-2.0, 2.0))

    def random_start(
        self,
        batch: int,
        spread: float,
        share: float,
        generator: Generator,
        levels: tuple[float, float] = (1.0, 1.0),
    ) -> tuple[States, Demands]:
        """Return initial states (veh) and demands (veh/s), of `batch` rollouts.

        spread: every flow is scaled by a factor from 1 - spread to 1 + spread
        share: of the rollouts that start at a random time from a random state, with regions filled
            to at most 80 % of the jam accumulation; the others start as the scenario
        levels: range of one factor of all demand, per rollout
        """
        steps, regions = self.demand.shape[:2]
        is_random = torch.arange(batch, device=self.device) < share * batch
        factor = 1.0 + spread * (2.0 * self._uniform(generator, batch, regions, regions) - 1.0)
        shift = (self._uniform(generator, batch) * steps * 0.5).long() * is_random
        index = torch.arange(steps, device=self.device)[:, None] + shift
        padded = torch.cat([self.demand, torch.zeros_like(self.demand)])
        demand = padded[index] * factor
        weight = self._uniform(generator, batch, regions, regions) ** 2 * self.bound
        filling = self._uniform(generator, batch, regions) * self._uniform(generator, batch, 1)
        total = filling * 0.8 * self._nominal.mfd.jam
        x = total.unsqueeze(-1) * weight / weight.sum(-1, keepdim=True).clamp(min=1e-6)
        low, high = levels
        if levels != (1.0, 1.0):
            demand = demand * (low + (high - low) * self._uniform(generator, batch, 1, 1))
        return torch.where(is_random[:, None, None], x, self.start), demand

    def draw_model(
        self, batch: int, spread: float, generator: Generator, scale: float = 1.0
    ) -> None:
        """Draw a regional model for each of `batch` rollouts.

        All are around the nominal one.

        spread: standard deviation of the logarithm of every region's accumulation axis (jam,
            critical accumulation, storage), and half of that for its outflow and capacities (-)
        scale: factor of all accumulation axes (-)
        """
        self.parameters = self._nominal
        if not spread and scale == 1.0:
            return
        p = self._nominal
        regions = len(p.adjacency)
        wide = scale * self._factor(generator, spread, batch, regions)
        high = self._factor(generator, 0.5 * spread, batch, regions)
        # No rate rises above the largest that the integration step was checked for.
        fastest = p.mfd.rate_up_to_jam(torch.zeros_like(p.mfd.jam), torch)
        if p.exit_rates is not None:
            fastest = fastest * p.exit_rates.amax(-1)
        high = high.clamp(max=1.0 / (fastest * self.planning.step / self.planning.substeps))
        drawn = replace(p, mfd=p.mfd.scaled(wide, high))
        if p.capacity is not None:
            capacity = p.capacity * self._factor(generator, 0.5 * spread, batch, regions, regions)
            drawn = replace(drawn, capacity=capacity, storage=p.storage * wide)
        self.parameters = drawn

    def perturb(
        self, demand: Demands, level: Levels, noise: float, generator: Generator
    ) -> Demands:
        """Add Gaussian noise to the pairs with demand; the sum is clipped at zero.

        demand: (veh/s, (T, B, R, R))
        level: share of `noise` in each rollout (-, (B,))
        noise: largest standard deviation (veh/s)
        """
        if not noise:
            return demand
        pairs = torch.tensor(pairs_with_demand(self.planning.forecast))
        sigma = level[:, None, None] * noise * pairs
        normal = torch.randn(demand.shape, generator=generator, dtype=self.dtype)
        return (demand + (normal * sigma).to(self.device)).clamp(min=0.0)

    def step(self, policy: nn.Module, x: States, demand: States, noise: States) -> States:
        """Return the state one control interval after x (veh, (B, R, R)).

        noise: of the observation of x (veh, (B, R, R))
        """
        perimeter, splits = commanded(policy, x + noise)
        if splits is None:
            splits = self.nominal_splits
        scheme = self.planning.scheme
        return dynamics.advance(self.parameters, x, demand, perimeter, splits, **scheme)

    def states(
        self,
        policy: nn.Module,
        x: States,
        demand: Demands,
        generator: Generator,
        step: Callable | None = None,
    ) -> tuple[Demands, Demands, Demands]:
        """Return states, observed states and backlog (veh, (T, B, R, R)).

        policy: a Policy or any module: states -> perimeter or (perimeter, splits); it may have a
            method `metering`
        x: initial states (veh, (B, R, R))
        step: replaces `self.step`, such as its compiled form
        """
        advance = step or self.step
        metering = getattr(policy, "metering", None)
        noise = self._normal(generator, *demand.shape)
        noise *= self.planning.measurement_std
        states = [x]
        waiting = [torch.zeros_like(x)]
        for k in range(demand.shape[0] - 1):
            entering = demand[k]
            backlog = waiting[-1]
            rates = None
            if metering is not None:
                rates = metering(x + noise[k])
            if rates is not None:
                entering, backlog = dynamics.admitted(backlog, entering, rates, self.planning.step)
            x = advance(policy, x, entering, noise[k])
            if self.process_std:
                shock = self.process_std * self._normal(generator, *x.shape)
                x = torch.where(x > 0, (x + shock).clamp(min=0.0), x)
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
    ) -> Trajectories:
        """Return the rollouts from x with their controls; arguments as `states`."""
        exact, seen, backlog = self.states(policy, x, demand, generator, step)
        perimeter, splits = commanded(policy, seen)
        if splits is None:
            splits = self.nominal_splits
        return Trajectories(
            step=self.planning.step,
            states=exact,
            backlog=backlog,
            demand=demand,
            rate=dynamics.rate(self.parameters, exact.sum(-1)),
            perimeter=perimeter.expand_as(exact),
            splits=splits.expand(*exact.shape, -1),
        )

    def total_time_spent(
        self,
        policy: nn.Module,
        x: States,
        demand: Demands,
        generator: Generator,
        step: Callable | None = None,
    ) -> Levels:
        """Return the total time spent with both costs (veh s, (B,)).

        Arguments as `states`.
        """
        exact, seen, waiting = self.states(policy, x, demand, generator, step)
        vehicles = exact.sum((0, -2, -1)) + waiting.sum((-2, -1)).sum(0)
        if self.detour_cost or self.holding_cost:
            perimeter, splits = commanded(policy, seen)
            if self.detour_cost and splits is not None:
                leaving = dynamics.desired_outflow(self.parameters, exact, splits)
                share = 0.5 * (splits - self.nominal_splits).abs().sum(-2)  # off the nominal ones
                diverted = (share * leaving).sum((0, -2, -1))
                vehicles = vehicles + self.detour_cost * diverted
            if self.holding_cost:
                held = self._held(exact, perimeter).sum((0, -1))
                vehicles = vehicles + self.holding_cost * held
        return self.planning.step * vehicles

    def _held(self, x: PerPair, perimeter: PerPair) -> PerRegion:
        """Return the flow that gates hold in each region (veh/s, (..., R)).

        It is the flow out of a region times the mean share by which its boundaries are closed.
        """
        p = self.parameters
        network = self.planning.network
        vehicles = x.sum(-1)
        closed = (network.u_max - perimeter) / (network.u_max - network.u_min) * p.adjacency
        boundaries = p.adjacency.sum(-1).clamp(min=1.0)
        return dynamics.rate(p, vehicles) * vehicles * closed.sum(-1) / boundaries


def can_compile(device: str = "cpu") -> bool:
    """Return True if torch.compile works on `device`.

    It needs a C++ compiler, headers and OpenMP, and on a GPU Triton.
    """
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
    from torch import _dynamo
    from torch._inductor import config

    warnings.filterwarnings("ignore", category=FutureWarning, module="torch._inductor")
    config.compile_threads = 1  # no pool of processes beside one training
    _dynamo.reset()  # earlier trainings count towards a limit
    return torch.compile(step, dynamic=False)
