"""Identification of MFDs per region from real detectors.

They give counts and occupancies. `load` reads their tables, `fit` fits a network, and
`Identified.write` writes its network.toml.

Density of a region and interval: occupancy of its detectors over the length of a vehicle and a
loop. Flow: their mean flow. Both are weighted by the lane-kilometres of each detector (Edie's
definitions). Times the lane-kilometres of the region they give accumulation [veh] and production
[veh km/h]; production over the mean trip length within the region is the outflow (Geroliminis and
Daganzo, Transportation Research B 42, 2008).
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
from nmfd.model.detector_tables import SPEEDS_M_S, VEHICLE_LENGTH_M
from nmfd.model.regional_model import NetworkTable, RegionalModel, network_toml
from nmfd.runs import config, files
from nmfd.runs.tables import wrapped
from nmfd.studies import fit_quality, plots

# Bounds of the control.
U_MIN = 0.1
U_MAX = 0.9
# Share of a region's detectors, by lane-kilometres, that must report in an interval.
LEAST_REPORTING = 0.5
STOP_LINE_KM = 0.03  # before a junction, where queues stand
FAR = 3.0  # times the median distance between neighbouring detectors: no boundary lies between
LEAST_COVERAGE = 0.3
BIASED_SHARE = 0.5
LEAST_DAYS = 3
LEAST_INTERVALS = 100  # of a region: a rush hour alone has fewer

# Beginnings of the doubts about a region.
UNKNOWN = "coverage unknown"
SMALL = "low coverage"
LOOPS = "loops at stop lines"
ASSUMED = "trip length assumed"
SINGLE = "days"
LEFT = "detectors left out"
SHORT = "intervals"
MISCOUNT = "odd counts"
MEANINGS = {  # beginning of a doubt -> meaning and remedy
    **fit_quality.MEANINGS,
    UNKNOWN: "accumulation and outflow are those of links with detectors; give lane_km with "
    "--about",
    SMALL: f"detectors stand for less than {100 * LEAST_COVERAGE:g} % of the lane-kilometres, "
    "usually the main roads",
    LOOPS: f"most loops lie within {1000 * STOP_LINE_KM:g} m of a junction, where standing queues "
    "bias the density",
    ASSUMED: "two thirds of the side of a square as large as the region; give it with "
    "--trip-length or --about",
    LEFT: "their counts cannot be right, see below; lane-kilometres stand for the links of the "
    "others",
    SINGLE: f"fewer than {LEAST_DAYS} days: the difference between days is unknown",
    SHORT: f"fewer than {LEAST_INTERVALS}: the curve may be that of one rush hour only",
    MISCOUNT: "detectors whose flow does not fit their occupancy, see below; they bias the curve",
}
UNKNOWN_PARTS = (
    "Not in such data: which trips end in a region; vehicles on links without detectors; split "
    "ratios (vehicles cross the fewest boundaries); capacities of boundaries; controlled signals; "
    "anything beyond the largest accumulation, where the outflow is constant or a guess. Demand "
    "belongs into a scenario.toml."
)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Tables of real detectors.

    read: numbers of rows, detectors and days of the counts, as text
    days: number of days
    left: lines about detectors whose counts cannot be right
    odd: region -> detector -> its flow over that of others at the same occupancy, if doubtful
    detectors: region, lane_km, pos_km, x_m, y_m and used (False if left out), by detid
    regions: lane_km, coverage (share of lane_km with detectors in use, NaN if unknown), trip_km,
        assumed (True if trip_km is), x and y (NaN where not given), by name
    intervals: those of Identified
    """

    read: str
    days: int
    left: list[str]
    odd: Mapping[str, Mapping[str, float]]
    detectors: pd.DataFrame
    regions: pd.DataFrame
    intervals: pd.DataFrame


