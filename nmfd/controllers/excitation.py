"""Excitation for identification: every control moves over its range while the city stays alive."""

from dataclasses import replace

import numpy as np

from nmfd.controllers.rules import PiGating, SetPoint
from nmfd.model.planning import PlanningModel, options
from nmfd.types import Controls, Observation

HOLD_INTERVALS = (3, 9)  # control intervals between two draws, from and to
SET_POINT_RANGE = (0.5, 1.3)  # factor of the set points
DISTURBED_SHARE = 0.35  # of the gateways whose u is drawn at random
MAX_DIVERTED_SHARE = 0.6  # of the vehicles with a random next region; more locks a city


class Probing:
    """Gating at random set points, with some gateways open at random, for loading runs.

    Random controls alone would lock the city early in every run. Gating alone moves all gateways of a region together.
    With guidance, theta lies between the nominal split ratios and a random point of the simplex. All is drawn again
    every few control intervals, from the seed of the run. The set points vary around the option set_point, or else the
    critical accumulation.
    """

    def __init__(self, planning: PlanningModel, *, guidance: bool):
        """Raise InputError for a wrong option."""
        self.name = "probing-pcrg" if guidance else "probing-pc"
        self._network, self._guidance, self._gating = planning.network, guidance, None
        middle = options(SetPoint, planning, self.name).set_point
        middle = middle or tuple(planning.network.mfds[region].critical for region in planning.protected)
        if middle:
            gating = replace(planning, controller_options={PiGating.name: {"set_point": list(middle)}})
            self._gating = PiGating(gating)
            self._gating.critical = np.array(middle)
        self._open = np.where(planning.network.adjacency, planning.network.u_max, 0.0)
        self.reset()

    def reset(self, seed: int = 0) -> None:
        self._random, self._left = np.random.default_rng([seed, 0x70726F62]), 0
        if self._gating is not None:
            self._gating.reset()

    def act(self, observation: Observation) -> Controls:
        if self._left == 0:
            self._draw()
        self._left -= 1
        perimeter = self._open if self._gating is None else self._gating.act(observation).perimeter
        return Controls(perimeter=np.where(self._disturbed, self._random_u, perimeter), splits=self._splits)

    def _draw(self) -> None:
        random, network = self._random, self._network
        self._left = int(random.integers(*HOLD_INTERVALS))
        if self._gating is not None:
            self._gating.set_point = random.uniform(*SET_POINT_RANGE) * self._gating.critical
        self._random_u = random.uniform(network.u_min, network.u_max, network.adjacency.shape)
        self._disturbed = network.adjacency & (random.random(network.adjacency.shape) < DISTURBED_SHARE)
        self._splits = None
        if self._guidance:
            point = random.exponential(size=network.split_mask.shape) ** 2 * network.split_mask
            point /= np.maximum(point.sum(axis=1, keepdims=True), 1e-12)
            share = MAX_DIVERTED_SHARE * random.random((network.regions, 1, network.regions)) ** 2
            self._splits = (1.0 - share) * network.nominal_splits + share * point
