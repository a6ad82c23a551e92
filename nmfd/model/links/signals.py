"""Signals of the link model: programmes, max-pressure and gates.

A stage is a green phase of a programme. Max-pressure (Varaiya, 2013) chooses the stage with the
highest pressure, as cosim.plant.max_pressure does, with the model's own queues. The choice has no
derivative; the flows have one while the choices stay.

A gate leaves a movement, of each window of green with the capacity W (s), the share u:

    W - (1 - u) (G - LEAST_GREEN_S)                     from its beginning; G is its green (s)

as cosim.plant.gates does. Under max-pressure the window is the cycle.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nmfd.model.links.flows import LEAST, Flows

LEAST_GREEN_S = 5.0  # of a gated movement in each window of green
DECISION_PERIOD_S = 5.0
LONGEST_GREEN_S = 50.0  # under max-pressure while others wait
LONGEST_RED_S = 120.0  # then a stage with vehicles comes first
CALLED_VEH = 0.2  # vehicles that call a stage
MAX_PRESSURE = "max-pressure"


class Lights(NamedTuple):
    """Lights of all movements in one step.

    light: capacity as a share of the saturation flow (-, (B, M))
    yields: share of it in which the movement gives way (-, (B, M))
    """

    light: Tensor
    yields: Tensor


class Stages(NamedTuple):
    """State of B rollouts of the signals that choose their stages.

    stage, before: present or coming stage, and the one before it (B, S)
    clearing: time until the present stage begins (s, (B, S))
    green: time since then (s, (B, S))
    red: time since each stage was last green (s, (B, S, n))
    """

    stage: Tensor
    before: Tensor
    clearing: Tensor
    green: Tensor
    red: Tensor


class Gates:
    """Limits of the green of gated movements.

    The state is the capacity used in the window (s).

    movements: gated ones; opens: True in seconds of the programmes with which a window begins
    """

    def __init__(self, flows: Flows, *, by_cycle: bool):
        """by_cycle: the window is the cycle, not a time of green"""
        network = flows.network
        self._dt = flows.dt
        self.movements = np.flatnonzero(network.gated)
        self.opens = np.zeros(len(network.light))
        whole = np.ones(len(self.movements))
        taken = np.ones(len(self.movements))
        for number, movement in enumerate(self.movements):
            begin = network.begin[movement]
            cycle = network.cycle[movement]
            light = network.light[begin : begin + cycle]
            opens = (light > 0.0) & (np.roll(light, 1) == 0.0)
            capacity = light.sum()
            green = (light == 1.0).sum()
            if by_cycle:
                opens[:] = False
                capacity = green = cycle
            if not opens.any():
                opens[0] = True
            self.opens[begin : begin + cycle] = opens
            whole[number] = capacity / opens.sum()
            taken[number] = max(green / opens.sum() - LEAST_GREEN_S, 0.0)
        self.places = flows.places(self.movements)
        self._whole = flows.values(whole)
        self._taken = flows.values(taken)

    def start(self, batch: int) -> Tensor:
        """Return the state (B, gates) before the first step."""
        return self._whole.new_zeros(batch, len(self._whole))

    def limit(
        self, used: Tensor, light: Tensor, opens: Tensor, share: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the state and the lights (B, M) under the gates.

        opens: 1 where a window begins with this step, else 0 (gates,)
        share: of the commands (-, (B, gates))
        """
        seconds = light.index_select(1, self.places) * self._dt
        used = used * (1.0 - opens)
        budget = self._whole - (1.0 - share) * self._taken
        left = ((budget - used) / seconds.clamp(min=LEAST)).clamp(0.0, 1.0)
        factor = torch.ones_like(light).index_copy(1, self.places, left)
        return used + seconds * left, light * factor


