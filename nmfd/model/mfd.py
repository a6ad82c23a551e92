"""Outflow MFDs: the published cubic, piecewise linear ones, and the protocol of any other.

Beyond the jam accumulation the outflow is constant. This tail is not published. The benchmark's
cubic rises again beyond 10,019 vehicles: a jammed region would recover by itself. With g(jam)
beyond the jam accumulation the published figures are consistent.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Real

from nmfd.errors import InputError

Samples = Real[np.ndarray, " N"]
# Geometric guess of a curve: the shape of the published one, g = c (ALPHA y^2 + BETA y + 1) x with
# y = x / jam.
ALPHA, BETA = 0.98405, -1.97190
JAM_DENSITY = 80.0  # veh per lane-km: 60 % of the lanes full of standing vehicles


def of_numbers(kind: "type[Mfd]", **numbers: Any) -> Any:
    """Return a curve of this kind whose numbers are arrays, which need no check."""
    curve = object.__new__(kind)
    vars(curve).update(numbers)
    return curve


@runtime_checkable
class Mfd(Protocol):
    """Outflow of one region against its accumulation; or of R regions, if its numbers are arrays
    (R,).

    A kind of curve is a frozen dataclass of floats, or tuples of floats, with `jam` [veh] and
    `rate_up_to_jam`. One formula serves all plants, training and MPC: it takes the functions of
    NumPy, torch or CasADi from `xp`, under NumPy's names (minimum, maximum, exp, ...).
    """

    jam: Any

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        """Return the outflow per vehicle q(n) = g(n)/n [1/s] for n [veh] up to the jam, falling and
        finite at 0."""
        ...

    def slope_up_to_jam(self, accumulation: Any) -> Any:
        """Return dq/dn [1/(veh s)] of NumPy's arrays; by finite differences unless a kind states
        it."""
        step = 1e-6 * self.jam
        above, below = (
            self.rate_up_to_jam(accumulation + step),
            self.rate_up_to_jam(accumulation - step),
        )
        return (above - below) / (2.0 * step)

    def scaled(self, wide: Any, high: Any) -> "Mfd":
        """Return the curve with its accumulation axis times `wide` and its rate times `high`."""
        return _Scaled(self, wide, high)

    def rate(self, accumulation: Any, xp: Any = np) -> Any:
        """Return q(n) [1/s] of any accumulation [veh]: beyond the jam the outflow stays g(jam)."""
        body = xp.minimum(accumulation, self.jam)
        return self.rate_up_to_jam(body, xp) * self.jam / xp.maximum(accumulation, self.jam)

    def outflow(self, accumulation: Any, xp: Any = np) -> Any:
        """Return g(n) = n q(n) [veh/s]."""
        return self.rate(accumulation, xp) * accumulation

    @property
    def critical(self) -> float:
        """Accumulation of maximum outflow [veh], the smallest if there are several."""
        if np.ndim(self.jam):
            raise AttributeError("critical: only the curve of one region has it")
        grid = np.linspace(0.0, self.jam, 20001)
        outflow = self.rate_up_to_jam(grid) * grid
        return float(grid[np.argmax(outflow >= outflow.max() * (1.0 - 1e-13))])

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
        rate = self.rate_up_to_jam(grid)
        if not rate.min() > 0:
            return f"the outflow is not positive at {grid[rate.argmin()]:.0f} veh, below jam = {self.jam:g}"
        return None


@dataclass(frozen=True, kw_only=True)
class Cubic(Mfd):
    """Outflow g(n) = a n^3 + b n^2 + c n, constant beyond the jam accumulation.

    a [veh^-2 s^-1], b [veh^-1 s^-1], c [s^-1]: coefficients; jam [veh]
    Raises InputError for a number that is not finite, and for jam <= 0.

        >>> curve = Cubic(a=4.133e-11, b=-8.282e-7, c=0.0042, jam=10000.0)  # the benchmark's
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
                raise InputError(
                    f"Mfd: {name}: expected {allowed}, got {value:g} instead; give a finite one"
                )

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        return (self.a * accumulation + self.b) * accumulation + self.c

    def slope_up_to_jam(self, accumulation: Any) -> Any:
        return 2.0 * self.a * accumulation + self.b

    def scaled(self, wide: Any, high: Any) -> "Cubic":
        numbers = {"a": high * self.a / wide**2, "b": high * self.b / wide, "c": high * self.c}
        return of_numbers(Cubic, **numbers, jam=wide * self.jam)


@dataclass(frozen=True, kw_only=True)
class PiecewiseLinear(Mfd):
    """Outflow along straight lines from (0, 0) through points, the last at the jam accumulation.

    accumulations [veh], rising from above 0; outflows [veh/s]

        >>> trapezoid(free=0.004, capacity=6.0, wave=0.001, jam=8000.0).accumulations
        (1500.0, 2000.0, 7700.0)
    """

    accumulations: tuple[float, ...]
    outflows: tuple[float, ...]

    def __post_init__(self) -> None:
        n, count = np.array([0.0, *self.accumulations]), len(self.outflows)
        rising = len(n) == count + 1 > 1 and (np.diff(n) > 0).all()
        if not (rising and np.isfinite([*n, *self.outflows]).all()):
            wanted = "as many finite outflows as accumulations, which rise from above 0"
            raise InputError(
                f"PiecewiseLinear: expected {wanted}, got {self.accumulations} and {self.outflows}"
            )

    @property
    def jam(self) -> Any:
        return self.accumulations[-1]

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        kinks = self._kinks()
        q = next(kinks)[1] + 0.0 * accumulation
        for (
            kink,
            change,
        ) in kinks:  # beyond n_k the outflow changes by (n - n_k) times the change of slope
            q = q + change * (1.0 - kink / xp.maximum(accumulation, kink))
        return q

    def _kinks(self) -> Iterator[tuple[Any, Any]]:
        """Yield the accumulations at which the slope of the outflow changes, from 0, and these
        changes [1/s]."""
        left, low, before = 0.0, 0.0, 0.0
        for right, high in zip(self.accumulations, self.outflows, strict=True):
            slope = (high - low) / (right - left)
            yield left, slope - before
            left, low, before = right, high, slope


