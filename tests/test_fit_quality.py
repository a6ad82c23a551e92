"""A fit that explains nothing says so, and predictions stand beside the one that nothing changes."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny

from cosim.evaluation import model_validation
from nmfd.model.authority import Boundaries, verdict
from nmfd.model.identification import Observed
from nmfd.model.mfd import Mfd
from nmfd.model.regional_model import load_network
from nmfd.studies.fit_quality import MEANINGS, fit_table, prediction_table, predictions, region_fits, write_fits


@pytest.fixture
def network(tmp_path):
    tiny.write(tmp_path, network=tiny.row_network(3))
    return load_network(tmp_path / "network")


def cloud(x, outflow):
    return {"loading": np.column_stack([x, outflow]).astype(float), "unloading": np.empty((0, 2))}


def doubts(network, samples, most=2.0, seeds=2):
    state = np.repeat(np.diag([most * mfd.critical for mfd in network.mfds])[None], 3, axis=0)
    return list(region_fits(network, samples, [state], seeds)["doubts"])


def test_good_fits_have_no_warning_and_bad_ones_say_what_is_wrong(network):
    random, curve = np.random.default_rng(0), network.mfds[0]
    x = random.uniform(1.0, 1000.0, 200)
    good_one = cloud(x, curve.outflow(x) + random.normal(0.0, 0.01, 200))
    noise = cloud(x, random.uniform(0.0, 1.0, 200))
    few = cloud(x[:3], x[:3])
    assert doubts(network, [good_one] * 3) == [()] * 3
    bad = doubts(network, [good_one, noise, few])
    assert bad[0] == () and bad[1][0].startswith("R2 ") and bad[2] == ("few samples (3)",)
    assert doubts(network, [good_one] * 3, most=0.4)[0] == ("not reached (40 % of critical)",)
    assert doubts(network, [good_one] * 3, seeds=1)[2] == ("one seed",)
    assert doubts(network, [cloud(x, np.ones(200))] * 3)[0] == ("R2 nan",)
    endless = replace(network, mfds=(Mfd(a=0.0, b=-1e-6, c=0.004, jam=1000.0), *network.mfds[1:]))
    assert doubts(endless, [cloud(x, endless.mfds[0].outflow(x))] * 3)[0] == (
        "no falling branch (jam 1000, critical 1000 veh)",
    )


def test_warnings_are_in_the_table_and_the_file(network, tmp_path):
    fits = region_fits(network, [cloud([1.0], [1.0])] * 3, seeds=1)
    table = fit_table(network, fits)
    assert "WARNINGS" in table.splitlines()[0] and table.count("few samples (1); not reached (0 % of critical)") == 3
    for kind in ("few samples", "not reached", "one seed"):
        assert f"WARNING, {kind}: " in table and kind in MEANINGS
    write_fits(tmp_path / "fit.csv", fits)
    rows = pd.read_csv(tmp_path / "fit.csv")
    assert rows["doubts"].str.endswith("one seed").all()


def observed(network, states):
    steps, r = len(states) - 1, network.regions
    return Observed(
        accumulation=states,
        demand=np.zeros((steps, r, r)),
        perimeter=np.zeros((steps, r, r)),
        splits=np.zeros((steps, r, r, r)),
        crossings=np.zeros((steps, r, r)),
    )


def test_persistence_is_what_it_says(network):
    """A region that gains 10 vehicles in every interval: 10 after one, 40 after four."""
    state = np.zeros((9, 3, 3))
    state[:, 0, 0] = 10.0 * np.arange(9)
    run, critical = observed(network, state), network.mfds[0].critical
    errors = predictions(network, [run, run], {"step": 225.0, "substeps": 8, "integrator": "euler"})
    assert (errors["ahead_s"] == 900.0).all()
    shares = errors[["next_interval_persistence_rmse_share", "ahead_persistence_rmse_share"]].to_numpy()
    assert shares[0] * critical == pytest.approx([10.0, 40.0]) and (shares[1:] == 0.0).all()
    table = prediction_table(network, errors, 225.0)
    assert table.splitlines()[0].count("unchanged") == 2
    assert f"{100 * shares[0, 0]:.1f} %" in table.splitlines()[1]


def test_every_table_of_predictions_has_persistence():
    shares = ("next_interval_rmse_share", "next_interval_persistence_rmse_share")
    rows = pd.DataFrame({"demand": [1.0, 1.0], "controller": "x", "runs": 1, "model": "", "most_share": 1.0})
    rows = rows.assign(**dict.fromkeys(shares, 0.25), ahead_s=900.0)
    rows = rows.assign(ahead_rmse_share=0.1, ahead_persistence_rmse_share=0.1)
    line = model_validation.prediction_table(rows).splitlines()
    assert line[0].count("if nothing changed") == 2 and line[1].count("25.0 %") == 2


def crossing(flow, share):
    flow = np.array(flow, dtype=float)
    gateways = (flow >= 0).astype(int) - np.eye(len(flow), dtype=int)
    return Boundaries(flow=flow, controlled=share * flow, gateways=gateways, controllable=gateways * int(share > 0))


FLOW = [[0, 300, 0], [100, 0, 100], [0, 300, 0]]


@pytest.mark.parametrize(
    "most, started, share, answer",
    [
        ((0.5, 0.9, 0.2), (10, 10, 10), 1.0, "No: no region is ever critical, region 1 comes nearest with 0.90"),
        ((0.5, 1.9, 0.2), (10, 10, 10), 0.0, "No: no gateway has a signal"),
        ((0.5, 1.9, 0.2), (10, 600, 10), 1.0, "It may: region 1 becomes critical, and gateways could hold 50%"),
        (
            (0.5, 1.9, 0.2),
            (10, 5400, 10),
            1.0,
            "Hardly: regions become critical, but gateways could hold no more than 10",
        ),
        ((0.5, 1.9, 0.2), (10, 600, 10), 0.06, "No: regions become critical, but gateways could hold no more than 3%"),
    ],
)
def test_the_verdict_has_reasons_and_numbers(network, most, started, share, answer):
    most, started = np.array(most), np.array(started, dtype=float)
    found = verdict(network, crossing(FLOW, share), most=most, started=started, where="in 2 runs")
    assert found.sentences[0].startswith(f"Can perimeter control help? {answer}"), found.sentences
    text = found.text()
    assert f"{share:.0%} of the 800 crossings in 2 runs" in text
    table = text.partition("\n\n")[2].splitlines()
    assert len(table) == 1 + (crossing(FLOW, 1.0).gateways > 0).sum()


def test_nobody_crosses(network):
    found = verdict(network, crossing(np.zeros((3, 3)), 1.0), most=np.ones(3), started=np.ones(3), where="in 1 run")
    assert "No: no vehicle crosses" in found.sentences[0]
