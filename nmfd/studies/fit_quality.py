"""Quality of the fit of each region, and doubts about it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from nmfd.arrays import PerRegion, Points, StatesOverTime
from nmfd.metrics import largest_accumulation
from nmfd.model import mfd
from nmfd.model.mfd import Held, OverTime
from nmfd.model.regional_model import Errors, HeldOut, RegionalModel
from nmfd.runs import files
from nmfd.runs.tables import cell, text_table, wrapped

if TYPE_CHECKING:
    from nmfd.model.identification import Observed

# By region: label -> samples (n, 2) of accumulation [veh] and outflow [veh/s].
Samples = Sequence[Mapping[str, Points]]
States = Sequence[StatesOverTime]  # accumulations of each run
SPILLBACK = "held up by a neighbour"  # label of samples that the region's own MFD does not explain
FEWEST_VEHICLES = 5.0  # in a region during an interval that counts as a sample
SAMPLES = 10  # of a region: with fewer it keeps its MFD
HYSTERESIS_BINS = 12  # of accumulation
FEWEST_IN_BIN = 3  # samples of either branch, of several runs
EXPLAINED = 0.3  # R2 below which the curve explains hardly more than the mean outflow
FALL = 0.05  # share of the largest outflow: a smaller fall up to the jam is no falling branch
AHEAD_S = 900.0  # of the longer prediction
CRITICAL_DENSITIES = 8.0, 60.0  # veh per lane-km, of cities

# Beginnings of the doubts about a region.
FEW = "few samples"
POOR = "R2"
ENDLESS = "no falling branch"
ODD = "critical density"
ALONE = "one seed"
MEANINGS = {  # beginning of a doubt -> meaning and remedy
    FEW: f"fewer than {SAMPLES} samples, the MFD is unchanged; give a higher demand (cosim: "
    "--levels)",
    POOR: f"below {EXPLAINED:g} the curve explains hardly anything of the outflow and misleads "
    "controllers; give more data (cosim: --levels, --seeds), or other regions",
    ENDLESS: "the critical accumulation is above and was not seen; controllers use a guess from "
    "lanes; give a higher demand (cosim: --levels)",
    ODD: f"outside {CRITICAL_DENSITIES[0]:g} to {CRITICAL_DENSITIES[1]:g} veh per lane-km, as no "
    "city has it; check regions, lanes and data",
    ALONE: "the held-out run has the trips of the others; give --seeds 2 or more",
}
HELD_OUT = (
    "RMSE of accumulations, in percent of critical ones (where these were not seen, of the "
    "largest), in runs that the model has not seen: "
)
SITUATIONS = ("flowing", "congested")  # no region beyond its critical accumulation, and else
VEHICLES = "{:.1f}"  # form of an error
AHEAD_CAPTION = (
    'RMSE in vehicles, and "as now": that of the prediction that nothing changes. Flowing: no '
    "region is beyond its critical accumulation (where that was not seen, the largest one)"
)


def with_guesses(
    model: RegionalModel,
    samples: Samples,
    lane_km: PerRegion,
    accumulations: States = (),
    *,
    fastest: PerRegion | float = np.inf,
) -> RegionalModel:
    """Return `model` with guesses where the data show no falling branch.

    Such a region has `critical_above`, and a curve from its lanes unless it is nearly empty.

    lane_km: lane-kilometres (km, (R,))
    accumulations: of each run (veh, (T+1, R, R)); without them the samples have the largest ones
    fastest: largest rate of any vehicle (1/s, (R,))
    """
    fastest = np.broadcast_to(fastest, model.regions)
    empty = nearly_empty(samples)
    most = _largest(samples, accumulations)
    above = {}
    mfds = list(model.mfds)
    for n, curve in enumerate(model.mfds):
        if n not in empty and falls(curve, most[n]):
            continue
        above[n] = float(most[n])
        if n in empty:
            continue
        rate = fastest[n]
        if model.exit_rates is not None:
            rate = fastest[n] / model.exit_rates[n].max()
        jam = mfd.JAM_DENSITY * lane_km[n]
        mfds[n] = mfd.guess_beyond(curve, jam, above[n], max_rate=rate)
    storage = model.storage
    if storage is not None:
        storage = np.maximum(storage, [curve.jam for curve in mfds])
    return replace(model, mfds=tuple(mfds), storage=storage, critical_above=above)


def falls(curve: mfd.Mfd, most: float) -> bool:
    """Return True if the outflow has fallen at `most` [veh]."""
    if most <= curve.critical:
        return False
    return curve.outflow(most) <= (1.0 - FALL) * curve.capacity


def _largest(samples: Samples, accumulations: States) -> PerRegion:
    """Return the largest accumulations (R,) [veh] in runs, or in samples."""
    if len(accumulations):
        return largest_accumulation(accumulations)
    largest = [np.concatenate(list(cloud.values()))[:, 0].max(initial=0.0) for cloud in samples]
    return np.array(largest)


def region_fits(
    network: RegionalModel,
    samples: Samples,
    accumulations: States = (),
    seeds: int = 2,
    lane_km: PerRegion | float = np.nan,
) -> pd.DataFrame:
    """Return the fit of each region, a row each; NaN where unknown.

    accumulations: of each run (veh, (T+1, R, R))
    seeds: number of seeds of the loading runs
    lane_km: lane-kilometres (km, (R,))

    Columns:

        region, name, critical_veh, critical_above_veh, jam_veh, storage_veh and
            max_outflow_veh_s: those of the model
        samples: their number
        r2: share of their variance that the curve explains
        spread: of samples around the curve, as a share of its maximum
        hysteresis: `hysteresis` (-)
        most_share: largest accumulation in any run over the critical one (-)
        doubts: texts, each of which begins with a key of MEANINGS
    """
    most = _largest(samples, accumulations)
    critical = network.seen_critical
    density = critical / lane_km
    rows = []
    for region, (curve, cloud) in enumerate(zip(network.mfds, samples, strict=True)):
        points = own_points(cloud)
        residuals = points[:, 1] - curve.outflow(points[:, 0])
        r2 = np.nan
        if len(points) >= SAMPLES and points[:, 1].var() > 0:
            r2 = 1.0 - (residuals**2).mean() / points[:, 1].var()
        spread = np.nan
        if len(points):
            spread = np.sqrt((residuals**2).mean()) / curve.capacity
        above = network.critical_above.get(region, np.nan)
        storage = np.inf if network.storage is None else network.storage[region]
        row = {
            "region": region,
            "name": network.region_names[region],
            "critical_veh": critical[region],
            "critical_above_veh": above,
            "jam_veh": curve.jam,
            "storage_veh": storage,
            "max_outflow_veh_s": curve.capacity,
            "samples": len(points),
            "r2": r2,
            "spread": spread,
            "hysteresis": hysteresis(cloud),
            "most_share": most[region] / critical[region],
            "doubts": _doubts(len(points), r2, above, density[region], seeds),
        }
        rows.append(row)
    return pd.DataFrame(rows)


def _doubts(samples: int, r2: float, above: float, density: float, seeds: int) -> tuple[str, ...]:
    """Return the doubts about a region.

    samples: number of samples
    above: accumulation above which the critical one is (veh), NaN if that was seen
    density: critical density (veh/lane-km), NaN if unknown
    """
    doubts = []
    if samples < SAMPLES:
        doubts.append(f"{FEW} ({samples})")
    elif not r2 >= EXPLAINED:  # NaN too
        doubts.append(f"{POOR} {r2:.2f}")
    if not np.isnan(above):
        doubts.append(f"{ENDLESS} (critical above {above:.0f} veh, not seen)")
    if density < CRITICAL_DENSITIES[0] or density > CRITICAL_DENSITIES[1]:
        doubts.append(f"{ODD} {density:.3g} veh per lane-km")
    if seeds < 2:
        doubts.append(ALONE)
    return tuple(doubts)


def own_points(cloud: Mapping[str, Points]) -> Points:
    """Return the samples (n, 2) that the region's own MFD explains."""
    return np.concatenate([points for label, points in cloud.items() if label != SPILLBACK])


