"""Identification of MFDs per region from counts and occupancies of real detectors, as network.toml.

Density of a region and interval: occupancy of its detectors over the length of a vehicle and a
loop; flow: their mean flow; both weighted by the lane-kilometres of each detector (Edie's
definitions). Times the lane-kilometres of the
region: accumulation [veh] and production [veh km/h]; production over the mean trip length within
    the region: outflow
(Geroliminis and Daganzo, Transportation Research B 42, 2008).
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
from nmfd.model import detector_doubts, detector_tables, mfd
from nmfd.model.detector_tables import VEHICLE_LENGTH_M
from nmfd.model.regional_model import NetworkTable, RegionalModel, network_toml
from nmfd.runs import config, files
from nmfd.runs.tables import wrapped
from nmfd.studies import fit_quality, plots

U_MIN, U_MAX = 0.1, 0.9  # bounds of the control
LEAST_REPORTING = (
    0.5  # share of a region's detectors, by lane-kilometres, that must report in an interval
)
STOP_LINE_KM = 0.03  # before a junction, where queues stand
FAR = 3.0  # times the median distance between neighbouring detectors: no boundary lies between
LEAST_COVERAGE, BIASED_SHARE, LEAST_DAYS = 0.3, 0.5, 3
LEAST_INTERVALS = 100  # of a region: a rush hour alone has fewer
UNKNOWN, SMALL, LOOPS = "coverage unknown", "low coverage", "loops at stop lines"
ASSUMED, SINGLE, LEFT = "trip length assumed", "days", "detectors left out"
SHORT, MISCOUNT = "intervals", "odd counts"
MEANINGS = {
    **fit_quality.MEANINGS,
    UNKNOWN: "accumulation and outflow are those of links with detectors; give lane_km with --about",
    SMALL: f"detectors stand for less than {100 * LEAST_COVERAGE:g} % of the lane-kilometres, usually the main roads",
    LOOPS: f"most loops lie within {1000 * STOP_LINE_KM:g} m of a junction, where standing queues bias the density",
    ASSUMED: "two thirds of the side of a square as large as the region; give it with --trip-length or --about",
    LEFT: "their counts cannot be right, see below; lane-kilometres stand for the links of the others",
    SHORT: f"fewer than {LEAST_INTERVALS}: the curve may be that of one rush hour only",
    MISCOUNT: "detectors whose flow does not fit their occupancy, see below; they bias the curve",
    SINGLE: f"fewer than {LEAST_DAYS} days: the difference between days is unknown",
}
UNKNOWN_PARTS = (
    "Not in such data: which trips end in a region; vehicles on links without detectors; split ratios (vehicles cross "
    "the fewest boundaries); capacities of boundaries; controlled signals; anything beyond the largest accumulation, "
    "where the outflow is constant or a guess. Demand belongs into a scenario.toml."
)


@dataclass(frozen=True, kw_only=True)
class Identified:
    """Identified network and the data behind it.

    fits: a row per region (fit_quality.region_fits); text: report
    intervals: a row per region, day and interval, with density_veh_km, flow_veh_h (per lane),
        reporting (share of the monitored lane-km), accumulation_veh, production_veh_km_h and
        outflow_veh_s
    """

    network: RegionalModel
    fits: pd.DataFrame
    intervals: pd.DataFrame
    text: str


def identify(
    counts: Path | str,
    *,
    out: Path | str,
    detectors: Path | str | None = None,
    regions: Path | str | None = None,
    about: Path | str | None = None,
    adjacency: Path | str | None = None,
    city: str | None = None,
    skip_bad: bool = False,
    trip_length: float | None = None,
) -> Identified:
    """Fit an MFD to each region; write network.toml, mfd.png, samples.csv, fit.csv and
    identify.txt.

        >>> identified = nmfd.identify("counts.csv", detectors="detectors.csv", trip_length=1500.0, out="mine")
        >>> (len(identified.fits), identified.intervals["region"].nunique()) == (identified.network.regions,) * 2
        True

    counts, detectors, regions, about: tables (nmfd.model.detector_tables)
    out: folder of the network, whose name it gets
    adjacency: csv file region,neighbour; None: by the detectors' positions
    city: of several in the tables
    skip_bad: leave out doubled rows and those with missing or impossible numbers
    trip_length: mean trip length within a region [m]; None: assumed from the size of the region

    Raises InputError, before anything is written.
    """
    out, counts = Path(out), Path(counts)
    paths = [
        None if file is None else Path(file) for file in (detectors, regions, about, adjacency)
    ]
    if trip_length is not None and not 10.0 <= trip_length <= 1e5:
        raise InputError(f"--trip-length: {config.got('a number from 10 to 100000', trip_length)}")
    if (out / "network.toml").exists():
        raise InputError(f"{out / 'network.toml'}: exists; choose another --out")
    rows, left = detector_tables.read_counts(counts, city=city, skip_bad=skip_bad)
    stations = detector_tables.read_detectors(paths[0], paths[1], rows, counts, city=city)
    names = sorted(
        set(stations["region"]), key=lambda name: name.rjust(9) if name.isdecimal() else name
    )
    speed = rows["flow"].sum() * VEHICLE_LENGTH_M / 3600.0 / max(rows["occ"].sum(), 1e-9)
    if not detector_tables.SPEEDS_M_S[0] <= speed <= detector_tables.SPEEDS_M_S[1]:
        what = f"a mean speed of {speed:.3g} m/s, with {VEHICLE_LENGTH_M:g} m for a vehicle over a loop"
        expected = "flow in veh/h per lane, not per interval, and occ as a share, not percent"
        raise InputError(f"{counts}: flow and occ give {what}; expected {expected}")
    read, days, count = len(rows), rows["day"].nunique(), rows["detid"].nunique()
    rows, faulty = detector_tables.screened(rows, stations["region"])
    odd = detector_doubts.miscounting(rows, stations["region"])
    stations = stations.drop(
        list(faulty.get(detector_tables.SUM, ()))
    )  # its lanes are those of the others
    used = stations[stations.index.isin(rows["detid"])]
    broken = [
        f"detectors left out, {reason}: "
        + ", ".join(
            name if name not in used.index else f"{name} ({n} of {days} days)"
            for name, n in of.items()
        )
        for reason, of in faulty.items()
    ]
    for own, factors in odd.items():
        shown = ", ".join(f"{name} ({factor:.2f})" for name, factor in factors.items())
        what = "flow of detectors over that of others at the same occupancy"
        broken.append(f"region {own}: {what}: {shown}")
    table = detector_tables.read_about(paths[2], names)
    lane_km, coverage = _lane_km(stations, used, table, paths[2] or counts)
    trip_km, assumed = _trip_lengths(stations, table, trip_length)
    intervals = _intervals(rows, used)
    number = intervals["region"].map(names.index)
    intervals["accumulation_veh"] = intervals["density_veh_km"] * lane_km[number]
    intervals["production_veh_km_h"] = intervals["flow_veh_h"] * lane_km[number]
    intervals["outflow_veh_s"] = intervals["production_veh_km_h"] / trip_km[number] / 3600.0
    samples = [_cloud(intervals[intervals["region"] == region]) for region in names]
    for region in fit_quality.nearly_empty(samples):
        raise InputError(
            f"{counts}: region {names[region]} was measured in fewer than {fit_quality.SAMPLES} intervals with "
            f"{100 * LEAST_REPORTING:g} % of its detectors reporting; give more data, or join it to another region"
            + "".join(f"; {line}" for line in broken)
        )
    network = RegionalModel(
        name=out.absolute().name,
        region_names=tuple(names),
        positions=_positions(stations, table),
        adjacency=_adjacency(paths[3], stations, names),
        mfds=tuple(mfd.fit(*fit_quality.own_points(cloud).T) for cloud in samples),
        u_min=U_MIN,
        u_max=U_MAX,
    )
    if (network.hops < 0).any():
        i, j = np.argwhere(network.hops < 0)[0]
        remedy = "give all pairs of neighbours, region,neighbour, with --adjacency"
        raise InputError(
            f"{adjacency or counts}: region {names[j]} cannot be reached from {names[i]}; {remedy}"
        )
    network = fit_quality.with_guesses(network, samples, lane_km)
    fits = fit_quality.region_fits(network, samples, lane_km=lane_km)
    lengths = np.where(assumed, trip_km, np.nan)
    fits["doubts"] = [
        (
            *doubts,
            *_doubts(stations[stations["region"] == region], used, coverage[n], lengths[n], days),
            *_sample_doubts((intervals["region"] == region).sum(), len(odd.get(region, ()))),
        )
        for n, (region, doubts) in enumerate(zip(names, fits["doubts"], strict=True))
    ]
    network = replace(network, doubts=tuple(fits["doubts"]))
    share = (
        "unknown"
        if np.isnan(coverage).all()
        else f"{np.nanmin(coverage):.0%} to {np.nanmax(coverage):.0%}"
    )
    facts = f"{read:,} rows of {count} detectors on {days} days; left out: {detector_tables.omitted(left)}; "
    facts += f"share of the lane-km with detectors: {share}; trip length within a region: "
    facts += f"{1000 * trip_km.min():,.0f} to {1000 * trip_km.max():,.0f} m"
    notes = wrapped("\n".join([*(f"WARNING, {line}" for line in broken), facts, UNKNOWN_PARTS]))
    report = "\n".join([fit_quality.fit_table(network, fits, MEANINGS), *notes])
    text = network_toml(
        network,
        {},
        f"Regional model: written by nmfd identify from {counts.name}; see identify.txt.",
    )
    config.checked(NetworkTable, tomllib.loads(text), out / "network.toml")
    out.mkdir(parents=True, exist_ok=True)
    plots.draw_mfds(out / "mfd.png", network, samples)
    files.write_table(out / "samples.csv", intervals, float_format="%.6g")
    fit_quality.write_fits(out / "fit.csv", fits)
    files.write_text(out / "identify.txt", report + "\n")
    files.write_text(out / "network.toml", text)
    return Identified(network=network, fits=fits, intervals=intervals, text=report)


def _intervals(rows: pd.DataFrame, detectors: pd.DataFrame) -> pd.DataFrame:
    """Return density_veh_km, flow_veh_h (per lane) and reporting [-] by region, day and
    interval."""
    weights = detectors["lane_km"].fillna(1.0)
    rows = rows.assign(
        region=rows["detid"].map(detectors["region"]), weight=rows["detid"].map(weights)
    )
    rows = rows.assign(flow=rows["flow"] * rows["weight"], occ=rows["occ"] * rows["weight"])
    table = (
        rows.groupby(["region", "day", "interval"])[["flow", "occ", "weight"]].sum().reset_index()
    )
    table["reporting"] = table["weight"] / table["region"].map(
        weights.groupby(detectors["region"]).sum()
    )
    table["density_veh_km"] = table["occ"] / table["weight"] * 1000.0 / VEHICLE_LENGTH_M
    table["flow_veh_h"] = table["flow"] / table["weight"]
    table = table[table["reporting"] >= LEAST_REPORTING].sort_values(
        ["region", "day", "interval"], ignore_index=True
    )
    return table[["region", "day", "interval", "density_veh_km", "flow_veh_h", "reporting"]]


def _cloud(part: pd.DataFrame) -> dict[str, Points]:
    """Return "loading" and "unloading" -> (n, 2) of accumulation [veh] and outflow [veh/s] of a
    region, by days."""
    rising = part.groupby("day")["accumulation_veh"].diff().fillna(0.0) >= 0
    points, occupied = (
        part[["accumulation_veh", "outflow_veh_s"]].to_numpy(dtype=float),
        part["accumulation_veh"] > 0,
    )
    return {"loading": points[occupied & rising], "unloading": points[occupied & ~rising]}


def _positions(detectors: pd.DataFrame, about: pd.DataFrame) -> np.ndarray:
    """Return (R, 2) [m]: given, or the middle of the detectors; on a circle if neither is known."""
    middle = detectors.groupby("region")[["x_m", "y_m"]].mean().reindex(about.index).to_numpy()
    places = np.where(np.isnan(about[["x", "y"]].to_numpy()), middle, about[["x", "y"]].to_numpy())
    angle = 2.0 * np.pi * np.arange(len(about)) / len(about)
    return (
        places
        if not np.isnan(places).any()
        else 1000.0 * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    )


def _lane_km(
    detectors: pd.DataFrame, used: pd.DataFrame, about: pd.DataFrame, where: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Return lane-kilometres (R,) and the share of them with detectors in use (R,), NaN where
    unknown."""
    in_use = (
        used["lane_km"]
        .groupby(used["region"])
        .sum()
        .reindex(about.index, fill_value=0.0)
        .to_numpy()
    )
    covered = (
        detectors["lane_km"]
        .groupby(detectors["region"])
        .sum(min_count=1)
        .reindex(about.index)
        .to_numpy()
    )
    total = about["lane_km"].to_numpy()
    if (unknown := np.isnan(covered) & np.isnan(total)).any():
        remedy = "give the length of the detectors' links with --detectors, or lane_km of every region with --about"
        raise InputError(
            f"{where}: the lane-kilometres of region {about.index[unknown][0]} are unknown; {remedy}"
        )
    if (covered > 1.05 * total).any():
        n = int(np.nanargmax(covered / total))
        what = f"lane_km: {total[n]:g} is less than the {covered[n]:.4g} km of its detectors"
        remedy = "correct it, or length and lanes in the detectors' table"
        raise InputError(f"{where}: region {about.index[n]}: {what}; {remedy}")
    return np.where(np.isnan(total), covered, total), in_use / total


