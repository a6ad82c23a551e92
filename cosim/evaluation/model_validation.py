"""Runs against predictions of the regional model, and samples of MFDs.

`cosim compare` writes and prints the errors.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from cosim.evaluation.results import Finished
from cosim.evaluation.simulate import regional_outflow
from cosim.plant.strategy import of_finished
from nmfd.model.mfd import held_up
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import files
from nmfd.runs.tables import cell, text_table
from nmfd.studies.benchmark import draw_accumulations
from nmfd.studies.fit_quality import SITUATIONS, Samples, joined, predictions, samples_of_run
from nmfd.types import Result

if TYPE_CHECKING:
    from nmfd.model.identification import Observed

CAPTION = (
    "RMSE of the accumulation predicted from the start of a run, and from every recorded state, "
    "and most: largest accumulation of any region, as shares of the critical accumulation (where "
    "it was not seen, of the largest one that was); RMSE: mean of the regions. Flowing, congested: "
    "later errors while no region is beyond its critical accumulation, and else"
)


def observed(result: Result) -> "Observed":
    """Return the data of a run for identification.

    Its demand is the departures.
    """
    from nmfd.model.identification import Observed  # torch takes two seconds

    crossings = net_crossings(result)
    exits = crossings.sum(axis=2)
    own = np.arange(exits.shape[1])
    exits[:, own, own] = result["arrivals"]
    return Observed(
        accumulation=result["accumulation"],
        inside=mean_inside(result),
        demand=result["departures"] / result.step,
        perimeter=result["perimeter"],
        splits=expected_splits(result),
        crossings=crossings.sum(axis=3),
        exits=exits,
    )


def mean_inside(result: Result) -> np.ndarray:
    """Return the mean accumulation of each interval (veh, (T, R, R)).

    Signals that change together fill and empty a region within an interval, so that its ends say
    too little. They stand for it in older runs, which have no `time_inside`.
    """
    if "time_inside" in result:
        return result["time_inside"] / result.step
    return 0.5 * (result["accumulation"][1:] + result["accumulation"][:-1])


def expected_splits(result: Result) -> np.ndarray:
    """Return the split ratios that a model takes for a run (-, (T, R, R, R)).

    They are the commanded ones or, with prices, the answer that the controller expected.
    """
    if "expected_splits" in result:
        return result["expected_splits"]
    return result["splits"]


def net_crossings(result: Result) -> np.ndarray:
    """Return crossings [i, h, j] from i to h, bound for j (veh, (T, R, R, R)).

    In the model no vehicle leaves the region of its destination. Those that do, and come back
    later, are taken off the vehicles that come.
    """
    crossings = result["crossings"].astype(float)
    own = np.arange(crossings.shape[1])
    leaving = crossings[:, own, :, own]  # [i, t, h] from i to h, bound for i
    crossings[:, own, :, own] = 0.0
    crossings[:, :, own, own] -= np.moveaxis(leaving, (0, 1, 2), (2, 0, 1))
    return crossings


def predict(scenario: Scenario, result: Result) -> Result:
    """Run the regional model from the same start.

    It gets the recorded departures and controls.
    """
    import torch

    from nmfd.model.dynamics import advance, parameters

    known = parameters(scenario.network)
    states = [torch.from_numpy(result["accumulation"][0])]
    given = (result["departures"] / scenario.step, result["perimeter"], expected_splits(result))
    for interval in zip(*map(torch.from_numpy, given), strict=True):
        states.append(advance(known, states[-1], *interval, **scenario.scheme))
    return result.assign(
        accumulation=torch.stack(states).numpy(),
        backlog=np.zeros_like(result["backlog"]),
        plant="nmfd",
    )


def compare(found: Finished) -> pd.DataFrame:
    """Draw the runs of a folder beside predictions, and return the errors.

    There is a row for every strategy, demand level and region. Shares are of `share_of_veh`: the
    critical accumulation, or the largest one that was seen where it was not reached.

    Raises: InputError if the city has changed since the runs
    """
    found.map()
    tables = []
    for level in found.levels:
        for controller in level.rows["controller"].unique():
            network = of_finished(controller).planning(found.scenario).network
            scenario = replace(found.scenario, network=network)
            results = level.results(controller)
            predicted = [predict(scenario, result) for result in results]
            errors = _errors(scenario, results, predicted)
            errors.insert(0, "demand", level.demand)
            errors.insert(1, "controller", controller)
            tables.append(errors)
            drawn = [
                run.assign(backlog=np.zeros_like(run["backlog"]))
                for run in (results[0], predicted[0])
            ]
            prefix = f"compare-{files.run_name(controller, results[0].seed)}-"
            draw_accumulations(level.folder, scenario, drawn, prefix=prefix)
    return pd.concat(tables, ignore_index=True)


def _errors(
    scenario: Scenario, results: Sequence[Result], predicted: Sequence[Result]
) -> pd.DataFrame:
    """Return the errors in the runs of one strategy, a row per region."""
    network = scenario.network
    states = np.concatenate([run["accumulation"].sum(axis=2) for run in results])
    off = np.concatenate([run["accumulation"].sum(axis=2) for run in predicted]) - states
    base = network.critical.copy()
    for region, largest in network.critical_above.items():
        base[region] = largest or np.nan  # no vehicle was ever there
    columns = {
        "runs": len(results),
        "model": os.path.normpath(network.folder) if network.folder else "",
        "region": range(network.regions),
        "critical_veh": network.seen_critical,
        "share_of_veh": base,
        "most_share": states.max(axis=0) / base,
        "whole_run_rmse_share": np.sqrt((off**2).mean(axis=0)) / base,
        "whole_run_bias_share": off.mean(axis=0) / base,
    }
    ahead = predictions(network, list(map(observed, results)), scenario.scheme)
    return pd.DataFrame(columns).join(ahead.replace(np.inf, np.nan))


def prediction_table(rows: pd.DataFrame) -> str:
    """Return prediction errors as text, a line per strategy and demand."""
    lines = []
    for (demand, controller), group in rows.groupby(["demand", "controller"], sort=False):
        first = group.iloc[0]
        mean = {}
        for name, share in group.filter(like="rmse_share").mean().items():
            mean[name] = cell(100 * share, "{:.1f} %")
        line = {
            "demand": f"{demand:g}",
            "controller": controller,
            "runs": first["runs"],
            "model": Path(first["model"]).name,
            "most": cell(group["most_share"].max(), "{:.1f}"),
            "whole run": mean["whole_run_rmse_share"],
            "next interval": mean["next_interval_rmse_share"],
            "if nothing changed": mean["next_interval_persistence_rmse_share"],
            "later": f"{mean['ahead_rmse_share']} ({first['ahead_s']:g} s)",
            "if nothing changed ": mean["ahead_persistence_rmse_share"],
        }
        for name in SITUATIONS:
            errors = group[[f"{name}_rmse_veh", f"{name}_persistence_rmse_veh"]]
            model, as_now = np.sqrt((errors**2).mean())
            error = "-"
            if not np.isnan(model):
                error = f"{model:.0f} ({as_now:.0f}) veh"
            line[f"{name} (as now)"] = error
        lines.append(line)
    return text_table(lines, CAPTION)


def outflow_samples(network: RegionalModel, results: Sequence[Result]) -> Samples:
    """Return the MFD samples of each region.

    They are label -> accumulation (veh) and outflow (veh/s), (n, 2); see `samples_of_run`. The
    outflow of an interval is the one that the model's g gives. It consists of trips that ended in
    the region, and of transfers divided by u. In the model x_ii leaves at q x_ii and x_ij at
    u q x_ij, so q = outflow / (x_ii + u x_i,other).
    """
    runs = []
    for result in results:
        x = mean_inside(result)
        total = x.sum(axis=2)
        own = np.diagonal(x, axis1=1, axis2=2)
        outflow = regional_outflow(result, result.step)
        weight = own + np.minimum(result["perimeter"].max(axis=2), network.u_max) * (total - own)
        whole = outflow * total / np.maximum(weight, 1e-9)
        blocked = held_up(total, outflow, network.adjacency)
        runs.append(samples_of_run(total, whole, blocked))
    return joined(runs)
