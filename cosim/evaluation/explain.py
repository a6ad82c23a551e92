"""Why a controller gained something, or nothing, against no control, or against the first one where that was not run:
what the runs of an evaluation say about it.

Perimeter control can only gain where it controls the boundaries, where a region would go beyond its critical
accumulation without it, and if it holds vehicles back at all; even then it may cost more than it saves.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Int

from cosim.evaluation import experiment, signal_reasons, statistics
from nmfd.arrays import PerRegion
from nmfd.controllers.strategy import ALONE, parse
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import run_folder
from nmfd.studies.benchmark import REFERENCE
from nmfd.types import Result

NO_AUTHORITY = 0.5  # of the flow over the boundaries passes without a signal under control
HARDLY = 0.01  # of the commands, or of the time
NEARLY_OPEN = 0.1  # of the range of u, below its upper bound: a learned policy never quite reaches that
MOSTLY_INSIDE = 0.5  # of what came into a region started there
MORE_FULL = 0.02  # of the edges before gateways and intervals
A_WAIT = 1.0  # s, before a trip begins


@dataclass(frozen=True, kw_only=True)
class Loading:
    """Of R regions: most (R,), the highest accumulation over the critical one, mean over the runs; beyond (R,), the
    share of the time beyond it; inside (R,), the share of the vehicles there that had started there, NaN if unknown."""

    most: PerRegion
    beyond: PerRegion
    inside: PerRegion

    @property
    def critical(self) -> Int[np.ndarray, " _"]:
        """The regions that were beyond their critical accumulation for more than a moment."""
        return np.flatnonzero(self.beyond > HARDLY)


def load(network: RegionalModel, trajectories: Sequence[Result], records: Iterable[Mapping]) -> Loading:
    """What some runs were like."""
    critical = network.critical
    states = [trajectory.accumulation.sum(axis=2) / critical for trajectory in trajectories]
    started, came = np.zeros(network.regions), np.zeros(network.regions)
    for record in records:
        started += record["departures"].sum(axis=(0, 2))
        came += record["crossings"].sum(axis=(0, 1, 3))
    with np.errstate(invalid="ignore"):
        inside = started / (started + came)
    return Loading(
        most=np.mean([state.max(axis=0) for state in states], axis=0),
        beyond=np.mean([(state > 1.0).mean(axis=0) for state in states], axis=0),
        inside=inside,
    )


@dataclass(frozen=True, kw_only=True)
class ControlActivity:
    """What a controller did. held: share of its perimeter commands, one per boundary, direction and interval, that were
    below the upper bound by more than NEARLY_OPEN of the range; guided: vehicles per trip that it gave a next region;
    waited [s]: before a trip began, where trips are metered.
    """

    held: float
    guided: float
    waited: float = 0.0

    def __str__(self) -> str:
        """As the end of a sentence about the controller."""
        parts = [f"it held back in {_share(self.held)} of its commands"] if self.held >= HARDLY else []
        if self.guided > 0:
            parts.append(f"it guided {self.guided:.1f} times per trip")
        if self.waited >= A_WAIT:
            parts.append(f"its trips waited {self.waited:.0f} s before they began")
        return " and ".join(parts) or "it never held back and never guided"


def deeds(
    network: RegionalModel, trajectories: Sequence[Result], records: Iterable[Mapping], *, metered: bool = False
) -> ControlActivity:
    """What a controller did in some runs; metered: whether it could make trips wait."""
    limit = network.u_max - NEARLY_OPEN * (network.u_max - network.u_min)
    held = [(t.perimeter[:, network.adjacency] < limit).mean() for t in trajectories]
    guided, trips = 0.0, 0.0
    for record in records:
        guided, trips = guided + record["guided"].sum(), trips + record["departures"].sum()
    waited = sum(t.backlog[1:].sum() * t.step for t in trajectories) if metered else 0.0
    return ControlActivity(
        held=float(np.mean(held)), guided=float(guided / max(trips, 1.0)), waited=float(waited / max(trips, 1.0))
    )


def text(folders: Mapping[float, Path], network: RegionalModel, rows: pd.DataFrame) -> str:
    """Markdown, a section per demand level: what the city was like without control, and a line per controller.

    folders: demand level -> its run folder; rows: as in cosim.evaluation.statistics.
    """
    parts = []
    for level, folder in folders.items():
        city, lines = at(level, folder, network, rows[rows["demand"] == level])
        parts.append("\n".join([f"## Why, at demand times {level:g}", "", city, "", *(f"- {line}" for line in lines)]))
    return "\n\n".join(parts) + "\n"


def at(level: float, folder: Path, network: RegionalModel, rows: pd.DataFrame) -> tuple[str, list[str]]:
    """What the city was like without control at one demand level, or under the first controller, and a line per
    controller; rows: of this level."""
    kept = {name: [int(seed) for seed in group["seed"]] for name, group in rows.groupby("controller", sort=False)}
    shown = statistics.compared_with(rows)
    found = load(network, *_runs(folder, shown, kept[shown]))
    leaking = float(rows.loc[rows["controller"] == shown, "leaking_share"].mean())
    lines = []
    for name, seeds in kept.items():
        if name != REFERENCE:
            done = deeds(network, *_runs(folder, name, seeds), metered=_metered(folder, name))
            lines.append(f"{name} {verdict(rows, level, name, found, leaking, done, network)}")
    return _city(network, found, leaking, shown), lines


def _metered(folder: Path, name: str) -> bool:
    """Whether trips could be made to wait in the runs of a strategy: by its name, or everywhere in this city."""
    if parse(name).metered:
        return True
    return bool(run_folder.read_manifest(folder / "manifest.json")["configuration"].get("sumo", {}).get("metering"))


def at_a_glance(level: float, folder: Path, network: RegionalModel, rows: pd.DataFrame, name: str) -> str:
    """Why the strategy `name` does better or not than what all are compared with, in one sentence for everybody, none
    of that itself; other arguments as of `at`."""
    shown = statistics.compared_with(rows)
    if name == shown:
        return ""
    before, after = (
        _runs(folder, one, [int(seed) for seed in rows.loc[rows["controller"] == one, "seed"]]) for one in (shown, name)
    )
    found, then = load(network, *before), load(network, after[0], ())
    done = deeds(network, *after, metered=_metered(folder, name))
    gained = (
        statistics.paired(statistics.by_seed(rows, level, name), statistics.by_seed(rows, level, shown)).percent < 0
    )
    region = int(np.argmax(found.beyond))
    if not gained or not len(found.critical) or then.beyond[region] >= found.beyond[region]:
        leaking = float(rows.loc[rows["controller"] == shown, "leaking_share"].mean())
        return f"{name} {verdict(rows, level, name, found, leaking, done, network)}."
    acts = [
        text
        for text, there in (
            ("signals at the boundaries held vehicles back", done.held >= HARDLY),
            ("drivers were guided to other routes", done.guided > 0),
            ("trips waited outside for room", done.waited >= A_WAIT),
        )
        if there and parse(name).controller.name != ALONE
    ]
    means = f", because {' and '.join(acts)}" if acts else ""
    first = statistics.than(shown)
    return (
        f"{first[0].upper()}{first[1:]}, the region {network.region_names[region]} held more vehicles than it serves "
        f"best with for {_share(found.beyond[region])} of the time, up to {found.most[region]:.1f} times as many, and "
        f"served fewer of them; with {name} for {_share(then.beyond[region])}, up to {then.most[region]:.1f} times as "
        f"many{means}."
    )


def _runs(folder: Path, name: str, seeds: Sequence[int]) -> tuple[list[Result], Iterable[Mapping]]:
    """Trajectories and records of one controller."""
    return (
        [run_folder.read_trajectory(run_folder.run_path(folder, name, seed)) for seed in seeds],
        (experiment.read_run(folder, name, seed) for seed in seeds),
    )


def verdict(
    rows: pd.DataFrame,
    level: float,
    name: str,
    found: Loading,
    leaking: float,
    done: ControlActivity,
    network: RegionalModel,
) -> str:
    """What a controller came to against no control or the first one, and why, in one line that begins behind its name.
    rows: of this demand level; leaking: share of the flow over the boundaries that passes no signal under control."""
    against = statistics.compared_with(rows)
    if name == against and rows["controller"].nunique() > 1:
        return f"is what the others are compared with, for {REFERENCE} was not run; {done}"
    against = REFERENCE if name == against else against
    pair = statistics.paired(statistics.by_seed(rows, level, name), statistics.by_seed(rows, level, against))
    if not pair.seeds:
        return f"has no common seed with {against}, so that nothing can be said: add it to --controllers"
    if np.isnan(pair.percent):
        return "is not told in percent: nobody spent any time with what it is compared with"
    spread = f"± {pair.percent_half:.1f} over {pair.seeds} seeds" if pair.seeds > 1 else "on one seed, no proof"
    other = "" if against == REFERENCE else f" against {against}"
    size = f"{pair.percent:+.1f} % in total time spent{other} {spread}"
    unmodelled = parse(name).controller.name == ALONE
    if pair.percent < 0 and (pair.excludes_zero or pair.seeds == 1):
        return f"gains ({size})" + ("" if unmodelled else f"; {done}")
    kind = "loses" if pair.excludes_zero or pair.seeds == 1 else "gains nothing that stands out from the seeds"
    if pair.percent == 0.0:
        kind = "changes nothing"
    reasons = [] if unmodelled else _reasons(rows, name, against, found, leaking, done, network)
    reasons += signal_reasons.reasons(rows[rows["controller"] == name])
    return f"{kind} ({size})" + (f": {'; '.join(reasons)}" if reasons else "")


def _reasons(
    rows: pd.DataFrame,
    name: str,
    against: str,
    found: Loading,
    leaking: float,
    done: ControlActivity,
    network: RegionalModel,
) -> list[str]:
    """Why perimeter control, or guidance, gains nothing."""
    reasons = []
    if leaking > NO_AUTHORITY:
        reasons.append(
            f"no control authority at the boundaries, {_share(leaking)} of the flow over them passes no "
            "signal under control"
        )
    if not len(found.critical):
        reasons.append("no region is ever critical, so that there is nothing to protect")
    elif done.held >= HARDLY and all(found.inside[r] > MOSTLY_INSIDE for r in found.critical):
        reasons.append(
            f"most of what fills {_list(network, found.critical)} starts there, where no gateway holds it back"
        )
    full = rows.groupby("controller")["gateway_full_share"].mean()
    if done.held >= HARDLY and full.get(name, 0.0) - full.get(against, 0.0) > MORE_FULL:
        reasons.append(
            f"its queues fill the streets before the gateways ({_share(full[name])} of the time, "
            f"{_share(full[against])} {statistics.than(against)}) and block others"
        )
    return [*reasons, str(done)]


def _city(network: RegionalModel, found: Loading, leaking: float, shown: str) -> str:
    """The city without control, in two sentences."""
    when = "Without control" if shown == REFERENCE else f"Under {shown}"
    hot = [
        f"{_list(network, [r])} ({_share(found.beyond[r])} of the time, most {found.most[r]:.1f} times it)"
        for r in found.critical
    ]
    highest = int(np.argmax(found.most))
    state = (
        f"beyond their critical accumulation were {', '.join(hot)}"
        if hot
        else (
            f"no region went beyond its critical accumulation; {_list(network, [highest])} came nearest, with "
            f"{found.most[highest]:.1f} times it"
        )
    )
    return f"Signals under control see {_share(1.0 - leaking)} of the flow over the boundaries. {when} {state}."


def _list(network: RegionalModel, regions: Sequence[int]) -> str:
    return ", ".join(f"{r} {network.region_names[r]}" for r in regions)


def _share(value: float) -> str:
    return "an unknown share" if np.isnan(value) else f"{100.0 * value:.0f} %"
