"""Vehicles that wait for each other on a junction: freed where the streets behind it are, left
where they are full."""

from types import SimpleNamespace

import pytest

from cosim.plant.stuck import GAP_M, JUNCTION_PATIENCE_S, Junctions

LENGTH, EDGES = 5.0, (":x_1", ":x_2", ":x_10", ":y_1", "a", "b", "short")
CITY = SimpleNamespace(
    region_of=dict.fromkeys(EDGES, 0),
    length={"a": 50.0, "b": 50.0, "short": 0.2},
    over={("short", "a"): (":x_3",), ("a", "b"): (":y_1",)},
)


class Streets:
    """A session: vehicles on junction x, since when they stand, and what is free of lanes a_0 and
    b_0, 50 m long unless told otherwise [m]."""

    def __init__(self, standing, room, **lengths):
        self.standing, self.free, self.set_on = standing, room, {}
        self.lengths = lengths
        self.at = {"first": ":x_1_0", "second": ":x_2_0", "third": ":x_2_0"}

    def halting(self, edge):
        return len(self.vehicles_on(edge))

    def vehicles_on(self, edge):
        return [vehicle for vehicle in self.standing if self.at[vehicle].rpartition("_")[0] == edge]

    def standing_time(self, vehicle):
        return self.standing[vehicle]

    def place(self, vehicle):
        return self.at[vehicle], 1.0

    def vehicle_length(self, vehicle):
        return LENGTH

    def next_lanes(self, lane):
        onward = {":x_1_0": "a_0", ":x_2_0": ":x_10_0", ":x_10_0": "b_0", "a_0": ":y_1_0"}
        return ["b_0", "a_0"] if lane == "short_0" else [onward[lane]]

    def route(self, vehicle):
        return ("before", "b" if self.at[vehicle] == ":x_2_0" else "a")

    def route_index(self, vehicle):
        return 0

    def lane(self, lane):
        return self.lengths.get(lane, 50.0), frozenset()

    def room(self, lane):
        return self.free[lane]

    def set_down(self, vehicle, lane, position):
        self.set_on[vehicle] = lane, position
        return True


@pytest.mark.parametrize(
    "standing, room, expected",
    [
        # One per lane.
        (
            {"first": 130.0, "second": 150.0, "third": 200.0},
            (50.0, 50.0),
            {"first": "a_0", "third": "b_0"},
        ),
        (
            {"first": 130.0, "second": 20.0},
            (50.0, 0.0),
            {"first": "a_0"},
        ),  # who has just come is not asked
        (
            {"first": 130.0, "second": 130.0},
            (50.0, 9.0),
            {},
        ),  # one street behind is full: a real lock
        ({"first": JUNCTION_PATIENCE_S - 1.0}, (50.0, 50.0), {}),
    ],
)
def test_vehicles_are_set_down_where_all_have_room(standing, room, expected):
    streets = Streets(standing, dict(zip(("a_0", "b_0"), room, strict=True)))
    junctions = Junctions(streets, CITY)
    junctions.free()
    assert streets.set_on == {vehicle: (lane, LENGTH + GAP_M) for vehicle, lane in expected.items()}
    assert junctions.freed == len(expected)


@pytest.mark.parametrize("room, expected", [(0.2, {"first": ("a_0", 0.2)}), (-4.8, {})])
def test_on_a_street_too_short_for_a_vehicle_it_is_set_at_the_end(room, expected):
    """A second vehicle, whose end is 4.8 m before the street, leaves no room there."""
    streets = Streets({"first": 130.0}, {"a_0": room}, a_0=0.2)
    Junctions(streets, CITY).free()
    assert streets.set_on == expected


def test_a_full_street_too_short_for_a_vehicle_does_not_keep_the_others():
    streets = Streets({"first": 130.0, "third": 130.0}, {"a_0": -4.8, "b_0": 50.0}, a_0=0.2)
    Junctions(streets, CITY).free()
    assert set(streets.set_on) == {"third"}


@pytest.mark.parametrize("room, expected", [(50.0, {"first": "a_0", "third": "b_0"}), (0.0, {})])
def test_who_stands_on_a_street_too_short_for_a_vehicle_stands_on_the_junction(room, expected):
    """The first goes where its route leads, not where the first link of its lane does."""
    streets = Streets({"first": 130.0, "third": 130.0}, {"a_0": room, "b_0": 50.0})
    streets.at["first"] = "short_0"
    Junctions(streets, CITY).free()
    assert {vehicle: lane for vehicle, (lane, _) in streets.set_on.items()} == expected