def samples_of_run(inside: OverTime, outflow: OverTime, held_up: Held) -> Samples:
    """Return the samples of one run: "loading", "unloading", and SPILLBACK.

    inside, outflow: of T intervals (veh), (veh/s), both (T, R)
    held_up: True where a neighbour holds up the outflow, `mfd.held_up` (bool, (T, R))
    """
    seen = inside >= FEWEST_VEHICLES
    rising = np.diff(inside, axis=0, prepend=0.0) >= 0
    masks = {
        "loading": seen & ~held_up & rising,
        "unloading": seen & ~held_up & ~rising,
        SPILLBACK: seen & held_up,
    }
    points = np.stack([inside, outflow], axis=2)
    samples = []
    for region in range(inside.shape[1]):
        cloud = {label: points[mask[:, region], region] for label, mask in masks.items()}
        samples.append(cloud)
    return samples


def joined(runs: Sequence[Samples]) -> Samples:
    """Return the samples of several runs together."""
    samples = []
    for clouds in zip(*runs, strict=True):
        together = {}
        for label in clouds[0]:
            together[label] = np.concatenate([cloud[label] for cloud in clouds])
        samples.append(together)
    return samples


def outflow_critical(cloud: Mapping[str, Points]) -> float:
    """Return the critical accumulation of a curve through samples (veh).

    It is NaN if they are fewer than SAMPLES, or do not show that the outflow falls.
    """
    points = own_points(cloud)
    if len(points) >= SAMPLES:
        curve = mfd.fit(*points.T)
        if falls(curve, points[:, 0].max()):
            return curve.critical
    return float("nan")


