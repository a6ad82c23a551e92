"""Signals of the link model: fixed, actuated, max-pressure, and gates.

A stage is a green phase of a programme. Max-pressure (Varaiya, 2013) chooses the stage with the
highest pressure, as cosim.plant.max_pressure does, with the model's own queues. The choice has no
derivative; the flows have one while the choices stay.

Actuated signals are SUMO's: the phases of the programme follow each other. A green phase lasts from
its least to its longest time while vehicles pass the detectors of its lanes, at a distance d before
the stop line. It ends 3 s after the last one has left them. Until t, N vehicles have passed:

    N = min(A(t + d / v), N_down(t - d / w) + n d / spacing)

A counts those who arrived at the stop line or left, the others are as in nmfd.model.links.flows.
The second term is the smaller one if a queue covers the detector, which extends the phase, too.

A gate leaves a movement, of each window of green with the capacity W (s), the share u:

    W - (1 - u) (G - LEAST_GREEN_S)                     from its beginning; G is its green (s)

as cosim.plant.gates does. Under max-pressure the window is the cycle. At actuated signals, W and G
are those of a cycle of the programme.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from nmfd.model.links.flows import EPSILON, LEAST, Flows, Traffic

LEAST_GREEN_S = 5.0  # of a gated movement in each window of green
DECISION_PERIOD_S = 5
LONGEST_GREEN_S = 50.0  # under max-pressure while others wait
LONGEST_RED_S = 120.0  # of a movement with vehicles; then a stage that serves it comes first
CALLED_VEH = 0.2  # vehicles that call a stage
FIXED = "fixed"
MAX_PRESSURE = "max-pressure"
ACTUATED = "actuated"
KEPT = 8  # intervals whose programmes are kept: with equal cycles, one is enough
GAP_S = 3.0  # SUMO's time without a vehicle on the detectors that ends a green


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
    red: time since each movement was last green (s, (B, M))
    """

    stage: Tensor
    before: Tensor
    clearing: Tensor
    green: Tensor
    red: Tensor


class Phases(NamedTuple):
    """State of B rollouts of actuated signals.

    phase: present phase (B, S); since: time since it began (s, (B, S))
    passed: vehicles that passed the detectors of each link so far (veh, (B, L))
    gap: time since the last one, or since a queue covered the detector (s, (B, L))
    had_left: vehicles that had left each link at the last h steps, the newest last (veh, (h, B, L))
    """

    phase: Tensor
    since: Tensor
    passed: Tensor
    gap: Tensor
    had_left: Tensor


class Responsive(Protocol):
    """Signals that follow the traffic; their state is Stages or Phases.

    period: steps after which their decisions fall on the same ones again
    """

    period: int

    def start(self, batch: int) -> Any:
        """Return the state before the first step."""

    def step(
        self, number: int, state: Any, traffic: Traffic, programme: Lights
    ) -> tuple[Any, Lights]:
        """Return the state and the lights of a step.

        number: of the step
        programme: lights of the signals that keep their programmes
        """


