"""Verdict on perimeter control in a city, before any policy is trained.

Control helps only if vehicles on their way into a region that becomes critical pass signals under control. The measure
is the share of all vehicles filling such a region, from elsewhere or starting there, that a gateway could hold.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Real

from nmfd.arrays import PerPair, PerRegion
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.tables import text_columns

ENOUGH = 0.25  # share of the filling vehicles that can be held: control may help
NOTHING = 0.05  # or less: control does not help

Counts = Real[np.ndarray, "R R"]
FILE = "verdict.txt"
NO_GATEWAY = (
    "no gateway has a signal that perimeter control can use, so that only route guidance can help here; other regions "
    "(cosim import --regions, or your own) may have signals between them"
)


@dataclass(frozen=True, kw_only=True)
class Boundaries:
    """Crossings and gateways, [i, h] from region i to h.

    flow, controlled: (R, R) [veh], all crossings, and those past a signal under control
    gateways, controllable: (R, R), number of gateways, and of those with such a signal
    """

    flow: Counts
    controlled: Counts
    gateways: Int[np.ndarray, "R R"]
    controllable: Int[np.ndarray, "R R"]

    @classmethod
    def of_gateways(cls, regions: int, gateways: Iterable[tuple[int, int, float, bool]]) -> "Boundaries":
        """Sum over gateways: source, target, crossings [veh], with a signal under control."""
        flow, controlled = np.zeros((2, regions, regions))
        count, controllable = np.zeros((2, regions, regions), dtype=int)
        for source, target, vehicles, reached in gateways:
            pair = source, target
            flow[pair] += vehicles
            controlled[pair] += vehicles * reached
            count[pair] += 1
            controllable[pair] += reached
        return cls(flow=flow, controlled=controlled, gateways=count, controllable=controllable)

    @property
    def shares(self) -> PerPair:
        """Controlled share (R, R) [-] of the flow, or of the gateways without flow."""
        by_count = self.controllable / np.maximum(self.gateways, 1)
        return np.where(self.flow > 0, self.controlled / np.maximum(self.flow, 1e-9), by_count)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Answer in the first of some sentences, and the numbers behind it."""

    sentences: tuple[str, ...]
    boundaries: Boundaries

    def text(self) -> str:
        """Return the sentences and a table of the boundaries."""
        each = self.boundaries
        pairs = np.argwhere(each.gateways > 0)
        columns = {
            "flow [veh]": [f"{each.flow[i, h]:.0f}" for i, h in pairs],
            "controlled [veh]": [f"{each.controlled[i, h]:.0f}" for i, h in pairs],
            "share": [f"{each.shares[i, h]:.0%}" for i, h in pairs],
            "gateways": each.gateways[*pairs.T],
            "with signals": each.controllable[*pairs.T],
        }
        table = text_columns(["from", "to", *columns], zip(*pairs.T, *columns.values(), strict=True))
        return "\n".join([*self.sentences, "", table]) + "\n"


def verdict(
    network: RegionalModel, boundaries: Boundaries, *, most: PerRegion, started: PerRegion, where: str
) -> Verdict:
    """Return the verdict.

    most: (R,) [-], highest accumulation over the critical one, in any run; started: (R,) [veh], departures by region
    where: the runs, such as "in 6 loading runs"
    """
    names = network.titles
    flow = boundaries.flow.sum()
    passed = (
        f"; {boundaries.controlled.sum() / flow:.0%} of the {flow:,.0f} crossings {where} passed one" if flow else ""
    )
    ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in zip(names, most, strict=True))
    details = [
        f"Of {boundaries.gateways.sum()} gateways {boundaries.controllable.sum()} have a signal that perimeter control "
        f"can use{passed}.",
        f"Highest accumulation {where}, as a multiple of the critical one: {ratios}.",
    ]
    if network.placeholder:
        details.append("The critical accumulations are guesses from lanes and speed limits until cosim identify.")
    critical, nearest = np.flatnonzero(most >= 1.0), int(np.argmax(most))
    came, held = boundaries.flow.sum(axis=0), boundaries.controlled.sum(axis=0)
    holdable = held / np.maximum(came + started, 1.0)
    if not boundaries.controllable.any():
        answer = f"No: {NO_GATEWAY}."
    elif not flow:
        answer = "No: no vehicle crosses a boundary."
    elif not len(critical):
        answer = (
            f"No: no region is ever critical, {names[nearest]} comes nearest with {most[nearest]:.2f} of its critical "
            "accumulation; more demand may change that."
        )
    else:
        details += [
            f"{names[r]} becomes critical: {came[r]:,.0f} vehicles entered from other regions, "
            f"{held[r] / max(came[r], 1.0):.0%} of them past a signal under control, and {started[r]:,.0f} started in "
            f"it; {holdable[r]:.0%} of all could be held."
            for r in critical
        ]
        best = int(critical[np.argmax(holdable[critical])])
        share = f"{holdable[best]:.0%} of what fills {names[best]}"
        if holdable[best] <= NOTHING:
            answer = f"No: regions become critical, but gateways could hold no more than {share}; try other regions."
        elif holdable[best] < ENOUGH:
            answer = f"Hardly: regions become critical, but gateways could hold no more than {share}."
        else:
            answer = f"It may: {names[best]} becomes critical, and gateways could hold {share}."
    return Verdict(sentences=(f"Can perimeter control help? {answer}", *details), boundaries=boundaries)
