"""Compact DPC policies and rules: control by a few readable numbers.

A compact policy is trained through the regional model (dpc-pc, dpc-pcrg with `compact`). A rule,
gating-rule or, with prices, pricing-rule, has numbers that were tuned in SUMO (`cosim tune`) or
chosen by hand. It reads them from scenario.toml.

p is a protected region, h -> p one of its entries, z_i = n_i / n_cr,i, s(x) = 1 / (1 + e^-x):

    e_p  = set_point - z_p
    v_p  = gain e_p
    u_hp = u_min + (u_max - u_min) s(4 (v_p + relief max(z_h - 1, 0)))
    c_p  = price max(z_p - price_from, 0)
    c_i  = elsewhere max(z_i - elsewhere_from, 0)    for other regions i

All other entries are open. `relief` opens a gate for a region beyond its own critical accumulation.
With metering,

    r_i = n_cr,i max(min(a_i, b), 0) / FILL_TIME_S
    a_i = metering_slope (metering - z_i)
    b   = metering_gain (metering_protected - max_p z_p)

trips may begin in region i per second. `metering_protected` = 0 omits b. A gate moves a queue into
the regions around the protected one, which may lock instead; trips that have not begun block no
vehicle.

With `integral` the gate is PI gating (nmfd.controllers.rules), initially open, v_p = 1/2, with
relief on top:

    v_p(k) = clip(v_p(k-1) + gain (e_p(k) - e_p(k-1)) + integral e_p(k), -1/2, 1/2)
    u_hp   = u_min + (u_max - u_min) clip(1/2 + v_p + relief max(z_h - 1, 0), 0, 1)

It corrects errors of the regional model, so rollouts of that model do not use it: `integral` is
tuned in SUMO (`cosim tune`), not trained. The straight line closes earlier than s as the region
fills.

With `per_region` n_cr,i is replaced by the accumulation of region i that counts as full. It is
trained for each region, so that trips wait where that pays; it begins at the critical accumulation,
or the largest that was seen.

The regional model answers prices by a logit (nmfd.model.answer). The policy is trained like a
network.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from nmfd.controllers.dpc.numbers import Numbers
from nmfd.controllers.dpc.policy import (
    DTYPE,
    FILL_TIME_S,
    Architecture,
    DpcController,
    Memory,
    Policy,
)
from nmfd.model.planning import PlanningModel
from nmfd.model.regional_model import RegionalModel
from nmfd.tensors import PerPair, PerRegion

if TYPE_CHECKING:
    from nmfd.controllers.dpc.options import ConstantControl, GatingRule


class CompactPolicy(Policy):
    """Policy with a few numbers for its protected regions.

    numbers: a tensor of Numbers (12,)
    log_full: with `per_region`, logarithm of the accumulation that counts as full, relative to
        `scale` (-, (R,))
    held: True for a protected region (R,)
    """

    def _build(self, network: RegionalModel) -> None:
        self.numbers = nn.Parameter(torch.tensor(Numbers(), dtype=DTYPE))
        if self.architecture.per_region:
            known = torch.tensor(network.known_critical, dtype=DTYPE)
            self.scale.copy_(known.unsqueeze(-1))
            self.log_full = nn.Parameter(torch.zeros_like(known))
        held = np.isin(np.arange(network.regions), self.architecture.compact)
        self.register_buffer("held", torch.tensor(held), persistent=False)

    def outputs(self, x: PerPair, memory: Memory | None = None) -> tuple[PerPair, None]:
        """Return the perimeter in the states x, and None.

        memory: result of `remember` for x, v in its first row; None without integral action
        """
        numbers = self._read()
        full = self._full(x)
        relief = numbers.relief * (full - 1.0).clamp(min=0.0).unsqueeze(-1)
        if memory is None:
            gate = numbers.gain * (numbers.set_point - full)
            share = torch.sigmoid(4.0 * (gate.unsqueeze(-2) + relief))
        else:
            gate = memory[..., 0, :]
            share = (0.5 + (gate.unsqueeze(-2) + relief)).clamp(0.0, 1.0)
        return self.box.opened(torch.where(self.held, share, torch.ones_like(share))), None

    def remember(self, x: PerPair, memory: Memory | None) -> Memory | None:
        """Return v and e after the states x; None without integral action.

        memory: the one before x, None at the beginning
        """
        numbers = self._read()
        if not numbers.integral:
            return None
        error = numbers.set_point - self._full(x)
        if memory is None:
            v = torch.full_like(error, 0.5)
            before = error
        else:
            v, before = memory.unbind(-2)
        v = v + numbers.gain * (error - before) + numbers.integral * error
        return torch.stack([v.clamp(-0.5, 0.5), error], dim=-2)

    def prices(self, x: PerPair) -> PerRegion | None:
        """Return the price of each region (-, (..., R)), or None."""
        if not self.architecture.guidance:
            return None
        numbers = self._read()
        full = self._full(x)
        elsewhere = numbers.elsewhere * (full - numbers.elsewhere_from).clamp(min=0.0)
        protected = numbers.price * (full - numbers.price_from).clamp(min=0.0)
        return torch.where(self.held, protected, elsewhere)

    def metering(self, x: PerPair) -> PerRegion | None:
        """Return the largest departure rates (veh/s, (..., R)), or None."""
        if not self.architecture.metering:
            return None
        numbers = self._read()
        full = self._full(x)
        room = numbers.metering_slope * (numbers.metering - full)
        if numbers.metering_protected:
            fullest = torch.where(self.held, full, torch.zeros_like(full)).amax(-1, keepdim=True)
            left = numbers.metering_gain * (numbers.metering_protected - fullest)
            room = torch.minimum(room, left)
        return self._counts_as_full() * room.clamp(min=0.0) / FILL_TIME_S

    def bound(self) -> None:
        """Set negative numbers to 0."""
        with torch.no_grad():
            self.numbers.clamp_(min=0.0)

    def load_state_dict(self, weights: Any, *args: Any, **options: Any) -> Any:
        """Load weights; those of an older file lack the last numbers."""
        given = weights["numbers"]
        missing = given.new_tensor(Numbers()[len(given) :])
        weights = {**weights, "numbers": torch.cat([given, missing])}
        return super().load_state_dict(weights, *args, **options)

    def _counts_as_full(self) -> PerRegion:
        """Return the accumulation of each region for which z_i is 1 (veh, (R,))."""
        full = super()._counts_as_full()
        if self.architecture.per_region:
            full = full * self.log_full.exp()
        return full

    def _read(self) -> Numbers:
        return Numbers(*self.numbers.clamp(min=0.0))


def rule(
    kind: type[CompactPolicy], planning: PlanningModel, options: "GatingRule | ConstantControl"
) -> DpcController:
    """Return the controller of a policy with the numbers of a rule.

    kind: of the policy, for the protected regions
    """
    architecture = Architecture(
        guidance=options.guides, compact=planning.protected, metering=options.metering
    )
    policy = kind(planning.network, architecture)
    given = torch.tensor(options.numbers, dtype=DTYPE)
    policy.numbers.data[: len(given)] = given
    controller = DpcController(policy)
    controller.name = options.name
    return controller
