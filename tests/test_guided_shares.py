"""Who is guided where, worked out by hand: two ways from region 0 to region 3, a through region 1
and b through 2."""

from dataclasses import replace

import numpy as np
import pytest
import streets
import tiny
from streets import seen

from cosim.evaluation.simulate import Simulation, simulate
from cosim.plant import guidance, shares
from cosim.plant.guidance import Guide
from cosim.plant.meter import Event
from cosim.plant.strategy import parse
from nmfd.api import load_scenario
from nmfd.types import Controls

# s and z are in region 0, a and b in 1 and 2; all lead to t in 3, where t2 follows, and z by a
# shorter u.
REGION_OF = {"a": 1, "b": 2, "s": 0, "t": 3, "t2": 3, "u": 3, "v": 3}
AFTER = {
    "s": ("a", "b"),
    "a": ("t",),
    "b": ("t",),
    "t": ("t2", "u"),
    "t2": ("v",),
    "u": ("v",),
    "v": (),
}
EDGES = tuple(sorted(REGION_OF))


@pytest.fixture(autouse=True)
def everybody_sees_the_same_times(monkeypatch):
    monkeypatch.setattr(guidance, "SPREAD", 0.0)
    monkeypatch.setattr(guidance, "MESO_SPREAD", 0.0)


class Town:
    """A guide of drivers on s, bound for t: by a it takes `through_a` [s] more than the last edge,
    by b `through_b`."""

    def __init__(
        self,
        *,
        through_a=30.0,
        through_b=90.0,
        theta=0.5,
        own=0.5,
        most_detour=1e9,
        compliance=1.0,
        seed=0,
        lanes=True,
    ):
        length = dict.fromkeys(EDGES, 10.0) | {"a": through_a, "b": through_b, "u": 5.0}
        city = streets.city(
            REGION_OF,
            AFTER,
            length=length,
            turn_time={(e, f): 1.0 for e, after in AFTER.items() for f in after},
            over={("s", "a"): (":s_1",), ("a", "t"): (":a_1",)},
            inside={":a_1": 9.0, ":s_1": 9.0},
        )
        self.routes, self.takes_it, self.shares = {}, True, np.zeros((2, 4, 4, 4))
        for splits, to_a in zip(self.shares, (own, theta), strict=True):
            splits[0, 1, 3], splits[0, 2, 3] = to_a, 1.0 - to_a
            splits[1, 3, 3] = splits[2, 3, 3] = 1.0
        self.guide = Guide(
            streets.session(self.routes, set_route=self._set_route),
            city,
            self.shares[0],
            compliance=compliance,
            most_detour=most_detour,
            random=np.random.default_rng(seed),
            lanes=lanes,
        )
        self.command()

    def _set_route(self, vehicle, way):
        if self.takes_it:
            self.routes[vehicle] = tuple(way)
        return self.takes_it

    def command(self, **speeds):
        """The next control interval, with these speeds [m/s] in the last one; elsewhere nobody was
        seen."""
        seen_speeds = [speeds.get(edge, np.nan) for edge in EDGES]
        streets = seen(seen_speeds, crossing=(0.0, 0.0), crossed=(0.0, 0.0)) if speeds else None
        self.guide.command(self.shares[1], streets)

    def sent(self, way, *, region=0, edge="t", free=True):
        """The way of one more driver who was on this one, in this region and bound for `edge`."""
        vehicle = str(len(self.routes))
        self.routes[vehicle] = tuple(way)
        self.guide.apply(
            [
                Event(
                    vehicle=vehicle, source=None, region=region, destination=3, edge=edge, free=free
                )
            ]
        )
        return self.routes[vehicle]

    def home(self, *way):
        """The way of a driver in the region of the destination, bound for v."""
        return self.sent(way, region=3, edge="v")

    def drive(self, count, by="a", free=True):
        """By which of a and b each of `count` drivers goes who were on their way by `by`."""
        ways = [self.sent(("s", by, "t"), free=free) for _ in range(count)]
        assert set(ways) <= {("s", "a", "t"), ("s", "b", "t")}
        return "".join(way[1] for way in ways)


@pytest.mark.parametrize("theta, expected", [(0.0, 0), (0.25, 20), (0.4, 32), (0.5, 40), (0.8, 40)])
def test_theta_shifts_the_shares_of_those_who_wish(theta, expected):
    """All wish to go by a: theta takes theta / own of them there, and b gets what is freed."""
    town = Town(through_a=30.0, through_b=31.0, theta=theta)
    ways = town.drive(40)
    assert abs(ways.count("a") - expected) <= 1
    assert town.guide.realised[0, :, 3].tolist() == [0, ways.count("a"), ways.count("b"), 0]
    assert town.guide.realised.sum() == 40


@pytest.mark.parametrize("bonus, first", [(30.0, 5), (10.0, 13)])
def test_a_longer_way_is_taken_as_soon_as_its_region_is_far_enough_behind(
    monkeypatch, bonus, first
):
    """Half of them shall go by b, which takes 125 s more. After n drivers by a, the lead of a's
    price is 125 - bonus ((n + 1) / 2 - ((n + 1) / 2 - n)) = 125 - bonus n: b it is from n = 125 /
    bonus on."""
    monkeypatch.setattr(shares, "SHARE_PENALTY_S", bonus)
    town = Town(through_a=30.0, through_b=155.0, theta=0.25)
    ways = town.drive(first + 1)
    assert ways.index("b") == first