@dataclass(frozen=True, kw_only=True)
class Identified:
    """Identified network and the data behind it.

    fits: a row per region (fit_quality.region_fits)
    intervals: a row per region, day and interval, with density_veh_km, flow_veh_h (per lane),
        reporting (share of the monitored lane-km), accumulation_veh, production_veh_km_h and
        outflow_veh_s
    text: report
    """

    network: RegionalModel
    fits: pd.DataFrame
    intervals: pd.DataFrame
    text: str

    def write(self, out: Path, source: str) -> None:
        """Write network.toml, mfd.png, samples.csv, fit.csv and identify.txt.

        out: folder of the network
        source: name of the file of counts
        """
        comment = f"Regional model: written by nmfd identify from {source}; see identify.txt."
        text = network_toml(self.network, {}, comment)
        config.checked(NetworkTable, tomllib.loads(text), out / "network.toml")
        out.mkdir(parents=True, exist_ok=True)
        samples = samples_of(self.intervals, self.network.region_names)
        plots.draw_mfds(out / "mfd.png", self.network, samples)
        files.write_table(out / "samples.csv", self.intervals, float_format="%.6g")
        fit_quality.write_fits(out / "fit.csv", self.fits)
        files.write_text(out / "identify.txt", self.text + "\n")
        files.write_text(out / "network.toml", text)


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
    """Fit an MFD to each region; write network.toml and a report.

        >>> identified = nmfd.identify(
        ...     "counts.csv", detectors="detectors.csv", trip_length=1500.0, out="mine"
        ... )
        >>> len(identified.fits) == identified.network.regions
        True

    counts, detectors, regions, about: tables (nmfd.model.detector_tables)
    out: folder of the network, whose name it gets
    adjacency: csv file region,neighbour; None: by the detectors' positions
    city: of several in the tables
    skip_bad: leave out doubled rows and those with missing or impossible numbers
    trip_length: mean trip length within a region (m); None: assumed from the size of the region

    Raises: InputError, before anything is written
    """
    out = Path(out)
    if trip_length is not None and not 10.0 <= trip_length <= 1e5:
        raise InputError(f"--trip-length: {config.got('a number from 10 to 100000', trip_length)}")
    if (out / "network.toml").exists():
        raise InputError(f"{out / 'network.toml'}: exists; choose another --out")
    counts = Path(counts)
    rows, omitted = detector_tables.read_counts(counts, city=city, skip_bad=skip_bad)
    stations = detector_tables.read_detectors(detectors, regions, rows, counts, city=city)
    # Numbers are sorted by their value.
    names = sorted(
        set(stations["region"]), key=lambda name: name.rjust(9) if name.isdecimal() else name
    )
    speed = rows["flow"].sum() * VEHICLE_LENGTH_M / 3600.0 / max(rows["occ"].sum(), 1e-9)
    if not SPEEDS_M_S[0] <= speed <= SPEEDS_M_S[1]:
        raise InputError(
            f"{counts}: flow and occ give a mean speed of {speed:.3g} m/s, with "
            f"{VEHICLE_LENGTH_M:g} m for a vehicle over a loop; expected flow in veh/h per lane, "
            "not per interval, and occ as a share, not percent"
        )
    days = rows["day"].nunique()
    read = f"{len(rows):,} rows of {rows['detid'].nunique()} detectors on {days} days; "
    read += f"left out: {detector_tables.omitted(omitted)}"
    rows, faulty = detector_tables.screened(rows, stations["region"])
    odd = detector_doubts.miscounting(rows, stations["region"])
    # Lanes that are counted twice are those of the other detectors.
    stations = stations.drop(list(faulty.get(detector_tables.SUM, ())))
    stations["used"] = stations.index.isin(rows["detid"])
    used = stations[stations["used"]]
    table = detector_tables.read_about(about, names)
    lane_km, coverage = _lane_km(stations, table, about or counts)
    trip_km, assumed = _trip_lengths(stations, table, trip_length)
    table = table.assign(lane_km=lane_km, coverage=coverage, trip_km=trip_km, assumed=assumed)
    data = Measured(
        read=read,
        days=days,
        left=_left_lines(faulty, used, days),
        odd=odd,
        detectors=stations,
        regions=table,
        intervals=_intervals(rows, used, table),
    )
    identified = _fitted(data, counts, name=out.absolute().name, adjacency=adjacency)
    identified.write(out, counts.name)
    return identified


