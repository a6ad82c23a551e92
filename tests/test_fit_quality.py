"""A fit that explains nothing says so, and predictions stand beside the one that nothing
changes."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from cosim.evaluation import model_validation
from nmfd.model.identification import Observed
from nmfd.model.mfd import Cubic
from nmfd.model.regional_model import Errors, HeldOut
from nmfd.studies.fit_quality import (
    MEANINGS,
    ahead_table,
    doubt_lines,
    fit_table,
    held_out,
    prediction_text,
    predictions,
    region_fits,
    short_table,
    with_guesses,
    write_fits,
)

GROWING = np.zeros((9, 3, 3))  # region 0 gains 10 vehicles in every interval
GROWING[:, 0, 0] = 10.0 * np.arange(9)


@pytest.fixture
def network(three_regions):
    return three_regions.network


def cloud(x, outflow):
    return {"loading": np.column_stack([x, outflow]).astype(float), "unloading": np.empty((0, 2))}


def doubts(network, samples, most=2.0, seeds=2):
    state = np.repeat(np.diag([most * mfd.critical for mfd in network.mfds])[None], 3, axis=0)
    network = replace(
        network, critical_above=with_guesses(network, samples, np.ones(3), [state]).critical_above
    )
    return list(region_fits(network, samples, [state], seeds)["doubts"])


def test_good_fits_have_no_warning_and_bad_ones_say_what_is_wrong(network):
    random, curve = np.random.default_rng(0), network.mfds[0]
    x = random.uniform(1.0, 1000.0, 200)
    good_one = cloud(x, curve.outflow(x) + random.normal(0.0, 0.01, 200))
    noise = cloud(x, random.uniform(0.0, 1.0, 200))
    few = cloud(x[:3], x[:3])
    assert doubts(network, [good_one] * 3) == [()] * 3
    bad = doubts(network, [good_one, noise, few])
    assert bad[0] == ()
    assert bad[1][0].startswith("R2 ")
    assert bad[2][0] == "few samples (3)"
    assert doubts(network, [good_one] * 3, most=0.4)[0] == (
        "no falling branch (critical above 136 veh, not seen)",
    )
    assert doubts(network, [good_one] * 3, seeds=1)[2] == ("one seed",)
    assert doubts(network, [cloud(x, np.ones(200))] * 3)[0] == ("R2 nan",)
    endless = replace(network, mfds=(Cubic(a=0.0, b=-1e-6, c=0.004, jam=1000.0), *network.mfds[1:]))
    assert doubts(endless, [cloud(x, endless.mfds[0].outflow(x))] * 3)[0] == (
        "no falling branch (critical above 2000 veh, not seen)",
    )


@pytest.mark.filterwarnings("error")
def test_a_region_without_vehicles_has_no_largest_share(network):
    empty = replace(network, critical_above={1: 0.0})
    some = 10.0 * np.eye(3)
    some[1] = 0.0
    shares = region_fits(empty, [cloud([1.0], [1.0])] * 3, [some[None]])["most_share"]
    assert np.isnan(shares).tolist() == [False, True, False]


def test_warnings_are_in_the_table_and_the_file(network, tmp_path):
    network = replace(network, critical_above=dict.fromkeys(range(3), 1.0))
    fits = region_fits(network, [cloud([1.0], [1.0])] * 3, seeds=1)
    table = fit_table(network, fits)
    assert "WARNINGS" in table.splitlines()[0]
    assert table.count("few samples (1); no falling branch (critical above 1 veh, not seen)") == 3
    for kind in ("few samples", "no falling branch", "one seed"):
        assert f"WARNING, {kind}: " in table
        assert kind in MEANINGS
    write_fits(tmp_path / "fit.csv", fits)
    rows = pd.read_csv(tmp_path / "fit.csv")
    assert rows["doubts"].str.endswith("one seed").all()


def observed(network, states):
    none = np.zeros((len(states) - 1, *network.split_mask.shape))
    pairs = none[..., 0]
    return Observed(
        accumulation=states,
        inside=pairs,
        demand=pairs,
        perimeter=pairs,
        splits=none,
        crossings=pairs,
    )


@pytest.mark.filterwarnings("error")
def test_persistence_is_what_it_says(network):
    """A region that gains 10 vehicles in every interval: 10 after one, 40 after four."""
    run, critical = observed(network, GROWING), network.mfds[0].critical
    errors = predictions(network, [run, run], {"step": 225.0, "substeps": 8, "integrator": "euler"})
    assert (errors["ahead_s"] == 900.0).all()
    shares = errors[
        ["next_interval_persistence_rmse_share", "ahead_persistence_rmse_share"]
    ].to_numpy()
    assert shares[0] * critical == pytest.approx([10.0, 40.0])
    assert (shares[1:] == 0.0).all()
    unseen = replace(network, critical_above={0: 0.5 * critical, 1: 0.0})
    twice = predictions(unseen, [run, run], {"step": 225.0, "substeps": 8, "integrator": "euler"})
    assert twice["ahead_persistence_rmse_share"][0] == pytest.approx(2.0 * shares[0, 1])
    assert np.isnan(twice["ahead_persistence_rmse_share"][1])  # nobody was ever there
    text = prediction_text(errors, 225.0)
    assert f"225 s ahead (unchanged: {100 * shares[:, 0].mean():.1f} %)" in text
    assert "900 s ahead (unchanged: " in text


def test_every_table_of_predictions_has_persistence():
    shares = ("next_interval_rmse_share", "next_interval_persistence_rmse_share")
    rows = pd.DataFrame(
        {"demand": [1.0, 1.0], "controller": "x", "runs": 1, "model": "", "most_share": 1.0}
    )
    rows = rows.assign(**dict.fromkeys(shares, 0.25), ahead_s=900.0)
    rows = rows.assign(
        ahead_rmse_share=0.1, ahead_persistence_rmse_share=0.1, whole_run_rmse_share=0.5
    )
    rows = rows.assign(flowing_rmse_veh=[3.0, 4.0], flowing_persistence_rmse_veh=8.0)
    rows = rows.assign(congested_rmse_veh=np.nan, congested_persistence_rmse_veh=np.nan)
    line = model_validation.prediction_table(rows).splitlines()
    assert line[0].count("if nothing changed") == 2
    assert line[1].count("25.0 %") == 2
    assert line[0].split("  ")[-1].strip() == "congested (as now)"
    assert "4 (8) veh" in line[1]  # root of the mean of 9 and 16
    assert line[1].rstrip().endswith("-")


def test_errors_are_told_apart_by_congestion(network):
    """Region 0 gains 10 vehicles in every interval, beyond its critical accumulation at last."""
    scheme = {"step": 450.0, "substeps": 16, "integrator": "euler"}  # 900 s are two intervals
    runs = [observed(network, GROWING)]
    errors = predictions(network, runs, scheme, critical=np.array([55.0, 1.0, 1.0]))
    assert errors["flowing_states"].tolist() == [4] * 3  # up to 50 vehicles after 900 s
    assert errors["congested_states"].tolist() == [3] * 3
    assert errors["flowing_persistence_rmse_veh"].tolist() == [20.0, 0.0, 0.0]
    summary = held_out(errors)
    assert summary.ahead == 900.0
    assert summary.congested.as_now == pytest.approx(20.0 / np.sqrt(3.0))
    predicted = (errors["flowing_rmse_veh"] ** 2).mean() ** 0.5
    assert summary.flowing.model == pytest.approx(predicted)
    alone = held_out(predictions(network, runs, scheme, critical=np.full(3, 1e3)))
    assert alone.congested is None


def test_the_short_table_has_fits_and_errors(network):
    scheme = {"step": 225.0, "substeps": 8, "integrator": "euler"}
    errors = predictions(network, [observed(network, GROWING)], scheme)
    network = replace(network, critical_above={2: 7.0})
    fits = region_fits(network, [cloud([1.0], [1.0])] * 3)
    lines = short_table(network, fits, errors).splitlines()
    assert len(lines) == 4
    assert max(map(len, lines)) <= 100
    assert lines[1].endswith(")")
    assert "(40.0)" in lines[1]
    assert "above 7" in lines[3]
    assert doubt_lines(network, fits)[1].endswith(": few samples (1)")


def test_a_model_worse_than_as_now_is_said_to_know_nothing(network):
    scheme = {"step": 225.0, "substeps": 8, "integrator": "euler"}
    errors = predictions(network, [observed(network, GROWING)], scheme)
    good = errors.assign(flowing_rmse_veh=1.0)
    assert "WARNING" not in ahead_table(good, network.titles)
    bad = errors.assign(flowing_rmse_veh=100.0)
    table = ahead_table(bad, network.titles)
    assert "the model does not know" in table
    assert "its error is 100 veh, of 23" in table
    assert HeldOut(ahead=900.0, flowing=None, congested=Errors(2.0, 3.0)).problem == ""
