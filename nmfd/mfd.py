"""The outflow MFD of a region: g(x) = a x^3 + b x^2 + c x, constant beyond the jam accumulation (design.md, 2)."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Mfd:
    """Outflow against accumulation of one region.

    a [veh^-2 s^-1], b [veh^-1 s^-1], c [s^-1]: coefficients of the cubic.
    jam [veh]: the accumulation beyond which the outflow stays at g(jam); infinity for a bare cubic.
    """

    a: float
    b: float
    c: float
    jam: float

    def rate(self, accumulation):
        """Outflow per vehicle q(x) = g(x)/x [1/s] of `accumulation` (...) [veh]; c at x = 0."""
        x = np.asarray(accumulation, dtype=float)
        body = np.minimum(x, self.jam)
        q = (self.a * body + self.b) * body + self.c
        return np.where(x > self.jam, q * self.jam / np.maximum(x, self.jam), q) if np.isfinite(self.jam) else q

    def outflow(self, accumulation):
        """g(x) [veh/s] of `accumulation` (...) [veh]."""
        return self.rate(accumulation) * np.asarray(accumulation, dtype=float)

    @property
    def critical(self) -> float:
        """The accumulation of maximum outflow [veh]."""
        grid = np.linspace(0.0, self.jam if np.isfinite(self.jam) else -self.c / self.b * 2, 20001)
        return float(grid[np.argmax(self.outflow(grid))])

    @property
    def capacity(self) -> float:
        """The maximum outflow [veh/s]."""
        return float(self.outflow(self.critical))

    def problem(self) -> str | None:
        """Why this is no MFD, or None: it must start with positive slope and stay positive up to the jam."""
        if not self.c > 0:
            return f"c must be positive (the free-flow slope), got {self.c:g}"
        if not self.jam > 0:
            return f"jam must be positive, got {self.jam:g}"
        if np.isfinite(self.jam):
            grid = np.linspace(0.0, self.jam, 2001)
            rate = self.rate(grid)
            if rate.min() <= 0:
                return f"the outflow is not positive at {grid[rate.argmin()]:.0f} veh, below jam = {self.jam:g}"
        return None
