"""The searches of route guidance against all ways there are, in a small random city."""

from itertools import pairwise, product
from unittest.mock import Mock

import libsumo
import numpy as np
import pytest
import streets
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from streets import seen

from cosim.plant import guidance, routes
from cosim.plant.guidance import Guide
from cosim.plant.meter import Event
from cosim.plant.routes import MOST_NODES, Exits, Moves, Returning, Trees, Ways

EDGES, REGION = 40, np.repeat([0, 1, 2, 3], 10)


@pytest.fixture(scope="module")
def city():
    """Moves first -> second with the time of their turns, and the time of every edge."""
    random = np.random.default_rng(3)
    pairs = sorted(
        {(int(a), int(b)) for a, b in random.integers(EDGES, size=(160, 2)) if a != b and a != 39}
    )
    first, second = np.array(pairs).T
    return first, second, random.uniform(0.0, 3.0, len(pairs)), random.uniform(5.0, 60.0, EDGES)


@pytest.fixture(params=[MOST_NODES, 1])
def ways(city, request, monkeypatch):
    """Out of region 0, with all searches kept or hardly any."""
    monkeypatch.setattr(routes, "MOST_NODES", request.param)
    first, second, turn, time = city
    inside, outside = (
        Moves(first, second, allowed=(REGION == 0) ^ outside, reverse=outside)
        for outside in (False, True)
    )
    gates = sorted(
        {
            (int(REGION[b]), int(a), int(b), n)
            for n, (a, b) in enumerate(zip(first, second, strict=True))
            if REGION[a] == 0 and REGION[b] != 0
        }
    )
    following, gate, entry, move = np.array(gates).T
    ahead = outside.ahead(outside.number[entry], 0.8 * time, 0.7 * turn)
    moves = Moves(first, second, allowed=np.full(EDGES, True), reverse=False)
    everywhere = Trees(moves, time, turn, aims=gate)
    exits = Exits(np.array([gate, entry, move, following]).T, inside=inside, outside=outside)
    over = turn[move] + time[entry]
    there = Trees(inside, time, turn, aims=exits.first_nodes, beyond=over)
    onward = Trees(outside, time, turn, ahead, aims=exits.second_nodes)
    returning = Returning(everywhere, over, back_to(gate, entry, city))
    found = Ways(exits, there=there, onward=onward, ahead=ahead, everywhere=returning)
    return found, gate, entry


def least(city, allowed):
    """(EDGES, EDGES) [s] from the end of one edge to the end of another over allowed edges, by
    Floyd and Warshall."""
    first, second, turn, time = city
    cost = np.full((EDGES, EDGES), np.inf)
    np.fill_diagonal(cost, np.where(allowed, 0.0, np.inf))
    for a, b, extra in zip(first, second, turn, strict=True):
        if allowed[a] and allowed[b]:
            cost[a, b] = min(cost[a, b], time[b] + extra)
    for k in range(EDGES):
        cost = np.minimum(cost, cost[:, [k]] + cost[[k]])
    return cost


def takes(way, city):
    """The time [s] from the end of the first edge of a way to that of its last."""
    turns = {(int(a), int(b)): extra for a, b, extra in zip(*city[:3], strict=True)}
    return sum(turns[move] + city[3][move[1]] for move in pairwise(way))


def back_to(gate, entry, city):
    """(G,) [s] from behind the nearest gateway back to each."""
    return 0.8 * least(city, np.full(EDGES, True))[np.ix_(entry, gate)].min(axis=0)


