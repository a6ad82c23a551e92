"""A fit that explains nothing says so, and predictions stand beside the one that nothing
changes."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny

from cosim.evaluation import model_validation
from nmfd.model.authority import Boundaries, verdict
from nmfd.model.identification import Observed
from nmfd.model.mfd import Cubic
from nmfd.model.regional_model import load_network
from nmfd.studies.fit_quality import (
    MEANINGS,
    fit_table,
    prediction_text,
    predictions,
    region_fits,
    with_guesses,
    write_fits,
)


@pytest.fixture
def network(tmp_path):
    tiny.write(tmp_path, network=tiny.row_network(3))
    return load_network(tmp_path / "network")


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
        accumulation=states, demand=pairs, perimeter=pairs, splits=none, crossings=pairs
    )


def test_persistence_is_what_it_says(network):
    """A region that gains 10 vehicles in every interval: 10 after one, 40 after four."""
    state = np.zeros((9, 3, 3))
    state[:, 0, 0] = 10.0 * np.arange(9)
    run, critical = observed(network, state), network.mfds[0].critical
    errors = predictions(network, [run, run], {"step": 225.0, "substeps": 8, "integrator": "euler"})
    assert (errors["ahead_s"] == 900.0).all()
    shares = errors[
        ["next_interval_persistence_rmse_share", "ahead_persistence_rmse_share"]
    ].to_numpy()
    assert shares[0] * critical == pytest.approx([10.0, 40.0])
    assert (shares[1:] == 0.0).all()
    unseen = replace(network, critical_above={0: 0.5 * critical})
    twice = predictions(unseen, [run, run], {"step": 225.0, "substeps": 8, "integrator": "euler"})
    assert twice["ahead_persistence_rmse_share"][0] == pytest.approx(2.0 * shares[0, 1])
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
    line = model_validation.prediction_table(rows).splitlines()
    assert line[0].count("if nothing changed") == 2
    assert line[1].count("25.0 %") == 2


def crossing(flow, share):
    flow = np.array(flow, dtype=float)
    gateways = (flow >= 0).astype(int) - np.eye(len(flow), dtype=int)
    return Boundaries(
        flow=flow,
        controlled=share * flow,
        gateways=gateways,
        controllable=gateways * int(share > 0),
    )


FLOW = [[0, 300, 0], [100, 0, 100], [0, 300, 0]]


def judged(network, boundaries, most, started, waiting=0.0, slowness=1.3):
    """The verdict of accumulations that are multiples of the critical ones."""
    most, started = np.array(most) * network.critical, np.array(started, dtype=float)
    known = {
        "most": most,
        "started": started,
        "waiting": waiting,
        "slowness": slowness,
        "where": "in 2 runs",
    }
    return verdict(network, boundaries, scenario="scenarios/x", **known)


@pytest.mark.parametrize(
    "load, started, share, answer, protect, commands",
    [
        (
            0.9,
            10,
            1.0,
            "No: no region is seen to become critical, region 1 comes nearest with 0.90",
            (),
            3,
        ),
        (1.9, 10, 0.0, "No: no gateway has a signal", (), 2),
        (1.9, 600, 1.0, "It may: region 1 becomes critical, and gateways could hold 50%", (1,), 0),
        (
            1.9,
            5400,
            1.0,
            "Hardly: regions become critical, but gateways could hold no more than 10",
            (1,),
            0,
        ),
        (
            1.9,
            600,
            0.06,
            "No: regions become critical, but gateways could hold no more than 3%",
            (),
            2,
        ),
    ],
)
def test_the_verdict_has_reasons_numbers_and_commands(
    network, load, started, share, answer, protect, commands
):
    found = judged(network, crossing(FLOW, share), (0.5, load, 0.2), (10, started, 10))
    assert found.sentences[0].startswith(f"Can perimeter control help? {answer}"), found.sentences
    assert found.protect == protect
    assert sum("cosim " in each for each in found.sentences[1:]) == commands
    text = found.text()
    assert f"{share:.0%} of the 800 crossings in 2 runs" in text
    table = text.partition("\n\n")[2].splitlines()
    assert len(table) == 1 + (crossing(FLOW, 1.0).gateways > 0).sum()


CROWDED = "There, up to 0 vehicles waited outside at a time, and a trip took 12.0 times its free-flow time"


@pytest.mark.parametrize(
    "changes, busy, answer, words",
    [
        (
            {"placeholder": True},
            {"waiting": 584.0},
            "Cannot say yet: the critical",
            "cosim identify scenarios/x",
        ),
        ({"placeholder": True}, {}, "Cannot say yet", "cosim identify scenarios/x"),
        (
            {},
            {"waiting": 584.0},
            "Cannot say yet: up to 584 vehicles",
            "cosim identify scenarios/x --levels",
        ),
        ({}, {"slowness": 12.0}, "Cannot say yet: up to 0 vehicles", CROWDED),
        (
            {},
            {"slowness": np.nan},
            "No: no region is seen",
            "no-control+max-pressure --demand 1,1.3,1.6",
        ),
        (
            {"critical_above": {1: 480.0}},
            {},
            "No: no region is seen",
            "region 1 above 480 veh, not seen",
        ),
        (
            {"critical_above": dict.fromkeys(range(3), 9.0)},
            {},
            "No: no region is seen to become critical; more",
            "",
        ),
    ],
)
def test_no_verdict_on_guesses_or_on_congestion_that_no_region_explains(
    network, changes, busy, answer, words
):
    """584 vehicles outside and trips of 12 times the free-flow time are no "No: nothing to
    protect"."""
    load = (0.5, 1.9 if "critical_above" in changes else 0.4, 0.2)
    found = judged(replace(network, **changes), crossing(FLOW, 1.0), load, (4000, 10, 10), **busy)
    assert found.sentences[0].startswith(f"Can perimeter control help? {answer}")
    assert words in found.text()
    assert found.protect == ()


def test_all_regions_that_gates_can_hold_are_to_be_protected_and_none_if_nobody_crosses(network):
    assert judged(network, crossing(FLOW, 1.0), (1.5, 1.9, 1.2), (99, 99, 9)).protect == (0, 1, 2)
    found = judged(network, crossing(np.zeros((3, 3)), 1.0), np.ones(3), np.ones(3))
    assert "No: no vehicle crosses" in found.sentences[0]
    assert found.protect == ()
