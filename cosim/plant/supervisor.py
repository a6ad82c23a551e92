"""The supervisor of gates, which opens them where control does not pay.

A region is held if its entries let in less than HELD_SHARE of what they can. It is overfull above
OVERFULL critical accumulations, where a gate should empty it. If it was held for PATIENCE_S, is
overfull and no emptier than before that time, then it fills from inside or past its gates, which
only make queues: they open for PATIENCE_S.
"""

import numpy as np
from jaxtyping import Bool

from nmfd.arrays import PerPair, PerRegion
from nmfd.model.regional_model import RegionalModel

PATIENCE_S = 900.0
HELD_SHARE = 0.5
OVERFULL = 1.2


class Supervisor:
    """The regions whose gates are open against the command.

    Call `opened` once per control interval.
    """

    def __init__(self, network: RegionalModel, step: float):
        """step: control interval [s]"""
        self._network = network
        self._patience = max(round(PATIENCE_S / step), 1)
        self._before: list[PerRegion] = []  # accumulations of the past intervals [veh]
        # Control intervals that every region was held so far, and that it is open from now on.
        self._held = np.zeros(network.regions, dtype=int)
        self._open_for = np.zeros(network.regions, dtype=int)

    def opened(self, share: PerPair, accumulation: PerRegion) -> Bool[np.ndarray, " R"]:
        """Return the regions to open.

        share: commanded (R, R) [-]; accumulation: (R,) now [veh]
        """
        adjacency = self._network.adjacency
        self._before = [*self._before[-self._patience :], accumulation]
        self._open_for = np.maximum(self._open_for - 1, 0)
        overfull = accumulation > OVERFULL * self._network.critical
        futile = (self._held >= self._patience) & overfull & (accumulation >= self._before[0])
        self._open_for[futile] = self._patience
        is_open = self._open_for > 0
        entries = adjacency.sum(axis=0)
        mean = (share * adjacency).sum(axis=0) / np.maximum(entries, 1)
        held = (mean < HELD_SHARE) & (entries > 0) & ~is_open
        self._held = np.where(held, self._held + 1, 0)
        return is_open
