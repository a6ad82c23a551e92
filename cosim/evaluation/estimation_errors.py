"""How good the estimate was that the controllers saw: tables and pictures of runs with measurement = "estimate"."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

from nmfd.model.regional_model import RegionalModel
from nmfd.runs import files, run_folder
from nmfd.runs.tables import text_columns
from nmfd.studies import plots
from nmfd.studies.traffic_states import OutflowOf
from nmfd.types import Result

COLUMNS = (
    "controller",
    "seed",
    "region",
    "name",
    "critical_veh",
    "mean_veh",
    "rmse_veh",
    "rmse_share",
    "bias_veh",
    "cell_rmse_veh",
)
CAPTION = (
    "estimate against exact accumulation of a region: RMSE, also as a share of the critical accumulation; bias > 0: "
    "too many; x_ij RMSE: of the single cells (region, destination) in which there were vehicles; mean over runs"
)


def errors(network: RegionalModel, trajectory: Result) -> list[dict]:
    """One row of COLUMNS per region, and one for all of them (region "all"): the mean over regions of the errors, as
    roots of mean squares."""
    exact, off = trajectory.accumulation, trajectory.observed - trajectory.accumulation
    used = (exact > 0).any(axis=0)
    rows = []
    for i, mfd in enumerate(network.mfds):
        total, cells = off[:, i].sum(axis=1), off[:, i][:, used[i]]
        rows.append(
            dict(
                zip(
                    COLUMNS,
                    (
                        trajectory.controller,
                        trajectory.seed,
                        i,
                        network.region_names[i],
                        mfd.critical,
                        float(exact[:, i].sum(axis=1).mean()),
                        _rms(total),
                        _rms(total) / mfd.critical,
                        float(total.mean()),
                        _rms(cells),
                    ),
                    strict=True,
                )
            )
        )
    numbers = pd.DataFrame(rows)
    together = {name: float(numbers[name].mean()) for name in ("critical_veh", "mean_veh", "bias_veh")}
    together |= {name: _rms(numbers[name]) for name in ("rmse_veh", "rmse_share")}
    whole = {
        "controller": trajectory.controller,
        "seed": trajectory.seed,
        "region": "all",
        "name": "mean of the regions",
        **together,
        "cell_rmse_veh": _rms(off[:, used]),
    }
    return [*rows, {name: whole[name] for name in COLUMNS}]


def write_errors(
    folder: Path, network: RegionalModel, trajectories: Sequence[Result], outflow: OutflowOf | None = None
) -> pd.DataFrame:
    """estimation.csv, and one picture per run that was controlled on estimates; nothing without such a run.

    outflow: what left every region of a run, for the picture (nmfd.studies.plots)
    """
    estimated = [trajectory for trajectory in trajectories if trajectory.estimated]
    rows = pd.DataFrame([row for trajectory in estimated for row in errors(network, trajectory)], columns=COLUMNS)
    if not estimated:
        return rows
    files.write_table(folder / "estimation.csv", rows)
    for trajectory in estimated:
        path = folder / f"estimate-{run_folder.run_name(trajectory.controller, trajectory.seed)}.png"
        if not path.exists():
            drawing, axes = plots.panels(network.regions)
            known = None if outflow is None else cache(outflow)
            for region, ax in enumerate(axes):
                plots.region_estimate(ax, network, region, trajectory, known)
            plots.legend_below(drawing, axes)
            plots.save(drawing, path)
    return rows


def error_table(rows: pd.DataFrame) -> str:
    """The errors as text: one line per controller and region, means over seeds."""
    numbers = ["critical_veh", "mean_veh", "rmse_veh", "rmse_share", "bias_veh", "cell_rmse_veh"]
    keys = ["controller", "region", "name"]
    shown = rows.astype({"region": str}).groupby(keys, sort=False)[numbers].mean().reset_index()
    for column in numbers:
        shown[column] = [
            f"{100 * value:.1f} %" if column == "rmse_share" else f"{value:.1f}" for value in shown[column]
        ]
    headings = ["controller", "region", "name", "critical", "mean", "RMSE", "of critical", "bias", "x_ij RMSE"]
    return text_columns(headings, shown.to_numpy().tolist(), CAPTION)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else 0.0
