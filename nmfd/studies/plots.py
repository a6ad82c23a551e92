"""Figures of networks, scenarios and runs, without pyplot.

Each function draws into an `ax` and returns it.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, Tick
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator, MultipleLocator, StrMethodFormatter

from nmfd.model.mfd import Mfd
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import config
from nmfd.runs.files import atomic
from nmfd.types import Result

COLOURS = config.read(Path(__file__).with_name("colours.toml"))  # of controllers
OTHER_COLOURS = (
    "#17becf",
    "#5254a3",
    "#843c39",
    "#66c2a5",
    "#bc80bd",
    "#1b5e20",
    "#fb8072",
    "#556b2f",
)
PLANT_LABELS = {
    "nmfd": "regional model",
    "acyclic": "acyclic model",
    "links": "link model",
    "sumo": "SUMO",
    "estimate": "estimate",
}
LINE_STYLES = ("-", "--", ":", "-.")
MARKERS = "o^sDvPX"
CRITICAL = "critical accumulation of the model"
UNSEEN = "beyond all samples: a guess"
OUTFLOW = "outflow [veh/s]"
LAST = CRITICAL, UNSEEN  # labels at the end of legends
LONGEST_IN_MINUTES = 4 * 3600  # s; the axis of a longer time is in hours


class _Drawing(Figure):
    """Figure that shows names with `$` as they are, not as mathematics."""

    def draw(self, renderer: Any) -> None:
        of_ticks = set()  # those of a logarithmic axis are mathematics
        for tick in self.findobj(Tick):
            of_ticks |= {tick.label1, tick.label2}
        for text in self.findobj(Text):
            if text not in of_ticks:
                text.set_parse_math(False)
        super().draw(renderer)


def colours(controllers: Iterable[str]) -> dict[str, str]:
    """Return the colour of each controller.

    The colour follows from the name, so that a controller looks the same in every picture. Unknown
    names get one of OTHER_COLOURS, the next free one if two names collide.
    """
    tones = dict(COLOURS)
    for name in sorted({*controllers} - {*COLOURS}):
        first = crc32(name.encode()) % len(OTHER_COLOURS)
        turned = OTHER_COLOURS[first:] + OTHER_COLOURS[:first]
        free = [tone for tone in turned if tone not in tones.values()]
        tones[name] = free[0] if free else turned[0]
    return tones


def figure(width: float, height: float) -> Figure:
    """Return an empty figure [inch] without overlapping parts."""
    drawing = _Drawing(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(drawing)
    return drawing


def save(drawing: Figure, path: Path) -> Path:
    """Write `drawing` to `path`, whole or not at all.

    The suffix of `path` chooses the format.
    """
    with atomic(path) as temporary:
        drawing.savefig(temporary, dpi=150)
    return path


def panels(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` axes, at most four in a row."""
    columns = min(4, count)
    rows = math.ceil(count / columns)
    size = (3.3 * columns, 1.0 + 2.7 * rows)
    if count == 1:
        size = (6.8, 4.6)
    drawing = figure(*size)
    grid = drawing.add_gridspec(rows, columns)
    return drawing, [drawing.add_subplot(grid[n]) for n in range(count)]


def legend_below(drawing: Figure, axes: Sequence[Axes], columns: int = 4) -> None:
    """Draw one legend below all `axes`, in as many `columns` as fit.

    It has each label once, and the labels in LAST at the end.
    """
    entries: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            entries[label] = handle
    for label in LAST:
        if label in entries:
            entries[label] = entries.pop(label)
    style = dict(loc="outside lower center", frameon=False)
    for number in range(min(columns, len(entries)), 0, -1):
        legend = drawing.legend(entries.values(), entries.keys(), ncols=number, **style)
        for text in legend.get_texts():
            text.set_parse_math(False)
        width = legend.get_window_extent(drawing.canvas.get_renderer()).width
        if width <= drawing.bbox.width or number == 1:
            return
        legend.remove()


def total_accumulation(ax: Axes, trajectories: Sequence[Result], seed: int | None = None) -> Axes:
    """Draw vehicles in the network and waiting to enter over time.

    seed: run to show instead of the mean over seeds
    """

    def vehicles(trajectory: Result) -> np.ndarray:
        return trajectory["accumulation"].sum(axis=(1, 2)) + trajectory["backlog"].sum(axis=(1, 2))

    _curves(ax, trajectories, vehicles, seed)
    ax.set(ylabel="vehicles in the network [veh]", ylim=(0.0, None))
    return ax


def region_accumulation(
    ax: Axes,
    network: RegionalModel,
    region: int,
    trajectories: Sequence[Result],
    seed: int | None = None,
) -> Axes:
    """Draw the accumulation of one region over time.

    Results of several plants share the controller's colour and differ in line style.

    seed: run to show instead of the mean over seeds
    """

    def accumulation(trajectory: Result) -> np.ndarray:
        return trajectory["accumulation"][:, region].sum(axis=1)

    critical = network.seen_critical[region]
    style = dict(color="0.35", linewidth=1.0, linestyle=":", zorder=1)
    ax.hlines(critical, 0.0, 1.0, transform=ax.get_yaxis_transform(), label=CRITICAL, **style)
    _curves(ax, trajectories, accumulation, seed)
    highest = max((accumulation(one).max() for one in trajectories), default=0.0)
    # One vehicle if nobody was there. NaN: no critical accumulation was seen.
    top = np.nanmax([highest, 1.25 * critical, 1.0])
    ax.set(ylabel="accumulation [veh]", ylim=(0.0, 1.06 * top))
    ax.set_title(network.titles[region], fontsize="medium")
    return ax


