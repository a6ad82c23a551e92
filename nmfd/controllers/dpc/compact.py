"""A policy of a few numbers that can be read: gates, prices and metering by how full the regions are.

With z_i = n_i / n_cr,i, how full region i is in critical accumulations, the entries h -> p of every protected region p,
and the prices of all ways through p, are

    u_hp = u_min + (u_max - u_min) s(4 (v_p + relief max(z_h - 1, 0))),    v_p = gain e_p,    e_p = set_point - z_p
    c_p  = price max(z_p - price_from, 0)                                  s(x) = 1 / (1 + e^-x)

and every other entry is open; the prices of the other regions are elsewhere max(z_i - elsewhere_from, 0). `relief`
opens a gate for a region that is beyond its own critical accumulation. Where trips can be made to wait,

    r_i = n_cr,i max(min(metering - z_i, metering_gain (metering_protected - max_p z_p)), 0) / HELD

may begin in region i per second; without `metering_protected` (0) nobody waits for the protected regions. A gate moves
a queue into the regions around the one that it protects, which may lock in its place; trips that have not begun
stand in nobody's way. The greater `metering_gain`, the less of `metering_protected` stays unused while somebody waits,
and the more begin at once when there is room.

With `integral` the gate is the PI gate of nmfd.controllers.pi_gating, which begins open, v_p = 1/2, with relief on top:

    v_p(k) = clip(v_p(k-1) + gain (e_p(k) - e_p(k-1)) + integral e_p(k), -1/2, 1/2)
    u_hp = u_min + (u_max - u_min) clip(1/2 + v_p + relief max(z_h - 1, 0), 0, 1).

That takes up what the regional model does not know, so that there is none of it in rollouts of that model: `integral`
is chosen in SUMO (`cosim tune`), and training leaves it alone. Of s instead of the straight line, which closes later as
the region fills, grid7 with 30 % rerouting drivers locked where the PI gate held it.

Guided drivers who are bound for elsewhere are told that a way through region i takes 1 + c_i times as long as it does
(nmfd.types.Controls). What they make of it in the regional model is a logit over the next regions, around their own
split ratios theta0:

    theta_ihj ~ theta0_ihj exp(-e_hj / DISPERSION),    e_hj = c_h t_hj + sum_g theta0_hgj e_gj for h != j,

t_hj the mean time that it takes to leave h on the way to j, so that e_hj is what the prices add from h on. That keeps
the policy differentiable: it is trained as the others are (`training`).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from nmfd.controllers.dpc.policy import Memory, Policy
from nmfd.model import dynamics
from nmfd.model.regional_model import RegionalModel
from nmfd.tensors import PerPair, PerRegion, PerTurn

DISPERSION = 60.0  # s: how differently drivers see the same ways; assumed, nobody has measured it
HELD = 90.0  # s, a cycle of the signals: how fast a region may fill
OLDEST = 8  # numbers of the policies that had the fewest: up to metering
LONGEST = 20.0  # times as long as in free flow: the most that it takes in the model to leave a region


class Numbers(NamedTuple):
    """What a compact policy consists of, in this order; see above. Both of `metering` count where it lets trips wait;
    older policies have no `integral`, `metering_protected` and `metering_gain`."""

    set_point: float = 1.0
    gain: float = 2.0
    relief: float = 0.0
    price: float = 1.0
    price_from: float = 0.6
    elsewhere: float = 0.0
    elsewhere_from: float = 0.6
    metering: float = 1.5
    integral: float = 0.0
    metering_protected: float = 0.0
    metering_gain: float = 1.0


class CompactPolicy(Policy):
    """The policy of these numbers, for the protected regions `architecture.compact`.

    numbers: (11,) [-], `Numbers`
    """

    def _build(self, network: RegionalModel) -> None:
        self.numbers = nn.Parameter(torch.tensor(Numbers()))
        held = np.isin(np.arange(network.regions), self.architecture.compact)
        self.register_buffer("held", torch.tensor(held), persistent=False)
        self.register_buffer("own", torch.tensor(network.nominal_splits, dtype=torch.float32), persistent=False)
        self._model = dynamics.parameters(network, dtype=torch.float32)
        self._hops = int(network.hops.max())

    def begin_with(self, numbers: Sequence[float]) -> None:
        """Set the first of `Numbers` to these, and the others to their defaults."""
        with torch.no_grad():
            self.numbers.copy_(torch.tensor(Numbers(*numbers)))

    def listed(self, x: PerPair, memory: Memory | None = None) -> tuple[PerPair, PerTurn | None]:
        """Perimeter and splits of the states x; memory: what `remember` made of them."""
        numbers, full = self._read(), self._full(x)
        gate = numbers.gain * (numbers.set_point - full) if memory is None else memory[..., 0, :]
        want = gate.unsqueeze(-2) + numbers.relief * (full - 1.0).clamp(min=0.0).unsqueeze(-1)
        share = torch.sigmoid(4.0 * want) if memory is None else (0.5 + want).clamp(0.0, 1.0)
        share = torch.where(self.held, share, torch.ones_like(want))
        perimeter = (self.u_min + (self.u_max - self.u_min) * share) * self.adjacency
        prices = self.prices(x)
        return perimeter, None if prices is None else self._answer(x.to(self.scale.dtype), prices)

    def remember(self, x: PerPair, memory: Memory | None) -> Memory | None:
        """v and e after states x, where they were `memory` before; None without integral action."""
        numbers = self._read()
        if not numbers.integral:
            return None
        error = numbers.set_point - self._full(x)
        v, before = (torch.full_like(error, 0.5), error) if memory is None else memory.unbind(-2)
        v = v + numbers.gain * (error - before) + numbers.integral * error
        return torch.stack([v.clamp(-0.5, 0.5), error], dim=-2)

    def prices(self, x: PerPair) -> PerRegion | None:
        """(..., R) [-], of the ways through each region in the states x."""
        if not self.architecture.guidance:
            return None
        numbers, full = self._read(), self._full(x)
        return torch.where(
            self.held,
            numbers.price * (full - numbers.price_from).clamp(min=0.0),
            numbers.elsewhere * (full - numbers.elsewhere_from).clamp(min=0.0),
        )

    def metering(self, x: PerPair) -> PerRegion | None:
        """(..., R) [veh/s], the most trips that may begin in each region in the states x; None where nobody waits."""
        if not self.architecture.metering:
            return None
        numbers, full = self._read(), self._full(x)
        room = numbers.metering - full
        if numbers.metering_protected:
            fullest = torch.where(self.held, full, torch.zeros_like(full)).amax(-1, keepdim=True)
            room = torch.minimum(room, numbers.metering_gain * (numbers.metering_protected - fullest))
        return self.scale.squeeze(-1) * room.clamp(min=0.0) / HELD

    def bound(self) -> None:
        """Set numbers that fell below 0 to 0."""
        with torch.no_grad():
            self.numbers.clamp_(min=0.0)

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *others: Any) -> None:
        """Of an older file, what it does not have has its default."""
        kept = state_dict.get(f"{prefix}numbers")
        if isinstance(kept, torch.Tensor) and kept.dim() == 1 and OLDEST <= len(kept) < len(Numbers()):
            state_dict[f"{prefix}numbers"] = torch.tensor(Numbers(*kept.tolist()))
        super()._load_from_state_dict(state_dict, prefix, *others)

    def _read(self) -> Numbers:
        return Numbers(*self.numbers.clamp(min=0.0))

    def _full(self, x: PerPair) -> PerRegion:
        """(..., R) [-], how full each region is, in critical accumulations."""
        return x.to(self.scale.dtype).sum(-1) / self.scale.squeeze(-1)

    def _answer(self, x: PerPair, prices: PerRegion) -> PerTurn:
        """(..., R, R, R) [-], the split ratios that prices (..., R) [-] bring about in the regional model."""
        p = self._model
        rate = torch.maximum(dynamics.rate(p, x.sum(-1)), p.c / LONGEST)
        leaving = rate.unsqueeze(-1) * (1.0 if p.exit_rates is None else p.exit_rates)
        here = prices.unsqueeze(-1) / leaving * p.off_diagonal
        extra = here
        for _ in range(self._hops):
            extra = here + torch.einsum("hgj,...gj->...hj", self.own, extra) * p.off_diagonal
        costs = extra.unsqueeze(-3) + torch.zeros_like(self.own)
        least = torch.where(self.own > 0, costs, torch.inf).amin(-2, keepdim=True)
        weight = self.own * torch.exp(-(costs - torch.where(least.isfinite(), least, 0.0)).clamp(min=0.0) / DISPERSION)
        return weight / weight.sum(-2, keepdim=True).clamp(min=1e-9)
