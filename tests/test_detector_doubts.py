"""Detectors that are kept, but named because their counts do not fit their occupancy."""

import numpy as np
import pandas as pd
import pytest

import nmfd
from nmfd.model.detector_doubts import miscounting

DETECTORS = 10  # of a region


def tables(intervals: int = 200) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Counts of two regions, N and S, on one curve, and their detectors."""
    random = np.random.default_rng(1)
    rows, stations = [], []
    for region in "NS":
        for n in range(DETECTORS):
            detid = f"{region}{n}"
            place = {"x": 300.0 * (n % 5), "y": 900.0 * (region == "N") + 300.0 * (n // 5)}
            stations.append({"detid": detid, "length": 0.3, "region": region, **place})
            density = 60.0 * np.sin(np.linspace(0.1, 3.0, intervals))
            density = density * random.uniform(0.9, 1.1, intervals)
            flow = 30.0 * density * np.exp(-density / 40.0)
            counts = {"flow": flow.round(2), "occ": (density * 0.0065).round(5)}
            times = {"day": "2024-05-06", "interval": 300 * np.arange(intervals), "detid": detid}
            rows.append(pd.DataFrame(times | counts))
    return pd.concat(rows, ignore_index=True), pd.DataFrame(stations)


def identified(folder, counts, stations) -> str:
    """The report of an identification."""
    counts.to_csv(folder / "counts.csv", index=False)
    stations.to_csv(folder / "detectors.csv", index=False)
    found = nmfd.identify(
        folder / "counts.csv",
        detectors=folder / "detectors.csv",
        trip_length=1500.0,
        out=folder / "net",
    )
    return found.text


def test_detectors_at_half_flow_are_named(tmp_path):
    counts, stations = tables()
    region = stations.set_index("detid")["region"]
    assert miscounting(counts, region) == {}
    half = counts["detid"].isin(["N0", "N3"])
    counts["flow"] = counts["flow"].where(~half, counts["flow"] / 2)
    found = miscounting(counts, region)
    assert found.keys() == {"N"}
    assert found["N"] == pytest.approx({"N0": 0.5, "N3": 0.5}, rel=0.05)
    text = identified(tmp_path, counts, stations)
    assert "odd counts: 2 detectors" in text
    assert "region N: flow of detectors over that of others at the same occupancy: N0 (0.5" in text


def test_few_intervals_are_told(tmp_path):
    assert "intervals: 30" in identified(tmp_path, *tables(intervals=30))


def test_many_intervals_and_alike_detectors_need_no_word(tmp_path):
    text = identified(tmp_path, *tables())
    assert "intervals:" not in text
    assert "odd counts" not in text
