"""The searches of route guidance against all ways there are, in a small random city."""

import numpy as np
import pytest

from cosim.guidance import _Moves, _Ways, shifted

EDGES, REGION = 40, np.repeat([0, 1, 2, 3], 10)


@pytest.fixture(scope="module")
def city():
    """Moves first -> second with the time of their turns, and the time of every edge."""
    random = np.random.default_rng(3)
    pairs = sorted({(int(a), int(b)) for a, b in random.integers(EDGES, size=(160, 2)) if a != b and a != 39})
    first, second = np.array(pairs).T
    return first, second, random.uniform(0.0, 3.0, len(pairs)), random.uniform(5.0, 60.0, EDGES)


@pytest.fixture(scope="module")
def ways(city):
    """Out of region 0."""
    first, second, turn, time = city
    inside, back = (_Moves(first, second, turn, allowed=(REGION == 0) ^ outside, reverse=outside)
                    for outside in (False, True))
    gates = sorted({(int(REGION[b]), int(a), int(b)) for a, b in zip(first, second, strict=True)
                    if REGION[a] == 0 and REGION[b] != 0})
    following, gate, entry = np.array(gates).T
    return _Ways(gate, entry, following, inside=inside, outside=back, time=time,
                 reached=back.leading_to(back.number[entry]), ahead=back.ahead(back.number[entry], 0.8 * time)
                 ), gate, entry


def least(city, allowed):
    """(EDGES, EDGES) [s] from the end of one edge to the end of another over allowed edges, by Floyd and Warshall."""
    first, second, turn, time = city
    cost = np.full((EDGES, EDGES), np.inf)
    np.fill_diagonal(cost, np.where(allowed, 0.0, np.inf))
    for a, b, extra in zip(first, second, turn, strict=True):
        if allowed[a] and allowed[b]:
            cost[a, b] = min(cost[a, b], time[b] + extra)
    for k in range(EDGES):
        cost = np.minimum(cost, cost[:, [k]] + cost[[k]])
    return cost


def test_the_searches_find_the_least_times_up_to_a_limit(city, ways):
    found, gate, entry = ways
    inside, outside = least(city, REGION == 0), least(city, REGION != 0)
    turns = {pair: extra for *pair, extra in zip(*city[:3], strict=True) for pair in [tuple(map(int, pair))]}
    cut = 0
    for most in (60.0, np.inf, 150.0):  # a wider search may come later, a narrower one may use it
        for here in range(10):
            for target in range(10, EDGES):
                exact = inside[here, gate] + city[3][entry] + outside[entry, target]
                cost, reached = found.cost(here, target, most)
                np.testing.assert_array_equal(reached, np.isfinite(exact))
                np.testing.assert_allclose(cost[exact <= most], exact[exact <= most])
                assert (cost[exact > most] >= exact[exact > most] - 1e-9).all()
                cut += int((np.isinf(cost) & np.isfinite(exact)).sum())
                for g in np.flatnonzero(np.isfinite(exact) & (exact <= most)):
                    way = found.route(here, int(g), target)
                    assert way[0] == here and way[-1] == target
                    crossing = way.index(int(entry[g]))
                    assert way[crossing - 1] == gate[g] and (REGION[way[crossing:]] != 0).all()
                    takes = city[3][way[1:]].sum() + sum(
                        turns[move] for move in zip(way[:-1], way[1:], strict=True) if move != (gate[g], entry[g]))
                    assert takes == pytest.approx(exact[g])
    assert cut > 100


def test_shifted_shares_keep_their_sum_and_follow_theta():
    wish, own = np.array([0.5, 0.3, 0.2]), np.array([0.6, 0.2, 0.2])
    np.testing.assert_allclose(shifted(wish, own, own), wish)
    moved = shifted(wish, own, np.array([0.3, 0.5, 0.2]))
    np.testing.assert_allclose(moved, [0.25, 0.55, 0.2])
