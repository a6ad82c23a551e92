"""Integration of a regional model over a control interval.

It takes arrays of NumPy, torch or CasADi.
"""

from collections.abc import Callable
from typing import Any

# Weights of the slopes, and the point of each slope in steps along the previous one.
SCHEMES = {"euler": ((1.0,), (0.0,)), "rk4": ((1 / 6, 1 / 3, 1 / 3, 1 / 6), (0.0, 0.5, 0.5, 1.0))}


def integrated(
    slope: Callable[[Any], Any],
    x: Any,
    step: float,
    *,
    integrator: str = "euler",
    substeps: int = 1,
) -> Any:
    """Return x after a step of dx/dt = slope(x).

    With Euler x stays >= 0 if step * q <= substeps and demand >= 0.

    step: (s)
    integrator: forward Euler ("euler") or classical Runge-Kutta ("rk4")
    substeps: number of equal parts of the step
    """
    step = step / substeps
    for _ in range(substeps):
        k1 = slope(x)
        if integrator == "euler":
            x = x + step * k1
            continue
        k2 = slope(x + 0.5 * step * k1)
        k3 = slope(x + 0.5 * step * k2)
        k4 = slope(x + step * k3)
        x = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return x


def counted(
    slope: Callable[[Any], tuple[Any, Any]],
    x: Any,
    step: float,
    *,
    integrator: str = "euler",
    substeps: int = 1,
) -> tuple[Any, Any]:
    """Return `integrated` and the integral of a flow, for the ledger.

    slope: returns dx/dt and the flow
    """
    step = step / substeps
    ended = 0.0
    for _ in range(substeps):
        change = 0.0 * x
        mean_change = 0.0 * x
        mean_flow = 0.0
        for weight, place in zip(*SCHEMES[integrator], strict=True):
            change, flow = slope(x + place * step * change)
            mean_change = mean_change + weight * change
            mean_flow = mean_flow + weight * flow
        x = x + step * mean_change
        ended = ended + step * mean_flow
    return x, ended