def _left_lines(
    faulty: Mapping[str, Mapping[str, int]], used: pd.DataFrame, days: int
) -> list[str]:
    """Return a line for each reason for which detectors were left out.

    faulty: reason -> detector -> number of days
    used: detectors that are left on other days
    """
    lines = []
    for reason, bad_days in faulty.items():
        names = []
        for name, number in bad_days.items():
            names.append(f"{name} ({number} of {days} days)" if name in used.index else name)
        lines.append(f"detectors left out, {reason}: {', '.join(names)}")
    return lines


def _lane_km(
    detectors: pd.DataFrame, about: pd.DataFrame, where: Path | str
) -> tuple[np.ndarray, np.ndarray]:
    """Return lane-kilometres (R,) and their share with detectors (R,).

    The detectors are those in use. The share is NaN where it is unknown.

    Raises: InputError if lane-kilometres are unknown or contradict one another
    """
    used = detectors[detectors["used"]].groupby("region")["lane_km"].sum()
    in_use = used.reindex(about.index, fill_value=0.0).to_numpy()
    known = detectors.groupby("region")["lane_km"].sum(min_count=1)
    covered = known.reindex(about.index).to_numpy()
    total = about["lane_km"].to_numpy()
    unknown = np.isnan(covered) & np.isnan(total)
    if unknown.any():
        raise InputError(
            f"{where}: the lane-kilometres of region {about.index[unknown][0]} are unknown; give "
            "the length of the detectors' links with --detectors, or lane_km of every region with "
            "--about"
        )
    if (covered > 1.05 * total).any():
        n = int(np.nanargmax(covered / total))
        raise InputError(
            f"{where}: region {about.index[n]}: lane_km: {total[n]:g} is less than the "
            f"{covered[n]:.4g} km of its detectors; correct it, or length and lanes in the "
            "detectors' table"
        )
    return np.where(np.isnan(total), covered, total), in_use / total


