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
from cosim.plant.routes import MOST_TIMES

EDGES, REGION = 40, np.repeat([0, 1, 2, 3], 10)
NAMES = [f"{n:02}" for n in range(EDGES)]


@pytest.fixture(scope="module")
def city():
    """Moves first -> second with the time of their turns, and the time of every edge."""
    random = np.random.default_rng(3)
    pairs = sorted(
        {(int(a), int(b)) for a, b in random.integers(EDGES, size=(160, 2)) if a != b and a != 39}
    )
    first, second = np.array(pairs).T
    return first, second, random.uniform(0.0, 3.0, len(pairs)), random.uniform(5.0, 60.0, EDGES)


@pytest.fixture(params=[MOST_TIMES, 1])
def kept(request, monkeypatch):
    """All searches are kept, or hardly any, and all drivers see the same times."""
    monkeypatch.setattr(routes, "MOST_TIMES", request.param)
    monkeypatch.setattr(guidance, "SPREAD", 0.0)


class Crowd:
    """Drivers in the random city, one after the other.

    Without a `present` route, SUMO says that they are not on the first edge of their route.
    """

    def __init__(self, city, *, ways_return=False, detour=60.0):
        first, second, turn, time = city
        pairs = [(NAMES[a], NAMES[b]) for a, b in zip(first, second, strict=True)]
        town = streets.city(
            dict(zip(NAMES, REGION.tolist(), strict=True)),
            {name: [NAMES[b] for b in second[first == n]] for n, name in enumerate(NAMES)},
            length=dict(zip(NAMES, time, strict=True)),
            turn_time=dict(zip(pairs, turn, strict=True)),
        )
        self.routes = {}
        self.here = 0
        session = streets.session(self.routes, road=lambda vehicle: NAMES[self.here])
        chosen = {"compliance": 1.0, "random": np.random.default_rng(0)}
        chosen |= {"ways_return": ways_return, "most_detour": detour}
        self.guide = Guide(session, town, np.full((4,) * 3, 1 / 3), **chosen)

    def send_by(self, *regions):
        """Command that all leave for these regions, in equal shares."""
        theta = np.zeros((4,) * 3)
        theta[:, regions] = 1.0 / len(regions)
        self.guide.command(theta, None)

    def sent(self, here, target, present=()):
        """Return the edges of a driver's route, and those before."""
        self.here = here
        before = [NAMES[n] for n in present] or [NAMES[here - 1], NAMES[target]]
        self.routes["driver"] = tuple(before)
        region = int(REGION[here])
        bound = {"destination": int(REGION[target]), "edge": NAMES[target]}
        self.guide.apply([Event(vehicle="driver", source=None, region=region, **bound)])
        return [int(name) for name in self.routes["driver"]], [int(name) for name in before]


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
    first, second, turn, time = city
    total = 0.0
    for a, b in pairwise(way):
        total += turn[(first == a) & (second == b)].item() + time[b]
    return total


def hops(city):
    """Predecessors on the ways with the fewest moves."""
    first, second, *_ = city
    moves = csr_array((np.ones(len(first)), (first, second)), shape=(EDGES,) * 2)
    _, before = dijkstra(moves, unweighted=True, return_predecessors=True)
    return before


def way_by(before, here, target):
    """The edges from here to target by predecessors, () without a way."""
    way = [target]
    while way[-1] != here:
        if before[here, way[-1]] < 0:
            return ()
        way.append(int(before[here, way[-1]]))
    return way[::-1]


