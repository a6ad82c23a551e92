"""Perimeter control to green: the gateway links of a signal lose a part of their green, second by second.

Every link of the original programme is green in windows. A window of a gateway movement i -> h of length L keeps

    green = m + (u_ih - u_min) / (u_max - u_min) (L - m),        m = min(minimum green, L)

from its beginning; then comes the original yellow, then red until the original window is over. Green is only taken
away, hence no two movements are green together that never were; u_max is the original programme. What is taken stays
red (hold-back), or the phases of gateway movements are shortened and those without any get the seconds, within an
unchanged cycle and unchanged intergreens (redistribute).
"""

from bisect import bisect_right
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import accumulate

import numpy as np

from cosim.plant.settings import HOLD_BACK
from cosim.sumo.session import Phase, Programme
from nmfd.arrays import PerPair

YELLOW = 3.0  # s, where the original programme has none after a green
GREEN = frozenset("Gg")


class GatewaySignal:
    """One signal with gateway links under perimeter control.

    programme: the original one, of `phases`, read at simulation time `start` [s]
    movements: link index -> (i, h)
    min_green: [s], never less, unless the original window is shorter
    """

    def __init__(
        self,
        programme: Programme,
        movements: Mapping[int, tuple[int, int]],
        *,
        min_green: float,
        mode: str,
        start: float,
    ):
        """mode: HOLD_BACK or REDISTRIBUTE of cosim.plant.settings"""
        self.signal, self.phases = programme.signal, programme.phases
        self._states = [phase.state for phase in programme.phases]
        self._original = [phase.duration for phase in programme.phases]
        self._movements = {link: _Movement(pair) for link, pair in movements.items()}
        self._min_green, self._mode, self._cycle = min_green, mode, programme.cycle
        self._windows = {link: _windows(programme, link) for link in movements}
        self._yellow = {link: yellow_time(programme.phases, link) for link in movements}
        self._cycle_start = start - programme.position
        self._ends = list(accumulate(self._original))
        self._shown, self._since, self.next_change = "", start, start

    def command(self, share: PerPair, opened: Collection[int] = ()) -> None:
        """(R, R) [-]: (u - u_min) / (u_max - u_min) for the windows (hold-back) or cycles that begin from now on.

        opened: links that keep their original green whatever `share` says
        """
        for link, movement in self._movements.items():
            movement.share = 1.0 if link in opened else float(share[movement.pair])

    def update(self, now: float) -> str:
        """The state to show from `now` [s] on; call at every `next_change`, and not earlier than the last call."""
        for link, movement in self._movements.items():
            if self._shown and self._shown[link] in GREEN:
                movement.green_time += now - self._since
        while now >= self._cycle_start + self._cycle:
            self._cycle_start += self._cycle
            self._ends = list(accumulate(self._durations()))
        phase = min(bisect_right(self._ends, now - self._cycle_start + 1e-6), len(self._ends) - 1)
        base, changes = self._states[phase], [self._cycle_start + self._ends[phase]]
        shown = list(base)
        for link, movement in self._movements.items():
            shown[link], change = self._filter(link, movement, base[link], phase, now)
            changes.append(change)
        self._shown, self._since, self.next_change = "".join(shown), now, min(changes)
        return self._shown

    def green_time(self) -> dict[int, float]:
        """Seconds of green that every gateway link has shown so far."""
        return {link: movement.green_time for link, movement in self._movements.items()}

    def _durations(self) -> list[float]:
        """Phase durations of the cycle that begins, with the original sum."""
        if self._mode == HOLD_BACK:
            return self._original
        shares: dict[int, float] = {}
        for link, movement in self._movements.items():
            for phase in self._phases_of(link):
                shares[phase] = max(shares.get(phase, 0.0), movement.share)
        takers = [
            phase
            for phase, state in enumerate(self._states)
            if phase not in shares and GREEN & set(state) and "y" not in state
        ]
        if not takers:  # nobody conflicts with the gateways: what they lose stays red
            return self._original
        durations = list(self._original)
        for phase, share in shares.items():
            least = min(self._min_green, durations[phase])
            durations[phase] = least + float(round(share * (durations[phase] - least)))
        freed = sum(self._original) - sum(durations)
        weights = [self._original[phase] for phase in takers]
        for phase, extra in zip(takers, _apportion(freed, weights), strict=True):
            durations[phase] += extra
        return durations

    def _phases_of(self, link: int) -> list[int]:
        """The phases that may be shortened for a gateway link: it is green in them, and nothing is yellow."""
        return [n for n, state in enumerate(self._states) if state[link] in GREEN and "y" not in state]

    def _filter(self, link: int, movement: "_Movement", base: str, phase: int, now: float) -> tuple[str, float]:
        """The character to show for one gateway link instead of `base`, and when that must be looked at again."""
        never = float("inf")
        full = self._windows[link].get(phase, 0.0)
        always = full >= self._cycle  # never red in the original: its window is the cycle
        if base in GREEN:
            if not movement.open or (always and now - movement.opened_at >= self._cycle - 1e-6):
                movement.open, movement.cut_at = True, never
                if self._shown:  # a window whose beginning was not seen is left whole
                    movement.opened_at, movement.cut_at = now, now + self._green(movement, full)
            if now < movement.cut_at:
                return base, movement.cut_at
        else:
            movement.open = False
            if base != "y":
                movement.cut_at = never
                return base, never
            if now < movement.cut_at:
                return base, never
        red_at = movement.cut_at + self._yellow[link]
        return ("y", red_at) if now < red_at else ("r", never)

    def _green(self, movement: "_Movement", full: float) -> float:
        """Seconds to keep of a window of `full` seconds."""
        share, least = movement.share, min(self._min_green, full)
        return full if share >= 1.0 else least + round(share * (full - least))


