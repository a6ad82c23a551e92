"""Confidence bands over loading runs, and production samples."""

from pathlib import Path

import numpy as np
import pytest

from nmfd.api import load_scenario
from nmfd.studies.mfd_bands import BINS, band, draw_production, production_samples

SCENARIO = Path(__file__).parents[1] / "scenarios" / "economic_mpc"


def test_a_band_is_the_interval_over_runs_not_over_samples():
    """Three runs of a thousand equal samples each are three observations; known Student interval of 1, 2 and 3."""
    runs = [np.column_stack([np.full(1000, 50.0), np.full(1000, value)]) for value in (1.0, 2.0, 3.0)]
    [[x, mean, half]] = band(runs)
    assert (x, mean) == (50.0, 2.0)
    assert half == pytest.approx(4.3027 / np.sqrt(3.0), rel=1e-3)


def test_bins_with_one_run_tell_no_band():
    random = np.random.default_rng(0)
    wide, narrow = (
        np.column_stack([x, 0.1 * x]) for x in (120.0 * np.sqrt(random.random(4000)), 59.9 * random.random(4000))
    )
    found = band([wide, narrow, narrow])
    assert len(found) == BINS // 2 and found[:, 0].max() < 60.0 < wide[:, 0].max()
    assert np.allclose(found[:, 1], 0.1 * found[:, 0], rtol=0.02)
    assert band([np.empty((0, 2))] * 3).shape == (0, 3)


def test_production_samples_and_their_picture(tmp_path):
    """Rising and falling accumulation apart; an empty region says nothing."""
    x = np.concatenate([np.linspace(0, 100, 21), np.linspace(95, 0, 20)])
    record = {"mean_accumulation": np.tile(x[:, None], 7), "production": np.tile(10.0 * x[:, None], 7)}
    samples = production_samples(record, 0)
    assert len(samples["loading"]) == 20 and len(samples["unloading"]) == 19
    assert (np.diff(samples["unloading"][:, 0]) < 0).all()
    draw_production(tmp_path / "p.png", load_scenario(SCENARIO).network, [record, record])
    assert (tmp_path / "p.png").stat().st_size > 10_000
