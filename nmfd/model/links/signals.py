"""Signals of the link model: fixed programmes, stages by actuation or max-pressure, and gates.

A stage is a green phase of a programme. Actuated signals show their stages in turn, each until its
queues are empty, between a least and a largest green. Max-pressure (Varaiya, 2013) chooses the
stage with the highest pressure, as cosim.plant.max_pressure does, with the model's own queues. The
choice has no derivative; the flows have one while the choices stay.

A gate leaves a movement, of each window of green with the capacity W (s), the share u:

    W - (1 - u) (G - LEAST_GREEN_S)                     from its beginning; G is its green (s)

as cosim.plant.gates does. Under max-pressure the window is the cycle.
"""

from typing import NamedTuple

import numpy as np
import torch

from nmfd.model.links.flows import LEAST, Flows, Tensor, Traffic

LEAST_GREEN_S = 5.0  # of a gated movement in each window of green
DECISION_PERIOD_S = 5.0
LONGEST_GREEN_S = 50.0  # under max-pressure while others wait
LONGEST_RED_S = 120.0  # then a stage with vehicles comes first
CALLED_VEH = 0.2  # vehicles that call a stage
FIXED, ACTUATED, MAX_PRESSURE = "fixed", "actuated", "max-pressure"


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
    """Limits the green of gated movements; its state is the capacity used in the window (s)."""

    def __init__(self, flows: Flows, *, by_cycle: bool):
        """by_cycle: the window is the cycle, not a time of green"""
        network = flows.network
        self._flows = flows
        self.movements = np.flatnonzero(network.gated)
        self.opens = np.zeros(len(network.light))  # seconds of the programmes: a window begins
        whole, taken = np.ones(len(self.movements)), np.ones(len(self.movements))
        for number, movement in enumerate(self.movements):
            cycle, begin = network.cycle[movement], network.begin[movement]
            light = network.light[begin : begin + cycle]
            opens = (light > 0.0) & (np.roll(light, 1) == 0.0)
            whole[number], green = light.sum(), (light == 1.0).sum()
            if by_cycle:
                opens[:] = False
                whole[number] = green = cycle
            if not opens.any():
                opens[0] = True
            self.opens[begin : begin + cycle] = opens
            whole[number] /= opens.sum()
            taken[number] = max(green / opens.sum() - LEAST_GREEN_S, 0.0)
        self.places = flows.places(self.movements)
        self._whole, self._taken = flows.values(whole), flows.values(taken)

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
        seconds = light.index_select(1, self.places) * self._flows.dt
        used = used * (1.0 - opens)
        budget = self._whole - (1.0 - share) * self._taken
        left = ((budget - used) / seconds.clamp(min=LEAST)).clamp(0.0, 1.0)
        factor = torch.ones_like(light).index_copy(1, self.places, left)
        return used + seconds * left, light * factor


