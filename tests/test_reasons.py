"""Why a controller gains or not: made-up runs of which the reason is known."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import tiny
import trajectories

from cosim.evaluation import explain, signal_reasons
from nmfd.model.regional_model import load_network


@pytest.fixture
def network(tmp_path):
    tiny.write(tmp_path)
    return load_network(tmp_path / "network")


def run(network, load, u):
    """A run of 10 intervals: every region holds `load` times its critical accumulation in the second half."""
    count = network.regions
    critical = np.array([mfd.critical for mfd in network.mfds])
    state = np.zeros((11, count, count))
    state[6:] = np.diag(load * critical)
    perimeter = np.broadcast_to(np.where(network.adjacency, u, 0.0), (10, count, count))
    return trajectories.made(
        controller="x",
        plant="sumo",
        seed=0,
        step=90.0,
        accumulation=state,
        backlog=np.zeros_like(state),
        completed=np.zeros(11),
        perimeter=perimeter,
        splits=np.zeros((10, count, count, count)),
        decision_time=np.zeros(10),
        wall_time=1.0,
    )


def record(network, started, came, guided=0.0):
    """Vehicles that departed in every region, and that entered it."""
    count = network.regions
    crossings = np.zeros((1, count, count, count))
    crossings[0, ..., 0] = np.where(network.adjacency, came / np.maximum(network.adjacency.sum(axis=0), 1), 0.0)
    return {
        "departures": np.full((1, count, count), started / count),
        "crossings": crossings,
        "guided": np.array([guided]),
    }


def table(percent, full=0.01):
    rows = [
        {
            "demand": 1.0,
            "controller": name,
            "seed": 2000 + n,
            "total_time_spent_veh_s": tts,
            "gateway_full_share": share,
        }
        for name, values, share in (("no-control", [100.0, 110.0, 105.0], 0.01), ("pi-gating", percent, full))
        for n, tts in enumerate(values)
    ]
    return pd.DataFrame(rows)


BETTER, WORSE, ALIKE = [80.0, 88.0, 84.1], [120.0, 132.0, 126.1], [101.0, 108.0, 105.0]


@pytest.mark.parametrize(
    "values, most, leaking, u, started, full, expected",
    [
        (
            BETTER,
            2.0,
            0.0,
            0.3,
            1,
            0.01,
            "gains (-20.0 % in total time spent ± 0.1 over 3 seeds); it held back in 100 %",
        ),
        (ALIKE, 0.5, 0.0, 0.9, 1, 0.01, "no region is ever critical"),
        (ALIKE, 2.0, 0.8, 0.3, 1, 0.01, "no control authority at the boundaries, 80 % of the flow"),
        (ALIKE, 2.0, 0.0, 0.9, 1, 0.01, "it never held back and never guided"),
        (WORSE, 2.0, 0.0, 0.3, 900, 0.01, "starts there, where no gateway holds it back"),
        (WORSE, 2.0, 0.0, 0.3, 1, 0.20, "fill the streets before the gateways (20 % of the time, 1 % without"),
    ],
)
def test_known_reasons(network, values, most, leaking, u, started, full, expected):
    rows = table(values, full)
    found = explain.load(network, [run(network, most, 0.9)], [record(network, started, 100)])
    done = explain.deeds(network, [run(network, most, u)], [record(network, started, 100)])
    line = explain.verdict(rows, 1.0, "pi-gating", found, leaking, done, network)
    assert expected in line
    kind = {tuple(BETTER): "gains (", tuple(WORSE): "loses (", tuple(ALIKE): "gains nothing"}[tuple(values)]
    assert line.startswith(kind), line
    if expected.startswith(("no region", "it never")):
        assert "queues" not in line and "authority" not in line


def test_load_and_deeds_are_counted(network):
    found = explain.load(network, [run(network, 2.0, 0.9), run(network, 1.2, 0.9)], [record(network, 50, 150)])
    assert found.most == pytest.approx(1.6) and found.beyond == pytest.approx(5 / 11)
    entered = network.adjacency.any(axis=0)
    assert found.inside[entered] == pytest.approx(0.25) and list(found.critical) == list(range(network.regions))
    half = run(network, 1.0, 0.9)
    half = replace(half, perimeter=np.concatenate([half.perimeter[:5], run(network, 1.0, 0.2).perimeter[:5]]))
    done = explain.deeds(network, [half], [record(network, 50, 150, guided=100.0 * network.regions)])
    assert done.held == 0.5 and done.guided == pytest.approx(2.0) and done.waited == 0.0
    backlog = np.zeros_like(half.backlog)
    backlog[3:5, 0, 1] = 10.0  # vehicles, for two intervals of 90 s
    waiting = [replace(half, backlog=backlog)] * 2
    done = explain.deeds(network, waiting, [record(network, 6, 1)] * 2, metered=True)
    trips = 6 * network.regions
    assert done.waited == pytest.approx(10.0 * 180.0 / trips)
    assert str(done) == (
        f"it held back in 50 % of its commands and its trips waited {1800 / trips:.0f} s before they began"
    )
    assert explain.deeds(network, waiting, [record(network, 6, 1)] * 2).waited == 0.0


@pytest.mark.parametrize(
    "city, name, waits",
    [({}, "pi-gating", False), ({"metering": True}, "pi-gating", True), ({}, "pi-gating+metering", True)],
)
def test_trips_can_wait_by_the_strategy_or_everywhere_in_a_city(tmp_path, city, name, waits):
    sumo = {"configuration": {"sumo": city}, "controllers": {}, "sessions": []}
    (tmp_path / "manifest.json").write_text(json.dumps(sumo), encoding="utf-8")
    assert explain._metered(tmp_path, name) == waits


def test_nothing_to_compare_with(network):
    rows = table(ALIKE)[lambda frame: frame["controller"] != "no-control"]
    found = explain.load(network, [run(network, 2.0, 0.9)], [])
    line = explain.verdict(rows, 1.0, "pi-gating", found, 0.0, explain.ControlActivity(held=0.1, guided=0.0), network)
    assert "no common seed with no-control" in line and np.isnan(found.inside).all()


def test_why_max_pressure_costs_time(network):
    """A sentence with the numbers, in the evaluation and beside the table of a run; none where it gains."""
    facts = {
        "signal_lanes": 33,
        "split_lanes": 19,
        "never_whole_lanes": 2,
        "intergreen_share": 0.3,
        "programmed_intergreen_share": 0.1,
        "signals_left_alone": 4,
    }
    rows = table(WORSE).replace("pi-gating", "max-pressure")
    for key, value in facts.items():
        rows[key] = np.where(rows["controller"] == "max-pressure", value, np.nan)
    found, done = explain.load(network, [run(network, 0.5, 0.9)], []), explain.ControlActivity(held=0.0, guided=0.0)
    line = explain.verdict(rows, 1.0, "max-pressure", found, 0.0, done, network)
    [sentence] = signal_reasons.losses(rows)
    for text in (line, sentence):
        assert "19 of 33 lanes before its signals are shared by movements that a stage serves one without" in text
        assert "2 of them are shared by movements that no stage serves together" in text
        assert "between two stages 30 % of the time" in text and "are 10 %" in text and "4 signals keep" in text
    assert sentence.startswith("max-pressure costs 20.0 % against no-control here: ")
    assert not signal_reasons.losses(table(BETTER).replace("pi-gating", "max-pressure"))
    assert not signal_reasons.losses(rows[[c for c in rows if c != "split_lanes"]])  # runs of an older version
