"""Why a controller gains or loses against the reference: one paragraph from the numbers of the runs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.evaluation import statistics
from cosim.evaluation.results import Finished, Level
from nmfd.arrays import PerRegion
from nmfd.controllers.strategy import ALONE, parse
from nmfd.model.regional_model import RegionalModel
from nmfd.studies.benchmark import REFERENCE
from nmfd.types import Result

LEAKING_SHARE = 0.5  # of the boundary flow without a signal: perimeter control has no authority
SMALL_SHARE = 0.01  # of commands, or of the time
OPEN_SHARE = 0.1  # of the range of u below its upper bound: a policy never quite reaches that
FULL_SHARE = 0.02  # more full edges before gateways than under the reference
INTERGREEN_SHARE = 0.03  # more time between two stages than in the original programmes
WAIT_S = 1.0  # before a trip begins


@dataclass(frozen=True, kw_only=True)
class Load:
    """Peak accumulation over critical, share of time beyond it, and share of vehicles that start inside (R,)."""

    peak: PerRegion
    beyond: PerRegion
    inside: PerRegion


def load(network: RegionalModel, runs: Sequence[Result]) -> Load:
    """Return the load of the regions in some runs."""
    states = [run.accumulation.sum(axis=2) / network.critical for run in runs]
    started = sum(run.departures.sum(axis=(0, 2)) for run in runs)
    entered = sum(run.crossings.sum(axis=(0, 1, 3)) for run in runs)
    return Load(
        peak=np.mean([state.max(axis=0) for state in states], axis=0),
        beyond=np.mean([(state > 1.0).mean(axis=0) for state in states], axis=0),
        inside=started / np.maximum(started + entered, 1),
    )


def text(level: Level, finished: Finished) -> str:
    """Return the section of evaluate.md for one demand level."""
    names = list(dict.fromkeys(level.rows["controller"]))
    lines = [f"- {paragraph(level, finished, name)}" for name in names if name != REFERENCE]
    return "\n".join([f"## Why, at demand times {level.demand:g}", "", city(level, finished), "", *lines, ""])


def city(level: Level, finished: Finished) -> str:
    """Return two sentences about the city under the reference."""
    network, against = finished.scenario.network, statistics.compared_with(level.rows)
    found = load(network, _runs(level, against))
    hot = [
        f"{network.region_names[r]} ({found.beyond[r]:.0%} of the time, up to {found.peak[r]:.1f} times)"
        for r in np.flatnonzero(found.beyond > SMALL_SHARE)
    ]
    highest = int(np.argmax(found.peak))
    state = (
        f"these regions exceed their critical accumulation: {', '.join(hot)}"
        if hot
        else f"no region exceeds its critical accumulation; {network.region_names[highest]} is nearest, with "
        f"{found.peak[highest]:.1f} times"
    )
    when = "Without control" if against == REFERENCE else f"Under {against}"
    return f"Signals under control see {1.0 - _leaking(level):.0%} of the boundary flow. {when} {state}."


def paragraph(level: Level, finished: Finished, name: str) -> str:
    """Return how much `name` gains or loses against the reference, and why."""
    rows, against = level.rows, statistics.compared_with(level.rows)
    if name == against:
        return f"{name} is the reference."
    pair = statistics.paired(
        statistics.by_seed(rows, level.demand, name), statistics.by_seed(rows, level.demand, against)
    )
    if not pair.seeds or np.isnan(pair.percent):
        return f"{name} has no seed in common with {against}, or {against} has no time spent: no comparison."
    spread = f"± {pair.percent_half:.1f} % over {pair.seeds} seeds" if pair.seeds > 1 else "on one seed, no proof"
    clear = pair.excludes_zero or pair.seeds == 1
    verdict = "changes nothing" if pair.percent == 0 else "gains" if pair.percent < 0 else "loses"
    if not clear and pair.percent:
        verdict = "shows no significant change"
    reasons = _reasons(level, finished.scenario.network, name, against, gains=clear and pair.percent < 0)
    size = f"{pair.percent:+.1f} % total time spent against {against} {spread}"
    return f"{name} {verdict} ({size}){': ' if reasons else ''}{'; '.join(reasons)}."


def _reasons(level: Level, network: RegionalModel, name: str, against: str, *, gains: bool) -> list[str]:
    """Return what the controller did, and what limits it if it does not gain."""
    before, runs, rows = load(network, _runs(level, against)), _runs(level, name), level.rows
    region, trips = int(np.argmax(before.beyond)), max(sum(run.departures.sum() for run in runs), 1)
    limit = network.u_max - OPEN_SHARE * (network.u_max - network.u_min)
    held = float(np.mean([(run.perimeter[:, network.adjacency] < limit).mean() for run in runs]))
    guided = sum(run.guided.sum() for run in runs) / trips
    strategy = parse(name)
    metered, alone = strategy.metered or level.key["sumo"].get("metering"), strategy.controller.name == ALONE
    waited = sum(run.backlog[1:].sum() * run.step for run in runs) / trips if metered else 0.0
    acts = [
        *([f"it holds vehicles back in {held:.0%} of its commands"] if held >= SMALL_SHARE else []),
        *([f"it guides {guided:.1f} times per trip"] if guided > 0 else []),
        *([f"its trips wait {waited:.0f} s before they begin"] if waited >= WAIT_S else []),
    ] or ["it never holds back and never guides"] * (not alone)
    if gains:
        after = load(network, runs)
        relief = f"{network.region_names[region]} is beyond its critical accumulation {after.beyond[region]:.0%} of the"
        return acts + [f"{relief} time instead of {before.beyond[region]:.0%}"] * int(
            before.beyond[region] > SMALL_SHARE
        )
    limits = []
    if not alone and _leaking(level) > LEAKING_SHARE:
        limits.append(f"{_leaking(level):.0%} of the boundary flow passes no signal under control")
    critical = np.flatnonzero(before.beyond > SMALL_SHARE)
    if not alone and not len(critical):
        limits.append("no region is ever critical, so there is nothing to protect")
    elif held >= SMALL_SHARE and (before.inside[critical] > 0.5).all():
        limits.append("most vehicles in the critical regions start there, behind the gateways")
    full = rows.groupby("controller")["gateway_full_share"].mean()
    if held >= SMALL_SHARE and full[name] - full[against] > FULL_SHARE:
        limits.append(
            f"its queues fill the edges before gateways {full[name]:.0%} of the time, not {full[against]:.0%}"
        )
    mean = rows[rows["controller"] == name].mean(numeric_only=True)
    if mean.get("split_lanes", 0) > 0:
        limits.append(
            f"{mean['split_lanes']:.0f} of {mean['signal_lanes']:.0f} lanes serve movements of several stages"
        )
    if mean.get("intergreen_share", 0) > mean.get("programmed_intergreen_share", 0) + INTERGREEN_SHARE:
        limits.append(
            f"its signals are between stages {mean['intergreen_share']:.0%} of the time, the original programmes "
            f"{mean['programmed_intergreen_share']:.0%}"
        )
    return acts + limits


def _runs(level: Level, name: str) -> list[Result]:
    return [level.read(name, int(seed)) for seed in level.rows.loc[level.rows["controller"] == name, "seed"]]


def _leaking(level: Level) -> float:
    rows = level.rows
    return float(rows.loc[rows["controller"] == statistics.compared_with(rows), "leaking_share"].mean())
