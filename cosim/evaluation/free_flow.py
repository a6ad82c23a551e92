"""Time that vehicles need to cross each region of a city in free flow."""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cosim.sumo.net import City
from nmfd.arrays import PerRegion

QUANTILE = 0.25  # of the ways through a region


def crossing_times(city: City) -> PerRegion:
    """Return the free-flow time through each region (s, (R,)).

    It is the lower quartile of the shortest ways from every gateway into the region to every
    gateway out of it, on streets of the region; 0 if there is no such way.
    """
    times = np.zeros(city.regions)
    # From the end of a street to that of the next one (s, (E, E)).
    first, second = city.move_edges.T
    shape = (len(city.edges),) * 2
    streets = csr_array((city.move_time + city.free_time[second], (first, second)), shape=shape)
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
            times[region] = np.quantile(used, QUANTILE)
    return times
