"""Proof sheet of the signals of a run: what each showed, against its original programmes.

A green lasts MIN_GREEN_S or as long as originally, that of a crossing as long as originally. After
a green comes the original yellow, YELLOW_S where the programme ends no green. Links are green, and
have the right of way, together only if the programme shows it. Between the greens of others lies
the original time. Of several programmes, the one that fits best counts. The sheet shares no code
with the controllers, and leaves out signals whose states are no phases (NEMA).
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import pandas as pd

from cosim.sumo.xml_files import attribute, read_xml
from nmfd.types import Quantity, Result

KINDS = ("static", "actuated", "delay_based")
MIN_GREEN_S, YELLOW_S = 5.0, 3.0
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
    programmes: dict[str, list[Element]] = {}
    crossings: dict[str, set[int]] = {}
    for root in map(read_xml, files):
        for logic in root.iter("tlLogic"):
            programmes.setdefault(attribute(logic, "id"), []).append(logic)
        for link in root.iter("connection"):
            if (signal := link.get("tl")) and attribute(link, "from").startswith(":"):
                indices = link.get("linkIndex"), link.get("linkIndex2")
                crossings.setdefault(signal, set()).update(int(index) for index in indices if index)
    rows = {
        signal: min(
            (
                Rules(logic, crossings.get(signal, ()), step).judge(
                    states[signal], end, waits.get(signal, np.nan)
                )
                for logic in programmes[signal]
            ),
            key=lambda row: sum(row[-len(VIOLATIONS) :]),
        )
        for signal in sorted(states.keys() & programmes.keys())
        if all(logic.get("type") in KINDS for logic in programmes[signal])
    }
    return {"signal": np.array(list(rows), dtype=str)} | {
        key: np.array([row[n] for row in rows.values()]) for n, key in enumerate(tuple(SHEET)[1:])
    }


def sheets(results: Iterable[Result]) -> pd.DataFrame:
    """Return the table signals.csv: one row per run and signal."""
    parts = [
        result.data[list(SHEET)[1:]]
        .to_dataframe()
        .reset_index()
        .assign(controller=result.controller, seed=result.seed)
        for result in results
    ]
    units = {name: f"{name}_s" for name, quantity in SHEET.items() if quantity.unit == "s"}
    return pd.concat(parts)[["controller", "seed", *SHEET]].rename(columns=units)


class Rules:
    """The rules of one signal with K links, from a programme.

    green, yellow: (K,) [s] least; between: (K, K) [s] least, from the end of a green of the first
        to a green of the
    second; apart, yielding: (K, K) bool, never green, never G, together
    """

    def __init__(self, logic: Element, crossings: Collection[int], step: float):
        """crossings: links for pedestrians; step: see `proof_sheet`"""
        phases = list(logic.iter("phase"))
        lights = np.array([list(attribute(phase, "state")) for phase in phases])
        green, yellow = np.isin(lights, ["G", "g"]), lights == "y"
        shortest = "duration" if logic.get("type") == "static" else "minDur"
        duration = [float(phase.get(shortest) or attribute(phase, "duration")) for phase in phases]
        after = [list(map(int, phase.get("next", "").split())) for phase in phases]
        after = [others or [(n + 1) % len(phases)] for n, others in enumerate(after)]
        steps = [(n, m) for n, others in enumerate(after) for m in others]

        def least(first: np.ndarray, then: np.ndarray) -> np.ndarray:
            """Return the least time (K,) [s] in phases `then` (n, K) after phases `first` (n, K),
            inf if never."""
            times = np.where(then, np.inf, 0.0)
            for _ in phases:
                onward = [
                    seconds + times[others].min(axis=0)
                    for seconds, others in zip(duration, after, strict=True)
                ]
                times = np.where(then, onward, 0.0)
            return np.min(
                [np.where(first[n] & ~first[m], times[m], np.inf) for n, m in steps], axis=0
            )

        self.apart, self.yielding = (~(on.T @ on) for on in (green, lights == "G"))
        self.crossing = crossing = np.isin(np.arange(lights.shape[1]), list(crossings))
        own, passed = least(~green, green), least(green, yellow)
        self.green = np.where(crossing & np.isfinite(own), own, np.minimum(own, MIN_GREEN_S))
        self.yellow = np.where(np.isfinite(passed), passed, np.where(crossing, 0.0, YELLOW_S))
        direct, between = np.full((2, *self.apart.shape), np.inf)
        for start, link in (
            (m, link) for n, m in steps for link in np.flatnonzero(green[n] & ~green[m])
        ):
            # Walk from the end of the green. Direct is the way to a link that is among the first
            # ones, or follows them at once, if it waits for none that goes on; but a crossing is
            # cleared while cars beside it are green.
            coming = self.apart[link] & ~self.apart.diagonal()
            walks = [(start, 0.0, np.inf, coming, coming)]
            while walks:
                phase, time, first, left, usual = walks.pop()
                on, later = green[phase], time + duration[phase]
                first = min(first, time) if (on & self.apart[link]).any() else first
                usual = usual & (time - first < MIN_GREEN_S)
                for gaps, links in ((between, on & left), (direct, on & left & usual)):
                    gaps[link, links] = np.minimum(gaps[link, links], time)
                left = left & ~on
                if later >= MIN_GREEN_S and not crossing[link]:
                    usual = usual & ~(on @ self.apart)
                if left.any() and later < sum(duration):
                    walks += [(other, later, first, left, usual) for other in after[phase]]
        usual = direct.min(axis=1, keepdims=True)
        usual = np.where(np.isfinite(usual), usual, self.yellow[:, None])
        self.between = np.minimum(np.where(np.isfinite(direct), direct, usual), between)
        for times in (self.green, self.yellow, self.between):  # whole steps
            times[:] = np.floor(times / step + 1e-6) * step - 1e-6

    def judge(self, states: States, end: float, wait: float = np.nan) -> tuple[float, ...]:
        """Return the row of SHEET; lights that began before the first state, or last to the end,
        are not judged. wait: the longest [s]"""
        time = np.array([time for time, _ in states])[:, None]
        lights = np.array([list(state) for _, state in states])
        green, yellow = np.isin(lights, ["G", "g"]), lights == "y"
        was, was_yellow = _before(green), _before(yellow)
        starts, ends = green & ~was, was & ~green
        ended = _latest(ends, time)
        since = _before(
            _latest(starts | ends | (yellow != was_yellow), time)
        )  # beginning of the light before
        lasted, over = time - since, was_yellow & ~yellow & (since == _before(ended))
        bare = ends & ~yellow & (self.yellow > 0.0)
        red = np.where(starts, time - np.maximum(_before(ended), time[0]), 0.0).max(axis=0)
        red = np.where(green[-1], red, np.maximum(red, end - np.maximum(ended[-1], time[0])))
        early = early_after_walk = 0
        clearances = [np.inf]
        for link, apart in enumerate(self.apart.T):
            rows = starts[:, link]
            gap = time[rows] - ended[rows]
            others = apart & ~green[rows]
            too_soon = others & (gap < self.between[:, link])
            walks = self.crossing & ~self.crossing[link]
            early += np.count_nonzero((too_soon & ~walks).any(axis=1))
            early_after_walk += np.count_nonzero((too_soon & walks).any(axis=1))
            clearances.append(gap[others & walks].min(initial=np.inf))
        conflicts = 0
        for on, first in zip(green, lights == "G", strict=True):
            pairs = self.apart & np.outer(on, on) | self.yielding & np.outer(first, first)
            conflicts += np.count_nonzero(np.triu(pairs, 1))
        return (
            _least(lasted[ends]),
            _least(lasted[over]),
            _least(np.array(clearances)),
            float(red[~self.apart.diagonal()].max(initial=0.0)),
            wait,
            np.count_nonzero(ends & (lasted < self.green)),
            np.count_nonzero(bare) + np.count_nonzero(over & (lasted < self.yellow)),
            early,
            early_after_walk,
            conflicts,
        )


def _before(rows: np.ndarray) -> np.ndarray:
    """Return the rows before those of an array (M, K), the first one twice."""
    return np.vstack([rows[:1], rows[:-1]])


def _latest(events: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the time (M, K) [s] of the latest of the events (M, K), -inf before the first. time:
    (M, 1) [s]"""
    return np.maximum.accumulate(np.where(events, time, -np.inf))


def _least(times: np.ndarray) -> float:
    return float(min(times[np.isfinite(times)], default=np.nan))