def nearly_empty(samples: Samples) -> list[int]:
    """Return the regions with too few samples for a fit."""
    return [region for region, cloud in enumerate(samples) if len(own_points(cloud)) < SAMPLES]


def hysteresis(cloud: Mapping[str, Points], fewest: int = FEWEST_IN_BIN) -> float:
    """Return the excess of outflow while loading over unloading [-].

    It is a share of the outflow: the mean over bins of accumulation with samples of both, weighted
    by outflow; NaN without such bins. Above 0 the loop is clockwise (Gayah and Daganzo,
    Transportation Research B 45, 2011; Saberi and Mahmassani, Transportation Research Record 2315,
    2012).

    fewest: samples of either branch in a bin
    """
    nothing = np.empty((0, 2))
    loading = cloud.get("loading", nothing)
    unloading = cloud.get("unloading", nothing)
    most = np.concatenate([loading, unloading])[:, 0].max(initial=1e-9)
    loading_bin = _bin_numbers(loading[:, 0], most)
    unloading_bin = _bin_numbers(unloading[:, 0], most)
    pairs = []
    for n in range(HYSTERESIS_BINS):
        up = loading[loading_bin == n, 1]
        down = unloading[unloading_bin == n, 1]
        if min(len(up), len(down)) >= fewest:
            pairs.append((up.mean(), down.mean()))
    if not pairs:
        return float("nan")
    both = np.array(pairs).T
    return float((both[0] - both[1]).sum() / both.mean(axis=0).sum())


def _bin_numbers(accumulation: np.ndarray, most: float) -> np.ndarray:
    """Return the numbers of bins of accumulation up to `most` [veh]."""
    numbers = (HYSTERESIS_BINS * accumulation / most).astype(int)
    return np.minimum(numbers, HYSTERESIS_BINS - 1)


