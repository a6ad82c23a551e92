"""Waits of drivers at red signals, for the proof sheet of a run.

A driver waits from the time when the vehicle stands first on its lane and its light is red, until
the light ends. Samples find these drivers, and changes of signals end their waits.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

from cosim.sumo.session import Session
from cosim.sumo.signals import CLOSED, Link, lane_id


class Waits:
    """Waits of one run.

    Call `sample` every few seconds and `changed` at every change of a signal.
    """

    def __init__(
        self,
        session: Session,
        links: Mapping[str, Iterable[Link]],
        states: Mapping[str, Sequence[tuple[float, str]]],
    ):
        """links: signal -> its links

        states: signal -> time [s] and state at every change
        """
        self._session = session
        self._states = states
        # Edge -> lane -> next edge -> signal and link.
        self._lanes: dict[str, dict[str, dict[str, tuple[str, int]]]] = {}
        for signal, own in links.items():
            for link in own:
                lanes = self._lanes.setdefault(link.from_edge, {})
                lanes.setdefault(lane_id(link), {})[link.to_edge] = signal, link.index
        # Signal -> link -> time since which a driver waits [s].
        self._waiting: dict[str, dict[int, float]] = defaultdict(dict)
        self._longest: dict[str, float] = {}

    def changed(self, signal: str, state: str, now: float) -> None:
        """End the waits of drivers whose light ends to be red at `now` [s]."""
        waiting = self._waiting.get(signal)
        if not waiting:
            return
        for link, begin in list(waiting.items()):
            if state[link] not in CLOSED:
                del waiting[link]
                self._end(signal, now - begin)

    def sample(self) -> None:
        """Look for the drivers who wait now."""
        session = self._session
        self._waiting.clear()
        for edge, lanes in self._lanes.items():
            if not session.halting(edge):
                continue
            for lane, targets in lanes.items():
                vehicle = session.first_on(lane)
                if vehicle is None:
                    continue
                standing = session.standing_time(vehicle)
                if standing == 0.0:
                    continue
                ahead = targets.get(self._next_edge(vehicle))
                if ahead is None:  # the vehicle is on the wrong lane
                    continue
                signal, link = ahead
                red_since = self._red_since(signal, link)
                if red_since is not None:
                    self._waiting[signal][link] = max(session.time - standing, red_since)

    def longest(self) -> dict[str, float]:
        """Return signal -> longest wait so far [s]; no entry where nobody waited."""
        for signal, waiting in self._waiting.items():
            for begin in waiting.values():
                self._end(signal, self._session.time - begin)
        return self._longest

    def _red_since(self, signal: str, link: int) -> float | None:
        """Return the time at which a light became red [s], None if it is not."""
        since = None
        for time, state in reversed(self._states[signal]):
            if state[link] not in CLOSED:
                break
            since = time
        return since

    def _end(self, signal: str, seconds: float) -> None:
        self._longest[signal] = max(seconds, self._longest.get(signal, 0.0))

    def _next_edge(self, vehicle: str) -> str:
        """Return the next edge of a vehicle's route, "" at its end."""
        route = self._session.route(vehicle)
        place = self._session.route_index(vehicle)
        return route[place + 1] if place + 1 < len(route) else ""