def _trip_lengths(
    detectors: pd.DataFrame, about: pd.DataFrame, trip_length: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean trip lengths (R,) [km], and which are assumed (R,).

    They are those within the regions. An assumed one is two thirds of the side of a square as large
    as the detectors' convex hull.

    trip_length: of regions whose own is not given (m)

    Raises: InputError for a region without a trip length and without positions
    """
    given = about["trip_length"]
    if trip_length is not None:
        given = given.fillna(trip_length)
    lengths = given.to_numpy(dtype=float) / 1000.0
    assumed = np.isnan(lengths)
    for n in np.flatnonzero(assumed):
        own = detectors[detectors["region"] == about.index[n]]
        points = own[["x_m", "y_m"]].dropna().to_numpy()
        try:
            area = ConvexHull(points).volume  # its name in two dimensions
        except (QhullError, ValueError):
            raise InputError(
                f"region {about.index[n]}: the mean trip length is unknown and cannot be assumed "
                "without positions; give --trip-length METRES, or a column trip_length with --about"
            ) from None
        lengths[n] = 2.0 / 3.0 * np.sqrt(area) / 1000.0
    return lengths, assumed


def _intervals(rows: pd.DataFrame, detectors: pd.DataFrame, regions: pd.DataFrame) -> pd.DataFrame:
    """Return the intervals of Identified.

    They are those in which enough detectors report.

    rows: counts
    detectors: those in use
    """
    weights = detectors["lane_km"].fillna(1.0)
    weight = rows["detid"].map(weights)
    weighted = pd.DataFrame(
        {
            "region": rows["detid"].map(detectors["region"]),
            "day": rows["day"],
            "interval": rows["interval"],
            "flow": rows["flow"] * weight,
            "occ": rows["occ"] * weight,
            "weight": weight,
        }
    )
    table = weighted.groupby(["region", "day", "interval"]).sum().reset_index()
    all_weights = weights.groupby(detectors["region"]).sum()
    table["density_veh_km"] = table["occ"] / table["weight"] * 1000.0 / VEHICLE_LENGTH_M
    table["flow_veh_h"] = table["flow"] / table["weight"]
    table["reporting"] = table["weight"] / table["region"].map(all_weights)
    table = table[table["reporting"] >= LEAST_REPORTING]
    table = table.sort_values(["region", "day", "interval"], ignore_index=True)
    table = table.drop(columns=["flow", "occ", "weight"])
    lane_km = table["region"].map(regions["lane_km"])
    trip_km = table["region"].map(regions["trip_km"])
    table["accumulation_veh"] = table["density_veh_km"] * lane_km
    table["production_veh_km_h"] = table["flow_veh_h"] * lane_km
    table["outflow_veh_s"] = table["production_veh_km_h"] / trip_km / 3600.0
    return table


def _fitted(data: Measured, counts: Path, *, name: str, adjacency: Path | str | None) -> Identified:
    """Return the network with the MFDs that fit the intervals best.

    name: of the network
    others: see `identify`

    Raises: InputError for a region with too few intervals, or that cannot be reached
    """
    names = tuple(data.regions.index)
    samples = samples_of(data.intervals, names)
    for region in fit_quality.nearly_empty(samples):
        left = "".join(f"; {line}" for line in data.left)
        raise InputError(
            f"{counts}: region {names[region]} was measured in fewer than "
            f"{fit_quality.SAMPLES} intervals with {100 * LEAST_REPORTING:g} % of its detectors "
            f"reporting; give more data, or join it to another region{left}"
        )
    lane_km = data.regions["lane_km"].to_numpy()
    network = RegionalModel(
        name=name,
        region_names=names,
        positions=_positions(data.detectors, data.regions),
        adjacency=_adjacency(adjacency, data.detectors, names),
        mfds=tuple(mfd.fit(*fit_quality.own_points(cloud).T) for cloud in samples),
        u_min=U_MIN,
        u_max=U_MAX,
    )
    if (network.hops < 0).any():
        i, j = np.argwhere(network.hops < 0)[0]
        raise InputError(
            f"{adjacency or counts}: region {names[j]} cannot be reached from {names[i]}; "
            "give all pairs of neighbours, region,neighbour, with --adjacency"
        )
    network = fit_quality.with_guesses(network, samples, lane_km)
    fits = fit_quality.region_fits(network, samples, lane_km=lane_km)
    fits["doubts"] += pd.Series([tuple(_doubts(data, region)) for region in names])
    network = replace(network, doubts=tuple(fits["doubts"]))
    text = _report(data, network, fits)
    return Identified(network=network, fits=fits, intervals=data.intervals, text=text)


def samples_of(
    intervals: pd.DataFrame, regions: Sequence[str], flow: str = "outflow_veh_s"
) -> list[dict[str, Points]]:
    """Return fit_quality.Samples with labels "loading" and "unloading".

    intervals: rows with region, day, accumulation_veh and `flow`, by region, day and time
    flow: column of the second coordinate
    """
    samples = []
    for region in regions:
        part = intervals[intervals["region"] == region]
        rising = part.groupby("day")["accumulation_veh"].diff().fillna(0.0) >= 0
        occupied = part["accumulation_veh"] > 0
        points = part[["accumulation_veh", flow]].to_numpy(dtype=float)
        cloud = {"loading": points[occupied & rising], "unloading": points[occupied & ~rising]}
        samples.append(cloud)
    return samples


def _positions(detectors: pd.DataFrame, regions: pd.DataFrame) -> np.ndarray:
    """Return (R, 2) [m]: given, or the middle of the detectors.

    If one is unknown, all regions lie on a circle.
    """
    given = regions[["x", "y"]].to_numpy()
    middle = detectors.groupby("region")[["x_m", "y_m"]].mean().reindex(regions.index).to_numpy()
    places = np.where(np.isnan(given), middle, given)
    if not np.isnan(places).any():
        return places
    angle = 2.0 * np.pi * np.arange(len(regions)) / len(regions)
    return 1000.0 * np.stack([np.sin(angle), np.cos(angle)], axis=1)


def _adjacency(
    path: Path | str | None, detectors: pd.DataFrame, regions: Sequence[str]
) -> Adjacency:
    """Return (R, R) bool: given, or regions with neighbouring detectors.

    Neighbours are joined by a side of a triangle (Delaunay) and not far apart.

    Raises: InputError if there are no positions
    """
    if path is not None:
        return detector_tables.read_pairs(path, regions)
    adjacency = np.zeros((len(regions),) * 2, dtype=bool)
    if len(regions) == 1:
        return adjacency
    placed = detectors.dropna(subset=["x_m", "y_m"]).drop_duplicates(["x_m", "y_m"])
    points = placed[["x_m", "y_m"]].to_numpy()
    try:
        triangles = Delaunay(points).simplices
    except (QhullError, ValueError):
        raise InputError(
            "adjacency is unknown without detector positions (long, lat or x, y); give a table "
            "region,neighbour with --adjacency"
        ) from None
    sides = np.concatenate([triangles[:, pair] for pair in combinations(range(3), 2)])
    sides = np.unique(np.sort(sides, axis=1), axis=0)
    distance = np.linalg.norm(points[sides[:, 0]] - points[sides[:, 1]], axis=1)
    near = sides[distance <= FAR * np.median(distance)]
    region = pd.Index(regions).get_indexer(placed["region"])
    i, h = region[near].T
    adjacency[i, h] = i != h
    return adjacency | adjacency.T


def _doubts(data: Measured, name: str) -> list[str]:
    """Return the doubts about a region beside those of its fit."""
    region = data.regions.loc[name]
    detectors = data.detectors[data.detectors["region"] == name]
    at_stop_line = (detectors["pos_km"] <= STOP_LINE_KM).mean()
    left = (~detectors["used"]).sum()
    doubts = []
    if np.isnan(region["coverage"]):
        doubts.append(UNKNOWN)
    elif region["coverage"] < LEAST_COVERAGE:
        doubts.append(f"{SMALL} {100 * region['coverage']:.0f} %")
    if at_stop_line > BIASED_SHARE:
        doubts.append(f"{LOOPS} ({100 * at_stop_line:.0f} %)")
    if region["assumed"]:
        doubts.append(f"{ASSUMED} ({1000 * region['trip_km']:,.0f} m)")
    if data.days < LEAST_DAYS:
        doubts.append(f"{SINGLE}: {data.days}")
    if left:
        doubts.append(f"{LEFT}: {left} of {len(detectors)}")
    intervals = (data.intervals["region"] == name).sum()
    if intervals < LEAST_INTERVALS:
        doubts.append(f"{SHORT}: {intervals}")
    odd = data.odd.get(name, {})
    if odd:
        doubts.append(f"{MISCOUNT}: {len(odd)} detectors")
    return doubts


def _report(data: Measured, network: RegionalModel, fits: pd.DataFrame) -> str:
    """Return the fits, doubts and data as text."""
    coverage = data.regions["coverage"]
    trip_m = 1000 * data.regions["trip_km"]
    share = "unknown"
    if coverage.notna().any():
        share = f"{coverage.min():.0%} to {coverage.max():.0%}"
    facts = f"{data.read}; share of the lane-km with detectors: {share}; "
    facts += f"trip length within a region: {trip_m.min():,.0f} to {trip_m.max():,.0f} m"
    lines = [f"WARNING, {line}" for line in data.left]
    for region, factors in data.odd.items():
        shown = ", ".join(f"{name} ({factor:.2f})" for name, factor in factors.items())
        lines.append(
            f"WARNING, region {region}: flow of detectors over that of others at the same "
            f"occupancy: {shown}"
        )
    notes = wrapped("\n".join([*lines, facts, UNKNOWN_PARTS]))
    return "\n".join([fit_quality.fit_table(network, fits, MEANINGS), *notes])
