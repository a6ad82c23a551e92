"""Figures: every function draws into the `ax` it is given and returns it. Nothing is simulated here.

`figure`, `panels` and `save` make files without pyplot, and so without a display or global state.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator, MultipleLocator, StrMethodFormatter

from nmfd.arrays import Adjacency
from nmfd.model.mfd import Mfd
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs.files import atomic
from nmfd.studies.traffic_states import LOOKS, OutflowOf, draw_strips, states
from nmfd.types import Result

# Colours that stay apart for colour-blind readers and on coloured zones.
CONTROLLER_COLOURS = {
    "no-control": "#333333",
    "pi-gating": "#e69f00",
    "mpc-pc": "#56b4e9",
    "mpc-pcrg": "#0059a8",
    "dpc-pc": "#e377c2",
    "dpc-pcrg": "#882255",
    "route-guidance": "#8c6d31",
    "probing-pc": "#bcbd22",
    "probing-pcrg": "#637939",
    "bound-pc": "#9aa33c",
    "bound-pcrg": "#4d6600",
    "greedy": "#2e8b57",
    "mpc-pc-terminal": "#7fd1c7",
    "mpc-pcrg-terminal": "#00695c",
}
CITY_COLOURS = {  # what a city may do without a regional controller
    "webster": "#00838f",
    "actuated": "#7e57c2",
    "max-pressure": "#009e73",
    "rerouting-30": "#7f7f7f",
    "rerouting-100": "#b5a642",
}
OTHER_COLOURS = ("#17becf", "#5254a3", "#843c39", "#66c2a5", "#bc80bd", "#1b5e20", "#fb8072", "#556b2f")
PLANT_LABELS = {"nmfd": "regional model", "acyclic": "acyclic model", "sumo": "SUMO", "estimate": "estimate"}
LINE_STYLES = ("-", "--", ":", "-.")
GREEN, RED = "#2ca02c", "#d62728"
ZONES = (  # of a curve without samples: label, colour, opacity
    ("within 10 % of the curve's maximum", GREEN, 0.22),
    ("less outflow, up to the jam accumulation", RED, 0.13),
    ("beyond the jam accumulation", RED, 0.30),
)
CRITICAL, UNSEEN = "critical accumulation of the model", "beyond all samples: a guess"
LAST = (CRITICAL, UNSEEN, *(look[0] for look in LOOKS.values()), *(zone[0] for zone in ZONES))  # in legends


def colour(controller: str) -> str:
    """The colour of a controller, the same in every figure; unknown names get one of OTHER_COLOURS by their hash."""
    other = OTHER_COLOURS[zlib.crc32(controller.encode()) % len(OTHER_COLOURS)]
    return (CONTROLLER_COLOURS | CITY_COLOURS).get(controller, other)


def colours(controllers: Sequence[str]) -> dict[str, str]:
    """The colour of each of `controllers`; unknown names get different ones of OTHER_COLOURS while there are any."""
    known = CONTROLLER_COLOURS | CITY_COLOURS
    unknown = [name for name in dict.fromkeys(controllers) if name not in known]
    others = OTHER_COLOURS * (1 + len(unknown) // len(OTHER_COLOURS))
    return {**known, **dict(zip(unknown, others, strict=False))}


def figure(width: float, height: float) -> Figure:
    """An empty figure [inch] that keeps its parts from overlapping."""
    drawing = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(drawing)
    return drawing


def save(drawing: Figure, path: Path) -> Path:
    """Write `drawing` to `path`, whole or not at all; the suffix chooses the format."""
    with atomic(path) as temporary:
        drawing.savefig(temporary, dpi=150)
    return path


def panels(count: int) -> tuple[Figure, list[Axes]]:
    """A figure with `count` axes, at most four in a row."""
    columns = min(4, count)
    rows = -(-count // columns)
    drawing = figure(6.8 if count == 1 else 3.3 * columns, 1.0 + (3.6 if count == 1 else 2.7 * rows))
    grid = np.ravel(drawing.subplots(rows, columns))
    for ax in grid[count:]:
        ax.remove()
    return drawing, list(grid[:count])


def legend_below(drawing: Figure, axes: Sequence[Axes], columns: int = 4) -> None:
    """One legend for all `axes`, below them, in as many `columns` as fit; every label once, LAST last."""
    entries = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    entries |= {label: entries.pop(label) for label in LAST if label in entries}
    for number in range(min(columns, len(entries)), 0, -1):
        legend = drawing.legend(
            entries.values(), entries.keys(), loc="outside lower center", ncols=number, frameon=False
        )
        if number == 1 or legend.get_window_extent(drawing.canvas.get_renderer()).width <= drawing.bbox.width:
            return
        legend.remove()


def optimal_band(mfd: Mfd) -> tuple[float, float]:
    """The accumulations [veh] between which the outflow is within 10 % of its maximum."""
    grid = np.linspace(0.0, mfd.jam if np.isfinite(mfd.jam) else 2.0 * mfd.critical, 20001)
    inside = grid[mfd.outflow(grid) >= 0.9 * mfd.capacity]
    return float(inside[0]), float(inside[-1])


def total_accumulation(ax: Axes, trajectories: Sequence[Result], seed: int | None = None) -> Axes:
    """Vehicles in the network, with those that wait to enter, over time. seed: shown instead of the mean over seeds."""
    _curves(ax, trajectories, lambda t: t.accumulation.sum(axis=(1, 2)) + t.backlog.sum(axis=(1, 2)), seed)
    ax.set_ylabel("vehicles in the network [veh]")
    ax.set_ylim(bottom=0.0)
    return ax


def region_accumulation(
    ax: Axes,
    network: RegionalModel,
    region: int,
    trajectories: Sequence[Result],
    seed: int | None = None,
    outflow: OutflowOf | None = None,
) -> Axes:
    """Accumulation of one region over time, and the critical one of the model; above, a strip per curve in the colours
    of the states that the region was in (traffic_states).

    seed: shown instead of the mean over seeds; the strips show it or, without one, the first seed. outflow: what left
    every region of a run (T, R) [veh/s], of which the states are told; None, or where it gives None: no strip.
    Trajectories of several plants, such as the microsimulation and the regional model, share the controller's colour
    and differ in line style; the marks of strips are hollow for all but the first plant.
    """
    mfd = network.mfds[region]
    highest = max((t.accumulation[:, region].sum(axis=1).max() for t in trajectories), default=0.0)
    ax.hlines(
        mfd.critical,
        0.0,
        1.0,
        transform=ax.get_yaxis_transform(),
        color="0.35",
        linewidth=1.0,
        linestyle=":",
        label=CRITICAL,
        zorder=1,
    )
    _curves(ax, trajectories, lambda t: t.accumulation[:, region].sum(axis=1), seed)
    left = _strips(ax, mfd, region, trajectories, seed, outflow)
    ax.set_ylabel("accumulation [veh]")
    top = 1.06 * max(highest, 1.25 * mfd.critical)
    ax.set_ylim(0.0, top / left)
    ax.set_yticks([tick for tick in ax.get_yticks() if 0.0 <= tick <= top])  # none beside the strips
    ax.set_title(region_title(network, region), fontsize="medium")
    return ax


def _strips(
    ax: Axes, mfd: Mfd, region: int, trajectories: Sequence[Result], seed: int | None, outflow: OutflowOf | None
) -> float:
    """The strips of a region; returns the share of `ax` below them."""
    chosen: dict[tuple[str, str], Result] = {}
    for t in sorted(trajectories, key=lambda t: t.seed != seed):  # stable: the first where none has the seed
        chosen.setdefault((t.controller, t.plant), t)
    known = {key: out for key, t in chosen.items() if (out := outflow(t) if outflow else None) is not None}
    shown = [chosen[key] for key in known]
    if not shown:
        return 1.0
    found = states(
        mfd,
        shown[0].step,
        [t.accumulation[:, region].sum(axis=1) for t in shown],
        [out[:, region] for out in known.values()],
    )
    tones = colours([t.controller for t in trajectories])
    time = [time_axis(ax, t.step * np.arange(len(t.accumulation))) for t in shown]
    return draw_strips(
        ax, time, found, [tones[t.controller] for t in shown], [t.plant != trajectories[0].plant for t in shown]
    )


def region_estimate(
    ax: Axes, network: RegionalModel, region: int, trajectory: Result, outflow: OutflowOf | None = None
) -> Axes:
    """Accumulation of one region over time, and the estimate of it that the controller saw."""
    estimate = replace(trajectory, accumulation=trajectory.observed, plant="estimate")
    return region_accumulation(
        ax,
        network,
        region,
        [trajectory, estimate],
        outflow=lambda t: None if outflow is None or t.plant == "estimate" else outflow(t),
    )


def mfd(ax: Axes, mfd: Mfd, samples: Mapping[str, np.ndarray] | None = None) -> Axes:
    """Outflow against accumulation. Without samples, the curve's own zones; with some, what they do not reach.

    samples: label -> (n, 2) of accumulation [veh] and outflow [veh/s], such as {"loading": ..., "unloading": ...}, or
        by controller
    """
    clouds = {label: np.asarray(cloud) for label, cloud in (samples or {}).items() if len(cloud)}
    jam = mfd.jam if np.isfinite(mfd.jam) else 2.0 * mfd.critical
    # Up to the jam and a little of the tail; with samples, only as far as they tell something.
    right = 1.15 * jam
    if clouds:
        right = min(right, max([1.25 * optimal_band(mfd)[1], *(1.1 * cloud[:, 0].max() for cloud in clouds.values())]))
    if clouds:  # which tell what flows themselves
        seen = max(cloud[:, 0].max() for cloud in clouds.values())
        ax.axvspan(seen, max(right, seen), facecolor="none", edgecolor="0.75", hatch="///", linewidth=0, label=UNSEEN)
        ax.vlines(
            mfd.critical,
            0.0,
            1.0,
            transform=ax.get_xaxis_transform(),
            color="0.35",
            linewidth=1.0,
            linestyle=":",
            label=CRITICAL,
            zorder=1,
        )
    else:
        _zones(ax, mfd, right)
    for (label, cloud), tone in zip(clouds.items(), _tones(len(clouds)), strict=True):
        tone = (CONTROLLER_COLOURS | CITY_COLOURS).get(label, tone)
        ax.scatter(cloud[:, 0], cloud[:, 1], s=7, color=tone, alpha=0.6, linewidths=0, label=label)
    grid = np.linspace(0.0, right, 1001)
    ax.plot(grid, mfd.outflow(grid), color="black", linewidth=1.8, label="MFD")
    ax.plot([mfd.critical], [mfd.capacity], "o", color="black", markersize=4)
    if not clouds:
        ax.annotate(
            f"{mfd.critical:,.0f} veh, {mfd.capacity:.3g} veh/s",
            (mfd.critical, mfd.capacity),
            xytext=(0, 6),
            textcoords="offset points",
            ha="center",
            fontsize="small",
        )
    ax.set_xlim(0.0, right)
    ax.set_ylim(0.0, 1.12 * max([mfd.capacity, *(cloud[:, 1].max() for cloud in clouds.values())]))
    ax.set_xlabel("accumulation [veh]")
    ax.set_ylabel("outflow [veh/s]")
    ax.xaxis.set_major_locator(MaxNLocator(5))
    _thousands(ax.xaxis)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def draw_mfds(path: Path, network: RegionalModel, samples: Sequence[Mapping[str, np.ndarray]]) -> None:
    """Draw the MFD of each region over its outflow samples, as one file."""
    drawing, axes = panels(network.regions)
    for region, ax in enumerate(axes):
        mfd(ax, network.mfds[region], samples[region])
        ax.set_title(region_title(network, region), fontsize="medium")
    legend_below(drawing, axes)
    save(drawing, path)


def improvement(ax: Axes, gains: Mapping[str, Mapping[float, tuple[float, float]]]) -> Axes:
    """Improvement over no control [%] against sigma of the demand noise [veh/s], with 95 % intervals.

    gains: controller -> sigma -> mean and half interval (nmfd.studies.robustness.improvements)
    """
    ax.axhline(0.0, color=CONTROLLER_COLOURS["no-control"], linewidth=1.0)
    for number, (controller, points) in enumerate(gains.items()):
        mean, half = np.array(list(points.values())).reshape(-1, 2).T
        ax.errorbar(
            list(points),
            mean,
            np.nan_to_num(half),
            color=colour(controller),
            linewidth=1.6,
            capsize=3,
            marker="o^sDv"[number % 5],
            markersize=4,
            label=controller,
        )
    ax.set_ylabel("total time spent saved\nagainst no-control [%]")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def trips(ax: Axes, counts: Mapping[float, float]) -> Axes:
    """Vehicles of the whole scenario against sigma of the demand noise [veh/s]."""
    ax.plot(list(counts), list(counts.values()), color=CONTROLLER_COLOURS["no-control"], marker="o", markersize=4)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel("standard deviation of the noise on the demand [veh/s]")
    ax.set_ylabel("trips [veh]")
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def region_map(ax: Axes, network: RegionalModel) -> Axes:
    """Regions as discs at their positions, with the boundaries that vehicles may cross."""
    positions = network.positions
    apart = [np.linalg.norm(positions[i] - positions[h]) for i, h in _pairs(network.adjacency)]
    spacing = min(apart, default=1.0) or 1.0
    for i, h in _pairs(network.adjacency):
        ax.plot(*positions[[i, h]].T, color="#888888", linewidth=1.4, zorder=1)
    for region, (x, y) in enumerate(positions):
        ax.add_patch(Circle((x, y), 0.31 * spacing, facecolor="#dbe9f6", edgecolor="#30506f", linewidth=1.2, zorder=2))
        name = network.region_names[region]
        if name == str(region):
            ax.text(x, y, name, ha="center", va="center", fontweight="bold")
        else:
            ax.text(x, y + 0.06 * spacing, str(region), ha="center", va="center", fontweight="bold")
            ax.text(x, y - 0.12 * spacing, name, ha="center", va="center", fontsize="x-small")
    margin = 0.45 * spacing
    ax.set_xlim(positions[:, 0].min() - margin, positions[:, 0].max() + margin)
    ax.set_ylim(positions[:, 1].min() - margin, positions[:, 1].max() + margin)
    ax.set_aspect("equal")
    ax.set_axis_off()
    return ax


def spawn_matrix(ax: Axes, scenario: Scenario) -> Axes:
    """Demand of the whole scenario per pair of regions [veh], origins down and destinations across."""
    trips = scenario.step * scenario.demand.sum(axis=0)
    regions = scenario.network.regions
    image = ax.imshow(np.where(trips > 0, trips, np.nan), cmap="Blues", vmin=0.0)
    for (i, j), value in np.ndenumerate(trips):
        if value > 0 and regions <= 12:
            ax.text(
                j,
                i,
                f"{value:,.0f}",
                ha="center",
                va="center",
                fontsize="x-small",
                color="white" if value > 0.5 * trips.max() else "black",
            )
    ax.set_xticks(range(regions))
    ax.set_yticks(range(regions))
    ax.set_xticks(np.arange(regions - 1) + 0.5, minor=True)
    ax.set_yticks(np.arange(regions - 1) + 0.5, minor=True)
    ax.grid(which="minor", color="#dddddd", linewidth=0.6)
    ax.tick_params(which="minor", length=0)
    ax.set_xlabel("destination region")
    ax.set_ylabel("origin region")
    bar = ax.figure.colorbar(image, ax=ax, shrink=0.85)
    bar.set_label("trips [veh]")
    _thousands(bar.ax.yaxis)
    return ax


def demand(ax: Axes, scenario: Scenario) -> Axes:
    """Demand over time [veh/s], stacked by destination region."""
    arriving = scenario.demand.sum(axis=1).T
    used = np.flatnonzero(arriving.sum(axis=1) > 0)
    steps = np.flatnonzero(arriving.sum(axis=0) > 0)
    end = min(scenario.steps, 1 + steps[-1] + max(1, scenario.steps // 20)) if len(steps) else scenario.steps
    time = time_axis(ax, scenario.step * np.arange(end + 1))
    if len(used):
        rates = np.concatenate([arriving[used, :end], arriving[used, end - 1 : end]], axis=1)
        ax.stackplot(
            time,
            rates,
            step="post",
            labels=[f"to {region_title(scenario.network, j)}" for j in used],
            colors=_tones(len(used)),
            linewidth=0,
        )
    ax.set_ylabel("demand [veh/s]")
    ax.set_ylim(bottom=0.0)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def _curves(
    ax: Axes, trajectories: Sequence[Result], quantity: Callable[[Result], np.ndarray], seed: int | None = None
) -> None:
    """One curve per controller and plant: the mean over its seeds, or one `seed`, and their range as a shade."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for trajectory in trajectories:
        groups.setdefault((trajectory.controller, trajectory.plant), []).append(trajectory)
    plants = list(dict.fromkeys(plant for _, plant in groups))
    tones = colours([controller for controller, _ in groups])
    for (controller, plant), members in groups.items():
        values = np.stack([quantity(member) for member in members])
        time = time_axis(ax, members[0].step * np.arange(values.shape[1]))
        # With a single controller in two plants, as in a comparison of models, the plant is all that matters.
        parts = [controller] * (len(groups) > len(plants) or len(plants) == 1)
        parts += [PLANT_LABELS.get(plant, plant)] * (len(plants) > 1)
        shown = [n for n, member in enumerate(members) if member.seed == seed]
        ax.plot(
            time,
            values[shown[0]] if shown else values.mean(axis=0),
            color=tones[controller],
            linewidth=1.6,
            label=", ".join(parts),
            linestyle=LINE_STYLES[plants.index(plant) % len(LINE_STYLES)],
        )
        if len(members) > 1:
            ax.fill_between(
                time,
                values.min(axis=0),
                values.max(axis=0),
                color=tones[controller],
                alpha=0.2 if len(groups) < 4 else 0.1,
                linewidth=0,
            )
    _thousands(ax.yaxis)
    ax.spines[["top", "right"]].set_visible(False)


