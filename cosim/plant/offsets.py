"""Offsets of fixed-time signals with one common cycle: the combination method (Hillier 1966).

On every road from signal to signal, platoons leave during the green windows of the one and queue before those of the
other; their delay depends only on the difference of the two offsets. The sum over all roads is minimised by changing
one signal's offset after another. Platoons do not disperse: the roads are short.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cosim.sumo.net import City
from cosim.sumo.signals import GREEN, Signal

STEP = 2  # s between two offsets that are tried
SWEEPS = 30  # through all signals, at most
FULLEST = 0.95  # load, at most: above it a queue would never end, whatever the offset
SLOWER = 1.15  # travel time over the free-flow time, of a platoon that accelerates


def offsets(
    city: City, signals: Sequence[Signal], flows: Mapping[tuple[str, str], float], saturation: float
) -> list[Signal]:
    """`signals` with new offsets. flows: (edge, next edge) -> [veh/s]; saturation: [veh/s] and lane."""
    cycles = {round(sum(phase.duration for phase in signal.phases)) for signal in signals}
    if len(cycles) != 1:  # no common cycle, no wave
        return list(signals)
    cycle = cycles.pop()
    cost = _costs(city, signals, flows, saturation, cycle)
    near: list[list[tuple[int, np.ndarray]]] = [[] for _ in signals]
    for (a, b), curve in cost.items():  # curve[(offset of b - offset of a) mod cycle]
        near[b].append((a, curve))
        near[a].append((b, np.roll(curve[::-1], 1)))
    chosen = np.zeros(len(signals), dtype=int)
    candidates = np.arange(0, cycle, STEP)
    for _ in range(SWEEPS):
        before = chosen.copy()
        for n, others in enumerate(near):
            if others:
                total = sum(curve[(candidates - chosen[m]) % cycle] for m, curve in others)
                chosen[n] = candidates[int(np.argmin(total))]
        if (chosen == before).all():
            break
    return [replace(signal, offset=float(offset)) for signal, offset in zip(signals, chosen, strict=True)]


def _costs(
    city: City, signals: Sequence[Signal], flows: Mapping[tuple[str, str], float], saturation: float, cycle: int
) -> dict[tuple[int, int], np.ndarray]:
    """(signal, next signal) -> (cycle,) queueing on the road between them [veh s per cycle], by the later offset minus
    the earlier one."""
    into: dict[str, list[tuple[int, np.ndarray]]] = {}
    out_of: dict[str, list[tuple[int, np.ndarray, float, float]]] = {}
    for n, signal in enumerate(signals):
        for edge, to, lanes, green in _movements(signal):
            if flow := flows.get((edge, to), 0.0):
                # where a road ends in no signal it is nobody's business
                into.setdefault(to, []).append((n, _discharge(green, flow, saturation * lanes)))
                out_of.setdefault(edge, []).append((n, green, flow, saturation * lanes))
    pairs, arrivals, services = [], [], []
    for first, platoons in sorted(into.items()):
        last, time = _road(city, first, out_of)
        if last is None:
            continue
        for n, profile in platoons:
            shifted = np.roll(profile, round(SLOWER * time) % cycle)
            part = profile.sum() / sum(other.sum() for _, other in platoons)  # and of the green, as the road's others
            for m, green, flow, rate in out_of[last]:
                scale = min(1.0, FULLEST * rate * green.sum() / (flow * cycle))
                arrivals.append(shifted / shifted.sum() * flow * part * cycle * scale)
                services.append(green * rate * part)
                pairs.append((n, m))
    cost: dict[tuple[int, int], np.ndarray] = {}
    if pairs:
        for pair, curve in zip(pairs, _queues(np.array(arrivals), np.array(services)), strict=True):
            cost[pair] = cost.get(pair, 0.0) + curve
    return cost


def _movements(signal: Signal) -> Iterator[tuple[str, str, int, np.ndarray]]:
    """(edge, next edge, lanes, (cycle,) green as 0 or 1) of every movement."""
    lanes: dict[tuple[str, str], dict[int, int]] = {}
    for link in signal.links:
        lanes.setdefault((link.from_edge, link.to_edge), {})[link.lane] = link.index
    for (edge, to), indices in sorted(lanes.items()):
        index = next(iter(indices.values()))
        green = [phase.state[index] in GREEN for phase in signal.phases for _ in range(round(phase.duration))]
        yield edge, to, len(indices), np.array(green, dtype=float)


def _discharge(green: np.ndarray, flow: float, rate: float) -> np.ndarray:
    """(cycle,) vehicles that leave in every second when `flow` arrives evenly."""
    queue, left = 0.0, np.zeros(len(green))
    for _ in range(2):
        for t, shown in enumerate(green):
            left[t] = min(queue + flow, rate) if shown else 0.0
            queue = min(queue + flow - left[t], rate * len(green))
    return left if left.any() else np.full(len(green), flow)


def _road(city: City, edge: str, ends: Collection[str]) -> tuple[str | None, float]:
    """The edge before the next signal, from `edge` on, and the free-flow time to its end [s]; None at a fork."""
    time, seen = 0.0, set()
    while edge not in seen:
        seen.add(edge)
        time += city.length[edge] / city.speed[edge]
        if edge in ends:
            return edge, time
        if len(city.successors[edge]) != 1:
            break
        edge = city.successors[edge][0]
    return None, time


def _queues(arrivals: np.ndarray, services: np.ndarray) -> np.ndarray:
    """(M, cycle): vehicle seconds in the queue in a cycle, if the clock of the service is n seconds late."""
    movements, cycle = arrivals.shape
    shift = (np.arange(cycle)[:, None] - np.arange(cycle)[None, :]) % cycle  # [time, offset] -> the service's second
    queue, total = np.zeros((movements, cycle)), np.zeros((movements, cycle))
    for lap in range(2):
        for t in range(cycle):
            queue = np.maximum(queue + arrivals[:, t, None] - services[:, shift[t]], 0.0)
            if lap:
                total += queue
    return total
