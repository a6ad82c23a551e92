"""What the last plans got wrong, as demand of the next one: offset-free model predictive control.

After every decision the regional model says where it leads to; the next measurement says where it led. The difference
is the innovation of nmfd.model.disturbance, whose estimate is added to the demand that is forecast, fading over the
horizon. What entered meanwhile is the demand that was forecast, less what waits more than before.
"""

from collections import deque

import numpy as np
import torch

from nmfd.arrays import PairsOverTime, PerPair, PerTurn
from nmfd.errors import InputError
from nmfd.model import disturbance, dynamics
from nmfd.model.planning import PlanningModel
from nmfd.types import Controls, Observation


class OffsetFree:
    """Watches one closed loop on the model of `planning`."""

    def __init__(self, planning: PlanningModel, where: str):
        """where: what asks for it, for the InputError of a network that knows of no disturbance."""
        network = planning.network
        if network.disturbance is None:
            raise InputError(
                f"{where}: the network {network.name} has no table [disturbance]; cosim identify finds it, or omit the "
                "key"
            )
        self._law, self._model = network.disturbance, dynamics.parameters(network)
        self._critical = torch.tensor(network.critical)
        self._nominal, self._demand, self._step = network.nominal_splits, planning.forecast, planning.step
        self._substeps, self._integrator = planning.substeps, planning.integrator
        self.reset()

    def reset(self) -> None:
        """Forget what was seen."""
        self._innovations: deque[torch.Tensor] = deque(maxlen=disturbance.LOOK)
        self._before: tuple[Observation, PerPair, PerTurn] | None = None

    def saw(self, observation: Observation) -> None:
        """What the last decision led to. A measurement that is none, or not the next one, tells nothing."""
        if self._before is None or not np.isfinite(observation.accumulation).all():
            return
        (then, perimeter, splits), self._before = self._before, None
        if observation.step != then.step + 1 or then.step >= len(self._demand):
            return
        entered = self._demand[then.step] + (then.backlog - observation.backlog) / self._step
        x, demand, u, theta = map(torch.as_tensor, (then.accumulation, entered, perimeter, splits))
        foreseen = dynamics.advance(
            self._model, x, demand, u, theta, self._step, substeps=self._substeps, integrator=self._integrator
        )
        self._innovations.append((torch.as_tensor(observation.accumulation) - foreseen) / self._step)

    def decided(self, observation: Observation, controls: Controls) -> None:
        """What was seen and asked for in the interval that begins."""
        splits = self._nominal if controls.splits is None else controls.splits
        known = np.isfinite(observation.accumulation).all()
        self._before = (observation.copy(), controls.perimeter, splits) if known else None

    def ahead(self, accumulation: PerPair, intervals: int) -> PairsOverTime:
        """(intervals, R, R) [veh/s] to be added to the demand from `accumulation` (R, R) [veh] on."""
        if not self._innovations:
            return np.zeros((intervals, *accumulation.shape))
        estimate = disturbance.estimated(self._law, torch.stack(tuple(self._innovations)))
        return disturbance.ahead(
            self._law, estimate, torch.as_tensor(accumulation), self._critical, intervals, self._step
        ).numpy()
