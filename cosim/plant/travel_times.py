"""Travel times along streets and over junctions, from what was seen of late.

Few vehicles are on one street at a time, and a mean over those of a single control interval tells drivers of reds and
gaps that are gone when they come. So what was seen in the last minutes counts together, the newest most: on a street
the mean speed, over a junction by Little's law the vehicles that are on it by those that get over it in a second. Who
turns across the others' way waits in the middle of a junction, half a minute where it is busy, and no street sees that.

The mesoscopic model has no junctions to wait on, and there the newest interval counts half, however few it saw: with
the other rule guidance lost in two cities of three (README.md, Travel times).
"""

import math

import numpy as np

from cosim.plant.sampling import StreetMeans
from cosim.sumo.arrays import MoveEnds, PerEdge, PerInside, PerMove
from cosim.sumo.net import City

SMOOTHING = 0.5  # weight of the newest control interval in the mesoscopic model
WINDOW = 300.0  # s in which what was seen comes to count a third
EMPTY = 0.5  # of what was seen counts yet where there was nobody for a control interval
UNSEEN = 3.0  # veh s at the speed limit that count besides
SLOWEST = 0.1  # m/s; slower is as good as standing


class TravelTimes:
    """Of one run.

    first, second: (M,), the numbers of the edges that each move leads from and to
    free: (E,) [s], in free flow; free_turns: (M,) [s]
    edges: (E,) [s], of the edges; turns: (M,) [s], of the moves between them
    """

    first: MoveEnds
    second: MoveEnds
    free: PerEdge
    free_turns: PerMove
    edges: PerEdge
    turns: PerMove

    def __init__(self, city: City, *, lanes: bool = True):
        """lanes: not in the mesoscopic model"""
        self._lanes = lanes
        number = {edge: n for n, edge in enumerate(city.edges)}
        moves = [(e, f) for e, after in city.successors.items() for f in after]
        self.first, self.second = np.array([(number[e], number[f]) for e, f in moves]).T
        self._length = np.array([city.length[edge] for edge in city.edges])
        self._limit = np.array([city.speed[edge] for edge in city.edges])
        self.free, self.free_turns = self._length / self._limit, np.array([city.turn_time[move] for move in moves])
        self.edges, self.turns = self.free.copy(), self.free_turns.copy()
        inside = {edge: n for n, edge in enumerate(city.inside)}
        self._longest = np.array(list(city.inside.values())) / SLOWEST
        # Which internal edges (`_via`) each move leads over, which several do.
        over = [(n, inside[edge]) for n, move in enumerate(moves) for edge in city.over.get(move, ()) if edge in inside]
        self._move, self._via = np.array(over, dtype=int).reshape(-1, 2).T
        # What was seen: time [veh s] and distance [veh m] on edges, time and ways over [veh] on internal ones.
        self._spent, self._driven = np.zeros((2, len(number)))
        self._crossing, self._crossed = np.zeros((2, len(inside)))

    def learn(self, seen: StreetMeans) -> None:
        """A control interval has ended in which this was seen."""
        if not self._lanes:
            now = np.where(np.isnan(seen.speed), self.free, self._length / np.maximum(seen.speed, SLOWEST))
            self.edges = self.edges + SMOOTHING * (np.maximum(now, self.free) - self.edges)
            return
        kept, spent = math.exp(-seen.duration / WINDOW), seen.vehicles * seen.duration
        somebody = spent > 0.0
        kept_here = np.where(somebody, kept, min(kept, EMPTY))
        self._spent = kept_here * self._spent + spent
        self._driven = kept_here * self._driven + spent * np.where(somebody, seen.speed, 0.0)
        speed = (self._driven + UNSEEN * self._limit) / (self._spent + UNSEEN)
        speed[seen.speed == 0.0] = 0.0  # closed, or nobody has moved
        self.edges = np.maximum(self._length / np.maximum(speed, SLOWEST), self.free)
        self._crossing = kept * self._crossing + seen.crossing * seen.duration
        self._crossed = kept * self._crossed + seen.crossed * seen.duration
        self.turns = np.maximum(np.bincount(self._move, self._over()[self._via], len(self.turns)), self.free_turns)

    def _over(self) -> PerInside:
        """[s] over each internal edge; 0 where nobody was."""
        standing = np.where(self._crossing > 0.0, self._longest, 0.0)
        takes = np.divide(self._crossing, self._crossed, out=standing.copy(), where=self._crossed > 0.0)
        return np.minimum(takes, self._longest)
