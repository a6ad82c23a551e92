"""What state a region is in, by what leaves it: told from measured outflow, not from a fitted curve alone.

The same accumulation can flow or stand, and a fitted curve may be wrong; therefore a picture that colours a region
looks at how many vehicles left it in the run that it shows.
"""

from collections.abc import Callable, Sequence
from enum import IntEnum
from itertools import groupby

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.axes import Axes

from nmfd.model import dynamics
from nmfd.model.mfd import Mfd
from nmfd.model.regional_model import RegionalModel
from nmfd.types import Result

WINDOW = 3  # control intervals over which accumulation and outflow are averaged: single ones are noisy
NEAR = 0.9  # of the largest outflow: near capacity
COLLAPSED = 0.7  # of the largest outflow in the runs, with more vehicles than then: congested, whatever the curve says
SLOW = 1 / 3  # of what could leave: congested, or held back
STANDING = 0.1  # of what could leave: the free outflow of so many vehicles, or the largest
FEWEST = 5.0  # vehicles, for an outflow per vehicle that means something
EXPECTED = 10.0  # vehicles that would have left if they had been free: with fewer, none may be chance
COUNTED = 30.0  # vehicles that left at the largest outflow: with fewer, less may be chance
STRIP, STRIPS = 0.045, 0.3  # height of a strip, and of all together at most, as shares of the axes

RegionalOutflow = Float[np.ndarray, "T R"]
OutflowOf = Callable[[Result], RegionalOutflow | None]


class TrafficState(IntEnum):
    """Of a region during a control interval."""

    FLOWING = 0
    NEAR_CAPACITY = 1
    CONGESTED = 2
    STANDING = 3


# Label, colour, hatch: from light to dark, so that they are told apart in grey and by colour-blind readers, too.
LOOKS = {
    TrafficState.FLOWING: ("below critical and flowing", "#dfeee0", ""),
    TrafficState.NEAR_CAPACITY: ("near capacity: outflow within 10 % of the largest", "#6cbf84", ""),
    TrafficState.CONGESTED: ("congested or held back: less leaves than could", "#c1440e", ""),
    TrafficState.STANDING: ("standing: hardly any vehicle leaves", "#1d0b2e", "////"),
}


def states(
    mfd: Mfd, step: float, accumulation: Sequence[Float[np.ndarray, " S"]], outflow: Sequence[Float[np.ndarray, " T"]]
) -> list[Int[np.ndarray, " T"]]:
    """The TrafficState of one region in every interval of some runs, accumulations [veh] and outflows [veh/s] each.

    near capacity: the outflow is within 10 % of the largest, which is that of the curve or, if more, of the runs;
    congested: beyond the critical accumulation with less outflow, or holding more vehicles than at the largest outflow
    of the runs and letting out less than COLLAPSED of it, or less than SLOW of what could leave; standing: less than
    STANDING of that
    """
    x = [_smooth(0.5 * (run[1:] + run[:-1])) for run in accumulation]
    q = [_smooth(run) for run in outflow]
    every_x, every_q = np.concatenate([np.zeros(0), *x]), np.concatenate([np.zeros(0), *q])
    best = int(np.argmax(every_q)) if len(every_q) else 0
    largest, held = (every_q[best], every_x[best]) if len(every_q) else (0.0, 0.0)
    most = max(mfd.capacity, largest)
    free = max([mfd.c, *(every_q / np.maximum(every_x, FEWEST))])
    told = largest * step * WINDOW >= COUNTED
    found, stay = [], 1 + int(np.ceil(1.0 / (free * step)))
    for run, one, out in zip(accumulation, x, q, strict=True):
        state = np.full(len(one), int(TrafficState.FLOWING))
        state[(one > mfd.critical) | (told & (one > 1.1 * held) & (out < COLLAPSED * largest))] = TrafficState.CONGESTED
        could = np.minimum(free * _for_a_while(one, run[0], stay), most)
        enough = could * step * WINDOW >= EXPECTED
        state[enough & (out < SLOW * could)] = TrafficState.CONGESTED
        state[out >= NEAR * most] = TrafficState.NEAR_CAPACITY
        state[enough & (out < STANDING * could)] = TrafficState.STANDING
        found.append(state)
    return found


def _smooth(values: np.ndarray) -> np.ndarray:
    """(T,): means over WINDOW intervals around each, fewer at the ends."""
    window = np.ones(min(WINDOW, len(values)))
    return np.convolve(values, window, mode="same") / np.convolve(np.ones(len(values)), window, mode="same")


def _for_a_while(x: np.ndarray, first: float, stay: int) -> np.ndarray:
    """(T,) [veh]: what a region has held at least for `stay` intervals; who has just come cannot leave yet."""
    return np.lib.stride_tricks.sliding_window_view(np.concatenate([np.full(stay, first), x]), stay + 1).min(axis=1)


def model_outflow(network: RegionalModel) -> OutflowOf:
    """What leaves every region of a run on a regional plant [veh/s]; nothing of a microsimulation, which measures it
    itself."""
    p = dynamics.parameters(network)

    def outflow(trajectory: Result) -> RegionalOutflow | None:
        if trajectory.plant not in ("nmfd", "acyclic"):
            return None
        x, u, theta = (
            torch.from_numpy(np.asarray(part, dtype=float))
            for part in (trajectory.accumulation[:-1], trajectory.perimeter, trajectory.splits)
        )
        completions, transfers = dynamics.flows(p, x, u, theta)
        return (completions + transfers.sum(dim=(-1, -2))).numpy()

    return outflow


def remembered(outflow: OutflowOf) -> OutflowOf:
    """The same, asked once per run: pictures ask for every region."""
    known: dict[tuple[str, str, int], RegionalOutflow | None] = {}

    def once(trajectory: Result) -> RegionalOutflow | None:
        key = trajectory.controller, trajectory.plant, trajectory.seed
        if key not in known:
            known[key] = outflow(trajectory)
        return known[key]

    return once


def draw_strips(
    ax: Axes,
    time: Sequence[Float[np.ndarray, " S"]],
    found: Sequence[Int[np.ndarray, " T"]],
    tones: Sequence[str],
    hollow: Sequence[bool],
) -> float:
    """A strip per run at the top of `ax` in the colours of its states, a mark in the run's own colour before it, or a
    hollow one; returns the share of the axes that is left below them. time: of the states, in the unit of the axis."""
    height = min(STRIP, STRIPS / max(len(found), 1))
    for row, (edges, state, tone, empty) in enumerate(zip(time, found, tones, hollow, strict=True)):
        y = 1.0 - (row + 1) * height
        begin = 0
        for kind, members in groupby(state.tolist()):
            end = begin + len(list(members))
            label, fill, hatch = LOOKS[TrafficState(kind)]
            ax.broken_barh(
                [(edges[begin], edges[end] - edges[begin])],
                (y + 0.1 * height, 0.8 * height),
                facecolor=fill,
                edgecolor="#ffffff" if hatch else fill,
                hatch=hatch,
                linewidth=0.0,
                label=label,
                transform=ax.get_xaxis_transform(),
                zorder=4,
            )
            begin = end
        ax.scatter(
            [-0.025],
            [y + 0.5 * height],
            s=9,
            marker="s",
            facecolor="none" if empty else tone,
            edgecolor=tone,
            transform=ax.transAxes,
            clip_on=False,
            linewidths=0.8,
            zorder=5,
        )
    return 1.0 - len(found) * height
