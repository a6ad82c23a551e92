"""How far ahead the regional models prediction_errors the accumulations of finished runs, over all runs of a folder."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from cosim.evaluation import experiment
from cosim.evaluation.identify import observed
from cosim.evaluation.results import Finished
from nmfd.arrays import PerRegion
from nmfd.controllers.strategy import parse
from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel
from nmfd.model.scenario import Scenario
from nmfd.runs import files
from nmfd.runs.tables import text_table
from nmfd.studies import fit_quality

COLUMNS = (
    "demand",
    "controller",
    "runs",
    "model",
    "region",
    "critical_veh",
    "most_share",
    "next_interval_rmse_share",
    "next_interval_persistence_rmse_share",
    "ahead_s",
    "ahead_rmse_share",
    "ahead_persistence_rmse_share",
)
CAPTION = (
    "RMSE of the predicted accumulation, predicted from every recorded state under the recorded departures and "
    "controls, as a share of the region's critical accumulation, mean of the regions; if nothing changed: of the "
    "prediction that every region keeps what it holds; most: the largest accumulation "
    "of any region in any of the runs, as a share of its critical one"
)


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """How well one model foresees the runs of one strategy at one demand level.

    model: the folder of its network; critical: (R,) [veh]; most: (R,) [-], the largest accumulation in the runs, as a
    share of the critical one; errors: (2, R) [-], RMSE one control interval and `ahead` [s] ahead, as such a share;
    persistence: (2, R) [-], if nothing changed
    """

    demand: float
    controller: str
    runs: int
    model: Path | None
    critical: PerRegion
    most: PerRegion
    ahead: float
    errors: Float[np.ndarray, "2 R"]
    persistence: Float[np.ndarray, "2 R"]


def prediction_errors(found: Finished, model: Path | None = None) -> list[ModelError]:
    """Of every strategy at every demand level of the folder.

    model: the folder of a network, instead of that with which each controller plans. Raises InputError.
    """
    if found.changed:
        raise InputError(f"{found.path}: {found.changed}; run them again to compare them")
    return [
        _of(
            level.demand,
            controller,
            found.scenario,
            parse(controller).planning(found.scenario, model).network,
            [experiment.read_run(level.folder, controller, seed) for seed in rows["seed"]],
        )
        for level in found.levels
        for controller, rows in level.rows.groupby("controller", sort=False)
    ]


def _of(
    demand: float, controller: str, scenario: Scenario, network: RegionalModel, results: Sequence[experiment.Result]
) -> ModelError:
    seen = [observed(result) for result in results]
    found = fit_quality.predictions(
        network, seen, {"step": scenario.step, "substeps": scenario.substeps, "integrator": scenario.integrator}
    )
    critical = network.critical
    return ModelError(
        demand=demand,
        controller=controller,
        runs=len(results),
        critical=critical,
        model=network.folder and Path(os.path.normpath(network.folder)),
        most=np.max([run.accumulation.sum(axis=2).max(axis=0) for run in seen], axis=0) / critical,
        ahead=found.ahead,
        errors=found.model,
        persistence=found.persistence,
    )


def foresight_table(foresights: Sequence[ModelError]) -> str:
    """As text, one line per strategy and demand level."""
    return text_table(
        [
            {
                "demand": f"{one.demand:g}",
                "controller": one.controller,
                "runs": one.runs,
                "model": one.model.name if one.model else "",
                "most": f"{one.most.max():.1f}",
                "next interval": f"{100 * one.errors[0].mean():.1f} %",
                "if nothing changed": f"{100 * one.persistence[0].mean():.1f} %",
                "later": f"{100 * one.errors[1].mean():.1f} % ({one.ahead:g} s)",
                "if nothing changed ": f"{100 * one.persistence[1].mean():.1f} %",
            }
            for one in foresights
        ],
        CAPTION,
    )


def write_foresights(path: Path, foresights: Sequence[ModelError]) -> None:
    """COLUMNS as a table, one row per strategy, demand level and region."""
    rows = [
        (
            one.demand,
            one.controller,
            one.runs,
            one.model,
            region,
            one.critical[region],
            one.most[region],
            one.errors[0, region],
            one.persistence[0, region],
            one.ahead,
            one.errors[1, region],
            one.persistence[1, region],
        )
        for one in foresights
        for region in range(len(one.critical))
    ]
    files.write_table(path, pd.DataFrame(rows, columns=COLUMNS), float_format="%.6g")