class Programmes:
    """Fixed programmes, second by second."""

    def __init__(self, flows: Flows, opens: np.ndarray):
        """opens: of the gates"""
        self._flows = flows
        self._opens = opens

    def read(self, begin: float, steps: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return lights, duties to give way and openings (steps, M).

        begin: time of the first step (s)
        """
        network = self._flows.network
        seconds = round(self._flows.dt)
        clock = round(begin) + np.arange(steps * seconds)[:, None]
        place = network.begin + clock % network.cycle

        def by_step(values: np.ndarray) -> np.ndarray:
            return values[place].reshape(steps, seconds, -1)

        light = by_step(network.light).mean(axis=1)
        yielding = by_step(network.light * network.yields).mean(axis=1)
        yields = yielding / np.maximum(light, 1e-9)
        opens = by_step(self._opens).max(axis=1)
        values = self._flows.values
        return values(light), values(yields), values(opens)


class MaxPressure:
    """Signals that choose their stages."""

    def __init__(self, flows: Flows, lookahead: float):
        """lookahead: green after a change over which stages are compared (s)"""
        network = flows.network
        self._flows = flows
        self._lookahead = lookahead
        self._chooses = torch.as_tensor(network.signal >= 0, device=flows.device)
        self._signal = flows.places(np.maximum(network.signal, 0))
        self._light = flows.values(network.stage_light)
        self._yields = flows.values(network.stage_yields)
        self._loss = flows.values(network.stage_loss)
        self._least = flows.values(network.stage_least)
        self._count = flows.places(network.stages)
        self._link = flows.places(network.movement_link)
        self._pressed = flows.places(network.pressure_movement)
        self._presses = flows.places(network.pressure_link)
        self._weight = flows.values(network.pressure_weight)
        self._gain_stage = flows.places(network.gain_stage)
        self._gain_movement = flows.places(network.gain_movement)
        self._gain = flows.values(network.gain)
        self._period = max(round(DECISION_PERIOD_S / flows.dt), 1)

    def start(self, batch: int) -> Stages:
        """Return the state at first: all signals in their first stage."""
        signals, most = self._least.shape
        stage = torch.zeros(batch, signals, dtype=torch.long, device=self._flows.device)
        zeros = self._least.new_zeros(batch, signals)
        return Stages(stage, stage, zeros, zeros, self._least.new_zeros(batch, signals, most))

    def step(
        self, number: int, stages: Stages, inside: Tensor, programme: Lights
    ) -> tuple[Stages, Lights]:
        """Return the state and the lights of a step.

        number: of the step
        inside: vehicles by link (veh, (B, L))
        programme: lights of the signals that keep their programmes
        """
        if number % self._period == 0:
            with torch.no_grad():
                stages = self._decide(stages, inside)
        dt = self._flows.dt
        after = self._shown(self._light, stages.stage)
        before = self._shown(self._light, stages.before)
        # Those who gave way wait on the junction, and go while it clears.
        last = before * self._shown(self._yields, stages.before)
        kept = torch.maximum(torch.minimum(after, before), last)
        waits = (stages.clearing / dt).clamp(max=1.0).index_select(1, self._signal)
        light = waits * kept + (1.0 - waits) * after
        yields = (1.0 - waits) * self._shown(self._yields, stages.stage)
        begun = (dt - stages.clearing).clamp(min=0.0)
        running = torch.nn.functional.one_hot(stages.stage, self._least.shape[1])
        stages = stages._replace(
            clearing=(stages.clearing - dt).clamp(min=0.0),
            green=stages.green + begun,
            red=(stages.red + dt) * (1 - running),
        )
        light = torch.where(self._chooses, light, programme.light)
        return stages, Lights(light, torch.where(self._chooses, yields, programme.yields))

    def _shown(self, table: Tensor, stage: Tensor) -> Tensor:
        """Return what the stages (B, S) show, (B, M), from a table (M, n)."""
        place = stage.index_select(1, self._signal).unsqueeze(2)
        return table.expand(len(stage), -1, -1).gather(2, place).squeeze(2)

    def _decide(self, stages: Stages, inside: Tensor) -> Stages:
        """Return the state with the stages that each signal wants now."""
        own = stages.stage.unsqueeze(2)
        batch = len(own)
        signals, most = self._least.shape
        present = inside.index_select(1, self._link).unsqueeze(2)
        waiting = inside.new_zeros(batch, signals, most)
        waiting = waiting.index_add(1, self._signal, self._light * present)
        number = torch.arange(most, device=inside.device)
        exists = number < self._count.unsqueeze(1)
        called = (waiting >= CALLED_VEH) & exists & (number != own)
        rows = own.unsqueeze(3).expand(-1, -1, 1, most)
        loss = self._loss.expand(batch, -1, -1, -1).gather(2, rows).squeeze(2)
        least = self._least.expand(batch, -1, -1).gather(2, own).squeeze(2)

        pressure = self._pressure(inside)
        worth = pressure * self._lookahead / (self._lookahead + loss)
        worth = torch.where(called, worth, -torch.inf)
        overdue = torch.where(called & (stages.red >= LONGEST_RED_S), stages.red, 0.0)
        late = overdue.amax(2) > 0.0
        best = torch.where(late, overdue.argmax(2), worth.argmax(2))
        ahead = worth.amax(2) > pressure.gather(2, own).squeeze(2)
        too_long = stages.green + DECISION_PERIOD_S > LONGEST_GREEN_S
        may = (stages.clearing == 0.0) & (stages.green >= least) & called.any(2)
        switch = may & (ahead | too_long | late)
        lost = loss.gather(2, best.unsqueeze(2)).squeeze(2)
        return stages._replace(
            stage=torch.where(switch, best, stages.stage),
            before=torch.where(switch, stages.stage, stages.before),
            clearing=torch.where(switch, lost, stages.clearing),
            green=torch.where(switch, 0.0, stages.green),
        )

    def _pressure(self, inside: Tensor) -> Tensor:
        """Return the pressures of all stages (B, S, n)."""
        flows = self._flows
        weighed = inside.index_select(1, self._presses) * self._weight
        weight = flows.sums(weighed, self._pressed, flows.movements).clamp(min=0.0)
        gained = weight.index_select(1, self._gain_movement) * self._gain
        signals, most = self._least.shape
        return flows.sums(gained, self._gain_stage, signals * most).view(-1, signals, most)
