"""Errors of estimated states: tables and figures of runs with measurement = "estimate"."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from nmfd.model.regional_model import RegionalModel
from nmfd.runs import files
from nmfd.runs.tables import text_columns
from nmfd.studies import plots
from nmfd.types import Result

CAPTION = (
    "estimate against true accumulation of a region: RMSE, also as a share of the critical accumulation; bias > 0: "
    "too many; x_ij RMSE: of the cells (region, destination) with vehicles; mean over runs"
)
MEANS = ["critical_veh", "mean_veh", "rmse_veh", "rmse_share", "bias_veh", "cell_rmse_veh"]


def errors(network: RegionalModel, result: Result) -> list[dict]:
    """Return a row per region, and one for "all": means over regions, of errors as root mean squares."""
    exact, off = result.accumulation, result.observed - result.accumulation
    used = (exact > 0).any(axis=0)
    rows: list[dict] = []
    for i, critical in enumerate(network.critical):
        error, mean = off[:, i].sum(axis=1), float(exact[:, i].sum(axis=1).mean())
        values = (critical, mean, _rms(error), _rms(error) / critical, error.mean(), _rms(off[:, i][:, used[i]]))
        rows.append({"region": i, "name": network.region_names[i], **dict(zip(MEANS, map(float, values), strict=True))})
    table = pd.DataFrame(rows)
    whole = table[MEANS].mean().to_dict() | {name: _rms(table[name]) for name in ("rmse_veh", "rmse_share")}
    rows.append({"region": "all", "name": "mean of the regions", **whole, "cell_rmse_veh": _rms(off[:, used])})
    return [{"controller": result.controller, "seed": result.seed, **row} for row in rows]


def write_errors(folder: Path, network: RegionalModel, results: Sequence[Result]) -> pd.DataFrame:
    """Write estimation.csv and a figure per run that was controlled on estimates; nothing without such a run."""
    estimated = [result for result in results if result.estimated]
    rows = pd.DataFrame([row for result in estimated for row in errors(network, result)])
    if estimated:
        files.write_table(folder / "estimation.csv", rows)
    for result in estimated:
        path = folder / f"estimate-{files.run_name(result.controller, result.seed)}.png"
        if not path.exists():
            drawing, axes = plots.panels(network.regions)
            estimate = result.assign(accumulation=result.observed, plant="estimate")
            for region, ax in enumerate(axes):
                plots.region_accumulation(ax, network, region, [result, estimate])
            plots.legend_below(drawing, axes)
            plots.save(drawing, path)
    return rows


def error_table(rows: pd.DataFrame) -> str:
    """Return the errors as text, a line per controller and region, means over seeds."""
    keys = ["controller", "region", "name"]
    shown = rows.astype({"region": str}).groupby(keys, sort=False)[MEANS].mean().reset_index()
    for name in MEANS:
        percent = name == "rmse_share"
        shown[name] = [f"{100 * value:.1f} %" if percent else f"{value:.1f}" for value in shown[name]]
    headings = [*keys, "critical", "mean", "RMSE", "of critical", "bias", "x_ij RMSE"]
    return text_columns(headings, shown.to_numpy().tolist(), CAPTION)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else 0.0
