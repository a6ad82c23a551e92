"""Whether perimeter control can help in a city at all: a verdict before anything is trained.

It can only where vehicles on their way into a region that becomes critical pass signals that it commands. What counts
is the share of all that fills such a region, coming from elsewhere or starting there, that a gateway could hold.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Real

from nmfd.arrays import PerPair, PerRegion
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.tables import text_table

ENOUGH = 0.25  # of what fills a critical region can be held: control may be felt
NOTHING = 0.05  # of it, or less: control is not felt

Counts = Real[np.ndarray, "R R"]
FILE = "verdict.txt"
COLUMNS = ("source", "target", "flow_veh", "controlled_veh", "controlled_share", "gateways", "controlled_gateways")


@dataclass(frozen=True, kw_only=True)
class Boundaries:
    """[i, h] = from region i to h.

    flow, controlled: (R, R) [veh] that crossed, and those of them that passed a signal under control; gateways,
    controllable: (R, R), how many there are, and how many with such a signal
    """

    flow: Counts
    controlled: Counts
    gateways: Int[np.ndarray, "R R"]
    controllable: Int[np.ndarray, "R R"]

    @property
    def shares(self) -> PerPair:
        """(R, R) [-]: of the flow that passes a signal under control; of the gateways, where nobody crossed."""
        by_count = self.controllable / np.maximum(self.gateways, 1)
        return np.where(self.flow > 0, self.controlled / np.maximum(self.flow, 1e-9), by_count)

    def rows(self) -> list[tuple]:
        """A row of COLUMNS per boundary and direction, and one for all."""
        parts = (self.flow, self.controlled, self.shares, self.gateways, self.controllable)
        found: list[tuple] = [
            (int(i), int(h), *(_plain(part[i, h]) for part in parts)) for i, h in np.argwhere(self.gateways > 0)
        ]
        flow, controlled = self.flow.sum(), self.controlled.sum()
        share = controlled / flow if flow else float("nan")
        return [
            *found,
            ("all", "all", *map(_plain, (flow, controlled, share, self.gateways.sum(), self.controllable.sum()))),
        ]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """answer: whether perimeter control can help, and why, in a sentence; details: the numbers behind it."""

    answer: str
    details: tuple[str, ...]
    boundaries: Boundaries

    @property
    def sentences(self) -> tuple[str, ...]:
        """All that is said."""
        return (self.answer, *self.details)

    def text(self) -> str:
        """For the file: the sentences, and a table of the boundaries."""
        rows = [
            dict(
                zip(
                    ("from", "to", "flow [veh]", "controlled [veh]", "share", "gateways", "with signals"),
                    (*row[:4], _percent(row[4]), *row[5:]),
                    strict=True,
                )
            )
            for row in self.boundaries.rows()
        ]
        return "\n".join([*self.sentences, "", text_table(rows)]) + "\n"


def verdict(
    network: RegionalModel, boundaries: Boundaries, *, most: PerRegion | None, started: PerRegion | None, where: str
) -> Verdict:
    """most: (R,) [-], the highest accumulation over the critical one, in any run; started: (R,) [veh], trips that began
    in every region; both None where nothing was simulated. where: the runs, such as "in 6 loading runs"."""
    flow, controlled = float(boundaries.flow.sum()), float(boundaries.controlled.sum())
    with_signals, gateways = int(boundaries.controllable.sum()), int(boundaries.gateways.sum())
    details = [
        f"Of {gateways} gateways {with_signals} have a signal that perimeter control can use"
        + (f"; {_percent(controlled / flow)} of the {flow:,.0f} crossings {where} passed one." if flow else ".")
    ]
    if most is not None:
        details.append(
            f"Highest accumulation {where}, as a multiple of the critical one: "
            + ", ".join(f"{_name(network, r)} {most[r]:.2f}" for r in range(network.regions))
            + "."
        )
    if network.placeholder:
        details.append(
            "The critical accumulations are guesses from lanes and speed limits until cosim identify measures them."
        )
    elif any(network.doubts):
        doubtful = [_name(network, r) for r, doubts in enumerate(network.doubts) if doubts]
        details.append(f"The fit is doubtful, and so is this, in {', '.join(doubtful)}: see its warnings.")
    answer = _answer(network, boundaries, most, started, details)
    return Verdict(answer=f"Can perimeter control help? {answer}", details=tuple(details), boundaries=boundaries)


def _answer(
    network: RegionalModel,
    boundaries: Boundaries,
    most: PerRegion | None,
    started: PerRegion | None,
    details: list[str],
) -> str:
    """The answer; what there is to say of critical regions goes to the details."""
    if not boundaries.controllable.any():
        return f"No: {NO_GATEWAY}."
    if most is None or started is None:
        return "Unknown: nothing was simulated; cosim identify will tell."
    if not boundaries.flow.any():
        return "No: nobody crosses a boundary."
    critical = np.flatnonzero(most >= 1.0)
    if not len(critical):
        nearest = int(np.argmax(most))
        return (
            f"No: no region is ever critical, {_name(network, nearest)} comes nearest with {most[nearest]:.2f} of "
            "its critical accumulation, so there is nothing to protect; more demand may change that."
        )
    came, held = boundaries.flow.sum(axis=0), boundaries.controlled.sum(axis=0)
    holdable = held / np.maximum(came + started, 1.0)
    for r in critical:
        details.append(
            f"{_name(network, r)} becomes critical: {came[r]:,.0f} vehicles came into it from other regions, "
            f"{_percent(held[r] / max(came[r], 1.0))} of them past a signal under control, and {started[r]:,.0f} "
            f"started in it; {_percent(holdable[r])} of all that could be held."
        )
    best = int(critical[np.argmax(holdable[critical])])
    share = f"{_percent(holdable[best])} of what fills {_name(network, best)}"
    if holdable[best] <= NOTHING:
        return (
            f"No: regions become critical, but gateways could hold no more than {share}; "
            "other regions (cosim import --regions, --method, or your own) may have signals between them."
        )
    if holdable[best] < ENOUGH:
        return f"Hardly: regions become critical, but gateways could hold no more than {share}."
    return f"It may: {_name(network, best)} becomes critical, and gateways could hold {share}."


NO_GATEWAY = (
    "no gateway has a signal that perimeter control can use, so that only route guidance can do anything here; "
    "other regions (cosim import --regions, --method, or your own) may have signals between them"
)


def _name(network: RegionalModel, region: int) -> str:
    name = network.region_names[region]
    return f"region {region}" if name == str(region) else f"{region} {name}"


def _percent(share: float) -> str:
    return "-" if np.isnan(share) else f"{100.0 * share:.0f} %"


def _plain(value: float) -> float | int:
    number = float(value)
    return int(number) if number == int(number if np.isfinite(number) else 0) else round(number, 4)


def joined(boundaries: Sequence[Boundaries]) -> Boundaries:
    """Of several runs of one city: flows add up."""
    return Boundaries(
        flow=np.sum([one.flow for one in boundaries], axis=0),
        controlled=np.sum([one.controlled for one in boundaries], axis=0),
        gateways=boundaries[0].gateways,
        controllable=boundaries[0].controllable,
    )