class _Movement:
    """What a gateway link carries from one update to the next."""

    def __init__(self, pair: tuple[int, int]):
        self.pair, self.green_time, self.share = pair, 0.0, 1.0
        self.open, self.opened_at, self.cut_at = False, -float("inf"), float("inf")


def _windows(programme: Programme, link: int) -> dict[int, float]:
    """Phase in which a green window of `link` begins -> its length [s]; a window may run over the cycle's end."""
    phases = programme.phases
    green = [phase.state[link] in GREEN for phase in phases]
    if all(green):
        return {0: programme.cycle}
    windows = {}
    for first in range(len(phases)):
        if green[first] and not green[first - 1]:
            length, n = 0.0, first
            while green[n % len(phases)]:
                length, n = length + phases[n % len(phases)].duration, n + 1
            windows[first] = length
    return windows


def yellow_time(phases: Sequence[Phase], link: int) -> float:
    """The longest yellow after a green of `link` [s]."""
    found = []
    for n, phase in enumerate(phases):
        if phase.state[link] == "y" and phases[n - 1].state[link] in GREEN:
            length = 0.0
            while phases[n % len(phases)].state[link] == "y":  # it ends at that green at the latest
                length, n = length + phases[n % len(phases)].duration, n + 1
            found.append(length)
    return max(found, default=YELLOW)


def _apportion(total: float, weights: list[float]) -> list[float]:
    """`total` whole seconds shared out by weight, in whole seconds (largest remainders)."""
    exact = np.array(weights) / sum(weights) * total
    shares = np.floor(exact)
    left = total - shares.sum()
    for n in np.argsort(shares - exact, kind="stable")[: int(left)]:
        shares[n] += 1.0
    shares[0] += total - shares.sum()
    return shares.tolist()


class GatewaySignals:
    """Perimeter control at fixed-time signals (a cosim.plant.actuation.SignalControl)."""

    def __init__(self, signals: list[GatewaySignal], show: Callable[[str, str], None]):
        """show(signal, state) puts a state on a signal."""
        self._signals, self._show = signals, show

    def command(self, share: PerPair, opened: Mapping[str, Collection[int]]) -> None:
        """share: (R, R) [-], [i, h] = (u_ih - u_min) / (u_max - u_min); opened: signal -> links that it spares."""
        for signal in self._signals:
            signal.command(share, opened.get(signal.signal, ()))

    def play(self, now: float) -> None:
        """Show what holds from `now` [s] on; call before every simulation step."""
        for signal in self._signals:
            if now >= signal.next_change - 1e-6:
                self._show(signal.signal, signal.update(now))

    def green_time(self) -> dict[str, dict[int, float]]:
        """Signal -> gateway link -> seconds of green shown so far."""
        return {signal.signal: signal.green_time() for signal in self._signals}