class Gates:
    """Limits of the green of gated movements.

    The state is the capacity used in the window (s).

    movements: gated ones; opens: True in seconds of the programmes with which a window begins
    """

    def __init__(self, flows: Flows, *, by_cycle: bool = False, of_programme: bool = True):
        """by_cycle: the window is the cycle, not a time of green
        of_programme: W and G are those of the programme, not the window
        """
        network = flows.network
        self._dt = flows.dt
        self.extended = by_cycle and of_programme
        self.movements = np.flatnonzero(network.gated)
        self.opens = np.zeros(len(network.light))
        whole = np.ones(len(self.movements))
        taken = np.ones(len(self.movements))
        for number, movement in enumerate(self.movements):
            begin = network.begin[movement]
            cycle = network.cycle[movement]
            light = network.light[begin : begin + cycle]
            opens = (light > 0.0) & (np.roll(light, 1) == 0.0)
            green = (light == 1.0).sum()
            capacity = flows.light[begin : begin + cycle].sum()
            if by_cycle:
                opens[:] = False
            if not of_programme:
                capacity = green = cycle
            if not opens.any():
                opens[0] = True
            self.opens[begin : begin + cycle] = opens
            whole[number] = capacity / opens.sum()
            taken[number] = max(green / opens.sum() - LEAST_GREEN_S, 0.0)
        self.movement = flows.places(self.movements)
        self.link = flows.places(network.movement_link[self.movements])
        self.whole = flows.values(whole)
        self.taken = flows.values(taken)
        self.cycle = flows.values(network.cycle[self.movements])

    def start(self, batch: int) -> Tensor:
        """Return the state (B, gates) before the first step."""
        return self.whole.new_zeros(batch, len(self.whole))

    def limit(
        self, used: Tensor, light: Tensor, opens: Tensor, share: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the state and the lights (B, M) under the gates.

        opens: 1 where a window begins with this step, else 0 (gates,)
        share: of the commands (-, (B, gates))
        """
        seconds = light.index_select(1, self.movement) * self._dt
        used = used * (1.0 - opens)
        budget = self.whole - (1.0 - share) * self.taken
        if self.extended:  # an open gate has more green than the programme
            budget = torch.where(share < 1.0, budget, self.cycle)
        left = ((budget - used) / seconds.clamp(min=LEAST)).clamp(0.0, 1.0)
        factor = torch.ones_like(light).index_copy(1, self.movement, left)
        return used + seconds * left, light * factor


class Programmes:
    """Fixed programmes, second by second."""

    def __init__(self, flows: Flows, opens: np.ndarray):
        """opens: of the gates"""
        self._flows = flows
        self._opens = opens
        self._period = math.lcm(*flows.network.cycle.tolist())
        self._read = lru_cache(maxsize=KEPT)(self._read_in_period)

    def read(self, begin: float, steps: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return lights, duties to give way and openings (steps, M).

        begin: time of the first step (s)
        """
        return self._read(round(begin) % self._period, steps)

    def _read_in_period(self, begin: int, steps: int) -> tuple[Tensor, Tensor, Tensor]:
        network = self._flows.network
        seconds = round(self._flows.dt)
        clock = begin + np.arange(steps * seconds)[:, None]
        place = network.begin + clock % network.cycle

        def by_step(values: np.ndarray) -> np.ndarray:
            return values[place].reshape(steps, seconds, -1)

        light = by_step(self._flows.light).mean(axis=1)
        yielding = by_step(self._flows.light * network.yields).mean(axis=1)
        yields = yielding / np.maximum(light, 1e-9)
        opens = by_step(self._opens).max(axis=1)
        values = self._flows.values
        return values(light), values(yields), values(opens)


def _shown(table: Tensor, stage: Tensor, signal: Tensor) -> Tensor:
    """Return what the stages (B, S) show, (B, M), from a table (M, n).

    signal: of each movement (M,)
    """
    place = stage.index_select(1, signal).unsqueeze(2)
    return table.expand(len(stage), -1, -1).gather(2, place).squeeze(2)


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
        self._serves = flows.values(network.stage_light > 0.0)
        self._yields = flows.values(network.stage_yields)
        self._loss = flows.values(network.stage_loss)
        self._lost = flows.values(flows.lost)
        self._least = flows.values(network.stage_least)
        self._count = flows.places(network.stages)
        self._link = flows.places(network.movement_link)
        self._pressed = flows.places(network.pressure_movement)
        self._presses = flows.places(network.pressure_link)
        self._weight = flows.values(network.pressure_weight)
        self._gain_stage = flows.places(network.gain_stage)
        self._gain_movement = flows.places(network.gain_movement)
        self._gain = flows.values(network.gain)
        self.period = DECISION_PERIOD_S // math.gcd(DECISION_PERIOD_S, round(flows.dt))

    def start(self, batch: int) -> Stages:
        """Return the state at first: all signals in their first stage."""
        signals = len(self._least)
        stage = torch.zeros(batch, signals, dtype=torch.long, device=self._flows.device)
        zeros = self._least.new_zeros(batch, signals)
        red = zeros.new_zeros(batch, len(self._light))
        return Stages(stage, stage, zeros, zeros, red)

    def step(
        self, number: int, stages: Stages, traffic: Traffic, programme: Lights
    ) -> tuple[Stages, Lights]:
        """Return the state and the lights of a step, as `Responsive`."""
        dt = self._flows.dt
        since = number * dt % DECISION_PERIOD_S  # the last decision was due
        if since < dt:
            with torch.no_grad():
                stages = self._decide(stages, traffic.inside)
        after = _shown(self._light, stages.stage, self._signal)
        before = _shown(self._light, stages.before, self._signal)
        # Those who gave way wait on the junction, and go while it clears.
        last = before * _shown(self._yields, stages.before, self._signal)
        clearing = stages.clearing.index_select(1, self._signal)
        lost = (self._lost - stages.green.index_select(1, self._signal)).clamp(min=0.0)
        waits = (clearing / dt).clamp(max=1.0)
        starts = ((clearing + lost) / dt).clamp(max=1.0)
        both = torch.minimum(after, before)
        kept = torch.maximum(both, last)
        light = waits * kept + (starts - waits) * both + (1.0 - starts) * after
        yields = (1.0 - waits) * _shown(self._yields, stages.stage, self._signal)
        begun = (dt - stages.clearing).clamp(min=0.0)
        stages = stages._replace(
            clearing=(stages.clearing - dt).clamp(min=0.0),
            green=stages.green + begun,
            red=torch.where(after > 0.0, 0.0, stages.red + dt),
        )
        light = torch.where(self._chooses, light, programme.light)
        return stages, Lights(light, torch.where(self._chooses, yields, programme.yields))

    def _decide(self, stages: Stages, inside: Tensor) -> Stages:
        """Return the state with the stages that each signal wants now."""
        own = stages.stage.unsqueeze(2)
        batch = len(own)
        signals, most = self._least.shape
        present = inside.index_select(1, self._link)
        waiting = inside.new_zeros(batch, signals, most)
        waiting = waiting.index_add(1, self._signal, self._light * present.unsqueeze(2))
        number = torch.arange(most, device=inside.device)
        exists = number < self._count.unsqueeze(1)
        called = (waiting >= CALLED_VEH) & exists & (number != own)
        rows = own.unsqueeze(3).expand(-1, -1, 1, most)
        loss = self._loss.expand(batch, -1, -1, -1).gather(2, rows).squeeze(2)
        least = self._least.expand(batch, -1, -1).gather(2, own).squeeze(2)

        pressure = self._pressure(inside)
        worth = pressure * self._lookahead / (self._lookahead + loss)
        worth = torch.where(called, worth, -torch.inf)
        too_late = (stages.red >= LONGEST_RED_S) & (present >= CALLED_VEH)
        red = torch.where(too_late, stages.red, 0.0).unsqueeze(2)
        overdue = torch.zeros_like(waiting).index_add(1, self._signal, self._serves * red)
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


class Actuated:
    """Signals that extend green while vehicles arrive."""

    period = 1

    def __init__(self, flows: Flows, *, gateways_fixed: bool):
        """gateways_fixed: signals of gated movements keep their programmes"""
        network = flows.network
        self._flows = flows
        signal = np.maximum(network.signal, 0)
        responds = (network.phase_least < network.phase_most).any(axis=1)
        if gateways_fixed:
            responds[network.signal[network.gated & (network.signal >= 0)]] = False
        chooses = (network.signal >= 0) & responds[signal]
        second = np.where(chooses[:, None], network.phase_second[signal], 0)
        place = network.begin[:, None] + second
        self._chooses = torch.as_tensor(chooses, device=flows.device)
        self._signal = flows.places(signal)
        self._light = flows.values(network.light[place])
        self._yielding = flows.values(network.light[place] * network.yields[place])
        before = np.tile(np.arange(second.shape[1]) - 1, (len(signal), 1))
        before[:, 0] = network.phases[signal] - 1
        red_before = np.take_along_axis(network.light[place], before, axis=1) == 0.0
        self._lost = flows.values(flows.lost[:, None] * red_before)
        self._count = flows.places(network.phases)
        self._least = flows.values(network.phase_least)
        self._most = flows.values(network.phase_most)
        self._detected = flows.places(network.detected)
        self._detecting = flows.places(network.detecting)
        time = network.detector / flows.speed
        ahead = np.minimum(time, flows.dt)
        self._ahead = flows.values(ahead / flows.dt)
        # A gap begins when a vehicle has left the detector.
        self._added = flows.values(time - ahead - flows.spacing / flows.speed)
        lanes = np.bincount(network.lane_link, minlength=flows.links)
        self._between = flows.values(lanes * network.detector / flows.spacing)
        steps = np.round(network.detector / flows.wave / flows.dt).astype(int)
        self._kept = int(steps.max(initial=0)) + 1
        self._back = flows.places(self._kept - 1 - steps)

    def start(self, batch: int) -> Phases:
        """Return the state at first: all signals begin their programmes."""
        signals = len(self._least)
        phase = torch.zeros(batch, signals, dtype=torch.long, device=self._flows.device)
        since = self._least.new_zeros(batch, signals)
        passed = self._least.new_zeros(batch, self._flows.links)
        had_left = passed.expand(self._kept, -1, -1)
        return Phases(phase, since, passed, torch.full_like(passed, GAP_S), had_left)

    def step(
        self, number: int, phases: Phases, traffic: Traffic, programme: Lights
    ) -> tuple[Phases, Lights]:
        """Return the state and the lights of a step, as `Responsive`."""
        seconds = round(self._flows.dt)
        with torch.no_grad():
            phases = self._detect(phases, traffic)
            gap = self._gap_of_phases(phases.gap)
        light = torch.zeros_like(programme.light)
        yielding = torch.zeros_like(light)
        for second in range(seconds):
            phases = self._next(phases, gap + second)
            lost = _shown(self._lost, phases.phase, self._signal)
            begun = (phases.since.index_select(1, self._signal) - lost).clamp(0.0, 1.0) / seconds
            light = light + begun * _shown(self._light, phases.phase, self._signal)
            yielding = yielding + begun * _shown(self._yielding, phases.phase, self._signal)
        yields = yielding / light.clamp(min=1e-9)
        light = torch.where(self._chooses, light, programme.light)
        return phases, Lights(light, torch.where(self._chooses, yields, programme.yields))

    def _detect(self, phases: Phases, traffic: Traffic) -> Phases:
        """Return the state with the vehicles that pass a detector in this step."""
        flows = self._flows
        near = flows.near(traffic, self._ahead)
        had_left = torch.cat([phases.had_left[1:], traffic.left.unsqueeze(0)])
        queue = had_left.gather(0, self._back.expand(1, len(near), -1)).squeeze(0) + self._between
        passed = torch.minimum(traffic.left + near, queue)
        last = torch.floor(passed + 0.5) - 0.5
        ago = flows.dt * (passed - last) / (passed - phases.passed).clamp(min=EPSILON)
        gap = torch.where(last > phases.passed, ago, phases.gap + flows.dt)
        gap = torch.where(traffic.left + near > queue, 0.0, gap)
        return phases._replace(passed=passed, gap=gap, had_left=had_left)

    def _gap_of_phases(self, gap: Tensor) -> Tensor:
        """Return the least gap of the links that extend each phase (s, (B, S, p)).

        gap: of the links (s, (B, L))
        """
        signals, most = self._least.shape
        seen = (gap + self._added).index_select(1, self._detected)
        none = gap.new_full((len(gap), signals * most), torch.inf)
        place = self._detecting.expand_as(seen)
        return none.scatter_reduce(1, place, seen, "amin").view(-1, signals, most)

    def _next(self, phases: Phases, gap: Tensor) -> Phases:
        """Return the state in the second that begins.

        gap: of all phases (s, (B, S, p))
        """
        phase = phases.phase
        least = self._least.gather(1, phase.T).T
        most = self._most.gather(1, phase.T).T
        gap = gap.gather(2, phase.unsqueeze(2)).squeeze(2)
        ends = (phases.since >= least) & (gap >= GAP_S)
        ends = ends | (phases.since >= most)
        return phases._replace(
            phase=torch.where(ends, (phase + 1) % self._count, phase),
            since=torch.where(ends, 0.0, phases.since) + 1.0,
        )
