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
        ways = beyond_first + city.free_time[begin][:, None]
        used = ways[np.isfinite(ways)]
        if used.size:
            times[region] = np.median(used)
    return times


def _street_times(city: City) -> csr_array:
    """Return the free-flow time from the end of edge a to that of edge b.

    Its unit is s, its shape (E, E); only successors have an entry.
    """
    first, second = city.move_edges.T
    times = city.move_time + city.free_time[second]
    size = len(city.edges)
    return csr_array((times, (first, second)), shape=(size, size))
