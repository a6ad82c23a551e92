"""MFDs from measured counts and occupancies: formulas, doubts, and errors in tables."""

import doctest
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import good, problem
from commands import nmfd as command

import nmfd
from nmfd.model.mfd import Cubic
from nmfd.studies import measured

CURVE = Cubic(a=4e-9, b=-8e-6, c=0.004, jam=1000.0)  # of every region, which holds 10 km of lanes
LANE_KM, TRIP, VEHICLE = 10.0, 1200.0, 6.5
REGIONS = ("north", "south")


def tables(*, days: int = 3, most: float = 900.0) -> tuple[pd.DataFrame, pd.DataFrame]:
    """(counts, detectors) of two regions with ten links each, all of which follow CURVE exactly."""
    random, rows = np.random.default_rng(0), []
    links = [(f"{region}{n}", f"{region}-{n}", region) for region in REGIONS for n in range(10)]
    detectors = pd.DataFrame(links, columns=["detid", "linkid", "region"])
    r, n = np.indices((2, 10)).reshape(2, -1)
    detectors = detectors.assign(length=(0.25 + 0.05 * n) * LANE_KM / 2.0 / 4.75, lanes=2, pos=0.1)
    detectors = detectors.assign(long=8.5 + 0.01 * (n % 5), lat=47.4 - 0.03 * r - 0.01 * (n // 5))
    for day in range(days):
        load = most * np.sin(np.linspace(0.05, np.pi - 0.05, 40)) * random.uniform(0.9, 1.0)
        for k, n in enumerate(load):
            flow = CURVE.outflow(n) * TRIP * 3.6 / LANE_KM  # veh/h of a lane
            spread = random.uniform(0.7, 1.3, len(detectors))
            for region in REGIONS:  # links differ, regions keep their mean
                own = (detectors["region"] == region).to_numpy()
                spread[own] /= np.average(spread[own], weights=detectors["length"][own])
            occ = n / LANE_KM / 1000.0 * VEHICLE * spread
            table = {
                "day": f"2019-05-{day + 1:02d}",
                "interval": 300 * k,
                "flow": flow * spread,
                "occ": occ,
            }
            rows.append(detectors[["detid"]].assign(**table))
    return pd.concat(rows, ignore_index=True).assign(
        error=0, city="made up", speed=np.nan
    ), detectors


@pytest.fixture(scope="module")
def made():
    return tables()


@pytest.fixture
def without_pictures(monkeypatch):
    monkeypatch.setattr("nmfd.studies.plots.draw_mfds", lambda *given: None)


def written(folder: Path, counts: pd.DataFrame, detectors: pd.DataFrame) -> dict[str, Path]:
    files = {"counts": folder / "counts.csv", "detectors": folder / "detectors.csv"}
    counts.to_csv(files["counts"], index=False)
    detectors.to_csv(files["detectors"], index=False)
    return files


def identified(folder: Path, counts: pd.DataFrame, detectors: pd.DataFrame, **given):
    return nmfd.identify(**written(folder, counts, detectors), **given, out=folder / "city")


def test_the_curve_that_made_the_tables_comes_back(tmp_path, made):
    found = identified(tmp_path, *made, trip_length=TRIP)
    for fit, curve in zip(found.fits.itertuples(), found.network.mfds, strict=True):
        x = np.linspace(10.0, 840.0, 50)
        assert np.abs(curve.outflow(x) - CURVE.outflow(x)).max() < 0.01 * CURVE.capacity
        assert fit.r2 > 0.99
        assert fit.spread < 0.02
        assert fit.critical_veh == pytest.approx(CURVE.critical, rel=0.03)
        assert fit.doubts == ("coverage unknown",)
    frame = found.intervals
    assert len(frame) == 2 * 3 * 40
    assert frame["reporting"].between(0.999, 1.001).all()
    assert frame["production_veh_km_h"].to_numpy() == pytest.approx(
        3.6 * TRIP * CURVE.outflow(frame["accumulation_veh"].to_numpy()), rel=1e-6
    )
    again = nmfd.load_network(tmp_path / "city")
    assert again.region_names == REGIONS
    assert again.adjacency.tolist() == [
        [False, True],
        [True, False],
    ]
    assert again.doubts == found.network.doubts
    assert not again.placeholder
    assert np.hypot(*(again.positions[0] - again.positions[1])) == pytest.approx(
        3336.0, rel=0.01
    )  # 0.03 degrees
    files = {path.name for path in (tmp_path / "city").iterdir()}
    assert files == {"network.toml", "mfd.png", "samples.csv", "fit.csv", "identify.txt"}
    assert "Not in such data" in found.text


def test_the_example_in_the_docstring(tmp_path, made, monkeypatch):
    written(tmp_path, *made)
    monkeypatch.chdir(tmp_path)
    assert doctest.testmod(measured, extraglobs={"nmfd": nmfd}) == (0, 2)


@pytest.mark.usefixtures("without_pictures")
def test_what_is_given_replaces_what_is_assumed(tmp_path, made):
    counts, detectors = made
    detectors[["detid", "region"]].to_csv(tmp_path / "regions.csv", index=False)
    (tmp_path / "about.csv").write_text("region,lane_km,trip_length\nnorth,40,600\nsouth,,1200\n")
    (tmp_path / "adjacency.csv").write_text("region,neighbour\nnorth,south\n")
    files = {name: tmp_path / f"{name}.csv" for name in ("regions", "about", "adjacency")}
    found = identified(tmp_path, counts, detectors.drop(columns="region"), **files)
    north, south = found.network.mfds
    assert north.critical == pytest.approx(4.0 * south.critical, rel=0.02)  # four times the streets
    assert north.capacity == pytest.approx(8.0 * south.capacity, rel=0.02)  # and trips half as long
    assert list(found.fits["doubts"]) == [("low coverage 25 %",), ("coverage unknown",)]


@pytest.mark.usefixtures("without_pictures")
def test_doubts_of_few_days_free_flow_and_loops_at_stop_lines(tmp_path):
    counts, detectors = tables(days=1, most=200.0)
    found = identified(tmp_path, counts, detectors.assign(pos=0.01))
    text = " ".join(found.fits["doubts"][0])
    loops = "loops at stop lines (100 %)"
    for doubt in ("no falling branch", "coverage unknown", loops, "trip length assumed", "days: 1"):
        assert doubt in text
        assert f"WARNING, {doubt.split(' (')[0].split(':')[0]}" in found.text
    n = found.network.critical_above[0]
    assert n == found.intervals["accumulation_veh"].max() < 210.0
    assert np.isnan(found.fits["critical_veh"]).all()
    assert f"above {n:.0f} " in found.text
    assert f"critical_above = {n:.6g}" in (tmp_path / "city/network.toml").read_text()
    # Measured up to n, beyond a guess from lanes: 27 veh per lane-km.
    for curve in found.network.mfds:
        assert curve.outflow(n) == pytest.approx(CURVE.outflow(n), rel=0.03)
        assert curve.jam == 80.0 * LANE_KM
        assert curve.critical == pytest.approx(27.2 * LANE_KM, rel=0.01)
    again = nmfd.load_network(tmp_path / "city")
    assert np.isnan(again.seen_critical).all()
    assert (again.critical > 200.0).all()


@pytest.mark.usefixtures("without_pictures")
def test_a_critical_density_that_no_city_has_is_doubted(tmp_path, made):
    counts, detectors = made
    thin = counts.assign(occ=counts["occ"] / 8.0)
    found = identified(tmp_path, thin, detectors, trip_length=TRIP)
    assert found.fits["doubts"][0][0] == "critical density 4.17 veh per lane-km"
    assert "WARNING, critical dens" in found.text


def changed(**columns):
    """A change of the first row of the counts, whose values are texts then."""

    def change(counts, detectors):
        counts = counts.astype(object)
        for name, value in columns.items():
            counts.loc[3, name] = value
        return counts, detectors

    return change


MISTAKES = {
    "a column is missing": (
        lambda c, d: (c.rename(columns={"occ": "occc"}), d),
        {},
        "occ is missing; did you mean occc?",
    ),
    "nan": (
        changed(flow=np.nan),
        {},
        "line 5: flow: expected vehicles per hour and lane, from 0 to 3600, got nothing",
    ),
    "a word": (
        changed(occ="much"),
        {},
        "line 5: occ: expected a share of the time, from 0 to 1, got 'much' instead",
    ),
    "percent": (
        changed(occ=12.5),
        {},
        "got '12.5' instead (1 such rows); is it percent?; correct it, or leave",
    ),
    "no day": (changed(day=np.nan), {}, "line 5: day is missing"),
    "per interval": (
        lambda c, d: (c.assign(flow=c["flow"] / 60), d),
        {},
        "m/s, with 6.5 m for a vehicle over a loop",
    ),
    "all percent": (
        lambda c, d: (c.assign(occ=c["occ"] * 100), d),
        {"skip_bad": True},
        "occ a share?",
    ),
    "twice": (
        lambda c, d: (pd.concat([c, c[:1]]), d),
        {},
        "two rows of 2019-05-01, 0 s (1 such rows; do clocks go back",
    ),
    "two cities": (changed(city="elsewhere"), {}, "choose one of elsewhere, made up with --city"),
    "no such city": (lambda c, d: (c, d), {"city": "madeup"}, "did you mean made up?"),
    "a detector without a row": (lambda c, d: (c, d[1:]), {}, "detector north0, which"),
    "no regions": (lambda c, d: (c, d.drop(columns="region")), {}, "has no column region"),
    "metres": (
        lambda c, d: (c, d.assign(length=1000 * d["length"])),
        {},
        "km of its link, from 0.001 to 30, got",
    ),
    "a detector twice": (
        lambda c, d: (c, pd.concat([d, d[:1]])),
        {},
        "detid north0 is there twice",
    ),
    "no positions": (
        lambda c, d: (c, d.drop(columns=["long", "lat"])),
        {"trip_length": 900.0},
        "give a table region,",
    ),
    "no trip length": (lambda c, d: (c, d.drop(columns=["long", "lat"])), {}, "give --trip-length"),
    "too few intervals": (lambda c, d: (c[: 20 * 5], d), {}, "fewer than 10 intervals"),
    "a trip length in km": (
        lambda c, d: (c, d),
        {"trip_length": 1.2},
        "--trip-length: expected a number from 10",
    ),
}


@pytest.mark.parametrize("change, options, expected", MISTAKES.values(), ids=MISTAKES)
def test_malformed_tables_end_in_one_line(tmp_path, made, change, options, expected):
    assert expected in problem(identified, tmp_path, *change(*made), **options)
    assert not (tmp_path / "city").exists()


def test_the_command(tmp_path, made):
    files = written(tmp_path, *made)
    out = tmp_path / "city"
    text = good(
        command("identify", files["counts"], "--detectors", files["detectors"], "--out", out)
    )
    assert "R2" in text
    assert "trip length assumed" in text
    assert f"Written to {out}" in text


TABLES = {  # expected in the error -> name and text of a table
    "lane_km: 2 is less than the 10 km of its detectors": ("about", "region,lane_km\nnorth,2\n"),
    "region 'norht' has no detector; did you mean north?": ("about", "region,lane_km\nnorht,20\n"),
    "line 2: trip_length: expected m, from 10": ("about", "region,trip_length\nnorth,1.5\n"),
    "region south cannot be reached from north": ("adjacency", "region,neighbour\nnorth,north\n"),
    "line 2: region 'west' has no detector": ("adjacency", "region,neighbour\nnorth,west\n"),
    "column region is missing": ("adjacency", "a,b\n"),
    "cannot be read as a csv file": ("about", ""),
}


@pytest.mark.parametrize("expected", TABLES)
def test_other_tables_end_in_one_line(tmp_path, made, expected):
    name, text = TABLES[expected]
    (tmp_path / "other.csv").write_text(text)
    test_malformed_tables_end_in_one_line(
        tmp_path,
        made,
        lambda *given: given,
        {name: tmp_path / "other.csv", "trip_length": TRIP},
        expected,
    )


@pytest.mark.usefixtures("without_pictures")
def test_bad_rows_and_silent_detectors_are_left_out_and_counted(tmp_path, made):
    counts, detectors = made
    counts = counts.copy()
    counts.loc[[3, 7], "flow"] = np.nan
    counts.loc[[30, 31], "error"] = 1
    counts = counts[
        ~(
            (counts["interval"] == 900)
            & counts["detid"].str.startswith("north")
            & (counts.index % 10 < 7)
        )
    ]
    hour = counts[
        (counts["day"] == "2019-05-02") & counts["interval"].between(3000, 4800)
    ]  # clocks go back
    counts = pd.concat([counts, hour.assign(flow=hour["flow"] + 30.0)])
    found = identified(tmp_path, counts, detectors, trip_length=TRIP, skip_bad=True)
    left = "2 rows marked as errors, 2 rows with a missing or impossible number, "
    left += f"{len(hour)} rows doubled"
    assert left in " ".join(found.text.split())
    assert found.fits["critical_veh"][0] == pytest.approx(CURVE.critical, rel=0.03)
    frame = found.intervals
    assert not ((frame["region"] == "north") & (frame["interval"] == 900)).any()
    assert frame["reporting"].min() >= 0.5
    with pytest.raises(nmfd.InputError, match="exists; choose another"):
        identified(tmp_path, *made)


def faulty(counts, where, **values):
    """The counts with other values where `where` is true."""
    return counts.assign(
        **{name: counts[name].where(~where, value) for name, value in values.items()}
    )


def total(counts, one):
    """The counts with a detector that counts the lanes of three others again."""
    rows = counts[counts["detid"].isin(["north1", "north2", "north3"])]
    rows = rows.groupby(["day", "interval"], as_index=False).agg({"flow": "sum", "occ": "mean"})
    return pd.concat([counts, rows.assign(detid="north0")])


NOISE = np.random.default_rng(3).uniform(0.0, 0.4, 10000)
FAULTS = {  # change of the counts, reason
    "no occupancy": (lambda c, one: faulty(c, one, occ=0.0), "flow without occupancy"),
    "dead": (lambda c, one: faulty(c, one, flow=0.0, occ=0.0), "zero while others count"),
    "on a day": (
        lambda c, one: faulty(c, one & (c["day"] == "2019-05-02"), flow=0.0, occ=0.0),
        "zero while others count: north0 (1 of 3 days)",
    ),
    "parked on": (lambda c, one: faulty(c, one, flow=0.0, occ=1.0), "occupancy without flow"),
    "frozen": (
        lambda c, one: faulty(c, one & (c["interval"] > 5000), flow=321.0, occ=0.07),
        "constant",
    ),
    "wrong unit": (lambda c, one: faulty(c, one, occ=c["occ"] / 3.0), "unlike its neighbours"),
    "noise": (
        lambda c, one: faulty(c, one, flow=1500 * NOISE[: len(c)], occ=NOISE[: len(c)]),
        "unlike its neighbours",
    ),
    "lanes twice": (lambda c, one: total(c[~one], one), "sum of others"),
}


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("fault, reason", FAULTS.values(), ids=FAULTS)
def test_detectors_that_cannot_be_right_are_left_out_and_named(tmp_path, made, fault, reason):
    """The curve is that of all others, and of all streets; no other detector is suspected."""
    counts, detectors = made
    wrong = fault(counts, counts["detid"] == "north0")
    found = identified(tmp_path, wrong, detectors, trip_length=TRIP)
    (line,) = (
        line for line in found.text.splitlines() if line.startswith("WARNING, detectors left out, ")
    )
    assert line.startswith(f"WARNING, detectors left out, {reason}")
    assert "north0" in line
    assert line.count("north") == 1
    lanes = 1.0 if reason != "sum of others" else 1.0 - detectors["length"][0] * 2.0 / LANE_KM
    assert found.fits["critical_veh"][0] == pytest.approx(lanes * CURVE.critical, rel=0.05)
    assert (len(found.fits["doubts"][0]) == 2) == ("day" not in reason) or reason == "sum of others"
