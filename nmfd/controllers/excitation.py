"""Excitation for identification: every control moves over its range, while the city stays alive."""

from dataclasses import replace

import numpy as np

from nmfd.controllers.options import options
from nmfd.controllers.pi_gating import PiGating, SetPoint
from nmfd.model.planning import PlanningModel
from nmfd.types import Controls, Observation

HOLD = (3, 9)  # control intervals between two draws, from and to
SET_POINTS = (0.5, 1.3)  # of the middle one, of every region that is held
DISTURBED = 0.35  # share of the gateways whose u is drawn by lot
MOST_DIVERTED = 0.6  # share of the vehicles of one kind in a region whose way is drawn by lot; more locks a city


class Probing:
    """Gating at set points drawn by lot, with some gateways open at random besides, for loading runs.

    Random controls alone would lock the city early in every run; gating alone moves all gateways of a region together
    and never those between the others. With guidance, theta lies between the drivers' own and a point of the simplex
    drawn by lot. Everything is drawn anew every few control intervals, from the seed of the run.

    The set points are around the option set_point ([controllers.probing-pc] or [controllers.probing-pcrg]), or else the
    critical accumulation.
    """

    def __init__(self, planning: PlanningModel, *, guidance: bool):
        """InputError for a wrong option."""
        self.name = "probing-pcrg" if guidance else "probing-pc"
        self._network, self._guidance, self._gating = planning.network, guidance, None
        chosen = options(SetPoint, planning, self.name)
        regions = chosen.held(planning)
        middle = chosen.set_point or tuple(planning.network.mfds[region].critical for region in regions)
        if middle:
            held = {"regions": list(regions), "set_point": list(middle)}
            self._gating = PiGating(replace(planning, controller_options={PiGating.name: held}))
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
        return Controls(perimeter=np.where(self._disturbed, self._by_lot, perimeter), splits=self._splits)

    def _draw(self) -> None:
        random, network = self._random, self._network
        self._left = int(random.integers(*HOLD))
        if self._gating is not None:
            self._gating.set_point = random.uniform(*SET_POINTS) * self._gating.critical
        self._by_lot = random.uniform(network.u_min, network.u_max, network.adjacency.shape)
        self._disturbed = network.adjacency & (random.random(network.adjacency.shape) < DISTURBED)
        self._splits = None
        if self._guidance:
            lot = random.exponential(size=network.split_mask.shape) ** 2 * network.split_mask
            lot /= np.maximum(lot.sum(axis=1, keepdims=True), 1e-12)
            share = MOST_DIVERTED * random.random((network.regions, 1, network.regions)) ** 2
            self._splits = (1.0 - share) * network.nominal_splits + share * lot
