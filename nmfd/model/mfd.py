"""Outflow MFDs: the published cubic, piecewise linear ones, and others.

Beyond the jam accumulation the outflow is constant. This tail is not published. The benchmark's
cubic rises again beyond 10,019 vehicles: a jammed region would recover by itself. With g(jam)
beyond the jam accumulation the published figures are consistent.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Real

from nmfd.arrays import Adjacency
from nmfd.errors import InputError

Samples = Real[np.ndarray, " N"]
# Shape of the published curve, for guesses: g = c (ALPHA y^2 + BETA y + 1) x with y = x / jam.
ALPHA = 0.98405
BETA = -1.97190
KINK_ROUNDING = 0.005  # of the jam accumulation: width of rounded kinks
JAM_DENSITY = 80.0  # veh per lane-km: 60 % of the lanes full of standing vehicles
COLLAPSED_SHARE = 0.7  # of the largest outflow so far, below which a denser region is collapsed
OverTime = Real[np.ndarray, "T R"]
Held = Bool[np.ndarray, "T R"]


def of_numbers(kind: "type[Mfd]", **numbers: Any) -> Any:
    """Return a curve of this kind whose numbers are arrays.

    They come from curves that were checked, and are not checked again.
    """
    curve = object.__new__(kind)
    vars(curve).update(numbers)
    return curve


@runtime_checkable
class Mfd(Protocol):
    """Outflow of a region as a function of its accumulation.

    With arrays (R,) for its numbers it is that of R regions. A kind of curve is a frozen dataclass
    of floats, or tuples of floats, with `jam` [veh] and `rate_up_to_jam`. One formula serves all
    plants, training and MPC: it takes the functions of NumPy, torch or CasADi from `xp`, under
    NumPy's names (minimum, maximum, exp, ...).
    """

    jam: Any

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        """Return the rate q(n) = g(n)/n [1/s], falling and finite at 0.

        accumulation: n, up to the jam accumulation (veh)
        """
        ...

    def slope_up_to_jam(self, accumulation: Any) -> Any:
        """Return dq/dn [1/(veh s)] of NumPy's arrays.

        It comes from finite differences unless a kind of curve states it.
        """
        step = 1e-6 * self.jam
        above = self.rate_up_to_jam(accumulation + step)
        below = self.rate_up_to_jam(accumulation - step)
        return (above - below) / (2.0 * step)

    def scaled(self, wide: Any, high: Any) -> "Mfd":
        """Return the curve with accumulation times `wide`, rate times `high`."""
        return _Scaled(self, wide, high)

    def rate(self, accumulation: Any, xp: Any = np) -> Any:
        """Return q(n) [1/s] for any n [veh]; beyond the jam it is g(jam) / n."""
        body = xp.minimum(accumulation, self.jam)
        return self.rate_up_to_jam(body, xp) * self.jam / xp.maximum(accumulation, self.jam)

    def outflow(self, accumulation: Any, xp: Any = np) -> Any:
        """Return g(n) = n q(n) [veh/s]."""
        return self.rate(accumulation, xp) * accumulation

    @property
    def critical(self) -> float:
        """Accumulation of maximum outflow [veh], the smallest of several."""
        if np.ndim(self.jam):
            raise AttributeError("critical: only the curve of one region has it")
        grid = np.linspace(0.0, self.jam, 20001)
        outflow = self.rate_up_to_jam(grid) * grid
        return float(grid[np.argmax(outflow >= outflow.max() * (1.0 - 1e-13))])

    def reaching(self, share: float) -> float:
        """Return the smallest n [veh] with `share` of the maximum outflow."""
        grid = np.linspace(0.0, self.critical, 20001)
        reached = self.outflow(grid) >= share * self.capacity * (1.0 - 1e-12)
        return float(grid[np.argmax(reached)])

    @property
    def capacity(self) -> float:
        """Maximum outflow [veh/s]."""
        return float(self.outflow(self.critical))

    def problem(self) -> str | None:
        """Return why this is no MFD, or None.

        The outflow must be positive up to the jam.
        """
        grid = np.linspace(0.0, self.jam, 2001)
        rate = self.rate_up_to_jam(grid)
        if not rate.min() > 0:
            where = f"{grid[rate.argmin()]:.0f} veh, below jam = {self.jam:g}"
            return f"the outflow is not positive at {where}"
        return None


@dataclass(frozen=True, kw_only=True)
class Cubic(Mfd):
    """Outflow g(n) = a n^3 + b n^2 + c n, constant beyond the jam.

    a, b, c: coefficients (veh^-2 s^-1, veh^-1 s^-1, s^-1)
    jam: jam accumulation (veh)

    Raises: InputError for a number that is not finite, and for jam <= 0

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
            allowed = "a number"
            valid = np.isfinite(value)
            if name == "jam":
                allowed = "a number above 0"
                valid = valid and value > 0
            if not valid:
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
    """Outflow along straight lines from (0, 0) through points.

    accumulations: rising from above 0, the last is the jam accumulation (veh)
    outflows: (veh/s)

        >>> trapezoid(free=0.004, capacity=6.0, wave=0.001, jam=8000.0).accumulations
        (1500.0, 2000.0, 7700.0)
    """

    accumulations: tuple[float, ...]
    outflows: tuple[float, ...]

    def __post_init__(self) -> None:
        n = np.array([0.0, *self.accumulations])
        alike = len(self.outflows) == len(self.accumulations) > 0
        rising = (np.diff(n) > 0).all()
        finite = np.isfinite([*n, *self.outflows]).all()
        if not (alike and rising and finite):
            raise InputError(
                "PiecewiseLinear: expected as many finite outflows as accumulations, which rise "
                f"from above 0, got {self.accumulations} and {self.outflows}"
            )

    @property
    def jam(self) -> Any:
        return self.accumulations[-1]

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        kinks = self._kinks()
        _, first_slope = next(kinks)
        q = first_slope + 0.0 * accumulation
        # Beyond a kink n_k the outflow changes by (n - n_k) times the change of slope.
        for kink, change in kinks:
            q = q + change * (1.0 - kink / self._larger(accumulation, kink, xp))
        return q

    def _larger(self, accumulation: Any, kink: Any, xp: Any) -> Any:
        """Return the larger one of accumulation and kink [veh]."""
        return xp.maximum(accumulation, kink)

    def _kinks(self) -> Iterator[tuple[Any, Any]]:
        """Yield accumulations from 0, and the change of slope there [1/s]."""
        left = 0.0
        low = 0.0
        before = 0.0
        for right, high in zip(self.accumulations, self.outflows, strict=True):
            slope = (high - low) / (right - left)
            yield left, slope - before
            left = right
            low = high
            before = slope


