"""The pictures of an evaluation: which runs are shown, and the files they go to."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.evaluation import experiment, model_validation, statistics
from cosim.report import figures
from cosim.sumo.net import City, city_of
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import run_folder
from nmfd.studies import plots
from nmfd.studies.benchmark import draw_accumulations
from nmfd.types import Result

PANELS = 11  # boundaries, or pairs of region and destination, that are shown one by one
FEW = 5  # trips of one region; so many wait at any time for a gap in traffic
NAMED = 2  # controllers with the most teleports in a title
WINDOW = 3  # control intervals over which realised shares are taken
DRAWN = (  # what pictures of gateways and guidance need of a record
    "gateway_flow",
    "gateway_green",
    "gateway_original_green",
    "crossings",
    "guided",
)


def draw(folder: Path, scenario: Scenario, city: City | None, rows: pd.DataFrame, out: Path | None = None) -> None:
    """All pictures of one demand level into `out`, or into its run folder; `rows` of this level, as in statistics.

    Those of gateways and guidance need the `city`, and records that hold DRAWN.
    """
    out = folder if out is None else out
    seed = shown_seed(rows)
    order = list(dict.fromkeys(rows["controller"]))
    runs = sorted(
        (t for t in run_folder.trajectories(folder) if t.controller in order),
        key=lambda t: (order.index(t.controller), t.seed),
    )
    note = teleports(rows)
    shaded = ", shaded: all seeds" if rows["seed"].nunique() > 1 else ""
    draw_accumulations(
        out,
        scenario,
        runs,
        seed=seed,
        title=f"seed {seed}{shaded}; {note}",
        outflow=experiment.measured_outflow(folder),
    )
    if city is None:
        return
    results = [
        run for run in recorded(folder, rows, seed).values() if set(DRAWN) <= set(run.data.data_vars)
    ]  # best first
    if gating := next((run for run in results if acts(run, scenario.network)), None):
        perimeter(out / "perimeter.png", city, scenario.network, gating, note)
    if guiding := next((run for run in results if run["guided"].sum() > 0), None):
        splits(out / "splits.png", scenario.network, guiding, note)
    if telling := next((run for run in results if run.prices.any()), None):
        prices(out / "prices.png", scenario.network, telling, note)


def recorded(folder: Path, rows: pd.DataFrame, seed: int) -> dict[str, Result]:
    """The runs of this seed, the best controller first."""
    there = set(rows.loc[rows["seed"] == seed, "controller"])
    return {name: experiment.read_run(folder, name, seed) for name in ranked(rows) if name in there}


def acts(result: Result, network: RegionalModel) -> bool:
    """Whether a gateway was ever commanded to less than its original programme."""
    return bool((result.perimeter[:, network.adjacency] < network.u_max - 1e-9).any())


def ranked(rows: pd.DataFrame) -> list[str]:
    """Controllers of one demand level, the best first: by mean change against what all are compared with, else by mean
    TTS."""
    level = rows["demand"].iloc[0]
    reference = statistics.by_seed(rows, level, statistics.compared_with(rows))
    score = {}
    for name in dict.fromkeys(rows["controller"]):
        values = statistics.by_seed(rows, level, name)
        pair = statistics.paired(values, reference)
        score[name] = float(np.mean(list(values.values()))) if np.isnan(pair.percent) else pair.percent
    return sorted(score, key=score.__getitem__)


def shown_seed(rows: pd.DataFrame) -> int:
    """The first seed that most controllers have."""
    counts = rows["seed"].value_counts().sort_index()
    return int(counts.idxmax())


def teleports(rows: pd.DataFrame) -> str:
    """How many vehicles were teleported in the runs behind a picture; the controllers with the most by name, so that
    it fits into a title."""
    counts = rows.groupby("controller", sort=False)["teleports"].sum()
    counts = counts[counts > 0].sort_values(ascending=False, kind="stable")
    if counts.empty:
        return "no teleport in any run"
    named = [f"{name} {count:.0f}" for name, count in counts.iloc[:NAMED].items()]
    return "teleports: " + ", ".join(named + ["others fewer"] * (len(counts) > NAMED))


def perimeter(path: Path, city: City, network: RegionalModel, result: Result, note: str) -> None:
    """Commanded u against green and flow: the boundaries that were closed most over time, and all in one cloud; no
    picture of a city without a signal under control."""
    trajectory, record = result, result
    pairs = {}
    for pair in map(tuple, np.argwhere(network.adjacency)):
        members = [
            n
            for n, g in enumerate(city.gateways)
            if (g.source, g.target) == pair and not np.isnan(record["gateway_original_green"][0, n])
        ]
        original = record["gateway_original_green"][:, members] * [len(city.gateways[n].links) for n in members]
        shown = record["gateway_green"][:, members] * [len(city.gateways[n].links) for n in members]
        if members and original.sum() > 0:
            flow = record["gateway_flow"][:, members].sum(axis=1) / (figures.SATURATION * original.sum(axis=1))
            pairs[pair] = trajectory.perimeter[:, *pair], shown.sum(axis=1) / original.sum(axis=1), flow
    if not pairs:
        return
    closed = [pair for pair in pairs if pairs[pair][0].min() < network.u_max - 1e-9]
    chosen = sorted(sorted(closed, key=lambda pair: pairs[pair][0].mean())[:PANELS])
    drawing, axes = plots.panels(len(chosen) + 1)
    for ax, pair in zip(axes, chosen, strict=False):
        figures.perimeter(ax, trajectory.step, *pairs[pair])
        ax.set_title(f"{pair[0]} > {pair[1]}", fontsize="medium")
    figures.green_against_command(
        axes[-1],
        np.concatenate([u for u, _, _ in pairs.values()]),
        np.concatenate([green for _, green, _ in pairs.values()]),
    )
    axes[-1].set_title("all boundaries", fontsize="medium")
    drawing.suptitle(f"{trajectory.controller}, seed {trajectory.seed}; {note}", fontsize="medium")
    plots.legend_below(drawing, axes)
    plots.save(drawing, path)


def splits(path: Path, network: RegionalModel, result: Result, note: str) -> None:
    """Commanded theta against the shares that went there: the busiest choices over time, and all in one cloud; no
    picture where there is nothing to choose, as with two regions."""
    trajectory, crossings = result, result["crossings"].astype(float)
    leaving = crossings.sum(axis=2)  # (T, R, R), from i bound for j
    choices = [
        (i, j)
        for i, j in np.ndindex(network.adjacency.shape)
        if i != j and network.split_mask[i, :, j].sum() > 1 and leaving[:, i, j].sum() > 0
    ]
    if not choices:
        return
    totals = []
    for i, j in choices:
        neighbours = np.flatnonzero(network.split_mask[i, :, j])
        weight = leaving[:, i, j][:, None]
        commanded = (trajectory.splits[:, i, neighbours, j] * weight).sum(axis=0) / weight.sum()
        realised = crossings[:, i, neighbours, j].sum(axis=0) / weight.sum()
        totals.append(np.stack([commanded, realised, np.full(len(neighbours), weight.sum())]))
    shown = sorted(sorted(choices, key=lambda pair: -leaving[:, *pair].sum())[:PANELS])
    drawing, axes = plots.panels(len(shown) + 1)
    for ax, (i, j) in zip(axes, shown, strict=False):
        neighbours = np.flatnonzero(network.split_mask[i, :, j])
        moved = _moving_sum(crossings[:, i, neighbours, j])
        every = moved.sum(axis=1, keepdims=True)
        figures.splits(
            ax,
            trajectory.step,
            trajectory.splits[:, i, neighbours, j],
            np.where(every > 0, moved / np.maximum(every, 1.0), np.nan),
            neighbours,
        )
        ax.set_title(f"in {i}, bound for {j}", fontsize="medium")
    figures.split_totals(axes[-1], *np.concatenate(totals, axis=1))
    axes[-1].set_title("all", fontsize="medium")
    drawing.suptitle(
        f"{trajectory.controller}, seed {trajectory.seed}: commanded θ (lines), shares that went there (dots, over "
        f"{WINDOW} intervals); {note}",
        fontsize="medium",
    )
    plots.legend_below(drawing, axes, columns=8)
    plots.save(drawing, path)


def prices(path: Path, network: RegionalModel, trajectory: Result, note: str) -> None:
    """By how much longer ways through each region were told, and the trips that waited to begin there, over time."""
    told, waiting = 100.0 * trajectory.prices, trajectory.backlog[1:].sum(axis=2)
    shown = [np.flatnonzero(told.max(axis=0) > 0.0).tolist(), np.flatnonzero(waiting.max(axis=0) > FEW).tolist()]
    drawing, axes = plots.panels(2)
    figures.by_region(axes[0], trajectory.step, told, shown[0], network, "told longer by [%]")
    axes[0].set_title("ways through", fontsize="medium")
    figures.by_region(axes[1], trajectory.step, waiting, shown[1], network, "trips that wait [veh]")
    axes[1].set_title("trips that begin in", fontsize="medium")
    drawing.suptitle(f"{trajectory.controller}, seed {trajectory.seed}; {note}", fontsize="medium")
    plots.legend_below(drawing, axes)
    plots.save(drawing, path)


def _moving_sum(values: np.ndarray) -> np.ndarray:
    """(T, H): sums over WINDOW rows around each."""
    kernel = np.ones(min(WINDOW, len(values)))  # a longer one would make more rows
    return np.stack([np.convolve(column, kernel, mode="same") for column in values.T], axis=1)


def demand_levels(path: Path, rows: pd.DataFrame) -> None:
    """TTS over the demand levels, against that of no control or of the first controller."""
    against = statistics.compared_with(rows)
    ratios: dict[str, dict[float, tuple[float, float]]] = {}
    for level, names in statistics.groups(rows).items():
        for name in names:
            pair = statistics.paired(statistics.by_seed(rows, level, name), statistics.by_seed(rows, level, against))
            if name != against and not np.isnan(pair.percent):
                ratios.setdefault(name, {})[level] = 1.0 + pair.percent / 100.0, pair.percent_half / 100.0
    if not ratios:
        return
    drawing = plots.figure(7.5, 4.8)
    ax = figures.over_demand(drawing.subplots(), ratios, against)
    drawing.suptitle(f"paired by seed, 95 % intervals; {teleports(rows)}", fontsize="medium")
    plots.legend_below(drawing, [ax])
    plots.save(drawing, path)


def draw_all(out: Path, folders: Mapping[float, Path], scenario: Scenario, rows: pd.DataFrame) -> None:
    """The pictures of every demand level in its folder, and those across levels in `out`."""
    city = city_of(scenario.network)
    for level, folder in folders.items():
        draw(folder, scenario, city, rows[rows["demand"] == level])
    if len(folders) > 1:
        demand_levels(out / "demand.png", rows)


def draw_more(out: Path, scenario: Scenario, folder: Path, rows: pd.DataFrame) -> None:
    """Beside `draw`, for a page, the MFDs of one demand level; arguments as there."""
    results = recorded(folder, rows, shown_seed(rows))
    against = statistics.compared_with(rows)
    best = next((name for name in results if name != against), None)
    outflows(out / "mfd.png", scenario.network, {name: results[name] for name in (against, best) if name in results})


def outflows(path: Path, network: RegionalModel, results: dict[str, Result]) -> None:
    """The MFD of every region: of the regional model as a curve, in these runs as dots."""
    samples = []
    for region in range(network.regions):
        clouds = {
            name: model_validation.outflow_samples([result], [result], network.u_max, region, network.adjacency)
            for name, result in results.items()
        }
        samples.append({name: np.concatenate(list(parts.values())) for name, parts in clouds.items()})
    plots.draw_mfds(path, network, samples)
