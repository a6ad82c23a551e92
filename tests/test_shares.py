"""The next region of drivers, by shares and travel times worked out by hand."""

import math

import numpy as np
import pytest

from cosim.plant import fastest
from cosim.plant.fastest import UNKNOWN
from cosim.plant.shares import MEMORY, SHARE_PENALTY_S, Shares

HALF = (0.5, 0.5)


@pytest.mark.parametrize(
    "wish, own, theta, expected",
    [
        ((0.9, 0.1), HALF, HALF, (0.9, 0.1)),
        ((1.0, 0.0), HALF, (0.25, 0.75), (0.5, 0.5)),
        ((0.2, 0.8), HALF, (1.0, 0.0), (1.0, 0.0)),
        ((0.6, 0.4, 0.0), (0.5, 0.3, 0.2), (0.0, 0.4, 0.6), (0.0, 0.52, 0.48)),
    ],
    ids=["as they are", "half of them", "all of them", "freed by how much theta raises"],
)
def test_theta_shifts_wishes(wish, own, theta, expected):
    assert fastest.shifted.py_func(*map(np.array, (wish, own, theta))) == pytest.approx(
        np.array(expected)
    )


@pytest.mark.parametrize(
    "times, shares, given, expected",
    [
        ((100.0, 110.0), HALF, (0.0, 0.0), 0),
        ((100.0, 110.0), HALF, (1.0, 0.0), 1),
        ((100.0, 100.0 + SHARE_PENALTY_S), HALF, (1.0, 0.0), 0),
        ((100.0, 110.0), (0.0, 1.0), (0.0, 0.0), 1),
        ((math.inf, 110.0), HALF, (0.0, 9.0), 1),
        ((math.inf, 110.0), (1.0, 0.0), (0.0, 0.0), 1),
        ((100.0, 100.0), HALF, (0.0, 0.0), 0),
    ],
    ids=[
        "fastest",
        "behind",
        "not far behind",
        "no share",
        "too long",
        "only share too long",
        "tie",
    ],
)
def test_the_cheapest_next_region_is_assigned(times, shares, given, expected):
    arrays = map(np.array, (times, shares, given))
    assert fastest.assigned.py_func(*arrays, SHARE_PENALTY_S) == expected


def splits_of(shares):
    """Return split ratios from region 0 to 3 by 1 and 2."""
    splits = np.zeros((4, 4, 4))
    splits[0, 1:3, 3] = shares
    return splits


def shares_of(theta):
    """Return shares of drivers from region 0 to 3, half of whom go by 1 without guidance."""
    shares = Shares(splits_of(HALF))
    shares.command(splits_of(theta))
    return shares


def next_region(shares, *times, exists=(True, True), limit=math.inf):
    neighbours = np.array([1, 2])
    arrays = neighbours, np.array(times), np.array(exists)
    return fastest.chosen(shares.counts, 0, 3, *arrays, limit)


def test_a_region_without_a_route_leaves_its_share_to_others():
    assert next_region(shares_of((0.25, 0.75)), 100.0, math.inf, exists=(True, False)) == 0
    nowhere = next_region(shares_of(HALF), math.inf, math.inf, exists=(False, False))
    assert nowhere == UNKNOWN


def test_a_region_beyond_the_limit_gets_nobody_although_theta_says_so():
    assert next_region(shares_of((0.0, 1.0)), 100.0, 150.0, limit=160.0) == 1
    assert next_region(shares_of((0.0, 1.0)), 100.0, 150.0, limit=140.0) == 0


def test_a_driver_who_is_assigned_anew_counts_no_more_for_the_region_before():
    theta = (0.25, 0.75)
    shares = shares_of(theta)  # all wish to go by 1, half of them shall
    visits = np.array([(0, 3, 0, 0, UNKNOWN, 0)], fastest.VISIT)
    fastest.assign(shares.counts, visits, 0, 1)
    assert next_region(shares, 100.0, 101.0) == 1
    shares.command(splits_of(theta))
    assert shares.counts.given[0, 3, 1] == MEMORY
    fastest.assign(shares.counts, visits, 0, 2)
    assert shares.counts.given[0, 3].tolist() == pytest.approx([0.0, 0.0, 1.0, 0.0])
    assert shares.counts.realised[0, :, 3].tolist() == [0, 0, 1, 0]
    assert next_region(shares, 100.0, 101.0) == 0
