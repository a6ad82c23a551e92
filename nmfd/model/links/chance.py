"""Chance in the link model: vehicles begin and turn one by one.

Without chance, a junction at 95 % of its capacity has no queue left over at the end of green; with
it, trips take longer where traffic is dense. The trips of an entry begin as whole vehicles, one
after the other, the first at a random time. Each vehicle that moves up draws its cell by the shares
p_c, also where several move up in one step, or a part of one. Derivatives are those of the shares.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

DRAWS = 128  # of an entry, a power of 2; then they come again


class Choice(NamedTuple):
    """How the vehicles of B rollouts draw their cells in a control interval.

    shares: of the cells (-, (B, C))
    low, high: a draw from low to high takes the cell (-, (B, C))
    draws: of the vehicles of each entry, one after the other (-, (B, DRAWS, E))
    entry: entry that each cell leaves (C,)
    """

    shares: Tensor
    low: Tensor
    high: Tensor
    draws: Tensor
    entry: Tensor

    def cells(self, before: Tensor, moved: Tensor, most: int) -> Tensor:
        """Return the shares of the cells that a step's vehicles draw (-, (B, C)).

        before: vehicles that moved up so far, by entry (veh, (B, E))
        moved: those of the step (veh, (B, E)); most: no more of an entry than this
        """
        begin = before.detach()
        end = begin + moved.detach()
        still = (end == begin).to(end.dtype)  # none moves up: the next vehicle counts
        first = begin.floor()
        taken = torch.zeros_like(self.shares)
        for n in range(most + 1):
            number = first + n
            part = (torch.minimum(end, number + 1.0) - torch.maximum(begin, number)).clamp(min=0.0)
            if n == 0:
                part = part + still
            share = part / (end - begin + still)
            row = (number.long() % DRAWS).unsqueeze(1)
            draw = self.draws.gather(1, row).squeeze(1).index_select(1, self.entry)
            drawn = (draw >= self.low) & (draw < self.high)
            taken = taken + drawn * share.index_select(1, self.entry)
        return taken + (self.shares - self.shares.detach())


class Chance(NamedTuple):
    """Draws of B rollouts.

    draws: of the vehicles of each entry, one after the other (-, (B, DRAWS, E))
    entry: entry that each cell leaves (C,)
    order: cells in the order of their entries; place: of each cell in it (C,)
    first: place of the first cell of the same entry (C,)
    """

    draws: Tensor
    entry: Tensor
    order: Tensor
    place: Tensor
    first: Tensor

    def choice(self, shares: Tensor) -> Choice:
        """Return how cells with these shares (-, (B, C)) are drawn."""
        ordered = shares.detach().double().index_select(1, self.order)
        total = torch.cumsum(ordered, 1)
        before = total - ordered
        begin = before.index_select(1, self.first)
        low = before.index_select(1, self.place) - begin
        high = total.index_select(1, self.place) - begin
        dtype = self.draws.dtype
        return Choice(shares, low.to(dtype), high.to(dtype), self.draws, self.entry)

    def trips(self, before: Tensor, due: Tensor) -> Tensor:
        """Return the whole trips that begin in a step, by entry (veh, (B, E)).

        before: trips that were due before, on average
        due: those of the step
        """
        start = before.detach() + self.draws[:, 0]
        whole = (start + due.detach()).floor() - start.floor()
        return whole + (due - due.detach())


def chance_of(seeds: Sequence[int], entries: int, entry: Tensor) -> Chance:
    """Return the draws of rollouts with these seeds.

    entries: E; entry: that each cell leaves (C,)
    """
    uniform = []
    for seed in seeds:
        generator = torch.Generator().manual_seed(seed)
        uniform.append(torch.rand(DRAWS, entries, generator=generator))
    order = torch.argsort(entry, stable=True)
    sizes = torch.bincount(entry, minlength=entries)
    first = (torch.cumsum(sizes, 0) - sizes)[entry]
    return Chance(torch.stack(uniform).to(entry.device), entry, order, torch.argsort(order), first)