def with_intervals(ax: Axes, values: Mapping[str, Mapping[float, tuple[float, float]]]) -> Axes:
    """Draw lines with error bars, slightly apart.

    values: controller -> x -> mean and half of its interval
    """
    tones = colours(values)
    places: list[float] = []
    for points in values.values():
        places.extend(points)
    spread = max(np.ptp(places or [0.0]), 0.1)
    for number, (controller, points) in enumerate(values.items()):
        mean, half = np.array([*points.values()]).reshape(-1, 2).T
        aside = 0.012 * spread * (number - (len(values) - 1) / 2)
        ax.errorbar(
            np.array([*points]) + aside,
            mean,
            np.nan_to_num(half),
            label=controller,
            color=tones[controller],
            marker=MARKERS[number % len(MARKERS)],
            markersize=4,
            capsize=3,
            linewidth=1.6,
        )
    _open(ax)
    return ax


def mfd(
    ax: Axes,
    mfd: Mfd,
    samples: Mapping[str, np.ndarray] | None = None,
    *,
    seen: bool = True,
    flow: str = OUTFLOW,
) -> Axes:
    """Draw outflow against accumulation, and hatch what lies beyond samples.

    samples: label -> accumulation [veh] and outflow [veh/s] (n, 2), such as {"loading": ...,
        "unloading": ...}
    seen: False if the critical accumulation is a guess, which is not shown
    flow: label of the vertical axis
    """
    clouds = {label: np.asarray(cloud) for label, cloud in (samples or {}).items() if len(cloud)}
    right = 1.15 * mfd.jam
    if clouds:
        largest = max(cloud[:, 0].max() for cloud in clouds.values())
        right = min(right, max(1.5 * mfd.critical, 1.1 * largest))
        style = dict(facecolor="none", edgecolor="0.75", hatch="///", linewidth=0)
        ax.axvspan(largest, max(right, largest), label=UNSEEN, **style)
    if seen:
        style = dict(color="0.35", linewidth=1.0, linestyle=":", zorder=1)
        ax.axvline(mfd.critical, label=CRITICAL, **style)
    tones = colours(clouds)
    for label, cloud in clouds.items():
        style = dict(s=7, color=tones[label], alpha=0.6, linewidths=0)
        ax.scatter(cloud[:, 0], cloud[:, 1], label=label, **style)
    grid = np.linspace(0.0, right, 1001)
    ax.plot(grid, mfd.outflow(grid), color="black", linewidth=1.8, label="MFD")
    if seen and not clouds:
        peak = (mfd.critical, mfd.capacity)
        text = f"{mfd.critical:,.0f} veh, {mfd.capacity:.3g} veh/s"
        above = dict(xytext=(0, 6), textcoords="offset points", ha="center")
        ax.annotate(text, peak, fontsize="small", **above)
    highest = max([mfd.capacity, *(cloud[:, 1].max() for cloud in clouds.values())])
    ax.set(xlim=(0.0, right), xlabel="accumulation [veh]")
    ax.set(ylim=(0.0, 1.12 * highest), ylabel=flow)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    _thousands(ax.xaxis)
    _open(ax)
    return ax


def draw_mfds(
    path: Path,
    network: RegionalModel,
    samples: Sequence[Mapping[str, np.ndarray]] | None = None,
    flow: str = OUTFLOW,
) -> Path:
    """Draw the MFD of each region over its outflow samples, as one file.

    Equal MFDs without samples are drawn once.

    flow: label of the vertical axes
    """
    if samples or len(set(network.mfds)) > 1:
        titles = list(network.titles)
    elif network.regions > 1:
        titles = ["every region"]
    else:
        titles = [network.titles[0]]
    drawing, axes = panels(len(titles))
    for region, (ax, title) in enumerate(zip(axes, titles, strict=True)):
        seen = region not in network.critical_above
        mfd(ax, network.mfds[region], samples[region] if samples else None, seen=seen, flow=flow)
        ax.set_title(title, fontsize="medium")
    legend_below(drawing, axes)
    return save(drawing, path)


