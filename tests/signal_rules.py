"""What the signals of a junction must keep to under any command, and two programmes to try it
on."""

import itertools
from collections import defaultdict
from xml.etree import ElementTree

from cosim.evaluation.signal_proof import Rules, violations
from cosim.sumo.session import Phase
from cosim.sumo.signals import Link, Signal

MIN_GREEN = 5.0

# Two crossing streets with a left-turn tail; link 1 is a gateway in both phases of its street, link
# 3 turns on a g that never ends, and the green of link 4 runs over the end of the cycle.
PHASES = [
    ("GGrgG", 30),
    ("yGrgG", 3),
    ("rGrgy", 6),
    ("ryrgr", 3),
    ("rrGgr", 40),
    ("rrygr", 3),
    ("rrrgG", 5),
]
SINGLE = [("Gr", 42), ("yr", 3), ("rG", 4), ("rG", 38), ("ry", 3)]
# Link 2 is a crossing of the street of link 1.
WALK = [("GrG", 20), ("Grr", 4), ("yrr", 4), ("rrr", 1), ("rGr", 3), ("ryr", 2), ("rrr", 2)]
CROSS = [("Gr", 30), ("yr", 3), ("rG", 30), ("ry", 3)]


def signal(phases, links=(), name="s"):
    return Signal(
        id=name,
        offset=0.0,
        phases=tuple(Phase(duration=d, state=s) for s, d in phases),
        links=tuple(links),
    )


def cross(name="s"):
    """Two streets, one lane each."""
    return signal(
        CROSS,
        (
            Link(index=0, from_edge="a", lane=0, to_edge="b"),
            Link(index=1, from_edge="c", lane=0, to_edge="d"),
        ),
        name,
    )


def runs(states, link):
    """[(character class, seconds)] of one link: G for any green."""
    text = "".join("G" if s[link] in "Gg" else s[link] for s in states)
    return [(key, len(list(group))) for key, group in itertools.groupby(text)]


def watched(plant):
    """The states of every signal, one per simulation step from now on."""
    session, shown, step = plant.session, defaultdict(list), plant.session.step

    def watch():
        step()
        for name in session.signals():
            shown[name].append(session.signal_state(name))

    session.step = watch
    return shown


def rules(phases, crossings=()):
    """The rules of a signal with such a programme, in steps of 1 s."""
    logic = ElementTree.Element("tlLogic", type="static")
    for state, duration in phases:
        ElementTree.SubElement(logic, "phase", duration=str(duration), state=state)
    return Rules(logic, crossings, 1.0)


def check(states, phases):
    """What must hold under any command; states: one per second."""
    changes = [
        (float(n), state) for n, state in enumerate(states) if not n or state != states[n - 1]
    ]
    row = rules(phases).judge(changes, float(len(states)))
    assert not violations(row), row
