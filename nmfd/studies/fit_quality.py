"""Quality of the fit of each region, and doubts about it, as tables and files."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from nmfd.arrays import PerRegion, Points, StatesOverTime
from nmfd.metrics import largest_accumulation
from nmfd.model import identification, mfd
from nmfd.model.identification import Observed
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import files
from nmfd.runs.tables import text_table, wrapped

Samples = Sequence[
    Mapping[str, Points]
]  # by region, label -> (n, 2) of accumulation [veh] and outflow [veh/s]
States = Sequence[StatesOverTime]  # accumulations of each run
SPILLBACK = "held up by a neighbour"  # label of samples that the region's own MFD does not explain
SAMPLES = 10  # of a region: with fewer it keeps its MFD
HYSTERESIS_BINS = 12  # of accumulation
EXPLAINED = 0.3  # R2 below which the curve explains hardly more than the mean outflow
FALL = (
    0.05  # of the largest outflow: a smaller fall up to the jam accumulation is no falling branch
)
AHEAD_S = 900.0  # of the longer prediction
CRITICAL_DENSITIES = 8.0, 60.0  # veh per lane-km, of cities
FEW, POOR, ENDLESS, ODD, ALONE = (
    "few samples",
    "R2",
    "no falling branch",
    "critical density",
    "one seed",
)
MEANINGS = {  # beginning of a doubt -> meaning and remedy
    FEW: f"fewer than {SAMPLES} samples, the MFD is unchanged; give a higher demand (cosim: --levels)",
    POOR: f"below {EXPLAINED:g} the curve explains hardly anything of the outflow and misleads controllers; give more "
    "data (cosim: --levels, --seeds), or other regions",
    ENDLESS: "the critical accumulation is above and was not seen; controllers use a guess from lanes; give a higher "
    "demand (cosim: --levels)",
    ODD: "outside {:g} to {:g} veh per lane-km, as no city has it; check regions, lanes and data".format(
        *CRITICAL_DENSITIES
    ),
    ALONE: "there is no held-out error; give --seeds 2 or more",
}
HELD_OUT = (
    "RMSE of accumulations, in percent of critical ones (where these were not seen, of the largest), in runs of the "
    "last seed, by a fit without them: "
)


def with_guesses(
    model: RegionalModel,
    samples: Samples,
    lane_km: PerRegion,
    accumulations: States = (),
    *,
    fastest: float = np.inf,
) -> RegionalModel:
    """Return `model` with `critical_above` where its curve hardly falls up to the largest
    accumulation.

    The curve is a guess from lanes (R,) [km] there, unless the region is nearly empty. fastest:
    largest rate of any vehicle [1/s]
    """
    empty, most, above, mfds = (
        nearly_empty(samples),
        _largest(samples, accumulations),
        {},
        list(model.mfds),
    )
    for n, curve in enumerate(model.mfds):
        if (
            n in empty
            or most[n] <= curve.critical
            or curve.outflow(most[n]) > (1.0 - FALL) * curve.capacity
        ):
            above[n] = float(most[n])
            if n not in empty:
                rate = fastest if model.exit_rates is None else fastest / model.exit_rates[n].max()
                mfds[n] = mfd.guess_beyond(
                    curve, mfd.JAM_DENSITY * lane_km[n], above[n], max_rate=rate
                )
    storage = (
        None if model.storage is None else np.maximum(model.storage, [curve.jam for curve in mfds])
    )
    return replace(model, mfds=tuple(mfds), storage=storage, critical_above=above)


def _largest(samples: Samples, accumulations: States) -> PerRegion:
    if len(accumulations):
        return largest_accumulation(accumulations)
    return np.array(
        [np.concatenate(list(cloud.values()))[:, 0].max(initial=0.0) for cloud in samples]
    )


def region_fits(
    network: RegionalModel,
    samples: Samples,
    accumulations: States = (),
    seeds: int = 2,
    lane_km: PerRegion | float = np.nan,
) -> pd.DataFrame:
    """Return the fit of each region, a row each.

    Columns: region, name; critical_veh or critical_above_veh, jam_veh, storage_veh,
        max_outflow_veh_s of the model;
    samples; r2; spread of samples around the curve, as a share of its maximum; hysteresis [-];
    most_share, the largest accumulation in any run over the critical one [-]; doubts, each of which
    begins with a key of MEANINGS. NaN where unknown.

    accumulations: (T+1, R, R) [veh]; seeds: of the loading runs; lane_km: (R,)
    """
    most, critical, rows = _largest(samples, accumulations), network.seen_critical, []
    density, dense = critical / lane_km, CRITICAL_DENSITIES
    for region, (curve, cloud) in enumerate(zip(network.mfds, samples, strict=True)):
        points, above = own_points(cloud), network.critical_above.get(region, np.nan)
        residuals, r2 = points[:, 1] - curve.outflow(points[:, 0]), np.nan
        if len(points) >= SAMPLES and points[:, 1].var() > 0:
            r2 = 1.0 - (residuals**2).mean() / points[:, 1].var()
        doubts = {
            f"{FEW} ({len(points)})": len(points) < SAMPLES,
            f"{POOR} {r2:.2f}": len(points) >= SAMPLES and not r2 >= EXPLAINED,  # NaN too
            f"{ENDLESS} (critical above {above:.0f} veh, not seen)": region
            in network.critical_above,
            f"{ODD} {density[region]:.3g} veh per lane-km": density[region] < dense[0]
            or density[region] > dense[1],
            ALONE: seeds < 2,
        }
        rows.append(
            {
                "region": region,
                "name": network.region_names[region],
                "critical_veh": critical[region],
                "critical_above_veh": above,
                "jam_veh": curve.jam,
                "storage_veh": np.inf if network.storage is None else network.storage[region],
                "max_outflow_veh_s": curve.capacity,
                "samples": len(points),
                "r2": r2,
                "spread": np.sqrt((residuals**2).mean()) / curve.capacity
                if len(points)
                else np.nan,
                "hysteresis": hysteresis(cloud),
                "most_share": most[region] / critical[region],
                "doubts": tuple(text for text, there in doubts.items() if there),
            }
        )
    return pd.DataFrame(rows)


def own_points(cloud: Mapping[str, Points]) -> Points:
    """Return the samples (n, 2) that the region's own MFD explains."""
    return np.concatenate([points for label, points in cloud.items() if label != SPILLBACK])


