"""The flows that a signal plan is made for: the scenario's demand on static routes, in its busiest hour."""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from cosim.regions import City
from cosim.trips import make_trips

# Of the trips that plans are made for. Not a seed of an evaluation: a plan knows the demand, not the day's drivers.
PLANNING_SEED = 778_001
PEAK = 3600.0  # s


def turning_flows(city: City, demand: np.ndarray, step: float) -> Mapping[tuple[str, str], float]:
    """(edge, next edge) -> flow [veh/s] of the trips that depart in the busiest hour of `demand` (T, R, R) [veh/s], or
    in all of it where that is shorter; on static routes, without delays. Movements that nobody uses are missing."""
    trips = make_trips(city, demand, step, PLANNING_SEED)
    window = min(PEAK, step * len(demand))
    ends = np.searchsorted(trips.depart, trips.depart + window)
    first = int(np.argmax(ends - np.arange(len(ends)))) if len(ends) else 0
    turns: Counter[tuple[str, str]] = Counter()
    for route in trips.routes[first : ends[first] if len(ends) else 0]:
        turns.update(zip(route, route[1:], strict=False))
    return {turn: count / window for turn, count in turns.items()}
