"""Counts and occupancies of real detectors -> MFDs per region, what is doubtful about them -> network.toml.

Of every region and interval: the density is the occupancy of its detectors over the length that a vehicle and a loop
cover, the flow their mean flow, both weighted by the lane-kilometres that each detector stands for (Edie's definitions,
as far as loops know them). Times the lane-kilometres of the region they are accumulation n [veh] and production
P [veh km/h]; the outflow of the regional model is P over the mean trip length within the region (Geroliminis and
Daganzo, "Existence of urban-scale macroscopic fundamental diagrams", Transportation Research B 42, 2008).
"""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import ConvexHull, Delaunay, QhullError

from nmfd.arrays import Adjacency, Points
from nmfd.errors import InputError
from nmfd.model import detector_tables, mfd
from nmfd.model.detector_tables import SPEEDS
from nmfd.model.regional_model import NetworkTable, RegionalModel, load_network, network_toml
from nmfd.runs import config, files
from nmfd.runs.tables import wrapped
from nmfd.studies import fit_quality, plots
from nmfd.studies.settings import Measured

U_MIN, U_MAX = 0.1, 0.9  # bounds of the control, as in all networks here
STOP_LINE = 0.03  # km before a junction: a loop here sees queues first
FAR = 3.0  # times the median distance between neighbouring detectors: no boundary lies between
COVERAGE, BIASED, DAYS = 0.3, 0.5, 3  # shares of lane-kilometres; days: below, or above, it is doubtful
UNKNOWN, SMALL, LOOPS, ASSUMED, SINGLE = (
    "coverage unknown",
    "low coverage",
    "loops at stop lines",
    "trip length assumed",
    "days",
)
MEANINGS = {
    fit_quality.FEW: f"fewer than {fit_quality.SAMPLES} intervals were measured",
    fit_quality.POOR: f"below {fit_quality.EXPLAINED:g} the curve explains hardly anything of the outflow: streets "
    "that are not alike, too few detectors, or no MFD; other regions may have one",
    fit_quality.SHORT: "the critical accumulation was never reached: it and what lies beyond are extrapolated",
    fit_quality.ENDLESS: "no falling branch was measured, so where congestion begins is unknown: the accumulation "
    "called critical is hardly more than the largest that was seen",
    UNKNOWN: "all streets are taken to be those with detectors: accumulation and outflow are those of the monitored "
    "part; give lane_km with --about",
    SMALL: f"detectors stand for less than {100 * COVERAGE:g} % of the lane-kilometres, usually the main roads, and "
    "are taken for all",
    LOOPS: f"most loops lie within {1000 * STOP_LINE:g} m of a junction, where queues stand: the density comes out too "
    "high where a vehicle stands on them, too low between two",
    ASSUMED: "two thirds of the side of a square as large as the region: the outflow is as uncertain as that; give it "
    "with --trip-length or --about",
    SINGLE: f"fewer than {DAYS} days: how much the curve differs from day to day is unknown",
}
UNSAID = (
    "What such data do not say: which trips end in a region and which pass through (one trip length stands for all); "
    "vehicles on streets without detectors; the shares of drivers by destination and route (they cross the fewest "
    "boundaries); capacities of boundaries; which signals can be controlled; anything beyond the largest accumulation "
    "seen, where the outflow is kept constant. Demand and its pairs of regions belong into a scenario.toml."
)


@dataclass(frozen=True, kw_only=True)
class Sources:
    """The files. counts; detectors, regions, about: see nmfd.model.detector_tables, None where there is none
    adjacency: a csv file region,neighbour, or the network.toml of the same regions; None: neighbours by detectors
    city: of several in the tables; skip_bad: leave out rows with missing or impossible numbers
    """

    counts: Path
    detectors: Path | None = None
    regions: Path | None = None
    about: Path | None = None
    adjacency: Path | None = None
    city: str | None = None
    skip_bad: bool = False


@dataclass(frozen=True, kw_only=True)
class Identified:
    """What was measured, and the model made of it.

    network: with an MFD per region; samples: of every region, "loading" and "unloading" -> (n, 2) of accumulation [veh]
    and outflow [veh/s]; fits: how good they are; intervals: a row per region, day and interval; text: as the command
    prints it
    """

    network: RegionalModel
    samples: tuple[dict[str, Points], ...]
    fits: tuple[fit_quality.RegionFit, ...]
    intervals: pd.DataFrame
    text: str

    def to_frame(self) -> pd.DataFrame:
        """A row per region, day and interval: density_veh_km, flow_veh_h of a lane, reporting (share of the monitored
        lane-km), accumulation_veh, production_veh_km_h, outflow_veh_s."""
        return self.intervals


