"""Phases and detectors of actuated signals for the link model.

SUMO puts a detector on each lane, 2 s before the stop line or nearer: the vehicles between them
leave within the shortest green. A detector extends a phase if all movements of its lane are green,
and so are those of the lanes of the same signal that they lead to. A movement that gives way counts
as green on a street with one lane, or beside another one if it never has the right of way.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from cosim.evaluation.link_streets import Streets
from cosim.plant.programmes import Limits, actuated_limits
from cosim.sumo.net import City, Connection
from cosim.sumo.signals import GREEN, Cycle, Signal
from nmfd.arrays import Arrays

Lane: TypeAlias = tuple[str, int]  # street and number
# SUMO's defaults.
DETECTOR_S = 2.0  # time from a detector to the stop line at most
PASSING_S = 1.9  # headway of vehicles that leave a queue
SPACING_M = 7.5  # of these vehicles when they stood


def clock_at(cycle: Cycle, begin: float) -> float:
    """Return the time since the programme's own beginning (s).

    begin: time of the simulation (s)
    """
    if cycle.offset == "begin":
        return 0.0
    return begin - float(cycle.offset)


def phase_arrays(
    streets: Streets,
    signals: Sequence[Signal],
    actuated: Collection[str],
    cycles: Mapping[str, Cycle],
    begin: float,
) -> Arrays:
    """Return the arrays of actuated signals.

    actuated: those of `signals` that can be; begin: time of the first second (s)
    """
    lanes_of = _lanes_of_signals(streets)
    most = max((len(signal.phases) for signal in signals), default=1)
    second = np.zeros((len(signals), most), dtype=int)
    least = np.zeros((len(signals), most))
    longest = np.zeros_like(least)
    ahead = np.zeros(len(streets.links))
    pairs = set()
    for row, signal in enumerate(signals):
        if signal.id not in actuated:
            continue
        limits = actuated_limits(signal)
        durations = np.array([phase.duration for phase in signal.phases])
        begins = np.cumsum(durations) - durations - clock_at(cycles[signal.id], begin)
        columns = slice(len(limits))
        second[row, columns] = np.ceil(begins - 0.5) % max(round(durations.sum()), 1)
        least[row, columns] = [limit.least for limit in limits]
        longest[row, columns] = [limit.most for limit in limits]
        lanes = lanes_of[signal.id]
        for lane in lanes.keys() & streets.number.keys():
            link = streets.number[lane]
            ahead[link] = _ahead(signal, limits, lanes[lane], streets.city)
            for phase in _extended(signal, lane, lanes, streets.city):
                pairs.add((link, row * most + phase))
    detected, detecting = np.array(sorted(pairs), dtype=int).reshape(-1, 2).T
    return {
        "phases": np.array([len(signal.phases) for signal in signals], dtype=int),
        "phase_second": second,
        "phase_least": least,
        "phase_most": longest,
        "detector": ahead,
        "detected": detected,
        "detecting": detecting,
    }


def _lanes_of_signals(streets: Streets) -> dict[str, dict[Lane, list[Connection]]]:
    """Return signal -> lane -> its connections."""
    lanes: dict[str, dict[Lane, list[Connection]]] = defaultdict(lambda: defaultdict(list))
    for connections in streets.connections.values():
        for one in connections:
            if one.signal:
                lanes[one.signal][one.source, one.lane].append(one)
    return lanes


def _ahead(
    signal: Signal, limits: Sequence[Limits], connections: Sequence[Connection], city: City
) -> float:
    """Return the distance from a lane's detector to the stop line (m)."""
    street = connections[0].source
    shortest = np.inf
    for phase, limit in zip(signal.phases, limits, strict=True):
        green = any(phase.state[one.link] in GREEN for one in connections)
        if green and limit.least < limit.most:
            shortest = min(shortest, limit.least)
    cleared = (shortest / PASSING_S + 0.5) * SPACING_M
    return min(DETECTOR_S * city.speed[street], cleared, city.length[street])


def _extended(
    signal: Signal, lane: Lane, lanes: Mapping[Lane, Sequence[Connection]], city: City
) -> set[int]:
    """Return the phases that a lane's detector extends.

    lanes: connections of each lane of the signal
    """
    behind = {(one.target, one.to_lane) for one in lanes[lane]} & lanes.keys()
    phases = set()
    for number in range(len(signal.phases)):
        if all(_is_green(signal, number, lanes[one], city) for one in {lane, *behind}):
            phases.add(number)
    return phases


def _is_green(signal: Signal, number: int, connections: Sequence[Connection], city: City) -> bool:
    """Return True if all movements of a lane count as green in a phase."""
    state = signal.phases[number].state
    beside = any(state[one.link] == "G" for one in connections)
    alone = city.lanes[connections[0].source] == 1
    for one in connections:
        ever = any(phase.state[one.link] == "G" for phase in signal.phases)
        minor = state[one.link] == "g" and (alone or (beside and not ever))
        if state[one.link] != "G" and not minor:
            return False
    return True
