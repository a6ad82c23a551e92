"""The microsimulation against what the regional model predicts, for the same demand and the recorded controls."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from jaxtyping import Bool, Float

from cosim.evaluation import run_metrics
from cosim.sumo.arrays import Points, RegionCounts, Series
from nmfd import closed_loop
from nmfd.arrays import Adjacency
from nmfd.model.dynamics import advance, parameters
from nmfd.model.plant import NmfdPlant
from nmfd.model.scenario import Scenario
from nmfd.runs import files, run_folder
from nmfd.runs.tables import text_columns
from nmfd.studies import plots
from nmfd.studies.fit_quality import SPILLBACK
from nmfd.studies.traffic_states import model_outflow
from nmfd.types import Controls, Observation, Result

COLUMNS = (
    "region",
    "name",
    "critical_veh",
    "mean_veh",
    "rmse_veh",
    "rmse_share",
    "persistence_rmse_veh",
    "bias_veh",
    "next_interval_rmse_veh",
    "next_interval_rmse_share",
    "next_interval_persistence_rmse_veh",
)
COLLAPSED = 0.7  # of the largest outflow so far
CAPTION = (
    "RMSE, bias: of the accumulation that the regional model predicts for the whole run from its start [veh]; next "
    "interval: predicted one control interval ahead from every recorded state; if nothing changed: RMSE of the "
    "prediction that the region keeps what it holds, from the start or for one interval [veh]; bias > 0: the model "
    "holds too many"
)


class Replay:
    """The recorded controls of a trajectory, as a controller (nmfd.types.Controller)."""

    def __init__(self, trajectory: Result):
        """trajectory: with as many intervals as are to be controlled"""
        self.name, self._trajectory = trajectory.controller, trajectory

    def reset(self, seed: int = 0) -> None:
        """There is nothing to reset."""

    def act(self, observation: Observation) -> Controls:
        """The controls that were recorded for this control step, whatever is observed."""
        k = observation.step
        return Controls(perimeter=self._trajectory.perimeter[k], splits=self._trajectory.splits[k])


def predict(scenario: Scenario, result: Result) -> Result:
    """The regional model from the same start, under the departures and controls that the microsimulation recorded.

    Demand is what entered the streets, not what wished to: the backlog is none of the model's business here.
    """
    same = replace(
        scenario,
        steps=len(result.perimeter),
        demand=result["departures"] / scenario.step,
        measurement_std=0.0,
        faults=(),
    )
    trajectory = closed_loop.run(NmfdPlant(same), Replay(result), same, seed=result.seed)
    return trajectory.assign(plant="nmfd")


def predict_next(scenario: Scenario, result: Result, intervals: int = 1) -> Float[np.ndarray, "K R"]:
    """(T + 1 - intervals, R) [veh]: accumulations `intervals` ahead of every recorded state, by the regional model."""
    trajectory, steps = result, len(result.perimeter)
    x = torch.from_numpy(trajectory.accumulation[: steps + 1 - intervals])
    demand = torch.from_numpy(result["departures"] / scenario.step)
    perimeter, splits = torch.from_numpy(trajectory.perimeter), torch.from_numpy(trajectory.splits)
    p = parameters(scenario.network)
    for n in range(intervals):
        part = slice(n, n + len(x))
        x = advance(
            p,
            x,
            demand[part],
            perimeter[part],
            splits[part],
            scenario.step,
            integrator=scenario.integrator,
            substeps=scenario.substeps,
        )
    return x.sum(-1).numpy()


def errors(scenario: Scenario, result: Result, predicted: Result) -> list[dict]:
    """One row of COLUMNS per region, and one for all of them (region "all").

    rmse, bias: of the predicted accumulation over the whole run, model minus simulation; share: of the critical
    accumulation; next_interval: predicted from the recorded state one control interval before.
    """
    simulated = result.accumulation.sum(-1)
    whole = predicted.accumulation.sum(-1) - simulated
    ahead = predict_next(scenario, result) - simulated[1:]
    critical = scenario.network.critical
    rows = [
        _row(i, scenario.network.region_names[i], critical[i], simulated[:, i], whole[:, i], ahead[:, i])
        for i in range(scenario.network.regions)
    ]
    return [*rows, _row("all", "all regions", critical.sum(), simulated.sum(1), whole.sum(1), ahead.sum(1))]


def _row(
    region: int | str,
    name: str,
    critical: float,
    simulated: Float[np.ndarray, " S"],
    whole: Float[np.ndarray, " S"],
    ahead: Series,
) -> dict:
    rmse, next_rmse, still, next_still = (
        float(np.sqrt((part**2).mean())) for part in (whole, ahead, simulated[0] - simulated, np.diff(simulated))
    )
    return dict(
        zip(
            COLUMNS,
            (
                region,
                name,
                float(critical),
                float(simulated.mean()),
                rmse,
                rmse / critical,
                still,
                float(whole.mean()),
                next_rmse,
                next_rmse / critical,
                next_still,
            ),
            strict=True,
        )
    )


def outflow_samples(
    trajectories: Sequence[Result], records: Sequence[dict], u_max: float, region: int, adjacency: Adjacency
) -> dict[str, Points]:
    """MFD samples of one region: label -> (n, 2) of accumulation [veh] and outflow [veh/s].

    Labels: "loading" and "unloading", and SPILLBACK for intervals in which a neighbour's congestion, not the region's
    own, limited what could leave (`held_up`).

    Per control interval, the outflow that the model's g has to give: trips ended in the region and transfers out of
    it as counted, the transfers divided by the u of the interval where it was below the bound that is meant by the
    original programme. In the model x_ii leaves at q x_ii and x_ij at u q x_ij, so q = outflow / (x_ii + u x_i,other).
    """
    samples: dict[str, list[Points]] = {"loading": [], "unloading": [], SPILLBACK: []}
    for trajectory, record in zip(trajectories, records, strict=True):
        x = 0.5 * (trajectory.accumulation[1:] + trajectory.accumulation[:-1])
        total, own = x.sum(2), x[:, range(x.shape[1]), range(x.shape[1])]
        outflow = run_metrics.regional_outflow(record, trajectory.step)
        share = np.minimum(trajectory.perimeter[:, region].max(axis=1), u_max)
        weight = own[:, region] + share * (total - own)[:, region]
        points = np.stack([total[:, region], outflow[:, region] * total[:, region] / np.maximum(weight, 1e-9)], axis=1)
        rising = np.diff(trajectory.accumulation[:, region].sum(1)) >= 0
        seen, blocked = total[:, region] >= 5.0, held_up(total, outflow, adjacency)[:, region]
        samples["loading"].append(points[seen & ~blocked & rising])
        samples["unloading"].append(points[seen & ~blocked & ~rising])
        samples[SPILLBACK].append(points[seen & blocked])
    return {label: np.concatenate(clouds) for label, clouds in samples.items()}


def held_up(accumulation: RegionCounts, outflow: RegionCounts, adjacency: Adjacency) -> Bool[np.ndarray, "T R"]:
    """(T, R) bool: a neighbour that collapsed before the region did is collapsed in this interval.

    Collapsed: holding more vehicles (T, R) than when its outflow (T, R) was largest so far, and letting out less than
    COLLAPSED of that. Queues that spill back over a boundary lower the outflow of the region behind it; its own MFD
    is not to blame.
    """
    steps, regions = outflow.shape
    collapsed = np.zeros((steps, regions), dtype=bool)
    for i in range(regions):
        best = 0
        for k in range(steps):
            if outflow[k, i] >= outflow[best, i]:
                best = k
            collapsed[k, i] = (
                accumulation[k, i] > accumulation[best, i] and outflow[k, i] < COLLAPSED * outflow[best, i]
            )
    onset = np.where(collapsed.any(axis=0), collapsed.argmax(axis=0), steps)
    earlier = adjacency & (onset[None, :] < onset[:, None])
    return (collapsed[:, None, :] & earlier[None]).any(axis=2)


def error_table(rows: pd.DataFrame) -> str:
    """The errors as text."""
    shown = rows.copy()
    for column in (name for name in COLUMNS if name.endswith("_veh")):
        shown[column] = [f"{value:.1f}" for value in rows[column]]
    for column in ("rmse_share", "next_interval_rmse_share"):
        shown[column] = [f"{100 * value:.1f} %" for value in rows[column]]
    headings = [
        "region",
        "name",
        "critical",
        "mean",
        "RMSE",
        "of critical",
        "if nothing changed",
        "bias",
        "next interval RMSE",
        "of critical",
        "if nothing changed",
    ]
    return text_columns(headings, shown.to_numpy().tolist(), CAPTION)


def write_comparison(folder: Path, scenario: Scenario, result: Result) -> pd.DataFrame:
    """Compare, and add compare-<run>.csv and two pictures to the run folder; returns the rows of `errors`."""
    predicted = predict(scenario, result)
    rows = pd.DataFrame(errors(scenario, result, predicted), columns=COLUMNS)
    name = run_folder.run_name(result.controller, result.seed)
    files.write_table(folder / f"compare-{name}.csv", rows)
    drawing, axes = plots.panels(scenario.network.regions + 1)
    measured = run_metrics.regional_outflow(result, result.step)
    predicted_outflow = model_outflow(scenario.network)
    outflow = cache(lambda t: measured if t.plant == "sumo" else predicted_outflow(t))
    for region, ax in enumerate(axes[:-1]):
        plots.region_accumulation(ax, scenario.network, region, [result, predicted], outflow=outflow)
    plots.total_accumulation(axes[-1], [result.assign(backlog=np.zeros_like(result.backlog)), predicted])
    axes[-1].set_title("all regions", fontsize="medium")
    plots.legend_below(drawing, axes, columns=4)
    plots.save(drawing, folder / f"compare-{name}-accumulation.png")
    samples = [
        outflow_samples([result], [result], scenario.network.u_max, region, scenario.network.adjacency)
        for region in range(scenario.network.regions)
    ]
    plots.draw_mfds(folder / f"compare-{name}-mfd.png", scenario.network, samples)
    return rows