def _zones(ax: Axes, mfd: Mfd, right: float) -> None:
    """Draw the ZONES between accumulation 0 and `right`."""
    limits = (*optimal_band(mfd), mfd.jam, max(right, mfd.jam))
    for (label, tone, opacity), begin, end in zip(ZONES, limits[:-1], limits[1:], strict=True):
        if begin < right:
            ax.axvspan(begin, min(end, right), color=tone, alpha=opacity, linewidth=0, label=label)


def time_axis(ax: Axes, seconds: np.ndarray) -> np.ndarray:
    """`seconds` in the unit of the time axis of `ax`: minutes up to four hours, then hours."""
    unit, name = (60.0, "min") if seconds[-1] <= 4 * 3600 else (3600.0, "h")
    ax.set_xlabel(f"time [{name}]")
    ax.set_xlim(0.0, seconds[-1] / unit)
    steps = (1, 2, 5, 10, 15, 30, 60) if name == "min" else (1, 2, 3, 6, 12, 24)
    ax.xaxis.set_major_locator(MultipleLocator(next((s for s in steps if seconds[-1] / unit / s <= 6), steps[-1])))
    return seconds / unit


def _thousands(axis: Axis) -> None:
    axis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))


def _tones(count: int) -> list:
    return [colormaps["tab10"](n % 10) for n in range(count)]


def _pairs(adjacency: Adjacency) -> Int[np.ndarray, "N 2"]:
    return np.argwhere(np.triu(adjacency | adjacency.T))


def region_title(network: RegionalModel, region: int) -> str:
    """Number and name, or the number alone where that is the name."""
    name = network.region_names[region]
    return f"region {region}" if name == str(region) else f"{region} {name}"