def trapezoid(
    *, free: float, capacity: float, wave: float, jam: float, least: float = 0.05
) -> PiecewiseLinear:
    """Return g(n) = min(free n, capacity, wave (jam - n)), constant below `least` times the
    capacity.

    free, wave: outflow per vehicle of an empty region, and by which it falls before the jam [1/s];
        capacity [veh/s]
    """
    last = jam - least * capacity / wave
    return PiecewiseLinear(
        accumulations=(capacity / free, jam - capacity / wave, last),
        outflows=(capacity, capacity, least * capacity),
    )


class _Scaled(Mfd):
    """Any curve with other axes."""

    def __init__(self, curve: Mfd, wide: Any, high: Any):
        self.curve, self.wide, self.high, self.jam = curve, wide, high, wide * curve.jam

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        return self.high * self.curve.rate_up_to_jam(accumulation / self.wide, xp)


class _Several(Mfd):
    """Regions with curves of different kinds, each an array over all regions with weights 0 and
    1."""

    def __init__(self, kinds: list[tuple[Any, Mfd]]):
        self.kinds, self.jam = kinds, sum(weight * curve.jam for weight, curve in kinds)

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        return sum(
            w * curve.rate_up_to_jam(xp.minimum(accumulation, curve.jam), xp)
            for w, curve in self.kinds
        )


def stacked(mfds: Sequence[Mfd], array: Callable[[Sequence[float]], Any]) -> Mfd:
    """Return the curves of R regions as one, whose numbers are arrays (R,), made by `array`, such
    as np.array."""
    keys = [(type(m), *map(np.shape, vars(m).values())) for m in mfds]
    kinds: dict[tuple, tuple[Any, Mfd]] = {}
    for key, first in zip(keys, mfds, strict=True):
        if key in kinds:
            continue
        alike = [
            m if k == key else first for m, k in zip(mfds, keys, strict=True)
        ]  # the others get any numbers
        columns = {name: [vars(m)[name] for m in alike] for name in vars(first)}
        numbers = {
            name: tuple(map(array, zip(*column, strict=True)))
            if isinstance(column[0], tuple)
            else stacked(column, array)  # of a scaled curve
            if hasattr(column[0], "rate_up_to_jam")
            else array(column)
            for name, column in columns.items()
        }
        kinds[key] = array([float(k == key) for k in keys]), of_numbers(type(first), **numbers)
    return next(iter(kinds.values()))[1] if len(kinds) == 1 else _Several(list(kinds.values()))


def guess(rate: float, jam: float) -> Cubic:
    """Return a curve of the published shape with q(0) = `rate` [1/s]."""
    return Cubic(a=ALPHA * rate / jam**2, b=BETA * rate / jam, c=rate, jam=jam)


def guess_beyond(curve: Mfd, jam: float, seen: float, *, max_rate: float = np.inf) -> Cubic:
    """Return the guess with the outflow of `curve`, fitted to data without a falling branch, at
    their end `seen` [veh].

    jam: of the region's lanes [veh], raised so that the critical accumulation is above `seen`;
        max_rate: [1/s]
    """
    jam *= max(1.0, 1.0001 * seen / guess(1.0, jam).critical)
    return guess(float(min(curve.outflow(seen) / guess(1.0, jam).outflow(seen), max_rate)), jam)


def fit(
    accumulation: Samples, outflow: Samples, *, max_rate: float = np.inf, bins: int = 24
) -> Cubic:
    """Fit a curve to samples (n,) [veh], (n,) [veh/s] by least squares over the medians of bins of
    accumulation.

    The rate q(x) = a x^2 + b x + c is positive, falling up to the jam accumulation and at most
    `max_rate` [1/s] (the inverse of the integration step). The jam accumulation is at most the
    largest sample: beyond the data the outflow is constant. Raises ValueError without samples.
    """
    x, g = np.asarray(accumulation, dtype=float), np.asarray(outflow, dtype=float)
    good = np.isfinite(x) & np.isfinite(g) & (x > 0)
    if not good.any():
        raise ValueError("no samples to fit an MFD to")
    x, g = x[good], g[good]
    number = np.minimum((bins * x / x.max()).astype(int), bins - 1)
    used = np.unique(number)
    middle_x, middle_g = (
        np.array([np.median(values[number == n]) for n in used]) for values in (x, g)
    )
    jams = (float(share * x.max()) for share in np.linspace(0.2, 1.0, 17))
    candidates = (_fit_cubic(middle_x, middle_g, jam, max_rate) for jam in jams)
    return min(candidates, key=lambda curve: ((curve.outflow(middle_x) - middle_g) ** 2).sum())


def _fit_cubic(x: np.ndarray, g: np.ndarray, jam: float, max_rate: float) -> Cubic:
    from scipy.optimize import minimize  # slow to import

    # Scaled: g = (A y^2 + B y + C) y with y = x / jam, at most 1. Falling: B <= 0 and 2 A + B <= 0
    # (q' is linear). Positive at the jam: A + B + C >= floor.
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
    return Cubic(a=a / jam**3, b=b / jam**2, c=c / jam, jam=jam)
