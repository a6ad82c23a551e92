"""Tables of real detectors in the format of UTD19.

Loder, Ambühl, Menendez and Axhausen, "Understanding traffic capacity of urban networks", Scientific
Reports 9, 2019; utd19.ethz.ch:

    counts.csv      day, interval [s since midnight], detid, flow [veh/h per lane], occ [share of the time]; optional:
                    error (1 marks a wrong row), city, region
    detectors.csv   detid, length [km of its link]; optional: lanes (covered), linkid, pos [km before the junction
                    downstream], long and lat [degrees] or x and y [m], citycode, region
    regions.csv     detid, region: unless another table has a column region
    about.csv       region, and any of lane_km, trip_length [m], x and y [m]
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from nmfd.errors import InputError, did_you_mean
from nmfd.runs.files import check_file

CHUNK_ROWS = 10**6  # all of UTD19 has 134 million
EARTH_RADIUS_M = 6371000.0
STATION_DECIMALS = 2  # of km: detectors of a link within 10 m form a station
SPEEDS_M_S = 0.5, 50.0  # range of plausible mean speeds
COUNTS = ("day", "interval", "detid", "flow", "occ")
MARKED, BAD, DOUBLED = "marked as errors", "with a missing or impossible number", "doubled"
SUM = "sum of others"
VEHICLE_LENGTH_M = 6.5  # of a vehicle and a loop together
# Screening of single detectors by day, after Chen, Kwon, Rice, Skabardonis and Varaiya, "Detecting
# errors and imputing missing data for single-loop surveillance systems", Transportation Research
# Record 1855, 2003 (PeMS).
FAULTY_SHARE = (
    0.25  # of the rows of a day to which a test applies, beyond which the day is left out
)
HELD_ROWS = 12  # with one value in a row: an hour of 5 min
LEAST_FLOW, LEAST_OCC = (
    100.0,
    0.03,
)  # veh/h and share: coarse numbers below repeat themselves without a fault
FEWEST_NEIGHBOURS = 5
FAR_OFF = {"flow": 8.0, "speed": 2.5}  # factor on the median of a region's detectors
FAR_OFF_SPREADS = 6.0  # the same in median absolute deviations of the logarithms
ODD, ALIKE = (
    0.2,
    0.6,
)  # correlation with the region's mean: of one detector at least, of the median one
Limits = Mapping[
    str, tuple[float, float, str, str]
]  # column -> least, most, meaning, likely mistake beyond
COUNT_LIMITS: Limits = {
    "interval": (0, 86400, "seconds since midnight", "is it milliseconds?"),
    "flow": (0.0, 3600.0, "vehicles per hour and lane", "is it of all lanes together, or a fault?"),
    "occ": (0.0, 1.0, "a share of the time", "is it percent?"),
}
DETECTOR_LIMITS: Limits = {
    "length": (1e-3, 30.0, "km of its link", "is it metres?"),
    "lanes": (1, 20, "lanes that it covers", ""),
}
ABOUT_LIMITS: Limits = {
    "lane_km": (1e-3, 1e6, "km of lanes", ""),
    "trip_length": (10.0, 1e5, "m", "is it km?"),
    "x": (-1e9, 1e9, "m", ""),
    "y": (-1e9, 1e9, "m", ""),
}


def read_counts(
    path: Path, *, city: str | None = None, skip_bad: bool = False
) -> tuple[pd.DataFrame, dict[str, int]]:
    """Return COUNTS, and region if present, of all good rows, and the number of rows left out by
    reason.

    city: of several in the file; skip_bad: leave out rows with a missing or impossible number, and
        all but the first of
    one detector and interval, instead of raising InputError; rows marked as errors are always left
    out
    """
    remedy = "" if skip_bad else "correct it, or leave such rows out with --skip-bad"
    parts, left, cities = [], {MARKED: 0, BAD: 0, DOUBLED: 0}, set[str]()
    for chunk in _chunks(path, COUNTS, ("error", "city", "region")):
        for key in ("day", "detid"):
            _keyed(chunk, key, path, once=False)
        if "city" in chunk:
            cities |= set(chunk["city"].dropna().astype(str))
            chunk = chunk if city is None else chunk[chunk["city"] == city]
        if "error" in chunk:
            wrong = chunk["error"].str.strip().str.lower().isin(["1", "1.0", "true"])
            left[MARKED] += int(wrong.sum())
            chunk = chunk[~wrong]
        good = _numbers(chunk, COUNT_LIMITS, path, remedy)
        left[BAD] += len(chunk) - len(good)
        parts.append(good[[*COUNTS, *(["region"] if "region" in good else [])]])
    if (city is None and len(cities) > 1) or (city is not None and city not in cities):
        known = (
            f"{', '.join(sorted(cities)) or 'none'} with --city{did_you_mean(city or '', cities)}"
        )
        raise InputError(f"{path}: city: choose one of {known}")
    rows = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
    if len(rows) == 0 or left[BAD] > len(rows):
        what = f"{len(rows)} good rows, and left out: {omitted(left)}; is flow in veh/h per lane, and occ a share?"
        raise InputError(f"{path}: {what}")
    if (doubled := rows.duplicated(["day", "interval", "detid"])).any():
        day, interval, detid = rows.loc[doubled.idxmax(), ["day", "interval", "detid"]]
        left[DOUBLED] = int(doubled.sum())
        if not skip_bad:
            what = f"two rows of {day}, {interval:g} s ({left[DOUBLED]:,} such rows; do clocks go back?)"
            raise InputError(
                f"{path}: detector {detid} has {what}; keep one, or leave them out with --skip-bad"
            )
    return rows[~doubled].reset_index(drop=True), left


def screened(
    rows: pd.DataFrame, region: pd.Series
) -> tuple[pd.DataFrame, dict[str, dict[str, int]]]:
    """Return the rows of plausible detectors, and reason -> detector -> days of what is left out.

    A detector that fails on half of its days or more is left out altogether. region: by detid
    """
    rows = rows.sort_values(["detid", "day", "interval"])
    keys, flow, occ = ["detid", "day"], rows["flow"], rows["occ"]
    own = rows["detid"].map(region)
    mean = rows.groupby([own, "day", "interval"])["flow"].transform("mean")
    busy = mean >= 0.5 * mean.groupby([own, rows["day"]]).transform("max").clip(lower=1e-9)
    speed = flow * VEHICLE_LENGTH_M / 3600.0 / occ.where(occ > 0, 1e-9)
    values = rows.groupby(keys)[["flow", "occ"]].transform("nunique").min(axis=1)
    constant = (
        (_held(rows, "flow") & (flow >= LEAST_FLOW))
        | (_held(rows, "occ") & (occ >= LEAST_OCC))
        | (values == 1)
    )
    tests = {  # NaN where a test does not apply
        "flow without occupancy": (speed > SPEEDS_M_S[1]).where(flow >= LEAST_FLOW),
        "occupancy without flow": (speed < SPEEDS_M_S[0]).where((occ > 0) & busy),
        "zero while others count": (_held(rows, "flow") & (flow == 0)).where(busy),
        "constant": constant & (flow + occ > 0),
    }
    shares = pd.DataFrame(tests).astype(float).groupby([rows[key] for key in keys]).mean()
    failed = (shares > FAULTY_SHARE) & (rows.groupby(keys).size().to_numpy() >= HELD_ROWS)[:, None]
    reasons, days = (
        failed.idxmax(axis=1)[failed.any(axis=1)],
        rows.groupby("detid")["day"].nunique(),
    )
    bad = reasons.groupby("detid").agg(reason=lambda part: part.mode()[0], days="size")
    whole = bad.index[bad["days"] >= 0.5 * days[bad.index]]
    rows = rows[
        ~rows["detid"].isin(whole) & ~pd.MultiIndex.from_frame(rows[keys]).isin(reasons.index)
    ]
    left = {reason: part["days"].to_dict() for reason, part in bad.groupby("reason")}
    for _, part in rows.groupby(own):
        for reason, names in _against_neighbours(part):
            left.setdefault(reason, {}).update(days[names].to_dict())
            rows = rows[~rows["detid"].isin(names)]
    return rows.sort_index(), left


def _held(rows: pd.DataFrame, column: str) -> pd.Series:
    """Mark the rows of HELD_ROWS or more in a row with one value of a detector and day."""
    columns = rows[["detid", "day", column]]
    run = (columns != columns.shift()).any(axis=1).cumsum()
    return run.groupby(run).transform("size") >= HELD_ROWS


def _against_neighbours(rows: pd.DataFrame) -> Iterator[tuple[str, list[str]]]:
    """Yield reasons and the detectors of one region that differ from its others, or count what
    others count."""
    wide = rows.pivot(index=["day", "interval"], columns="detid", values=["flow", "occ"])
    flow, names = wide["flow"], wide["flow"].columns
    if len(names) < FEWEST_NEIGHBOURS:
        return
    full, total = flow.dropna().to_numpy(), np.zeros(len(names), dtype=bool)
    if len(full) >= 2 * len(names):
        # Regression of each detector on all others: 1 / inverse[i, i] is what remains of the sum of
        # squares.
        gram = full.T @ full
        inverse = np.linalg.inv(gram + 1e-9 * np.trace(gram) * np.eye(len(names)))
        own = np.diag(inverse)
        weights = np.eye(len(names)) - inverse / own[:, None]
        terms = weights > 0.5
        total = (np.abs(weights - terms).max(axis=1) < 0.05) & (terms.sum(axis=1) > 1)
        total &= 1.0 / own < 1e-4 * np.diag(gram)
    with np.errstate(divide="ignore"):
        size = np.log(
            pd.DataFrame({"flow": flow.mean(), "speed": flow.mean() / wide["occ"].mean()})
        )
    off, like = (size - size.median()).abs(), flow.corrwith(flow.mean(axis=1))
    far = (off > np.maximum(np.log(pd.Series(FAR_OFF)), FAR_OFF_SPREADS * off.median())).any(axis=1)
    far |= (like < ODD) & (like.median() > ALIKE)
    for reason, wrong in ((SUM, total), ("unlike its neighbours", far.to_numpy() & ~total)):
        if wrong.any():
            yield reason, list(names[wrong])


def read_detectors(
    path: Path | None,
    regions: Path | None,
    counts: pd.DataFrame,
    where: Path,
    city: str | None = None,
) -> pd.DataFrame:
    """Return region, lane_km, pos_km, x_m, y_m (NaN where unknown) by detid of all detectors in
    `counts`.

    Detectors of one link share its length by station. The last table with a column region counts.
    Raises InputError.

    path, regions: detectors.csv and regions.csv; where: file of `counts`; city: a citycode of
        detectors.csv
    """
    table = counts.drop_duplicates("detid").drop(columns=["day", "interval", "flow", "occ"])
    detids = list(table["detid"])
    if path is not None:
        optional = ("lanes", "linkid", "pos", "long", "lat", "x", "y", "citycode", "region")
        more = pd.concat(_chunks(path, ("detid", "length"), optional))
        if city is not None and "citycode" in more:
            more = more[more["citycode"] == city]
        more = _keyed(more[more["detid"].isin(detids)], "detid", path)
        used = ["length", *(["lanes"] if "lanes" in more and more["lanes"].notna().all() else [])]
        more = _numbers(more, {name: DETECTOR_LIMITS[name] for name in used}, path)
        table = table.drop(columns="region", errors="ignore") if "region" in more else table
        table = more.merge(table, how="left")
    if regions is not None:
        named = _keyed(pd.concat(_chunks(regions, ("detid", "region"))), "detid", regions)
        table = table.drop(columns="region", errors="ignore").merge(named, how="left")
    where = regions or path or where
    if "region" not in table:
        raise InputError(
            f"{where}: has no column region; give it there, or a table detid,region with --regions"
        )
    table = table.set_index("detid")
    table = table[table["region"].notna() & (table["region"].str.strip() != "")]
    if missing := set(detids) - set(table.index):
        what = (
            f"detector {min(missing)}, which has counts, has no row or region ({len(missing)} such)"
        )
        raise InputError(f"{where}: {what}; add it")
    table = table.loc[detids]
    numbers = table.reindex(columns=["length", "lanes", "pos", "long", "lat", "x", "y"])
    out = numbers.apply(pd.to_numeric, errors="coerce").assign(region=table["region"].str.strip())
    link = (
        table["linkid"].fillna(pd.Series(table.index, table.index))
        if "linkid" in table
        else out.index
    )
    stations = (
        out["pos"]
        .round(STATION_DECIMALS)
        .groupby(np.asarray(link))
        .transform(lambda p: max(1, p.nunique()))
    )
    out["lane_km"] = out["length"] * out["lanes"].fillna(1.0) / stations
    if out["long"].notna().any() and out["x"].isna().all():
        middle = np.radians(out["lat"].mean())
        out["x"] = EARTH_RADIUS_M * np.cos(middle) * np.radians(out["long"] - out["long"].mean())
        out["y"] = EARTH_RADIUS_M * np.radians(out["lat"] - out["lat"].mean())
    return out.rename(columns={"pos": "pos_km", "x": "x_m", "y": "y_m"})[
        ["region", "lane_km", "pos_km", "x_m", "y_m"]
    ]


def read_about(path: Path | None, regions: Sequence[str]) -> pd.DataFrame:
    """Return lane_km, trip_length, x, y by region, NaN where unknown. Raises InputError."""
    columns = list(ABOUT_LIMITS)
    if path is None:
        return pd.DataFrame(np.nan, index=list(regions), columns=columns)
    table = _keyed(pd.concat(_chunks(path, ("region",), tuple(columns))), "region", path)
    for name in table["region"]:
        _check_region(name, regions, path)
    for name in set(columns) & set(table):
        _numbers(table[table[name].notna()], {name: ABOUT_LIMITS[name]}, path)
    return (
        table.set_index("region").apply(pd.to_numeric).reindex(index=list(regions), columns=columns)
    )


def read_pairs(path: Path, regions: Sequence[str]) -> np.ndarray:
    """Return (R, R) bool: the pairs region, neighbour of a csv file, both ways. Raises
    InputError."""
    table = pd.concat(_chunks(path, ("region", "neighbour")))
    adjacency = np.zeros((len(regions),) * 2, dtype=bool)
    for line, pair in zip(
        table.index + 2, table[["region", "neighbour"]].itertuples(index=False), strict=True
    ):
        i, h = (_check_region(name, regions, f"{path}: line {line}") for name in pair)
        adjacency[i, h] = adjacency[h, i] = i != h
    return adjacency


def omitted(left: Mapping[str, int]) -> str:
    """Return the numbers of rows left out as text."""
    return ", ".join(f"{rows:,} rows {why}" for why, rows in left.items() if rows) or "nothing"


def _check_region(name: str, regions: Sequence[str], where: Path | str) -> int:
    """Return the number of a region. Raises InputError."""
    if name not in regions:
        known = f"{did_you_mean(str(name), regions)}; there are {', '.join(regions)}"
        raise InputError(f"{where}: region {name!r} has no detector{known}")
    return list(regions).index(name)


def _chunks(
    path: Path, needed: Sequence[str], optional: Sequence[str] = ()
) -> Iterator[pd.DataFrame]:
    """Yield the columns of a csv file as texts, in parts. Raises InputError."""
    check_file(path, "give a csv file")
    try:
        header = list(pd.read_csv(path, nrows=0, skipinitialspace=True).columns)
        if missing := [name for name in needed if name not in header]:
            known = f"{did_you_mean(missing[0], header)}; needed: {', '.join(needed)}"
            raise InputError(f"{path}: column {missing[0]} is missing{known}")
        names = [name for name in header if name in (*needed, *optional)]
        yield from pd.read_csv(
            path, dtype=str, chunksize=CHUNK_ROWS, usecols=names, skipinitialspace=True
        )
    except (OSError, UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        text = " ".join(str(error).split())
        raise InputError(
            f"{path}: cannot be read as a csv file ({text}); expected {', '.join(needed)}"
        ) from None


def _numbers(
    table: pd.DataFrame, limits: Limits, path: Path, remedy: str = "correct it"
) -> pd.DataFrame:
    """Return the rows with all columns of `limits` within them. Raises InputError for others, given
    a `remedy`."""
    values = {name: pd.to_numeric(table[name], errors="coerce") for name in limits}
    bad = {name: ~values[name].between(low, high) for name, (low, high, _, _) in limits.items()}
    for name, (low, high, what, hint) in limits.items():
        if remedy and (count := int(bad[name].sum())):
            line = bad[name].idxmax()
            got = "nothing" if pd.isna(table.loc[line, name]) else repr(table.loc[line, name])
            remedy = f"{hint}; {remedy}" if values[name][line] > high and hint else remedy
            problem = f"line {line + 2}: {name}: expected {what}, from {low:g} to {high:g}, got {got} instead"
            raise InputError(f"{path}: {problem} ({count:,} such rows); {remedy}")
    return table.assign(**values)[~pd.concat(bad, axis=1).any(axis=1)]


def _keyed(table: pd.DataFrame, key: str, path: Path, *, once: bool = True) -> pd.DataFrame:
    """Return `table`. Raises InputError for a key that is missing or, if it must be there once,
    doubled."""
    if (missing := table[key].isna()).any():
        raise InputError(
            f"{path}: line {missing.idxmax() + 2}: {key} is missing; add it or remove the line"
        )
    if once and (twice := table[key].duplicated()).any():
        line = twice.idxmax()
        raise InputError(
            f"{path}: line {line + 2}: {key} {table[key][line]} is there twice; remove one of the lines"
        )
    return table
