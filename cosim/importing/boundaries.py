"""Local search for the boundary at which gates hold most vehicles.

Gates hold a vehicle that first enters the densest region past a signal with room before it. A
vehicle that first enters elsewhere leaks in, and one that starts inside is out of reach. The search
moves clusters of streets into the densest region and out of it while held less leaking vehicles
rise. Regions stay connected, large enough and of even density.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from cosim.importing.streets import LinkMask, Streets
from cosim.sumo.arrays import EdgeMask, EdgeNumbers, PerEdge

ROOM_M = 75.0  # of lanes before a gate, for ten vehicles; with less it holds nobody
Routes = Mapping[tuple[int, ...], int]  # edges -> number of vehicles
Labels = Int[np.ndarray, " U"]


class Limits(NamedTuple):
    """Limits of regions.

    smallest: [m of lanes]
    even: share of the variance of density that lies between regions, at least [-]
    """

    smallest: float
    even: float


class Entered(NamedTuple):
    """Vehicles from elsewhere, by where they first enter a region.

    held: past gates with room
    """

    held: int
    leaked: int


def with_room(streets: Streets, uncontrollable: Collection[str]) -> LinkMask:
    """Return the links (L,) at which a gate can hold vehicles.

    They have a signal, and ROOM_M on the edge before it and those that lead there past no signal.
    uncontrollable: signals that perimeter control cannot use
    """
    before, behind = streets.links.T
    free = ~streets.signalled
    room = streets.lane_metres.copy()
    np.add.at(room, behind[free], streets.lane_metres[before[free]])
    return streets.controllable(uncontrollable) & (room[before] >= ROOM_M)


class Turns:
    """Turns of all vehicles from edge to edge, in the order of their routes."""

    def __init__(self, streets: Streets, routes: Routes, held: LinkMask):
        """held: links at which a gate can hold vehicles"""
        used = [route for route in routes if len(route) > 1]
        lengths = [len(route) for route in used]
        edges = np.concatenate([np.array(route) for route in used] or [np.zeros(0, dtype=int)])
        last = np.cumsum(lengths, dtype=int) - 1
        inner = np.ones(len(edges), dtype=bool)
        inner[last] = False
        self._vehicles = np.array([routes[route] for route in used], dtype=int)
        self._route = np.arange(len(used)).repeat(np.array(lengths, dtype=int) - 1)
        self._source = edges[inner]
        self._target = np.roll(edges, -1)[inner]
        starts = np.array([route[0] for route in used], dtype=int)
        self._start = starts[self._route]
        gates = set(map(tuple, streets.links[held].tolist()))
        turns = zip(self._source.tolist(), self._target.tolist(), strict=True)
        self._held = np.array([turn in gates for turn in turns], dtype=bool)

    def entered(self, inside: EdgeMask) -> Entered:
        """Return how vehicles from elsewhere enter the edges `inside`."""
        enters = np.flatnonzero(~inside[self._source] & inside[self._target] & ~inside[self._start])
        first = enters[np.diff(self._route[enters], prepend=-1) > 0]
        vehicles = self._vehicles[self._route[first]]
        held = int(vehicles[self._held[first]].sum())
        return Entered(held=held, leaked=int(vehicles.sum()) - held)


@dataclass(frozen=True, kw_only=True)
class Clusters:
    """U clusters of streets, which change regions as a whole.

    of: (E,) cluster of an edge, -1 outside the main part
    metres: (U,) of lanes; vehicles: (U,) at the peak [veh]
    variance: of the density of edges [(veh/m)^2]
    neighbours: (U, U) number of connections between two of them
    """

    of: EdgeNumbers
    metres: Float[np.ndarray, " U"]
    vehicles: Float[np.ndarray, " U"]
    variance: float
    neighbours: csr_array

    @classmethod
    def made(cls, streets: Streets, of: EdgeNumbers, density: PerEdge) -> "Clusters":
        """Return the clusters of a network. density: (E,) [veh/m of lane]"""
        inside = of >= 0
        count = int(of.max()) + 1
        lanes = streets.lane_metres[inside]
        mean = np.average(density[inside], weights=lanes)
        return cls(
            of=of,
            metres=np.bincount(of[inside], lanes, count),
            vehicles=np.bincount(of[inside], lanes * density[inside], count),
            variance=float(np.average((density[inside] - mean) ** 2, weights=lanes)),
            neighbours=streets.joins(of),
        )

    def on_edges(self, labels: Labels) -> EdgeNumbers:
        """Return the region (E,) of every edge, -1 outside the main part."""
        return np.where(self.of >= 0, labels[self.of], -1)

    def densities(self, labels: Labels) -> Float[np.ndarray, " R"]:
        """Return the density (R,) of regions [veh/m of lane]."""
        metres = np.bincount(labels, self.metres)
        return np.bincount(labels, self.vehicles) / np.maximum(metres, 1.0)

    def between(self, labels: Labels) -> float:
        """Return the share of the variance of density between regions."""
        density = self.densities(labels)
        metres = np.bincount(labels, self.metres)
        mean = np.average(density, weights=metres)
        explained = np.average((density - mean) ** 2, weights=metres)
        return float(explained / max(self.variance, 1e-12))

    def improved(self, labels: Labels, turns: Turns, limits: Limits) -> Labels:
        """Return regions (U,) of which gates hold more; see the module."""
        densest = int(np.argmax(self.densities(labels)))
        best = self._value(labels, turns, densest)
        rising = True
        while rising:
            rising = False
            for cluster in range(len(labels)):
                moved = self._moved(labels, cluster, densest)
                if moved is None or not self._allowed(moved, labels[cluster], densest, limits):
                    continue
                value = self._value(moved, turns, densest)
                if value > best:
                    labels = moved
                    best = value
                    rising = True
        return labels

    def _value(self, labels: Labels, turns: Turns, densest: int) -> int:
        """Return the vehicles that gates hold, less those that leak in."""
        entered = turns.entered(self.on_edges(labels) == densest)
        return entered.held - entered.leaked

    def _moved(self, labels: Labels, cluster: int, densest: int) -> Labels | None:
        """Return the regions after a cluster moved, None if it cannot.

        It moves into the densest region, or from there to the neighbour with most connections.
        """
        first, last = self.neighbours.indptr[cluster : cluster + 2]
        around = np.bincount(
            labels[self.neighbours.indices[first:last]],
            self.neighbours.data[first:last],
            minlength=int(labels.max()) + 1,
        )
        target = densest
        if labels[cluster] == densest:
            around[densest] = 0.0
            target = int(np.argmax(around))
        if not around[target]:
            return None
        moved = labels.copy()
        moved[cluster] = target
        return moved

    def _allowed(self, labels: Labels, source: int, densest: int, limits: Limits) -> bool:
        """Return True if the regions keep the limits after a move from `source`."""
        if np.bincount(labels, self.metres).min() < limits.smallest:
            return False
        if np.argmax(self.densities(labels)) != densest or self.between(labels) < limits.even:
            return False
        members = np.flatnonzero(labels == source)
        part = self.neighbours[members][:, members]
        return connected_components(part, directed=False, return_labels=False) == 1
