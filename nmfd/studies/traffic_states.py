"""Traffic state of a region from its measured outflow, since the same accumulation can flow or stand."""

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

WINDOW = 3  # control intervals of the moving averages
NEAR_SHARE = 0.9  # of the largest outflow: near capacity
COLLAPSED_SHARE = 0.7  # of the largest outflow in the runs, with more vehicles than then: congested
SLOW_SHARE, STANDING_SHARE = 1 / 3, 0.1  # of the possible outflow
LEAST_VEHICLES = 5.0  # for an outflow per vehicle
LEAST_POSSIBLE = 10.0  # vehicles that could leave within the window: with fewer, none may be chance
LEAST_COUNTED = 30.0  # vehicles within the window at the largest outflow: with fewer, less may be chance
STRIP_HEIGHT, STRIPS_HEIGHT = 0.045, 0.3  # of one, and of all at most, as shares of the axes

RegionalOutflow = Float[np.ndarray, "T R"]
OutflowOf = Callable[[Result], RegionalOutflow | None]


class TrafficState(IntEnum):
    """State of a region during a control interval."""

    FLOWING = 0
    NEAR_CAPACITY = 1
    CONGESTED = 2
    STANDING = 3


# Label, colour, hatch; from light to dark.
LOOKS = {
    TrafficState.FLOWING: ("below critical and flowing", "#dfeee0", ""),
    TrafficState.NEAR_CAPACITY: ("near capacity: outflow within 10 % of the largest", "#6cbf84", ""),
    TrafficState.CONGESTED: ("congested or held back: less leaves than could", "#c1440e", ""),
    TrafficState.STANDING: ("standing: hardly any vehicle leaves", "#1d0b2e", "////"),
}


def states(
    mfd: Mfd, step: float, accumulation: Sequence[Float[np.ndarray, " S"]], outflow: Sequence[Float[np.ndarray, " T"]]
) -> list[Int[np.ndarray, " T"]]:
    """Return the TrafficState of one region in each interval of some runs.

    Near capacity: outflow near the largest of curve and runs. Congested: less beyond the critical accumulation, or less
    than COLLAPSED_SHARE of the largest with more vehicles, or less than SLOW_SHARE of the possible outflow. Standing:
    less than STANDING_SHARE of it.

    accumulation: [veh] and outflow: [veh/s] of each run
    """
    x = [_smooth(0.5 * (run[1:] + run[:-1])) for run in accumulation]
    q = [_smooth(run) for run in outflow]
    every_x, every_q = np.concatenate([np.zeros(0), *x]), np.concatenate([np.zeros(0), *q])
    best = int(np.argmax(every_q)) if len(every_q) else 0
    largest, held = (every_q[best], every_x[best]) if len(every_q) else (0.0, 0.0)
    most = max(mfd.capacity, largest)
    free = max([mfd.c, *(every_q / np.maximum(every_x, LEAST_VEHICLES))])
    significant = largest * step * WINDOW >= LEAST_COUNTED
    series, stay = [], 1 + int(np.ceil(1.0 / (free * step)))
    for run, one, out in zip(accumulation, x, q, strict=True):
        state = np.full(len(one), int(TrafficState.FLOWING))
        state[(one > mfd.critical) | (significant & (one > 1.1 * held) & (out < COLLAPSED_SHARE * largest))] = (
            TrafficState.CONGESTED
        )
        possible = np.minimum(free * _lasting(one, run[0], stay), most)
        enough = possible * step * WINDOW >= LEAST_POSSIBLE
        state[enough & (out < SLOW_SHARE * possible)] = TrafficState.CONGESTED
        state[out >= NEAR_SHARE * most] = TrafficState.NEAR_CAPACITY
        state[enough & (out < STANDING_SHARE * possible)] = TrafficState.STANDING
        series.append(state)
    return series


def _smooth(values: np.ndarray) -> np.ndarray:
    """Return moving averages (T,) over WINDOW intervals, fewer at the ends."""
    window = np.ones(min(WINDOW, len(values)))
    return np.convolve(values, window, mode="same") / np.convolve(np.ones(len(values)), window, mode="same")


def _lasting(x: np.ndarray, first: float, stay: int) -> np.ndarray:
    """Return the least accumulation (T,) [veh] of the last `stay` intervals: new vehicles cannot leave yet."""
    return np.lib.stride_tricks.sliding_window_view(np.concatenate([np.full(stay, first), x]), stay + 1).min(axis=1)


def model_outflow(network: RegionalModel) -> OutflowOf:
    """Return a function: outflow (T, R) [veh/s] of a run on a regional plant, None for other plants."""
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


def draw_strips(
    ax: Axes,
    time: Sequence[Float[np.ndarray, " S"]],
    runs: Sequence[Int[np.ndarray, " T"]],
    tones: Sequence[str],
    hollow: Sequence[bool],
) -> float:
    """Draw a strip of states per run at the top of `ax`, with a mark in the colour of the run; return the share below.

    time: edges of the intervals, in the unit of the axis; hollow: marks without filling
    """
    height = min(STRIP_HEIGHT, STRIPS_HEIGHT / max(len(runs), 1))
    for row, (edges, state, tone, empty) in enumerate(zip(time, runs, tones, hollow, strict=True)):
        y, begin = 1.0 - (row + 1) * height, 0
        for kind, members in groupby(state.tolist()):
            end = begin + len(list(members))
            label, fill, hatch = LOOKS[TrafficState(kind)]
            style = dict(facecolor=fill, edgecolor="#ffffff" if hatch else fill, hatch=hatch, linewidth=0.0, zorder=4)
            bar, where = [(edges[begin], edges[end] - edges[begin])], (y + 0.1 * height, 0.8 * height)
            ax.broken_barh(bar, where, label=label, transform=ax.get_xaxis_transform(), **style)
            begin = end
        mark = dict(marker="s", facecolor="none" if empty else tone, edgecolor=tone, linewidths=0.8, zorder=5)
        ax.scatter([-0.025], [y + 0.5 * height], s=9, transform=ax.transAxes, clip_on=False, **mark)
    return 1.0 - len(runs) * height
