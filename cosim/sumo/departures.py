"""Vehicles as SUMO reads them from a city's files, with all that it draws for them. None of them is
driven."""

import heapq
import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from contextlib import chdir, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count

import libsumo

from cosim.sumo.session import ERRORS, REFUSALS, one_line, start_quietly
from nmfd.errors import InputError
from nmfd.runs.files import temporary_folder
from nmfd.runs.pool import in_processes

IDLE_S = 86400.0  # without a new vehicle: the end of a simulation that has no end
# No vehicle or person leaves its queue; trips get routes when they are due.
UNDRIVEN = {
    "max-num-vehicles": 0,
    "max-num-persons": 0,
    "max-depart-delay": -1,
    "device.rerouting.pre-period": 0,
    "ignore-route-errors": "true",
    "no-step-log": "true",
    "no-warnings": "true",
}


@dataclass(frozen=True, kw_only=True)
class Departure:
    """Vehicle as SUMO reads it.

    depart: [s]; kind: SUMO's vehicle class; line: of public transport; speed_factor: [-]
    route: id; edges: of the route at the time of departure
    valid: the route has no gaps
    place: departLane and departPos [m] of a vehicle that is on the road in a loaded state
    """

    id: str
    depart: float
    type: str
    kind: str
    line: str
    speed_factor: float
    route: str
    edges: tuple[str, ...]
    valid: bool
    place: tuple[str, str] | None = None


def read_departures(
    options: Mapping[str, object], *, end: float | None, where: str
) -> list[Departure]:
    """Return the vehicles that depart before `end` [s], in the order in which SUMO builds them.

    options: of SUMO, with absolute paths. SUMO runs in a process of its own.
    Raises InputError with SUMO's words and the file `where`.
    """
    job = partial(_said, {**options, **UNDRIVEN}, math.inf if end is None else end)
    [(_, outcome)] = in_processes([job], 1, [None])
    if isinstance(outcome, str):
        raise InputError(f"{where}: sumo cannot run it: {outcome}; correct the input")
    return outcome


def _said(options: Mapping[str, object], end: float) -> list[Departure] | str:
    """Return `_read`, or SUMO's words if it refuses the files."""
    try:
        return _read(options, end)
    except ERRORS as error:
        return one_line(error)


def _read(options: Mapping[str, object], end: float) -> list[Departure]:
    simulation, vehicle = libsumo.simulation, libsumo.vehicle
    found: dict[int, Departure] = {}

    def take(number: int, name: str, depart: float, place: tuple[str, str] | None = None) -> None:
        found[number] = Departure(
            id=name,
            depart=depart,
            type=vehicle.getTypeID(name),
            kind=vehicle.getVehicleClass(name),
            line=vehicle.getLine(name),
            speed_factor=round(vehicle.getSpeedFactor(name), 6),
            route=vehicle.getRouteID(name),
            edges=tuple(vehicle.getRoute(name)[vehicle.getRouteIndex(name) if place else 0 :]),
            valid=vehicle.isRouteValid(name),
            place=place,
        )
        vehicle.remove(name)

    with temporary_folder() as folder, chdir(folder):  # some devices of vehicles write files
        start_quietly(
            ["sumo", *(text for key, value in options.items() for text in (f"--{key}", str(value)))]
        )
        numbers, due = count(), list[tuple[float, int, str]]()
        step, now = -math.inf, simulation.getTime()
        last = now
        for name in (
            vehicle.getIDList()
        ):  # in a loaded state; on a junction: at the end of the street before it
            position = (
                -1.0 if vehicle.getRoadID(name).startswith(":") else vehicle.getLanePosition(name)
            )
            take(next(numbers), name, now, (str(vehicle.getLaneIndex(name)), f"{position:.2f}"))
        while True:
            for name in simulation.getLoadedIDList():
                with suppress(REFUSALS):  # SUMO has dropped it
                    heapq.heappush(
                        due, (round(now - vehicle.getDepartDelay(name), 3), next(numbers), name)
                    )
                last = now
            while due and due[0][0] <= step:
                depart, number, name = heapq.heappop(due)
                with suppress(REFUSALS):
                    take(number, name, depart)
            if now >= end or simulation.getMinExpectedNumber() == 0 or now - last > IDLE_S:
                break
            for name in libsumo.person.getIDList():
                libsumo.person.remove(name)
            libsumo.simulationStep()
            step, now = now, simulation.getTime()
        libsumo.close()
    return _queued([found[number] for number in sorted(found)], now - step)


def _queued(departures: Sequence[Departure], step: float) -> list[Departure]:
    """Return the departures with times that keep their order in SUMO's queue when they are sorted
    by time.

    SUMO puts a vehicle behind those that it read before and that depart less than a `step` [s]
    later.
    """
    times, queued = list[float](), list[Departure]()
    for departure in departures:
        n = bisect_left(times, departure.depart)
        if n == len(times) or times[n] >= departure.depart + step:
            times.insert(n, departure.depart)
        queued.append(replace(departure, depart=times[n]))
    return queued
