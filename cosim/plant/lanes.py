"""Lanes: where on a street it is too late to turn elsewhere.

SUMO gives a vehicle any way that the street leads to, and leaves it to the vehicle to get into a lane for it. Where it
cannot, because a queue stands there, it waits at the end of the wrong one until somebody lets it in. Two leaders of
neighbouring lanes who each wait for the other's block a street for ever, and soon the city behind it. So drivers near
the end of a lane are told of ways on that it leads to only; and who has stood at its end for a while, bound for
elsewhere, drives on and is guided again where he comes out.

Where the second is done, the first can be left out (`near` = 0), and under fixed-time signals it should be: who stands
before a full street could turn nowhere else, and so the city locks (README.md, Lanes).
"""

from collections.abc import Sequence

from cosim.sumo.session import Session

NEAR = 50.0  # m before the end of a lane, where its queue stands: nobody changes lanes for a new way any more
LEADER = 10.0  # m: who is there is the first
PATIENCE = 60.0  # s that the first stands there before he gives up


class Lanes:
    """Those of one simulation with lanes; the mesoscopic model has none. near: [m] before the end of one, from where on
    it is too late; 0: never."""

    def __init__(self, session: Session, near: float = NEAR):
        self._session, self._near = session, near
        self._known: dict[str, tuple[float, frozenset[str]]] = {}  # lane -> its length [m], and where it leads

    def too_late(self, vehicle: str, way: Sequence[str]) -> bool:
        """Whether a vehicle on way[0] cannot take this way any more."""
        if len(way) < 2:
            return False
        left, onward = self._left(vehicle)
        return left < self._near and way[1] not in onward

    def way_out(self, vehicle: str, target: str) -> list[str]:
        """A way to edge `target` from the end of a lane that does not lead where its leader is bound for, once he has
        stood there for PATIENCE; [] for everybody else."""
        if self._session.standing_time(vehicle) < PATIENCE:
            return []
        left, onward = self._left(vehicle)
        here, *after = self._session.route(vehicle)[self._session.route_index(vehicle) :]
        if left > LEADER or not after or after[0] in onward:
            return []
        ways = [(time, way) for time, way in (self._session.fastest(edge, target) for edge in sorted(onward)) if way]
        return [here, *min(ways)[1]] if ways else []

    def _left(self, vehicle: str) -> tuple[float, frozenset[str]]:
        """[m] to the end of the lane that a vehicle is on, and the edges that this leads to."""
        lane, position = self._session.place(vehicle)
        if lane not in self._known:
            self._known[lane] = self._session.lane(lane)
        length, onward = self._known[lane]
        return length - position, onward