def nearly_empty(samples: Samples) -> list[int]:
    """Return the regions with too few samples for a fit."""
    return [region for region, cloud in enumerate(samples) if len(own_points(cloud)) < SAMPLES]


def hysteresis(cloud: Mapping[str, Points]) -> float:
    """Return the excess of outflow while loading over unloading at the same accumulation, as a
    share of it [-].

    Mean over bins of accumulation with both, weighted by outflow; NaN without such bins.
    """
    parts = [cloud.get(label, np.empty((0, 2))) for label in ("loading", "unloading")]
    most = np.concatenate(parts)[:, 0].max(initial=1e-9)
    numbers = [
        np.minimum((HYSTERESIS_BINS * part[:, 0] / most).astype(int), HYSTERESIS_BINS - 1)
        for part in parts
    ]
    bins = [
        n for n in range(HYSTERESIS_BINS) if all((number == n).sum() >= 3 for number in numbers)
    ]
    both = np.array(
        [
            [part[number == n, 1].mean() for n in bins]
            for part, number in zip(parts, numbers, strict=True)
        ]
    )
    return float((both[0] - both[1]).sum() / both.mean(axis=0).sum()) if bins else float("nan")


def fit_table(
    network: RegionalModel, fits: pd.DataFrame, known: Mapping[str, str] = MEANINGS
) -> str:
    """Return the fits as text, followed by the meanings of the doubts."""
    table = text_table(
        [
            {
                "region": f"{fit.region} {fit.name}",
                "critical [veh]": f"above {fit.critical_above_veh:.0f}"
                if np.isnan(fit.critical_veh)
                else f"{fit.critical_veh:.0f}",
                "jam [veh]": f"{fit.jam_veh:.0f}",
                **({} if network.storage is None else {"storage [veh]": f"{fit.storage_veh:.0f}"}),
                "max outflow [veh/s]": f"{fit.max_outflow_veh_s:.3f}",
                "samples": fit.samples,
                "R2": f"{fit.r2:.2f}",
                "spread": f"{100 * fit.spread:.0f} %",
                "hysteresis": "-" if np.isnan(fit.hysteresis) else f"{100 * fit.hysteresis:.0f} %",
                "most / critical": "-" if np.isnan(fit.most_share) else f"{fit.most_share:.2f}",
                "WARNINGS": "; ".join(fit.doubts) or "none",
            }
            for fit in fits.itertuples(index=False)
        ]
    )
    doubts = [doubt for doubts in fits["doubts"] for doubt in doubts]
    lines = [
        f"WARNING, {kind}: {text}"
        for kind, text in known.items()
        if any(d.startswith(kind) for d in doubts)
    ]
    return "\n".join([table, *wrapped("\n".join(lines))])


def predictions(network: RegionalModel, runs: Sequence[Observed], scheme: dict) -> pd.DataFrame:
    """Return the RMSE of predicted accumulations as shares of the critical ones [-], a row per
    region.

    Where a critical accumulation was not seen, it is the largest one that was.

    Columns: next_interval_rmse_share and ahead_rmse_share, of the regional model one interval and
        ahead_s [s] ahead;
    next_interval_persistence_rmse_share and ahead_persistence_rmse_share, of the prediction that
    nothing changes.

    scheme: step [s], substeps and integrator
    """
    largest = np.array(
        [network.critical_above.get(r, one) for r, one in enumerate(network.critical)]
    )
    ahead = min(max(1, round(AHEAD_S / scheme["step"])), max(len(run.demand) for run in runs))
    columns = {}
    for when, intervals in (("next_interval", 1), ("ahead", ahead)):
        errors = identification.prediction_errors(network, runs, intervals, **scheme)
        states = [run.accumulation.sum(axis=2) for run in runs]
        unchanged = np.concatenate([state[:-intervals] - state[intervals:] for state in states])
        for name, part in (("rmse_share", errors), ("persistence_rmse_share", unchanged)):
            columns[f"{when}_{name}"] = np.sqrt((part**2).mean(axis=0)) / largest
    return pd.DataFrame({**columns, "ahead_s": ahead * scheme["step"]})


def prediction_text(errors: pd.DataFrame, step: float) -> str:
    """Return the means of `predictions` in runs that the fit did not use, as text; step: control
    interval [s]."""
    means = (100.0 * errors.filter(like="rmse_share").mean()).map("{:.1f} %".format)
    whens = zip((step, errors["ahead_s"][0]), means[::2], means[1::2], strict=True)
    return HELD_OUT + ", ".join(
        f"{model} {when:g} s ahead (unchanged: {same})" for when, model, same in whens
    )


def write_fits(path: Path, fits: pd.DataFrame, held_out: pd.DataFrame | None = None) -> None:
    """Write fit.csv, a row per region; held_out: `predictions` in runs that the fit did not use."""
    errors = pd.DataFrame() if held_out is None else held_out.add_prefix("held_out_")
    files.write_table(
        path, fits.assign(doubts=fits["doubts"].map("; ".join)).join(errors), float_format="%.6g"
    )
