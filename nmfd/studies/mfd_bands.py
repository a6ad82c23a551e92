"""What loading runs say of the MFDs beyond one curve: confidence bands over runs, and the production."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from nmfd.arrays import Points
from nmfd.model.regional_model import RegionalModel
from nmfd.studies import plots
from nmfd.studies.benchmark import interval

BINS = 12  # of accumulation
FEWEST = 3  # runs in a bin
Band = Float[np.ndarray, "_ 3"]  # bins of accumulation


def band(runs: Sequence[Points]) -> Band:
    """(n, 3): accumulation [veh], mean over runs, and half of its 95 % interval (Student's t).

    runs: (m, 2) of accumulation and outflow or production. The samples of one run hang together, therefore every run
    counts once in a bin of accumulation; bins with fewer than FEWEST runs are left out.
    """
    most = max((run[:, 0].max() for run in runs if len(run)), default=0.0)
    rows = []
    for n in range(BINS):
        low, high = n * most / BINS, (n + 1) * most / BINS
        inside = [run[(run[:, 0] > low) & (run[:, 0] <= high)] for run in runs]
        means = [part.mean(axis=0) for part in inside if len(part)]
        if len(means) >= FEWEST:
            x, value = np.array(means).T
            rows.append([x.mean(), value.mean(), interval(list(value))])
    return np.array(rows).reshape(-1, 3)


def draw_band(ax: Axes, found: Band, over: str = "runs") -> Axes:
    """A shaded band and its middle; found: (n, 3) as `band` gives it, over runs or days."""
    x, mean, half = found.T
    ax.fill_between(
        x,
        mean - half,
        mean + half,
        color="tab:blue",
        alpha=0.25,
        linewidth=0,
        zorder=3,
        label=f"mean over {over}, 95 % interval",
    )
    ax.plot(x, mean, color="tab:blue", linewidth=1.2, zorder=3)
    return ax


def production_samples(record: Mapping[str, np.ndarray], region: int) -> dict[str, Points]:
    """label -> (n, 2) of accumulation [veh] and production [veh m/s], loading and unloading, of one run."""
    accumulation, production = record["mean_accumulation"][:, region], record["production"][:, region]
    rising = np.diff(accumulation, prepend=0.0) >= 0
    points, seen = np.stack([accumulation, production], axis=1), accumulation >= 5.0
    return {"loading": points[seen & rising], "unloading": points[seen & ~rising]}


def draw_production(path: Path, network: RegionalModel, records: Sequence[Mapping[str, np.ndarray]]) -> None:
    """The production MFD of every region: samples of all runs, loading and unloading apart, with the band."""
    drawing, axes = plots.panels(network.regions)
    for region, ax in enumerate(axes):
        runs = [production_samples(record, region) for record in records]
        for label, tone in (("loading", "0.35"), ("unloading", "tab:orange")):
            cloud = np.concatenate([run[label] for run in runs])
            ax.scatter(cloud[:, 0], cloud[:, 1] / 1000.0, s=7, alpha=0.5, linewidths=0, color=tone, label=label)
        draw_band(ax, band([np.concatenate(list(run.values())) for run in runs]) / [1.0, 1000.0, 1000.0])
        ax.set_title(plots.region_title(network, region), fontsize="medium")
        ax.set_xlabel("accumulation [veh]")
        ax.set_ylabel("production [veh km/s]")
        ax.set_xlim(left=0.0)
        ax.set_ylim(0.0, 1.1e-3 * max(cloud[:, 1].max() for run in runs for cloud in run.values() if len(cloud)))
        ax.spines[["top", "right"]].set_visible(False)
    plots.legend_below(drawing, axes)
    plots.save(drawing, path)


def draw_mfds(
    path: Path,
    network: RegionalModel,
    samples: Sequence[Mapping[str, Points]],
    found: Sequence[Band] = (),
    over: str = "runs",
) -> None:
    """The MFD of every region over its outflow samples, as one picture. found: by region, a `band` to draw, over runs
    or days."""
    drawing, axes = plots.panels(network.regions)
    for region, ax in enumerate(axes):
        plots.mfd(ax, network.mfds[region], samples[region])
        if len(found):
            draw_band(ax, found[region], over)
        ax.set_title(plots.region_title(network, region), fontsize="medium")
    plots.legend_below(drawing, axes)
    plots.save(drawing, path)