def fit_table(
    network: RegionalModel, fits: pd.DataFrame, known: Mapping[str, str] = MEANINGS
) -> str:
    """Return the fits as text, followed by the meanings of the doubts."""
    rows = []
    for fit in fits.itertuples(index=False):
        row = {
            "region": f"{fit.region} {fit.name}",
            "critical [veh]": _critical(fit),
            "jam [veh]": f"{fit.jam_veh:.0f}",
        }
        if network.storage is not None:
            row["storage [veh]"] = f"{fit.storage_veh:.0f}"
        row |= {
            "max outflow [veh/s]": f"{fit.max_outflow_veh_s:.3f}",
            "samples": fit.samples,
            "R2": f"{fit.r2:.2f}",
            "spread": f"{100 * fit.spread:.0f} %",
            "hysteresis": cell(100 * fit.hysteresis, "{:.0f} %"),
            "most / critical": cell(fit.most_share, "{:.2f}"),
            "WARNINGS": "; ".join(fit.doubts) or "none",
        }
        rows.append(row)
    lines = []
    for kind, meaning in known.items():
        if any(doubt.startswith(kind) for doubts in fits["doubts"] for doubt in doubts):
            lines.append(f"WARNING, {kind}: {meaning}")
    return "\n".join([text_table(rows), *wrapped("\n".join(lines))])


def short_table(network: RegionalModel, fits: pd.DataFrame, errors: pd.DataFrame) -> str:
    """Return fits and errors of predictions by region as one narrow table.

    errors: `predictions` in runs that the model has not seen
    """
    rows = []
    of_fit = fits.itertuples(index=False)
    for title, fit, (_, error) in zip(network.titles, of_fit, errors.iterrows(), strict=True):
        row = {
            "region": title,
            "critical": _critical(fit),
            "outflow": f"{fit.max_outflow_veh_s:.3f}",
            "R2": f"{fit.r2:.2f}",
            "hysteresis": cell(100 * fit.hysteresis, "{:.0f} %"),
        }
        for name in SITUATIONS:
            model = cell(error[f"{name}_rmse_veh"], VEHICLES)
            row[name] = f"{model} ({cell(error[f'{name}_persistence_rmse_veh'], VEHICLES)})"
        rows.append(row)
    return text_table(rows)


def doubt_lines(network: RegionalModel, fits: pd.DataFrame) -> list[str]:
    """Return a line for every region with doubts."""
    lines = []
    for title, doubts in zip(network.titles, fits["doubts"], strict=True):
        if doubts:
            lines.append(f"{title}: {'; '.join(doubts)}")
    return lines


def _critical(fit: Any) -> str:
    """Return the critical accumulation [veh] of a row of `region_fits`."""
    if np.isnan(fit.critical_veh):
        return f"above {fit.critical_above_veh:.0f}"
    return f"{fit.critical_veh:.0f}"


def predictions(
    network: RegionalModel,
    runs: "Sequence[Observed]",
    scheme: dict,
    critical: PerRegion | None = None,
) -> pd.DataFrame:
    """Return the RMSE of predicted accumulations, a row per region.

    scheme: step [s], substeps and integrator
    critical: critical accumulations (veh, (R,)); those of the network, or where they were not seen
        the largest ones, if None

    Columns:

        next_interval_rmse_share, ahead_rmse_share: errors of the regional model, one control
            interval and ahead_s [s] ahead, as shares of `critical`
        next_interval_persistence_rmse_share, ahead_persistence_rmse_share: errors of the
            prediction that nothing changes
        flowing_rmse_veh, flowing_persistence_rmse_veh: errors `ahead_s` ahead, of states in which
            no region is beyond its critical accumulation up to then (veh); NaN without any
        congested_rmse_veh, congested_persistence_rmse_veh: of all other states (veh)
        flowing_states, congested_states: their number
        flowing_total_share: predicted over observed vehicles in the flowing states (-)
    """
    from nmfd.model import identification  # torch takes two seconds

    if critical is None:
        critical = network.known_critical
    whole = np.where(critical > 0.0, critical, np.nan)  # 0 where no vehicle was ever seen
    longest = max(len(run.demand) for run in runs)
    ahead = min(max(1, round(AHEAD_S / scheme["step"])), longest)
    columns = {}
    for when, intervals in (("next_interval", 1), ("ahead", ahead)):
        errors = identification.prediction_errors(network, runs, intervals, **scheme)
        states = identification.windows(runs, intervals).states.sum(-1).numpy()
        unchanged = states[:, 0] - states[:, -1]
        columns[f"{when}_rmse_share"] = _rmse(errors) / whole
        columns[f"{when}_persistence_rmse_share"] = _rmse(unchanged) / whole
    flowing = (states <= critical).all(axis=(1, 2))
    for name, chosen in zip(SITUATIONS, (flowing, ~flowing), strict=True):
        columns[f"{name}_states"] = int(chosen.sum())
        columns[f"{name}_rmse_veh"] = _rmse(errors[chosen])
        columns[f"{name}_persistence_rmse_veh"] = _rmse(unchanged[chosen])
    there = states[flowing, -1].sum()
    predicted = there + errors[flowing].sum()
    columns["flowing_total_share"] = predicted / there if there else np.nan
    return pd.DataFrame({**columns, "ahead_s": ahead * scheme["step"]})


