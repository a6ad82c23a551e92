"""Drivers of the link model: shares of turns on their way.

Without guidance the vehicles of an entry e take its cells c with the static shares p_c. Guided
drivers weigh the ways onward:

    z_e = sum_c p_c w_c z(c),     p'_c = p_c w_c z(c) / z_e,     z(c) = 1 where the way ends

z(c) is that of the entry that c leads to. This is a recursive logit (Fosgerau, Frejinger and
Karlstroem, 2013) whose prior are the static shares: only ways that static routes use are taken.

- By times, to the region of destination: w_c = exp(-(d + price T) / DISPERSION_S), with the time T
  and the delay d on the link that c enters; a price counts where another region is the destination.
- By commanded splits, to the next region: w_c = theta_ihj / nominal theta_ihj over the boundary, so
  that nominal splits change nothing.

In the region of destination the shares are static. A share of the drivers, the compliance, follows.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nmfd.arrays import PerTurn
from nmfd.model.links.flows import Flows
from nmfd.model.regional_model import DISPERSION_S
from nmfd.tensors import PerRegion
from nmfd.tensors import PerTurn as Turns

LONGEST_DELAY_S = 300.0  # on one link; keeps weights within the range of numbers
LEAST_NOMINAL = 0.02  # nominal share by which a command is divided
ARRIVED = 0.999  # share of the static ways that the recursion follows to their end
LONGEST_WAY = 500  # links


@dataclass(frozen=True)
class _Ways:
    """Ends of the ways of a choice.

    ends: True for cells after which nothing is weighed (C,)
    steps: links on the longest way
    """

    ends: Tensor
    steps: int


class Drivers:
    """Shares of the cells (B, C) under guidance; static without."""

    def __init__(self, flows: Flows, nominal: PerTurn | None):
        """nominal: split ratios without guidance (-, (R, R, R))

        None: no splits are commanded.
        """
        network = flows.network
        self._flows = flows
        region = network.region
        target = network.destination[network.cell_entry]
        here = region[network.entry_link[network.cell_entry]]
        onward = region[network.turn_link[network.cell_turn]]
        self._shares = flows.values(network.cell_share).double()
        self._target = flows.places(target)
        self._link = flows.places(network.turn_link[network.cell_turn])
        self._region_of_link = flows.places(region)
        self._at_home = torch.as_tensor(here == target, device=flows.device)
        self._enters_home = torch.as_tensor(onward == target, device=flows.device)
        self._free = flows.values(flows.free_time)
        home = region[network.entry_link] == network.destination
        self._home = torch.as_tensor(home, device=flows.device).unsqueeze(0)
        self._to_destination = self._ways(onward == target)
        self._to_next_region = self._ways(onward != here)
        regions = network.regions
        self._crosses = torch.as_tensor(onward != here, device=flows.device)
        self._turn = flows.places((here * regions + onward) * regions + target)
        self._nominal = None
        if nominal is not None:
            self._nominal = flows.values(nominal).reshape(1, -1).clamp(min=LEAST_NOMINAL)

    def static(self, row: Tensor) -> Tensor:
        """Return the shares without guidance.

        row: of the network's shares, of each rollout (B,)
        """
        return self._shares.index_select(0, row)

    def by_times(
        self, share: Tensor, present: Tensor, left: Tensor, prices: PerRegion | None
    ) -> Tensor:
        """Return the shares of drivers who weigh travel times.

        share: static ones (-, (B, C))
        present: vehicles on each link, summed over the last interval (veh s, (B, L))
        left: vehicles that left it then (veh, (B, L))
        """
        # A vehicle in free flow beside those seen: the time of an empty link is its free time.
        time = (present + self._free) / (left + 1.0)
        cost = (time - self._free).clamp(0.0, LONGEST_DELAY_S).index_select(1, self._link)
        if prices is not None:
            priced = time * prices.index_select(1, self._region_of_link)
            cost = cost + torch.where(self._enters_home, 0.0, priced.index_select(1, self._link))
        weight = torch.exp(-cost.double() / DISPERSION_S)
        return self._weighed(share, weight, self._to_destination)

    def by_splits(self, share: Tensor, splits: Turns) -> Tensor:
        """Return the shares of drivers who head for commanded next regions.

        share: static ones (-, (B, C))
        """
        if self._nominal is None:
            return share
        ratio = splits.flatten(1) / self._nominal
        weight = torch.where(self._crosses, ratio.index_select(1, self._turn), 1.0)
        return self._weighed(share, weight.double(), self._to_next_region)

    def _ways(self, ends: np.ndarray) -> _Ways:
        """Return ways that end with some cells (C,)."""
        last = torch.as_tensor(ends, device=self._flows.device)
        reached = self._home.double().expand(len(self._shares), -1)
        steps = 0
        while steps < LONGEST_WAY and float(reached.min()) < ARRIVED:
            reached = self._onward(reached, self._shares, last)[1]
            steps += 1
        return _Ways(last, max(steps, 1))

    def _onward(self, value: Tensor, weighed: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
        """Return p_c w_c z(c) (B, C), and its sums z_e (B, E).

        value: z_e before (B, E)
        weighed: p_c w_c (B, C)
        ends: of the ways (C,)
        """
        flows = self._flows
        share = weighed * torch.where(ends, 1.0, value.index_select(1, flows.onward))
        zeros = share.new_zeros(len(share), flows.entries)
        total = zeros.index_add(1, flows.entry_of_cell, share)
        return share, torch.where(self._home, 1.0, total)

    def _weighed(self, share: Tensor, weight: Tensor, ways: _Ways) -> Tensor:
        """Return p'_c (-, (B, C)); where no way is left, the static shares."""
        value = share.new_ones(len(share), self._flows.entries)
        weighed = share * weight
        onward = weighed
        for _ in range(ways.steps):
            onward, value = self._onward(value, weighed, ways.ends)
        total = value.index_select(1, self._flows.entry_of_cell)
        possible = (total > torch.finfo(torch.float64).tiny) & ~self._at_home
        return torch.where(possible, onward / torch.where(possible, total, 1.0), share)
