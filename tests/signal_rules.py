"""What the signals of a junction must keep to under any command, and two programmes to try it on."""

import itertools

from cosim.sumo.session import Phase
from cosim.sumo.signals import Link, Signal

MIN_GREEN = 5.0

# Two crossing streets with a left-turn tail; link 1 is a gateway in both phases of its street, link 3 turns on a g that
# never ends, and the green of link 4 runs over the end of the cycle.
PHASES = [("GGrgG", 30), ("yGrgG", 3), ("rGrgy", 6), ("ryrgr", 3), ("rrGgr", 40), ("rrygr", 3), ("rrrgG", 5)]
SINGLE = [("Gr", 42), ("yr", 3), ("rG", 4), ("rG", 38), ("ry", 3)]
# Link 2 is a crossing of the street of link 1.
WALK = [("GrG", 20), ("Grr", 4), ("yrr", 4), ("rrr", 1), ("rGr", 3), ("ryr", 2), ("rrr", 2)]
CROSS = [("Gr", 30), ("yr", 3), ("rG", 30), ("ry", 3)]


def signal(phases, links=(), name="s"):
    return Signal(id=name, offset=0.0, phases=tuple(Phase(duration=d, state=s) for s, d in phases), links=tuple(links))


def cross(name="s"):
    """Two streets, one lane each."""
    return signal(
        CROSS,
        (Link(index=0, from_edge="a", lane=0, to_edge="b"), Link(index=1, from_edge="c", lane=0, to_edge="d")),
        name,
    )


def runs(states, link):
    """[(character class, seconds)] of one link: G for any green."""
    text = "".join("G" if s[link] in "Gg" else s[link] for s in states)
    return [(key, len(list(group))) for key, group in itertools.groupby(text)]


def check(states, phases, min_green=MIN_GREEN):
    """What must hold under any command; the first and the last run of every link may be cut off by the simulation."""
    together = {
        pair for state, _ in phases for pair in itertools.combinations([n for n, c in enumerate(state) if c in "Gg"], 2)
    }
    for state in set(states):
        for pair in itertools.combinations([n for n, c in enumerate(state) if c in "Gg"], 2):
            assert pair in together, f"{state} shows {pair} green together"
    originals = [s for s, d in phases for _ in range(int(d))] * 3
    for link in range(len(phases[0][0])):
        least = min([length for c, length in runs(originals, link)[1:-1] if c == "G"], default=min_green)
        yellow = [length for c, length in runs(originals, link)[1:-1] if c == "y"]
        sequence = runs(states, link)
        for (before, _), (after, _) in itertools.pairwise(sequence):
            assert (before, after) != ("G", "r"), f"link {link} goes from green to red without yellow"
            assert (before, after) != ("r", "y"), f"link {link} goes from red to yellow"
        for n, (shown, length) in enumerate(sequence[1:-1], start=1):
            if shown == "G":
                assert length >= min(min_green, least), f"link {link} is green for {length} s"
            if shown == "y" and yellow and sequence[n - 1][0] == "G":
                assert length >= min(yellow), f"link {link} is yellow for {length} s"