@dataclass(frozen=True, kw_only=True)
class RoundedLinear(PiecewiseLinear):
    """`PiecewiseLinear` with rounded kinks.

    Solvers of MPC stop at sharp ones.

    >>> curve = RoundedLinear(accumulations=(100.0, 300.0), outflows=(1.0, 1.0))
    >>> curve.critical, round(float(curve.outflow(100.0)), 3)
    (100.0, 0.993)
    """

    @property
    def critical(self) -> float:
        """First point with the largest outflow [veh]."""
        if np.ndim(self.jam):
            raise AttributeError("critical: only the curve of one region has it")
        return float(self.accumulations[int(np.argmax(self.outflows))])

    def _larger(self, accumulation: Any, kink: Any, xp: Any) -> Any:
        width = KINK_ROUNDING * self.jam
        return 0.5 * (accumulation + kink + ((accumulation - kink) ** 2 + width**2) ** 0.5)


def trapezoid(
    *, free: float, capacity: float, wave: float, jam: float, least: float = 0.05
) -> PiecewiseLinear:
    """Return the curve g(n) = min(free n, capacity, wave (jam - n)).

    free: outflow per vehicle of an empty region (1/s)
    capacity: largest outflow (veh/s)
    wave: loss of outflow per further vehicle before the jam (1/s)
    jam: accumulation at which the last line would reach zero (veh)
    least: share of the capacity below which the outflow is constant (-)
    """
    last = jam - least * capacity / wave
    return PiecewiseLinear(
        accumulations=(capacity / free, jam - capacity / wave, last),
        outflows=(capacity, capacity, least * capacity),
    )


class _Scaled(Mfd):
    """Curve with other axes than `curve`."""

    def __init__(self, curve: Mfd, wide: Any, high: Any):
        self.curve = curve
        self.wide = wide
        self.high = high
        self.jam = wide * curve.jam

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        return self.high * self.curve.rate_up_to_jam(accumulation / self.wide, xp)


class _Several(Mfd):
    """Curves of regions of different kinds.

    kinds: a pair for each kind: weights, 1 in its regions and 0 elsewhere, and a curve over all
        regions
    """

    def __init__(self, kinds: list[tuple[Any, Mfd]]):
        self.kinds = kinds
        self.jam = sum(weight * curve.jam for weight, curve in kinds)

    def rate_up_to_jam(self, accumulation: Any, xp: Any = np) -> Any:
        rate = 0.0
        for weight, curve in self.kinds:
            body = xp.minimum(accumulation, curve.jam)
            rate = rate + weight * curve.rate_up_to_jam(body, xp)
        return rate


def stacked(mfds: Sequence[Mfd], array: Callable[[Sequence[float]], Any]) -> Mfd:
    """Return the curves of R regions as one, whose numbers are arrays (R,).

    array: makes these arrays, such as np.array
    """
    kinds = [(type(curve), *map(np.shape, vars(curve).values())) for curve in mfds]
    groups = []
    for kind in dict.fromkeys(kinds):
        first = mfds[kinds.index(kind)]
        # Regions of another kind have weight 0 and get any numbers.
        alike = [curve if own == kind else first for curve, own in zip(mfds, kinds, strict=True)]
        numbers = {}
        for name in vars(first):
            numbers[name] = _stacked_numbers([vars(curve)[name] for curve in alike], array)
        weight = array([float(own == kind) for own in kinds])
        groups.append((weight, of_numbers(type(first), **numbers)))
    if len(groups) == 1:
        return groups[0][1]
    return _Several(groups)


