"""Robustness: the improvement by controllers made for a scenario when its demand comes out differently.

Every controller is made for the nominal scenario (MPC has its forecast, the policies their training) and meets
perturbed demand; its improvement is over no control in the same perturbed scenario.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from nmfd.controllers.strategy import Strategy
from nmfd.metrics import percent_change, summary
from nmfd.model.scenario import Scenario, perturbed
from nmfd.runs.tables import text_columns
from nmfd.studies import plots
from nmfd.studies.benchmark import REFERENCE, closed_loop_of, interval
from nmfd.types import Result

if TYPE_CHECKING:
    import pandas as pd

PLANT = "acyclic"
SIGMAS_VEH_S = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0)  # of the noise on the demand
KEPT = ("controller", "seed", "plant", "total_time_spent_veh_s", "final_accumulation_veh", "fallbacks")
CAPTION = (
    "improvement of total time spent over no-control in the same perturbed scenario [%], mean ± 95 % interval; "
    "trips: mean of all perturbed scenarios [veh]; sigma of the noise on the demand in veh/s"
)


def run_one(strategy: Strategy, seed: int, *, scenario: Scenario, sigma: float) -> Result:
    """Run one closed loop in perturbed demand; return its figures, without arrays.

    seed: number of the draw of the noise on demand and measurements
    """
    import xarray

    row = summary(closed_loop_of(strategy, seed, scenario=scenario, plant=PLANT, sigma=sigma))
    trips = scenario.step * float(perturbed(scenario, sigma, seed).demand.sum())
    facts = {"sigma_veh_per_s": sigma, "trips_veh": trips}
    return Result(xarray.Dataset(attrs=facts | {column: row[column] for column in KEPT}))


def improvements(rows: "pd.DataFrame", controller: str) -> dict[float, tuple[float, float]]:
    """Return sigma -> mean and 95 % half interval of the improvement of `controller` over no control [%]."""
    done = rows[rows["failure"] == ""]
    totals = done.pivot_table("total_time_spent_veh_s", ["sigma_veh_per_s", "seed"], "controller")
    gains: dict[float, list[float]] = {}
    for (sigma, _), own, reference in totals.reindex(columns=[controller, REFERENCE]).dropna().itertuples():
        gains.setdefault(sigma, []).append(-percent_change(own, reference))
    return {sigma: (math.fsum(values) / len(values), interval(values)) for sigma, values in gains.items()}


def draw(folder: Path, rows: "pd.DataFrame") -> None:
    """Draw the improvement over sigma as robustness.png in `folder`."""
    drawing = plots.figure(8.0, 4.8)
    ax = drawing.subplots()
    ax.axhline(0.0, color=plots.COLOURS[REFERENCE], linewidth=1.0)
    plots.with_intervals(ax, {name: improvements(rows, name) for name in _compared(rows)})
    ax.set(xlabel="standard deviation of the noise on the demand [veh/s]", ylabel="total time spent saved [%]")
    plots.legend_below(drawing, [ax])
    plots.save(drawing, folder / "robustness.png")


def improvement_table(rows: "pd.DataFrame") -> str:
    """Return the improvements as text: one line per controller, one column per sigma."""
    reference = rows[(rows["controller"] == REFERENCE) & (rows["failure"] == "")]
    trips = reference.groupby("sigma_veh_per_s")["trips_veh"].mean()
    lines = [["trips", *(f"{total:,.0f}" for total in trips)]]
    for name in _compared(rows):
        gains = improvements(rows, name)
        cells = {sigma: f"{mean:.1f} ± {half:.1f}" for sigma, (mean, half) in gains.items() if not math.isnan(mean)}
        lines.append([name, *(cells.get(sigma, "-") for sigma in trips.index)])
    return text_columns(["sigma", *(f"{sigma:g}" for sigma in trips.index)], lines, CAPTION)


def _compared(rows: "pd.DataFrame") -> list[str]:
    done = rows[rows["failure"] == ""]
    return [name for name in done["controller"].unique() if name != REFERENCE]
