"""Tables of real detectors in the format of UTD19.

Loder, Ambühl, Menendez and Axhausen, "Understanding traffic capacity of urban networks", Scientific
Reports 9, 2019; utd19.ethz.ch:

    counts.csv      day, interval [s since midnight], detid, flow [veh/h per lane], occ [share of
                    the time]; optional: error (1 marks a wrong row), city, region
    detectors.csv   detid, length [km of its link]; optional: lanes (covered), linkid, pos [km
                    before the junction downstream], long and lat [degrees] or x and y [m],
                    citycode, region
    regions.csv     detid, region: unless another table has a column region
    about.csv       region, and any of lane_km, trip_length [m], x and y [m]
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from nmfd.errors import InputError, did_you_mean
from nmfd.runs.files import check_file

CHUNK_ROWS = 10**6  # all of UTD19 has 134 million
EARTH_RADIUS_M = 6371000.0
STATION_DECIMALS = 2  # of km: detectors of a link within 10 m form a station
SPEEDS_M_S = 0.5, 50.0  # range of plausible mean speeds
VEHICLE_LENGTH_M = 6.5  # of a vehicle and a loop together
COUNTS = ("day", "interval", "detid", "flow", "occ")

# Reasons for rows that are left out.
MARKED = "marked as errors"
BAD = "with a missing or impossible number"
DOUBLED = "doubled"

# Screening of single detectors by day, after Chen, Kwon, Rice, Skabardonis and Varaiya, "Detecting
# errors and imputing missing data for single-loop surveillance systems", Transportation Research
# Record 1855, 2003 (PeMS).
FAULTY_SHARE = 0.25  # of a day's rows to which a test applies; more, and the day is left out
HELD_ROWS = 12  # with one value in a row: an hour of 5 min
# Coarse numbers below these (veh/h, and share) repeat themselves without a fault.
LEAST_FLOW = 100.0
LEAST_OCC = 0.03
# Comparison of a detector with those of its region.
FEWEST_NEIGHBOURS = 5
FAR_OFF = {"flow": 8.0, "speed": 2.5}  # factor on the median of a region's detectors
FAR_OFF_SPREADS = 6.0  # the same in median absolute deviations of the logarithms
# Correlation with the region's mean: less of one detector is a fault if the median has more.
ODD = 0.2
ALIKE = 0.6
SUM = "sum of others"
UNLIKE = "unlike its neighbours"


class Limit(NamedTuple):
    """Range of a number; hint: the likely mistake beyond."""

    low: float
    high: float
    meaning: str
    hint: str = ""


COUNT_LIMITS = {
    "interval": Limit(0, 86400, "seconds since midnight", "is it milliseconds?"),
    "flow": Limit(
        0.0, 3600.0, "vehicles per hour and lane", "is it of all lanes together, or a fault?"
    ),
    "occ": Limit(0.0, 1.0, "a share of the time", "is it percent?"),
}
DETECTOR_LIMITS = {
    "length": Limit(1e-3, 30.0, "km of its link", "is it metres?"),
    "lanes": Limit(1, 20, "lanes that it covers"),
}
ABOUT_LIMITS = {
    "lane_km": Limit(1e-3, 1e6, "km of lanes"),
    "trip_length": Limit(10.0, 1e5, "m", "is it km?"),
    "x": Limit(-1e9, 1e9, "m"),
    "y": Limit(-1e9, 1e9, "m"),
}


def read_counts(
    path: Path, *, city: str | None = None, skip_bad: bool = False
) -> tuple[pd.DataFrame, dict[str, int]]:
    """Return the good rows, and the number of rows left out by reason.

    The rows have COUNTS, and region if it is there. Rows marked as errors are always left out.

    city: of several in the file
    skip_bad: leave out rows with a missing or impossible number, and all but the first of one
        detector and interval, instead of raising InputError

    Raises: InputError
    """
    remedy = "" if skip_bad else "correct it, or leave such rows out with --skip-bad"
    parts = []
    left = {MARKED: 0, BAD: 0, DOUBLED: 0}
    cities = set()
    for chunk in _chunks(path, COUNTS, ("error", "city", "region")):
        _check_keys(chunk, "day", path, once=False)
        _check_keys(chunk, "detid", path, once=False)
        if "city" in chunk:
            cities |= set(chunk["city"].dropna().astype(str))
            if city is not None:
                chunk = chunk[chunk["city"] == city]
        if "error" in chunk:
            wrong = chunk["error"].str.strip().str.lower().isin(["1", "1.0", "true"])
            left[MARKED] += int(wrong.sum())
            chunk = chunk[~wrong]
        good = _numbers(chunk, COUNT_LIMITS, path, remedy)
        left[BAD] += len(chunk) - len(good)
        columns = list(COUNTS)
        if "region" in good:
            columns.append("region")
        parts.append(good[columns])
    ambiguous = city is None and len(cities) > 1
    unknown = city is not None and city not in cities
    if ambiguous or unknown:
        known = ", ".join(sorted(cities)) or "none"
        hint = did_you_mean(city or "", cities)
        raise InputError(f"{path}: city: choose one of {known} with --city{hint}")
    rows = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
    if len(rows) == 0 or left[BAD] > len(rows):
        raise InputError(
            f"{path}: {len(rows)} good rows, and left out: {omitted(left)}; "
            "is flow in veh/h per lane, and occ a share?"
        )
    doubled = rows.duplicated(["day", "interval", "detid"])
    left[DOUBLED] = int(doubled.sum())
    if left[DOUBLED] and not skip_bad:
        day, interval, detid = rows.loc[doubled.idxmax(), ["day", "interval", "detid"]]
        raise InputError(
            f"{path}: detector {detid} has two rows of {day}, {interval:g} s "
            f"({left[DOUBLED]:,} such rows; do clocks go back?); "
            "keep one, or leave them out with --skip-bad"
        )
    return rows[~doubled].reset_index(drop=True), left


def screened(
    rows: pd.DataFrame, region: pd.Series
) -> tuple[pd.DataFrame, dict[str, dict[str, int]]]:
    """Return the rows of plausible detectors, and what is left out.

    The second is reason -> detector -> number of days. A detector that fails on half of its days or
    more is left out altogether.

    rows: those of `read_counts`
    region: by detid
    """
    rows = rows.sort_values(["detid", "day", "interval"])
    region_of_row = rows["detid"].map(region)
    by_day = rows.groupby(["detid", "day"])
    # The mean of a test is the share of rows that fail it, among those to which it applies.
    tests = _failed_tests(rows, region_of_row)
    shares = tests.groupby([rows["detid"], rows["day"]]).mean()
    long_enough = by_day.size().to_numpy() >= HELD_ROWS
    failed = (shares > FAULTY_SHARE) & long_enough[:, None]
    reasons = failed.idxmax(axis=1)[failed.any(axis=1)]  # by detid and day
    days = rows.groupby("detid")["day"].nunique()
    bad = reasons.groupby("detid").agg(reason=lambda part: part.mode()[0], days="size")
    mostly_bad = bad.index[bad["days"] >= 0.5 * days[bad.index]]
    on_bad_day = pd.MultiIndex.from_frame(rows[["detid", "day"]]).isin(reasons.index)
    rows = rows[~rows["detid"].isin(mostly_bad) & ~on_bad_day]
    left = {reason: part["days"].to_dict() for reason, part in bad.groupby("reason")}
    for _, part in rows.groupby(region_of_row):
        for reason, names in _against_neighbours(part).items():
            if names:
                left.setdefault(reason, {}).update(days[names].to_dict())
                rows = rows[~rows["detid"].isin(names)]
    return rows.sort_index(), left


def _failed_tests(rows: pd.DataFrame, region: pd.Series) -> pd.DataFrame:
    """Return 1 for each row and test that it fails, and 0 if it passes.

    NaN stands for a test that does not apply.

    rows: by detid, day and interval
    region: of each row
    """
    flow = rows["flow"]
    occ = rows["occ"]
    mean = rows.groupby([region, "day", "interval"])["flow"].transform("mean")
    busiest = mean.groupby([region, rows["day"]]).transform("max")
    busy = mean >= 0.5 * busiest.clip(lower=1e-9)
    speed = flow * VEHICLE_LENGTH_M / 3600.0 / occ.where(occ > 0, 1e-9)
    by_day = rows.groupby(["detid", "day"])
    one_value_all_day = by_day[["flow", "occ"]].transform("nunique").min(axis=1) == 1
    flow_held = _held(rows, "flow")
    flow_stuck = flow_held & (flow >= LEAST_FLOW)
    occ_stuck = _held(rows, "occ") & (occ >= LEAST_OCC)
    constant = flow_stuck | occ_stuck | one_value_all_day
    tests = {
        "flow without occupancy": (speed > SPEEDS_M_S[1]).where(flow >= LEAST_FLOW),
        "occupancy without flow": (speed < SPEEDS_M_S[0]).where((occ > 0) & busy),
        "zero while others count": (flow_held & (flow == 0)).where(busy),
        "constant": constant & (flow + occ > 0),
    }
    return pd.DataFrame(tests).astype(float)


def _held(rows: pd.DataFrame, column: str) -> pd.Series:
    """Return True for rows among HELD_ROWS or more with one value.

    They follow each other and are of one detector and day.
    """
    columns = rows[["detid", "day", column]]
    run = (columns != columns.shift()).any(axis=1).cumsum()
    return run.groupby(run).transform("size") >= HELD_ROWS


def _against_neighbours(rows: pd.DataFrame) -> dict[str, list[str]]:
    """Return reason -> detectors of a region that contradict its others.

    They differ from the others, or count again what others count.
    """
    wide = rows.pivot(index=["day", "interval"], columns="detid", values=["flow", "occ"])
    flow = wide["flow"]
    names = flow.columns
    if len(names) < FEWEST_NEIGHBOURS:
        return {}
    total = _sums_of_others(flow.dropna().to_numpy())
    means = {"flow": flow.mean(), "speed": flow.mean() / wide["occ"].mean()}
    with np.errstate(divide="ignore"):
        size = np.log(pd.DataFrame(means))
    off = (size - size.median()).abs()
    allowed = np.maximum(np.log(pd.Series(FAR_OFF)), FAR_OFF_SPREADS * off.median())
    far = (off > allowed).any(axis=1)
    like = flow.corrwith(flow.mean(axis=1))
    odd = (like < ODD) & (like.median() > ALIKE)
    unlike = (far | odd).to_numpy() & ~total
    return {SUM: list(names[total]), UNLIKE: list(names[unlike])}


def _sums_of_others(flow: np.ndarray) -> np.ndarray:
    """Return the detectors (D,) bool that count the sum of several others.

    flow: intervals in which all detectors report ((n, D))
    """
    detectors = flow.shape[1]
    if len(flow) < 2 * detectors:
        return np.zeros(detectors, dtype=bool)
    # Regression of each detector on all others: 1 / inverse[i, i] is what remains of the sum of
    # squares.
    gram = flow.T @ flow
    inverse = np.linalg.inv(gram + 1e-9 * np.trace(gram) * np.eye(detectors))
    own = np.diag(inverse)
    weights = np.eye(detectors) - inverse / own[:, None]
    terms = weights > 0.5
    plain_sum = (np.abs(weights - terms).max(axis=1) < 0.05) & (terms.sum(axis=1) > 1)
    exact = 1.0 / own < 1e-4 * np.diag(gram)
    return plain_sum & exact


def read_detectors(
    path: Path | str | None,
    regions: Path | str | None,
    counts: pd.DataFrame,
    where: Path | str,
    city: str | None = None,
) -> pd.DataFrame:
    """Return region, lane_km, pos_km, x_m, y_m of all detectors, by detid.

    They are those in `counts`. NaN stands for what is unknown. Detectors of one link share its
    length by station. The last table with a column region counts.

    path, regions: detectors.csv and regions.csv
    where: file of `counts`
    city: a citycode of detectors.csv

    Raises: InputError
    """
    table = counts.drop_duplicates("detid").drop(columns=["day", "interval", "flow", "occ"])
    detids = list(table["detid"])
    if path is not None:
        where = path
        more = _read_links(path, detids, city)
        if "region" in more:
            table = table.drop(columns="region", errors="ignore")
        table = more.merge(table, how="left")
    if regions is not None:
        where = regions
        named = pd.concat(_chunks(regions, ("detid", "region")))
        _check_keys(named, "detid", regions)
        table = table.drop(columns="region", errors="ignore").merge(named, how="left")
    if "region" not in table:
        raise InputError(
            f"{where}: has no column region; give it there, or a table detid,region with --regions"
        )
    table = table.set_index("detid")
    table = table[table["region"].notna() & (table["region"].str.strip() != "")]
    missing = set(detids) - set(table.index)
    if missing:
        raise InputError(
            f"{where}: detector {min(missing)}, which has counts, has no row or region "
            f"({len(missing)} such); add it"
        )
    return _placed(table.loc[detids])


def _read_links(path: Path | str, detids: Sequence[str], city: str | None) -> pd.DataFrame:
    """Return the rows of detectors.csv for these detectors.

    Raises: InputError
    """
    optional = ("lanes", "linkid", "pos", "long", "lat", "x", "y", "citycode", "region")
    table = pd.concat(_chunks(path, ("detid", "length"), optional))
    if city is not None and "citycode" in table:
        table = table[table["citycode"] == city]
    table = table[table["detid"].isin(detids)]
    _check_keys(table, "detid", path)
    limits = {"length": DETECTOR_LIMITS["length"]}
    if "lanes" in table and table["lanes"].notna().all():
        limits["lanes"] = DETECTOR_LIMITS["lanes"]
    return _numbers(table, limits, path)


def _placed(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of `read_detectors` from texts, by detid."""
    numbers = table.reindex(columns=["length", "lanes", "pos", "long", "lat", "x", "y"])
    out = numbers.apply(pd.to_numeric, errors="coerce")
    out["region"] = table["region"].str.strip()
    link = pd.Series(out.index, out.index)  # without a link's id a detector is alone on its link
    if "linkid" in table:
        link = table["linkid"].fillna(link)
    places = out["pos"].round(STATION_DECIMALS).groupby(np.asarray(link))
    stations = places.transform(lambda part: max(1, part.nunique()))
    out["lane_km"] = out["length"] * out["lanes"].fillna(1.0) / stations
    if out["long"].notna().any() and out["x"].isna().all():
        middle = np.radians(out["lat"].mean())
        out["x"] = EARTH_RADIUS_M * np.cos(middle) * np.radians(out["long"] - out["long"].mean())
        out["y"] = EARTH_RADIUS_M * np.radians(out["lat"] - out["lat"].mean())
    out = out.rename(columns={"pos": "pos_km", "x": "x_m", "y": "y_m"})
    return out[["region", "lane_km", "pos_km", "x_m", "y_m"]]


