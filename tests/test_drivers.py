"""Judgement of drivers' routes by travel times worked out by hand.

From a, the main road a m b t takes 30 s, of which m is in region 1, and the side street a s t 50 s.
"""

import math

import numpy as np
import pytest
import streets

from cosim.plant.drivers import MESO_THRESHOLD, SWITCHING_THRESHOLD, Drivers, Present
from cosim.plant.routes import TravelTimes

CITY = streets.side_street()


def drivers_of(*, ways_return=True, lanes=True):
    """Return the drivers of the city, and free travel times."""
    times = TravelTimes(CITY)
    return Drivers(CITY, times, ways_return=ways_return, lanes=lanes), times.edges


def numbers(route):
    return np.array([CITY.number[edge] for edge in route])


def test_the_present_route_takes_the_time_after_its_first_edge():
    drivers, time = drivers_of()
    late = time + 5.0
    itinerary = drivers.itinerary(tuple("?ambt"))
    present = drivers.present(itinerary, 1, CITY.number["a"], late)
    assert present.route.tolist() == numbers("ambt").tolist()
    assert present[1:] == Present(None, 45.0, 15.0, found=True)[1:]
    assert drivers.present(itinerary, 0, CITY.number["a"], late).route is None
    assert present.longest == 46.0
    assert drivers.time(numbers("ambt"), late) == 45.0


@pytest.mark.parametrize(
    "route, here, found, route_known",
    [
        ("ambt", "a", False, True),
        ("ast", "a", True, True),
        ("at", "a", False, True),
        ("a?t", "a", False, False),
        ("ast", "s", False, True),
    ],
    ids=["comes back", "inside", "unknown move", "closed to cars", "not on its first edge"],
)
def test_routes_that_no_search_finds(route, here, found, route_known):
    drivers, time = drivers_of(ways_return=False)
    itinerary = drivers.itinerary(tuple(route))
    present = drivers.present(itinerary, 0, CITY.number[here], time)
    assert present.found is found
    assert (present.route is not None) is route_known
    assert (present.longest == math.inf) is not found


@pytest.mark.parametrize("ways_return, expected", [(False, 1), (True, 2)])
def test_the_next_region_of_a_route_that_comes_back(ways_return, expected):
    drivers, _ = drivers_of(ways_return=ways_return)
    assert drivers.next_region(numbers("ambt")) == expected
    assert drivers.next_region(numbers("ast")) == 2
    assert drivers.next_region(numbers("as")) == 0


def test_another_route_must_save_a_share_of_the_delay():
    drivers, _ = drivers_of()
    present = Present(numbers("ast"), time=100.0, delay=50.0)
    worth = 100.0 - SWITCHING_THRESHOLD * 50.0 * 0.5
    assert drivers.worth(present) == pytest.approx(worth)
    assert drivers.keeps(present, worth + 0.1)
    assert not drivers.keeps(present, worth - 0.1)
    assert not drivers.keeps(present, worth + 0.1, following=1)
    assert drivers.keeps(present, worth + 0.1, following=2)


def test_in_the_mesoscopic_model_another_route_must_save_a_share_of_its_own_time():
    drivers, _ = drivers_of(lanes=False)
    assert drivers.worth(Present(np.array([0]), time=130.0, delay=1.0)) == 130.0 / (
        1.0 + MESO_THRESHOLD
    )


def test_routes_closed_to_cars_are_kept_and_unknown_ones_left():
    drivers, _ = drivers_of()
    assert drivers.keeps(Present(None), 1.0)
    assert not drivers.keeps(Present(numbers("ast")), np.inf)
