"""Max-pressure without SUMO: the ways between stages, rations of green, and pressures worked out by
hand."""

from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import streets
import tiny_city
from signal_rules import CROSS, MIN_GREEN, PHASES, SINGLE, WALK, check, signal

from cosim.plant import max_pressure
from cosim.plant.max_pressure import MAX_RED_S, MaxPressure
from cosim.plant.pressure import PERMISSIVE, Roads
from cosim.plant.stages import Junction, stages_of, transition
from cosim.sumo.net import Gateway, load_city
from cosim.sumo.session import Phase
from cosim.sumo.signals import Link, read_signals


@pytest.mark.parametrize("phases", [PHASES, SINGLE, CROSS])
def test_every_way_between_stages_is_safe(phases):
    """Random switching: yellow after green, the minimum green, nothing green together that never
    was."""
    random = np.random.default_rng(2)
    junction, states = Junction(signal(phases), 0.0), []
    for second in range(1500):
        if second >= junction.next_change:
            junction.advance(float(second))
        if junction.may_switch(float(second)) and random.random() < 0.3:
            other = int(random.integers(junction.stages))
            if other != junction.stage:
                junction.switch(other, float(second))
        states.append(junction.state)
    assert len(set(states)) > 3
    check(states, phases)


def test_the_programme_s_own_way_is_kept():
    phases = signal(SINGLE).phases
    assert [p.state for p in transition(phases, 0, 2)] == ["yr"]
    phases = signal(
        [("GGr", 20), ("yyr", 4), ("rrr", 2), ("rrG", 20), ("rry", 3), ("Grr", 9), ("yrr", 3)]
    ).phases
    assert [(p.state, p.duration) for p in transition(phases, 0, 3)] == [("yyr", 4), ("rrr", 2)]
    assert [(p.state, p.duration) for p in transition(phases, 0, 5)] == [("Gyr", 4), ("Grr", 2)]
    assert transition(phases, 5, 0) == [Phase(duration=3, state="yrr")]


def test_other_ways_take_the_times_between_greens_from_the_programme():
    """Link 0 needs 2 s of red before 3, which no phase after the first has; a crossing is cleared
    beside cars."""
    states = ["GGrr", "Gyrr", "GrGr", "yryr", "rrrr", "rrrG", "rrry"]
    phases = signal(list(zip(states, (20, 3, 20, 3, 2, 20, 3), strict=True))).phases
    assert [(p.state, p.duration) for p in transition(phases, 0, 5)] == [("yyrr", 3), ("rrrr", 2)]
    crossed = signal(WALK)
    assert [(p.state, p.duration) for p in transition(crossed.phases, 0, 4)] == [
        ("Gry", 4),
        ("yry", 4),
        ("rrr", 1),
    ]
    junction = Junction(crossed, 0.0)
    assert junction.may_switch(20.0)
    assert not junction.may_switch(19.0)


@pytest.mark.parametrize(
    "states, kept",
    [
        ("Gr yr rG rG ry", [0, 2]),
        ("GGr Gyr Grr yrr rrG rry", [0, 4]),
        ("GGg yyg rrG rry", [0, 2]),
        ("Ggr yyr GrG Grr", [0, 2]),
    ],
    ids=["twice", "a part goes on", "protected later", "the last of two"],
)
def test_stages_that_serve_nothing_more_are_left_out(states, kept):
    assert list(stages_of(signal([(state, 5) for state in states.split()]))) == kept


@pytest.mark.parametrize("phases", [PHASES, SINGLE, CROSS])
def test_rationed_green(phases):
    """Random switching and commands: all is safe; no cycle has more green than its ration; u_max
    rations nothing."""
    random, links = np.random.default_rng(3), (0, 1)
    junction = Junction(signal(phases), 0.0, dict.fromkeys(links, 0))
    cycle, states, budgets = int(sum(d for _, d in phases)), [], []
    for second in range(40 * cycle):
        now = float(second)
        if second % cycle == 0:
            share = 1.0 if second >= 30 * cycle else float(random.uniform())
            for ration in junction.rations.values():
                ration.share = share
            budgets.append(np.inf if share == 1.0 else MIN_GREEN + share * (cycle - MIN_GREEN))
        if now >= junction.next_change - 1e-6:
            junction.advance(now)
        if junction.may_switch(now) and random.random() < 0.1:
            junction.switch((junction.stage + 1) % junction.stages, now)
        states.append(junction.state)
    check(states, phases)
    green = (
        np.array([[state[link] in "Gg" for link in links] for state in states])
        .reshape(40, cycle, 2)
        .sum(axis=1)
    )
    assert (green <= np.ceil(np.array(budgets))[:, None]).all()
    limited = np.isfinite(budgets)
    assert (
        green[limited] >= np.array(budgets)[limited, None] - 1.0
    ).any()  # rations are used up somewhere
    spent = [junction.rations[link].green_time(40.0 * cycle).shown for link in links]
    assert spent == green.sum(axis=0).tolist()


