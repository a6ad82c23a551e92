"""Figures of networks, scenarios and runs; each function draws into an `ax` and returns it, without
pyplot."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from zlib import crc32

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
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
    "sumo": "SUMO",
    "estimate": "estimate",
}
LINE_STYLES, MARKERS = ("-", "--", ":", "-."), "o^sDvPX"
CRITICAL, UNSEEN = "critical accumulation of the model", "beyond all samples: a guess"
LAST = CRITICAL, UNSEEN  # labels at the end of legends


def colours(controllers: Iterable[str]) -> dict[str, str]:
    """Return the colour of each controller; unknown names get distinct ones of OTHER_COLOURS if
    possible.

    It follows from the name, so that a controller looks the same in every picture, unless two names
    collide.
    """
    tones = dict(COLOURS)
    for name in sorted({*controllers} - {*COLOURS}):
        first = crc32(name.encode()) % len(OTHER_COLOURS)
        turned = OTHER_COLOURS[first:] + OTHER_COLOURS[:first]
        tones[name] = next((tone for tone in turned if tone not in tones.values()), turned[0])
    return tones


def figure(width: float, height: float) -> Figure:
    """Return an empty figure [inch] without overlapping parts."""
    drawing = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(drawing)
    return drawing


def save(drawing: Figure, path: Path) -> Path:
    """Write `drawing` to `path`, whole or not at all; the suffix chooses the format."""
    with atomic(path) as temporary:
        drawing.savefig(temporary, dpi=150)
    return path


def panels(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` axes, at most four in a row."""
    columns = min(4, count)
    rows = -(-count // columns)
    drawing = figure(
        6.8 if count == 1 else 3.3 * columns, 1.0 + (3.6 if count == 1 else 2.7 * rows)
    )
    grid = np.ravel(drawing.subplots(rows, columns))
    for ax in grid[count:]:
        ax.remove()
    return drawing, list(grid[:count])


def legend_below(drawing: Figure, axes: Sequence[Axes], columns: int = 4) -> None:
    """Draw one legend below all `axes`, in as many `columns` as fit; each label once, LAST last."""
    entries = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    entries |= {label: entries.pop(label) for label in LAST if label in entries}
    for number in range(min(columns, len(entries)), 0, -1):
        place = dict(loc="outside lower center", ncols=number, frameon=False)
        legend = drawing.legend(entries.values(), entries.keys(), **place)
        if (
            number == 1
            or legend.get_window_extent(drawing.canvas.get_renderer()).width <= drawing.bbox.width
        ):
            return
        legend.remove()


def total_accumulation(ax: Axes, trajectories: Sequence[Result], seed: int | None = None) -> Axes:
    """Draw vehicles in the network and waiting to enter over time; seed: shown instead of the mean
    over seeds."""
    _curves(
        ax,
        trajectories,
        lambda t: t["accumulation"].sum(axis=(1, 2)) + t["backlog"].sum(axis=(1, 2)),
        seed,
    )
    ax.set(ylabel="vehicles in the network [veh]", ylim=(0.0, None))
    return ax


def region_accumulation(
    ax: Axes,
    network: RegionalModel,
    region: int,
    trajectories: Sequence[Result],
    seed: int | None = None,
) -> Axes:
    """Draw the accumulation of one region over time; seed: shown instead of the mean over seeds.

    Results of several plants share the controller's colour and differ in line style.
    """
    critical = network.seen_critical[region]
    style = dict(color="0.35", linewidth=1.0, linestyle=":", zorder=1)
    ax.hlines(critical, 0.0, 1.0, transform=ax.get_yaxis_transform(), label=CRITICAL, **style)
    _curves(ax, trajectories, lambda t: t["accumulation"][:, region].sum(axis=1), seed)
    highest = max(
        (t["accumulation"][:, region].sum(axis=1).max() for t in trajectories), default=0.0
    )
    ax.set(ylabel="accumulation [veh]", ylim=(0.0, 1.06 * np.nanmax([highest, 1.25 * critical])))
    ax.set_title(network.titles[region], fontsize="medium")
    return ax


def with_intervals(ax: Axes, values: Mapping[str, Mapping[float, tuple[float, float]]]) -> Axes:
    """Draw controller -> x -> mean and half of its interval as lines with error bars, slightly
    apart."""
    tones, places = colours([*values]), [x for points in values.values() for x in points]
    for number, (controller, points) in enumerate(values.items()):
        mean, half = np.array([*points.values()]).reshape(-1, 2).T
        aside = 0.012 * max(np.ptp(places or [0.0]), 0.1) * (number - (len(values) - 1) / 2)
        style = {
            "color": tones[controller],
            "marker": MARKERS[number % len(MARKERS)],
            "markersize": 4,
            "capsize": 3,
        }
        ax.errorbar(
            np.array([*points]) + aside,
            mean,
            np.nan_to_num(half),
            label=controller,
            linewidth=1.6,
            **style,
        )
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def mfd(
    ax: Axes, mfd: Mfd, samples: Mapping[str, np.ndarray] | None = None, *, seen: bool = True
) -> Axes:
    """Draw outflow against accumulation, and hatch what lies beyond the samples.

    samples: label -> (n, 2) of accumulation [veh] and outflow [veh/s], such as {"loading": ...,
        "unloading": ...}
    seen: False if the critical accumulation is a guess, which is not shown
    """
    clouds = {label: np.asarray(cloud) for label, cloud in (samples or {}).items() if len(cloud)}
    right = 1.15 * mfd.jam
    if clouds:
        largest = max(cloud[:, 0].max() for cloud in clouds.values())
        right = min(right, max(1.5 * mfd.critical, 1.1 * largest))
        style = dict(facecolor="none", edgecolor="0.75", hatch="///", linewidth=0)
        ax.axvspan(largest, max(right, largest), label=UNSEEN, **style)
    if seen:
        ax.axvline(
            mfd.critical, color="0.35", linewidth=1.0, linestyle=":", label=CRITICAL, zorder=1
        )
    tones = colours(clouds)
    for label, cloud in clouds.items():
        ax.scatter(
            cloud[:, 0], cloud[:, 1], s=7, color=tones[label], alpha=0.6, linewidths=0, label=label
        )
    grid = np.linspace(0.0, right, 1001)
    ax.plot(grid, mfd.outflow(grid), color="black", linewidth=1.8, label="MFD")
    if seen and not clouds:
        text, peak = (
            f"{mfd.critical:,.0f} veh, {mfd.capacity:.3g} veh/s",
            (mfd.critical, mfd.capacity),
        )
        ax.annotate(
            text, peak, xytext=(0, 6), textcoords="offset points", ha="center", fontsize="small"
        )
    top = 1.12 * max([mfd.capacity, *(cloud[:, 1].max() for cloud in clouds.values())])
    ax.set(
        xlim=(0.0, right), ylim=(0.0, top), xlabel="accumulation [veh]", ylabel="outflow [veh/s]"
    )
    ax.xaxis.set_major_locator(MaxNLocator(5))
    _thousands(ax.xaxis)
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def draw_mfds(
    path: Path, network: RegionalModel, samples: Sequence[Mapping[str, np.ndarray]] | None = None
) -> Path:
    """Draw the MFD of each region over its outflow samples, as one file; equal MFDs without samples
    once."""
    shown = range(network.regions) if samples or len(set(network.mfds)) > 1 else [0]
    drawing, axes = panels(len(shown))
    for region, ax in zip(shown, axes, strict=True):
        seen = region not in network.critical_above
        mfd(ax, network.mfds[region], samples[region] if samples else None, seen=seen)
        ax.set_title(
            network.titles[region] if len(shown) == network.regions else "every region",
            fontsize="medium",
        )
    legend_below(drawing, axes)
    return save(drawing, path)


def region_map(ax: Axes, network: RegionalModel) -> Axes:
    """Draw regions as discs at their positions, and the boundaries between them."""
    places, pairs = network.positions, np.argwhere(np.triu(network.adjacency | network.adjacency.T))
    spacing = min((np.linalg.norm(places[i] - places[h]) for i, h in pairs), default=1.0) or 1.0
    for i, h in pairs:
        ax.plot(*places[[i, h]].T, color="#888888", linewidth=1.4, zorder=1)
    for region, (x, y) in enumerate(places):
        ax.add_patch(
            Circle(
                (x, y),
                0.31 * spacing,
                facecolor="#dbe9f6",
                edgecolor="#30506f",
                linewidth=1.2,
                zorder=2,
            )
        )
        name = network.region_names[region]
        ax.text(
            x,
            y,
            str(region),
            ha="center",
            va="bottom" if name != str(region) else "center",
            fontweight="bold",
        )
        ax.text(
            x, y, name if name != str(region) else "", ha="center", va="top", fontsize="x-small"
        )
    ax.axis("scaled")
    ax.set_axis_off()
    return ax


def spawn_matrix(ax: Axes, scenario: Scenario) -> Axes:
    """Draw the trips of the scenario per pair of regions [veh], origins down and destinations
    across."""
    trips, regions = scenario.step * scenario.demand.sum(axis=0), scenario.network.regions
    image = ax.imshow(np.where(trips > 0, trips, np.nan), cmap="Blues", vmin=0.0)
    for (i, j), value in np.ndenumerate(trips):
        if value > 0 and regions <= 12:
            tone = "white" if value > 0.5 * trips.max() else "black"
            ax.text(j, i, f"{value:,.0f}", ha="center", va="center", fontsize="x-small", color=tone)
    ax.set(
        xticks=range(regions),
        yticks=range(regions),
        xlabel="destination region",
        ylabel="origin region",
    )
    bar = ax.figure.colorbar(image, ax=ax, shrink=0.85, label="trips [veh]")
    _thousands(bar.ax.yaxis)
    return ax


def demand(ax: Axes, scenario: Scenario) -> Axes:
    """Draw the demand over time [veh/s], stacked by destination region."""
    arriving = scenario.demand.sum(axis=1).T
    used, steps = np.flatnonzero(arriving.sum(axis=1) > 0), np.flatnonzero(arriving.sum(axis=0) > 0)
    end = (
        min(scenario.steps, 1 + steps[-1] + max(1, scenario.steps // 20))
        if len(steps)
        else scenario.steps
    )
    time = time_axis(ax, scenario.step * np.arange(end + 1))
    if len(used):
        rates = np.concatenate([arriving[used, :end], arriving[used, end - 1 : end]], axis=1)
        labels = [f"to {scenario.network.titles[j]}" for j in used]
        tones = [f"C{n % 10}" for n in range(len(used))]
        ax.stackplot(time, rates, step="post", labels=labels, colors=tones, linewidth=0)
    ax.set(ylabel="demand [veh/s]", ylim=(0.0, None))
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def _curves(
    ax: Axes,
    trajectories: Sequence[Result],
    quantity: Callable[[Result], np.ndarray],
    seed: int | None = None,
) -> None:
    """Draw a curve per controller and plant: the mean over seeds, or one `seed`, and their
    range."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for trajectory in trajectories:
        groups.setdefault((trajectory.controller, trajectory.plant), []).append(trajectory)
    plants = list(dict.fromkeys(plant for _, plant in groups))
    tones = colours([controller for controller, _ in groups])
    for (controller, plant), members in groups.items():
        values = np.stack([quantity(member) for member in members])
        time = time_axis(ax, members[0].step * np.arange(values.shape[1]))
        label = [controller] * (len(groups) > len(plants) or len(plants) == 1)
        label += [PLANT_LABELS.get(plant, plant)] * (len(plants) > 1)
        one = next(
            (row for row, member in zip(values, members, strict=True) if member.seed == seed), None
        )
        style = dict(linewidth=1.6, linestyle=LINE_STYLES[plants.index(plant) % len(LINE_STYLES)])
        shown = values.mean(axis=0) if one is None else one
        ax.plot(time, shown, color=tones[controller], label=", ".join(label), **style)
        if len(members) > 1:
            low, high, alpha = (
                values.min(axis=0),
                values.max(axis=0),
                0.2 if len(groups) < 4 else 0.1,
            )
            ax.fill_between(time, low, high, color=tones[controller], alpha=alpha, linewidth=0)
    _thousands(ax.yaxis)
    ax.spines[["top", "right"]].set_visible(False)


def time_axis(ax: Axes, seconds: np.ndarray) -> np.ndarray:
    """Set up the time axis of `ax`, in minutes up to four hours; return `seconds` in its unit."""
    short = 60.0, "min", (1, 2, 5, 10, 15, 30, 60)
    unit, name, steps = short if seconds[-1] <= 4 * 3600 else (3600.0, "h", (1, 2, 3, 6, 12, 24))
    ax.set(xlabel=f"time [{name}]", xlim=(0.0, seconds[-1] / unit))
    ax.xaxis.set_major_locator(
        MultipleLocator(next((s for s in steps if seconds[-1] / unit / s <= 6), steps[-1]))
    )
    return seconds / unit


def _thousands(axis: Axis) -> None:
    axis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
