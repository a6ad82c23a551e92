"""Stages of a signal, and safe transitions between any two of them.

A stage is a phase of the original programme that is green for some link and yellow for none.
Max-pressure takes the stages in any order, so it needs transitions that the programme does not
have. Yellow and all-red times of these come from the programme. An example (= green, ~ yellow,
. red):

    phase        0     1     2     3     4     5     6
    seconds     20     3    20     3     2    20     3
    link 0     ===== ===== ===== ~~~~~ ..... ..... .....
    link 1     ===== ~~~~~ ..... ..... ..... ..... .....
    link 2     ..... ..... ===== ~~~~~ ..... ..... .....
    link 3     ..... ..... ..... ..... ..... ===== ~~~~~

The stages are phases 0, 2 and 5. The programme goes from 0 to 2 by phase 1, and from 2 to 5 by
phases 3 and 4. It never goes from 0 to 5 directly. There links 0 and 1 lose their green: yellow for
3 s, then red for 2 s, because link 3 gets its green 5 s after that of link 0 ends (`clearance`).
"""

from functools import lru_cache
from itertools import permutations
from typing import NamedTuple

import numpy as np

from cosim.plant.gates import (
    MIN_GREEN_S,
    NEVER,
    Movements,
    Ration,
    ends_bare,
    run_length,
    yellow_time,
)
from cosim.sumo.session import Phase
from cosim.sumo.signals import GREEN, Signal, is_stage

LEVELS = "rsgG"  # from red by way of turns on red to the right of way


class _Change(NamedTuple):
    """A coming change of a signal: time (s) and the state from then on."""

    time: float
    state: str


class Junction:
    """The states of one signal, second by second.

    A state belongs to a stage, or to the transition between two stages.

    stages: their number; stage: the present or coming one; stage_since: time at which it begins (s)
    losses: (stage, another stage) -> time between them (s)
    rations: link index -> limit of the green of a gateway link
    lost: time between stages so far (s); next_change: time of the next `advance` (s)
    """

    def __init__(self, signal: Signal, now: float, gateways: Movements | None = None):
        """gateways: links whose green is rationed"""
        phases = signal.phases
        self.signal = signal.id
        self._phases = phases
        self._numbers = stages_of(signal)
        self._least = _minimum_greens(phases, self._numbers)
        self.stages = len(self._numbers)
        self.losses = {}
        self._transitions = {}
        for source, target in permutations(range(self.stages), 2):
            between = transition(phases, self._numbers[source], self._numbers[target])
            self._transitions[source, target] = between
            self.losses[source, target] = sum(phase.duration for phase in between)
        self.stage = 0
        self.stage_since = now
        self._green_since = now
        self._coming: list[_Change] = []
        self.lost = 0.0
        self._base = phases[self._numbers[0]].state
        self.state = self._base
        self.rations: dict[int, Ration] = {}
        self.next_change = NEVER
        if gateways:
            cycle = sum(phase.duration for phase in phases)
            for link, gateway in gateways.items():
                yellow = yellow_time(phases, link)
                self.rations[link] = Ration(gateway, cycle=cycle, yellow=yellow, start=now)
            self.next_change = now  # commands hold from the first second on

    def may_switch(self, now: float) -> bool:
        """Return True if the stage may end at `now` (s)."""
        least = max(self._green_since + MIN_GREEN_S, self.stage_since + self._least[self.stage])
        return not self._coming and now >= least - 1e-6

    def switch(self, stage: int, now: float) -> str:
        """Leave the stage for another one; return the state from `now` on."""
        begin = now
        self._coming = []
        for phase in self._transitions[self.stage, stage]:
            self._coming.append(_Change(begin, phase.state))
            begin += phase.duration
        self._coming.append(_Change(begin, self._phases[self._numbers[stage]].state))
        self.stage = stage
        self.stage_since = begin
        self._green_since = begin
        self.lost += begin - now
        return self.advance(now)

    def advance(self, now: float) -> str:
        """Return the state from `now` (s) on; call at every `next_change`."""
        while self._coming and now >= self._coming[0].time - 1e-6:
            self._base = self._coming.pop(0).state
        self.next_change = self._coming[0].time if self._coming else NEVER
        shown = list(self._base)
        for link, ration in self.rations.items():
            lasting = all(change.state[link] in GREEN for change in self._coming)
            shown[link], again = ration.show(shown[link], now, lasting=lasting)
            self.next_change = min(self.next_change, again)
            # A ration may open in the middle of a stage, which then lasts for the minimum green.
            if ration.opened(now):
                self._green_since = max(self._green_since, now)
        self.state = "".join(shown)
        return self.state


def _minimum_greens(phases: tuple[Phase, ...], stages: tuple[int, ...]) -> list[float]:
    """Return the minimum green (s) of every stage.

    Pedestrians, whose green ends without yellow, get the longest green of the programme.
    """
    walking = {}
    for link in ends_bare(phases):
        walking[link] = max(run_length(phases, n, link, GREEN) for n in range(len(phases)))
    least = []
    for stage in stages:
        green = MIN_GREEN_S
        for link, longest in walking.items():
            if phases[stage].state[link] in GREEN:
                green = max(green, longest)
        least.append(green)
    return least


