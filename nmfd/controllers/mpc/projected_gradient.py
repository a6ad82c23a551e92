"""Spectral projected gradients with a certificate.

They minimise smooth functions on simple convex sets.

Birgin, Martinez and Raydan, "Nonmonotone spectral projected gradient methods on convex sets", SIAM
J. Optim. 10 (2000).
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

MEMORY = 20  # recent values that a step is compared with: nonmonotone search
SUFFICIENT_DECREASE = 1e-4  # share of the decrease by the slope
MIN_STEP_SHARE = 1e-10  # below which the line search ends
MAX_STEP = 1e10  # spectral step length
AT_REST = "no further descent"
TIME_LIMIT = "time limit"
Function: TypeAlias = Callable[[np.ndarray], tuple[float, np.ndarray]]


class Late(Exception):
    """Deadline reached during an evaluation."""


@dataclass(frozen=True, kw_only=True)
class Minimum:
    """Result of a search.

    point, value: the best
    gap: bound on value minus minimum if the function is convex; else to first order, at a point
        that is no better
    reason: why the search stopped short of its tolerance, or None
    """

    point: np.ndarray
    value: float
    gap: float
    reason: str | None


class _Evaluated(NamedTuple):
    point: np.ndarray
    value: float
    gradient: np.ndarray


def minimise(
    function: Function,
    project: Callable[[np.ndarray], np.ndarray],
    gap: Callable[[np.ndarray, np.ndarray], float],
    start: np.ndarray,
    *,
    metric: np.ndarray | float = 1.0,
    tolerance: float,
    iterations: int,
    seconds: float,
) -> Minimum:
    """Descend from the admissible `start` until gap <= tolerance * |value|.

    function: point -> value and gradient; it may raise Late
    project: point -> nearest admissible point
    gap: (point, gradient) -> largest decrease of the linear model over admissible points
        (Frank-Wolfe)
    metric: weights of the squared length of a step, about proportional to the second derivatives;
        the nearest point in this metric must be that of `project`, as for bounds, and for simplices
        of one weight each
    seconds: time limit, checked after every evaluation (s)
    """
    deadline = time.perf_counter() + seconds
    try:
        here = _Evaluated(start, *function(start))
    except Late:
        return Minimum(point=start, value=np.inf, gap=np.inf, reason=TIME_LIMIT)
    if not (np.isfinite(here.value) and np.isfinite(here.gradient).all()):
        return Minimum(point=start, value=here.value, gap=np.inf, reason="not a number")
    best = here
    least = np.inf
    recent = deque([here.value], MEMORY)
    length = 1.0 / max(np.abs(here.gradient / metric).max(initial=0.0), 1.0 / MAX_STEP)
    for iteration in range(iterations + 1):
        now = gap(here.point, here.gradient)
        if now <= tolerance * abs(here.value):
            return Minimum(point=here.point, value=here.value, gap=now, reason=None)
        least = min(least, now)
        if here.value < best.value:
            best = here
        if iteration == iterations:
            reason = "iteration limit"
            break
        if time.perf_counter() > deadline:
            reason = TIME_LIMIT
            break
        direction = project(here.point - length * here.gradient / metric) - here.point
        there = _line_search(function, here, direction, max(recent), deadline)
        if isinstance(there, str):
            reason = there
            break
        moved = there.point - here.point
        curvature = float((moved * (there.gradient - here.gradient)).sum())
        length = 4.0 * length
        if curvature > 0:
            length = float((metric * moved**2).sum()) / curvature
        length = min(length, MAX_STEP)
        here = there
        recent.append(here.value)
    return Minimum(point=best.point, value=best.value, gap=least, reason=reason)


def _line_search(
    function: Function, here: _Evaluated, direction: np.ndarray, limit: float, deadline: float
) -> _Evaluated | str:
    """Return the first point with sufficient decrease, or why there is none.

    limit: value that the decrease counts from
    """
    slope = float((here.gradient * direction).sum())
    share = 1.0
    while True:
        point = here.point + share * direction
        try:
            there = _Evaluated(point, *function(point))
        except Late:
            return TIME_LIMIT
        if there.value <= limit + SUFFICIENT_DECREASE * share * slope:
            return there
        if time.perf_counter() > deadline:
            return TIME_LIMIT
        if share < MIN_STEP_SHARE:
            return AT_REST
        # Lowest point of the parabola through both values.
        lowest = -0.5 * share**2 * slope / (there.value - here.value - share * slope)
        trusted = 0.1 * share <= lowest <= 0.5 * share
        share = lowest if trusted else 0.5 * share