def _stacked_numbers(values: Sequence[Any], array: Callable[[Sequence[float]], Any]) -> Any:
    """Return one attribute of R curves with arrays instead of numbers."""
    first = values[0]
    if isinstance(first, tuple):
        return tuple(array(numbers) for numbers in zip(*values, strict=True))
    if hasattr(first, "rate_up_to_jam"):  # the curve inside a scaled one
        return stacked(values, array)
    return array(values)


def guess(rate: float, jam: float) -> Cubic:
    """Return a curve of the published shape with q(0) = `rate` [1/s]."""
    return Cubic(a=ALPHA * rate / jam**2, b=BETA * rate / jam, c=rate, jam=jam)


def guess_beyond(curve: Mfd, jam: float, seen: float, *, max_rate: float = np.inf) -> Cubic:
    """Return the guess for a region whose data show no falling branch.

    It has the outflow of `curve` at the end of the data.

    curve: fitted to the data
    jam: of the region's lanes, raised so that the critical accumulation is above `seen` (veh)
    seen: largest accumulation of the data (veh)
    max_rate: limit of q(0) (1/s)
    """
    jam *= max(1.0, 1.0001 * seen / guess(1.0, jam).critical)
    rate = curve.outflow(seen) / guess(1.0, jam).outflow(seen)
    return guess(float(min(rate, max_rate)), jam)


def fit(
    accumulation: Samples, outflow: Samples, *, max_rate: float = np.inf, bins: int = 24
) -> Cubic:
    """Fit a curve to samples by least squares over the medians of bins.

    The rate q(x) = a x^2 + b x + c is positive, falling up to the jam accumulation and at most
    `max_rate`. The jam accumulation is at most the largest sample: beyond the data the outflow is
    constant.

    accumulation: (veh, (N,))
    outflow: (veh/s, (N,))
    max_rate: inverse of the integration step (1/s)
    bins: number of bins of accumulation

    Raises: ValueError without samples
    """
    x = np.asarray(accumulation, dtype=float)
    g = np.asarray(outflow, dtype=float)
    good = np.isfinite(x) & np.isfinite(g) & (x > 0)
    if not good.any():
        raise ValueError("no samples to fit an MFD to")
    x = x[good]
    g = g[good]
    number = np.minimum((bins * x / x.max()).astype(int), bins - 1)
    used = np.unique(number)
    middle_x = np.array([np.median(x[number == n]) for n in used])
    middle_g = np.array([np.median(g[number == n]) for n in used])

    def misfit(curve: Cubic) -> float:
        return ((curve.outflow(middle_x) - middle_g) ** 2).sum()

    jams = [float(share * x.max()) for share in np.linspace(0.2, 1.0, 17)]
    return min((_fit_cubic(middle_x, middle_g, jam, max_rate) for jam in jams), key=misfit)


def _fit_cubic(x: np.ndarray, g: np.ndarray, jam: float, max_rate: float) -> Cubic:
    """Return the curve with this jam accumulation that fits points best."""
    from scipy.optimize import minimize  # slow to import

    # Scaled: g = (A y^2 + B y + C) y with y = x / jam, at most 1. Falling: B <= 0 and 2 A + B <= 0
    # (q' is linear). Positive at the jam: A + B + C >= floor. Each row of `limits` times (A, B, C)
    # is at least the entry of `least`.
    y = np.minimum(x / jam, 1.0)
    scale = g.max()
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


def held_up(accumulation: OverTime, outflow: OverTime, adjacency: Adjacency) -> Held:
    """Mark intervals in which a neighbour holds up a region's outflow.

    The neighbour has collapsed, and did so before the region. A collapsed region holds more
    vehicles than when its outflow was largest so far, and lets out less than COLLAPSED_SHARE of
    that. Its queues spill back and lower the outflow of the region behind. Outflows are means of
    three intervals here, so that chance in one of them is no collapse.

    accumulation, outflow: (veh), (veh/s), both (T, R)
    """
    from scipy.ndimage import uniform_filter1d  # slow to import

    mean = uniform_filter1d(outflow, 3, axis=0, output=float, mode="nearest")
    largest = np.maximum.accumulate(mean)
    interval = np.arange(len(outflow))[:, None]
    best = np.maximum.accumulate(np.where(mean == largest, interval, 0))
    fuller = accumulation > np.take_along_axis(accumulation, best, axis=0)
    collapsed = fuller & (mean < COLLAPSED_SHARE * largest)
    last_flowing = np.maximum.accumulate(np.where(collapsed, -1, interval))
    onset = np.where(collapsed, last_flowing, len(mean))  # of the collapse that lasts
    earlier = onset[:, None, :] < onset[:, :, None]
    return (adjacency & earlier).any(axis=2)
