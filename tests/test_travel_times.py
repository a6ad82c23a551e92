"""What streets and junctions take, worked out by hand: a, 100 m at up to 10 m/s, leads over a
junction to b and c."""

import math

import numpy as np
import pytest
import streets
from streets import seen

from cosim.plant.routes import EMPTY_WEIGHT, PRIOR_VEH_S, STANDING_M_S, WINDOW_S, TravelTimes

NOBODY = math.nan


@pytest.fixture
def times():
    """Into b one turns over two internal edges, of which the first is shared with c."""
    city = streets.city(
        {"a": 0, "b": 0, "c": 0},
        {"a": ("b", "c"), "b": (), "c": ()},
        length=dict.fromkeys("abc", 100.0),
        speed=dict.fromkeys("abc", 10.0),
        turn_time={("a", "b"): 2.0, ("a", "c"): 1.0},
        over={("a", "b"): (":1", ":2"), ("a", "c"): (":1",)},
        inside={":1": 8.0, ":2": 4.0},
    )
    return TravelTimes(city)


def learn(times, *speeds, vehicles=(2.0, 2.0, 2.0), **others):
    on = [0.0 if math.isnan(speed) else n for speed, n in zip(speeds, vehicles, strict=True)]
    times.learn(seen(speeds, on, **{"crossing": (0.0, 0.0), "crossed": (0.0, 0.0)} | others))


def seconds(driven, spent):
    """The time of an edge by what was driven [veh m] and the time spent [veh s] on it."""
    return pytest.approx(100.0 * (spent + PRIOR_VEH_S) / (driven + 10.0 * PRIOR_VEH_S))


def test_at_first_everything_is_free(times):
    assert times.edges.tolist() == times.free.tolist() == [10.0] * 3
    assert times.turns.tolist() == times.free_turns.tolist() == [2.0, 1.0]
    assert times.first.tolist() == [0, 0]
    assert times.second.tolist() == [1, 2]
    learn(times, NOBODY, NOBODY, NOBODY)
    assert times.edges.tolist() == [10.0] * 3
    assert times.turns.tolist() == [2.0, 1.0]


def test_many_count_more_than_few_and_nobody_is_faster_than_allowed(times):
    learn(times, 2.0, 2.0, 30.0, vehicles=(2.0, 0.01, 2.0), duration=60.0)
    for edge, spent in ((0, 120.0), (1, 0.6)):
        assert times.edges[edge] == seconds(2.0 * spent, spent)
    assert times.edges[2] == 10.0


def test_the_newest_counts_most(times):
    learn(times, 2.0, 2.0, 2.0, duration=60.0)
    learn(times, 8.0, NOBODY, 8.0, vehicles=(1.0, 0.0, 1.0), duration=90.0)
    kept = math.exp(-90.0 / WINDOW_S)
    assert times.edges[0] == seconds(240.0 * kept + 8.0 * 90.0, 120.0 * kept + 90.0)
    # An empty street is soon as good as free.
    assert times.edges[1] == seconds(240.0 * EMPTY_WEIGHT, 120.0 * EMPTY_WEIGHT)
    for _ in range(12):
        learn(times, 8.0, NOBODY, 8.0, vehicles=(1.0, 0.0, 1.0))
    assert times.edges[1] == pytest.approx(10.0, rel=0.02)
    assert times.edges[0] == pytest.approx(12.5, rel=0.1)


def test_a_long_interval_leaves_less_of_an_empty_street(times):
    learn(times, 2.0, 2.0, 2.0, duration=60.0)
    learn(times, NOBODY, NOBODY, NOBODY, duration=900.0)
    kept = math.exp(-900.0 / WINDOW_S)
    assert times.edges[0] == seconds(240.0 * kept, 120.0 * kept)


def test_closed_and_standing_streets_are_so_at_once(times):
    learn(times, 8.0, 8.0, 8.0, vehicles=(50.0, 50.0, 50.0))
    learn(times, 0.0, NOBODY, 0.01, vehicles=(0.0, 0.0, 2e4))
    assert times.edges[0] == times.edges[2] == 100.0 / STANDING_M_S
    assert 12.0 < times.edges[1] < 13.0
    learn(times, NOBODY, NOBODY, NOBODY)
    assert times.edges[0] < 20.0  # open again


def test_turns_take_those_on_the_junction_by_those_who_get_over_it(times):
    """1.5 vehicles there, one in 10 s gets over it: 15 s."""
    learn(times, NOBODY, NOBODY, NOBODY, crossing=(1.5, 0.4), crossed=(0.1, 0.2), duration=90.0)
    assert times.turns.tolist() == pytest.approx([15.0 + 2.0, 15.0])
    learn(times, NOBODY, NOBODY, NOBODY, crossing=(0.5, 0.0), crossed=(0.5, 0.0), duration=60.0)
    kept = math.exp(-60.0 / WINDOW_S)
    takes = (1.5 * 90.0 * kept + 0.5 * 60.0) / (0.1 * 90.0 * kept + 0.5 * 60.0)
    assert times.turns.tolist() == pytest.approx([takes + 2.0, takes])


def test_who_stands_on_a_junction_takes_as_long_as_at_the_slowest_speed(times):
    learn(times, NOBODY, NOBODY, NOBODY, crossing=(1.0, 1.0), crossed=(0.0, 1e-9))
    assert times.turns.tolist() == pytest.approx(
        [8.0 / STANDING_M_S + 4.0 / STANDING_M_S, 8.0 / STANDING_M_S]
    )
    learn(times, NOBODY, NOBODY, NOBODY, crossing=(0.0, 0.0), crossed=(1e6, 1e6))
    assert np.allclose(times.turns, [2.0, 1.0])  # no faster than in free flow