def test_the_minimum_green():
    """Of a stage, and of a gateway whose ration is the least."""
    held = Junction(signal(CROSS), 0.0, {0: 0})
    held.rations[0].share = 0.0
    assert held.may_switch(MIN_GREEN)
    assert not held.may_switch(MIN_GREEN - 1.0)
    while held.next_change < 66.0:
        held.advance(held.next_change)
    assert held.rations[0].green_time(66.0).shown == MIN_GREEN


def link(index, start, end, lane=0):
    return Link(index=index, from_edge=start, lane=lane, to_edge=end)


# a and c meet at the signal s, which lets one of them through; b, d, e and f follow. b has two
# lanes and ends at the signal t, where the left one leads to e alone, the right one to e and f. x
# leads into a and nowhere else: one road.
LANES = dict.fromkeys("acdefx", 1) | {"b": 2}
AFTER = {"x": ("a",), "a": ("b",), "c": ("d",), "b": ("e", "f"), "d": (), "e": (), "f": ()}
LANE_IDS = {edge: tuple(f"{edge}_{n}" for n in range(lanes)) for edge, lanes in LANES.items()}
TOWN = streets.city(
    dict.fromkeys(LANES, 0),
    AFTER,
    lanes=LANES,
    lane_ids=LANE_IDS,
    length=dict.fromkeys(LANES, 200.0),
)
CROSSING = signal(CROSS, (link(0, "a", "b"), link(1, "c", "d")), "s")
END = signal(
    [("GGg", 30), ("yyy", 3), ("rrG", 30), ("rry", 3)],
    (link(0, "b", "e", lane=1), link(1, "b", "e"), link(2, "b", "f")),
    "t",
)
FLOWS = {("b", "e"): 3.0, ("b", "f"): 1.0}


def weights(**vehicles):
    """Movement -> weight [veh] with so many vehicles on every lane of an edge, and the matrices."""
    roads = Roads(TOWN, [CROSSING, END], FLOWS)
    present = np.array([vehicles.get(lane.partition("_")[0], 0.0) for lane in roads.lanes])
    return dict(zip(roads.movements, (roads.weights @ present).tolist(), strict=True)), roads


def test_weights_by_hand():
    """What waits for a movement: all of a; of b the left lane for e, and of the right one three
    quarters for e. Less what it would run into, by turning shares: 0.75 (left + 0.75 right) + 0.25
    (0.25 right)."""
    found, _ = weights(a=10.0, b=4.0, c=2.0)
    assert found["b", "e"] == pytest.approx(4.0 + 3.0)
    assert found["b", "f"] == pytest.approx(1.0)
    assert found["a", "b"] == pytest.approx(10.0 - 0.75 * 7.0 - 0.25 * 1.0)
    assert found["c", "d"] == pytest.approx(2.0)


@pytest.mark.parametrize("length, weight", [(10.0, 5.0 + 0.25 * 8.0), (100.0, 5.0)])
def test_a_short_piece_before_the_signal_is_not_all_of_the_queue(length, weight):
    """x leads into a, and for three quarters of its vehicles elsewhere; within 100 m they count by
    that share."""
    after = {**AFTER, "x": ("a", "f")}
    town = replace(TOWN, successors=after, length={**TOWN.length, "a": length})
    roads = Roads(town, [CROSSING], {("x", "a"): 1.0, ("x", "f"): 3.0})
    present = np.array([{"a": 5.0, "x": 8.0}.get(lane[0], 0.0) for lane in roads.lanes])
    assert (roads.weights @ present)[roads.movements["a", "b"]] == pytest.approx(weight)


