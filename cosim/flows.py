"""The flows that a signal plan is made for: the demand on static routes, in its busiest quarter of an hour."""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from cosim.regions import City
from cosim.trips import make_trips

# Of the trips that plans are made for. No seeds of an evaluation: a plan knows the demand, not the day's drivers.
PLANNING_SEEDS = (778_001, 778_002, 778_003, 778_004)
PEAK = 900.0  # s; the Highway Capacity Manual designs for the busiest quarter of the peak hour


def turning_flows(city: City, demand: np.ndarray, step: float) -> Mapping[tuple[str, str], float]:
    """(edge, next edge) -> flow [veh/s] of the trips that depart in the busiest quarter of an hour of `demand`
    (T, R, R) [veh/s], or in all of it where that is shorter; on static routes, without delays, the mean of several
    planning seeds. Movements that nobody uses are missing."""
    window = min(PEAK, step * len(demand))
    turns: Counter[tuple[str, str]] = Counter()
    for seed in PLANNING_SEEDS:
        trips = make_trips(city, demand, step, seed)
        if not len(trips.depart):
            continue
        ends = np.searchsorted(trips.depart, trips.depart + window)
        first = int(np.argmax(ends - np.arange(len(ends))))
        for route in trips.routes[first : ends[first]]:
            turns.update(zip(route, route[1:], strict=False))
    return {turn: count / (window * len(PLANNING_SEEDS)) for turn, count in turns.items()}
