"""The searches of route guidance against all ways there are, in a small random city."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.guidance import Guide, shifted
from cosim.measure import Event
from cosim.regions import City, Gateway
from cosim.ways import Home, Moves, Ways

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
    inside, back = (Moves(first, second, turn, allowed=(REGION == 0) ^ outside, reverse=outside)
                    for outside in (False, True))
    gates = sorted({(int(REGION[b]), int(a), int(b)) for a, b in zip(first, second, strict=True)
                    if REGION[a] == 0 and REGION[b] != 0})
    following, gate, entry = np.array(gates).T
    return Ways(gate, entry, following, inside=inside, outside=back, time=time,
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


def test_ways_home_are_the_fastest_up_to_a_limit(city):
    first, second, turn, time = city
    exact = least(city, np.full(EDGES, True))
    home = Home(Moves(first, second, turn, allowed=np.full(EDGES, True), reverse=True), time)
    turns = {(int(a), int(b)): extra for a, b, extra in zip(first, second, turn, strict=True)}
    for most in (60.0, np.inf, 100.0):
        for here in range(EDGES):
            for target in range(EDGES):
                expected = exact[here, target] if exact[here, target] <= most else np.inf
                assert home.cost(here, target, most) == pytest.approx(expected)
                if np.isfinite(expected):
                    way = home.route(here, target)
                    assert (way[0], way[-1]) == (here, target)
                    assert sum(turns[move] + time[move[1]] for move in zip(way[:-1], way[1:], strict=True)) == (
                        pytest.approx(expected))


# A main road a m b t of 10 s each, of which m is in another region, and the side street s of `side` s from a to t.
REGION_OF = {"a": 0, "b": 0, "m": 1, "s": 0, "t": 2}
AFTER = {"a": ("m", "s"), "b": ("t",), "m": ("b",), "s": ("t",), "t": ()}


def guided(route, *, ways_return, side=40.0, to_region_1=0.5):
    """The route of a driver on a bound for t after guidance, and the region for which he is said to leave."""
    moves = [(e, f) for e, after in AFTER.items() for f in after]
    edges = tuple(sorted(AFTER))
    city = City(
        net_file=Path(), regions=3, region_of=REGION_OF, edges=edges, length=dict.fromkeys(edges, 10.0) | {"s": side},
        lanes=dict.fromkeys(edges, 1), lane_ids={}, speed=dict.fromkeys(edges, 1.0), successors=AFTER,
        turn_time=dict.fromkeys(moves, 0.0), signals={},
        gateways=tuple(sorted((
            Gateway(source=REGION_OF[e], target=REGION_OF[f], from_edge=e, to_edge=f, signal=None, links=())
            for e, f in moves if REGION_OF[e] != REGION_OF[f]), key=lambda g: (g.source, g.target))))
    routes = {"driver": route}
    session = SimpleNamespace(
        road=lambda vehicle: routes[vehicle][0], route=routes.get, route_index=lambda vehicle: 0,
        set_route=lambda vehicle, way: routes.update({vehicle: tuple(way)}) or True)
    own, splits = np.zeros((2, 3, 3, 3))
    own[0, 1:, 2], own[1, 0, 2] = 0.5, 1.0
    splits[0, 1:, 2], splits[1, 0, 2] = (to_region_1, 1.0 - to_region_1), 1.0
    guide = Guide(session, city, own, compliance=1.0, most_detour=60.0, random=np.random.default_rng(0),
                  ways_return=ways_return)
    guide.command(splits, None)
    guide.apply([Event(vehicle="driver", source=None, region=0, destination=2, edge="t")])
    return "".join(routes["driver"]), int(guide.realised[0, :, 2].argmax())


@pytest.mark.parametrize("route", ["ambt", "ast"])
def test_a_main_road_that_leaves_the_region_and_comes_back_is_open_to_all(route):
    assert guided(tuple(route), ways_return=True) == ("ambt", 2)  # he leaves region 0 for good by b t
    assert guided(tuple(route), ways_return=False) == ("ast", 2)


def test_ways_that_return_are_taken_where_they_are_faster_and_no_command_for_the_next_region_closes_them():
    assert guided(tuple("ast"), ways_return=True, side=12.0) == ("ast", 2)
    assert guided(tuple("ambt"), ways_return=True, side=2.0) == ("ast", 2)
    for to_region_1 in (0.0, 0.5, 1.0):  # nobody can leave for 1 for good: there is no other way on than back
        assert guided(tuple("ambt"), ways_return=True, to_region_1=to_region_1)[0] == "ambt"


def test_shifted_shares_keep_their_sum_and_follow_theta():
    wish, own = np.array([0.5, 0.3, 0.2]), np.array([0.6, 0.2, 0.2])
    np.testing.assert_allclose(shifted(wish, own, own), wish)
    moved = shifted(wish, own, np.array([0.3, 0.5, 0.2]))
    np.testing.assert_allclose(moved, [0.25, 0.55, 0.2])