def test_who_waits_behind_a_piece_too_short_to_be_seen_on_is_seen():
    """A vehicle stands on x, before the 5 m of a, where a detector would find nobody: it gets its
    green."""
    town = replace(TOWN, length={**TOWN.length, "a": 5.0})
    _, play = played({"x": 1.0, "c": 9.0}, town=town)
    shown = [state for _, state in play(120)]
    assert shown.count("rG") == 2
    assert shown.count("Gr") >= 2


def test_saturation_flows_by_hand():
    """A lane each; of a lane that two movements share, a share; of a permissive green, less;
    nothing of a lane that this stage serves in part and another one wholly: its queue stands behind
    whoever is first."""
    _, roads = weights()
    assert roads.begins == [0, 2]
    dense, movement = roads.gain.toarray(), roads.movements
    assert dense[0, movement["a", "b"]] == 1.0
    assert dense[1, movement["c", "d"]] == 1.0
    assert dense[2, movement["b", "e"]] == pytest.approx(1.75)
    assert dense[2, movement["b", "f"]] == pytest.approx(0.25 * PERMISSIVE)
    assert dense[3, movement["b", "f"]] == 0.0
    assert np.count_nonzero(dense) == 4


def test_a_lane_that_no_stage_serves_wholly_counts_as_its_first_vehicle_is_likely_to_be_served():
    """Three quarters of the right lane of b go to e: a share of 0.75 with a chance of 0.75; 0.25 of
    0.25 go to f."""
    divided = signal([("GGr", 30), ("yyr", 3), ("rrG", 30), ("rry", 3)], END.links, "t")
    roads = Roads(TOWN, [CROSSING, divided], FLOWS)
    dense, movement = roads.gain.toarray(), roads.movements
    assert dense[2, movement["b", "e"]] == pytest.approx(1.0 + 0.75 * 0.75)
    assert dense[3, movement["b", "f"]] == pytest.approx(0.25 * 0.25)


def played(vehicles, signals=(CROSSING,), town=TOWN):
    """Max-pressure at these signals, with so many vehicles on every lane of an edge; and a function
    that plays until a time and returns (time, state) of all that s has shown."""
    session = SimpleNamespace(time=0.0, lane_vehicles=lambda lane: vehicles.get(lane[0], 0.0))
    shown = []

    def show(name, state):
        if name == "s":
            shown.append((session.time, state))

    control = MaxPressure(session, town, signals, FLOWS, show=show, lookahead=1.0)

    def play(until):
        while session.time < until:
            control.play(session.time)
            session.time += 1.0
        return shown

    return control, play


@pytest.fixture
def junctions():
    """The vehicles on every lane of an edge, to be changed, and what plays both signals."""
    vehicles = {}
    return vehicles, played(vehicles, [CROSSING, END])[1]


def test_no_green_outlasts_the_maximum_while_others_wait():
    """A single vehicle waits on c, a hundred on a; nobody anywhere else: then a keeps its green."""

    def greens(**vehicles):
        _, play = played(vehicles)
        return [time for time, state in play(200) if state == "rG"]

    assert greens(a=100.0) == []
    assert greens(a=100.0, c=1.0) == [
        53.0,
        113.0,
        173.0,
    ]  # decided every 5 s: 50 s of green, 3 s; 47 s, 3 s


def test_who_waits_too_long_comes_first(monkeypatch):
    """c has no pressure at all, as its road ahead is full; after 120 s of red its link gets the
    minimum green."""
    monkeypatch.setattr(max_pressure, "MAX_GREEN_S", 500.0)
    town = replace(TOWN, successors={**AFTER, "d": ("e",)})
    _, play = played({"a": 5.0, "c": 2.0, "d": 30.0}, town=town)
    shown = play(150)
    assert [entry for entry in shown if entry[1] == "rG"] == [(MAX_RED_S + 3.0, "rG")]
    assert shown[-1] == (MAX_RED_S + 13.0, "Gr")


