"""The meter on a session that is made up: every vehicle followed by hand from loading to
arrival."""

from types import SimpleNamespace

import numpy as np
import pytest
import streets

from cosim.plant.meter import Event, Meter
from cosim.sumo.outputs import End
from cosim.sumo.session import REFUSALS
from nmfd.ledger import LedgerError

# a0 -> b0 -> b1 -> c0 in a row, regions 0, 1, 1, 2, and a way back c0 -> a0. Entries: b0, c0 and
# a0.
EDGES = {"a0": 0, "b0": 1, "b1": 1, "c0": 2}


CITY = streets.city(
    {**EDGES, ":j_0": 1},
    {"a0": ("b0",), "b0": ("b1",), "b1": ("c0",), "c0": ("a0",)},
    length=dict.fromkeys(EDGES, 100.0),
    speed=dict.fromkeys(EDGES, 10.0),
)


WAY = ("a0", "b0", "b1", "c0")


class Streets:
    """A session in which vehicles are moved by hand. places: vehicle -> edge; routes: vehicle ->
    edges."""

    step_length = 1.0

    def __init__(self):
        self.time, self.places, self.routes, self.waiting, self.bound = 0.0, {}, {}, [], set()
        self.held, self.due = set(), {}
        self.teleports, self.running, self.road = (
            lambda: 0,
            lambda: tuple(self.places),
            self.places.__getitem__,
        )
        self.known, self.pending = lambda: (*self.places, *self.held), lambda: tuple(self.waiting)
        self.is_free = self.is_private = lambda vehicle: vehicle not in self.bound
        self.is_public = lambda vehicle: vehicle in self.bound

    def route(self, vehicle):
        return self.routes[vehicle]

    def departure(self, vehicle):
        return self.time, self.time - self.due.get(vehicle, self.time)

    def vehicles_on(self, edge):
        return tuple(sorted(vehicle for vehicle, place in self.places.items() if place == edge))


@pytest.fixture
def play():
    """A function that makes one simulation step: new=, move=, gone= and so on; the meter's events
    of it."""
    session = Streets()
    meter = Meter(session, CITY, probes=frozenset({"p"}))

    def step(
        *, new=(), move=None, gone=(), loads=(), jumps=(), lands=(), waiting=None, observed=meter
    ):
        session.time += 1.0
        session.places.update(
            {vehicle: session.routes[vehicle][0] for vehicle in new} | (move or {})
        )
        for vehicle in (*gone, *jumps):
            session.places.pop(vehicle, None)
        session.loaded, session.departed, session.arrived = lambda: loads, lambda: new, lambda: gone
        session.started_teleport, session.ended_teleport = lambda: jumps, lambda: lands
        session.waiting = session.waiting if waiting is None else waiting
        return observed.observe()

    def stay(**move):
        """The events of three steps on these edges."""
        return [event for _ in range(3) for event in step(move=move)]

    return SimpleNamespace(session=session, meter=meter, step=step, stay=stay)


def counted(vehicles):
    """Return how many are counted, by entry [i, j] of a matrix."""
    return {entry: count for entry, count in np.ndenumerate(vehicles) if count}


def test_a_trip_through_three_regions(play):
    play.session.routes = {"v": WAY}
    assert play.step(new=["v"]) == [
        Event(vehicle="v", source=None, region=0, destination=2, edge="c0", free=True)
    ]
    assert counted(play.meter.accumulation()) == {(0, 2): 1}
    assert counted(play.meter.departures) == {(0, 2): 1}
    events = play.stay(v="b0")
    assert events == [Event(vehicle="v", source=0, region=1, destination=2, edge="c0", free=True)]
    assert counted(play.meter.accumulation()) == {(1, 2): 1}
    play.step(move={"v": "b1"})
    events = play.stay(v="c0")
    assert [(event.source, event.region) for event in events] == [(1, 2)]
    assert counted(play.meter.accumulation()) == {(2, 2): 1}
    play.step(gone=["v"])
    assert counted(play.meter.accumulation()) == {}
    assert (play.meter.arrivals == [0, 0, 1]).all()
    assert play.meter.crossings[0, 1, 2] == play.meter.crossings[1, 2, 2] == 1
    assert play.meter.crossings.sum() == 2
    assert dict(play.meter.entry_flow) == {(0, "b0"): 1, (1, "c0"): 1}
    assert play.meter.teleports == 0
    assert play.meter._vehicles == {}  # nothing is kept of who has gone


def test_two_boundaries_between_two_counts(play):
    """Where a vehicle comes from is known without a count in between."""
    play.session.routes = {"v": WAY}
    play.step(new=["v"])
    events = [
        event
        for edge in ("b0", "b0", "b1", "c0", "c0", "c0")
        for event in play.step(move={"v": edge})
    ]
    assert [(event.source, event.region) for event in events] == [(0, 1), (1, 2)]
    assert counted(play.meter.accumulation()) == {(2, 2): 1}
    assert play.meter.crossings.sum() == 2


