"""Why a controller gains or loses against the reference: one paragraph from the numbers of the
runs."""

from collections.abc import Sequence

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


def load(network: RegionalModel, runs: Sequence[Result]) -> tuple[PerRegion, PerRegion]:
    """Return peak accumulation over critical (R,) and the share of time beyond critical (R,), mean
    over runs.

    NaN and 0 where the critical accumulation was not seen.
    """
    states = [run.accumulation.sum(axis=2) / network.seen_critical for run in runs]
    return np.mean([s.max(axis=0) for s in states], axis=0), np.mean(
        [(s > 1).mean(axis=0) for s in states], axis=0
    )


def text(level: Level, finished: Finished) -> str:
    """Return the section of evaluate.md for one demand level."""
    names = list(dict.fromkeys(level.rows["controller"]))
    lines = [f"- {paragraph(level, finished, name)}" for name in names if name != REFERENCE]
    return "\n".join(
        [f"## Why, at demand times {level.demand:g}", "", city(level, finished), "", *lines, ""]
    )


def city(level: Level, finished: Finished) -> str:
    """Return two sentences about the city under the reference."""
    names, against = finished.scenario.network.region_names, statistics.compared_with(level.rows)
    peak, beyond = load(finished.scenario.network, level.results(against))
    state = "no region exceeds its critical accumulation"
    if len(known := np.flatnonzero(~np.isnan(peak))):
        most = known[np.argmax(peak[known])]
        state += f"; {names[most]} is nearest, with {peak[most]:.1f} times"
    if unseen := len(names) - len(known):
        state += f"; that of {unseen} regions was not seen"
    if hot := [
        f"{names[r]} ({beyond[r]:.0%} of the time, up to {peak[r]:.1f} times)"
        for r in np.flatnonzero(beyond > SMALL_SHARE)
    ]:
        state = f"these regions exceed their critical accumulation: {', '.join(hot)}"
    when = "Without control" if against == REFERENCE else f"Under {against}"
    state = "; ".join([state, *_removed(level, against)])
    return f"Signals under control see {1.0 - _leaking(level):.0%} of the boundary flow. {when} {state}."


def paragraph(level: Level, finished: Finished, name: str) -> str:
    """Return how much `name` gains or loses against the reference, and why."""
    against = statistics.compared_with(level.rows)
    if name == against:
        return f"{name} is the reference."
    values = [statistics.by_seed(level.rows, level.demand, each) for each in (name, against)]
    pair = statistics.paired(*values)
    if np.isnan(pair.percent):
        return (
            f"{name} has no seed in common with {against}, or no vehicle spent time: no comparison."
        )
    few, gains = pair.seeds < statistics.FEWEST_SEEDS, pair.percent < 0
    clear = pair.significant or few
    verdict = "changes nothing" if not pair.percent else "gains" if gains else "loses"
    if pair.percent and not clear:
        verdict = "shows no significant change"
    spread = (
        f"± {pair.percent_half:.1f} % over {pair.seeds} seeds" if pair.seeds > 1 else "on one seed"
    )
    spread += ", no proof" * few
    reasons = _reasons(level, finished.scenario, name, against, gains=clear and gains) + _removed(
        level, name
    )
    size = f"{pair.percent:+.1f} % total time spent against {against} {spread}"
    losers = (
        _losers(level, finished.scenario.network.region_names, name, against)
        if clear and gains
        else ""
    )
    return f"{name} {verdict} ({size}){': ' if reasons else ''}{'; '.join(reasons)}.{losers}"


