"""Constant control: a sign that never changes, and measures nothing.

It is the floor under every policy: one that does not beat the best constant only needs it.
"""

from typing import Annotated, ClassVar, NamedTuple

import torch
from pydantic import Field
from torch import nn

from nmfd.controllers.base import Options
from nmfd.controllers.dpc.compact import CompactPolicy
from nmfd.controllers.dpc.policy import DTYPE, FILL_TIME_S, Architecture, DpcController, Memory
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.config import Numbers, Problem, got, setting
from nmfd.tensors import PerPair, PerRegion


class Levels(NamedTuple):
    """Numbers of constant control (-).

    gate: opening of the boundaries into protected regions, from 0 (u_min) to 1 (u_max)
    price, elsewhere: prices of protected and of other regions
    metering: departures of a region in FILL_TIME_S, as a share of its critical accumulation
    """

    gate: float = 1.0
    price: float = 0.0
    elsewhere: float = 0.0
    metering: float = 1.0


LevelsOption = Annotated[Numbers, Field(min_length=4, max_length=4)]
MEANING = "gate, price, elsewhere, metering; see nmfd/controllers/dpc/constant.py"


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
        opening = torch.where(self.held, gate, torch.ones_like(gate)).expand(x.shape)
        perimeter = self.box.low + (self.box.high - self.box.low) * opening
        return perimeter * self.box.allowed, None

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


class ConstantControl(Options):
    """Gates, prices and departure rates that never change."""

    numbers: LevelsOption = setting(MEANING, Levels(), unit="-")
    guidance: bool = setting("prices guide drivers", True)
    metering: bool = setting("trips wait beyond a rate; for +metering", False)
    name: ClassVar[str] = "constant"

    @property
    def guides(self) -> bool:
        return self.guidance

    def misfit(self, planning: PlanningModel) -> Problem | None:
        """Return negative numbers, a gate above 1, or no protected region."""
        levels = Levels(*self.numbers)
        if min(levels) < 0.0 or levels.gate > 1.0:
            expected = "4 numbers >= 0, the first at most 1"
            return Problem("numbers", got(expected, list(self.numbers)))
        if not planning.protected:
            return Problem("numbers", "expected a scenario with protected regions; name them")
        return None

    def make(self, planning: PlanningModel) -> DpcController:
        architecture = Architecture(
            guidance=self.guidance, compact=planning.protected, metering=self.metering
        )
        policy = ConstantPolicy(planning.network, architecture)
        policy.numbers.data.copy_(torch.tensor(self.numbers, dtype=DTYPE))
        controller = DpcController(policy)
        controller.name = self.name
        return controller
