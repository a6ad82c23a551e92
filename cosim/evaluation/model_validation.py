"""Microsimulation against the predictions of the regional model: `cosim compare`, and samples of
MFDs."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from jaxtyping import Bool

from cosim.evaluation.results import Finished
from cosim.evaluation.simulate import regional_outflow
from cosim.plant.strategy import of_finished
from cosim.sumo.arrays import Points, RegionCounts
from nmfd.arrays import Adjacency
from nmfd.metrics import largest_accumulation
from nmfd.model.dynamics import advance, parameters
from nmfd.model.identification import Observed
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import files
from nmfd.runs.tables import text_table
from nmfd.studies.benchmark import draw_accumulations
from nmfd.studies.fit_quality import SPILLBACK, predictions
from nmfd.types import Result

COLLAPSED_SHARE = 0.7  # of the largest outflow so far, below which a denser region is collapsed
FEWEST_VEHICLES = 5.0  # in a region during an interval that counts as a sample
CAPTION = (
    "RMSE of the accumulation predicted from the start of a run, and from every recorded state, and most: largest "
    "accumulation of any region, as shares of the critical accumulation; RMSE: mean of the regions"
)


def observed(result: Result) -> Observed:
    """Return the data of a run for identification; its demand is the departures."""
    return Observed(
        accumulation=result.accumulation,
        demand=result["departures"] / result.step,
        perimeter=result.perimeter,
        splits=result.splits,
        crossings=result["crossings"].sum(axis=3),
    )


def predict(scenario: Scenario, result: Result) -> Result:
    """Run the regional model from the same start under the recorded departures and controls."""
    known, x = parameters(scenario.network), torch.from_numpy(result.accumulation[0])
    given = (result["departures"] / scenario.step, result.perimeter, result.splits)
    states = [x]
    for interval in zip(*map(torch.from_numpy, given), strict=True):
        states.append(advance(known, states[-1], *interval, **scenario.scheme))
    return result.assign(
        accumulation=torch.stack(states).numpy(),
        backlog=np.zeros_like(result.backlog),
        plant="nmfd",
    )


def compare(found: Finished) -> pd.DataFrame:
    """Draw the runs of a folder beside predictions; return the errors by strategy, demand level and
    region.

    Raises: InputError if the city has changed since the runs
    """
    found.map()
    tables = []
    for level in found.levels:
        for controller in level.rows["controller"].unique():
            network, results = (
                of_finished(controller).planning(found.scenario).network,
                level.results(controller),
            )
            scenario, runs = replace(found.scenario, network=network), list(map(observed, results))
            predicted = [predict(scenario, result) for result in results]
            both = zip(predicted, results, strict=True)
            off = np.concatenate([a.accumulation.sum(2) - b.accumulation.sum(2) for a, b in both])
            columns = {
                "demand": level.demand,
                "controller": controller,
                "runs": len(runs),
                "model": os.path.normpath(network.folder) if network.folder else "",
                "region": range(network.regions),
                "critical_veh": network.seen_critical,
                "most_share": largest_accumulation(run.accumulation for run in runs)
                / network.seen_critical,
                "whole_run_rmse_share": np.sqrt((off**2).mean(axis=0)) / network.seen_critical,
                "whole_run_bias_share": off.mean(axis=0) / network.seen_critical,
            }
            tables.append(pd.DataFrame(columns).join(predictions(network, runs, scenario.scheme)))
            drawn = [
                run.assign(backlog=np.zeros_like(run.backlog)) for run in (results[0], predicted[0])
            ]
            prefix = f"compare-{files.run_name(controller, results[0].seed)}-"
            draw_accumulations(level.folder, scenario, drawn, prefix=prefix)
    return pd.concat(tables, ignore_index=True)


def prediction_table(rows: pd.DataFrame) -> str:
    """Return prediction errors as text, one line per strategy and demand level."""
    lines = []
    for (demand, controller), group in rows.groupby(["demand", "controller"], sort=False):
        mean, first = (
            (100 * group.filter(like="rmse_share").mean()).map("{:.1f} %".format),
            group.iloc[0],
        )
        lines.append(
            {
                "demand": f"{demand:g}",
                "controller": controller,
                "runs": first["runs"],
                "model": Path(first["model"]).name,
                "most": f"{group['most_share'].max():.1f}",
                "whole run": mean["whole_run_rmse_share"],
                "next interval": mean["next_interval_rmse_share"],
                "if nothing changed": mean["next_interval_persistence_rmse_share"],
                "later": f"{mean['ahead_rmse_share']} ({first['ahead_s']:g} s)",
                "if nothing changed ": mean["ahead_persistence_rmse_share"],
            }
        )
    return text_table(lines, CAPTION)


def outflow_samples(network: RegionalModel, results: Sequence[Result]) -> list[dict[str, Points]]:
    """Return the MFD samples of each region: label -> (n, 2) of accumulation [veh] and outflow
    [veh/s].

    Labels are "loading", "unloading", and SPILLBACK for intervals in which a neighbour's congestion
    limits the outflow (`held_up`). The outflow of an interval is that which the model's g gives:
    trips ended in the region, and transfers divided by u. In the model x_ii leaves at q x_ii and
    x_ij at u q x_ij, so q = outflow / (x_ii + u x_i,other).
    """
    samples: list[dict] = [
        {"loading": [], "unloading": [], SPILLBACK: []} for _ in range(network.regions)
    ]
    for result in results:
        x = 0.5 * (result.accumulation[1:] + result.accumulation[:-1])
        total, own = x.sum(2), np.diagonal(x, axis1=1, axis2=2)
        outflow = regional_outflow(result, result.step)
        weight = own + np.minimum(result.perimeter.max(axis=2), network.u_max) * (total - own)
        points = np.stack([total, outflow * total / np.maximum(weight, 1e-9)], axis=2)
        rising = np.diff(result.accumulation.sum(2), axis=0) >= 0
        seen, blocked = total >= FEWEST_VEHICLES, held_up(total, outflow, network.adjacency)
        masks = {
            "loading": seen & ~blocked & rising,
            "unloading": seen & ~blocked & ~rising,
            SPILLBACK: seen & blocked,
        }
        for n, clouds in enumerate(samples):
            for label, mask in masks.items():
                clouds[label].append(points[mask[:, n], n])
    return [{label: np.concatenate(parts) for label, parts in clouds.items()} for clouds in samples]


def held_up(
    accumulation: RegionCounts, outflow: RegionCounts, adjacency: Adjacency
) -> Bool[np.ndarray, "T R"]:
    """Mark the intervals in which a neighbour that collapsed before the region is collapsed.

    A collapsed region holds more vehicles (T, R) than when its outflow (T, R) was largest so far,
    and lets out less than COLLAPSED_SHARE of that. Its queues spill back and lower the outflow of
    the region behind.
    """
    largest, interval = np.maximum.accumulate(outflow), np.arange(len(outflow))[:, None]
    best = np.maximum.accumulate(np.where(outflow == largest, interval, 0))
    fuller = accumulation > np.take_along_axis(accumulation, best, axis=0)
    collapsed = fuller & (outflow < COLLAPSED_SHARE * largest)
    onset = np.where(collapsed.any(axis=0), collapsed.argmax(axis=0), len(outflow))
    earlier = adjacency & (onset[None, :] < onset[:, None])
    return (collapsed[:, None, :] & earlier[None]).any(axis=2)
