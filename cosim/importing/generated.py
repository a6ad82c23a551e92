"""A demand for a city without any: a morning peak towards the centre, through traffic and a
background.

The centre is where the signals are. All drivers take a fastest route at free flow, with a delay for
every junction and a longer one for a signal, as one of DRIVER_CLASSES groups of drivers perceives
the times.
"""

from xml.etree.ElementTree import Element, SubElement

import numpy as np

from cosim.importing.demand import Traffic
from cosim.importing.streets import Streets
from cosim.sumo.trips import DRIVER_CLASSES, SHORT_EDGE_M, fastest_routes, perception
from nmfd.errors import InputError

RAMP_UP_S, FLAT_S, RAMP_DOWN_S = 1800.0, 1800.0, 1800.0
INWARD_SHARE, THROUGH_SHARE = 0.5, 0.25  # of the trips; the rest is the background
PEAK_DENSITY = (
    3.0e-3  # veh/m of lane that the peak would keep on the streets at free flow, at level 1
)
MAX_ORIGINS = 400  # streets where trips begin: bounds the shortest paths to find
JUNCTION_DELAY_S, SIGNAL_DELAY_S = 3.0, 10.0
PILOT_TRIPS = 1500  # from which the mean trip time is estimated


def morning_peak(streets: Streets, *, level: float, begin: float, seed: int) -> Traffic:
    """Generate trips on the largest part of the network in which every edge can be reached from
    every other.

    level: 1 keeps PEAK_DENSITY under way if vehicles meet no queue; begin: of the peak [s]
    Raises: InputError for a network that is too small
    """
    if (count := streets.core.sum()) < 4:
        raise InputError(
            f"{streets.path}: only {count} streets can be reached from each other; give vehicles instead"
        )
    random = np.random.default_rng([seed, 0x7065616B])
    ends = _Ends(streets, random)
    signalled = np.array([signal is not None for signal in streets.link_signals])
    turn = np.where(signalled, SIGNAL_DELAY_S, JUNCTION_DELAY_S)
    time = streets.length / streets.speed + JUNCTION_DELAY_S  # with the junction before it
    noise = perception(len(time), random)

    def routed(ends: tuple[np.ndarray, np.ndarray]) -> list[tuple[int, ...]]:
        tastes = random.integers(DRIVER_CLASSES, size=len(ends[0]))
        return fastest_routes(ends, tastes, noise, time=time, links=streets.links, turn=turn)

    pilot = routed(ends.draw(PILOT_TRIPS))
    mean = float(np.mean([time[list(route)].sum() for route in pilot if route]))
    inside = level * PEAK_DENSITY * float(streets.lane_metres[streets.core].sum())
    count = max(1, round(inside / mean * (RAMP_UP_S / 2 + FLAT_S + RAMP_DOWN_S / 2)))
    first, last = ends.draw(count)
    depart = begin + np.sort(_times(random.random(count)))
    routes = routed((first, last))
    kept = np.array([bool(route) for route in routes])
    free = {
        "departLane": "best",
        "departSpeed": "max",
        "departPos": "random_free",
        "arrivalPos": "random",
    }
    vehicles = []
    for n in np.flatnonzero(kept):
        vehicles.append(
            Element("vehicle", {"id": f"v{n}", "type": "car", "depart": f"{depart[n]:.2f}", **free})
        )
        SubElement(
            vehicles[-1], "route", {"edges": " ".join(streets.edges[edge] for edge in routes[n])}
        )
    return Traffic(
        vehicles=tuple(vehicles),
        depart=depart[kept],
        origin=first[kept],
        destination=last[kept],
        shared=(Element("vType", {"id": "car", "sigma": "0.2"}),),
        notes={"trips of a generated morning peak": int(kept.sum())},
    )


class _Ends:
    """Origins and destinations of trips."""

    def __init__(self, streets: Streets, random: np.random.Generator):
        self._random = random
        good = streets.core & (streets.length >= SHORT_EDGE_M)
        self._edges = np.flatnonzero(good if good.sum() >= 4 else streets.core)
        weight = streets.lane_metres[self._edges]
        middle = np.average(streets.centre[self._edges], axis=0, weights=weight)
        if signalled := [n for n, signal in enumerate(streets.link_signals) if signal is not None]:
            middle = streets.centre[streets.links[signalled, 0]].mean(axis=0)
        away = streets.centre[self._edges] - middle
        self._distance, self._angle = np.hypot(*away.T), np.arctan2(*away.T[::-1])
        radius = np.sqrt(np.average(self._distance**2, weights=weight))
        starts = random.choice(
            len(weight), size=min(MAX_ORIGINS, len(weight)), replace=False, p=weight / weight.sum()
        )
        outside = self._distance[starts] > 0.5 * radius
        self._all, self._outer = starts, starts[outside] if outside.sum() >= 2 else starts
        rim = starts[self._distance[starts] >= np.quantile(self._distance[starts], 0.7)]
        self._rim = rim if len(rim) >= 2 else starts
        self._weight, self._fast = weight, weight * streets.speed[self._edges] ** 2
        self._central = weight * np.exp(-0.5 * (self._distance / (0.3 * radius)) ** 2)

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        kind = self._random.random(count)
        inward, through = (
            kind < INWARD_SHARE,
            (kind >= INWARD_SHARE) & (kind < INWARD_SHARE + THROUGH_SHARE),
        )
        first = self._random.choice(self._all, size=count)
        last = self._pick(np.arange(len(self._weight)), self._weight, count)
        first[inward] = self._random.choice(self._outer, size=inward.sum())
        last[inward] = self._pick(np.arange(len(self._weight)), self._central, int(inward.sum()))
        first[through] = self._pick(self._rim, self._fast[self._rim], int(through.sum()))
        last[through] = [self._opposite(n) for n in first[through]]
        last = np.where(first == last, (last + 1) % len(self._weight), last)
        return self._edges[first], self._edges[last]

    def _pick(self, options: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
        return self._random.choice(options, size=count, p=weight / weight.sum())

    def _opposite(self, n: int) -> int:
        """Draw a street on the far side of the city."""
        turned = np.cos(self._angle[self._rim] - self._angle[n]) < 0.0
        options = self._rim[turned] if turned.any() else self._rim
        return int(self._pick(options, self._fast[options], 1)[0])


def _times(uniform: np.ndarray) -> np.ndarray:
    """Return departures [s] after the beginning, of a trapezoid, from uniform random numbers."""
    clock = np.linspace(0.0, RAMP_UP_S + FLAT_S + RAMP_DOWN_S, 541)
    rate = np.minimum(np.minimum(clock / RAMP_UP_S, 1.0), (clock[-1] - clock) / RAMP_DOWN_S)
    share = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2)])
    return np.interp(uniform, share / share[-1], clock)
