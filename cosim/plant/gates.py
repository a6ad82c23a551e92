"""Perimeter control to green: how commands limit the green of gateways.

With s the share of its gateway (cosim.plant.room), and m the minimum green, a gateway link keeps
m + s (L - m) seconds of green. At a fixed-time signal (GatewaySignal), this is the length of a
green window, and L the one that the programme gives it. At a signal that SUMO times by detectors
(ResponsiveSignal) or that max-pressure runs, it is the sum over a cycle (Ration), and L the nominal
green in a cycle, or the whole cycle.

Then come the original yellow, and red. Green is only taken away: there are no new conflicts, and
s = 1 is the original programme. The green that is taken stays red.
"""

from bisect import bisect_left
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

from cosim.sumo.arrays import PerGateway
from cosim.sumo.session import Phase, Programme, Session
from cosim.sumo.signals import GREEN, is_stage

MIN_GREEN_S = 5.0  # of a gateway link, and of every stage under max-pressure
DEFAULT_YELLOW_S = 3.0  # where the original programme has none after a green
NEVER = float("inf")
Movements = Mapping[int, int]  # index of a gateway link -> number of its gateway
Show = Callable[[str, str], None]  # (signal, state): sets the state


class Green(NamedTuple):
    """Green of a link since the start [s].

    shown: as shown; ungated: as it would be without commands
    """

    shown: float = 0.0
    ungated: float = 0.0

    def later(self, seconds: float, light: str, base: str) -> "Green":
        """Return the green after some seconds of a light instead of `base`."""
        shown, ungated = self
        if light in GREEN:
            shown += seconds
        if base in GREEN:
            ungated += seconds
        return Green(shown, ungated)


class GatewaySignal:
    """A fixed-time signal with gateway links.

    Changes take effect as in SUMO: in the simulation step that contains their time.

    next_change: time of the next change of its state [s]
    """

    def __init__(
        self, programme: Programme, movements: Movements, *, start: float, step: float, show: Show
    ):
        """start: time at which the programme was read; step: simulation step [s]"""
        self._signal = programme.signal
        self._phases = programme.phases
        self._show = show
        self._step = step
        self._cycle = programme.cycle
        self._cycle_start = start - programme.position
        self._ends = list(accumulate(phase.duration for phase in programme.phases))
        self._movements = {
            link: _Movement(gateway, programme, link) for link, gateway in movements.items()
        }
        self._shown = ""
        self._since = self.next_change = start

    def command(self, share: PerGateway) -> None:
        """Set the shares (G,) [-] of the windows or cycles that begin from now on."""
        for movement in self._movements.values():
            movement.share = float(share[movement.gateway])

    def play(self, now: float) -> None:
        """Set the state of the simulation step that begins at `now` [s]."""
        step_end = now + self._step - 1e-6
        if self.next_change >= step_end:
            return
        for movement in self._movements.values():
            movement.green = movement.green.later(now - self._since, movement.shown, movement.base)
        while self._cycle_start + self._cycle < step_end:
            self._cycle_start += self._cycle
        phase = bisect_left(self._ends, step_end - self._cycle_start)
        phase = min(phase, len(self._ends) - 1)
        shown = list(self._phases[phase].state)
        self.next_change = self._cycle_start + self._ends[phase]
        for link, movement in self._movements.items():
            base = shown[link]
            shown[link], change = self._filter(movement, base, phase, step_end)
            movement.shown = shown[link]
            movement.base = base
            self.next_change = min(self.next_change, change)
        self._shown = "".join(shown)
        self._since = now
        self._show(self._signal, self._shown)

    def green_time(self) -> dict[str, dict[int, Green]]:
        """Return signal -> gateway link -> green up to the last change."""
        return {self._signal: {link: movement.green for link, movement in self._movements.items()}}

    def _filter(
        self, movement: "_Movement", base: str, phase: int, step_end: float
    ) -> tuple[str, float]:
        """Return the light of a link instead of `base`, and its next change [s]."""
        window = movement.windows.get(phase)
        if window is not None:
            begin = self._cycle_start + window.after_cycle_start
            if begin > movement.begin + 1e-6:
                movement.begin = begin
                # The window during which control starts is left whole.
                movement.cut_at = movement.end_of(window) if self._shown else NEVER
        elif base != "y":
            movement.cut_at = NEVER
        if movement.cut_at >= step_end:
            return base, movement.cut_at
        red_at = movement.cut_at + movement.yellow
        return ("y", red_at) if red_at >= step_end else ("r", NEVER)


class _Window(NamedTuple):
    """A green window of a link.

    after_cycle_start: its begin against that of the cycle [s]; length: [s]
    """

    after_cycle_start: float
    length: float


