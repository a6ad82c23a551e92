"""Verdict on perimeter control in a city, before any policy is trained.

Control helps only if vehicles on their way into a region that becomes critical pass signals under
control. The measure is the share of all vehicles filling such a region, from elsewhere or starting
there, that a gateway could hold.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from jaxtyping import Int, Real

from nmfd.arrays import PerPair, PerRegion
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.tables import text_columns

ENOUGH = 0.25  # share of the filling vehicles that can be held: control may help
NOTHING = 0.05  # or less: control does not help
# A city is congested if so many of all trips wait outside at a time, or if trips take so many times
# the free-flow time.
WAITING_SHARE = 0.02
SLOW = 2.5
FILE = "verdict.txt"
NO_GATEWAY = (
    "no gateway has a signal that perimeter control can use (gateways.csv says why); where the "
    "city has such signals, other regions may have one (cosim import --regions)"
)
Counts = Real[np.ndarray, "R R"]


@dataclass(frozen=True, kw_only=True)
class Boundaries:
    """Crossings and gateways, [i, h] from region i to h.

    flow, controlled: all crossings, and those past a signal under control (veh, (R, R))
    gateways, controllable: number of gateways, and of those with such a signal ((R, R))
    """

    flow: Counts
    controlled: Counts
    gateways: Int[np.ndarray, "R R"]
    controllable: Int[np.ndarray, "R R"]

    @classmethod
    def of_gateways(
        cls, regions: int, gateways: Iterable[tuple[int, int, float, bool]]
    ) -> "Boundaries":
        """Return the sums over gateways.

        gateways: source, target, crossings [veh], and True for a signal under control
        """
        flow = np.zeros((regions, regions))
        controlled = np.zeros((regions, regions))
        count = np.zeros((regions, regions), dtype=int)
        controllable = np.zeros((regions, regions), dtype=int)
        for source, target, vehicles, reached in gateways:
            flow[source, target] += vehicles
            count[source, target] += 1
            if reached:
                controlled[source, target] += vehicles
                controllable[source, target] += 1
        return cls(flow=flow, controlled=controlled, gateways=count, controllable=controllable)

    @property
    def shares(self) -> PerPair:
        """Controlled share (R, R) [-] of the flow, or of gateways without flow."""
        by_count = self.controllable / np.maximum(self.gateways, 1)
        return np.where(self.flow > 0, self.controlled / np.maximum(self.flow, 1e-9), by_count)

    def table(self) -> str:
        """Return a table with a row for each boundary."""
        headings = ["from", "to", "flow [veh]", "controlled [veh]", "share", "gateways"]
        headings.append("with signals")
        rows = []
        for i, h in np.argwhere(self.gateways > 0):
            rows.append(
                [
                    f"{i}",
                    f"{h}",
                    f"{self.flow[i, h]:.0f}",
                    f"{self.controlled[i, h]:.0f}",
                    f"{self.shares[i, h]:.0%}",
                    f"{self.gateways[i, h]}",
                    f"{self.controllable[i, h]}",
                ]
            )
        return text_columns(headings, rows)


class Answer(Enum):
    """Answer to the question if perimeter control can help, and its reason."""

    NO_SIGNAL = "no gateway has a signal under control"
    NO_CROSSING = "no vehicle crosses a boundary"
    GUESSED = "the critical accumulations are guesses"
    CROWDED = "the city is congested, but no region is seen to become critical"
    FREE = "no region is seen to become critical"
    POWERLESS = "gateways hold nothing of what fills a critical region"
    WEAK = "gateways hold little of what fills a critical region"
    USEFUL = "gateways hold enough of what fills a critical region"


BY_SHARE = (Answer.POWERLESS, Answer.WEAK, Answer.USEFUL)  # answers from what gateways could hold


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Answer and the numbers behind it, from runs with open gateways.

    started: departures by region (veh, (R,))
    waiting: most vehicles that waited outside at a time (veh)
    slowness: trip time over free-flow time (-), NaN if unknown
    where: the runs, such as "in 6 loading runs"
    load: highest accumulation as a multiple of the critical one (-, (R,)), NaN if that was not seen
    holdable: share of the vehicles filling each region that a gateway could hold (-, (R,))
    critical: the regions that become critical
    """

    answer: Answer
    network: RegionalModel
    boundaries: Boundaries
    started: PerRegion
    waiting: float
    slowness: float
    where: str
    load: PerRegion
    holdable: PerRegion
    critical: list[int]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Verdict as sentences, of which the first has the answer.

    protect: the regions to protect
    """

    sentences: tuple[str, ...]
    boundaries: Boundaries
    protect: tuple[int, ...] = ()

    def text(self) -> str:
        """Return the sentences and a table of the boundaries."""
        return "\n".join([*self.sentences, "", self.boundaries.table()]) + "\n"


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
    """Return the verdict: the answer, its grounds, and what to do next.

    most: highest accumulation in any run (veh, (R,))
    started, waiting, slowness, where: those of the Judgement
    scenario: its folder, for commands
    """
    load = most / network.seen_critical
    filling = boundaries.flow.sum(axis=0) + started
    holdable = boundaries.controlled.sum(axis=0) / np.maximum(filling, 1.0)
    critical = np.flatnonzero(load >= 1.0).tolist()
    protect: tuple[int, ...] = ()
    if not boundaries.controllable.any():
        answer = Answer.NO_SIGNAL
    elif not boundaries.flow.any():
        answer = Answer.NO_CROSSING
    elif network.placeholder:
        answer = Answer.GUESSED
    elif critical:
        largest = max(holdable[region] for region in critical)
        if largest <= NOTHING:
            answer = Answer.POWERLESS
        else:
            answer = Answer.USEFUL if largest >= ENOUGH else Answer.WEAK
            least = min(largest, ENOUGH)  # only the best one if none is enough
            protect = tuple(region for region in critical if holdable[region] >= least)
    elif waiting > WAITING_SHARE * started.sum() or slowness > SLOW:
        answer = Answer.CROWDED
    else:
        answer = Answer.FREE
    judgement = Judgement(
        answer=answer,
        network=network,
        boundaries=boundaries,
        started=started,
        waiting=waiting,
        slowness=slowness,
        where=where,
        load=load,
        holdable=holdable,
        critical=critical,
    )
    remedies = [f"Next, {remedy}" for remedy in _remedies(answer, scenario)]
    first = f"Can perimeter control help? {_answer_text(judgement)}"
    sentences = (first, *_facts(judgement), *remedies)
    return Verdict(sentences=sentences, boundaries=boundaries, protect=protect)


def _answer_text(judgement: Judgement) -> str:
    names = judgement.network.titles
    match judgement.answer:
        case Answer.NO_SIGNAL:
            return f"No: {NO_GATEWAY}."
        case Answer.NO_CROSSING:
            return "No: no vehicle crosses a boundary."
        case Answer.GUESSED:
            guessed = "the critical accumulations are guesses from lanes and speed limits"
            return f"Cannot say yet: {guessed}."
        case Answer.CROWDED:
            traffic = _traffic(judgement)
            return f"Cannot say yet: {traffic}, but no region is seen to become critical."
        case Answer.FREE:
            near = int(np.argmax(np.nan_to_num(judgement.load)))
            nearest = ""
            if judgement.load[near] > 0:
                nearest = f", {names[near]} comes nearest with {judgement.load[near]:.2f}"
            free = f"no region is seen to become critical{nearest}"
            return f"No: {free}; more demand may change that."
    best = max(judgement.critical, key=lambda region: judgement.holdable[region])
    share = f"{judgement.holdable[best]:.0%} of what fills {names[best]}"
    if judgement.answer is Answer.USEFUL:
        return f"It may: {names[best]} becomes critical, and gateways could hold {share}."
    little = f"regions become critical, but gateways could hold no more than {share}"
    if judgement.answer is Answer.WEAK:
        return f"Hardly: {little}."
    return f"No: {little}; try other regions."


def _facts(judgement: Judgement) -> list[str]:
    """Return what the answer rests on, a sentence each."""
    boundaries = judgement.boundaries
    network = judgement.network
    names = network.titles
    flow = boundaries.flow.sum()
    passed = ""
    if flow:
        part = boundaries.controlled.sum() / max(flow, 1)
        passed = f"; {part:.0%} of the {flow:,.0f} crossings {judgement.where} passed one"
    guess = ", a guess" if network.placeholder else ""
    ratios = []
    for region, ratio in enumerate(judgement.load):
        if np.isnan(ratio):
            above = network.critical_above[region]
            ratios.append(f"{names[region]} above {above:.0f} veh, not seen")
        else:
            ratios.append(f"{names[region]} {ratio:.2f}")
    facts = [
        f"Of {boundaries.gateways.sum()} gateways {boundaries.controllable.sum()} have a signal "
        f"that perimeter control can use{passed}.",
        f"Highest accumulation {judgement.where}, as a multiple of the critical one{guess}: "
        f"{', '.join(ratios)}.",
        f"There, {_traffic(judgement)}.",
    ]
    if judgement.answer not in BY_SHARE:
        return facts
    for region in judgement.critical:
        came = boundaries.flow[:, region].sum()
        share = boundaries.controlled[:, region].sum() / max(came, 1.0)
        facts.append(
            f"{names[region]} becomes critical: {came:,.0f} vehicles entered from other regions, "
            f"{share:.0%} of them past a signal under control, and "
            f"{judgement.started[region]:,.0f} started in it; "
            f"{judgement.holdable[region]:.0%} of all could be held."
        )
    return facts


def _traffic(judgement: Judgement) -> str:
    """Return how congested the city was."""
    waited = f"up to {judgement.waiting:,.0f} vehicles waited outside at a time"
    if np.isnan(judgement.slowness):
        return waited
    return f"{waited}, and a trip took {judgement.slowness:.1f} times its free-flow time"


def _remedies(answer: Answer, scenario: str) -> list[str]:
    """Return what to do next, with the commands."""
    if answer in (Answer.WEAK, Answer.USEFUL):
        return []
    identify = f"cosim identify {scenario}"
    guidance = f"cosim evaluate {scenario} --controllers no-control,route-guidance"
    pressure = f"{guidance},no-control+max-pressure"
    partition = "another partition: cosim import SUMOCFG --regions N --out networks/OTHER"
    if answer is Answer.GUESSED:
        return [f"the model of the city: {identify}"]
    if answer is Answer.NO_SIGNAL:
        return [f"guidance: {guidance}"]
    remedies = [f"guidance and other signals: {pressure}", partition]
    if answer is Answer.CROWDED:
        remedies.insert(0, f"other demand shows more: {identify} --levels 0.8,1,1.3")
    if answer is Answer.FREE:
        remedies.append(f"more demand: {pressure} --demand 1,1.3,1.6")
    return remedies
