"""The flows that a signal plan is made for: the demand on static routes, in its busiest quarter of an hour."""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from cosim.sumo.net import City
from cosim.sumo.recorded_trips import RecordedTrips, edges_of
from cosim.sumo.trips import DRIVER_CLASSES, Ways, make_trips
from nmfd.arrays import PairsOverTime

# Of the trips that plans are made for. No seeds of an evaluation: a plan knows the demand, not the day's drivers.
PLANNING_SEEDS = (778_001, 778_002, 778_003, 778_004)
PEAK = 900.0  # s; the Highway Capacity Manual designs for the busiest quarter of the peak hour


def turning_flows(city: City, demand: PairsOverTime, step: float) -> Mapping[tuple[str, str], float]:
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
            turns.update(pairwise(route))
    return {turn: count / (window * len(PLANNING_SEEDS)) for turn, count in turns.items()}


def own_flows(
    city: City, originals: RecordedTrips, routes: Mapping[str, Sequence[str]], factor: float
) -> Mapping[tuple[str, str], float]:
    """The same of a city's own vehicles, `factor` times as many: of those that have a route on it; the others, which
    have a beginning and an end only, are thought to take a fastest way. routes: those that vehicles name."""
    ends = np.searchsorted(originals.depart, originals.depart + PEAK)
    if not len(ends):
        return {}
    first = int(np.argmax(ends - np.arange(len(ends))))
    busiest = [edges_of(element, routes) for element in originals.elements[first : ends[first]]]
    known = set(city.edges)
    turns: Counter[tuple[str, str]] = Counter()
    for edges, driven in busiest:
        if driven:
            turns.update(pair for pair in pairwise(edges) if known.issuperset(pair))
    legs = [
        leg
        for edges, driven in busiest
        if not driven
        for leg in pairwise(edges)
        if leg[0] != leg[1] and known.issuperset(leg)
    ]
    if legs:
        number = {edge: n for n, edge in enumerate(city.edges)}
        random = np.random.default_rng(PLANNING_SEEDS[0])
        begin, end = np.array([[number[edge] for edge in leg] for leg in legs]).T
        for route in Ways(city, random).routes(begin, end, random.integers(DRIVER_CLASSES, size=len(legs))):
            turns.update(pairwise(route))
    return {turn: factor * count / PEAK for turn, count in turns.items()}
