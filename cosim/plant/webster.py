"""Fixed-time signals optimised for the demand: one common cycle and the splits with the least delay, then green waves.

Delay is Webster's for uniform arrivals with the term of the Highway Capacity Manual for random and excess arrivals
(HCM 2000, chapter 16); unlike Webster's closed formulas, which minimise much the same, it also holds where the flow is
near or above capacity, and for left turns that are permitted in one stage and protected in another.
"""

import hashlib
import inspect
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

import numpy as np

import cosim.plant.offsets
import cosim.sumo.signals
import cosim.sumo.trips
import cosim.sumo.turning_flows
from cosim.plant.offsets import offsets
from cosim.sumo.net import City
from cosim.sumo.session import Phase
from cosim.sumo.signals import Signal, programme_row, write_programmes
from nmfd.arrays import PairsOverTime
from nmfd.errors import InputError
from nmfd.runs import shipped

CYCLES = (40, 50, 60, 70, 80, 90, 100, 110, 120)  # s
MIN_GREEN = 5.0  # s
STEP = 1.0  # s, of the splits
SATURATION = 0.5  # veh/s and lane: 1,800 an hour, straight on
TURNING = {"l": 0.95, "r": 0.85}  # of that in turns (HCM)
LOST = 1.0  # s of every green window, more than what is used of the yellow
GAP, FOLLOW_UP = 4.5, 2.5  # s, critical gap and follow-up time of permitted left turns (HCM)
SNEAKERS = 1.0  # veh per lane, which wait on the junction and turn when the green ends
PERIOD = 900.0  # s, for which an excess flow lasts (HCM: a quarter of an hour)
LEAST = 1e-4  # veh/s, so that a capacity is never zero


@dataclass(frozen=True, kw_only=True)
class _Lane:
    """A lane before a signal. edge: its own; flow: [veh/s]; shares: ((link index, share of the flow, saturation flow
    [veh/s]), ...)"""

    edge: str
    flow: float
    shares: tuple[tuple[int, float, float], ...]


def optimised(city: City, signals: Sequence[Signal], flows: Mapping[tuple[str, str], float]) -> list[Signal]:
    """`signals` with the durations and offsets for `flows`, (edge, next edge) -> [veh/s].

    The cycle is the same for all, so that green waves are possible, and no shorter than every minimum green needs.
    """
    lanes = {signal.id: _lanes(signal, flows) for signal in signals}
    best, plan = math.inf, list(signals)
    for cycle in CYCLES:
        found = [split for signal in signals if (split := _split(signal, lanes[signal.id], cycle)) is not None]
        if len(found) < len(signals):  # too short
            continue
        total = sum(delay for _, delay in found)
        if total >= best:  # longer ones are worse still
            break
        best, plan = total, [signal for signal, _ in found]
    return offsets(city, plan, flows, SATURATION)


def plan(
    city: City,
    signals: Sequence[Signal],
    demand: PairsOverTime,
    step: float,
    *,
    folder: Path,
    flows: Mapping[tuple[str, str], float] | None = None,
) -> Path:
    """The additional file for SUMO with `signals` optimised for the peak of `demand` (T, R, R) [veh/s], or for `flows`
    where these are known.

    Kept in `folder` under a name that changes with all that it depends on. InputError if it cannot be written there.
    """
    content = hashlib.sha256(metadata.version("numpy").encode())
    sources = (
        cosim.sumo.turning_flows,
        cosim.plant.offsets,
        cosim.sumo.signals,
        cosim.sumo.trips,
        sys.modules[__name__],
    )
    for source in sources:
        content.update(Path(inspect.getfile(source)).read_bytes())
    content.update(city.net_file.read_bytes())
    content.update(repr((step, sorted(city.region_of.items()))).encode())
    content.update(np.ascontiguousarray(demand).tobytes())
    if flows is not None:
        content.update(repr((sorted(flows.items()), signals)).encode())
    path = folder / f"webster-{content.hexdigest()[:16]}.add.xml"
    if not path.is_file():
        flows = cosim.sumo.turning_flows.turning_flows(city, demand, step) if flows is None else flows
        rows = [programme_row(signal, "static") for signal in optimised(city, signals, flows)]
        try:
            shipped.made(folder)
            write_programmes(path, rows)
        except OSError as error:
            raise InputError(f"{path}: the signal plan cannot be kept ({error.strerror}); make it writable") from None
    return path


