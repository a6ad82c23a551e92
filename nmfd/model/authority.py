"""Verdict on perimeter control in a city, before any policy is trained.

Control helps only if vehicles on their way into a region that becomes critical pass signals under control. The measure
is the share of all vehicles filling such a region, from elsewhere or starting there, that a gateway could hold.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Real

from nmfd.arrays import PerPair, PerRegion
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.tables import text_table

ENOUGH = 0.25  # share of the filling vehicles that can be held: control may help
NOTHING = 0.05  # or less: control does not help

Counts = Real[np.ndarray, "R R"]
FILE = "verdict.txt"
COLUMNS = ("source", "target", "flow_veh", "controlled_veh", "controlled_share", "gateways", "controlled_gateways")
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

    @property
    def shares(self) -> PerPair:
        """Controlled share (R, R) [-] of the flow, or of the gateways without flow."""
        by_count = self.controllable / np.maximum(self.gateways, 1)
        return np.where(self.flow > 0, self.controlled / np.maximum(self.flow, 1e-9), by_count)

    def rows(self) -> list[tuple]:
        """Return a row of COLUMNS per boundary and direction, and one for all."""
        parts = (self.flow, self.controlled, self.shares, self.gateways, self.controllable)
        rows: list[tuple] = [
            (int(i), int(h), *(_rounded(part[i, h]) for part in parts)) for i, h in np.argwhere(self.gateways > 0)
        ]
        flow, controlled = self.flow.sum(), self.controlled.sum()
        total = (flow, controlled, controlled / flow if flow else np.nan, self.gateways.sum(), self.controllable.sum())
        return [*rows, ("all", "all", *map(_rounded, total))]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Answer in a sentence, and the numbers behind it."""

    answer: str
    details: tuple[str, ...]
    boundaries: Boundaries

    @property
    def sentences(self) -> tuple[str, ...]:
        """Answer and details."""
        return (self.answer, *self.details)

    def text(self) -> str:
        """Return the sentences and a table of the boundaries."""
        names = ("from", "to", "flow [veh]", "controlled [veh]", "share", "gateways", "with signals")
        rows = [(*row[:4], _percent(row[4]), *row[5:]) for row in self.boundaries.rows()]
        table = text_table([dict(zip(names, row, strict=True)) for row in rows])
        return "\n".join([*self.sentences, "", table]) + "\n"


def verdict(
    network: RegionalModel, boundaries: Boundaries, *, most: PerRegion | None, started: PerRegion | None, where: str
) -> Verdict:
    """Return the verdict.

    most: (R,) [-], highest accumulation over the critical one, in any run; started: (R,) [veh], departures by region;
    both None without a simulation; where: the runs, such as "in 6 loading runs"
    """
    flow, names = float(boundaries.flow.sum()), [_name(network, region) for region in range(network.regions)]
    usable, gateways = int(boundaries.controllable.sum()), int(boundaries.gateways.sum())
    share = _percent(float(boundaries.controlled.sum()) / max(flow, 1e-9))
    passed = f"; {share} of the {flow:,.0f} crossings {where} passed one"
    details = [f"Of {gateways} gateways {usable} have a signal that perimeter control can use{passed if flow else ''}."]
    if most is not None:
        ratios = ", ".join(f"{name} {ratio:.2f}" for name, ratio in zip(names, most, strict=True))
        details.append(f"Highest accumulation {where}, as a multiple of the critical one: {ratios}.")
    if network.placeholder:
        details.append("The critical accumulations are guesses from lanes and speed limits until cosim identify.")
    elif any(network.doubts):
        doubtful = ", ".join(name for name, doubts in zip(names, network.doubts, strict=True) if doubts)
        details.append(f"The fit is doubtful in {doubtful}: see its warnings.")
    answer = _answer(names, boundaries, most, started, details)
    return Verdict(answer=f"Can perimeter control help? {answer}", details=tuple(details), boundaries=boundaries)


def _answer(
    names: list[str], boundaries: Boundaries, most: PerRegion | None, started: PerRegion | None, details: list[str]
) -> str:
    """Return the answer; add sentences on critical regions to `details`."""
    if not boundaries.controllable.any():
        return f"No: {NO_GATEWAY}."
    if most is None or started is None:
        return "Unknown: nothing was simulated; run cosim identify."
    if not boundaries.flow.any():
        return "No: no vehicle crosses a boundary."
    critical = np.flatnonzero(most >= 1.0)
    if not len(critical):
        nearest = int(np.argmax(most))
        return (
            f"No: no region is ever critical, {names[nearest]} comes nearest with {most[nearest]:.2f} of its critical "
            "accumulation; more demand may change that."
        )
    came, held = boundaries.flow.sum(axis=0), boundaries.controlled.sum(axis=0)
    holdable = held / np.maximum(came + started, 1.0)
    for r in critical:
        details.append(
            f"{names[r]} becomes critical: {came[r]:,.0f} vehicles entered from other regions, "
            f"{_percent(held[r] / max(came[r], 1.0))} of them past a signal under control, and {started[r]:,.0f} "
            f"started in it; {_percent(holdable[r])} of all could be held."
        )
    best = int(critical[np.argmax(holdable[critical])])
    share = f"{_percent(holdable[best])} of what fills {names[best]}"
    if holdable[best] <= NOTHING:
        return f"No: regions become critical, but gateways could hold no more than {share}; try other regions."
    if holdable[best] < ENOUGH:
        return f"Hardly: regions become critical, but gateways could hold no more than {share}."
    return f"It may: {names[best]} becomes critical, and gateways could hold {share}."


def joined(boundaries: Sequence[Boundaries]) -> Boundaries:
    """Return the sum over several runs of one city."""
    return Boundaries(
        flow=np.sum([one.flow for one in boundaries], axis=0),
        controlled=np.sum([one.controlled for one in boundaries], axis=0),
        gateways=boundaries[0].gateways,
        controllable=boundaries[0].controllable,
    )


def _name(network: RegionalModel, region: int) -> str:
    name = network.region_names[region]
    return f"region {region}" if name == str(region) else f"{region} {name}"


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100.0 * share:.0f} %"


def _rounded(value: float) -> float | int:
    number = float(value)
    return int(number) if number.is_integer() else round(number, 4)