def held_out(errors: pd.DataFrame) -> HeldOut:
    """Return the means over regions of `predictions`."""
    found: dict[str, Errors | None] = {}
    for name in SITUATIONS:
        found[name] = None
        if errors[f"{name}_states"].iloc[0]:
            model = _rmse(errors[f"{name}_rmse_veh"].to_numpy())
            as_now = _rmse(errors[f"{name}_persistence_rmse_veh"].to_numpy())
            found[name] = Errors(float(model), float(as_now))
    return HeldOut(ahead=float(errors["ahead_s"].iloc[0]), **found)


def ahead_table(errors: pd.DataFrame, titles: Sequence[str]) -> str:
    """Return the errors of `predictions` by region as text."""
    rows = []
    for title, (_, error) in zip(titles, errors.iterrows(), strict=True):
        row = {"region": title}
        for name in SITUATIONS:
            row[name] = cell(error[f"{name}_rmse_veh"], VEHICLES)
            row[f"{name}, as now"] = cell(error[f"{name}_persistence_rmse_veh"], VEHICLES)
        rows.append(row)
    everywhere = held_out(errors)
    row = {"region": "all"}
    for name in SITUATIONS:
        model, as_now = getattr(everywhere, name) or (np.nan, np.nan)
        row[name] = cell(model, VEHICLES)
        row[f"{name}, as now"] = cell(as_now, VEHICLES)
    table = text_table([*rows, row], f"{everywhere.ahead:g} s ahead. {AHEAD_CAPTION}")
    share = errors["flowing_total_share"].iloc[0]
    if not np.isnan(share):
        table += f"\nPredicted over observed vehicles in flowing traffic: {share:.2f}"
    if everywhere.problem:
        table += f"\nWARNING: the model does not know: {everywhere.problem}"
    return table


def _rmse(errors: np.ndarray) -> PerRegion:
    """Return the root mean square of errors (n, R), NaN without any."""
    if not len(errors):
        return np.full(errors.shape[1], np.nan)
    return np.sqrt((errors**2).mean(axis=0))


def prediction_text(errors: pd.DataFrame, step: float) -> str:
    """Return the means of `predictions` as text.

    errors: in runs that the model has not seen
    step: control interval (s)
    """
    texts = []
    for when, seconds in (("next_interval", step), ("ahead", errors["ahead_s"][0])):
        model = 100.0 * errors[f"{when}_rmse_share"].mean()
        same = 100.0 * errors[f"{when}_persistence_rmse_share"].mean()
        texts.append(f"{model:.1f} % {seconds:g} s ahead (unchanged: {same:.1f} %)")
    return HELD_OUT + ", ".join(texts)


def write_fits(path: Path, fits: pd.DataFrame, held_out: pd.DataFrame | None = None) -> None:
    """Write fit.csv, a row per region.

    held_out: `predictions` in runs that the model has not seen
    """
    table = fits.assign(doubts=fits["doubts"].map("; ".join))
    if held_out is not None:
        table = table.join(held_out.add_prefix("held_out_"))
    files.write_table(path, table, float_format="%.6g")