class Programmes:
    """Fixed programmes, second by second."""

    def __init__(self, flows: Flows, opens: np.ndarray):
        """opens: seconds of the programmes in which a gate's window begins (S,)"""
        self._flows, self._opens = flows, opens

    def read(self, begin: float, steps: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return lights, duties to give way and openings (steps, M) from `begin` (s) on."""
        network, seconds = self._flows.network, round(self._flows.dt)
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


class StageSignals:
    """Signals that choose their stages, actuated or by max-pressure."""

    def __init__(self, flows: Flows, kind: str, lookahead: float, *, gateways_fixed: bool):
        """lookahead: green after a change over which max-pressure compares (s)

        gateways_fixed: signals with gates keep their programmes
        """
        network = flows.network
        self._flows, self._kind, self._lookahead = flows, kind, lookahead
        chosen = network.signal >= 0
        if gateways_fixed:
            chosen &= ~np.isin(network.signal, network.signal[network.gated])
        self.chooses = torch.as_tensor(chosen, device=flows.device)
        self._signal = flows.places(np.maximum(network.signal, 0))
        self._light, self._yields = (
            flows.values(network.stage_light),
            flows.values(network.stage_yields),
        )
        self._loss = flows.values(network.stage_loss)
        self._least = flows.values(network.stage_least)
        self._most = flows.values(network.stage_most)
        self._count = flows.places(network.stages)
        self._link = flows.places(network.movement_link)
        self._weighs = flows.places(network.pressure_movement), flows.places(network.pressure_link)
        self._weight = flows.values(network.pressure_weight)
        self._gains = flows.places(network.gain_stage), flows.places(network.gain_movement)
        self._gain = flows.values(network.gain)
        self._period = max(round(DECISION_PERIOD_S / flows.dt), 1)

    def start(self, batch: int) -> Stages:
        """Return the state before the first step: all signals in their first stage."""
        signals, most = self._least.shape
        stage = torch.zeros(batch, signals, dtype=torch.long, device=self._flows.device)
        zeros = self._least.new_zeros(batch, signals)
        return Stages(stage, stage, zeros, zeros, self._least.new_zeros(batch, signals, most))

    def step(
        self, number: int, stages: Stages, traffic: Traffic, closed: Tensor, programme: Lights
    ) -> tuple[Stages, Lights]:
        """Return the state and the lights of a step.

        number: of the step; closed: 1 for movements without more green in this cycle (B, M)
        programme: lights of the signals that keep their programmes
        """
        if number % self._period == 0:
            with torch.no_grad():
                stages = self._decide(stages, traffic, closed)
        flows, dt = self._flows, self._flows.dt
        batch = len(stages.stage)

        def shown(table: Tensor, stage: Tensor) -> Tensor:
            place = stage.index_select(1, self._signal).unsqueeze(2)
            return table.expand(batch, -1, -1).gather(2, place).squeeze(2)

        after, before = shown(self._light, stages.stage), shown(self._light, stages.before)
        kept = torch.minimum(after, before)
        waits = (stages.clearing / dt).clamp(max=1.0).index_select(1, self._signal)
        light = waits * kept + (1.0 - waits) * after
        yields = shown(self._yields, stages.stage)
        begun = (dt - stages.clearing).clamp(min=0.0)
        running = torch.nn.functional.one_hot(stages.stage, self._least.shape[1])
        stages = stages._replace(
            clearing=(stages.clearing - dt).clamp(min=0.0),
            green=stages.green + begun,
            red=(stages.red + dt) * (1 - running),
        )
        light = torch.where(self.chooses, light, programme.light)
        return stages, Lights(light, torch.where(self.chooses, yields, programme.yields))

    def _decide(self, stages: Stages, traffic: Traffic, closed: Tensor) -> Stages:
        """Return the state with the stages that each signal wants now."""
        flows, own = self._flows, stages.stage.unsqueeze(2)
        signals, most = self._least.shape
        present = traffic.inside.index_select(1, self._link) * (1.0 - closed)
        waiting = torch.zeros(len(own), signals, most, dtype=flows.dtype, device=flows.device)
        waiting = waiting.index_add(1, self._signal, self._light * present.unsqueeze(2))
        number = torch.arange(most, device=flows.device)
        exists = number < self._count.unsqueeze(1)
        called = (waiting >= CALLED_VEH) & exists & (number != own)
        loss = self._loss.expand(len(own), -1, -1, -1)
        loss = loss.gather(2, own.unsqueeze(3).expand(-1, -1, 1, most)).squeeze(2)
        least = self._least.expand(len(own), -1, -1).gather(2, own).squeeze(2)
        if self._kind == ACTUATED:
            best = torch.where(called, (number - own - 1) % self._count.unsqueeze(1), most)
            best = best.argmin(2)
            longest = self._most.expand(len(own), -1, -1).gather(2, own).squeeze(2)
            wants = (waiting.gather(2, own).squeeze(2) < CALLED_VEH) | (stages.green >= longest)
        else:
            pressure = self._pressure(traffic.inside, closed)
            worth = pressure * self._lookahead / (self._lookahead + loss)
            worth = torch.where(called, worth, -torch.inf)
            overdue = torch.where(called & (stages.red >= LONGEST_RED_S), stages.red, 0.0)
            late = overdue.amax(2) > 0.0
            best = torch.where(late, overdue.argmax(2), worth.argmax(2))
            ahead = worth.amax(2) > pressure.gather(2, own).squeeze(2)
            too_long = stages.green + DECISION_PERIOD_S > LONGEST_GREEN_S
            wants = ahead | too_long | late
        may = (stages.clearing == 0.0) & (stages.green >= least) & called.any(2)
        switch = may & wants
        return stages._replace(
            stage=torch.where(switch, best, stages.stage),
            before=torch.where(switch, stages.stage, stages.before),
            clearing=torch.where(
                switch, loss.gather(2, best.unsqueeze(2)).squeeze(2), stages.clearing
            ),
            green=torch.where(switch, 0.0, stages.green),
        )

    def _pressure(self, inside: Tensor, closed: Tensor) -> Tensor:
        """Return the pressures of all stages (B, S, n)."""
        movement, link = self._weighs
        weighed = inside.index_select(1, link) * self._weight
        weight = self._flows.sums(weighed, movement, self._flows.movements)
        weight = weight.clamp(min=0.0) * (1.0 - closed)
        stage, movement = self._gains
        gained = weight.index_select(1, movement) * self._gain
        signals, most = self._least.shape
        return self._flows.sums(gained, stage, signals * most).view(-1, signals, most)