def test_a_region_that_is_first_seen_at_the_count(play):
    """On a junction, where no edge is polled; the entry is an event all the same, and its source is
    where it was."""
    play.session.routes = {"v": ("a0", "b0", "b1")}
    play.step(new=["v"])
    play.session.places["v"] = ":j_0"
    assert counted(play.meter.accumulation()) == {(1, 1): 1}
    assert play.meter.crossings[0, 1, 1] == 1
    events = play.stay(v="b0")
    assert [(event.source, event.region) for event in events] == [(0, 1)]
    assert play.meter.crossings.sum() == 1
    assert dict(play.meter.entry_flow) == {(0, "b0"): 1}


def test_a_vehicle_that_arrives_unseen_has_crossed_too(play):
    play.session.routes = {"v": ("a0", "b0")}
    play.step(new=["v"])
    play.step(gone=["v"])
    assert counted(play.meter.accumulation()) == {}
    assert play.meter.crossings[0, 1, 1] == 1
    assert (play.meter.arrivals == [0, 1, 0]).all()


def test_teleporting_vehicles_stay_where_they_were(play):
    play.session.routes = {"v": WAY, "w": ("a0", "b0")}
    play.step(new=["v", "w"])
    play.step(jumps=["v"])
    assert counted(play.meter.accumulation()) == {(0, 2): 1, (0, 1): 1}
    assert play.meter.teleports == 1
    play.step(move={"v": "b1"}, lands=["v"])
    assert counted(play.meter.accumulation()) == {(1, 2): 1, (0, 1): 1}
    assert play.meter.teleports == 1
    assert play.meter._teleporting == set()
    play.step(jumps=["v"])
    play.step(gone=["v"])
    assert counted(play.meter.accumulation()) == {(0, 1): 1}
    assert play.meter.teleports == 2
    assert play.meter._teleporting == set()


def test_vehicles_that_the_mesoscopic_model_holds_stay_where_they_were(play):
    """Taken off the road without a word, but not forgotten; one that SUMO does not know any more is
    lost."""
    play.session.routes = {"v": WAY, "w": ("a0", "b0"), "u": ("a0", "b0")}
    play.step(new=["v", "w"], loads=["u"], waiting=["u"])
    play.session.places.pop("v")
    play.session.held = {"v", "u"}
    assert counted(play.meter.accumulation()) == {(0, 2): 1, (0, 1): 1}
    play.session.held = set()
    with pytest.raises(LedgerError, match="1 vehicles are in the city, but 2 departures"):
        play.meter.accumulation()


def test_who_waits_to_enter_is_backlog(play):
    play.session.routes = {"v": WAY, "w": ("b0", "b1")}
    play.step(loads=["v", "w"], waiting=["v", "w"])
    assert counted(play.meter.backlog()) == {(0, 2): 1, (1, 1): 1}
    assert counted(play.meter.accumulation()) == {}
    play.step(new=["v"], waiting=["w"])
    assert counted(play.meter.backlog()) == {(1, 1): 1}
    assert counted(play.meter.accumulation()) == {(0, 2): 1}


def test_a_vehicle_that_sumo_gives_up_at_once(play):
    """It is loaded and gone in the same step: nothing to follow, and nothing breaks."""

    def gone(vehicle):
        raise REFUSALS(f"Vehicle '{vehicle}' is not known.")

    play.session.route = gone
    assert play.step(loads=("ghost",)) == []
    assert play.meter.given_up.sum() == 1


def test_a_vehicle_that_gives_up_before_it_departs_was_never_there(play):
    play.session.routes = {"v": ("a0", "b0")}
    play.step(loads=["v"], waiting=["v"])
    play.step(gone=["v"], waiting=[])
    assert counted(play.meter.accumulation()) == {}
    assert play.meter.arrivals.sum() == play.meter.departures.sum() == 0
    assert counted(play.meter.backlog()) == {}
    assert play.meter.crossings.sum() == 0


def test_probes_are_counted_apart(play):
    play.session.routes = {"p": ("a0", "b0", "b1"), "v": ("a0", "b0", "b1")}
    play.step(loads=["p", "v"], waiting=["p", "v"])
    assert counted(play.meter.probes()) == {}
    assert counted(play.meter.probe_backlog()) == {(0, 1): 1}
    play.step(new=["p", "v"], waiting=[])
    assert counted(play.meter.probes()) == {(0, 1): 1}
    assert counted(play.meter.probe_departures) == {(0, 1): 1}
    assert counted(play.meter.departures) == {(0, 1): 2}
    assert counted(play.meter.probe_backlog()) == {}
    play.session.routes["w"] = ("b0", "b1")
    play.step(new=["w"])
    assert counted(play.meter.probe_departures) == {(0, 1): 1}
    play.step(gone=["p", "v"])
    assert counted(play.meter.probes()) == {}


