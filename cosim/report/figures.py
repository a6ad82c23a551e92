"""Figures of an evaluation in SUMO: functions that draw into `ax`, and the files of one demand level."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cosim.evaluation import model_validation, statistics
from cosim.evaluation.results import Finished, Level
from cosim.sumo.arrays import Series
from cosim.sumo.net import City
from nmfd.model.regional_model import RegionalModel
from nmfd.studies import plots
from nmfd.studies.benchmark import draw_accumulations, interval
from nmfd.types import Result

Points = dict[str, dict[float, tuple[float, float]]]  # controller -> level -> mean and half of the interval

SATURATION_FLOW = 0.5  # veh/s and lane
COMMANDED, GREEN_SHOWN, FLOWED = "#333333", "#009e73", "#0059a8"
SHOWN_PANELS = 12  # boundaries, or pairs of region and destination, that are shown one by one
SHARE_WINDOW = 3  # control intervals over which realised shares are taken
MARKERS = "o^sDvPX"


def perimeter(ax: Axes, step: float, commanded: Series, green: Series, flow: Series) -> Axes:
    """Draw commanded u (T,) of one boundary, with green and flow (T,) as shares of the original programme."""
    time = plots.time_axis(ax, step * np.arange(len(commanded) + 1))
    for values, tone, label, width in (
        (flow, FLOWED, "flow / saturation flow of the original green", 1.2),
        (green, GREEN_SHOWN, "green shown / original green", 1.6),
        (commanded, COMMANDED, "commanded u", 1.6),
    ):
        ax.stairs(values, time, color=tone, linewidth=width, label=label, baseline=None)
    ax.set_ylim(0.0, max(1.08, 1.05 * float(np.nanmax([green, flow], initial=1.0))))
    return _finished(ax, "share [-]")


def splits(
    ax: Axes,
    step: float,
    commanded: Float[np.ndarray, "T H"],
    realised: Float[np.ndarray, "T H"],
    neighbours: Sequence[int],
) -> Axes:
    """Draw commanded (lines) and realised (dots) split ratios of one region and destination over time."""
    time = plots.time_axis(ax, step * np.arange(len(commanded) + 1))
    for n, h in enumerate(neighbours):
        tone = colormaps["tab10"](h % 10)
        ax.stairs(commanded[:, n], time, color=tone, linewidth=1.5, label=f"by {h}", baseline=None)
        ax.plot(time[:-1] + np.diff(time) / 2, realised[:, n], "o", color=tone, markersize=3)
    ax.set_ylim(-0.04, 1.04)
    return _finished(ax, "share [-]")


def over_levels(ax: Axes, values: Mapping[str, Mapping[float, tuple[float, float]]], label: str) -> Axes:
    """Draw a quantity over the demand level: controller -> level -> mean and half of its 95 % interval."""
    tones, levels = plots.colours([*values]), sorted({level for points in values.values() for level in points})
    for number, (controller, points) in enumerate(values.items()):
        mean, half = np.array([*points.values()]).T
        aside = 0.012 * max(levels[-1] - levels[0], 0.1) * (number - (len(values) - 1) / 2)  # intervals stay apart
        style = {"color": tones[controller], "marker": MARKERS[number % len(MARKERS)], "markersize": 4, "capsize": 3}
        ax.errorbar(np.array([*points]) + aside, mean, np.nan_to_num(half), label=controller, linewidth=1.6, **style)
    ax.axhline(1.0, color="#777777", linestyle="--", linewidth=1.0)
    ax.set_xticks(levels, [f"{level:g}" for level in levels])
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("demand, multiple of the scenario's")
    return _finished(ax, label)


def ranked(rows: pd.DataFrame) -> list[str]:
    """Return the controllers of one demand level, the best first: by paired change, else by mean time spent."""
    level = rows["demand"].iloc[0]
    reference = statistics.by_seed(rows, level, statistics.compared_with(rows))
    score = {}
    for name in dict.fromkeys(rows["controller"]):
        values = statistics.by_seed(rows, level, name)
        percent = statistics.paired(values, reference).percent
        score[name] = float(np.mean(list(values.values()))) if np.isnan(percent) else percent
    return sorted(score, key=score.__getitem__)


def draw_all(finished: Finished) -> None:
    """Draw the pictures of every demand level into its folder, and those of several levels beside them."""
    for level in finished.levels:
        draw_level(level.folder, finished, level)
    if len(finished.levels) > 1:
        draw_levels(finished.path, finished.rows)


def draw_level(out: Path, finished: Finished, level: Level) -> None:
    """Draw all pictures of one demand level into the folder `out`."""
    rows, network = level.rows, finished.scenario.network
    seed = int(rows["seed"].value_counts().sort_index().idxmax())  # the first one that most controllers have
    runs = level.results()
    title = f"seed {seed}{', shaded: all seeds' if rows['seed'].nunique() > 1 else ''}"
    draw_accumulations(out, finished.scenario, runs, seed=seed, title=title)
    best_first = {run.controller: run for run in runs if run.seed == seed}
    best_first = {name: best_first[name] for name in ranked(rows) if name in best_first}
    against = statistics.compared_with(rows)
    other = next((name for name in best_first if name != against), None)
    _draw_mfds(out / "mfd.png", network, [best_first[name] for name in (against, other) if name in best_first])
    closing = (run for run in best_first.values() if (run.perimeter[:, network.adjacency] < network.u_max - 1e-9).any())
    if gating := next(closing, None):
        _draw_perimeter(out / "perimeter.png", finished.map(), network, gating)
    if guiding := next((run for run in best_first.values() if run.guided.sum() > 0), None):
        _draw_splits(out / "splits.png", network, guiding)


def draw_levels(out: Path, rows: pd.DataFrame) -> None:
    """Draw trips served (the frontier) and time spent over several demand levels into the folder `out`."""
    against = statistics.compared_with(rows)
    ratios: Points = defaultdict(dict)
    shares: Points = defaultdict(dict)
    for level, names in statistics.groups(rows).items():
        reference = statistics.by_seed(rows, level, against)
        for name in names:
            part = rows[(rows["demand"] == level) & (rows["controller"] == name)]
            served = part["completed_veh"] / part["trips"].clip(lower=1)
            shares[name][level] = served.mean(), interval(list(served))
            pair = statistics.paired(statistics.by_seed(rows, level, name), reference)
            if name != against and not np.isnan(pair.percent):
                ratios[name][level] = 1.0 + pair.percent / 100.0, pair.percent_half / 100.0
    for file, values, label in (
        ("frontier.png", shares, "trips served / trips due [-]"),
        ("demand.png", ratios, f"total time spent / that of {against} [-]"),
    ):
        if values:
            drawing = plots.figure(7.5, 4.8)
            ax = over_levels(drawing.subplots(), values, label)
            _save(drawing, [ax], out / file, "mean over seeds, 95 % intervals")


def _draw_mfds(path: Path, network: RegionalModel, results: Sequence[Result]) -> None:
    clouds = [(run.controller, model_validation.outflow_samples(network, [run])) for run in results]
    samples = [{name: np.concatenate([*of[n].values()]) for name, of in clouds} for n in range(network.regions)]
    plots.draw_mfds(path, network, samples)


def _draw_perimeter(path: Path, city: City, network: RegionalModel, run: Result) -> None:
    """Draw the boundaries that were closed most over time."""
    gateways: dict[tuple[int, int], list[int]] = defaultdict(list)
    for n, gateway in enumerate(city.gateways):
        if not np.isnan(run.gateway_original_green[0, n]):
            gateways[gateway.source, gateway.target].append(n)
    pairs = {}
    for pair, members in sorted(gateways.items()):
        links = [len(city.gateways[n].links) for n in members]
        original, green = ((a[:, members] * links).sum(axis=1) for a in (run.gateway_original_green, run.gateway_green))
        if original.sum() > 0 and run.perimeter[:, *pair].min() < network.u_max - 1e-9:
            flow = run.gateway_flow[:, members].sum(axis=1) / (SATURATION_FLOW * original)
            pairs[pair] = run.perimeter[:, *pair], green / original, flow
    if not pairs:
        return
    shown = sorted(sorted(pairs, key=lambda pair: pairs[pair][0].mean())[:SHOWN_PANELS])
    drawing, axes = plots.panels(len(shown))
    for ax, pair in zip(axes, shown, strict=True):
        perimeter(ax, run.step, *pairs[pair]).set_title(f"{pair[0]} > {pair[1]}", fontsize="medium")
    _save(drawing, axes, path, f"{run.controller}, seed {run.seed}")


def _draw_splits(path: Path, network: RegionalModel, run: Result) -> None:
    """Draw the busiest choices between neighbours over time."""
    crossings = run.crossings.astype(float)
    leaving = crossings.sum(axis=2)  # (T, R, R), from i bound for j
    choices = [
        (i, j)
        for i, j in np.ndindex(network.adjacency.shape)
        if i != j and network.split_mask[i, :, j].sum() > 1 and leaving[:, i, j].sum() > 0
    ]
    if not choices:
        return
    shown = sorted(sorted(choices, key=lambda pair: -leaving[:, *pair].sum())[:SHOWN_PANELS])
    drawing, axes = plots.panels(len(shown))
    kernel = np.ones(min(SHARE_WINDOW, len(crossings)))
    for ax, (i, j) in zip(axes, shown, strict=True):
        neighbours = np.flatnonzero(network.split_mask[i, :, j])
        moved = np.stack([np.convolve(crossings[:, i, h, j], kernel, mode="same") for h in neighbours], axis=1)
        every = moved.sum(axis=1, keepdims=True)
        realised = np.where(every > 0, moved / np.maximum(every, 1.0), np.nan)
        splits(ax, run.step, run.splits[:, i, neighbours, j], realised, neighbours)
        ax.set_title(f"in {i}, bound for {j}", fontsize="medium")
    how = f"commanded θ (lines), shares over {SHARE_WINDOW} intervals (dots)"
    _save(drawing, axes, path, f"{run.controller}, seed {run.seed}: {how}")


def _save(drawing: Figure, axes: Sequence[Axes], path: Path, title: str) -> None:
    drawing.suptitle(title, fontsize="medium")
    plots.legend_below(drawing, axes)
    plots.save(drawing, path)


def _finished(ax: Axes, y: str) -> Axes:
    ax.set_ylabel(y)
    ax.spines[["top", "right"]].set_visible(False)
    return ax
