"""Why a controller gained something against no control, or nothing: what the runs of an evaluation say about it.

Perimeter control can only gain where it controls the boundaries, where a region would go beyond its critical
accumulation without it, and if it holds vehicles back at all; even then it may cost more than it saves.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from cosim import experiment, tables
from cosim.strategy import parse
from nmfd import runs
from nmfd.benchmarks import REFERENCE
from nmfd.network import Network
from nmfd.types import Trajectory

NO_AUTHORITY = 0.5   # of the flow over the boundaries passes without a signal under control
HARDLY = 0.01        # of the commands, or of the time
MOSTLY_INSIDE = 0.5  # of what came into a region started there
MORE_FULL = 0.02     # of the edges before gateways and intervals


@dataclass(frozen=True, kw_only=True)
class Load:
    """Of R regions: most (R,), the highest accumulation over the critical one, mean over the runs; beyond (R,), the
    share of the time beyond it; inside (R,), the share of the vehicles there that had started there, NaN if unknown."""

    most: np.ndarray
    beyond: np.ndarray
    inside: np.ndarray

    @property
    def critical(self) -> np.ndarray:
        """The regions that were beyond their critical accumulation for more than a moment."""
        return np.flatnonzero(self.beyond > HARDLY)


def load(network: Network, trajectories: Sequence[Trajectory], records: Iterable[Mapping]) -> Load:
    """What some runs were like."""
    critical = np.array([mfd.critical for mfd in network.mfds])
    states = [trajectory.accumulation.sum(axis=2) / critical for trajectory in trajectories]
    started, came = np.zeros(network.regions), np.zeros(network.regions)
    for record in records:
        if {"departures", "crossings"} <= record.keys() and record["crossings"].ndim == 4:
            started += record["departures"].sum(axis=(0, 2))
            came += record["crossings"].sum(axis=(0, 1, 3))
    with np.errstate(invalid="ignore"):
        inside = started / (started + came)
    return Load(
        most=np.mean([state.max(axis=0) for state in states], axis=0),
        beyond=np.mean([(state > 1.0).mean(axis=0) for state in states], axis=0), inside=inside)


def held_back(network: Network, trajectories: Sequence[Trajectory]) -> float:
    """Share of the commands, one per boundary, direction and interval, that were below the upper bound by more than
    HARDLY of the range; NaN where there is no boundary."""
    limit = network.u_max - HARDLY * (network.u_max - network.u_min)
    return float(np.mean([(t.perimeter[:, network.adjacency] < limit).mean() for t in trajectories]))


def text(folders: Mapping[float, Path], network: Network, rows: pd.DataFrame) -> str:
    """Markdown, a section per demand level: what the city was like without control, and a line per controller.

    folders: demand level -> its run folder; rows: as in cosim.tables.
    """
    parts = []
    for level, folder in folders.items():
        part = rows[rows["demand"] == level]
        kept = {name: [int(seed) for seed in group["seed"]] for name, group in part.groupby("controller", sort=False)}
        shown = REFERENCE if REFERENCE in kept else next(iter(kept))
        found = load(network, _trajectories(folder, shown, kept[shown]),
                     (experiment.read_run(folder, shown, seed).record for seed in kept[shown]))
        leaking = float(part.loc[part["controller"] == shown, "leaking_share"].mean())
        lines = [f"## Why, at demand times {level:g}", _city(network, found, leaking, shown)]
        for name, seeds in kept.items():
            if name != REFERENCE:
                held = held_back(network, _trajectories(folder, name, seeds))
                lines.append(f"- {name}: {verdict(part, level, name, found, leaking, held, network)}")
        parts.append("\n".join([lines[0], "", lines[1], "", *lines[2:]]))
    return "\n\n".join(parts) + "\n"


def verdict(
    rows: pd.DataFrame, level: float, name: str, found: Load, leaking: float, held: float, network: Network,
) -> str:
    """One line: gained or not, and why. rows: of this demand level; held: `held_back` of this controller."""
    pair = tables.paired(tables.by_seed(rows, level, name), tables.by_seed(rows, level, REFERENCE))
    if not pair.seeds:
        return f"no common seed with {REFERENCE}, so that nothing can be said; add it to --controllers"
    size = f"{pair.percent:+.1f} % in total time spent"
    if pair.seeds > 1:
        size += f" ± {pair.percent_half:.1f}"
    if pair.excludes_zero and pair.percent < 0:
        return f"gains ({size}); it held back in {_share(held)} of its commands"
    if parse(name).model_free:
        return f"{size}; no regional controller"
    reasons = []
    if leaking > NO_AUTHORITY:
        reasons.append(
            f"no authority at the boundaries: {_share(leaking)} of the flow over them passes no signal under control")
    if not len(found.critical):
        reasons.append("no region is ever critical, so that there is nothing to protect")
    if held < HARDLY:
        reasons.append(f"it held back in {_share(held)} of its commands, so that the signals did what they do anyway")
    elif len(found.critical):
        inside = [r for r in found.critical if found.inside[r] > MOSTLY_INSIDE]
        if len(inside) == len(found.critical):
            reasons.append(f"most of what fills {_list(network, inside)} starts there, where no gateway holds it back")
        full = rows.groupby("controller")["gateway_full_share"].mean()
        if full.get(name, 0.0) - full.get(REFERENCE, 0.0) > MORE_FULL:
            reasons.append(
                f"its queues fill the streets before the gateways ({_share(full[name])} of the time, "
                f"{_share(full[REFERENCE])} without control) and block others")
        if not reasons:
            reasons.append(f"holding back in {_share(held)} of its commands delayed as much as it saved")
    elif held >= HARDLY:
        reasons.append(f"it held vehicles back all the same, in {_share(held)} of its commands")
    if pair.seeds == 1:
        reasons.append("one seed proves nothing: give more")
    elif not pair.excludes_zero:
        reasons.append("the difference is within the spread of the seeds")
    kind = "loses" if pair.excludes_zero else "no gain to be seen"
    return f"{kind} ({size}): {'; '.join(reasons)}"


def _city(network: Network, found: Load, leaking: float, shown: str) -> str:
    """The city without control, in two sentences."""
    when = "Without control" if shown == REFERENCE else f"Under {shown}"
    hot = [f"{_list(network, [r])} ({_share(found.beyond[r])} of the time, most {found.most[r]:.1f} times it)"
           for r in found.critical]
    highest = int(np.argmax(found.most))
    state = f"beyond their critical accumulation were {', '.join(hot)}" if hot else (
        f"no region went beyond its critical accumulation; {_list(network, [highest])} came nearest, with "
        f"{found.most[highest]:.1f} times it")
    return f"Signals under control see {_share(1.0 - leaking)} of the flow over the boundaries. {when} {state}."


def _trajectories(folder: Path, name: str, seeds: Sequence[int]) -> list[Trajectory]:
    return [runs.read_trajectory(folder / f"{name}-{seed}.npz") for seed in seeds]


def _list(network: Network, regions: Sequence[int]) -> str:
    return ", ".join(f"{r} {network.region_names[r]}" for r in regions)


def _share(value: float) -> str:
    return "an unknown share" if np.isnan(value) else f"{100.0 * value:.0f} %"