def test_public_transport_is_not_free(play):
    play.session.routes, play.session.bound = {"bus": ("a0", "b0")}, {"bus"}
    assert [event.free for event in play.step(new=["bus"])] == [False]
    assert [event.free for event in play.stay(bus="b0")] == [False]


@pytest.mark.parametrize(
    "break_it, numbers",
    [
        (
            lambda play: play.session.places.pop("v"),
            r"1 vehicles are in the city, but 2 departures minus 0 arrivals are 2; "
            r"in region 0 bound for 2 there are 0, and 1 were followed there",
        ),
        (
            lambda play: play.meter.departures.__setitem__((0, 0), 1),
            "2 vehicles are in the city, but 3 departures minus 0",
        ),
        (
            lambda play: play.meter._running.__setitem__((1, 1), 1),
            "region 1 bound for 1 there are 0, and 1 were",
        ),
    ],
)
def test_the_ledger_names_step_and_numbers(play, break_it, numbers):
    play.session.routes = {"v": WAY, "w": ("a0", "b0")}
    play.step(new=["v", "w"])
    play.meter.accumulation(6)
    break_it(play)
    with pytest.raises(
        LedgerError, match=f"vehicle ledger broken at control step 7, 1 s: .*{numbers}"
    ):
        play.meter.accumulation(7)


def test_the_ends_that_sumo_tells_are_booked_by_hand(play):
    """Start all in 0, bound for 2 or 1; one ends in 1 instead, others are removed in 0, 1 and 2."""
    play.session.routes = dict.fromkeys("vwkju", WAY) | {"l": ("a0", "b0")}
    told, trips = [], SimpleNamespace(under_way={"u": 7.0}, completed=2, removed=3)
    trips.ends, trips.finish = (lambda: [told.pop() for _ in list(told)]), lambda gone: []
    meter = Meter(play.session, CITY, trips=trips)
    play.step(new=[*play.session.routes], observed=meter)
    play.step(gone="vwkl", observed=meter)
    assert counted(meter._running) == {(0, 2): 2}
    with pytest.raises(
        LedgerError, match=r"step 3: .* how the trips of 4 vehicles ended \(such as k\)"
    ):
        meter.accumulation(3)
    told += [
        End(vehicle="v", time=9.0, edge="b1", time_loss=5.0),
        End(vehicle="w", time=9.0, edge="b0", reason="traci", time_loss=11.0),
        End(vehicle="k", time=9.0, reason="traci", time_loss=0.0),
        End(vehicle="l", time=9.0, time_loss=0.0),
        End(
            vehicle="j", time=9.0, edge="c0", reason="collision", time_loss=0.0
        ),  # not called arrived
    ]
    play.session.places.pop("j")
    assert counted(meter.accumulation()) == {(0, 2): 1}
    assert meter.arrivals.tolist() == [0, 2, 0]
    assert counted(meter.removals) == {(1, 2): 1, (0, 2): 1, (2, 2): 1}
    assert counted(meter.redirected) == {(0, 2, 1): 1}
    assert counted(meter.jumps) == {(0, 2, 2): 1}
    assert meter.crossings[0, 1].tolist() == [0, 2, 1]
    assert meter.crossings.sum() == 3
    state = meter.state(4, 9.0)
    assert (state.step, state.time, state.completed) == (4, 9.0, 2.0)
    assert (state.removed == meter.removals).all()
    meter.close_books()
    assert [(trip.outcome, trip.time_loss) for trip in meter.trips()] == [
        ("removed", 0.0),
        ("completed", 0.0),
        ("removed", 0.0),
        ("removed", 11.0),
        ("completed", 5.0),
        ("under way", 7.0),
    ]
    trips.removed = 4
    with pytest.raises(
        LedgerError, match="2 completed trips and 3 removed vehicles were booked, .* has 2 and 4"
    ):
        meter.close_books()


def test_trips_dropped_rerouted_and_begun_again(play):
    """Book a trip that SUMO drops, a change of destination, and the second trip of one id."""
    play.session.routes = {"v": WAY, "w": ("b0", "b1"), "k": ("b0", "c0")}
    play.step(loads=["w", "k"], waiting=["w", "k"])
    play.step(
        new=["v"], move={"k": "b0"}, waiting=[]
    )  # SUMO does not know w any more; a program moved k
    assert counted(play.meter.backlog()) == {}
    assert counted(play.meter.given_up) == {(1, 1): 1}
    play.session.routes["v"] = ("a0", "b0")
    assert counted(play.meter.accumulation()) == {(0, 1): 1, (1, 2): 1}
    assert counted(play.meter.redirected) == {(0, 2, 1): 1}
    play.session.routes["v"] = ("c0", "a0")
    assert [event.region for event in play.step(new=["v"])] == [2]  # the id is used again
    assert counted(play.meter.accumulation()) == {(2, 0): 1, (1, 2): 1}
    assert play.meter.arrivals.tolist() == [0, 1, 0]
    assert counted(play.meter.departures) == {(0, 2): 1, (2, 0): 1, (1, 2): 1}