def read_about(path: Path | str | None, regions: Sequence[str]) -> pd.DataFrame:
    """Return lane_km, trip_length, x, y by region, NaN where unknown.

    Raises: InputError
    """
    columns = list(ABOUT_LIMITS)
    if path is None:
        return pd.DataFrame(np.nan, index=list(regions), columns=columns)
    table = pd.concat(_chunks(path, ("region",), columns))
    _check_keys(table, "region", path)
    for name in table["region"]:
        _check_region(name, regions, path)
    for name, limit in ABOUT_LIMITS.items():
        if name in table:
            _numbers(table[table[name].notna()], {name: limit}, path)
    table = table.set_index("region").apply(pd.to_numeric)
    return table.reindex(index=list(regions), columns=columns)


def read_pairs(path: Path | str, regions: Sequence[str]) -> np.ndarray:
    """Return (R, R) bool: pairs region, neighbour of a csv file, both ways.

    Raises: InputError
    """
    table = pd.concat(_chunks(path, ("region", "neighbour")))
    adjacency = np.zeros((len(regions),) * 2, dtype=bool)
    lines = table.index + 2
    for line, region, neighbour in zip(lines, table["region"], table["neighbour"], strict=True):
        where = f"{path}: line {line}"
        i = _check_region(region, regions, where)
        h = _check_region(neighbour, regions, where)
        adjacency[i, h] = i != h
    return adjacency | adjacency.T