def _reasons(
    level: Level, scenario: Scenario, name: str, against: str, *, gains: bool
) -> list[str]:
    """Return what the controller did, and what limits it if it does not gain."""
    reference, runs, strategy, network = (
        level.results(against),
        level.results(name),
        of_finished(name),
        scenario.network,
    )
    beyond = load(network, reference)[1]
    trips, acts = (
        max(sum(run.departures.sum() for run in runs), 1),
        strategy.controller.name != ALONE,
    )
    limit = network.u_max - OPEN_SHARE * (network.u_max - network.u_min)
    held = float(np.mean([(run.perimeter[:, network.adjacency] < limit).mean() for run in runs]))
    guided = sum(run.guided.sum() for run in runs) / trips
    metered = strategy.city.metering or level.key["sumo"].get("metering")
    waited = sum(run.backlog[1:].sum() * run.step for run in runs) / trips if metered else 0.0
    deeds = {
        f"it holds vehicles back in {held:.0%} of its commands": held >= SMALL_SHARE,
        f"it guides {guided:.1f} times per trip": guided > 0,
        f"its trips wait {waited:.0f} s before they begin": waited >= WAIT_S,
    }
    done = _never_reached(strategy, scenario, runs)
    done += [words for words, true in deeds.items() if true] or [
        "it never holds back and never guides"
    ] * acts
    critical, region = np.flatnonzero(beyond > SMALL_SHARE), int(np.argmax(beyond))
    if gains:
        now = load(network, runs)[1][region]
        relief = f"{network.region_names[region]} is critical {now:.0%} of the time instead of {beyond[region]:.0%}"
        return done + [relief] * bool(len(critical))
    mean = level.rows[level.rows["controller"] == name].mean(numeric_only=True)
    full = level.rows.groupby("controller")["gateway_full_share"].mean()
    split, between = (
        mean.get("split_lanes", 0),
        [mean.get(f"{k}intergreen_share", 0.0) for k in ("", "programmed_")],
    )
    leaking, holds = _leaking(level), held >= SMALL_SHARE
    started = sum(run.departures.sum(axis=(0, 2)) for run in reference)
    entered = sum(run.crossings.sum(axis=(0, 1, 3)) for run in reference)
    inside = len(critical) > 0 and bool((started > entered)[critical].all())
    blocks = holds and full[name] - full[against] > FULL_SHARE
    slow = between[0] > between[1] + INTERGREEN_SHARE
    limits = {
        f"{leaking:.0%} of the boundary flow passes no signal under control": acts
        and leaking > LEAKING_SHARE,
        "no region is seen to be critical, so there is nothing to protect": acts
        and not len(critical),
        "most vehicles in the critical regions start there, behind the gateways": holds and inside,
        f"its queues fill the edges before gateways {full[name]:.0%} of the time, not {full[against]:.0%}": blocks,
        f"{split:.0f} of {mean.get('signal_lanes', 0):.0f} lanes serve movements of several stages": split
        > 0,
        f"its signals are between stages {between[0]:.0%} of the time, the original programmes {between[1]:.0%}": slow,
    }
    return done + [words for words, true in limits.items() if true]


def _losers(level: Level, region_names: Sequence[str], name: str, against: str) -> str:
    """Return a sentence about the regions from which trips take much longer, "" if there are
    none."""
    longer = statistics.longer_trips(level, name, against)
    worst = [
        f"{region_names[r]} ({longer[r]:+.0f} %)"
        for r in np.argsort(-longer)
        if longer[r] > LONGER_PERCENT
    ]
    return f" Some lose: trips from {', '.join(worst)} take longer." if worst else ""


def _never_reached(strategy: Strategy, scenario: Scenario, runs: Sequence[Result]) -> list[str]:
    """Return the gates whose region never reached its set point, in any run."""
    gate = strategy.make(scenario) if isinstance(strategy.options(scenario), PiGating) else None
    if not isinstance(gate, PiGate):
        return []
    most = largest_accumulation(run.accumulation for run in runs)
    return [
        f"{scenario.network.region_names[region]} never reaches the set point of its gate, {goal:.0f} vehicles, with "
        f"{most[region]:.0f} at most"
        for region, goal in zip(gate.regions, gate.set_point, strict=True)
        if most[region] < goal
    ]


def _removed(level: Level, name: str) -> list[str]:
    """Return the removed trips as a reason if they are many: their time counts until then."""
    removed, trips = level.rows.loc[
        level.rows["controller"] == name, ["removed_veh", "trips"]
    ].sum()
    return (
        [f"{removed / trips:.1%} of its trips end by removal"]
        if removed > SMALL_SHARE * trips
        else []
    )


def _leaking(level: Level) -> float:
    rows = level.rows
    return float(
        rows.loc[rows["controller"] == statistics.compared_with(rows), "leaking_share"].mean()
    )
