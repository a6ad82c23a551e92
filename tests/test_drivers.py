"""Which routes drivers keep, by travel times worked out by hand.

From a, the main road a m b t takes 30 s, of which m is in region 1, and the side street a s t 50 s.
"""

import numpy as np
import pytest
import streets

from cosim.plant import fastest, guidance
from cosim.plant.fastest import MESO_THRESHOLD, SWITCHING_THRESHOLD, Present
from cosim.plant.guidance import Guide
from cosim.plant.meter import Event


def sent(route, *, here="a", place=0, ways_return=True):
    """Return the route of a driver bound for t after guidance."""
    routes = {"driver": tuple(route)}
    session = streets.session(routes, road=lambda vehicle: here, route_index=lambda vehicle: place)
    own = np.zeros((3, 3, 3))
    own[0, 1:, 2] = 0.5
    chosen = {"compliance": 1.0, "random": np.random.default_rng(0), "ways_return": ways_return}
    guide = Guide(session, streets.side_street(), own, **chosen)
    guide.command(own, None)
    guide.apply([Event(vehicle="driver", source=None, region=0, destination=2, edge="t")])
    return "".join(routes["driver"])


@pytest.mark.parametrize(
    "route, here, place, expected",
    [
        ("ambt", "a", 0, "ast"),
        ("ast", "a", 0, "ast"),
        ("at", "a", 0, "at"),
        ("a?t", "a", 0, "a?t"),
        ("?ambt", "a", 1, "ast"),
        ("?ast", "a", 1, "?ast"),
        ("ast", "s", 0, "st"),
    ],
    ids=[
        "comes back",
        "the fastest",
        "unknown move",
        "closed to cars",
        "closed before",
        "closed before the fastest",
        "not on its first edge",
    ],
)
def test_present_routes(monkeypatch, route, here, place, expected):
    """None of them may come back into region 0."""
    monkeypatch.setattr(guidance, "SPREAD", 0.0)
    assert sent(route, here=here, place=place, ways_return=False) == expected


def test_another_route_must_save_a_share_of_the_delay():
    streets_of = fastest.Streets._make([None] * len(fastest.Streets._fields))
    for lanes, worth in (
        (True, 100.0 - SWITCHING_THRESHOLD * 50.0 * 0.5),
        (False, 100.0 / (1.0 + MESO_THRESHOLD)),
    ):
        present = Present(known=True, time=100.0, delay=50.0, longest=101.0)
        judged = streets_of._replace(lanes=lanes)
        assert fastest.worth.py_func(judged, present) == pytest.approx(worth)