def region_map(ax: Axes, network: RegionalModel) -> Axes:
    """Draw regions as discs at their positions, and their boundaries."""
    places = network.positions
    pairs = np.argwhere(np.triu(network.adjacency | network.adjacency.T))
    spacing = min((np.linalg.norm(places[i] - places[h]) for i, h in pairs), default=1.0) or 1.0
    for i, h in pairs:
        ax.plot(*places[[i, h]].T, color="#888888", linewidth=1.4, zorder=1)
    disc = dict(facecolor="#dbe9f6", edgecolor="#30506f", linewidth=1.2, zorder=2)
    for region, (x, y) in enumerate(places):
        ax.add_patch(Circle((x, y), 0.31 * spacing, **disc))
        number = str(region)
        name = network.region_names[region]
        if name == number:
            ax.text(x, y, number, ha="center", va="center", fontweight="bold")
        else:
            ax.text(x, y, number, ha="center", va="bottom", fontweight="bold")
            ax.text(x, y, name, ha="center", va="top", fontsize="x-small")
    ax.axis("scaled")
    ax.set_axis_off()
    return ax


def spawn_matrix(ax: Axes, scenario: Scenario) -> Axes:
    """Draw the trips per pair of regions [veh].

    Origins go down and destinations across.
    """
    trips = scenario.step * scenario.demand.sum(axis=0)
    regions = scenario.network.regions
    image = ax.imshow(np.where(trips > 0, trips, np.nan), cmap="Blues", vmin=0.0)
    for (i, j), value in np.ndenumerate(trips):
        if value > 0 and regions <= 12:
            tone = "white" if value > 0.5 * trips.max() else "black"
            ax.text(j, i, f"{value:,.0f}", ha="center", va="center", fontsize="x-small", color=tone)
    ax.set(xticks=range(regions), xlabel="destination region")
    ax.set(yticks=range(regions), ylabel="origin region")
    bar = ax.figure.colorbar(image, ax=ax, shrink=0.85, label="trips [veh]")
    _thousands(bar.ax.yaxis)
    return ax


def demand(ax: Axes, scenario: Scenario) -> Axes:
    """Draw the demand over time [veh/s], stacked by destination region."""
    arriving = scenario.demand.sum(axis=1).T
    used = np.flatnonzero(arriving.sum(axis=1) > 0)
    busy = np.flatnonzero(arriving.sum(axis=0) > 0)
    end = scenario.steps
    if len(busy):
        end = min(end, 1 + busy[-1] + max(1, scenario.steps // 20))
    time = time_axis(ax, scenario.step * np.arange(end + 1))
    if len(used):
        rates = np.concatenate([arriving[used, :end], arriving[used, end - 1 : end]], axis=1)
        labels = [f"to {scenario.network.titles[j]}" for j in used]
        tones = [f"C{n % 10}" for n in range(len(used))]
        ax.stackplot(time, rates, step="post", labels=labels, colors=tones, linewidth=0)
    ax.set(ylabel="demand [veh/s]", ylim=(0.0, None))
    _open(ax)
    return ax


def time_axis(ax: Axes, seconds: np.ndarray) -> np.ndarray:
    """Set up the time axis of `ax`, and return `seconds` in its unit."""
    name = "min"
    unit = 60.0
    spacings: tuple[int, ...] = (1, 2, 5, 10, 15, 30, 60)
    if seconds[-1] > LONGEST_IN_MINUTES:
        name = "h"
        unit = 3600.0
        spacings = (1, 2, 3, 6, 12, 24)
    end = seconds[-1] / unit
    for spacing in spacings:
        if end / spacing <= 6:
            break
    ax.set(xlabel=f"time [{name}]", xlim=(0.0, end))
    ax.xaxis.set_major_locator(MultipleLocator(spacing))
    return seconds / unit


def _curves(
    ax: Axes,
    trajectories: Sequence[Result],
    quantity: Callable[[Result], np.ndarray],
    seed: int | None = None,
) -> None:
    """Draw a curve per controller and plant, and the range over seeds.

    seed: run to show instead of the mean over seeds
    """
    groups: dict[tuple[str, str], list[Result]] = {}
    for trajectory in trajectories:
        groups.setdefault((trajectory.controller, trajectory.plant), []).append(trajectory)
    plants = list(dict.fromkeys(plant for _, plant in groups))
    tones = colours([controller for controller, _ in groups])
    alpha = 0.2 if len(groups) < 4 else 0.1
    for (controller, plant), members in groups.items():
        values = np.stack([quantity(member) for member in members])
        time = time_axis(ax, members[0].step * np.arange(values.shape[1]))
        plant_name = PLANT_LABELS.get(plant, plant)
        if len(plants) == 1:
            label = controller
        elif len(groups) == len(plants):
            label = plant_name
        else:
            label = f"{controller}, {plant_name}"
        seeds = [member.seed for member in members]
        shown = values.mean(axis=0)
        if seed in seeds:
            shown = values[seeds.index(seed)]
        tone = tones[controller]
        dashes = LINE_STYLES[plants.index(plant) % len(LINE_STYLES)]
        ax.plot(time, shown, color=tone, label=label, linewidth=1.6, linestyle=dashes)
        if len(members) > 1:
            low = values.min(axis=0)
            high = values.max(axis=0)
            ax.fill_between(time, low, high, color=tone, alpha=alpha, linewidth=0)
    _thousands(ax.yaxis)
    _open(ax)


def _open(ax: Axes) -> None:
    """Leave out the frame above and on the right."""
    ax.spines[["top", "right"]].set_visible(False)


def _thousands(axis: Axis) -> None:
    axis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
