"""Differentiable rollouts of the link model of a city."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from nmfd.arrays import PerTurn
from nmfd.errors import InputError
from nmfd.model.links.chance import Chance, chance_of
from nmfd.model.links.drivers import Drivers
from nmfd.model.links.flows import Flows, Numbers, Ways
from nmfd.model.links.interval import Interval, LinkState, Steps
from nmfd.model.links.network import LinkNetwork
from nmfd.model.links.recompute import Recordings, at_once, run_again
from nmfd.model.links.signals import (
    ACTUATED,
    FIXED,
    MAX_PRESSURE,
    Actuated,
    Gates,
    MaxPressure,
    Programmes,
    Responsive,
)
from nmfd.model.planning import GUIDED
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import config
from nmfd.runs.config import Share, setting
from nmfd.tensors import PerPair, PerRegion
from nmfd.tensors import PerTurn as Turns

OPEN_SHARE = 0.95  # of what a boundary can let through; above it a gate is open


Signals = Literal["fixed", "actuated", "max-pressure"]
SHARES = ("rerouting", "compliance")  # choices that labels give in percent
METERING = "metering"  # label of a controller that commands rates


class Choices(config.Settings):
    """Signals and drivers of the city; other values are not in the link model."""

    signals: Signals = setting("control of the signals", FIXED)
    gateways_fixed: bool = setting(
        "signals with gateways stay fixed-time if the others are actuated", True
    )
    lookahead: float = setting("as of max-pressure in a city", 1.0, unit="s", gt=0.0)
    chain_limit: Share = setting(
        "share of a link's room beyond which no gate holds vehicles there; 0: no limit", 0.6
    )
    guided: bool = setting("drivers are guided by travel times without a command", False)
    compliance: Share = setting("share of the drivers who follow the guidance", 1.0)
    rerouting: Share = setting("share of the drivers who weigh travel times by themselves", 0.0)
    metering: float = setting("metering without a command; 0: never", 0.0, ge=0.0, le=0.0)
    measurement: Literal["exact"] = setting("what controllers see", "exact")


def choices_of(scenario: Scenario, labels: Sequence[str] = (), *, gated: bool = True) -> Choices:
    """Return the choices of the table [sumo].

    labels: of a strategy (nmfd.controllers.strategy), which change some
    gated: its controller commands gates, so that only signals without gateways can be actuated
    Raises: InputError for a value or label that the link model has not
    """
    own = {name: value for name, value in scenario.sumo.items() if name in Choices.model_fields}
    own |= _changes(labels)
    if ACTUATED in labels:
        own["gateways_fixed"] = gated
    return config.checked(Choices, own, scenario.where, "sumo.")


def _changes(labels: Sequence[str]) -> dict[str, Any]:
    """Return the choices that labels change.

    Commanded rates of metering are always obeyed, and guidance is once per control interval.
    """
    changes: dict[str, Any] = {}
    for label in labels:
        word, _, number = label.rpartition("-")
        if label in get_args(Signals):
            changes["signals"] = label
        elif label == GUIDED:
            changes["guided"] = True
        elif word in SHARES and number.isdigit():
            changes[word] = int(number) / 100.0
        elif label != METERING and word != "guidance-period":
            known = ", ".join([*get_args(Signals), GUIDED, *(f"{share}-30" for share in SHARES)])
            raise InputError(
                f"+{label}: streets (plant links) know {known}, metering and guidance-period-60; "
                "choose from these, or run it in SUMO (cosim)"
            )
    return changes


def gate_shares(network: RegionalModel, perimeter: PerPair) -> PerPair:
    """Return u as shares of what boundaries can let through (-, (B, R, R)).

    It is 1 where regions are not adjacent.
    """
    share = (perimeter - network.u_min) / (network.u_max - network.u_min)
    adjacent = torch.as_tensor(network.adjacency, device=share.device)
    return torch.where(adjacent, share.clamp(0.0, 1.0), 1.0)


class Commands(NamedTuple):
    """Commands of one control interval.

    None: no limit, and drivers on their own ways.

    gates: share of what each boundary can let through (-, (B, R, R), [i, h] from i to h)
    metering: largest rate of trips that may begin in each region (veh/s, (B, R))
    splits: share of the vehicles in i bound for j that head for h (-, (B, R, R, R), [i, h, j])
    prices: added share of the travel time through each region (-, (B, R))
    """

    gates: PerPair | None = None
    metering: PerRegion | None = None
    splits: Turns | None = None
    prices: PerRegion | None = None


class LinkModel:
    """Rollouts of one city: `start`, then `advance` once per control interval."""

    def __init__(
        self,
        network: LinkNetwork,
        step: float,
        *,
        nominal: PerTurn | None = None,
        numbers: Numbers | None = None,
        choices: Choices | None = None,
        dt: float = 2.0,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
        compiled: bool = True,
    ):
        """step: control interval (s), a multiple of dt
        dt: time step, a whole number (s)
        nominal: split ratios without guidance (-, (R, R, R))
        compiled: machine code on a processor; False, and always on a GPU: the reference
        """
        self.network = network
        self.step = step
        self._choices = choices or Choices()
        on_gpu = torch.device(device).type == "cuda"
        kinds: tuple[type[Flows], type[MaxPressure], type[Steps]] = (Flows, MaxPressure, Steps)
        if compiled and not on_gpu:
            from nmfd.model.links import processor  # loads a compiler

            kinds = (
                processor.ProcessorFlows,
                processor.CompiledMaxPressure,
                processor.CompiledSteps,
            )
        of_flows, of_signals, of_steps = kinds
        self.flows = of_flows(network, numbers or Numbers(), dt=dt, dtype=dtype, device=device)
        self._steps = round(step / dt)
        self._signals: Responsive | None = None
        self._gates = Gates(self.flows)
        if self._choices.signals == MAX_PRESSURE:
            self._signals = of_signals(self.flows, self._choices.lookahead)
            self._gates = Gates(self.flows, by_cycle=True, of_programme=False)
        elif self._choices.signals == ACTUATED:
            fixed = self._choices.gateways_fixed
            self._signals = Actuated(self.flows, gateways_fixed=fixed)
            self._gates = Gates(self.flows, by_cycle=not fixed)
        self._programmes = Programmes(self.flows, self._gates.opens)
        self._play = Recordings().play if on_gpu else at_once
        self._drivers = Drivers(self.flows, nominal)
        self._number()
        self._passing = of_steps(
            self.flows, self._gates, self._signals, self._choices.chain_limit, self._steps
        )

    def _number(self) -> None:
        """Set regions and boundaries of entries, links and gates."""
        flows = self.flows
        network = self.network
        regions = network.regions
        region = network.region
        self._origin = flows.values(network.origin)
        entry_region = region[network.entry_link]
        self._pair_of_entry = flows.places(entry_region * regions + network.destination)
        self._region_of_link = flows.places(region)
        entered = np.zeros(flows.movements, dtype=int)
        entered[network.turn_movement] = region[network.turn_link]
        gated = self._gates.movements
        link = network.movement_link[gated]
        boundary = region[link] * regions + entered[gated]
        self._boundary_of_gate = flows.places(boundary)
        served = network.turn_movement[network.served]
        lanes = np.bincount(served, minlength=flows.movements)[gated]
        total = np.bincount(boundary, lanes, regions**2)[boundary]
        self._weight_of_gate = flows.values(lanes / total)
        obeys = np.bincount(boundary, minlength=regions**2) > 0
        self._obeys = torch.as_tensor(obeys.reshape(regions, regions), device=flows.device)

    def start(self, batch: int, draws: Sequence[int] = (0,), *, chance: bool = False) -> LinkState:
        """Return the empty city at the beginning of interval 0.

        draws: numbers of the draws of trips; the rollouts take them in turn
        chance: single vehicles draw their turns, with the draws as seeds
        """
        flows = self.flows
        regions = self.network.regions
        seeds = np.resize(np.array(draws), batch)
        draw = seeds % (len(self.network.origin) // self.network.periods)
        traffic = flows.start(batch)
        by_chance = None
        if chance:
            by_chance = chance_of(seeds.tolist(), flows.entries, flows.entry_of_cell)
        return LinkState(
            interval=0,
            draw=flows.places(draw),
            traffic=traffic,
            used=self._gates.start(batch),
            stages=None if self._signals is None else self._signals.start(batch),
            chance=by_chance,
            asked=torch.zeros_like(traffic.due),
            begun=traffic.inside.new_zeros(batch),
            spent=traffic.inside.new_zeros(batch),
            present=torch.zeros_like(traffic.inside),
            gone=torch.zeros_like(traffic.inside),
            realised=traffic.inside.new_ones(batch, regions, regions),
        )

    def advance(self, state: LinkState, demand: PerPair, commands: Commands) -> LinkState:
        """Return the state one control interval later.

        demand: trips that are due (veh/s, (B, R, R))
        """
        gates = commands.gates
        opened = gates is not None and bool((gates >= OPEN_SHARE).all())
        if opened:
            commands = commands._replace(gates=None)
        programme = self._programmes.read(state.interval * self.step, self._steps)
        # Intervals are alike but for the steps in which signals decide.
        period = 1 if self._signals is None else self._signals.period
        alike = state._replace(interval=state.interval % period, chance=None)
        given = (alike, self._row(state), demand, commands, programme, state.chance)
        after = run_again(self._advance, *given, play=self._play)
        after = after._replace(interval=state.interval + 1, chance=state.chance)
        return after._replace(realised=gates) if opened else after

    def _row(self, state: LinkState) -> Tensor:
        """Return the row of the network's shares of each rollout (B,)."""
        network = self.network
        elapsed = int(state.interval * self.step / network.period)
        return state.draw * network.periods + min(elapsed, network.periods - 1)

    def _advance(
        self,
        state: LinkState,
        row: Tensor,
        demand: PerPair,
        commands: Commands,
        programme: tuple[Tensor, Tensor, Tensor],
        chance: Chance | None,
    ) -> LinkState:
        """Return the state by tensors alone, so that a GPU can record it.

        row: as of _row; programme: as of Programmes.read
        """
        flows = self.flows
        dt = flows.dt
        origin = self._origin.index_select(0, row)
        due = demand.flatten(1).index_select(1, self._pair_of_entry) * origin * dt
        light, yields, opens = programme
        gates = commands.gates
        shares = None
        if gates is not None:
            shares = gates.flatten(1).index_select(1, self._boundary_of_gate)
            shares = torch.where(shares >= OPEN_SHARE, 1.0, shares)
        interval = Interval(
            due=due,
            ways=self._ways(state, row, commands, chance),
            chance=chance,
            metering=commands.metering,
            gates=shares,
            light=light,
            yields=yields,
            opens=opens.index_select(1, self._gates.movement),
        )
        passed = self._passing(state, interval)
        traffic = passed.traffic
        realised = torch.ones_like(state.realised)
        if gates is not None:
            realised = self._realised(gates, passed.share)
        before = state.traffic
        gone = traffic.left - before.left + traffic.completed - before.completed
        everywhere = passed.present.sum(1) + passed.outside + passed.held
        return LinkState(
            interval=state.interval + 1,
            draw=state.draw,
            traffic=traffic,
            used=passed.used,
            stages=passed.stages,
            chance=None,
            asked=passed.asked,
            begun=state.begun + passed.begun,
            spent=state.spent + dt * everywhere,
            present=dt * passed.present,
            gone=gone,
            realised=realised,
        )

    def _ways(
        self, state: LinkState, row: Tensor, commands: Commands, chance: Chance | None = None
    ) -> Ways:
        """Return the ways of an interval; row: as of _row."""
        choices = self._choices
        drivers = self._drivers
        static = drivers.static(row)
        compliance = choices.rerouting
        by_splits = commands.splits is not None and commands.prices is None
        if by_splits or choices.guided or commands.prices is not None:
            compliance = choices.compliance
        cells = static
        if by_splits:
            cells = drivers.by_splits(static, commands.splits)
        elif compliance > 0.0:
            cells = drivers.by_times(static, state.present, state.gone, commands.prices)
        cells = static + compliance * (cells - static)
        return self.flows.ways(cells.to(self.flows.dtype), row, chance)

    def _realised(self, gates: PerPair, share: Tensor) -> PerPair:
        """Return the mean share of green of each boundary.

        It is the command where no gate obeys.
        """
        regions = self.network.regions
        given = self.flows.sums(share * self._weight_of_gate, self._boundary_of_gate, regions**2)
        return torch.where(self._obeys, given.view(-1, regions, regions), gates)

    def accumulation(self, state: LinkState) -> PerPair:
        """Return the vehicles in region i bound for j (veh, (B, R, R))."""
        under_way = self.flows.under_way(state.traffic)
        regions = self.network.regions
        zeros = under_way.new_zeros(len(under_way), regions, regions)
        return zeros.index_add(1, self._region_of_link, under_way)

    def backlog(self, state: LinkState) -> PerPair:
        """Return the trips that wait outside i, bound for j (veh, (B, R, R))."""
        regions = self.network.regions
        outside = state.traffic.held + state.traffic.due
        total = self.flows.sums(outside, self._pair_of_entry, regions**2)
        return total.view(-1, regions, regions)
