"""Why a controller gains or loses against the reference.

One paragraph for each controller, from the numbers of the runs.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cosim.evaluation import statistics
from cosim.evaluation.results import Finished, Level
from cosim.plant.strategy import Strategy, of_finished
from nmfd.arrays import PerRegion
from nmfd.controllers.rules import PiGate, PiGating
from nmfd.controllers.strategy import ALONE
from nmfd.metrics import largest_accumulation
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.studies.benchmark import REFERENCE
from nmfd.types import Result

LEAKING_SHARE = 0.5  # of the boundary flow without a signal: perimeter control has no authority
SMALL_SHARE = 0.01  # of commands, of the time, or of trips
OPEN_SHARE = 0.1  # of the range of u below its upper bound: a policy never quite reaches that
FULL_SHARE = 0.02  # more full edges before gateways than under the reference
INTERGREEN_SHARE = 0.03  # more time between two stages than in the original programmes
WAIT_S = 1.0  # before a trip begins
LONGER_PERCENT = 5.0  # trips from one region, while the whole gains


class Load(NamedTuple):
    """Load of the regions, mean over runs.

    peak: largest accumulation over the critical one (R,), NaN where that was not seen
    beyond: share of the time beyond the critical accumulation (R,), 0 where that was not seen
    """

    peak: PerRegion
    beyond: PerRegion


def load(network: RegionalModel, runs: Sequence[Result]) -> Load:
    """Return the load of the regions."""
    states = [run["accumulation"].sum(axis=2) / network.seen_critical for run in runs]
    return Load(
        peak=np.mean([state.max(axis=0) for state in states], axis=0),
        beyond=np.mean([(state > 1).mean(axis=0) for state in states], axis=0),
    )


def text(level: Level, finished: Finished) -> str:
    """Return the section of evaluate.md for one demand level."""
    lines = [f"## Why, at demand times {level.demand:g}", "", city(level, finished), ""]
    for name in level.rows["controller"].unique():
        if name != REFERENCE:
            lines.append(f"- {paragraph(level, finished, name)}")
    return "\n".join([*lines, ""])


def city(level: Level, finished: Finished) -> str:
    """Return two sentences about the city under the reference."""
    network = finished.scenario.network
    names = network.region_names
    against = statistics.compared_with(level.rows)
    peak, beyond = load(network, level.measures(against))
    hot = [
        f"{names[r]} ({beyond[r]:.0%} of the time, up to {peak[r]:.1f} times)"
        for r in np.flatnonzero(beyond > SMALL_SHARE)
    ]
    if hot:
        state = f"these regions exceed their critical accumulation: {', '.join(hot)}"
    else:
        state = "no region exceeds its critical accumulation"
        seen = np.flatnonzero(~np.isnan(peak))
        if len(seen):
            most = seen[np.argmax(peak[seen])]
            state += f"; {names[most]} is nearest, with {peak[most]:.1f} times"
        if len(seen) < len(names):
            state += f"; that of {len(names) - len(seen)} regions was not seen"
    state = "; ".join([state, *_removed(level, against)])
    when = f"Under {against}"
    if against == REFERENCE:
        when = "Without control"
    leaking = statistics.by_seed(level.rows, level.demand, against, "leaking_share")
    seen_by_signals = f"{1.0 - np.mean(list(leaking.values())):.0%} of the boundary flow"
    return f"Signals under control see {seen_by_signals}. {when} {state}."


def paragraph(level: Level, finished: Finished, name: str) -> str:
    """Return how much a controller gains or loses, and why."""
    against = statistics.compared_with(level.rows)
    if name == against:
        return f"{name} is the reference."
    own = statistics.by_seed(level.rows, level.demand, name)
    reference = statistics.by_seed(level.rows, level.demand, against)
    pair = statistics.paired(own, reference)
    if np.isnan(pair.percent):
        reason = f"{name} has no seed in common with {against}, or no vehicle spent time"
        return f"{reason}: no comparison."
    few = pair.seeds < statistics.FEWEST_SEEDS
    clear = pair.significant or few
    gains = clear and pair.percent < 0
    if not pair.percent:
        verdict = "changes nothing"
    elif not clear:
        verdict = "shows no significant change"
    elif gains:
        verdict = "gains"
    else:
        verdict = "loses"
    spread = "on one seed"
    if pair.seeds > 1:
        spread = f"± {pair.percent_half:.1f} % over {pair.seeds} seeds"
    if few:
        spread += ", no proof"
    size = f"{pair.percent:+.1f} % total time spent against {against} {spread}"
    reasons = _reasons(level, finished.scenario, name, against, gains=gains)
    reasons += _removed(level, name)
    because = f": {'; '.join(reasons)}" if reasons else ""
    losers = ""
    if gains:
        losers = _losers(level, finished.scenario.network.region_names, name, against)
    return f"{name} {verdict} ({size}){because}.{losers}"


def _reasons(
    level: Level, scenario: Scenario, name: str, against: str, *, gains: bool
) -> list[str]:
    """Return what a controller did, and what limits it if it does not gain."""
    network = scenario.network
    runs = level.measures(name)
    reference = level.measures(against)
    strategy = of_finished(name)
    trips = max(sum(run["departures"].sum() for run in runs), 1)
    acts = strategy.controller.name != ALONE

    limit = network.u_max - OPEN_SHARE * (network.u_max - network.u_min)
    held = float(np.mean([(run["perimeter"][:, network.adjacency] < limit).mean() for run in runs]))
    holds = held >= SMALL_SHARE
    guided = sum(run["guided"].sum() for run in runs) / trips
    waited = 0.0
    if strategy.city.metering or level.key["sumo"].get("metering"):
        waited = sum(run["backlog"][1:].sum() * run.step for run in runs) / trips
    deeds = []
    if holds:
        deeds.append(f"it holds vehicles back in {held:.0%} of its commands")
    if guided > 0:
        deeds.append(f"it guides {guided:.1f} times per trip")
    if waited >= WAIT_S:
        deeds.append(f"its trips wait {waited:.0f} s before they begin")
    if acts and not deeds:
        deeds.append("it never holds back and never guides")
    reasons = _never_reached(strategy, scenario, runs) + deeds

    beyond = load(network, reference).beyond
    critical = np.flatnonzero(beyond > SMALL_SHARE)
    if not gains:
        return reasons + _limits(level, name, reference, critical, acts=acts, holds=holds)
    if len(critical):
        region = int(np.argmax(beyond))
        now = load(network, runs).beyond[region]
        reasons.append(
            f"{network.region_names[region]} is critical {now:.0%} of the time "
            f"instead of {beyond[region]:.0%}"
        )
    return reasons


def _limits(
    level: Level,
    name: str,
    reference: Sequence[Result],
    critical: np.ndarray,
    *,
    acts: bool,
    holds: bool,
) -> list[str]:
    """Return what keeps a controller from gaining.

    reference: runs under the reference
    critical: regions that are critical in them
    acts: the controller is not no-control alone
    holds: it holds vehicles back
    """
    mean = level.rows.groupby("controller").mean(numeric_only=True)
    own = mean.loc[name]
    before = mean.loc[statistics.compared_with(level.rows)]
    limits = []
    leaking = before["leaking_share"]
    if acts and leaking > LEAKING_SHARE:
        limits.append(f"{leaking:.0%} of the boundary flow passes no signal under control")
    if acts and not len(critical):
        limits.append("no region is seen to be critical, so there is nothing to protect")
    if holds and len(critical):
        started = sum(run["departures"].sum(axis=(0, 2)) for run in reference)
        entered = sum(run["crossings"].sum(axis=(0, 1, 3)) for run in reference)
        if (started > entered)[critical].all():
            limits.append("most vehicles in the critical regions start there, behind the gateways")
    full = own["gateway_full_share"]
    full_before = before["gateway_full_share"]
    if holds and full - full_before > FULL_SHARE:
        limits.append(
            f"its queues fill the edges before gateways {full:.0%} of the time, "
            f"not {full_before:.0%}"
        )
    split = own.get("split_lanes", 0)
    if split > 0:
        lanes = own.get("signal_lanes", 0)
        limits.append(f"{split:.0f} of {lanes:.0f} lanes serve movements of several stages")
    between = own.get("intergreen_share", 0.0)
    programmed = own.get("programmed_intergreen_share", 0.0)
    if between > programmed + INTERGREEN_SHARE:
        limits.append(
            f"its signals are between stages {between:.0%} of the time, "
            f"the original programmes {programmed:.0%}"
        )
    return limits


def _losers(level: Level, region_names: Sequence[str], name: str, against: str) -> str:
    """Return a sentence about the regions from which trips take much longer.

    It is "" if there are none.
    """
    longer = statistics.longer_trips(level, name, against)
    worst = []
    for region in np.argsort(-longer):
        if longer[region] > LONGER_PERCENT:
            worst.append(f"{region_names[region]} ({longer[region]:+.0f} %)")
    if not worst:
        return ""
    return f" Some lose: trips from {', '.join(worst)} take longer."


def _never_reached(strategy: Strategy, scenario: Scenario, runs: Sequence[Result]) -> list[str]:
    """Return the gates whose region never reached its set point, in any run."""
    if not isinstance(strategy.options(scenario), PiGating):
        return []
    gate = strategy.make(scenario)
    if not isinstance(gate, PiGate):
        return []
    most = largest_accumulation(run["accumulation"] for run in runs)
    gates = []
    for region, goal in zip(gate.regions, gate.set_point, strict=True):
        if most[region] < goal:
            gates.append(
                f"{scenario.network.region_names[region]} never reaches the set point of its gate, "
                f"{goal:.0f} vehicles, with {most[region]:.0f} at most"
            )
    return gates


def _removed(level: Level, name: str) -> list[str]:
    """Return the removed trips as a reason if they are many."""
    rows = level.rows[level.rows["controller"] == name]
    removed = rows["removed_veh"].sum()
    trips = rows["trips"].sum()
    if removed > SMALL_SHARE * trips:
        return [f"{removed / trips:.1%} of its trips end by removal"]
    return []