def _lanes(signal: Signal, flows: Mapping[tuple[str, str], float]) -> list[_Lane]:
    """The used lanes before the signal; a movement's flow is spread evenly over the lanes that it may use."""
    links = {(k.from_edge, k.lane, k.to_edge): k for k in signal.links}
    serving: dict[tuple[str, str], set[int]] = {}
    for edge, lane, to in links:
        serving.setdefault((edge, to), set()).add(lane)
    found: dict[tuple[str, int], list[tuple[int, float, float]]] = {}
    for (edge, lane, to), link in sorted(links.items()):
        if flow := flows.get((edge, to), 0.0) / len(serving[edge, to]):
            rate = SATURATION * TURNING.get(link.turn, 1.0)
            found.setdefault((edge, lane), []).append((link.index, flow, rate))
    lanes = []
    for (edge, _), parts in found.items():
        total = sum(flow for _, flow, _ in parts)
        lanes.append(
            _Lane(edge=edge, flow=total, shares=tuple((index, flow / total, rate) for index, flow, rate in parts))
        )
    return lanes


def _split(signal: Signal, lanes: list[_Lane], cycle: float) -> tuple[Signal, float] | None:
    """The signal with stages that minimise the delay of a cycle, and that delay [veh s/s]; None if it does not fit.

    Delay is convex in the capacities, so the seconds are given out one by one, each to the stage where it saves most.
    """
    least = {n: min(MIN_GREEN, signal.phases[n].duration) for n in signal.stages}
    durations = [least.get(n, phase.duration) for n, phase in enumerate(signal.phases)]
    spare = round((cycle - sum(durations)) / STEP)
    if spare < 0:
        return None
    demand = _opposing(signal, lanes)
    for _ in range(spare):
        trials = []
        for n in signal.stages:
            durations[n] += STEP
            trials.append((_delay(signal, durations, lanes, demand, cycle), n))
            durations[n] -= STEP
        durations[min(trials)[1]] += STEP
    phases = tuple(Phase(duration=d, state=p.state) for d, p in zip(durations, signal.phases, strict=True))
    return replace(signal, phases=phases), _delay(signal, durations, lanes, demand, cycle)


def _opposing(signal: Signal, lanes: list[_Lane]) -> dict[tuple[int, str], tuple[float, float]]:
    """(stage, edge) -> flow [veh/s] with right of way from the other edges, all of it and that of its fullest lane."""
    found = {}
    for n in signal.stages:
        state = signal.phases[n].state
        for edge in {lane.edge for lane in lanes}:
            flows = [
                lane.flow * sum(share for index, share, _ in lane.shares if state[index] == "G")
                for lane in lanes
                if lane.edge != edge
            ]
            found[n, edge] = sum(flows), max(flows, default=0.0)
    return found


def _delay(
    signal: Signal,
    durations: list[float],
    lanes: list[_Lane],
    opposing: Mapping[tuple[int, str], tuple[float, float]],
    cycle: float,
) -> float:
    """Sum over the lanes of flow times delay [veh s/s]; opposing: see `_opposing`."""
    total = 0.0
    for lane in lanes:
        served, served_before = 0.0, math.inf  # veh per cycle that could pass; headway in the phase before
        for n, phase in enumerate(signal.phases):
            headway = 0.0
            for index, share, rate in lane.shares:
                light = phase.state[index]
                if light == "G":
                    headway += share / rate
                elif light == "g":
                    flow, fullest = opposing.get((n, lane.edge), (SATURATION, SATURATION))
                    headway += share / min(_permitted(flow, fullest, durations[n], cycle), rate)
                else:
                    headway = math.inf
            if headway < math.inf:
                served += max(durations[n] - LOST * (served_before == math.inf), 0.0) / headway
            served_before = headway
        capacity = max(served / cycle, LEAST)
        load, green = lane.flow / capacity, min(capacity / SATURATION, 1.0)
        uniform = 0.5 * cycle * (1.0 - green) ** 2 / (1.0 - min(load, 1.0) * green + 1e-9)
        excess = 0.25 * PERIOD * (load - 1.0 + math.sqrt((load - 1.0) ** 2 + 4.0 * load / (capacity * PERIOD)))
        total += lane.flow * (uniform + excess)
    return total


def _permitted(flow: float, fullest: float, green: float, cycle: float) -> float:
    """Mean flow [veh/s] of a lane that must give way to `flow` during a stage of `green` s."""
    queue = fullest * (cycle - green) / max(SATURATION - fullest, 0.05)  # s until the opposing queue is gone
    gaps = flow * math.exp(-flow * GAP) / (1.0 - math.exp(-flow * FOLLOW_UP)) if flow > 1e-6 else 1.0 / FOLLOW_UP
    return min(max(1.0 - queue / green, 0.0) * gaps + SNEAKERS / green, SATURATION)