@pytest.mark.parametrize("most, expected", [(59.0, "a"), (61.0, "b")])
def test_nobody_is_sent_on_a_longer_detour_whatever_theta_says(most, expected):
    """60 s more by b, where all are sent: or, where that is too much, the fastest way of all."""
    assert Town(theta=0.0, most_detour=most).drive(3) == 3 * expected
    other = {"a": "b", "b": "a"}[expected]  # the same with the ways exchanged
    assert (
        Town(through_a=90.0, through_b=30.0, theta=1.0, most_detour=most).drive(3, by="b")
        == 3 * other
    )


@pytest.mark.parametrize("by_b, expected", [(69.0, "b"), (71.0, "a")])
def test_travel_times_are_those_seen(by_b, expected):
    """a, 20 s when it is free, takes 70 s."""
    town = Town(through_a=20.0, through_b=by_b, theta=0.5)
    town.command(a=20.0 / 70.0)
    assert town.sent("s")[1] == expected


@pytest.mark.parametrize("waited, expected", [(18.0, "a"), (24.0, "b")])
def test_who_waits_on_a_junction_is_seen(waited, expected):
    """It takes 20 s more by b; by a they wait on the junction before it, behind it, or on both, 1 s
    in any case."""
    for inside in ((waited, 0.0), (0.0, waited), (waited / 2, waited / 2)):
        town = Town(through_a=30.0, through_b=50.0, theta=0.5)
        crossing = (0.5 * inside[0], 0.5 * inside[1])
        town.guide.command(
            town.shares[1], seen(np.full(len(EDGES), np.nan), crossing=crossing, crossed=(0.5, 0.5))
        )
        assert town.sent("s")[1] == expected


def test_a_refused_way_counts_for_no_region():
    town = Town()
    town.takes_it = False
    assert town.drive(3, by="b") == "bbb"
    assert town.guide.realised.sum() == 0


def test_compliance_and_drivers_who_are_not_free():
    assert Town(compliance=0.0).drive(5, by="b") == "bbbbb"
    assert Town().drive(5, by="b", free=False) == "bbbbb"
    half = Town(compliance=0.5).drive(200, by="b")
    assert 75 < half.count("a") < 125


@pytest.mark.parametrize(
    "present, expected",
    [("t t2 v", "t u v"), ("t u v", "t u v"), ("t closed v", "t closed v")],
    ids=["slower", "fastest", "closed to cars"],
)
def test_in_the_region_of_the_destination_it_is_the_fastest_way(present, expected):
    """By u it is 5 s less. A way over roads that are closed to cars is left alone."""
    town = Town()
    assert town.home(*present.split()) == tuple(expected.split())
    assert town.guide.realised.sum() == 0


@pytest.mark.parametrize("present", ["t2", "u"])
@pytest.mark.parametrize("at_v, best", [(30.5, False), (27.5, True)])
def test_the_more_delay_the_more_another_way_must_save(present, at_v, best):
    """It takes 12 s and that of v by t2, 5 s less by u. Of 42.5 s by t2, 20.5 s are delay: he keeps
    it for less than 0.6 20.5^2 / 42.5 = 5.9 s. Of 39.5 s, 17.5 s: less than 4.7 s."""
    town = Town()
    town.command(v=10.0 / at_v)
    assert town.home("t", present, "v") == ("t", "u" if best else present, "v")


@pytest.mark.parametrize("at_v, best", [(16.0, False), (4.0, True)])
def test_in_the_mesoscopic_model_another_way_must_save_a_share_of_its_own_time(at_v, best):
    """v takes 13 s, the mean of now and before: 25 s by t2 and 20 by u, 1.25 times. Or t2 takes 22
    s: 34 and 17 s."""
    town = Town(lanes=False)
    town.command(t2=10.0 / (34.0 if best else 10.0), v=10.0 / at_v)
    assert town.guide._times.edges[EDGES.index("t2")] == pytest.approx(
        22.0 if best else 10.0
    )  # smoothed: half of it
    assert town.home("t", "t2", "v") == ("t", "u" if best else "t2", "v")


@pytest.mark.slow
def test_guided_is_guidance_by_travel_times_wherever_the_controller_says_nothing():
    """The bytes are those of a controller that commands the nominal split ratios; without it no
    driver is guided."""
    scenario = load_scenario("demo", {"steps": 2})
    gates = 0.5 * scenario.network.open_perimeter
    half = Controls(perimeter=gates, splits=scenario.network.nominal_splits)
    by_hand, option, off = (
        simulate(Simulation(scenario, parse(tiny.Acting(lambda _, told=told: told), city), seed=1))
        for city, told in (
            ("", half),
            ("guided", replace(half, splits=None)),
            ("", replace(half, splits=None)),
        )
    )
    assert option["guided"].sum() > 0
    assert off["guided"].sum() == 0
    assert option.without_times().equals(by_hand.without_times())