class _Movement:
    """State of a gateway link between two changes.

    windows: phase with green -> its window; a link without red has one window, the cycle
    begin: of the present window, or the last one [s]; cut_at: end of its green [s]
    shown, base: light that is shown, and that of the programme, since the last change
    """

    def __init__(self, gateway: int, programme: Programme, link: int):
        self.gateway = gateway
        self.share = 1.0
        self.green = Green()
        self.shown = self.base = ""
        self.yellow = yellow_time(programme.phases, link)
        self.windows, self._always = _windows(programme, link)
        self.begin = -NEVER
        self.cut_at = NEVER

    def end_of(self, window: _Window) -> float:
        """Return the end of the green in the present window [s]."""
        if self.share >= 1.0:
            return NEVER
        least = min(MIN_GREEN_S, window.length)
        most = window.length
        if self._always:
            most -= self.yellow  # its yellow ends with the cycle
        kept = least + round(self.share * (window.length - least))
        return self.begin + min(kept, most)


def _windows(programme: Programme, link: int) -> tuple[dict[int, _Window], bool]:
    """Return phase with green -> its window, and True for a link without red."""
    phases = programme.phases
    green = [phase.state[link] in GREEN for phase in phases]
    if all(green):
        return dict.fromkeys(range(len(phases)), _Window(0.0, programme.cycle)), True
    windows = {}
    begin = 0.0
    for first, phase in enumerate(phases):
        if green[first] and not green[first - 1]:
            length = run_length(phases, first, link, GREEN)
            n = first
            after = begin
            while green[n]:
                windows[n] = _Window(after, length)
                n += 1
                if n == len(phases):  # it passes the end of the cycle
                    n = 0
                    after = after - programme.cycle
        begin += phase.duration
    return windows, False


def yellow_time(phases: Sequence[Phase], link: int) -> float:
    """Return the longest yellow after a green of a link [s]."""
    times = []
    for n, phase in enumerate(phases):
        if phase.state[link] == "y" and phases[n - 1].state[link] in GREEN:
            times.append(run_length(phases, n, link, "y"))
    return max(times, default=DEFAULT_YELLOW_S)


def ends_bare(phases: Sequence[Phase]) -> set[int]:
    """Return the links whose green ends without yellow, such as crossings."""
    links = set()
    for n, phase in enumerate(phases):
        before = phases[n - 1].state
        for link, light in enumerate(phase.state):
            if before[link] in GREEN and light == "r":
                links.add(link)
    return links


def least_times(phases: Sequence[Phase]) -> list[float]:
    """Return the shortest duration of each phase [s].

    It is the minimum green for a stage without pedestrians, otherwise the programmed duration.
    """
    bare = ends_bare(phases)
    walks = [any(phase.state[link] in GREEN for link in bare) for phase in phases]
    least = []
    for n, phase in enumerate(phases):
        # Pedestrians walk, or are still on their way.
        walking = walks[n] or walks[n - 1]
        if is_stage(phase.state) and not walking:
            least.append(min(phase.duration, MIN_GREEN_S))
        else:
            least.append(phase.duration)
    return least


def run_length(phases: Sequence[Phase], first: int, link: int, lights: Collection[str]) -> float:
    """Return how long a link shows one of `lights` from phase `first` on [s]."""
    length = 0.0
    n = first
    while phases[n % len(phases)].state[link] in lights:
        length += phases[n % len(phases)].duration
        n += 1
    return length


class Ration:
    """The green of one gateway link, limited per cycle.

    gateway: its number, whose share it follows
    share: of the cycles that begin from now on [-]; 1: no limit
    """

    def __init__(
        self, gateway: int, *, cycle: float, yellow: float, start: float, full: float | None = None
    ):
        """start: time at which the first cycle begins [s]

        full: green of share 1 in a cycle [s]; the cycle if None
        """
        self.gateway = gateway
        self.share = 1.0
        self._cycle = cycle
        self._yellow = yellow
        self._full = cycle if full is None else full
        self._least = min(MIN_GREEN_S, self._full)
        self._cycle_end = start
        # Green that the link may have in this cycle, and green that it has had [s].
        self._budget = NEVER
        self._spent = 0.0
        self._open = False
        self._opened_at = -NEVER
        self._base = self._light = "r"  # lights asked for and shown, since the last call
        self._since = start
        self._yellow_until = start
        self._green = Green()

    @property
    def limited(self) -> bool:
        """Return True if the green of this cycle is limited."""
        return self._budget < NEVER

    @property
    def exhausted(self) -> bool:
        """Return True if the link gets no more green in this cycle."""
        return not self._open and self._budget - self._spent < self._least - 1e-6

    def show(self, light: str, now: float, *, lasting: bool = True) -> tuple[str, float]:
        """Return the light instead of `light`, and the time of the next call [s].

        Call it also when `light` changes. lasting: a green lasts for the minimum green at least
        """
        self._green = self.green_time(now)
        if self._light in GREEN:
            self._spent += now - self._since
        self._since = now
        self._base = light
        while now >= self._cycle_end - 1e-6:
            self._cycle_end += self._cycle
            self._spent = 0.0
            self._budget = NEVER
            if self.share < 1.0:
                self._budget = self._least + self.share * (self._full - self._least)
        self._light, again = self._filter(light, now, lasting)
        return self._light, min(again, self._cycle_end)

    def green_time(self, now: float) -> Green:
        """Return the green before `now` [s]."""
        return self._green.later(now - self._since, self._light, self._base)

    def opened(self, now: float) -> bool:
        """Return True if the present green began at `now` [s]."""
        return self._open and self._opened_at >= now - 1e-6

    def _filter(self, light: str, now: float, lasting: bool) -> tuple[str, float]:
        left = self._budget - self._spent
        if light != "y" and self._yellow_until == NEVER:
            self._yellow_until = now
        if light in GREEN:
            if self._open and left <= 1e-6:
                self._open = False
                self._yellow_until = now + self._yellow
            elif not self._open and lasting:
                yellow_is_over = now >= self._yellow_until - 1e-6
                if yellow_is_over and left >= self._least - 1e-6:
                    self._open = True
                    self._opened_at = now
            if self._open:
                return light, now + left
        elif self._open:
            # A green after the yellow of the programme has to be a whole one again.
            self._open = False
            if light == "y":
                self._yellow_until = NEVER
        if now < self._yellow_until - 1e-6:
            return "y", self._yellow_until
        return "r", NEVER


