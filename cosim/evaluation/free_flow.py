"""Time that vehicles need to cross each region of a city in free flow."""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cosim.sumo.net import City
from nmfd.arrays import PerRegion


def crossing_times(city: City) -> PerRegion:
    """Return the free-flow time through each region (s, (R,)).

    It is the median of the shortest ways from every gateway into the region to every gateway out
    of it, on streets of the region; 0 if there is no such way.
    """
    times = np.zeros(city.regions)
    streets = _street_times(city)
    for region in range(city.regions):
        entries = [gateway for gateway in city.gateways if gateway.target == region]
        exits = [gateway for gateway in city.gateways if gateway.source == region]
        begin = sorted({city.number[gateway.to_edge] for gateway in entries})
        end = sorted({city.number[gateway.from_edge] for gateway in exits})
        if not begin or not end:
            continue
        inside = city.edge_region == region
        within = streets * inside[:, None] * inside[None, :]
        beyond_first = dijkstra(csr_array(within), indices=begin)[:, end]
        ways = beyond_first + _edge_times(city)[begin][:, None]
        used = ways[np.isfinite(ways)]
        if used.size:
            times[region] = np.median(used)
    return times


def _edge_times(city: City) -> np.ndarray:
    """Return the free-flow time on each edge (s, (E,))."""
    return np.array([city.length[edge] / city.speed[edge] for edge in city.edges])


def _street_times(city: City) -> csr_array:
    """Return the free-flow time from the end of edge a to that of edge b.

    Its unit is s, its shape (E, E); only successors have an entry.
    """
    edge_times = _edge_times(city)
    rows = []
    columns = []
    values = []
    for edge, after in city.successors.items():
        for other in after:
            here = city.number[other]
            rows.append(city.number[edge])
            columns.append(here)
            values.append(city.turn_time.get((edge, other), 0.0) + edge_times[here])
    size = len(city.edges)
    return csr_array((values, (rows, columns)), shape=(size, size))
