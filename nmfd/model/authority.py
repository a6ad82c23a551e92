"""Verdict on perimeter control in a city, before any policy is trained.

Control helps only if vehicles on their way into a region that becomes critical pass signals under
control. The measure is the share of all vehicles filling such a region, from elsewhere or starting
there, that a gateway could hold.
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
WAITING_SHARE = 0.02  # of all trips waiting outside at a time, and
SLOW = 2.5  # times the free-flow time: the city is congested
Counts = Real[np.ndarray, "R R"]
FILE = "verdict.txt"
NO_GATEWAY = "no gateway has a signal that perimeter control can use; other regions may have (cosim import --regions)"


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
    def of_gateways(
        cls, regions: int, gateways: Iterable[tuple[int, int, float, bool]]
    ) -> "Boundaries":
        """Sum over gateways: source, target, crossings [veh], with a signal under control."""
        sums = np.zeros((4, regions, regions))
        for source, target, vehicles, reached in gateways:
            sums[:, source, target] += vehicles, vehicles * reached, 1, reached
        count, controllable = sums[2:].astype(int)
        return cls(flow=sums[0], controlled=sums[1], gateways=count, controllable=controllable)

    @property
    def shares(self) -> PerPair:
        """Controlled share (R, R) [-] of the flow, or of the gateways without flow."""
        by_count = self.controllable / np.maximum(self.gateways, 1)
        return np.where(self.flow > 0, self.controlled / np.maximum(self.flow, 1e-9), by_count)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Answer in the first of some sentences, and the numbers behind it; protect: the regions to
    protect."""

    sentences: tuple[str, ...]
    boundaries: Boundaries
    protect: tuple[int, ...] = ()

    def text(self) -> str:
        """Return the sentences and a table of the boundaries."""
        each = self.boundaries
        headings = [
            "from",
            "to",
            "flow [veh]",
            "controlled [veh]",
            "share",
            "gateways",
            "with signals",
        ]
        columns = (each.flow, each.controlled, each.shares, each.gateways, each.controllable)
        forms = ("{}", "{}", "{:.0f}", "{:.0f}", "{:.0%}", "{}", "{}")
        pairs = np.argwhere(each.gateways > 0)
        lines = [
            map(str.format, forms, (i, h, *(part[i, h] for part in columns))) for i, h in pairs
        ]
        return "\n".join([*self.sentences, "", text_columns(headings, lines)]) + "\n"


def verdict(
    network: RegionalModel,
    boundaries: Boundaries,
    *,
    most: PerRegion,
    started: PerRegion,
    waiting: float,
    slowness: float,
    where: str,
    scenario: str,
) -> Verdict:
    """Return the verdict.

    most: (R,) [veh], highest accumulation in any run; started: (R,) [veh], departures by region
    waiting: most vehicles that waited outside at a time [veh]; slowness: trip time over free-flow
        time [-], NaN if unknown
    where: the runs, such as "in 6 loading runs"; scenario: its folder, for commands
    """
    identify = f"cosim identify {scenario}"
    guidance = f"cosim evaluate {scenario} --controllers no-control,route-guidance"
    pressure = f"{guidance},no-control+max-pressure"
    names, flow, load = network.titles, boundaries.flow.sum(), most / network.seen_critical
    part = f"{boundaries.controlled.sum() / max(flow, 1):.0%} of the {flow:,.0f} crossings {where}"
    passed = f"; {part} passed one" if flow else ""
    guess = ", a guess" if network.placeholder else ""
    ratios = ", ".join(
        f"{name} above {network.critical_above[r]:.0f} veh, not seen"
        if np.isnan(ratio)
        else f"{name} {ratio:.2f}"
        for r, (name, ratio) in enumerate(zip(names, load, strict=True))
    )
    crowded = waiting > WAITING_SHARE * started.sum() or slowness > SLOW
    traffic = f"up to {waiting:,.0f} vehicles waited outside at a time"
    traffic += (
        "" if np.isnan(slowness) else f", and a trip took {slowness:.1f} times its free-flow time"
    )
    details = [
        f"Of {boundaries.gateways.sum()} gateways {boundaries.controllable.sum()} have a signal that perimeter control "
        f"can use{passed}.",
        f"Highest accumulation {where}, as a multiple of the critical one{guess}: {ratios}.",
        f"There, {traffic}.",
    ]
    critical = np.flatnonzero(load >= 1.0)
    came, held = boundaries.flow.sum(axis=0), boundaries.controlled.sum(axis=0)
    holdable, protect = held / np.maximum(came + started, 1.0), np.empty(0, dtype=int)
    partition = "another partition: cosim import SUMOCFG --regions N --out networks/OTHER"
    remedies = [f"guidance and other signals: {pressure}", partition]
    if not boundaries.controllable.any():
        answer = f"No: {NO_GATEWAY}."
        remedies = [f"guidance: {guidance}", partition]
    elif not flow:
        answer = "No: no vehicle crosses a boundary."
    elif network.placeholder:
        answer = (
            "Cannot say yet: the critical accumulations are guesses from lanes and speed limits."
        )
        remedies = [f"the model of the city: {identify}"]
    elif not len(critical) and crowded:
        answer = f"Cannot say yet: {traffic}, but no region is seen to become critical."
        remedies = [f"other demand shows more: {identify} --levels 0.8,1,1.3", *remedies]
    elif not len(critical):
        near = int(np.argmax(np.nan_to_num(load)))
        nearest = f", {names[near]} comes nearest with {load[near]:.2f}" if load[near] > 0 else ""
        answer = f"No: no region is seen to become critical{nearest}; more demand may change that."
        remedies.append(f"more demand: {pressure} --demand 1,1.3,1.6")
    else:
        details += [
            f"{names[r]} becomes critical: {came[r]:,.0f} vehicles entered from other regions, "
            f"{held[r] / max(came[r], 1.0):.0%} of them past a signal under control, and {started[r]:,.0f} started in "
            f"it; {holdable[r]:.0%} of all could be held."
            for r in critical
        ]
        best = int(critical[np.argmax(holdable[critical])])
        share = f"{holdable[best]:.0%} of what fills {names[best]}"
        protect = critical[holdable[critical] >= min(ENOUGH, max(holdable[best], NOTHING + 1e-9))]
        if holdable[best] <= NOTHING:
            answer = f"No: regions become critical, but gateways could hold no more than {share}; try other regions."
        elif holdable[best] < ENOUGH:
            answer = (
                f"Hardly: regions become critical, but gateways could hold no more than {share}."
            )
        else:
            answer = f"It may: {names[best]} becomes critical, and gateways could hold {share}."
    if not answer.startswith(("It may", "Hardly")):
        details += [f"Next, {remedy}" for remedy in remedies]
    sentences = f"Can perimeter control help? {answer}", *details
    return Verdict(sentences=sentences, boundaries=boundaries, protect=tuple(map(int, protect)))
