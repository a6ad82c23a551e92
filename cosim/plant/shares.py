"""Shares of drivers by next region, and the next region of every driver.

Travel times move the drivers' wishes away from the split ratios without guidance. Theta shifts
these wishes as it does the drivers' own split ratios in the regional model (`shifted`).

Drivers are assigned deterministically, not at random: each takes the next region that costs least,
with a bonus for regions that are behind their share (`assigned`). Random assignment sends drivers
round the far end of a region, and jams a city.
"""

import numpy as np

from cosim.plant.fastest import Counts
from nmfd.arrays import PerTurn

SHARE_PENALTY_S = 30.0  # per vehicle that a region is behind its share
MEMORY = 0.9  # of the vehicles assigned before and of their wishes, per control interval


class Shares:
    """Drivers by region, next region and destination.

    counts: of the control interval
    """

    def __init__(self, own: PerTurn):
        """own: split ratios without guidance (-, (R, R, R))"""
        # By region, destination and next region: a driver needs one row of each.
        rows = _rows(own)
        self.counts = Counts(
            own=rows,
            theta=rows,
            wished=np.zeros(own.shape),
            given=np.zeros(own.shape),
            realised=np.zeros(own.shape, dtype=np.int64),
            interval=0,
            memory=MEMORY,
            penalty=SHARE_PENALTY_S,
        )

    def command(self, theta: PerTurn) -> None:
        """Begin a control interval with split ratios theta (-, (R, R, R))."""
        before = self.counts
        before.wished[:] *= MEMORY
        before.given[:] *= MEMORY
        self.counts = before._replace(theta=_rows(theta), interval=before.interval + 1)


def _rows(values: PerTurn) -> PerTurn:
    """Return values by region, destination and next region."""
    return np.ascontiguousarray(np.swapaxes(values, 1, 2), float)