def identify(
    sources: Sources, measured: Measured, *, out: Path, name: str | None = None, force: bool = False
) -> Identified:
    """Fit an MFD to every region; write network.toml, mfd.png, samples.csv, fit.csv and identify.txt to `out`.

    name: of the network, that of the folder if None; force: replace a network.toml that is there.
    Raises InputError, before anything is written.
    """
    if (out / "network.toml").exists() and not force:
        raise InputError(f"{out / 'network.toml'}: is there already; choose another --out, or replace it with --force")
    rows, left = detector_tables.read_counts(sources.counts, city=sources.city, skip_bad=sources.skip_bad)
    detectors = detector_tables.read_detectors(
        sources.detectors, sources.regions, rows, sources.counts, city=sources.city
    )
    base = _given_network(sources.adjacency, detectors)
    regions = _ordered(set(detectors["region"])) if base is None else list(base.region_names)
    about = detector_tables.read_about(sources.about, regions)
    places = _places(detectors, about, regions)
    lane_km, coverage = _lane_km(detectors, about, regions, sources)
    trip_km, assumed = _trip_lengths(detectors, about, regions, measured)
    intervals = _intervals(rows, detectors, regions, measured).merge(
        pd.DataFrame({"region": regions, "lane_km": lane_km, "trip_km": trip_km}), on="region"
    )
    intervals["accumulation_veh"] = intervals["density_veh_km"] * intervals["lane_km"]
    intervals["production_veh_km_h"] = intervals["flow_veh_h"] * intervals["lane_km"]
    intervals["outflow_veh_s"] = intervals["production_veh_km_h"] / intervals.pop("trip_km") / 3600.0
    intervals = intervals.drop(columns="lane_km").sort_values(["region", "day", "interval"], ignore_index=True)
    _check_units(intervals, sources.counts, measured)
    clouds = [_clouds(intervals[intervals["region"] == region]) for region in regions]
    for region, days in zip(regions, clouds, strict=True):
        if sum(len(fit_quality.own_points(day)) for day in days) < fit_quality.SAMPLES:
            raise InputError(
                f"{sources.counts}: region {region} was measured in fewer than {fit_quality.SAMPLES} intervals with "
                f"{100 * measured.least_share:g} % of its detectors reporting; give more data, a lower --least-share, "
                "or join it to another region"
            )
    samples = tuple(
        {label: np.concatenate([day[label] for day in days]) for label in ("loading", "unloading")} for days in clouds
    )
    network = base or RegionalModel(
        name="",
        region_names=tuple(regions),
        positions=places,
        u_min=U_MIN,
        u_max=U_MAX,
        mfds=(),
        adjacency=_adjacency(sources.adjacency, detectors, regions),
    )
    network = replace(
        network,
        name=name or out.absolute().name,
        exit_rates=None,
        capacity=None,
        storage=None,
        placeholder=False,
        mfds=tuple(mfd.fit(*fit_quality.own_points(cloud).T) for cloud in samples),
    )
    if (network.hops < 0).any():
        i, j = np.argwhere(network.hops < 0)[0]
        raise InputError(
            f"{sources.adjacency or sources.counts}: region {regions[j]} cannot be reached from "
            f"{regions[i]}; give all pairs of neighbours, region,neighbour, with --adjacency"
        )
    days = rows["day"].nunique()
    fits = tuple(
        replace(fit, doubts=(*fit.doubts, *_doubts(part, share, length if assume else None, days)))
        for fit, part, share, length, assume in zip(
            fit_quality.region_fits(network, samples),
            (detectors[detectors["region"] == r] for r in regions),
            coverage,
            trip_km,
            assumed,
            strict=True,
        )
    )
    network = replace(network, doubts=tuple(fit.doubts for fit in fits))
    text = "\n".join(
        [
            fit_quality.fit_table(network, fits, MEANINGS),
            *_told(rows, left, coverage, trip_km),
            *wrapped(UNSAID),
        ]
    )
    found = Identified(network=network, samples=samples, fits=fits, intervals=intervals, text=text)
    _write(out, found, sources)
    return found