def omitted(left: Mapping[str, int]) -> str:
    """Return the numbers of rows left out as text."""
    texts = [f"{rows:,} rows {reason}" for reason, rows in left.items() if rows]
    return ", ".join(texts) or "nothing"


def _check_region(name: str, regions: Sequence[str], where: Path | str) -> int:
    """Return the number of a region.

    Raises: InputError
    """
    if name not in regions:
        raise InputError(
            f"{where}: region {name!r} has no detector{did_you_mean(str(name), regions)}; there "
            f"are {', '.join(regions)}"
        )
    return list(regions).index(name)


def _chunks(
    path: Path | str, needed: Sequence[str], optional: Sequence[str] = ()
) -> Iterator[pd.DataFrame]:
    """Yield the columns of a csv file as texts, in parts.

    Raises: InputError
    """
    check_file(path, "give a csv file")
    try:
        header = list(pd.read_csv(path, nrows=0, skipinitialspace=True).columns)
        missing = [name for name in needed if name not in header]
        if missing:
            raise InputError(
                f"{path}: column {missing[0]} is missing{did_you_mean(missing[0], header)}; "
                f"needed: {', '.join(needed)}"
            )
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
    table: pd.DataFrame, limits: Mapping[str, Limit], path: Path | str, remedy: str = "correct it"
) -> pd.DataFrame:
    """Return the rows with all columns of `limits` within them.

    remedy: for other rows; "" to leave them out

    Raises: InputError for other rows, given a remedy
    """
    values = {}
    good = pd.Series(True, table.index)
    for name, limit in limits.items():
        values[name] = pd.to_numeric(table[name], errors="coerce")
        inside = values[name].between(limit.low, limit.high)
        good &= inside
        if remedy and not inside.all():
            line = inside.idxmin()
            text = table.loc[line, name]
            got = "nothing" if pd.isna(text) else repr(text)
            if values[name][line] > limit.high and limit.hint:
                remedy = f"{limit.hint}; {remedy}"
            raise InputError(
                f"{path}: line {line + 2}: {name}: expected {limit.meaning}, "
                f"from {limit.low:g} to {limit.high:g}, got {got} instead "
                f"({int((~inside).sum()):,} such rows); {remedy}"
            )
    return table.assign(**values)[good]


def _check_keys(table: pd.DataFrame, key: str, path: Path | str, *, once: bool = True) -> None:
    """Check that no key is missing.

    once: no key is doubled, either

    Raises: InputError
    """
    missing = table[key].isna()
    if missing.any():
        line = missing.idxmax() + 2
        raise InputError(f"{path}: line {line}: {key} is missing; add it or remove the line")
    doubled = table[key].duplicated()
    if once and doubled.any():
        line = doubled.idxmax()
        raise InputError(
            f"{path}: line {line + 2}: {key} {table[key][line]} is there twice; "
            "remove one of the lines"
        )
