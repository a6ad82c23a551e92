"""How good the fit of every region is, and what is doubtful about it: said in tables, files and the report."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from nmfd.arrays import Points, StatesOverTime
from nmfd.model import identification
from nmfd.model.disturbance import LOOK
from nmfd.model.identification import Observed
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import files
from nmfd.runs.tables import text_table, wrapped

SPILLBACK = "held up by a neighbour"  # label of samples that the region's own MFD does not explain
SAMPLES = 10  # of a region: with fewer it is as good as empty, and keeps the MFD that it has
BINS = 12  # of accumulation, for the hysteresis
EXPLAINED = 0.3  # R2: below, the curve says hardly more than the mean outflow
FALL = 0.05  # of the largest outflow: if it falls less up to the jam accumulation, it does not fall
AHEAD = 900.0  # s, of the longer prediction that is judged
CORRECTED = "corrected: by what the model got wrong in the control intervals just before"
FEW, POOR, SHORT, ENDLESS, ALONE = "few samples", "R2", "not reached", "no falling branch", "one seed"
MEANINGS = {  # beginning of a doubt -> what it means, and what would help
    FEW: f"fewer than {SAMPLES} samples, the MFD stays what it was before; higher --levels would load the region",
    POOR: f"below {EXPLAINED:g} the curve explains hardly anything of the outflow, and whoever plans with it is "
    "misled; more --levels and --seeds, or other regions, may tell more",
    SHORT: "no loading run reached the critical accumulation, what lies beyond is a guess; give higher --levels, or "
    "take it that perimeter control has nothing to protect there",
    ENDLESS: "the fitted outflow hardly falls up to the jam accumulation, so nothing tells where congestion begins; "
    "give higher --levels",
    ALONE: "there is no held-out error, and what the model is worth in runs that it has not seen is unknown; give "
    "--seeds 2 or more",
}


@dataclass(frozen=True, kw_only=True)
class RegionFit:
    """How well the model of one region explains what was seen there.

    critical_veh, jam_veh, storage_veh, max_outflow_veh_s: of the model; samples: of the outflow; r2, hysteresis [-]:
    NaN where unknown; spread [-]: standard deviation of the samples round the curve, as a share of its maximum;
    most_share: the largest accumulation in any run, as a share of the critical one; doubts: each
    begins as one of MEANINGS
    """

    region: int
    name: str
    critical_veh: float
    jam_veh: float
    storage_veh: float
    max_outflow_veh_s: float
    samples: int
    r2: float
    spread: float
    hysteresis: float
    most_share: float
    doubts: tuple[str, ...]


def region_fits(
    network: RegionalModel,
    samples: Sequence[dict[str, Points]],
    accumulations: Sequence[StatesOverTime] = (),
    seeds: int = 2,
) -> list[RegionFit]:
    """One per region. samples: by region (model_validation.outflow_samples); accumulations: of the runs, (T+1, R, R)
    [veh] each; seeds: of the loading runs"""
    most = (
        np.max([state.sum(axis=2).max(axis=0) for state in accumulations], axis=0)
        if len(accumulations)
        else (np.array([cloud_most(cloud) for cloud in samples]))
    )
    found = []
    for region, (curve, cloud) in enumerate(zip(network.mfds, samples, strict=True)):
        points = own_points(cloud)
        residuals = points[:, 1] - curve.outflow(points[:, 0])
        explained, share = float("nan"), float(most[region] / curve.critical)
        if len(points) >= SAMPLES and points[:, 1].var() > 0:
            explained = float(1.0 - (residuals**2).mean() / points[:, 1].var())
        doubts = []
        if len(points) < SAMPLES:
            doubts.append(f"{FEW} ({len(points)})")
        elif not explained >= EXPLAINED:  # also where it is unknown
            doubts.append(f"{POOR} {explained:.2f}")
        if share < 1.0:
            doubts.append(f"{SHORT} ({100 * share:.0f} % of critical)")
        if np.isfinite(curve.jam) and curve.outflow(curve.jam) > (1.0 - FALL) * curve.capacity:
            doubts.append(f"{ENDLESS} (jam {curve.jam:.0f}, critical {curve.critical:.0f} veh)")
        if seeds < 2:
            doubts.append(ALONE)
        found.append(
            RegionFit(
                region=region,
                name=network.region_names[region],
                critical_veh=curve.critical,
                jam_veh=curve.jam,
                storage_veh=float("inf") if network.storage is None else float(network.storage[region]),
                max_outflow_veh_s=curve.capacity,
                samples=len(points),
                r2=explained,
                spread=float(np.sqrt((residuals**2).mean()) / curve.capacity) if len(points) else float("nan"),
                hysteresis=hysteresis(cloud),
                most_share=share,
                doubts=tuple(doubts),
            )
        )
    return found


def cloud_most(cloud: Mapping[str, Points]) -> float:
    """The largest accumulation of the samples [veh]."""
    return max((float(points[:, 0].max()) for points in cloud.values() if len(points)), default=0.0)


def own_points(cloud: Mapping[str, Points]) -> Points:
    """(n, 2): the samples that the region's own MFD explains."""
    return np.concatenate([points for label, points in cloud.items() if label != SPILLBACK])