def stages_of(signal: Signal) -> tuple[int, ...]:
    """Return the stages (phases) whose green no other stage covers."""
    level = {}
    for n in signal.stages:
        level[n] = np.array([LEVELS.index(light) for light in signal.phases[n].state])
    covered = set()
    for n, m in permutations(level, 2):
        no_less = (level[n] <= level[m]).all()
        more = (level[n] < level[m]).any()
        if no_less and (more or m < n):  # of equal stages the first one stays
            covered.add(n)
    return tuple(n for n in level if n not in covered)


@lru_cache(maxsize=4096)  # a city shows the same states all day
def green_links(state: str) -> np.ndarray:
    """Return (K,) bool: the link is green in this state."""
    return np.isin(list(state), list(GREEN))


@lru_cache(maxsize=4096)
def clearance(phases: tuple[Phase, ...]) -> np.ndarray:
    """Return the shortest times between two greens (s, (K, K)).

    Row: the link whose green ends; column: the link whose green starts. The time is zero if both
    are green together in any phase. Otherwise it is taken from the programme if that switches from
    the first link to the second directly. If not, it is the shortest clearance that the programme
    has after the first link.
    """
    green = np.array([green_links(phase.state) for phase in phases])
    apart = ~(green.T @ green)
    direct = _direct_clearance(phases, green, apart)
    shortest = direct.min(axis=1, keepdims=True)
    after_link = np.where(shortest < NEVER, shortest, 0.0)
    times = np.where(direct < NEVER, direct, after_link)
    return np.where(apart, times, 0.0)


def _direct_clearance(
    phases: tuple[Phase, ...], green: np.ndarray, apart: np.ndarray
) -> np.ndarray:
    """Return the `clearance` (s, (K, K)) where the programme has one.

    It is NEVER where the programme does not switch from the one link to the other directly.

    green: a link is green in a phase (bool, (phases, K)); apart: two links never are (bool, (K, K))
    """
    direct = np.full(apart.shape, NEVER)
    bare = ends_bare(phases)
    ends = np.roll(green, 1, axis=0) & ~green
    for n, link in np.argwhere(ends):
        time = 0.0  # since the end of this green
        first = NEVER  # time of the first green that conflicts with it
        waiting = apart[link]  # links that the programme may still switch to directly
        for m in range(n, n + len(phases)):
            phase = m % len(phases)
            on = green[phase]
            if (on & apart[link]).any():
                first = min(first, time)
            if time >= first + MIN_GREEN_S:
                break
            starting = on & waiting
            direct[link, starting] = np.minimum(direct[link, starting], time)
            time += phases[phase].duration
            waiting = waiting & ~on
            if time >= MIN_GREEN_S and link not in bare:
                # Links in conflict with these wait for them, and no longer for the first link.
                waiting = waiting & ~(apart @ on)
    return direct


@lru_cache(maxsize=4096)
def transition(phases: tuple[Phase, ...], source: int, target: int) -> list[Phase]:
    """Return the phases between two stages.

    They are the original ones if the programme goes from `source` to `target`. Otherwise every link
    that loses green or priority (G to g) gets its programmed yellow, then red until conflicting
    traffic has cleared, at least as long as after `source` in the programme. The other links do not
    change, so no conflicting movement is green before the target stage.
    """
    programmed, following = _programmed_transition(phases, source)
    if following == target:
        return programmed
    before = phases[source].state
    after = phases[target].state
    losing, starting = _changing_links(before, after)
    if not losing:
        return []
    clear = {}
    for link in losing:
        clear[link] = max(clearance(phases)[link, starting], default=0.0)
    yellow = max(yellow_time(phases, link) for link in losing)
    walking = losing & ends_bare(phases)
    red = sum(phase.duration for phase in programmed if "y" not in phase.state)
    for link in losing - walking:
        red = max(red, clear[link] - yellow)
    # Pedestrians have no yellow: their clearance may begin while cars beside them are still green.
    early = 0.0
    for link in walking:
        early = max(early, clear[link] - yellow - red)
    steps = ((early, "y", walking), (yellow, "y", losing), (red, "r", losing))
    change = []
    for seconds, light, links in steps:
        if seconds > 0.0:
            state = "".join(light if k in links else old for k, old in enumerate(before))
            change.append(Phase(duration=seconds, state=state))
    return change


def _programmed_transition(phases: tuple[Phase, ...], source: int) -> tuple[list[Phase], int]:
    """Return the phases after a stage in the programme, and the next stage."""
    between = []
    n = (source + 1) % len(phases)
    while phases[n].state == phases[source].state:
        n = (n + 1) % len(phases)
    while not is_stage(phases[n].state):
        between.append(phases[n])
        n = (n + 1) % len(phases)
    return between, n


def _changing_links(before: str, after: str) -> tuple[set[int], list[int]]:
    """Return links that lose green or priority, and those green anew."""
    losing = set()
    starting = []
    for link, (old, new) in enumerate(zip(before, after, strict=True)):
        loses = old in GREEN and (new not in GREEN or (old, new) == ("G", "g"))
        if loses:
            losing.add(link)
        if new in GREEN and (loses or old not in GREEN):
            starting.append(link)
    return losing, starting


def intergreen_share(phases: tuple[Phase, ...]) -> float:
    """Return the share of the cycle between two stages."""
    between = sum(phase.duration for phase in phases if not is_stage(phase.state))
    return between / sum(phase.duration for phase in phases)
