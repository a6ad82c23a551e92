"""A controller with a schedule added to what it commands: what `cosim bound` searches, knowing what happens.

A schedule has numbers at K knots, evenly over the horizon and linear between them, of up to three channels:

    gates     added to u_hp of every gate h -> p into a protected region p, within the bounds
    prices    added to the prices of the protected regions, none below 0
    entries   natural logarithm of what the rates of metering are multiplied by

With zeros everywhere it is the controller itself, so that the best schedule is never worse.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from nmfd.arrays import PerPair, PerRegion
from nmfd.model.planning import PlanningModel
from nmfd.types import Controller, Controls, Observation

GATES, PRICES, ENTRIES = CHANNELS = ("gates", "prices", "entries")


def channels(controller: Controller, planning: PlanningModel) -> tuple[str, ...]:
    """What a schedule can be added to: the channels that the controller uses in an empty city; a fresh one is asked."""
    regions = planning.network.regions
    empty = np.zeros((regions, regions))
    controller.reset()
    controls = controller.act(Observation(step=0, time=0.0, accumulation=empty, backlog=empty.copy()))
    used = {
        GATES: bool(planning.protected),
        PRICES: controls.prices is not None and bool(planning.protected),
        ENTRIES: controls.metering is not None,
    }
    return tuple(channel for channel in CHANNELS if used[channel])


class Scheduled:
    """`controller` with a schedule (nmfd.types.Controller)."""

    def __init__(self, controller: Controller, schedule: Mapping[str, Sequence[float]], planning: PlanningModel):
        """schedule: channel -> K numbers, of which one that the controller does not command changes nothing"""
        network = planning.network
        self.name, self._controller, self._schedule = controller.name, controller, schedule
        self.deadline = getattr(controller, "deadline", None)  # [s], as the closed loop looks for it
        self._last = max(planning.steps - 1, 1)
        self._protected = np.isin(np.arange(network.regions), planning.protected)
        self._least, self._most = network.u_min, network.u_max
        self._gates = network.adjacency.astype(bool) & self._protected

    def reset(self, seed: int = 0) -> None:
        self._controller.reset(seed)

    def act(self, observation: Observation) -> Controls:
        step, controls = observation.step, self._controller.act(observation)
        return replace(
            controls,
            perimeter=self._perimeter(controls.perimeter, step),
            prices=self._prices(controls.prices, step),
            metering=None if controls.metering is None else controls.metering * np.exp(self._value(ENTRIES, step)),
        )

    def _value(self, channel: str, step: int) -> float:
        """Of a channel in control interval `step`."""
        numbers = self._schedule.get(channel, (0.0,))
        return float(np.interp(step / self._last, np.linspace(0.0, 1.0, len(numbers)), numbers))

    def _perimeter(self, perimeter: PerPair, step: int) -> PerPair:
        shifted = np.clip(perimeter + self._value(GATES, step), self._least, self._most)
        return np.where(self._gates, shifted, perimeter)

    def _prices(self, prices: PerRegion | None, step: int) -> PerRegion | None:
        if prices is None:
            return None
        return np.where(self._protected, np.maximum(prices + self._value(PRICES, step), 0.0), prices)