class ResponsiveSignal:
    """A signal that SUMO times by detectors, with gateway links.

    Its programme runs on underneath, and what is shown follows it one step behind. SUMO's own
    programme shows itself as long as no green is taken away.
    """

    def __init__(
        self,
        session: Session,
        programme: Programme,
        movements: Movements,
        *,
        show: Show,
        release: Callable[[str, str], None],
    ):
        """release(signal, programme): see Incidents"""
        self._signal = programme.signal
        self._programme = programme.id
        self._session = session
        self._show = show
        self._release = release
        phases = programme.phases
        start = session.time
        self._rations: dict[int, Ration] = {}
        self._always: set[int] = set()  # links that are never red
        for link, gateway in movements.items():
            green = [phase for phase in phases if phase.state[link] in GREEN]
            if len(green) == len(phases):
                self._always.add(link)
            self._rations[link] = Ration(
                gateway,
                cycle=programme.cycle,
                yellow=yellow_time(phases, link),
                start=start,
                full=sum(phase.duration for phase in green),
            )
        self._least: dict[str, float] = {}  # state -> least duration [s]
        for phase, least in zip(phases, least_times(phases), strict=True):
            self._least[phase.state] = max(least, self._least.get(phase.state, MIN_GREEN_S))
        self._base = ""  # state of the programme underneath
        self._since = self._next = start
        self._held = self._limited = False

    def command(self, share: PerGateway) -> None:
        """Set the shares (G,) [-] from the next cycle on."""
        for ration in self._rations.values():
            ration.share = float(share[ration.gateway])
        self._limited = any(ration.share < 1.0 for ration in self._rations.values())
        self._next = self._since

    def play(self, now: float) -> None:
        """Set the state from `now` [s] on, or leave the signal to SUMO."""
        if self._held:
            base = self._session.state_underneath(self._signal, self._programme)
        else:
            base = self._session.signal_state(self._signal)
        if base == self._base and now < self._next - 1e-6:
            return
        before = self._base
        self._base = base
        if base != before:
            self._since = now
        shown = list(base)
        self._next = NEVER
        for link, ration in self._rations.items():
            own = base[link]
            if not before and own == "y":
                own = "G"  # the first yellow counts as one after a green
            # A window that begins lasts for SUMO's own minimum.
            begun = not before or before[link] not in GREEN
            light, again = ration.show(own, now, lasting=begun or link in self._always)
            self._next = min(self._next, again)
            if light == "y" or base[link] in "Ggy":
                shown[link] = light
        if not before:
            self._next = now
        elif self._held or self._limited:
            self._hold("".join(shown), now)

    def green_time(self) -> dict[str, dict[int, Green]]:
        """Return signal -> gateway link -> green so far."""
        now = self._session.time
        return {
            self._signal: {link: ration.green_time(now) for link, ration in self._rations.items()}
        }

    def _hold(self, state: str, now: float) -> None:
        """Override SUMO from the first limited green on.

        Hand the signal back during a stage once no link is limited. A stage that has just begun
        could end too early, as what is shown is one step behind SUMO.
        """
        again = NEVER
        limited = self._limited or any(ration.limited for ration in self._rations.values())
        if not limited and state == self._base and is_stage(state):
            again = self._since + self._least.get(state, MIN_GREEN_S)
        self._held = now < again - 1e-6
        if self._held:
            self._show(self._signal, state)
            self._next = min(self._next, again)
        else:
            self._release(self._signal, self._programme)