@pytest.mark.parametrize("detour", [0.0, 40.0])
def test_the_fastest_ways_are_found_up_to_a_limit(city, ways, detour):
    """By each next region, and those that come back where they are the fastest of all."""
    found, gate, entry = ways
    inside, outside = least(city, REGION == 0), least(city, REGION != 0)
    fastest_of_all = least(city, np.full(EDGES, True))
    over = [takes(move, city) for move in zip(gate.tolist(), entry.tolist(), strict=True)]
    begins = found.exits.begins[:-1]
    cut = back = 0
    for longest in (60.0, np.inf, 150.0):  # a wider search may come later, or was made before
        for here, target in product(range(10), range(10, EDGES)):
            exact = inside[here, gate] + over + outside[entry, target]
            by_region = np.minimum.reduceat(exact, begins)
            choices = found.choices(here, target, longest, detour)
            assert choices.fastest == choices.times.min()
            for n, time in enumerate(choices.times):
                assert choices.exist[n] or by_region[n] == np.inf
                if time == np.inf:
                    cut += by_region[n] < np.inf
                    assert by_region[n] >= longest + detour
                    continue
                way = choices.route(n).tolist()
                assert (way[0], way[-1]) == (here, target)
                assert takes(way, city) == pytest.approx(time)
                leaves = max(place for place, edge in enumerate(way) if REGION[edge] == 0)
                assert REGION[way[leaves + 1]] == found.exits.neighbours[n]
                if (REGION[way[:leaves]] == 0).all():
                    assert time > longest + detour or time == pytest.approx(by_region[n])
                else:
                    back += 1
                    assert time > longest or time == pytest.approx(fastest_of_all[here, target])
            if fastest_of_all[here, target] < longest:
                assert choices.fastest == pytest.approx(fastest_of_all[here, target])
    assert cut > 50
    assert back > 10


def test_ways_home_are_the_fastest_up_to_a_limit(city):
    first, second, turn, time = city
    exact = least(city, np.full(EDGES, True))
    moves = Moves(first, second, allowed=np.full(EDGES, True), reverse=True)
    home = Trees(moves, time, turn)
    for most, here, target in product((60.0, np.inf), range(EDGES), range(EDGES)):
        cost, before = home.time(target, here, most)
        if exact[here, target] > most:
            assert cost == np.inf
        elif np.isfinite(exact[here, target]):
            way = home.back(before, target, here).tolist()
            assert (way[0], way[-1]) == (here, target)
            assert cost == pytest.approx(exact[here, target]) == takes(way, city)


DRIVER = Event(vehicle="driver", source=None, region=0, destination=2, edge="t")


def crossroads(route, *, ways_return, side=40.0, to_region_1=0.5, period=0.0, lanes=True):
    """A guide in the city with a side street of `side` s, its commands, the routes of the drivers,
    and where they are, which is at their routes' first edges."""
    routes, road = {"driver": route}, Mock(side_effect=lambda vehicle: routes[vehicle][0])
    own, splits = np.zeros((2, 3, 3, 3))
    own[0, 1:, 2], own[1, 0, 2] = 0.5, 1.0
    splits[0, 1:, 2], splits[1, 0, 2] = (to_region_1, 1.0 - to_region_1), 1.0
    guide = Guide(
        streets.session(routes, road=road),
        streets.side_street(side),
        own,
        compliance=1.0,
        most_detour=60.0,
        random=np.random.default_rng(0),
        ways_return=ways_return,
        period=period,
        lanes=lanes,
    )
    guide.command(splits, None)
    return guide, splits, routes, road


def guided(route, **chosen):
    """The route of a driver on a bound for t after guidance, and the region for which he is said to
    leave."""
    guide, _, routes, _ = crossroads(route, **chosen)
    guide.apply([DRIVER])
    return "".join(routes["driver"]), int(guide.realised[0, :, 2].argmax())


@pytest.mark.parametrize("route", ["ambt", "ast"])
def test_a_main_road_that_leaves_the_region_and_comes_back_is_open_to_all(route):
    assert guided(tuple(route), ways_return=True) == (
        "ambt",
        2,
    )  # he leaves region 0 for good by b t
    for side in (40.0, 200.0):  # however much longer
        assert guided(tuple(route), ways_return=False, side=side) == ("ast", 2)


def test_ways_that_return_are_taken_where_they_are_faster_and_no_command_closes_them():
    assert guided(tuple("ast"), ways_return=True, side=12.0) == ("ast", 2)
    assert guided(tuple("ambt"), ways_return=True, side=2.0) == ("ast", 2)
    for to_region_1 in (
        0.0,
        0.5,
        1.0,
    ):  # nobody can leave for 1 for good: there is no other way on than back
        assert guided(tuple("ambt"), ways_return=True, to_region_1=to_region_1)[0] == "ambt"


def test_prices_lengthen_the_ways_through_a_region_and_go_when_none_are_commanded():
    """Over m, in region 1, it takes 20 s and 10 (1 + price), on the side street 50 s."""
    for price, way in ((0.0, "ambt"), (1.0, "ambt"), (9.0, "ast"), (None, "ambt")):
        guide, splits, routes, _ = crossroads(tuple("ambt"), ways_return=True)
        guide.command(splits, None, np.array([0.0, 9.0, 0.0]))
        guide.command(splits, None, None if price is None else np.array([0.0, price, 0.0]))
        guide.apply([DRIVER])
        assert "".join(routes["driver"]) == way