@pytest.mark.parametrize("buses, first", [(1.0, MAX_RED_S + 3.0), (30.0, 8.0)])
def test_who_waits_on_a_street_that_is_closed_to_cars_gets_a_green(buses, first, monkeypatch):
    """Buses on k are in no count of cars: they press by their number, and a single one does not
    wait for ever."""
    monkeypatch.setattr(max_pressure, "MAX_GREEN_S", 500.0)
    crossing = replace(CROSSING, links=(link(0, "a", "b"),), others=(link(1, "k", "d"),))
    _, play = played({"a": 5.0, "k": buses}, [crossing])
    assert next(time for time, state in play(150) if state == "rG") == first


def test_streets_that_are_closed_to_cars_are_read_with_their_signals(tmp_path):
    """A bus street from the north into B1 of the tiny city; footways at its signal are nobody's."""
    file = tiny_city.network(tmp_path, "--tls.set B1,B2,C1,C2,B3,C0")
    root = ElementTree.parse(file)
    for lane in root.iterfind("edge[@id='B2B1']/lane"):
        lane.set("allow", "bus")
    root.write(file)
    city = load_city(file, tiny_city.regions(file, lambda edge: 0), 1)
    (found,) = (one for one in read_signals(city)[0] if one.id == "B1")
    assert {each.from_edge for each in found.others} == {"B2B1"}
    assert "B2B1" not in {each.from_edge for each in found.links}
    assert {each.index for each in (*found.links, *found.others)} == set(
        range(len(found.phases[0].state))
    )


def test_the_green_goes_where_the_pressure_is_after_the_minimum(junctions):
    """Decided every 5 s; yellow for 3 s; and back in the same way."""
    vehicles, play = junctions
    vehicles["c"] = 3.0
    assert play(9.0) == [(0.0, "Gr"), (5.0, "yr"), (8.0, "rG")]
    vehicles.update(c=0.0, a=1.0)  # green since 8 s, until 13 s at least
    assert play(61.0)[3:] == [(15.0, "ry"), (18.0, "Gr")]


@pytest.mark.parametrize(
    "a, b, c, state",
    [
        (5.0, 0.0, 4.9, "Gr"),
        (5.0, 0.0, 19.9, "Gr"),
        (5.0, 0.0, 20.1, "rG"),
        (9.0, 3.0, 20.1, "rG"),
        (9.0, 0.0, 20.1, "Gr"),
        (0.0, 4.0, 0.1, "rG"),
        (0.0, 4.0, 0.0, "Gr"),
    ],
    ids=[
        "less",
        "not worth it",
        "more",
        "less but nothing ahead",
        "more and nothing ahead",
        "negative",
        "nobody",
    ],
)
def test_the_higher_pressure_wins_and_the_green_stays_in_doubt(junctions, a, b, c, state):
    """The pressure of a is what waits there less what stands on b: 9 - 0.75 * 5.25 - 0.25 * 0.75 =
    4.9 - at b = 3. That of c has to be four times as high: 3 s of yellow for 1 s of green."""
    vehicles, play = junctions
    vehicles.update(a=a, b=b, c=c)
    assert play(41.0)[-1][1] == state


def test_a_spent_ration_exerts_no_pressure():
    """The gateway a -> b has 10 s of green in a cycle; then it is red, and c gets the green for a
    single vehicle."""
    town = replace(
        TOWN,
        gateways=(Gateway(source=0, target=1, from_edge="a", to_edge="b", signal="s", links=(0,)),),
    )
    control, play = played({"a": 50.0, "c": 1.0}, town=town)
    control.command(np.full(1, 5.0 / 61.0))  # 5 s, and so much of the other 61 s
    assert control.green_time()["s"][0].shown == 0.0
    shown = play(66.0)
    assert control.green_time()["s"][0].shown == pytest.approx(10.0, abs=1.0)
    assert shown[-1][1] == "rG"


def test_what_is_known_of_a_run():
    """Of five lanes one is served in part by a stage of t; CROSS is 6 s of 66 s between its stages,
    and so is t."""
    control, play = played({"a": 9.0, "c": 9.0}, [CROSSING, END])
    play(100.0)
    facts = control.facts(100.0)
    assert (facts["signal_lanes"], facts["split_lanes"], facts["never_whole_lanes"]) == (4, 1, 0)
    assert facts["programmed_intergreen_share"] == pytest.approx(6.0 / 66.0)
    assert facts["intergreen_share"] == pytest.approx(0.5 * 3.0 / 100.0)  # s changes once, t never