@pytest.mark.usefixtures("kept")
@pytest.mark.parametrize("present", [False, True])
@pytest.mark.parametrize("detour", [0.0, 40.0, 1e9])
def test_drivers_get_the_fastest_route_by_the_commanded_region(city, detour, present):
    """Up to a detour, and if their present route is not as good."""
    first, second, *_ = city
    leave = (REGION[first] == 0) & (REGION[second] != 0)
    inside, outside = least(city, REGION == 0), least(city, REGION != 0)
    gates = list(zip(first[leave].tolist(), second[leave].tolist(), strict=True))
    crowd, before = Crowd(city, detour=detour), hops(city)
    obeyed = cut = kept = 0
    for region in (1, 2, 3):
        crowd.send_by(region)
        for here, target in product(range(1, 10), range(10, EDGES)):
            exact = np.full(4, np.inf)
            for a, b in gates:
                time = inside[here, a] + takes((a, b), city) + outside[b, target]
                exact[REGION[b]] = min(exact[REGION[b]], time)
            way, old = crowd.sent(here, target, way_by(before, here, target) if present else ())
            if exact[region] == np.inf:
                assert way == old
                continue
            by = region if exact[region] <= exact.min() + detour else int(exact.argmin())
            obeyed += by == region
            cut += by != region
            if way == old:
                kept += 1
                assert takes(old, city) <= exact[by] + 1e-6
                continue
            leaves = next(n for n, edge in enumerate(way) if REGION[edge] != 0)
            assert REGION[way[leaves]] == by
            assert (way[0], way[-1]) == (here, target)
            assert takes(way, city) == pytest.approx(exact[by])
    assert obeyed > 100
    assert (cut > 50) is (detour < 1e9)
    assert (kept > 50) is present


@pytest.mark.usefixtures("kept")
def test_routes_that_come_back_are_taken_where_they_are_the_fastest(city):
    best = least(city, np.full(EDGES, True))
    crowd, before = Crowd(city, ways_return=True, detour=0.0), hops(city)
    back = 0
    crowd.send_by(1, 2, 3)
    for present, here, target in product((False, True), range(1, 10), range(10, EDGES)):
        way, old = crowd.sent(here, target, way_by(before, here, target) if present else ())
        if best[here, target] == np.inf:
            assert way == old
            continue
        assert (way[0], way[-1]) == (here, target)
        assert takes(way, city) == pytest.approx(best[here, target])
        leaves = max(place for place, edge in enumerate(way) if REGION[edge] == 0)
        back += bool((REGION[way[:leaves]] != 0).any())
    assert back > 10


@pytest.mark.usefixtures("kept")
@pytest.mark.parametrize("ways_return", [False, True])
def test_routes_home_are_the_fastest(city, ways_return):
    """Inside the region of destination, or anywhere where routes may return."""
    crowd = Crowd(city, ways_return=ways_return)
    crowd.send_by(0)
    found = 0
    for region in range(4):
        exact = least(city, np.full(EDGES, True) if ways_return else region == REGION)
        there = np.flatnonzero(region == REGION).tolist()
        for here, target in product(there, there):
            way, old = crowd.sent(here, target)
            if here == target or exact[here, target] == np.inf:
                assert way == old
                continue
            found += 1
            assert (way[0], way[-1]) == (here, target)
            assert takes(way, city) == pytest.approx(exact[here, target])
    assert found > 60


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


@pytest.mark.usefixtures("kept")
@pytest.mark.parametrize("ways_return", [False, True])
def test_with_prices_no_way_is_a_long_detour_by_the_times_without(city, ways_return):
    first, second, *_ = city
    free, before = (first, second, 0.0 * first, city[3]), hops(city)
    inside, outside = least(free, REGION == 0), least(free, REGION != 0)
    best = least(free, np.full(EDGES, True))
    if not ways_return:
        leave = (REGION[first] == 0) & (REGION[second] != 0)
        a, b = first[leave], second[leave]
        best = np.min(inside[:, a, None] + city[3][b, None] + outside[b], axis=1)
    longest = {}
    for most in (20.0, 60.0, 1e9):
        crowd, detours = Crowd(free, ways_return=ways_return, detour=most), []
        even = np.full((4,) * 3, 1 / 3)
        crowd.guide.command(even, None, np.array([0.0, 5.0, 5.0, 0.0]))
        for here, target in product(range(10), range(30, 39)):
            present = way_by(before, here, target)
            if present and best[here, target] < np.inf:
                way, _ = crowd.sent(here, target, present)
                detours.append(takes(way, free) - best[here, target])
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
        assert guide._shares.counts.given[0, 2, 2] == pytest.approx(1.0 if asked < 9 else 0.9)


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