def _trip_lengths(
    detectors: pd.DataFrame, about: pd.DataFrame, trip_length: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean trip lengths within the regions (R,) [km], and which are assumed (R,)."""
    lengths = (
        about["trip_length"]
        .fillna(np.nan if trip_length is None else trip_length)
        .to_numpy(dtype=float)
        / 1000.0
    )
    assumed = np.isnan(lengths)
    for n in np.flatnonzero(assumed):
        points = (
            detectors.loc[detectors["region"] == about.index[n], ["x_m", "y_m"]].dropna().to_numpy()
        )
        try:
            lengths[n] = (
                2.0 / 3.0 * np.sqrt(ConvexHull(points).volume) / 1000.0
            )  # volume of a plane hull: its area
        except (QhullError, ValueError):
            what = "the mean trip length is unknown and cannot be assumed without positions"
            remedy = "give --trip-length METRES, or a column trip_length with --about"
            raise InputError(f"region {about.index[n]}: {what}; {remedy}") from None
    return lengths, assumed


def _adjacency(path: Path | None, detectors: pd.DataFrame, regions: Sequence[str]) -> Adjacency:
    """Return (R, R) bool: given, or regions with detectors that are neighbours in the plane
    (Delaunay)."""
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
        what = "adjacency is unknown without detector positions (long, lat or x, y)"
        raise InputError(f"{what}; give a table region,neighbour with --adjacency") from None
    edges = np.unique(
        np.sort([pair for corner in corners for pair in combinations(corner, 2)], axis=1), axis=0
    )
    distance = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    for i, h in own[edges[distance <= FAR * np.median(distance)]]:
        adjacency[i, h] = adjacency[h, i] = i != h
    return adjacency


def _sample_doubts(intervals: int, odd: int) -> list[str]:
    """Return doubts about the samples of a region; odd: detectors with odd counts."""
    doubts = []
    if intervals < LEAST_INTERVALS:
        doubts.append(f"{SHORT}: {intervals}")
    if odd:
        doubts.append(f"{MISCOUNT}: {odd} detectors")
    return doubts


def _doubts(
    detectors: pd.DataFrame, used: pd.DataFrame, coverage: float, assumed_km: float, days: int
) -> list[str]:
    """Return the doubts about a region beside those of its fit; assumed_km: NaN unless assumed."""
    broken = (~detectors.index.isin(used.index)).sum()
    near = (detectors["pos_km"] <= STOP_LINE_KM).mean()
    doubts: Mapping[str, bool] = {
        UNKNOWN: np.isnan(coverage),
        f"{SMALL} {100 * coverage:.0f} %": coverage < LEAST_COVERAGE,
        f"{LOOPS} ({100 * near:.0f} %)": near > BIASED_SHARE,
        f"{ASSUMED} ({1000 * assumed_km:,.0f} m)": not np.isnan(assumed_km),
        f"{SINGLE}: {days}": days < LEAST_DAYS,
        f"{LEFT}: {broken} of {len(detectors)}": broken > 0,
    }
    return [text for text, there in doubts.items() if there]