def _intervals(rows: pd.DataFrame, detectors: pd.DataFrame, regions: Sequence[str], measured: Measured) -> pd.DataFrame:
    """A row per region, day and interval in which enough of its detectors report: density_veh_km, flow_veh_h, both of a
    lane, and reporting [-]."""
    known = detectors["lane_km"].fillna(1.0)  # all unknown: alike
    rows = rows.assign(region=rows["detid"].map(detectors["region"]), weight=rows["detid"].map(known))
    rows = rows.assign(flow=rows["flow"] * rows["weight"], occ=rows["occ"] * rows["weight"])
    found = rows.groupby(["region", "day", "interval"])[["flow", "occ", "weight"]].sum().reset_index()
    found["reporting"] = found["weight"] / found["region"].map(known.groupby(detectors["region"]).sum())
    found["density_veh_km"] = found["occ"] / found["weight"] * 1000.0 / measured.vehicle_length
    found["flow_veh_h"] = found["flow"] / found["weight"]
    found = found[found["region"].isin(regions) & (found["reporting"] >= measured.least_share)]
    return found[["region", "day", "interval", "density_veh_km", "flow_veh_h", "reporting"]]


def _check_units(intervals: pd.DataFrame, path: Path, measured: Measured) -> None:
    """InputError where flow and occupancy give a speed that no city has."""
    total = intervals[["production_veh_km_h", "accumulation_veh"]].sum()
    speed = total.iloc[0] / max(total.iloc[1], 1e-9) / 3.6
    if not SPEEDS[0] <= speed <= SPEEDS[1]:
        raise InputError(
            f"{path}: flow and occ give a mean speed of {speed:.3g} m/s, with {measured.vehicle_length:g} m for a "
            "vehicle over a loop; expected flow in veh/h per lane, not per interval, and occ as a share, not percent"
        )


def _clouds(part: pd.DataFrame) -> list[dict[str, Points]]:
    """Of every day of a region, "loading" and "unloading" -> (n, 2) of accumulation [veh] and outflow [veh/s]."""
    found = []
    for _, day in part.groupby("day"):
        points = day[["accumulation_veh", "outflow_veh_s"]].to_numpy(dtype=float)
        rising = np.diff(points[:, 0], prepend=0.0) >= 0
        seen = points[:, 0] > 0
        found.append({"loading": points[seen & rising], "unloading": points[seen & ~rising]})
    return found


def _ordered(names: set[str]) -> list[str]:
    """Numbers by their value, then names."""
    return sorted(names, key=lambda name: (not name.isdecimal(), int(name) if name.isdecimal() else 0, name))


def _given_network(path: Path | None, detectors: pd.DataFrame) -> RegionalModel | None:
    """The model in a network.toml, if that is what says the adjacency. InputError unless it has the same regions, by
    name or by number; the detectors then have the names."""
    if path is None or path.suffix != ".toml":
        return None
    network = load_network(path.parent)
    names = {str(number): name for number, name in enumerate(network.region_names)}
    detectors["region"] = detectors["region"].map(
        lambda name: name if name in network.region_names else names.get(name, name)
    )
    there, own = set(detectors["region"]), set(network.region_names)
    if there != own:
        odd, other = (
            (min(there - own), "the network has no such region")
            if there - own
            else (min(own - there), "no detector lies there")
        )
        raise InputError(f"{path}: region {odd!r}: {other}; the regions must be the same, {', '.join(names.values())}")
    return network


def _places(detectors: pd.DataFrame, about: pd.DataFrame, regions: Sequence[str]) -> np.ndarray:
    """(R, 2) [m]: given, or the middle of the detectors; on a circle where neither is known."""
    middle = detectors.groupby("region")[["x_m", "y_m"]].mean().reindex(list(regions)).to_numpy()
    places = np.where(np.isnan(about[["x", "y"]].to_numpy()), middle, about[["x", "y"]].to_numpy())
    angle = 2.0 * np.pi * np.arange(len(regions)) / len(regions)
    return places if not np.isnan(places).any() else 1000.0 * np.stack([np.sin(angle), np.cos(angle)], axis=1)


def _lane_km(
    detectors: pd.DataFrame, about: pd.DataFrame, regions: Sequence[str], sources: Sources
) -> tuple[np.ndarray, np.ndarray]:
    """(R,) lane-kilometres [km], and the share of them that detectors stand for, NaN where unknown."""
    seen = detectors["lane_km"].groupby(detectors["region"]).sum(min_count=1).reindex(list(regions)).to_numpy()
    given = about["lane_km"].to_numpy()
    if (unknown := np.isnan(seen) & np.isnan(given)).any():
        region = regions[int(unknown.argmax())]
        raise InputError(
            f"{sources.counts}: how long the streets of region {region} are is unknown; give the length "
            "of the detectors' links with --detectors, or lane_km of every region with --about"
        )
    if (seen > 1.05 * given).any():
        n = int(np.nanargmax(seen / given))
        raise InputError(
            f"{sources.about}: region {regions[n]}: lane_km: {given[n]:g} is less than the {seen[n]:.4g} "
            "km that its detectors stand for; correct it, or length and lanes in the detectors' table"
        )
    return np.where(np.isnan(given), seen, given), seen / given


