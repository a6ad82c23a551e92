"""Answer of guided drivers to prices: a logit over the next regions.

It is that of the regional model. A price c_i multiplies the travel time through region i by
1 + c_i for guided drivers bound for elsewhere (nmfd.types.Controls). The split ratios lie around
the nominal theta0, with the dispersion s (RegionalModel):

    theta_ihj ~ theta0_ihj exp(-e_hj / s)
    e_hj = c_h t_hj + sum_g theta0_hgj e_gj        for h != j, otherwise 0

t_hj is the mean time to leave h on the way to j, so that e_hj is what the prices add from h on.
A price that is the same everywhere changes no way of drivers who compare times. So c_i is the price
relative to the least one: (1 + price_i) / (1 + least price) - 1.
Where the time in a region depends on the next one (RegionalModel.detours), so does its price:

    theta_ihj ~ theta0_ihj exp(-(e_hj + c_i t_ij detour_ihj) / s)
    e_hj = c_h t_hj (1 + sum_g theta0_hgj detour_hgj) + sum_g theta0_hgj e_gj

The dispersion may be that of vehicles in i bound for j. With a `longest_delay` L of the network, a
way whose price adds d more than the least one counts as delayed by L (1 - exp(-d / L)): who can go
another way does so at a small price already, and a larger one diverts few others. The answer is
differentiable.
"""

import torch
from torch import nn

from nmfd.model import dynamics
from nmfd.model.regional_model import RegionalModel
from nmfd.tensors import PerPair, PerRegion, PerTurn

MAX_DELAY_FACTOR = 20.0  # largest time to leave a region, relative to free flow


class Answer(nn.Module):
    """Split ratios as a function of state and prices, without weights."""

    def __init__(self, network: RegionalModel):
        super().__init__()
        nominal = torch.tensor(network.nominal_splits, dtype=torch.float32)
        self.register_buffer("own", nominal, persistent=False)
        spread = torch.as_tensor(network.dispersion, dtype=torch.float32)
        spread = spread.expand(network.adjacency.shape).unsqueeze(-2)
        self.register_buffer("dispersion", spread, persistent=False)
        self.longest_delay = network.longest_delay
        self._network = network
        self._hops = int(network.hops.max())
        self._model = dynamics.parameters(network, dtype=torch.float32)

    def forward(self, x: PerPair, prices: PerRegion) -> PerTurn:
        """Return split ratios (-, (..., R, R, R)).

        x: accumulations (veh, (..., R, R))
        prices: (-, (..., R))
        """
        delay = saturated(self.delays(x, prices), self.longest_delay)
        weight = self.own * torch.exp(-delay / self.dispersion)
        return weight / weight.sum(-2, keepdim=True).clamp(min=1e-9)

    def delays(self, x: PerPair, prices: PerRegion) -> PerTurn:
        """Return what prices add to each way (s, (..., R, R, R)).

        Only differences count: it is 0 for the way to which they add least. Arguments as of
        `forward`.
        """
        device = self.own.device  # to which the module was moved
        if self._model.adjacency.device != device:
            self._model = dynamics.parameters(self._network, dtype=torch.float32, device=device)
        p = self._model
        free = p.mfd.rate_up_to_jam(torch.zeros_like(p.mfd.jam), torch)
        rate = torch.maximum(dynamics.rate(p, x.sum(-1)), free / MAX_DELAY_FACTOR)
        leaving = rate.unsqueeze(-1)
        if p.exit_rates is not None:
            leaving = leaving * p.exit_rates
        least_price = prices.amin(-1, keepdim=True)
        relative = (1.0 + prices) / (1.0 + least_price) - 1.0
        here = relative.unsqueeze(-1) / leaving * p.off_diagonal
        longer = None
        if p.detours is not None:
            longer = here.unsqueeze(-2) * p.detours
            here = here + (self.own * longer).sum(-2)
        # After as many rounds as the longest way has boundaries, e_hj holds every way to j.
        extra = here
        for _ in range(self._hops):
            extra = here + torch.einsum("hgj,...gj->...hj", self.own, extra) * p.off_diagonal
        costs = extra.unsqueeze(-3) + torch.zeros_like(self.own)
        if longer is not None:
            costs = costs + longer
        # Only differences matter: from the least one no exponential is too small.
        least = torch.where(self.own > 0, costs, torch.inf).amin(-2, keepdim=True)
        least = torch.where(least.isfinite(), least, 0.0)
        return (costs - least).clamp(min=0.0)


def saturated(delay: PerTurn, longest: torch.Tensor | float | None) -> PerTurn:
    """Return what delays by prices count as (s).

    longest: of the network (s), None for no limit
    """
    if longest is None:
        return delay
    return longest * -torch.expm1(-delay / longest)
