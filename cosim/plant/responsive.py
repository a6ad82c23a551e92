"""Perimeter control at signals that SUMO times by its detectors: actuated and delay-based ones.

They have no windows whose length is known before. A gateway movement i -> h may be green for

    m + (u_ih - u_min) / (u_max - u_min) (L - m)        of every C seconds,

m the minimum green, C the cycle and L its green in it by the programme's nominal durations (cosim.plant.green_quota).
Once that is spent its link turns yellow and red until the next window that begins after these C seconds. All else is
shown as SUMO decides it: its programme runs on underneath, with its detectors, and what is shown follows it one step
behind. As long as nothing is taken away, SUMO's own programme shows itself, to the byte.
"""

from collections.abc import Collection, Mapping, Sequence

from cosim.plant.green_quota import NEVER, Ration
from cosim.plant.incidents import Incidents
from cosim.plant.perimeter import yellow_time
from cosim.sumo.session import Programme, Session
from cosim.sumo.signals import GREEN, is_stage
from nmfd.arrays import PerPair


class ResponsiveSignal:
    """One signal with gateway links; `play` before every simulation step."""

    def __init__(
        self,
        session: Session,
        incidents: Incidents,
        programme: Programme,
        movements: Mapping[int, tuple[int, int]],
        *,
        min_green: float,
    ):
        """movements: link index -> (i, h); min_green: [s]"""
        self.signal, self._programme = programme.signal, programme.id
        self._session, self._incidents, self._min_green = session, incidents, min_green
        phases, start = programme.phases, session.time
        self._rations = {
            link: Ration(
                pair,
                cycle=programme.cycle,
                full=sum(p.duration for p in phases if p.state[link] in GREEN),
                min_green=min_green,
                yellow=yellow_time(phases, link),
                start=start,
            )
            for link, pair in movements.items()
        }
        self._always = {link for link in movements if all(phase.state[link] in GREEN for phase in phases)}
        self._base, self._since, self._next, self._held, self._limited = "", start, start, False, False

    def command(self, share: PerPair, opened: Collection[int]) -> None:
        """(R, R) [-], as GatewaySignal.command in cosim.plant.perimeter."""
        self._limited = False
        for link, ration in self._rations.items():
            own = 1.0 if link in opened else float(share[ration.pair])
            ration.command(own)
            self._limited |= own < 1.0
        self._next = self._since

    def play(self, now: float) -> None:
        """Show what holds from `now` [s] on, or leave the signal to SUMO."""
        if self._held:
            base = self._session.state_underneath(self.signal, self._programme)
        else:
            base = self._session.signal_state(self.signal)
        if base == self._base and now < self._next - 1e-6:
            return
        before, self._base = self._base, base
        if base != before:
            self._since = now
        shown = list(base)
        self._next = NEVER
        for link, ration in self._rations.items():
            begun = not before or before[link] not in GREEN  # a window that begins lasts for SUMO's own minimum
            light, again = ration.show(
                # of a yellow that is there in the beginning, as of that after a green
                "G" if not before and base[link] == "y" else base[link],
                now,
                lasting=begun or link in self._always,
            )
            self._next = min(self._next, again)
            if light == "y" or base[link] in "Ggy":
                shown[link] = light
        if not before:
            self._next = now
        elif self._held or self._limited:
            self._hold("".join(shown), now)

    def green_time(self, now: float) -> dict[int, float]:
        """Seconds of green that every gateway link has shown before `now` [s]."""
        return {link: ration.green_time(now) for link, ration in self._rations.items()}

    def _hold(self, state: str, now: float) -> None:
        """Show `state`, from the first command that takes green away on: SUMO's own is shown before it is seen here.

        The signal is given back when nothing is to be taken away any more, in the midst of a stage: one that began a
        moment ago could end, one step behind SUMO, before its minimum.
        """
        limited = self._limited or any(ration.limited for ration in self._rations.values())
        if limited or state != self._base or not is_stage(state):
            again = NEVER
        else:
            again = self._since + self._min_green
        if now >= again - 1e-6:
            self._held, again = False, NEVER
            self._incidents.release(self.signal, self._programme)
        else:
            self._held = True
            self._incidents.show(self.signal, state)
        self._next = min(self._next, again)


class ResponsiveSignals:
    """All of them (a cosim.plant.actuation.SignalControl)."""

    def __init__(self, session: Session, signals: Sequence[ResponsiveSignal]):
        self._session, self._signals = session, signals

    def command(self, share: PerPair, opened: Mapping[str, Collection[int]]) -> None:
        """share: (R, R) [-], [i, h] = (u_ih - u_min) / (u_max - u_min); opened: signal -> links that it spares."""
        for signal in self._signals:
            signal.command(share, opened.get(signal.signal, ()))

    def play(self, now: float) -> None:
        """Show what holds from `now` [s] on; call before every simulation step."""
        for signal in self._signals:
            signal.play(now)

    def green_time(self) -> dict[str, dict[int, float]]:
        """Signal -> gateway link -> seconds of green shown so far."""
        return {signal.signal: signal.green_time(self._session.time) for signal in self._signals}
