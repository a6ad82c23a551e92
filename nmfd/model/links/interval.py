"""The steps of a control interval of the link model."""

from typing import NamedTuple

import torch
from torch import Tensor

from nmfd.model.links.chance import Chance
from nmfd.model.links.flows import LEAST, Flows, Traffic, Ways
from nmfd.model.links.signals import Gates, Lights, Phases, Responsive, Stages
from nmfd.tensors import PerRegion


class LinkState(NamedTuple):
    """State of B rollouts at the beginning of a control interval.

    interval: its number
    draw: number of the draw of trips of each rollout (B,)
    used: of the gates' windows; stages: of max-pressure or of actuated signals
    chance: of single vehicles, None without
    asked: trips that were due so far on average, by entry (B, E)
    begun: trips that were due so far (veh, (B,))
    spent: time spent so far (veh s, (B,))
    present: vehicles on each link, summed over the last interval (veh s, (B, L))
    gone: vehicles that left each link in it (veh, (B, L))
    realised: share of green that each boundary was given in it (-, (B, R, R))
    """

    interval: int
    draw: Tensor
    traffic: Traffic
    used: Tensor
    stages: Stages | Phases | None
    chance: Chance | None
    asked: Tensor
    begun: Tensor
    spent: Tensor
    present: Tensor
    gone: Tensor
    realised: Tensor


class Interval(NamedTuple):
    """Commands, lights and ways of B rollouts in an interval of K steps.

    due: trips that are due in a step, by entry (veh, (B, E))
    ways, chance: of the vehicles
    metering: largest rate of trips that may begin in each region (veh/s, (B, R)); None: no limit
    gates: share of green of each gate (-, (B, gates)); None: no limit
    light, yields: lights of the programmes in each step, as of Lights (-, (K, M))
    opens: 1 where a window of a gate begins, else 0 (K, gates)
    """

    due: Tensor
    ways: Ways
    chance: Chance | None
    metering: PerRegion | None
    gates: Tensor | None
    light: Tensor
    yields: Tensor
    opens: Tensor


class Passed(NamedTuple):
    """State of B rollouts after the steps of an interval, and sums over them.

    traffic, used, stages, asked: as of LinkState
    begun: trips that were due (veh, (B,))
    present: vehicles on each link (veh, (B, L))
    outside, held: those that wait outside, and those of them that metering keeps there (veh, (B,))
    share: mean share of green of each gate (-, (B, gates))
    """

    traffic: Traffic
    used: Tensor
    stages: Stages | Phases | None
    asked: Tensor
    begun: Tensor
    present: Tensor
    outside: Tensor
    held: Tensor
    share: Tensor


class Steps:
    """Steps by operations on tensors: the reference, and on a GPU."""

    def __init__(
        self,
        flows: Flows,
        gates: Gates,
        signals: Responsive | None,
        chain_limit: float,
        steps: int,
    ):
        """signals: those that follow the traffic, None if there are none
        chain_limit: as of nmfd.model.links.model.Choices
        steps: of an interval
        """
        self.flows = flows
        self.gates = gates
        self.signals = signals
        self.chain_limit = chain_limit
        self.steps = steps

    def __call__(self, state: LinkState, interval: Interval) -> Passed:
        """Return the state an interval later."""
        flows = self.flows
        traffic = state.traffic
        used = state.used
        stages = state.stages
        chance = interval.chance
        present = torch.zeros_like(traffic.inside)
        outside = torch.zeros_like(traffic.inside)
        held = torch.zeros_like(traffic.held)
        mean_share = torch.zeros_like(used)
        asked = state.asked
        begun = torch.zeros_like(state.begun)
        for n in range(self.steps):
            whole = interval.due
            if chance is not None:
                whole = chance.trips(asked, whole)
            asked = asked + interval.due
            begun = begun + whole.sum(1)
            released = whole
            # Without metering, trips that were held begin in the first step.
            if interval.metering is not None or n == 0:
                traffic, released = self._metered(traffic, whole, interval.metering)
            lights = Lights(interval.light[n : n + 1], interval.yields[n : n + 1])
            if self.signals is not None:
                number = state.interval * self.steps + n
                stages, lights = self.signals.step(number, stages, traffic, lights)
            shown = lights.light
            if interval.gates is not None:
                share = self._gate_shares(interval.gates, traffic.inside)
                mean_share = mean_share + share / self.steps
                shown = shown.expand(len(used), -1)
                used, shown = self.gates.limit(used, shown, interval.opens[n], share)
            traffic = flows.step(traffic, released, shown, lights.yields, interval.ways)
            present = present + traffic.inside
            outside = outside + traffic.outside
            if interval.metering is not None:
                held = held + traffic.held
        return Passed(
            traffic=traffic,
            used=used,
            stages=stages,
            asked=asked,
            begun=begun,
            present=present,
            outside=outside.sum(1),
            held=held.sum(1),
            share=mean_share,
        )

    def _metered(
        self, traffic: Traffic, due: Tensor, metering: PerRegion | None
    ) -> tuple[Traffic, Tensor]:
        """Return the state, and the trips that may begin, by entry (veh, (B, E))."""
        flows = self.flows
        held = traffic.held + due
        if metering is None:
            return traffic._replace(held=torch.zeros_like(held)), held
        by_region = flows.sums(held, flows.region_of_entry, flows.network.regions)
        share = (metering * flows.dt / by_region.clamp(min=LEAST)).clamp(max=1.0)
        released = held * share.index_select(1, flows.region_of_entry)
        return traffic._replace(held=held - released), released

    def _gate_shares(self, share: Tensor, inside: Tensor) -> Tensor:
        """Return the share of green of each gate (-, (B, gates)).

        As in cosim.plant.room, a gate opens while its street fills: from half the limit on.

        share: of the command
        """
        if self.chain_limit:
            full = (inside / self.flows.storage).index_select(1, self.gates.link)
            share = torch.maximum(share, (2.0 * full / self.chain_limit - 1.0).clamp(0.0, 1.0))
        return share
