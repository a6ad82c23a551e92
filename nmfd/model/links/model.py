"""The link model of a city: B rollouts under commands by control interval, differentiable."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch.utils.checkpoint import checkpoint

from nmfd.model.links.flows import LEAST, Flows, Numbers, Tensor, Traffic
from nmfd.model.links.network import LinkNetwork
from nmfd.model.links.signals import FIXED, MAX_PRESSURE, Gates, Lights, Programmes, Stages, StageSignals
from nmfd.tensors import PerPair, PerRegion

OPEN_SHARE = 0.95  # of what a boundary can let through; above it a gate is open


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What the model takes from the table [sumo] of a scenario, with its names.

    signals: "fixed", "actuated" or "max-pressure"; lookahead: of max-pressure (s)
    gateways_fixed: signals with gates stay fixed if the others are actuated
    chain_limit: share of a link's room beyond which no gate holds vehicles there; 0: no limit (-)
    """

    signals: str = FIXED
    lookahead: float = 1.0
    gateways_fixed: bool = False
    chain_limit: float = 0.6


class Commands(NamedTuple):
    """Commands of one control interval; None: no limit.

    gates: share of what each boundary can let through (-, (B, R, R), [i, h] from i to h)
    metering: largest rate of trips that may begin in each region (veh/s, (B, R))
    """

    gates: PerPair | None = None
    metering: PerRegion | None = None


class LinkState(NamedTuple):
    """State of B rollouts at the beginning of a control interval.

    interval: its number; spent: time spent so far (veh s, (B,))
    used: of the gates' windows; stages: of signals that choose their stages
    realised: share of green that each boundary was given in the last interval (-, (B, R, R))
    """

    interval: int
    traffic: Traffic
    used: Tensor
    stages: Stages | None
    spent: Tensor
    realised: Tensor


