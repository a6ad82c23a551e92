"""Help for vehicles that SUMO would let stand forever.

SUMO gives a vehicle any route that its street leads to, and leaves the lane change to the vehicle.
Two leaders of neighbouring lanes that wait for each other's lane block a street forever, and soon
the city behind it. So a driver near the end of a lane gets only routes that the lane leads to, and
a leader that has stood at its end for a while drives on and is guided again from there. Under
fixed-time signals the first rule is off (`near_m` = 0): where the next street is full, no other
turn is left, and the city locks.

On a junction, vehicles give way to each other, also to standing ones. Such a ring never ends
without teleports. So vehicles that have stood on a junction for long are put on the streets behind
it, if all of them have room there. On a street shorter than a vehicle it is put at the end, if
nobody else is there; if somebody is, it waits, and does not keep the others. Who stands on such a
street stands on the junction, too. A junction that is blocked by a full street stays blocked: that
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
SHORT_STREET_M = 5.0  # a car that stands on a shorter one blocks the junctions at both ends


class Lanes:
    """The lanes of one simulation.

    near_m: distance to its end within which a lane cannot be left [m]; 0: it always can
    """

    def __init__(self, session: Session, near_m: float = QUEUE_END_M):
        self._session = session
        self._near = near_m
        self._lane = cache(session.lane)

    def too_late(self, vehicle: str, way: Sequence[str]) -> bool:
        """Return True if a vehicle on way[0] cannot take this way any more."""
        if len(way) < 2:
            return False
        left, onward = self._left(vehicle)
        return left < self._near and way[1] not in onward

    def way_out(self, vehicle: str, target: str) -> list[str]:
        """Return a way to edge `target` for a leader at the end of a wrong lane.

        It is [] for other vehicles.
        """
        if self._session.standing_time(vehicle) < LEADER_PATIENCE_S:
            return []
        left, onward = self._left(vehicle)
        here, *after = self._session.route(vehicle)[self._session.route_index(vehicle) :]
        if left > LEADER_M or not after or after[0] in onward:
            return []
        ways = []
        for edge in sorted(onward):
            time, way = self._session.fastest(edge, target)
            if way:
                ways.append((time, way))
        if not ways:
            return []
        _, fastest = min(ways)
        return [here, *fastest]

    def _left(self, vehicle: str) -> tuple[float, frozenset[str]]:
        """Return the way to the end of a vehicle's lane [m], and edges behind."""
        lane, position = self._session.place(vehicle)
        length, onward = self._lane(lane)
        return length - position, onward


class Junctions:
    """The junctions of one simulation with lanes.

    freed: vehicles put on a street so far
    """

    def __init__(self, session: Session, city: City):
        self._session = session
        self.freed = 0
        self._inside: dict[str, list[str]] = defaultdict(list)  # junction -> its internal edges
        for edge in sorted(city.region_of):
            if edge.startswith(":"):
                self._inside[_junction(edge)].append(edge)
        for (edge, _), way in sorted(city.over.items()):
            junction = _junction(way[0])
            if city.length[edge] < SHORT_STREET_M and edge not in self._inside[junction]:
                self._inside[junction].append(edge)

    def free(self) -> None:
        """Free the vehicles of all junctions, those first that have stood longest."""
        for edges in self._inside.values():
            standing = []
            for edge in edges:
                if not self._session.halting(edge):
                    continue
                for vehicle in self._session.vehicles_on(edge):
                    time = self._session.standing_time(vehicle)
                    if time >= JUNCTION_PATIENCE_S:
                        standing.append((-time, vehicle))
            self._free([vehicle for _, vehicle in sorted(standing)])

    def _free(self, vehicles: list[str]) -> None:
        """Put the vehicles of one junction on the streets behind it.

        Nothing happens unless there is room for all, but for those behind a short street.
        """
        lanes: dict[str, str] = {}  # lane behind the junction -> first vehicle that goes there
        for vehicle in vehicles:
            lane = self._lane_behind(vehicle)
            if lane is None:
                return
            length = self._length(lane)
            needed = self._session.vehicle_length(vehicle) + 2.0 * GAP_M
            if self._session.room(lane) >= min(needed, length):
                lanes.setdefault(lane, vehicle)
            elif length >= SHORT_STREET_M:
                return  # who waits for a short street may follow the vehicle that leaves it
        for lane, vehicle in lanes.items():
            position = self._session.vehicle_length(vehicle) + GAP_M
            position = min(position, self._length(lane))
            self.freed += self._session.set_down(vehicle, lane, position)

    def _length(self, lane: str) -> float:
        """Return the length of a lane (m)."""
        return self._session.lane(lane)[0]

    def _lane_behind(self, vehicle: str) -> str | None:
        """Return the lane of the next street; None if its own leads elsewhere."""
        session = self._session
        lane, _ = session.place(vehicle)
        ways = session.next_lanes(lane)
        while ways and ways[0].startswith(":"):
            ways = session.next_lanes(ways[0])
        street = session.route_index(vehicle) + 1
        following = session.route(vehicle)[street : street + 1]
        for onward in ways:
            if onward.rpartition("_")[0] in following:
                return onward
        return None


def _junction(edge: str) -> str:
    """Return the junction of an internal edge, such as "x" of ":x_3"."""
    return edge[1:].rpartition("_")[0]
