"""Proof sheet of the signals of a run, against their programmes.

- A green lasts MIN_GREEN_S, or as long as originally if that is less. The green of a crossing
  lasts as long as originally.
- The original yellow follows a green, or YELLOW_S if the programme ends no green.
- Two links may be green together, or have the right of way together, only if the programme allows
  it. Otherwise the programmed intergreen must separate them.

If a signal has several programmes, the one that fits best counts. The sheet shares no code with the
controllers. It leaves out signals whose states are no phases (NEMA), and those whose programme a
timetable changes.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from cosim.sumo.xml_files import attribute, read_xml, seconds_of, xml_text
from nmfd.types import Quantity, Result

if TYPE_CHECKING:
    import pandas as pd

KINDS = ("static", "actuated", "delay_based")
NO_RULES = ("id", "programID", "offset")  # attributes of a programme without effect on its rules
MIN_GREEN_S = 5.0
YELLOW_S = 3.0
SHEET = {  # variable of a result, column of signals.csv
    "signal": Quantity(("signal",), "", "id of the signal"),
    "shortest_green": Quantity(
        ("signal",), "s", "shortest green of a link; NaN without one that began and ended"
    ),
    "shortest_yellow": Quantity(("signal",), "s", "shortest yellow after a green; NaN without one"),
    "shortest_clearance": Quantity(
        ("signal",), "s", "shortest time from the green of a crossing to that of cars across it"
    ),
    "longest_red": Quantity(
        ("signal",), "s", "longest time without green of a link that has green in a programme"
    ),
    "longest_wait": Quantity(
        ("signal",), "s", "longest time that the first driver of a lane stood at red"
    ),
    "short_greens": Quantity(("signal",), "1", "greens below the minimum"),
    "short_yellows": Quantity(("signal",), "1", "greens without the original yellow after them"),
    "short_intergreens": Quantity(
        ("signal",), "1", "greens too soon after the green of another link"
    ),
    "short_clearances": Quantity(
        ("signal",), "1", "greens of cars too soon after the green of a crossing"
    ),
    "conflicts": Quantity(
        ("signal",), "1", "pairs of links with green, or the right of way, as never originally"
    ),
}
VIOLATIONS = tuple(SHEET)[-5:]
States = Sequence[tuple[float, str]]  # time [s] and state at every change


def proof_sheet(
    states: Mapping[str, States],
    files: Iterable[Path],
    *,
    end: float,
    step: float,
    waits: Mapping[str, float],
) -> dict:
    """Return the arrays (S,) of SHEET.

    states: by signal; files: network and additional files, with the programmes
    end: of the run [s]; step: of the simulation [s], to which times are rounded down
    waits: longest wait of a driver by signal [s]
    """
    programmes: dict[str, list[Element]] = defaultdict(list)
    crossings: dict[str, set[int]] = defaultdict(set)
    timetabled: set[str] = set()
    for root in map(read_xml, files):
        for logic in root.iter("tlLogic"):
            if logic.find("phase") is not None:
                programmes[attribute(logic, "id")].append(logic)
        for link in root.iter("connection"):
            signal = link.get("tl")
            if signal and attribute(link, "from").startswith(":"):
                indices = (link.get("linkIndex"), link.get("linkIndex2"))
                crossings[signal].update(int(index) for index in indices if index)
        timetabled.update(attribute(switch, "junctionID") for switch in root.iter("wautJunction"))
    known: dict[tuple, Rules] = {}  # by programme and crossings
    rows: dict[str, dict[str, float]] = {}
    for signal in sorted((states.keys() & programmes.keys()) - timetabled):
        if any(logic.get("type") not in KINDS for logic in programmes[signal]):
            continue
        judged = []
        for logic in programmes[signal]:
            programme = xml_text(logic, dict.fromkeys(NO_RULES, ""))
            key = (programme, *sorted(crossings[signal]))
            if key not in known:
                known[key] = Rules(logic, crossings[signal], step)
            judged.append(known[key].judge(states[signal], end))
        rows[signal] = min(judged, key=violations)
        rows[signal]["longest_wait"] = waits.get(signal, np.nan)
    sheet = {"signal": np.array(list(rows), dtype=str)}
    for name in list(SHEET)[1:]:
        sheet[name] = np.array([row[name] for row in rows.values()])
    return sheet


def violations(row: Mapping[str, float]) -> int:
    """Return how often a signal broke its rules."""
    return int(sum(row[name] for name in VIOLATIONS))


def sheets(results: Iterable[Result]) -> "pd.DataFrame":
    """Return the table signals.csv: one row per run and signal."""
    import pandas as pd  # a third of a second, which runs do not need

    parts = []
    for result in results:
        columns = {name: result[name] for name in SHEET}
        parts.append(
            pd.DataFrame({"controller": result.controller, "seed": result.seed, **columns})
        )
    units = {name: f"{name}_s" for name, quantity in SHEET.items() if quantity.unit == "s"}
    return pd.concat(parts).rename(columns=units)


class _Programme(NamedTuple):
    """The n phases of a programme.

    lights: (n, K) characters, by link; shortest: (n,) least durations [s]
    changes: phases that follow each other; after: phase -> the next ones
    """

    lights: np.ndarray
    shortest: list[float]
    changes: list[tuple[int, int]]
    after: list[list[int]]

    @property
    def green(self) -> np.ndarray:
        """(n, K) bool."""
        return np.isin(self.lights, ["G", "g"])


class _Walk(NamedTuple):
    """A way through the phases from the end of a green on.

    phase: the present one; time: since the end of the green [s]
    first: time at which a green begins that the ended one excludes [s], inf before
    left: (K,) bool, links that have not become green on the way; direct: those among them that the
        programme switches to directly
    """

    phase: int
    time: float
    first: float
    left: np.ndarray
    direct: np.ndarray


class Rules:
    """The rules of one signal with K links, from a programme.

    green, yellow: (K,) [s], least duration
    between: (K, K) [s], least time from the end of a green of the first to a green of the second
    apart, yielding: (K, K) bool, never green together, never G together
    crossing: (K,) bool, for pedestrians
    """

    def __init__(self, logic: Element, crossings: Collection[int], step: float):
        """crossings: links for pedestrians; step: see `proof_sheet`"""
        programme = _programme(logic)
        green = programme.green
        yellow = programme.lights == "y"
        right_of_way = programme.lights == "G"
        self.apart = ~(green.T @ green)
        self.yielding = ~(right_of_way.T @ right_of_way)
        self.crossing = np.isin(np.arange(green.shape[1]), list(crossings))
        own = _least_times(programme, ~green, green)
        walk = self.crossing & np.isfinite(own)
        self.green = np.where(walk, own, np.minimum(own, MIN_GREEN_S))
        usual_yellow = np.where(self.crossing, 0.0, YELLOW_S)
        passed = _least_times(programme, green, yellow)
        self.yellow = np.where(np.isfinite(passed), passed, usual_yellow)
        self.between = _intergreen(programme, self.apart, self.crossing, self.yellow)
        for times in (self.green, self.yellow, self.between):  # whole steps
            times[:] = np.floor(times / step + 1e-6) * step - 1e-6

    def judge(self, states: States, end: float) -> dict[str, float]:
        """Return the row of SHEET, without the longest wait.

        Lights that began before the first state, or last to the end, are not judged.
        """
        time = np.array([time for time, _ in states])[:, None]
        lights = np.array([list(state) for _, state in states])
        green = np.isin(lights, ["G", "g"])
        yellow = lights == "y"
        was_green = _before(green)
        was_yellow = _before(yellow)
        starts = green & ~was_green
        ends = was_green & ~green
        ended = _latest(ends, time)
        changed = starts | ends | (yellow != was_yellow)
        since = _before(_latest(changed, time))  # when the light before this one began
        lasted = time - since
        yellow_over = was_yellow & ~yellow & (since == _before(ended))
        bare = ends & ~yellow & (self.yellow > 0.0)

        red = np.where(starts, time - np.maximum(_before(ended), time[0]), 0.0).max(axis=0)
        red_at_the_end = end - np.maximum(ended[-1], time[0])
        red = np.where(green[-1], red, np.maximum(red, red_at_the_end))

        short_intergreens = short_clearances = 0
        clearances = [np.inf]
        for link, apart in enumerate(self.apart.T):
            rows = starts[:, link]
            gap = time[rows] - ended[rows]
            others = apart & ~green[rows]
            too_soon = others & (gap < self.between[:, link])
            walks = self.crossing & ~self.crossing[link]
            short_intergreens += np.count_nonzero((too_soon & ~walks).any(axis=1))
            short_clearances += np.count_nonzero((too_soon & walks).any(axis=1))
            clearances.append(gap[others & walks].min(initial=np.inf))

        conflicts = 0
        for state, times in Counter(state for _, state in states).items():
            conflicts += times * self._conflicts(state)

        short_yellows = np.count_nonzero(yellow_over & (lasted < self.yellow))
        return {
            "shortest_green": _least(lasted[ends]),
            "shortest_yellow": _least(lasted[yellow_over]),
            "shortest_clearance": _least(np.array(clearances)),
            "longest_red": float(red[~self.apart.diagonal()].max(initial=0.0)),
            "short_greens": np.count_nonzero(ends & (lasted < self.green)),
            "short_yellows": np.count_nonzero(bare) + short_yellows,
            "short_intergreens": short_intergreens,
            "short_clearances": short_clearances,
            "conflicts": conflicts,
        }

    def _conflicts(self, state: str) -> int:
        """Return how many pairs of links a state should not serve together."""
        lights = np.array(list(state))
        first = lights == "G"
        on = first | (lights == "g")
        together = self.apart & np.outer(on, on)
        unclear = self.yielding & np.outer(first, first)
        return int(np.count_nonzero(np.triu(together | unclear, 1)))


def _programme(logic: Element) -> _Programme:
    """Return the phases of a <tlLogic>."""
    shortest = "duration" if logic.get("type") == "static" else "minDur"
    phases = list(logic.iter("phase"))
    lights = []
    times = []
    changes = []
    after = []
    for n, phase in enumerate(phases):
        lights.append(list(attribute(phase, "state")))
        times.append(seconds_of(phase.get(shortest) or attribute(phase, "duration")))
        following = [int(number) for number in phase.get("next", "").split()]
        following = following or [(n + 1) % len(phases)]
        after.append(following)
        changes += [(n, m) for m in following]
    return _Programme(np.array(lights), times, changes, after)


def _least_times(programme: _Programme, first: np.ndarray, then: np.ndarray) -> np.ndarray:
    """Return for each link the shortest time in `then` after leaving `first`.

    It is (K,) [s], inf if that never happens. first, then: (n, K) bool, phases
    """
    times = np.where(then, np.inf, 0.0)  # (n, K) from the begin of a phase on
    for _ in programme.shortest:
        onward = []
        for seconds, following in zip(programme.shortest, programme.after, strict=True):
            onward.append(seconds + times[following].min(axis=0))
        times = np.where(then, onward, 0.0)
    least = np.full(then.shape[1], np.inf)
    for n, m in programme.changes:
        left = first[n] & ~first[m]
        least = np.where(left, np.minimum(least, times[m]), least)
    return least


def _intergreen(
    programme: _Programme, apart: np.ndarray, crossing: np.ndarray, yellow: np.ndarray
) -> np.ndarray:
    """Return (K, K) [s], least times from a green of a link to another's.

    The programme is walked from the end of every green on. It switches to a link directly if this
    link is among the first ones that become green, or follows them within the minimum green, and
    waits for none that stays green. But a crossing is cleared while cars beside it are green. For
    other links the shortest direct switch from the first link counts.
    """
    green = programme.green
    cycle = sum(programme.shortest)
    between = np.full(apart.shape, np.inf)
    direct = between.copy()
    for n, start in programme.changes:
        for link in np.flatnonzero(green[n] & ~green[start]):
            coming = apart[link] & ~apart.diagonal()
            walks = [_Walk(start, 0.0, np.inf, coming, coming)]
            while walks:
                walk = walks.pop()
                on = green[walk.phase]
                first = walk.first
                if (on & apart[link]).any():
                    first = min(first, walk.time)
                at_once = walk.direct & (walk.time - first < MIN_GREEN_S)
                new = on & walk.left
                between[link, new] = np.minimum(between[link, new], walk.time)
                new = new & at_once
                direct[link, new] = np.minimum(direct[link, new], walk.time)

                left = walk.left & ~on
                later = walk.time + programme.shortest[walk.phase]
                if later >= MIN_GREEN_S and not crossing[link]:
                    at_once = at_once & ~(on @ apart)
                if left.any() and later < cycle:
                    for following in programme.after[walk.phase]:
                        walks.append(_Walk(following, later, first, left, at_once))
    usual = direct.min(axis=1, keepdims=True)
    usual = np.where(np.isfinite(usual), usual, yellow[:, None])
    return np.minimum(np.where(np.isfinite(direct), direct, usual), between)


def _before(rows: np.ndarray) -> np.ndarray:
    """Return the rows before those of an array (M, K), the first one twice."""
    return np.vstack([rows[:1], rows[:-1]])


def _latest(events: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return (M, K) [s], the time of the latest event so far; -inf before any.

    events: (M, K) bool; time: (M, 1) [s]
    """
    return np.maximum.accumulate(np.where(events, time, -np.inf))


def _least(times: np.ndarray) -> float:
    return float(min(times[np.isfinite(times)], default=np.nan))
