"""Junctions: vehicles that wait for each other on one while the streets behind it are free.

On the area of a junction SUMO's vehicles give way to whoever crosses their path, also to one who stands there and gives
way to them. Such a ring of a few vehicles never ends (without teleporting), and blocks all streets that lead there. A
junction that is blocked because a street behind it is full is another matter: that is how cities lock, and it stays.
So only where all who have stood on a junction for STOOD have room on the street that they are about to enter, they are
set down there, those who have stood longest first.
"""

from collections import defaultdict

from cosim.sumo.net import City
from cosim.sumo.session import Session

STOOD = 120.0  # s: longer than any green, and than anybody waits on a junction for a gap
GAP = 2.5  # m behind a vehicle that is set down, and before it


class Junctions:
    """Those of one simulation with lanes; freed: how many vehicles were set down."""

    def __init__(self, session: Session, city: City):
        self._session, self.freed = session, 0
        self._inside: dict[str, list[str]] = defaultdict(list)  # junction -> the edges on it
        for edge in sorted(city.region_of):
            if edge.startswith(":"):
                self._inside[edge[1:].rpartition("_")[0]].append(edge)
        self._onward: dict[str, str] = {}  # lane on a junction -> the lane behind it

    def free(self) -> None:
        """Look at all junctions."""
        for edges in self._inside.values():
            standing = [
                (self._session.standing_time(vehicle), vehicle)
                for edge in edges
                if self._session.halting(edge)
                for vehicle in self._session.vehicles_on(edge)
            ]
            if waiting := sorted((-time, vehicle) for time, vehicle in standing if time >= STOOD):
                self._free([vehicle for _, vehicle in waiting])

    def _free(self, vehicles: list[str]) -> None:
        """Set those who stand on one junction down behind it, if there is room for all of them."""
        ahead = [(vehicle, self._behind(self._session.place(vehicle)[0])) for vehicle in vehicles]
        long = {vehicle: self._session.vehicle_length(vehicle) for vehicle in vehicles}
        if any(self._session.room(lane) < long[vehicle] + 2.0 * GAP for vehicle, lane in ahead):
            return
        for lane in dict.fromkeys(lane for _, lane in ahead):
            vehicle = next(vehicle for vehicle, other in ahead if other == lane)
            self.freed += self._session.set_down(vehicle, lane, long[vehicle] + GAP)

    def _behind(self, lane: str) -> str:
        """The lane of a street that a lane on a junction leads to."""
        if lane not in self._onward:
            onward = lane
            while onward.startswith(":"):
                onward = self._session.next_lane(onward)
            self._onward[lane] = onward
        return self._onward[lane]
