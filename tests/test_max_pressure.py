"""Max-pressure without SUMO: the ways between stages, rations of green, and pressures worked out by hand."""

import numpy as np
import pytest
from signal_rules import CROSS, MIN_GREEN, PHASES, SINGLE, check, signal

from cosim.plant.max_pressure import Junction, transition
from cosim.sumo.session import Phase


@pytest.mark.parametrize("phases", [PHASES, SINGLE, CROSS])
def test_every_way_between_stages_is_safe(phases):
    """Random switching: yellow after green, the minimum green, nothing green together that never was."""
    random = np.random.default_rng(2)
    junction, states = Junction(signal(phases), 0.0, min_green=MIN_GREEN), []
    for second in range(1500):
        if second >= junction.next_change:
            junction.advance(float(second))
        if junction.may_switch(float(second)) and random.random() < 0.3:
            other = int(random.integers(junction.stages))
            if other != junction.stage:
                junction.switch(other, float(second))
        states.append(junction.state)
    assert len(set(states)) > 3
    check(states, phases, MIN_GREEN)


def test_the_programme_s_own_way_is_kept():
    phases = signal(SINGLE).phases
    assert [p.state for p in transition(phases, 0, 2)] == ["yr"]
    phases = signal([("GGr", 20), ("yyr", 4), ("rrr", 2), ("rrG", 20), ("rry", 3), ("Grr", 9), ("yrr", 3)]).phases
    assert [(p.state, p.duration) for p in transition(phases, 0, 3)] == [("yyr", 4), ("rrr", 2)]
    assert [(p.state, p.duration) for p in transition(phases, 0, 5)] == [("Gyr", 4), ("Grr", 2)]
    assert transition(phases, 5, 0) == [Phase(duration=3, state="yrr")]


@pytest.mark.parametrize("phases", [PHASES, SINGLE, CROSS])
def test_rationed_green(phases):
    """Random switching and commands: all is safe; no cycle has more green than its ration; u_max rations nothing."""
    random, links = np.random.default_rng(3), (0, 1)
    junction = Junction(signal(phases), 0.0, {link: (0, 1) for link in links}, min_green=MIN_GREEN)
    cycle, states, budgets = int(sum(d for _, d in phases)), [], []
    for second in range(40 * cycle):
        now = float(second)
        if second % cycle == 0:
            share = 1.0 if second >= 30 * cycle else float(random.uniform())
            junction.command(np.full((2, 2), share))
            budgets.append(np.inf if share == 1.0 else MIN_GREEN + share * (cycle - MIN_GREEN))
        if now >= junction.next_change - 1e-6:
            junction.advance(now)
        if junction.may_switch(now) and random.random() < 0.1:
            junction.switch((junction.stage + 1) % junction.stages, now)
        states.append(junction.state)
    check(states, phases, MIN_GREEN)
    green = np.array([[state[link] in "Gg" for link in links] for state in states]).reshape(40, cycle, 2).sum(axis=1)
    assert (green <= np.ceil(np.array(budgets))[:, None]).all()
    limited = np.isfinite(budgets)
    assert (green[limited] >= np.array(budgets)[limited, None] - 1.0).any()  # rations are used up somewhere
    assert junction.green_time(40.0 * cycle) == {link: green[:, n].sum() for n, link in enumerate(links)}


@pytest.mark.parametrize("min_green", [2.0, 9.0])
def test_the_minimum_green_is_that_of_the_settings(min_green):
    """A stage lasts so long, and so much green has a gateway whose ration is the least."""
    held = Junction(signal(CROSS), 0.0, {0: (0, 1)}, min_green=min_green)
    held.command(np.zeros((2, 2)))
    assert held.may_switch(min_green) and not held.may_switch(min_green - 1.0)
    while held.next_change < 66.0:
        held.advance(held.next_change)
    assert held.green_time(66.0) == {0: min_green}
