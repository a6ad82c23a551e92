"""Constant control: a sign that never changes, and measures nothing.

Every policy must beat the best one: else the sign is enough.
"""

import torch
from torch import nn

from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.numbers import Levels
from nmfd.controllers.dpc.policy import DTYPE, FILL_TIME_S, Memory
from nmfd.model.regional_model import RegionalModel
from nmfd.tensors import PerPair, PerRegion


class ConstantPolicy(CompactPolicy):
    """Policy with the same controls in all states.

    numbers: a tensor of Levels (4,)
    """

    def _build(self, network: RegionalModel) -> None:
        super()._build(network)
        self.numbers = nn.Parameter(torch.tensor(Levels(), dtype=DTYPE))

    def outputs(self, x: PerPair, memory: Memory | None = None) -> tuple[PerPair, None]:
        """Return the perimeter, and None."""
        gate = self._levels().gate
        share = torch.where(self.held, gate, torch.ones_like(gate))
        return self.box.opened(share.expand(x.shape)), None

    def remember(self, x: PerPair, memory: Memory | None) -> None:
        """Return None: nothing is remembered."""

    def prices(self, x: PerPair) -> PerRegion | None:
        """Return the price of each region (-, (..., R)), or None."""
        if not self.architecture.guidance:
            return None
        levels = self._levels()
        return torch.where(self.held, levels.price, levels.elsewhere).expand(x.shape[:-1])

    def metering(self, x: PerPair) -> PerRegion | None:
        """Return the largest departure rates (veh/s, (..., R)), or None."""
        if not self.architecture.metering:
            return None
        critical = self.scale.squeeze(-1)
        return (self._levels().metering * critical / FILL_TIME_S).expand(x.shape[:-1])

    def _levels(self) -> Levels:
        return Levels(*self.numbers)
