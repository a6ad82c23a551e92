"""Greedy control: every boundary at a bound, by which of its two regions is congested now."""

import numpy as np

from nmfd.model.planning import PlanningModel
from nmfd.types import Controls, Observation


class Greedy:
    """The greedy controller of Geroliminis, Haddad and Ramezani (2013, table I), at every boundary by itself.

    u_ih = u_min where h is congested, n_h > n_cr,h, and i is not, or is less so, n_i / jam_i < n_h / jam_h; else u_max.
    Of two regions that is the published law: as much as possible into those that are not congested, as little as
    possible into one that is, and of two congested ones into the more congested. No options, and no route guidance.
    """

    name = "greedy"

    def __init__(self, planning: PlanningModel):
        network = planning.network
        self._critical = network.critical
        self._jam = np.array([mfd.jam for mfd in network.mfds])
        self._open = np.where(network.adjacency, network.u_max, 0.0)
        self._closed = np.where(network.adjacency, network.u_min, 0.0)

    def reset(self, seed: int = 0) -> None:
        pass

    def act(self, observation: Observation) -> Controls:
        vehicles = observation.accumulation.sum(axis=1)
        congested, full = vehicles > self._critical, vehicles / self._jam
        hold = congested & (~congested[:, None] | (full[:, None] < full))  # [i, h]
        return Controls(perimeter=np.where(hold, self._closed, self._open), splits=None)
