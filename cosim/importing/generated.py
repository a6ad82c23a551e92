"""Morning peak for a city without demand.

It has trips towards the centre, through traffic and a background.
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

RAMP_UP_S = 1800.0
FLAT_S = 1800.0
RAMP_DOWN_S = 1800.0
# Of the trips; the rest is the background.
INWARD_SHARE = 0.5
THROUGH_SHARE = 0.25
# Veh/m of lane that the peak would keep on the streets at free flow, at level 1.
PEAK_DENSITY = 3.0e-3
# Where on its first and last edge a vehicle begins and ends.
ANYWHERE = {
    "departLane": "best",
    "departSpeed": "max",
    "departPos": "random_free",
    "arrivalPos": "random",
}
MAX_ORIGINS = 400  # streets where trips begin: bounds the shortest paths to find
JUNCTION_DELAY_S = 3.0
SIGNAL_DELAY_S = 10.0
PILOT_TRIPS = 1500  # from which the mean trip time is estimated


def morning_peak(streets: Streets, *, level: float, begin: float, seed: int) -> Traffic:
    """Generate trips on the largest part of the network.

    There every edge can be reached from every other.
    level: 1 keeps PEAK_DENSITY under way if vehicles meet no queue; begin: of the peak [s]
    Raises: InputError for a network that is too small
    """
    if streets.core.sum() < 4:
        raise InputError(
            f"{streets.path}: only {streets.core.sum()} streets can be reached from each other; "
            "give vehicles instead"
        )
    random = np.random.default_rng([seed, 0x7065616B])
    ends = _Ends(streets, random)
    turn = np.where(streets.signalled, SIGNAL_DELAY_S, JUNCTION_DELAY_S)
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
    # Departures of a trapezoid.
    clock = np.linspace(0.0, RAMP_UP_S + FLAT_S + RAMP_DOWN_S, 541)
    rate = np.minimum(np.minimum(clock / RAMP_UP_S, 1.0), (clock[-1] - clock) / RAMP_DOWN_S)
    share = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2)])
    depart = begin + np.sort(np.interp(random.random(count), share / share[-1], clock))
    routes = routed((first, last))
    kept = np.array([bool(route) for route in routes])
    vehicles = []
    for n in np.flatnonzero(kept):
        own = {"id": f"v{n}", "type": "car", "depart": f"{depart[n]:.2f}"}
        vehicle = Element("vehicle", own | ANYWHERE)
        edges = " ".join(streets.edges[edge] for edge in routes[n])
        SubElement(vehicle, "route", {"edges": edges})
        vehicles.append(vehicle)
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
        if good.sum() < 4:
            good = streets.core
        self._edges = np.flatnonzero(good)
        weight = streets.lane_metres[self._edges]
        self._weight = weight
        self._fast = weight * streets.speed[self._edges] ** 2
        middle = np.average(streets.centre[self._edges], axis=0, weights=weight)
        if streets.signalled.any():
            middle = streets.centre[streets.links[streets.signalled, 0]].mean(axis=0)
        east, north = (streets.centre[self._edges] - middle).T
        self._distance = np.hypot(east, north)
        self._angle = np.arctan2(north, east)
        radius = np.sqrt(np.average(self._distance**2, weights=weight))
        self._central = weight * np.exp(-0.5 * (self._distance / (0.3 * radius)) ** 2)
        # Where trips begin: anywhere, outside the centre, or at the rim.
        starts = random.choice(
            len(weight), size=min(MAX_ORIGINS, len(weight)), replace=False, p=weight / weight.sum()
        )
        away = self._distance[starts]
        self._all = starts
        self._outer = starts[away > 0.5 * radius]
        if len(self._outer) < 2:
            self._outer = starts
        self._rim = starts[away >= np.quantile(away, 0.7)]
        if len(self._rim) < 2:
            self._rim = starts

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw the first and the last edges of so many trips."""
        kind = self._random.random(count)
        inward = kind < INWARD_SHARE
        through = (kind >= INWARD_SHARE) & (kind < INWARD_SHARE + THROUGH_SHARE)
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
        options = self._rim
        if turned.any():
            options = self._rim[turned]
        return int(self._pick(options, self._fast[options], 1)[0])