def nearly_empty(samples: Sequence[Mapping[str, Points]]) -> list[int]:
    """The regions with too few samples to fit anything to."""
    return [region for region, cloud in enumerate(samples) if len(own_points(cloud)) < SAMPLES]


def hysteresis(cloud: Mapping[str, Points]) -> float:
    """How much larger the outflow is while loading than while unloading at the same accumulation, as a share of it [-].

    The mean over bins of accumulation with both, weighted by the outflow; NaN where there is none.
    """
    loading, unloading = (cloud.get(label, np.empty((0, 2))) for label in ("loading", "unloading"))
    most = max((part[:, 0].max() for part in (loading, unloading) if len(part)), default=0.0)
    means = np.full((2, BINS), np.nan)
    for row, part in zip(means, (loading, unloading), strict=True):
        number = np.minimum((BINS * part[:, 0] / max(most, 1e-9)).astype(int), BINS - 1)
        for n in range(BINS):
            if (number == n).sum() >= 3:
                row[n] = part[number == n, 1].mean()
    both = means[:, ~np.isnan(means).any(axis=0)]
    return float((both[0] - both[1]).sum() / both.mean(axis=0).sum()) if both.size else float("nan")


def fit_table(
    network: RegionalModel,
    samples: Sequence[dict],
    fits: Sequence[RegionFit] | None = None,
    known: Mapping[str, str] = MEANINGS,
) -> str:
    """Per region: the curve of the MFD, how well it explains the samples, their hysteresis, and what is doubtful; then
    what the doubts mean, as far as `known`."""
    fits = region_fits(network, samples) if fits is None else fits
    table = text_table(
        [
            {
                "region": f"{fit.region} {fit.name}",
                "critical [veh]": f"{fit.critical_veh:.0f}",
                "jam [veh]": f"{fit.jam_veh:.0f}",
                **({} if network.storage is None else {"storage [veh]": f"{fit.storage_veh:.0f}"}),
                "max outflow [veh/s]": f"{fit.max_outflow_veh_s:.3f}",
                "samples": fit.samples,
                "R2": f"{fit.r2:.2f}",
                "spread": f"{100 * fit.spread:.0f} %",
                "hysteresis": "-" if np.isnan(fit.hysteresis) else f"{100 * fit.hysteresis:.0f} %",
                "most / critical": f"{fit.most_share:.2f}",
                "WARNINGS": "; ".join(fit.doubts) or "none",
            }
            for fit in fits
        ]
    )
    lines = [table, *wrapped("\n".join(meanings([doubt for fit in fits for doubt in fit.doubts], known)))]
    if empty := nearly_empty(samples):
        left = ", ".join(f"{region} {network.region_names[region]}" for region in empty)
        lines.append(f"nearly empty in all loading runs: {left}; the MFD stays as it was there")
    return "\n".join(lines)