def _trip_lengths(
    detectors: pd.DataFrame, about: pd.DataFrame, regions: Sequence[str], measured: Measured
) -> tuple[np.ndarray, np.ndarray]:
    """(R,) mean trip lengths within the regions [km], and whether they were assumed."""
    given = about["trip_length"].fillna(np.nan if measured.trip_length is None else measured.trip_length)
    lengths = given.to_numpy(dtype=float) / 1000.0
    for n in np.flatnonzero(np.isnan(lengths)):
        points = detectors.loc[detectors["region"] == regions[n], ["x_m", "y_m"]].dropna().to_numpy()
        try:
            lengths[n] = 2.0 / 3.0 * np.sqrt(ConvexHull(points).volume) / 1000.0  # of a plane hull, its area
        except (QhullError, ValueError):
            raise InputError(
                f"the mean trip length in region {regions[n]} is unknown, and its detectors' positions do not tell its "
                "size; give --trip-length METRES, or a column trip_length with --about"
            ) from None
    return lengths, given.isna().to_numpy()


def _adjacency(path: Path | None, detectors: pd.DataFrame, regions: Sequence[str]) -> Adjacency:
    """(R, R) bool, both ways: as given, or where detectors of two regions are neighbours in the plane (Delaunay)."""
    if path is not None:
        return detector_tables.read_pairs(path, regions)
    adjacency = np.zeros((len(regions),) * 2, dtype=bool)
    if len(regions) == 1:
        return adjacency
    placed = detectors.dropna(subset=["x_m", "y_m"]).drop_duplicates(["x_m", "y_m"])
    points, own = placed[["x_m", "y_m"]].to_numpy(), pd.Index(regions).get_indexer(placed["region"])
    try:
        corners = Delaunay(points).simplices
    except (QhullError, ValueError):
        raise InputError(
            "which regions are adjacent is unknown, and the detectors have no positions (long, lat or x, "
            "y) that tell it; give a table region,neighbour with --adjacency"
        ) from None
    edges = np.unique(np.sort([pair for corner in corners for pair in combinations(corner, 2)], axis=1), axis=0)
    distance = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    for i, h in own[edges[distance <= FAR * np.median(distance)]]:
        adjacency[i, h] = adjacency[h, i] = i != h
    return adjacency


def _doubts(detectors: pd.DataFrame, coverage: float, assumed_km: float | None, days: int) -> list[str]:
    """What is doubtful about a region beside its fit."""
    near = (detectors["pos_km"] <= STOP_LINE).mean()
    return [
        text
        for text, there in (
            (UNKNOWN, np.isnan(coverage)),
            (f"{SMALL} {100 * coverage:.0f} %", coverage < COVERAGE),
            (f"{LOOPS} ({100 * near:.0f} %)", near > BIASED),
            (f"{ASSUMED} ({1000 * (assumed_km or 0.0):,.0f} m)", assumed_km is not None),
            (f"{SINGLE}: {days}", days < DAYS),
        )
        if there
    ]


def _told(rows: pd.DataFrame, left: Mapping[str, int], coverage: np.ndarray, trip_km: np.ndarray) -> list[str]:
    share = (
        "unknown"
        if np.isnan(coverage).all()
        else (f"{100 * np.nanmin(coverage):.0f} to {100 * np.nanmax(coverage):.0f} %")
    )
    return wrapped(
        f"{len(rows):,} rows of {rows['detid'].nunique()} detectors on {rows['day'].nunique()} days; left out: "
        f"{detector_tables.told(left)}; share of the lane-km with detectors: {share}; trip length within a region: "
        f"{1000 * trip_km.min():,.0f} to {1000 * trip_km.max():,.0f} m"
    )


def _write(out: Path, found: Identified, sources: Sources) -> None:
    text = network_toml(
        found.network, {}, f"Regional model: written by nmfd identify from {sources.counts.name}; see identify.txt."
    )
    config.checked(NetworkTable, tomllib.loads(text), out / "network.toml")  # names, say, may be none
    out.mkdir(parents=True, exist_ok=True)
    plots.draw_mfds(out / "mfd.png", found.network, found.samples)
    files.write_table(out / "samples.csv", found.intervals, float_format="%.6g")
    fit_quality.write_fits(out / "fit.csv", found.fits, None)
    files.write_text(out / "identify.txt", found.text + "\n")
    files.write_text(out / "network.toml", text)
