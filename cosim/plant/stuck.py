"""Help for vehicles that SUMO would let stand forever, on lanes and on junctions.

SUMO gives a vehicle any route that its street leads to, and leaves the lane change to the vehicle.
Two leaders of neighbouring lanes that wait for each other's lane block a street forever, and soon
the city behind it. So a driver near the end of a lane gets only routes that the lane leads to, and
a leader that has stood at its end for a while drives on and is guided again from there. Under
fixed-time signals the first rule is off (`near_m` = 0): where the next street is full, no other
turn is left, and the city locks.

On a junction, vehicles give way to each other, also to standing ones. Such a ring never ends
without teleports. So vehicles that have stood on a junction for long are put on the streets behind
it, if all of them have room there. A junction that is blocked by a full street stays blocked: that
is gridlock, and it counts.
"""

from collections import defaultdict
from collections.abc import Sequence
from functools import cache

from cosim.sumo.net import City
from cosim.sumo.session import Session

QUEUE_END_M = 50.0  # before the end of a lane, where vehicles do not change lanes any more
LEADER_M = 10.0  # before the end of a lane: the first vehicle stands there
LEADER_PATIENCE_S = 60.0
JUNCTION_PATIENCE_S = 120.0  # longer than any green, and than any wait for a gap
GAP_M = 2.5  # behind and before a vehicle that is put on a street


class Lanes:
    """The lanes of one simulation. near_m: from there to its end, a lane cannot be left; 0: it
    always can."""

    def __init__(self, session: Session, near_m: float = QUEUE_END_M):
        self._session, self._near, self._lane = session, near_m, cache(session.lane)

    def too_late(self, vehicle: str, way: Sequence[str]) -> bool:
        """Return True if a vehicle on way[0] cannot take this way any more."""
        if len(way) < 2:
            return False
        left, onward = self._left(vehicle)
        return left < self._near and way[1] not in onward

    def way_out(self, vehicle: str, target: str) -> list[str]:
        """Return a way to edge `target` for a leader that stands at the end of a wrong lane, [] for
        other vehicles."""
        if self._session.standing_time(vehicle) < LEADER_PATIENCE_S:
            return []
        left, onward = self._left(vehicle)
        here, *after = self._session.route(vehicle)[self._session.route_index(vehicle) :]
        if left > LEADER_M or not after or after[0] in onward:
            return []
        ways = [
            (time, way)
            for time, way in (self._session.fastest(edge, target) for edge in sorted(onward))
            if way
        ]
        return [here, *min(ways)[1]] if ways else []

    def _left(self, vehicle: str) -> tuple[float, frozenset[str]]:
        """Return the way to the end of the vehicle's lane [m], and the edges that the lane leads
        to."""
        lane, position = self._session.place(vehicle)
        length, onward = self._lane(lane)
        return length - position, onward


class Junctions:
    """The junctions of one simulation with lanes. freed: vehicles put on a street so far."""

    def __init__(self, session: Session, city: City):
        self._session, self.freed = session, 0
        self._inside: dict[str, list[str]] = defaultdict(list)  # junction -> its internal edges
        for edge in sorted(city.region_of):
            if edge.startswith(":"):
                self._inside[edge[1:].rpartition("_")[0]].append(edge)
        self._behind = cache(self._street_behind)

    def free(self) -> None:
        """Free the vehicles of all junctions, those first that have stood longest."""
        for edges in self._inside.values():
            standing = [
                (-self._session.standing_time(vehicle), vehicle)
                for edge in edges
                if self._session.halting(edge)
                for vehicle in self._session.vehicles_on(edge)
            ]
            self._free(
                [vehicle for time, vehicle in sorted(standing) if -time >= JUNCTION_PATIENCE_S]
            )

    def _free(self, vehicles: list[str]) -> None:
        """Put the vehicles of one junction on the streets behind it, if there is room for all."""
        ahead = [(vehicle, self._behind(self._session.place(vehicle)[0])) for vehicle in vehicles]
        length = {vehicle: self._session.vehicle_length(vehicle) for vehicle in vehicles}
        if any(self._session.room(lane) < length[vehicle] + 2.0 * GAP_M for vehicle, lane in ahead):
            return
        for lane in dict.fromkeys(lane for _, lane in ahead):
            vehicle = next(vehicle for vehicle, other in ahead if other == lane)
            self.freed += self._session.set_down(vehicle, lane, length[vehicle] + GAP_M)

    def _street_behind(self, lane: str) -> str:
        """Return the lane of a street that a lane on a junction leads to."""
        while lane.startswith(":"):
            lane = self._session.next_lane(lane)
        return lane