def meanings(doubts: Sequence[str], known: Mapping[str, str] = MEANINGS) -> list[str]:
    """What these doubts mean, each kind once."""
    return [
        f"WARNING, {kind}: {what}" for kind, what in known.items() if any(doubt.startswith(kind) for doubt in doubts)
    ]


@dataclass(frozen=True, kw_only=True)
class Predictions:
    """RMSE as shares of the critical accumulation, (2, R): one control interval and `ahead` [s] ahead, of the model, of
    the model corrected by its disturbance (nmfd.model.disturbance), NaN where it has none or no run is long enough, and
    of persistence, which says that nothing changes."""

    step: float
    ahead: float
    model: Float[np.ndarray, "2 R"]
    corrected: Float[np.ndarray, "2 R"]
    persistence: Float[np.ndarray, "2 R"]


def predictions(network: RegionalModel, runs: Sequence[Observed], scheme: dict) -> Predictions:
    """Of `network` in `runs`. scheme: step, substeps and integrator"""
    intervals = identification.intervals_within(AHEAD, scheme["step"], runs)
    model, law = identification.prediction_shares(network, runs, (1, intervals), **scheme), network.disturbance
    long_enough = law is not None and max(len(run.demand) for run in runs) >= intervals + LOOK
    return Predictions(
        step=scheme["step"],
        ahead=intervals * scheme["step"],
        model=model,
        corrected=identification.prediction_shares(network, runs, (1, intervals), law=law, **scheme)
        if long_enough
        else np.full_like(model, np.nan),
        persistence=identification.persistence_shares(network, runs, (1, intervals)),
    )


def prediction_table(network: RegionalModel, held_out: Sequence[Observed], scheme: dict) -> str:
    """RMSE of the accumulation one control interval and AHEAD seconds ahead, in runs that the fit did not see."""
    found = predictions(network, held_out, scheme)
    heads = [f"{ahead:g} s ahead" for ahead in (found.step, found.ahead)]
    columns = np.stack([part[n] for n in (0, 1) for part in (found.model, found.corrected, found.persistence)], axis=1)
    names = [f"{region} {name}" for region, name in enumerate(network.region_names)]
    return text_table(
        [
            dict(
                zip(
                    (
                        "region",
                        heads[0],
                        "corrected",
                        "if nothing changed",
                        heads[1],
                        "corrected ",
                        "if nothing changed ",
                    ),
                    (name, *map(percent, row)),
                    strict=True,
                )
            )
            for name, row in zip([*names, "mean"], [*columns, columns.mean(axis=0)], strict=True)
        ],
        "RMSE of the accumulation in percent of the critical one, in the runs of the last seed, by a fit without them; "
        f"{CORRECTED}; if nothing changed: of the prediction that every region keeps what it holds",
    )


def percent(share: float) -> str:
    """As text; "-" where it is unknown."""
    return "-" if np.isnan(share) else f"{100 * share:.1f} %"


def write_fits(path: Path, fits: Sequence[RegionFit], found: Predictions | None) -> None:
    """fit.csv: a row per region; found: in held-out runs, None without any."""
    rows = []
    for fit in fits:
        row = asdict(fit) | {"doubts": "; ".join(fit.doubts)}
        for part in ("model", "corrected", "persistence"):
            for n, when in enumerate(("next_interval", "ahead")):
                row[f"held_out_{when}_{part}_rmse_share"] = (
                    float("nan") if found is None else float(getattr(found, part)[n, fit.region])
                )
        rows.append(row | {"ahead_s": float("nan") if found is None else found.ahead})
    files.write_table(path, pd.DataFrame(rows), float_format="%.6g")