@pytest.mark.parametrize("ways_return", [False, True])
def test_with_prices_no_way_is_a_long_detour_by_the_times_without(city, ways_return, monkeypatch):
    monkeypatch.setattr(guidance, "SPREAD", 0.0)
    first, second, _, time = city
    free, names, even = (
        (first, second, 0.0 * first, time),
        [f"{n:02}" for n in range(EDGES)],
        np.full((4,) * 3, 0.25),
    )
    inside, outside, best = (
        least(free, allowed) for allowed in (REGION == 0, REGION != 0, REGION < 4)
    )
    if not ways_return:
        leave = (REGION[first] == 0) & (REGION[second] != 0)
        a, b = first[leave], second[leave]
        best = np.min(inside[:, a, None] + time[b, None] + outside[b], axis=1)
    _, before = dijkstra(
        csr_array((np.ones(len(first)), (first, second)), shape=(EDGES,) * 2),
        return_predecessors=True,
    )
    after = {name: [names[b] for b in second[first == n]] for n, name in enumerate(names)}
    length = dict(zip(names, time, strict=True))
    longest = {}
    for most in (20.0, 60.0, 1e9):
        routes, detours, random = {}, [], np.random.default_rng(0)
        town = streets.city(dict(zip(names, REGION.tolist(), strict=True)), after, length=length)
        chosen = {
            "compliance": 1.0,
            "most_detour": most,
            "random": random,
            "ways_return": ways_return,
        }
        guide = Guide(streets.session(routes), town, even, **chosen)
        guide.command(even, None, np.array([0.0, 5.0, 5.0, 0.0]))
        for here, target in product(range(10), range(30, 39)):
            way = [target]
            while way[-1] != here and before[here, way[-1]] >= 0:
                way.append(before[here, way[-1]])
            if way[-1] == here and best[here, target] < np.inf:
                routes["driver"] = tuple(names[n] for n in way[::-1])
                guide.apply([DRIVER._replace(destination=3, edge=names[target])])
                detours.append(
                    time[[int(name) for name in routes["driver"][1:]]].sum() - best[here, target]
                )
        longest[most] = max(detours)
        assert longest[most] <= most + 1e-6
    assert longest[1e9] > 60.0


def test_who_is_bound_for_a_region_does_not_see_its_price():
    guide, splits, routes, _ = crossroads(tuple("ast"), ways_return=True)
    guide.command(splits, None, np.array([0.0, 0.0, 9.0]))
    guide.apply([DRIVER])
    assert (
        "".join(routes["driver"]) == "ambt"
    )  # 20 s less; t itself is in region 2, and takes the same both ways


def test_drivers_are_asked_again_where_they_are():
    """On his way over m, which comes to a stand, a driver turns into the side street if he is asked
    in time."""
    for period, asked in ((0.0, 99), (2.5, 3), (6.0, 6)):
        guide, splits, routes, _ = crossroads(tuple("ambt"), ways_return=True, period=period)
        guide.apply([DRIVER])
        guide.command(splits, seen([np.nan, np.nan, 0.1, np.nan, np.nan]))  # m/s on a, b, m, s, t
        for step in range(1, 9):
            guide.apply([])
            assert "".join(routes["driver"]) == ("ast" if step >= asked else "ambt")
            assert guide.realised.sum() == guide.realised[0, 2, 2] == 1
        # Of the region that he was told before nothing is left, although a control interval has
        # passed.
        assert guide._shares._given[0][2][2] == pytest.approx(1.0 if asked < 9 else 0.9)


def test_on_a_junction_it_is_too_late_and_who_arrived_is_not_asked():
    guide, splits, routes, road = crossroads(tuple("ambt"), ways_return=True, period=2.0)
    guide.apply([DRIVER])
    guide.command(splits, seen([np.nan, np.nan, 0.1, np.nan, np.nan]))
    road.side_effect = [":junction", ":junction", "a", libsumo.TraCIException("not known")]
    for expected in ("ambt", "ambt", "ambt", "ast", "ast", "ast", "ast", "ast", "ast"):
        guide.apply([])
        assert "".join(routes["driver"]) == expected
    assert (
        road.call_count == 5
    )  # when he came, twice on the junction, behind it, and when he had arrived