class LinkModel:
    """Rollouts of one city: `start`, then `advance` once per control interval."""

    def __init__(
        self,
        network: LinkNetwork,
        step: float,
        *,
        numbers: Numbers = Numbers(),
        choices: Choices = Choices(),
        dt: float = 3.0,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
    ):
        """step: control interval (s), a multiple of dt (s), which is a whole number"""
        self.network, self.choices, self.step = network, choices, step
        self.flows = flows = Flows(network, numbers, dt=dt, dtype=dtype, device=device)
        self._steps = round(step / dt)
        self.gates = Gates(flows, by_cycle=choices.signals == MAX_PRESSURE)
        self._programmes = Programmes(flows, self.gates.opens)
        self._stages = None
        if choices.signals != FIXED:
            self._stages = StageSignals(
                flows, choices.signals, choices.lookahead, gateways_fixed=choices.gateways_fixed
            )
        regions, region = network.regions, network.region
        self._origin = flows.values(network.origin)
        entry_region = region[network.entry_link]
        self._pair_of_entry = flows.places(entry_region * regions + network.destination)
        self._region_of_entry = flows.places(entry_region)
        self._region_of_link = flows.places(region)
        entered = np.zeros(len(network.cycle), dtype=int)
        entered[network.turn_movement] = region[network.turn_link]
        gated = self.gates.movements
        boundary = region[network.movement_link[gated]] * regions + entered[gated]
        self._boundary_of_gate = flows.places(boundary)
        self._link_of_gate = flows.places(network.movement_link[gated])
        lanes_of = np.bincount(network.turn_movement[network.served], minlength=len(network.cycle))
        capacity = lanes_of[gated]
        total = np.bincount(boundary, capacity, regions**2)[boundary]
        self._weight_of_gate = flows.values(capacity / total)
        self._share = flows.values(network.cell_share).unsqueeze(0)

    def start(self, batch: int) -> LinkState:
        """Return the empty city at the beginning of interval 0."""
        regions = self.network.regions
        traffic = self.flows.start(batch)
        return LinkState(
            interval=0,
            traffic=traffic,
            used=self.gates.start(batch),
            stages=None if self._stages is None else self._stages.start(batch),
            spent=torch.zeros_like(traffic.completed),
            realised=self._share.new_ones(batch, regions, regions),
        )

    def advance(self, state: LinkState, demand: PerPair, commands: Commands) -> LinkState:
        """Return the state one control interval later; demand: trips that are due (veh/s, (B, R, R))"""
        if torch.is_grad_enabled():
            return checkpoint(self._advance, state, demand, commands, use_reentrant=False)
        return self._advance(state, demand, commands)

    def _advance(self, state: LinkState, demand: PerPair, commands: Commands) -> LinkState:
        flows, dt = self.flows, self.flows.dt
        traffic, used, stages, spent = state.traffic, state.used, state.stages, state.spent
        due = demand.reshape(len(demand), -1).index_select(1, self._pair_of_entry) * self._origin * dt
        begin = state.interval * self.step
        light, yields, opens = self._programmes.read(begin, self._steps)
        opens = opens[:, self.gates.movements]
        share, mean_share = None, 0.0
        for n in range(self._steps):
            held, released = self._metered(traffic.held, due, commands.metering)
            traffic = traffic._replace(held=held)
            lights = Lights(light[n : n + 1], yields[n : n + 1])
            if commands.gates is not None:
                share = self._gate_shares(commands.gates, traffic.inside)
                mean_share = mean_share + share / self._steps
            if self._stages is not None and stages is not None:
                number = state.interval * self._steps + n
                closed = torch.zeros_like(traffic.passed)
                stages, lights = self._stages.step(number, stages, traffic, closed, lights)
            shown = lights.light
            if share is not None:
                used, shown = self.gates.limit(used, shown.expand(len(used), -1), opens[n], share)
            traffic = flows.step(traffic, released, shown, lights.yields, self._share)
            spent = spent + dt * (traffic.inside.sum(1) + traffic.outside.sum(1))
            if commands.metering is not None:
                spent = spent + dt * traffic.held.sum(1)
        realised = state.realised
        if commands.gates is not None:
            realised = self._realised(commands.gates, mean_share)
        return LinkState(state.interval + 1, traffic, used, stages, spent, realised)

    def _metered(
        self, held: Tensor, due: Tensor, metering: PerRegion | None
    ) -> tuple[Tensor, Tensor]:
        """Return the trips that are held back, and those that may begin, by entry (veh, (B, E))."""
        held = held + due
        if metering is None:
            return torch.zeros_like(held), held
        by_region = self.flows.sums(held, self._region_of_entry, self.network.regions)
        share = (metering * self.flows.dt / by_region.clamp(min=LEAST)).clamp(max=1.0)
        released = held * share.index_select(1, self._region_of_entry)
        return held - released, released

    def _gate_shares(self, gates: PerPair, inside: Tensor) -> Tensor:
        """Return the share of green of each gate (-, (B, gates)).

        As in cosim.plant.room, a gate opens while its street fills: from half the limit on.
        """
        share = gates.reshape(len(gates), -1).index_select(1, self._boundary_of_gate)
        share = torch.where(share >= OPEN_SHARE, 1.0, share)
        if self.choices.chain_limit:
            full = (inside / self.flows.storage).index_select(1, self._link_of_gate)
            floor = (2.0 * full / self.choices.chain_limit - 1.0).clamp(0.0, 1.0)
            share = torch.maximum(share, floor)
        return share

    def _realised(self, gates: PerPair, share: Tensor) -> PerPair:
        """Return the mean share of green of each boundary; the command where no gate obeys."""
        regions = self.network.regions
        given = self.flows.sums(share * self._weight_of_gate, self._boundary_of_gate, regions**2)
        obeys = torch.zeros(regions**2, dtype=torch.bool, device=given.device)
        obeys[self._boundary_of_gate] = True
        return torch.where(obeys.view(regions, regions), given.view(-1, regions, regions), gates)

    def accumulation(self, state: LinkState) -> PerPair:
        """Return the vehicles in region i bound for j (veh, (B, R, R))."""
        under_way = self.flows.under_way(state.traffic)
        regions = self.network.regions
        zeros = under_way.new_zeros(len(under_way), regions, regions)
        return zeros.index_add(1, self._region_of_link, under_way)

    def backlog(self, state: LinkState) -> PerPair:
        """Return the trips that wait outside region i, bound for j (veh, (B, R, R))."""
        regions = self.network.regions
        outside = state.traffic.held + state.traffic.due
        total = self.flows.sums(outside, self._pair_of_entry, regions**2)
        return total.view(-1, regions, regions)
