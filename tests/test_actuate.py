"""Perimeter commands on signals: yellow, minimum green, no new conflicts, the original programme at
u_max."""

import numpy as np
import pytest
from signal_rules import MIN_GREEN, PHASES, SINGLE, check, runs

from cosim.plant.gates import DEFAULT_YELLOW_S, GatewaySignal, Ration, yellow_time
from cosim.sumo.session import Phase, Programme


def programme(phases, position=0.0):
    return Programme(
        signal="s",
        phases=tuple(Phase(duration=d, state=s) for s, d in phases),
        position=position,
        static=True,
    )


def gateway_signal(phases, movements, position=0.0, step=1.0):
    """A fixed-time signal, and the states that it will show."""
    shown = []
    signal = GatewaySignal(
        programme(phases, position),
        movements,
        start=0.0,
        step=step,
        show=lambda _, state: shown.append(state),
    )
    return signal, shown


def play(phases, movements, commands, *, position=0.0, interval=90):
    """The state of every second, under a new command (R, R) every `interval` seconds."""
    signal, shown = gateway_signal(phases, movements, position)
    states = []
    for second in range(len(commands) * interval):
        if second % interval == 0:
            signal.command(commands[second // interval])
        signal.play(float(second))
        states.append(shown[-1])
    return states


@pytest.mark.parametrize("phases", [PHASES, SINGLE])
def test_u_max_is_the_original_programme(phases):
    movements = dict.fromkeys(range(1, len(phases[0][0])), 0)
    states = play(phases, movements, [np.ones(1)] * 4, position=17.0)
    original = [s for s, d in phases for _ in range(int(d))]
    assert states == [original[(second + 17) % 90] for second in range(360)]


@pytest.mark.parametrize("phases", [PHASES, SINGLE])
def test_random_commands_are_safe(phases):
    random = np.random.default_rng(3)
    for _ in range(40):
        links = random.permutation(len(phases[0][0]))[: random.integers(1, len(phases[0][0]) + 1)]
        movements = {int(link): int(link) for link in links}
        commands = random.uniform(-0.2, 1.2, (30, 6)).clip(0, 1)
        states = play(
            phases,
            movements,
            list(commands),
            position=float(random.integers(90)),
            interval=int(random.choice([30, 45, 90, 170])),
        )
        check(states, phases)


def test_green_falls_from_the_original_to_the_minimum():
    green = []
    for share in np.linspace(0.0, 1.0, 11):
        states = play(PHASES, {0: 0}, [np.full(1, share)] * 3)
        green.append(sum(s[0] in "Gg" for s in states[90:180]))
    assert green[0] == MIN_GREEN
    assert green[-1] == 30
    assert green[2] == 10
    assert green[4] == 15
    assert green[6] == 20
    assert (np.diff(green) >= 2).all()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_a_green_that_is_cut_has_the_yellow_of_the_programme_and_no_more(share):
    states = play(SINGLE, {0: 0}, [np.full(1, share)] * 4)
    assert [length for shown, length in runs(states, 0)[2:-1] if shown == "y"] == [3, 3, 3]


@pytest.mark.parametrize("position", [0.0, 17.0])
def test_a_link_that_is_never_red_is_held_once_per_cycle(position):
    """Its window is the cycle; the one that had begun before the simulation is left whole."""
    states = play(PHASES, {3: 0}, [np.full(1, 0.4)] * 4, position=position)
    first = round(90 - position) if position else 90
    assert "".join(state[3] for state in states[first : first + 180]) == 2 * (
        39 * "g" + 3 * "y" + 48 * "r"
    )
    assert {state[3] for state in states[: round(90 - position)]} == {"g"}


@pytest.mark.parametrize("rounding", [-1e-7, 0.0, 1e-7])
def test_the_end_of_the_cycle_may_be_off_by_some_rounding(rounding):
    """Sums of simulation steps are."""
    signal, shown = gateway_signal(SINGLE, {0: 0})
    signal.play(89.0 + rounding)
    signal.play(90.0 + rounding)
    assert shown == ["ry", "Gr"]


def test_every_window_of_a_link_keeps_its_minimum_green():
    phases = [("G", 20), ("y", 3), ("G", 10), ("y", 3), ("r", 54)]
    held = "".join(play(phases, {0: 0}, [np.zeros(1)] * 2)[90:])
    assert held == 5 * "G" + 3 * "y" + 15 * "r" + 5 * "G" + 3 * "y" + 59 * "r"


HALVES = [("Gr", 42.5), ("yr", 3.5), ("rG", 41.5), ("ry", 3.0)]
SHORT = [("rG", 20.25), ("ry", 3.0), ("Gr", 0.25), ("gr", 20.0), ("yr", 3.25)]


@pytest.mark.parametrize("phases", [HALVES, SHORT])
@pytest.mark.parametrize("step", [0.5, 1.0])
@pytest.mark.parametrize("share, cut", [(1.0, None), (0.0, 5.0)])
def test_a_change_is_in_the_step_that_contains_its_time(phases, step, share, cut):
    """SUMO's rule, for the phases of the programme and for the end of a limited green."""
    signal, shown = gateway_signal(phases, {0: 0}, step=step)
    signal.command(np.full(1, share))
    cycle = sum(seconds for _, seconds in phases)
    ends = np.cumsum([seconds for _, seconds in phases])
    begin = next(
        end - seconds for (state, seconds), end in zip(phases, ends, strict=True) if state[0] == "G"
    )
    for now in np.arange(0.0, 3 * cycle, step):
        signal.play(now)
        last = now + step - 0.01  # before the end of the step
        expected = phases[int(np.searchsorted(ends, last % cycle, side="right"))][0][0]
        if cut and last > (begin or cycle) and (last - begin) % cycle >= cut:
            expected = "y" if (last - begin) % cycle < cut + yellow_time_of(phases) else "r"
        assert shown[-1][0] == expected, now


def yellow_time_of(phases):
    return yellow_time(programme(phases).phases, 0)


def test_u_max_is_the_original_programme_to_the_fraction_of_a_second():
    phases = [("Gr", 42.4), ("yr", 3), ("rG", 41.6), ("ry", 3)]
    signal, _ = gateway_signal(phases, {0: 0}, step=0.1)
    signal.command(np.ones(1))
    for now in np.arange(0.0, 271.0, 0.1):
        signal.play(now)
    assert signal.green_time()["s"][0].shown == pytest.approx(3 * 42.4)


@pytest.mark.parametrize(
    "states, expected",
    [
        ([("G", 30), ("y", 2), ("y", 3), ("r", 55)], 5),
        ([("G", 30), ("r", 60)], DEFAULT_YELLOW_S),
        ([("G", 30), ("y", 4)], 4),
        ([("g", 9), ("y", 3), ("r", 5), ("G", 9), ("y", 4), ("r", 5)], 4),
        ([("y", 3), ("r", 9)], DEFAULT_YELLOW_S),
        ([("y", 2), ("r", 9), ("G", 9), ("y", 3)], 5),
    ],
)
def test_the_longest_yellow_after_a_green(states, expected):
    assert yellow_time(programme(states).phases, 0) == expected


def lit(*spans):
    """Return one light per second from spans such as "30G"."""
    return "".join(int(span[:-1]) * span[-1] for span in spans)


USUAL, TWICE, ALWAYS = (
    2 * lit("30G", "3y", "27r"),
    lit("10G", "3y", "7r", "20G", "3y", "17r"),
    lit("130G"),
)


@pytest.mark.parametrize(
    "lights, share, full, expected",
    [
        (USUAL, 1.0, 30.0, USUAL),
        (USUAL, 0.4, 30.0, 2 * lit("15G", "3y", "42r")),  # 5 s and two fifths of the other 25 s
        (USUAL, 0.0, 4.0, 2 * lit("4G", "3y", "53r")),  # less than the minimum green to begin with
        (TWICE, 0.4, 30.0, lit("10G", "3y", "7r", "5G", "3y", "32r")),
        (
            TWICE,
            0.3,
            30.0,
            lit("10G", "3y", "47r"),
        ),  # the remaining 2.5 s are below the minimum green
        (
            lit("8G", "3y", "49G"),
            0.2,
            30.0,
            lit("8G", "3y", "49r"),
        ),  # 2 s are left after the yellow of the programme
        (lit("8G", "3y", "49G"), 0.4, 30.0, lit("8G", "3y", "7G", "3y", "39r")),
        (lit("20r", "40G"), 0.4, 30.0, lit("20r", "15G", "3y", "22r")),
        (ALWAYS, 0.4, None, lit("27G", "3y", "30r", "27G", "3y", "30r", "10G")),
        (
            ALWAYS,
            53 / 55,
            None,
            lit("58G", "3y", "58G", "3y", "8G"),
        ),  # a yellow ends before the next green begins
    ],
)
def test_a_ration_of_green_is_spent_in_every_cycle(lights, share, full, expected):
    """Compare each second with the green worked out by hand; `show` is called only when the ration
    asks for it."""
    ration, shown, again = Ration(0, cycle=60.0, yellow=3.0, start=0.0, full=full), "", 0.0
    ration.share = share
    for second, light in enumerate(lights):
        if second >= again or light != lights[second - 1]:
            last, again = ration.show(light, float(second))
        shown += last
        assert ration.opened(second) == (last == "G" and shown[-2:-1] != "G")
    assert shown == expected
    green = ration.green_time(float(len(lights)))
    assert green.shown == shown.count("G")
    assert green.ungated == lights.count("G")
    assert ration.limited == (share < 1.0)
