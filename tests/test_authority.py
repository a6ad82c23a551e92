"""Verdicts on perimeter control: the answer, its numbers, and the commands that come next."""

from dataclasses import replace

import numpy as np
import pytest

from nmfd.model.authority import Boundaries, verdict


@pytest.fixture
def network(three_regions):
    return three_regions.network


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
    known = {
        "most": np.array(most) * network.critical,
        "started": np.array(started, dtype=float),
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
        (1.9, 10, 0.0, "No: no gateway has a signal", (), 1),
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


CROWDED = (
    "There, up to 0 vehicles waited outside at a time, and a trip took 12.0 times its free-flow "
    "time"
)


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
