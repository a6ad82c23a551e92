"""Tables of real detectors, as UTD19 has them (Loder, Ambühl, Menendez and Axhausen, "Understanding traffic capacity of
urban networks", Scientific Reports 9, 2019; utd19.ethz.ch), read and checked.

    counts.csv      day, interval [s since midnight], detid, flow [veh/h per lane], occ [share of the time], and if
                    there: error (1 marks what the owner holds for wrong), city, region; others are not read
    detectors.csv   detid, length [km of its link], and if there: lanes (that it covers), linkid, pos [km before the
                    junction downstream], long and lat [degrees] or x and y [m], citycode, region; others are not read
    regions.csv     detid, region: where no other table has a column region
    about.csv       region, and any of lane_km, trip_length [m], x and y [m]
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from nmfd.errors import InputError, did_you_mean
from nmfd.runs.files import check_file

CHUNK = 10**6  # lines at a time: all of UTD19 has 134 million
MOST_FLOW = 3600.0  # veh/h per lane: one a second
SHORTEST = 30  # s: intervals that are nearer to each other are minutes or numbers
DAY = 86400  # s
LONGEST_LINK = 30.0  # km
EARTH = 6371000.0  # m
NEAR = 2  # decimals of km: detectors of a link within 10 m of each other are beside each other
SPEEDS = 0.5, 50.0  # m/s: a mean speed beyond is one of wrong units
COUNTS = ("day", "interval", "detid", "flow", "occ")
LIMITS = {  # column -> least, most, what it is, what a value beyond may be
    "interval": (0, DAY, "seconds since midnight", "is it milliseconds?"),
    "flow": (0.0, MOST_FLOW, "vehicles per hour and lane", "is it of all lanes together, or a fault?"),
    "occ": (0.0, 1.0, "a share of the time", "is it percent?"),
}


def read_counts(path: Path, *, city: str | None = None, skip_bad: bool = False) -> tuple[pd.DataFrame, dict[str, int]]:
    """(COUNTS, and region if it is there, of every good row; what was left out -> rows).

    city: of several in the file. skip_bad: leave out rows with a missing or impossible number. Rows that are marked as
    an error are left out anyway. Raises InputError, which names the first bad line.
    """
    parts, left = [], {"marked as errors": 0, "with a missing or impossible number": 0}
    cities: set[str] = set()
    for chunk in _chunks(path, COUNTS, ("error", "city", "region")):
        for name in ("day", "detid"):
            if chunk[name].isna().any():
                line = chunk[name].isna().idxmax() + 2
                raise InputError(f"{path}: line {line}: {name} is missing; add it or remove the line")
        if "city" in chunk:
            cities |= set(chunk["city"].dropna().astype(str))
            chunk = chunk if city is None else chunk[chunk["city"] == city]
        if "error" in chunk:
            wrong = chunk["error"].str.strip().str.lower().isin(["1", "1.0", "true"])
            left["marked as errors"] += int(wrong.sum())
            chunk = chunk[~wrong]
        good, problem = _numbers(chunk, LIMITS)
        if not skip_bad and problem:
            raise InputError(f"{path}: {problem}; correct it, or leave such rows out with --skip-bad")
        left["with a missing or impossible number"] += len(chunk) - len(good)
        parts.append(good[[*COUNTS, *(["region"] if "region" in good else [])]])
    if city is not None and city not in cities:
        raise InputError(
            f"{path}: city: there is no {city!r}{did_you_mean(city, cities)}; choose from "
            f"{', '.join(sorted(cities)) or 'none: the file has no such column, so omit --city'}"
        )
    if city is None and len(cities) > 1:
        raise InputError(
            f"{path}: city: holds {len(cities)} of them; choose one with --city: {', '.join(sorted(cities))}"
        )
    rows = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
    if len(rows) == 0 or left["with a missing or impossible number"] > len(rows):
        raise InputError(
            f"{path}: {len(rows)} good rows, and left out: {told(left)}; is flow in veh/h per lane, and occ a share?"
        )
    doubled = rows.duplicated(["day", "interval", "detid"])
    if doubled.any():
        day, interval, detid = rows.loc[doubled.idxmax(), ["day", "interval", "detid"]]
        raise InputError(
            f"{path}: detector {detid} has two rows of {day}, {interval:g} s ({int(doubled.sum())} such "
            "rows); leave one of each"
        )
    times = np.unique(rows["interval"])
    if len(times) > 1 and np.diff(times).min() < SHORTEST:
        raise InputError(
            f"{path}: interval: expected seconds since midnight, {SHORTEST} s apart or more, got "
            f"{times[0]:g}, {times[1]:g}, ... instead; is it minutes, or a number?"
        )
    return rows, left


def read_detectors(
    path: Path | None, regions: Path | None, counts: pd.DataFrame, where: Path, city: str | None = None
) -> pd.DataFrame:
    """Of the detectors in `counts`, the file `where`: index detid; region, lane_km that each stands for, pos_km, x_m
    and y_m, the last four NaN where unknown.

    path, regions: detectors.csv and regions.csv; one of the tables says the regions. city: a citycode of detectors.csv.
    Detectors of one link share its length if they are not beside each other. Raises InputError.
    """
    table = counts.drop_duplicates("detid").drop(columns=["day", "interval", "flow", "occ"])
    detids, own = list(table["detid"]), "region" in table
    if path is not None:
        more = pd.concat(
            _chunks(
                path, ("detid", "length"), ("lanes", "linkid", "pos", "long", "lat", "x", "y", "citycode", "region")
            )
        )
        if city is not None and "citycode" in more:
            more = more[more["citycode"] == city]
        if own and "region" in more:
            raise InputError(f"{path}: has a column region, and so has {where}; remove one of the two")
        more = _once(more[more["detid"].isin(detids)], "detid", path)
        table = more.merge(table, how="left").set_index(more.index) if own else more
        table, problem = _numbers(
            table,
            {
                "length": (1e-3, LONGEST_LINK, "km of its link", "is it metres?"),
                **(
                    {"lanes": (1, 20, "lanes that it covers", "")}
                    if "lanes" in table and table["lanes"].notna().all()
                    else {}
                ),
            },
        )
        if problem:
            raise InputError(f"{path}: {problem}; correct it")
    if regions is not None:
        if "region" in table:
            raise InputError(f"{regions}: {where if own else path} has a column region already; give one of the two")
        table = table.merge(_once(pd.concat(_chunks(regions, ("detid", "region"))), "detid", regions), how="left")
    if "region" not in table:
        raise InputError(
            f"{path or where}: has no column region; give the region of every detector there, or as a "
            "table detid,region with --regions"
        )
    table = table.set_index("detid")
    for missing, what in (
        (set(detids) - set(table.index), "no row"),
        (set(detids) & set(table.index[table["region"].isna() | (table["region"].str.strip() == "")]), "no region"),
    ):
        if missing:
            file = regions if regions and what == "no region" else path or where
            raise InputError(
                f"{file}: detector {min(missing)}, which {where} counts, has {what} ({len(missing)} such "
                "detectors); add it"
            )
    table = table.loc[detids]
    number = {
        name: pd.to_numeric(table[name], errors="coerce") if name in table else np.nan
        for name in ("length", "lanes", "pos", "long", "lat", "x", "y")
    }
    found = pd.DataFrame(number, index=table.index).assign(region=table["region"].str.strip())
    link = table["linkid"].fillna(pd.Series(table.index, table.index)) if "linkid" in table else found.index
    stations = found["pos"].round(NEAR).groupby(np.asarray(link)).transform(lambda places: max(1, places.nunique()))
    found["lane_km"] = found["length"] * found["lanes"].fillna(1.0) / stations
    if found["long"].notna().any() and found["x"].isna().all():
        middle = np.radians(found["lat"].mean())
        found["x"] = EARTH * np.cos(middle) * np.radians(found["long"] - found["long"].mean())
        found["y"] = EARTH * np.radians(found["lat"] - found["lat"].mean())
    return found.rename(columns={"pos": "pos_km", "x": "x_m", "y": "y_m"})[
        ["region", "lane_km", "pos_km", "x_m", "y_m"]
    ]


def read_about(path: Path | None, regions: Sequence[str]) -> pd.DataFrame:
    """Of every region: index region; lane_km, trip_length, x, y, NaN where unknown. Raises InputError."""
    columns = ["lane_km", "trip_length", "x", "y"]
    if path is None:
        return pd.DataFrame(np.nan, index=list(regions), columns=columns)
    table = _once(pd.concat(_chunks(path, ("region",), tuple(columns))), "region", path)
    given = [name for name in columns if name in table]
    if unknown := sorted(set(table["region"]) - set(regions)):
        raise InputError(
            f"{path}: region {unknown[0]!r} has no detector{did_you_mean(unknown[0], regions)}; there are "
            f"{', '.join(regions)}"
        )
    limits = {
        "lane_km": (1e-3, 1e6, "km of lanes", ""),
        "trip_length": (10.0, 1e5, "m", "is it km?"),
        "x": (-1e9, 1e9, "m", ""),
        "y": (-1e9, 1e9, "m", ""),
    }
    for name in given:
        _, problem = _numbers(table[table[name].notna()], {name: limits[name]})
        if problem:
            raise InputError(f"{path}: {problem}; correct it")
    return table.set_index("region").apply(pd.to_numeric).reindex(index=list(regions), columns=columns)


def read_pairs(path: Path, regions: Sequence[str]) -> np.ndarray:
    """(R, R) bool: the pairs region, neighbour of a csv file, both ways. Raises InputError."""
    table = pd.concat(_chunks(path, ("region", "neighbour")))
    place = {name: n for n, name in enumerate(regions)}
    adjacency = np.zeros((len(regions),) * 2, dtype=bool)
    for line, (i, h) in zip(table.index + 2, table[["region", "neighbour"]].itertuples(index=False), strict=True):
        for name in (i, h):
            if name not in place:
                raise InputError(
                    f"{path}: line {line}: region {name!r} has no detector"
                    f"{did_you_mean(str(name), regions)}; there are {', '.join(regions)}"
                )
        if i == h:
            raise InputError(f"{path}: line {line}: region {i!r} is no neighbour of itself; remove the line")
        adjacency[place[i], place[h]] = adjacency[place[h], place[i]] = True
    return adjacency


def told(left: Mapping[str, int]) -> str:
    """What was left out, in words."""
    return ", ".join(f"{rows:,} rows {why}" for why, rows in left.items() if rows) or "nothing"


def _chunks(path: Path, needed: Sequence[str], wanted: Sequence[str] = ()) -> Iterator[pd.DataFrame]:
    """The columns of a csv file as texts, in parts. InputError for a file that is none, or has not what is needed."""
    check_file(path, "give a csv file")
    try:
        reader = pd.read_csv(
            path, dtype=str, chunksize=CHUNK, usecols=lambda name: name in (*needed, *wanted), skipinitialspace=True
        )
        with reader:
            header = list(pd.read_csv(path, nrows=0).columns)
            if missing := [name for name in needed if name not in header]:
                raise InputError(
                    f"{path}: column {missing[0]} is missing{did_you_mean(missing[0], header)}; expected "
                    f"{', '.join(needed)}, got {', '.join(map(str, header))[:200]} instead"
                )
            yield from reader
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give a csv file") from None
    except pd.errors.EmptyDataError:
        raise InputError(f"{path}: is empty; expected the columns {', '.join(needed)}") from None
    except (OSError, UnicodeDecodeError, pd.errors.ParserError) as error:
        text = " ".join(str(error).split())
        raise InputError(f"{path}: cannot be read as a csv file ({text}); give one") from None


def _numbers(table: pd.DataFrame, limits: Mapping[str, tuple[float, float, str, str]]) -> tuple[pd.DataFrame, str]:
    """The rows of which all these columns are numbers within their limits, and what is wrong with the first other."""
    values = {name: pd.to_numeric(table[name], errors="coerce") for name in limits}
    bad = {name: ~values[name].between(low, high) for name, (low, high, _, _) in limits.items()}
    good = table.assign(**values)[~pd.concat(bad, axis=1).any(axis=1)]
    for name, (low, high, what, hint) in limits.items():
        if bad[name].any():
            line, text = bad[name].idxmax(), table.loc[bad[name].idxmax(), name]
            got = "nothing" if pd.isna(text) else repr(text)
            hint = hint if values[name][line] > high and hint else ""
            return good, (
                f"line {line + 2}: {name}: expected {what}, from {low:g} to {high:g}, got {got} instead "
                f"({int(bad[name].sum()):,} such rows){'; ' + hint if hint else ''}"
            )
    return good, ""


def _once(table: pd.DataFrame, key: str, path: Path) -> pd.DataFrame:
    """`table`. InputError where a key is there twice or missing."""
    if table[key].isna().any():
        raise InputError(f"{path}: line {table[key].isna().idxmax() + 2}: {key} is missing; add it or remove the line")
    if (twice := table[key].duplicated()).any():
        raise InputError(
            f"{path}: line {twice.idxmax() + 2}: {key} {table[key][twice].iloc[0]} is there twice; remove "
            "one of the lines"
        )
    return table
