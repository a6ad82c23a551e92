"""Microsimulation against the predictions of the regional model: `cosim compare`, and samples of MFDs."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from jaxtyping import Bool

from cosim.evaluation.results import Finished
from cosim.evaluation.simulate import regional_outflow
from cosim.sumo.arrays import Points, RegionCounts
from nmfd.arrays import Adjacency
from nmfd.controllers.strategy import parse
from nmfd.metrics import largest_accumulation
from nmfd.model.dynamics import advance, parameters
from nmfd.model.identification import Observed
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import files
from nmfd.runs.tables import text_columns, text_table
from nmfd.studies import plots
from nmfd.studies.fit_quality import SPILLBACK, predictions
from nmfd.types import Result

COLLAPSED_SHARE = 0.7  # of the largest outflow so far, below which a denser region is collapsed
FEWEST_VEHICLES = 5.0  # in a region during an interval that counts as a sample
OF_ONE_RUN = (
    "RMSE, bias: of the accumulation predicted for the whole run from its start [veh]; next interval: predicted from "
    "every recorded state; if nothing changed: RMSE of constant accumulation; bias > 0: the model holds too many"
)
HEADINGS = ["region", "name", "critical", "mean", "RMSE", "of critical", "if nothing changed", "bias"]
HEADINGS += ["next interval RMSE", "of critical", "if nothing changed"]
OF_ALL_RUNS = (
    "RMSE of the accumulation predicted from every recorded state, and most: largest accumulation of any region, as "
    "shares of the critical accumulation; RMSE: mean of the regions"
)


def observed(result: Result) -> Observed:
    """Return a run as identification sees it; demand is what entered the streets."""
    return Observed(
        accumulation=result.accumulation,
        demand=result["departures"] / result.step,
        perimeter=result.perimeter,
        splits=result.splits,
        crossings=result["crossings"].sum(axis=3),
    )


def predict(scenario: Scenario, result: Result) -> Result:
    """Run the regional model from the same start under the recorded departures and controls."""
    states = [result.accumulation[0]]
    for k in range(len(result.perimeter)):
        states.append(_advanced(scenario, result, states[-1], k))
    return result.assign(accumulation=np.stack(states), backlog=np.zeros_like(result.backlog), plant="nmfd")


def _advanced(scenario: Scenario, result: Result, state: np.ndarray, intervals: int | slice) -> np.ndarray:
    """Return the states (..., R, R) [veh] one interval later under the departures and controls of these intervals."""
    recorded = (result["departures"] / scenario.step, result.perimeter, result.splits)
    given = map(torch.from_numpy, (state, *(values[intervals] for values in recorded)))
    return advance(parameters(scenario.network), *given, **scenario.scheme).numpy()


def errors(scenario: Scenario, result: Result, predicted: Result) -> pd.DataFrame:
    """Return the prediction errors of a run, a row per region and one for "all" together.

    The next interval is predicted from every recorded state under the recorded departures and controls.
    """
    network, simulated = scenario.network, result.accumulation.sum(-1)
    following = _advanced(scenario, result, result.accumulation[:-1], slice(None))
    parts = (simulated, predicted.accumulation.sum(-1) - simulated, following.sum(-1) - simulated[1:])
    seen, off, next_off = (np.column_stack([values, values.sum(axis=1)]) for values in parts)
    critical = np.append(network.seen_critical, network.seen_critical.sum())
    return pd.DataFrame(
        {
            "region": [*range(network.regions), "all"],
            "name": [*network.region_names, "all regions"],
            "critical_veh": critical,
            "mean_veh": seen.mean(axis=0),
            "rmse_veh": _rms(off),
            "rmse_share": _rms(off) / critical,
            "persistence_rmse_veh": _rms(seen[0] - seen),
            "bias_veh": off.mean(axis=0),
            "next_interval_rmse_veh": _rms(next_off),
            "next_interval_rmse_share": _rms(next_off) / critical,
            "next_interval_persistence_rmse_veh": _rms(np.diff(seen, axis=0)),
        }
    )


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0))


def error_table(rows: pd.DataFrame) -> str:
    """Return the prediction errors of a run as text."""
    shown = {name: [str(cell) for cell in rows[name]] for name in rows}
    for name in rows.columns[2:]:
        percent = name.endswith("share")
        shown[name] = [f"{100 * value:.1f} %" if percent else f"{value:.1f}" for value in rows[name]]
    return text_columns(HEADINGS, zip(*shown.values(), strict=True), OF_ONE_RUN)


def write_comparison(folder: Path, scenario: Scenario, result: Result) -> pd.DataFrame:
    """Write compare-<run>.csv and a figure beside a run; return the rows of `errors`."""
    network, predicted = scenario.network, predict(scenario, result)
    rows, name = errors(scenario, result, predicted), files.run_name(result.controller, result.seed)
    files.write_table(folder / f"compare-{name}.csv", rows)
    drawing, axes = plots.panels(network.regions + 1)
    for region, ax in enumerate(axes[:-1]):
        plots.region_accumulation(ax, network, region, [result, predicted])
    plots.total_accumulation(axes[-1], [result.assign(backlog=np.zeros_like(result.backlog)), predicted])
    axes[-1].set_title("all regions", fontsize="medium")
    plots.legend_below(drawing, axes, columns=4)
    plots.save(drawing, folder / f"compare-{name}-accumulation.png")
    return rows


def prediction_errors(found: Finished, model: Path | None = None) -> pd.DataFrame:
    """Return the prediction errors of all runs of a folder, a row per strategy, demand level and region.

    model: folder of the predicting network; None for that with which each controller plans

    Raises:
        InputError: if the city has changed since the runs.
    """
    found.map()
    scenario, tables = found.scenario, []
    for level in found.levels:
        for controller, rows in level.rows.groupby("controller", sort=False):
            network = parse(controller).planning(scenario, model).network
            runs = [observed(level.read(controller, seed)) for seed in rows["seed"]]
            most = largest_accumulation(run.accumulation for run in runs)
            columns = {
                "demand": level.demand,
                "controller": controller,
                "runs": len(runs),
                "model": os.path.normpath(network.folder) if network.folder else "",
                "region": range(network.regions),
                "critical_veh": network.seen_critical,
                "most_share": most / network.seen_critical,
            }
            tables.append(pd.DataFrame(columns).join(predictions(network, runs, scenario.scheme)))
    return pd.concat(tables, ignore_index=True)


def prediction_table(rows: pd.DataFrame) -> str:
    """Return prediction errors as text, one line per strategy and demand level."""
    lines = []
    for (demand, controller), group in rows.groupby(["demand", "controller"], sort=False):
        mean, first = (100 * group.filter(like="rmse_share").mean()).map("{:.1f} %".format), group.iloc[0]
        lines.append(
            {
                "demand": f"{demand:g}",
                "controller": controller,
                "runs": first["runs"],
                "model": Path(first["model"]).name,
                "most": f"{group['most_share'].max():.1f}",
                "next interval": mean["next_interval_rmse_share"],
                "if nothing changed": mean["next_interval_persistence_rmse_share"],
                "later": f"{mean['ahead_rmse_share']} ({first['ahead_s']:g} s)",
                "if nothing changed ": mean["ahead_persistence_rmse_share"],
            }
        )
    return text_table(lines, OF_ALL_RUNS)


def outflow_samples(network: RegionalModel, results: Sequence[Result]) -> list[dict[str, Points]]:
    """Return the MFD samples of each region: label -> (n, 2) of accumulation [veh] and outflow [veh/s].

    Labels are "loading", "unloading", and SPILLBACK for intervals in which a neighbour's congestion limits the outflow
    (`held_up`). The outflow of an interval is that which the model's g gives: trips ended in the region, and transfers
    divided by u. In the model x_ii leaves at q x_ii and x_ij at u q x_ij, so q = outflow / (x_ii + u x_i,other).
    """
    samples: list[dict] = [{"loading": [], "unloading": [], SPILLBACK: []} for _ in range(network.regions)]
    for result in results:
        x = 0.5 * (result.accumulation[1:] + result.accumulation[:-1])
        total, own = x.sum(2), np.diagonal(x, axis1=1, axis2=2)
        outflow = regional_outflow(result, result.step)
        weight = own + np.minimum(result.perimeter.max(axis=2), network.u_max) * (total - own)
        points = np.stack([total, outflow * total / np.maximum(weight, 1e-9)], axis=2)
        rising = np.diff(result.accumulation.sum(2), axis=0) >= 0
        seen, blocked = total >= FEWEST_VEHICLES, held_up(total, outflow, network.adjacency)
        masks = {"loading": seen & ~blocked & rising, "unloading": seen & ~blocked & ~rising, SPILLBACK: seen & blocked}
        for n, clouds in enumerate(samples):
            for label, mask in masks.items():
                clouds[label].append(points[mask[:, n], n])
    return [{label: np.concatenate(parts) for label, parts in clouds.items()} for clouds in samples]


def held_up(accumulation: RegionCounts, outflow: RegionCounts, adjacency: Adjacency) -> Bool[np.ndarray, "T R"]:
    """Mark the intervals in which a neighbour that collapsed before the region is collapsed.

    A collapsed region holds more vehicles (T, R) than when its outflow (T, R) was largest so far, and lets out less
    than COLLAPSED_SHARE of that. Its queues spill back and lower the outflow of the region behind.
    """
    largest, interval = np.maximum.accumulate(outflow), np.arange(len(outflow))[:, None]
    best = np.maximum.accumulate(np.where(outflow == largest, interval, 0))
    fuller = accumulation > np.take_along_axis(accumulation, best, axis=0)
    collapsed = fuller & (outflow < COLLAPSED_SHARE * largest)
    onset = np.where(collapsed.any(axis=0), collapsed.argmax(axis=0), len(outflow))
    earlier = adjacency & (onset[None, :] < onset[:, None])
    return (collapsed[:, None, :] & earlier[None]).any(axis=2)
