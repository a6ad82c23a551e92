"""Spectral projected gradients with a certificate, for smooth functions on simple convex sets.

Birgin, Martinez and Raydan, "Nonmonotone spectral projected gradient methods on convex sets", SIAM
J. Optim. 10 (2000).
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

MEMORY = 20  # recent values that a step is compared with: nonmonotone search
SUFFICIENT_DECREASE = 1e-4  # share of the decrease by the slope
MIN_STEP_SHARE = 1e-10  # below which the line search ends
MAX_STEP = 1e10  # spectral step length
AT_REST = "no further descent"
TIME_LIMIT = "time limit"


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


def minimise(
    function: Callable[[np.ndarray], tuple[float, np.ndarray]],
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
    point = start
    try:
        value, gradient = function(point)
    except Late:
        return Minimum(point=start, value=np.inf, gap=np.inf, reason=TIME_LIMIT)
    if not (np.isfinite(value) and np.isfinite(gradient).all()):
        return Minimum(point=start, value=value, gap=np.inf, reason="not a number")
    recent = deque([value], MEMORY)
    length = 1.0 / max(np.abs(gradient / metric).max(initial=0.0), 1.0 / MAX_STEP)
    best, least = (point, np.inf), np.inf

    def stopped(reason: str) -> Minimum:
        return Minimum(point=best[0], value=best[1], gap=least, reason=reason)

    for iteration in range(iterations + 1):
        if (now := gap(point, gradient)) <= tolerance * abs(value):
            return Minimum(point=point, value=value, gap=now, reason=None)
        least = min(least, now)
        if value < best[1]:
            best = point, value
        reason = "iteration limit" if iteration == iterations else TIME_LIMIT
        if iteration == iterations or time.perf_counter() > deadline:
            break
        direction = project(point - length * gradient / metric) - point
        slope, share, limit = float((gradient * direction).sum()), 1.0, max(recent)
        while True:
            other = point + share * direction
            try:
                other_value, other_gradient = function(other)
            except Late:
                return stopped(TIME_LIMIT)
            if other_value <= limit + SUFFICIENT_DECREASE * share * slope:
                break
            if time.perf_counter() > deadline:
                return stopped(TIME_LIMIT)
            if share < MIN_STEP_SHARE:
                return stopped(AT_REST)
            lowest = (
                -0.5 * share**2 * slope / (other_value - value - share * slope)
            )  # of the parabola through both
            share = lowest if 0.1 * share <= lowest <= 0.5 * share else 0.5 * share
        moved, turned = other - point, other_gradient - gradient
        curvature = float((moved * turned).sum())
        length = min(
            float((metric * moved**2).sum()) / curvature if curvature > 0 else 4.0 * length,
            MAX_STEP,
        )
        point, value, gradient = other, other_value, other_gradient
        recent.append(value)
    return stopped(reason)
