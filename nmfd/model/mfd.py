"""The outflow MFD of a region: g(x) = a x^3 + b x^2 + c x, constant beyond the jam accumulation.

The tail is not published. The benchmark's cubic rises again beyond 10,019 vehicles: a jammed region would recover by
itself. With g(jam) beyond the jam accumulation the published figures are consistent.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Real

from nmfd.errors import InputError

Values = Float[np.ndarray | np.floating, "*B"]
Samples = Real[np.ndarray, " N"]
# Geometric guess of a curve: the shape of the published one, g = c (ALPHA y^2 + BETA y + 1) x with y = x / jam.
ALPHA, BETA = 0.98405, -1.97190
JAM_DENSITY = 80.0  # veh per lane-km: 60 % of the lanes full of standing vehicles


@dataclass(frozen=True, kw_only=True)
class Mfd:
    """Outflow of one region against its accumulation.

    a [veh^-2 s^-1], b [veh^-1 s^-1], c [s^-1]: coefficients of the cubic.
    jam [veh]: the accumulation beyond which the outflow stays at g(jam).
    Raises InputError for a number that is not finite, and for jam <= 0.

        >>> curve = Mfd(a=4.133e-11, b=-8.282e-7, c=0.0042, jam=10000.0)  # the benchmark's
        >>> round(curve.critical), round(curve.capacity, 2)
        (3402, 6.33)
        >>> round(float(curve.outflow(8000.0)), 2)  # beyond the critical accumulation
        1.76
    """

    a: float
    b: float
    c: float
    jam: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.isfinite(value) or (name == "jam" and value <= 0):
                allowed = "a number above 0" if name == "jam" else "a number"
                raise InputError(f"Mfd: {name}: expected {allowed}, got {value:g} instead; give a finite one")

    def rate(self, accumulation: Values | float) -> Values:
        """Return the outflow per vehicle q(x) = g(x)/x [1/s] of `accumulation` (...) [veh]; c at x = 0."""
        x = np.asarray(accumulation, dtype=float)
        body = np.minimum(x, self.jam)
        q = (self.a * body + self.b) * body + self.c
        return np.where(x > self.jam, q * self.jam / np.maximum(x, self.jam), q)

    def outflow(self, accumulation: Values | float) -> Values:
        """Return g(x) [veh/s] of `accumulation` (...) [veh]."""
        return self.rate(accumulation) * np.asarray(accumulation, dtype=float)

    @property
    def critical(self) -> float:
        """Accumulation of maximum outflow [veh]."""
        grid = np.linspace(0.0, self.jam, 20001)
        return float(grid[np.argmax(self.outflow(grid))])

    def reaching(self, share: float) -> float:
        """Return the smallest accumulation [veh] with `share` of the maximum outflow."""
        grid = np.linspace(0.0, self.critical, 20001)
        return float(grid[np.argmax(self.outflow(grid) >= share * self.capacity * (1.0 - 1e-12))])

    @property
    def capacity(self) -> float:
        """Maximum outflow [veh/s]."""
        return float(self.outflow(self.critical))

    def problem(self) -> str | None:
        """Return why this is no MFD, or None: the outflow must be positive up to the jam."""
        grid = np.linspace(0.0, self.jam, 2001)
        rate = self.rate(grid)
        if not rate.min() > 0:
            return f"the outflow is not positive at {grid[rate.argmin()]:.0f} veh, below jam = {self.jam:g}"
        return None


def guess(rate: float, jam: float) -> Mfd:
    """Return a curve of the published shape with q(0) = `rate` [1/s]."""
    return Mfd(a=ALPHA * rate / jam**2, b=BETA * rate / jam, c=rate, jam=jam)


def guess_beyond(curve: Mfd, jam: float, seen: float, *, max_rate: float = np.inf) -> Mfd:
    """Return the guess with the outflow of `curve`, fitted to data without a falling branch, at their end `seen` [veh].

    jam: of the region's lanes [veh], raised so that the critical accumulation is above `seen`; max_rate: [1/s]
    """
    jam *= max(1.0, 1.0001 * seen / guess(1.0, jam).critical)
    return guess(float(min(curve.outflow(seen) / guess(1.0, jam).outflow(seen), max_rate)), jam)


def fit(accumulation: Samples, outflow: Samples, *, max_rate: float = np.inf, bins: int = 24) -> Mfd:
    """Fit a curve to samples (n,) [veh], (n,) [veh/s] by least squares over the medians of bins of accumulation.

    The rate q(x) = a x^2 + b x + c is positive, falling up to the jam accumulation and at most `max_rate` [1/s] (the
    inverse of the integration step). The jam accumulation is at most the largest sample: beyond the data the outflow
    is constant. Raises ValueError without samples.
    """
    x, g = np.asarray(accumulation, dtype=float), np.asarray(outflow, dtype=float)
    good = np.isfinite(x) & np.isfinite(g) & (x > 0)
    if not good.any():
        raise ValueError("no samples to fit an MFD to")
    x, g = x[good], g[good]
    number = np.minimum((bins * x / x.max()).astype(int), bins - 1)
    used = np.unique(number)
    middle_x, middle_g = (np.array([np.median(values[number == n]) for n in used]) for values in (x, g))
    jams = (float(share * x.max()) for share in np.linspace(0.2, 1.0, 17))
    candidates = (_fit_cubic(middle_x, middle_g, jam, max_rate) for jam in jams)
    return min(candidates, key=lambda curve: ((curve.outflow(middle_x) - middle_g) ** 2).sum())


def _fit_cubic(x: np.ndarray, g: np.ndarray, jam: float, max_rate: float) -> Mfd:
    """Fit a curve with a given jam accumulation."""
    from scipy.optimize import minimize  # slow to import

    # Scaled: g = (A y^2 + B y + C) y with y = x / jam, at most 1. Falling: B <= 0 and 2 A + B <= 0 (q' is linear).
    # Positive at the jam: A + B + C >= floor.
    y, scale = np.minimum(x / jam, 1.0), g.max()
    design = np.stack([y**3, y**2, y], axis=1)
    limits = np.array([[0, -1, 0], [-2, -1, 0], [1, 1, 1], [0, 0, 1], [0, 0, -1]], dtype=float)
    least = np.array([0.0, 0.0, 0.01, 0.01, -min(max_rate * jam / scale, 1e3)])
    result = minimize(
        lambda p: ((design @ p - g / scale) ** 2).sum(),
        x0=np.array([0.0, -1.0, 2.0]),
        jac=lambda p: 2.0 * design.T @ (design @ p - g / scale),
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-14},
        constraints={"type": "ineq", "fun": lambda p: limits @ p - least, "jac": lambda p: limits},
    )
    a, b, c = map(float, result.x * scale)
    return Mfd(a=a / jam**3, b=b / jam**2, c=c / jam, jam=jam)
