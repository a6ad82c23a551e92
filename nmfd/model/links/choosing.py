"""Max-pressure in machine code; signals.MaxPressure is the reference."""

from typing import Any, NamedTuple

import numpy as np

from nmfd.model.links.compiled import compiled, inner
from nmfd.model.links.signals import Lights, Stages


class Choosing(NamedTuple):
    """Places and numbers of MaxPressure, with its names.

    called, decision_period, longest_green, longest_red: constants of nmfd.model.links.signals
    dt, zero, one: as of City
    """

    chooses: Any
    signal: Any
    light: Any
    yields: Any
    loss: Any
    least: Any
    count: Any
    link: Any
    pressed: Any
    presses: Any
    weight: Any
    gain_stage: Any
    gain_movement: Any
    gain: Any
    called: Any
    decision_period: Any
    longest_green: Any
    longest_red: Any
    lookahead: Any
    dt: Any
    zero: Any
    one: Any


@compiled
def choose(signals: Choosing, inside: np.ndarray, stages: Stages) -> None:
    """Change stages (signals.Stages) to those that signals want now.

    inside: vehicles on each link (veh, (B, L))
    """
    zero = signals.zero
    most = signals.light.shape[1]
    pressure = np.empty(signals.least.size, inside.dtype)
    waiting = np.empty(signals.least.shape, inside.dtype)
    weight = np.empty(len(signals.signal), inside.dtype)
    for b in range(len(inside)):
        weight[:] = zero
        for n in range(len(signals.pressed)):
            weight[signals.pressed[n]] += inside[b, signals.presses[n]] * signals.weight[n]
        pressure[:] = zero
        for n in range(len(signals.gain)):
            gained = max(weight[signals.gain_movement[n]], zero) * signals.gain[n]
            pressure[signals.gain_stage[n]] += gained
        waiting[:] = zero
        for m in range(len(weight)):
            for n in range(most):
                present = signals.light[m, n] * inside[b, signals.link[m]]
                waiting[signals.signal[m], n] += present
        for s in range(len(waiting)):
            own = stages.stage[b, s]
            wanted = _wanted(signals, stages, b, s, waiting[s], pressure[s * most : (s + 1) * most])
            may = stages.clearing[b, s] == zero and stages.green[b, s] >= signals.least[s, own]
            if may and wanted != own:
                stages.stage[b, s] = wanted
                stages.before[b, s] = own
                stages.clearing[b, s] = signals.loss[s, own, wanted]
                stages.green[b, s] = zero


@inner
def _wanted(
    signals: Choosing,
    stages: Stages,
    b: int,
    s: int,
    waiting: np.ndarray,
    pressure: np.ndarray,
) -> int:
    """Return the stage that signal s wants.

    waiting: vehicles for each stage (veh, (n,)); pressure: of each stage (n,)
    """
    own = stages.stage[b, s]
    best = own
    overdue = own
    ahead = signals.zero
    longest = signals.zero
    for n in range(signals.count[s]):
        if n == own or waiting[n] < signals.called:
            continue
        kept = signals.lookahead / (signals.lookahead + signals.loss[s, own, n])
        if best == own or pressure[n] * kept > ahead:
            ahead = pressure[n] * kept
            best = n
        red = stages.red[b, s, n]
        if red >= signals.longest_red and red > longest:
            longest = red
            overdue = n
    if overdue != own:
        return overdue
    too_long = stages.green[b, s] + signals.decision_period > signals.longest_green
    return best if too_long or ahead > pressure[own] else own


@compiled
def show(signals: Choosing, stages: Stages, lights: Lights) -> None:
    """Set the lights of K steps, and the stages after them.

    lights: signals.Lights (K, B, M) of the programmes, which some signals keep
    """
    zero = signals.zero
    dt = signals.dt
    for k in range(len(lights.light)):
        for b in range(len(stages.stage)):
            _show(signals, stages, lights.light[k, b], lights.yields[k, b], b)
            for s in range(len(signals.count)):
                stages.green[b, s] += max(dt - stages.clearing[b, s], zero)
                stages.clearing[b, s] = max(stages.clearing[b, s] - dt, zero)
                for n in range(signals.light.shape[1]):
                    stages.red[b, s, n] += dt
                stages.red[b, s, stages.stage[b, s]] = zero


@inner
def _show(signals: Choosing, stages: Stages, light: np.ndarray, yields: np.ndarray, b: int) -> None:
    """Set the lights (M,) and duties to give way (M,) of rollout b in a step."""
    one = signals.one
    for m in range(len(signals.signal)):
        if not signals.chooses[m]:
            continue
        s = signals.signal[m]
        stage = stages.stage[b, s]
        earlier = stages.before[b, s]
        after = signals.light[m, stage]
        before = signals.light[m, earlier]
        # Those who gave way wait on the junction, and go while it clears.
        kept = max(min(after, before), before * signals.yields[m, earlier])
        waits = min(stages.clearing[b, s] / signals.dt, one)
        light[m] = waits * kept + (one - waits) * after
        yields[m] = (one - waits) * signals.yields[m, stage]
