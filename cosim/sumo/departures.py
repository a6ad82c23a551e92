"""Vehicles as SUMO reads them, with all that it draws for them.

None of them is driven.
"""

import heapq
import math
from collections.abc import Container, Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path

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
    "no-warnings": "true",  # on the console; the error log has them
}
WARNING = "Warning: "  # begins a line of SUMO's error log


@dataclass(frozen=True, kw_only=True)
class Departure:
    """Vehicle as SUMO reads it.

    depart: [s]; built: time of the step in which SUMO made it [s], -inf if before the first one
    kind: SUMO's vehicle class; line: of public transport; speed_factor: [-]
    route: id; edges: of the route at the time of departure
    valid: the route has no gaps
    routed: SUMO finds a route for it when it is to depart
    devices: kinds that it has, of those that were asked for
    place: departLane and departPos [m] of a vehicle that is on the road in a loaded state
    """

    id: str
    depart: float
    built: float
    type: str
    kind: str
    line: str
    speed_factor: float
    route: str
    edges: tuple[str, ...]
    valid: bool
    routed: bool
    devices: tuple[str, ...] = ()
    place: tuple[str, str] | None = None


@dataclass(frozen=True, kw_only=True)
class Departures:
    """Vehicles of a city as SUMO reads them.

    vehicles: those that depart, in the order in which SUMO builds them
    timeless: ids of those that wait for somebody, and so have no time of departure
    dropped: ids of those that SUMO dropped before they were due
    warnings: SUMO's words, one text each
    """

    vehicles: tuple[Departure, ...]
    timeless: tuple[str, ...]
    dropped: tuple[str, ...]
    warnings: tuple[str, ...]


def read_departures(
    options: Mapping[str, object],
    *,
    given: Mapping[str, bool],
    devices: Sequence[str],
    end: float | None,
    latest: float,
    where: str,
) -> Departures:
    """Return the vehicles that depart before `end` [s].

    options: of SUMO, with absolute paths. SUMO runs in a process of its own.
    given: id of every vehicle and flow -> True if it waits for somebody before it departs
    devices: kinds that SUMO gives to some vehicles by chance
    latest: when the last vehicle, person or flow of the files begins [s]
    Raises InputError with SUMO's words and the file `where`.
    """
    last = math.inf if end is None else end
    reading = partial(_read, {**options, **UNDRIVEN}, given, devices, last, latest, where)
    [(_, outcome)] = in_processes([reading], 1, [None])
    if isinstance(outcome, InputError):
        raise outcome
    return outcome


def _read(
    options: Mapping[str, object],
    given: Mapping[str, bool],
    devices: Sequence[str],
    end: float,
    latest: float,
    where: str,
) -> Departures | InputError:
    """Return what SUMO reads, or an error with its words."""
    with temporary_folder() as folder, chdir(folder):  # some devices of vehicles write files
        log = Path("said.log")
        command = ["sumo", "--error-log", str(log)]
        for key, value in options.items():
            command += [f"--{key}", str(value)]
        try:
            start_quietly(command)
            reader = _Reader(given, devices)
            reader.read(end, latest)
            libsumo.close()
        except ERRORS as error:
            return InputError(f"{where}: sumo cannot run it: {one_line(error)}; correct the input")
        except InputError as error:
            return InputError(f"{where}: {error}")
        return reader.departures(log.read_text(encoding="utf-8", errors="replace"))


def original(name: str, given: Container[str]) -> str:
    """Return the id in `given` of the element that a vehicle comes from.

    It is its own, or that of a flow or of a multiplied vehicle. It is "" for the vehicles of
    calibrators and persons. In `given` the id of a flow may end with a dot, as a vehicle may have
    the same id.
    """
    while name and name not in given:
        name = name.rpartition(".")[0]
        if f"{name}." in given:
            return f"{name}."
    return name


class _Reader:
    """Steps through a simulation and takes every vehicle out when it is due."""

    def __init__(self, given: Mapping[str, bool], devices: Sequence[str]):
        """given: id of every vehicle and flow -> True if it waits

        devices: kinds to ask for
        """
        self._given = given
        self._devices = devices
        self._numbers = count()  # vehicles in the order in which SUMO builds them
        self._due: list[tuple[float, int, str, float]] = []  # depart, number, id, built
        self._found: dict[int, Departure] = {}
        self._timeless: list[str] = []
        self._dropped: list[str] = []
        self._step = -math.inf  # time of the last step
        self._now = libsumo.simulation.getTime()

    def read(self, end: float, latest: float) -> None:
        """Read until `end` [s], or until all vehicles are read.

        latest: when the last one begins [s]
        Raises InputError if so much time passes before it that nobody can have meant it.
        """
        self._take_from_road()
        last = self._now
        while True:
            if self._load():
                last = self._now
            self._take_due()
            if self._now >= end:
                return
            idle = self._now - last > IDLE_S
            if idle and (latest > self._now or self._due):
                raise InputError(
                    f"nothing begins in the day after {last:g} s, but something later; correct "
                    "the times, or give --end"
                )
            if idle or (libsumo.simulation.getMinExpectedNumber() == 0 and self._now > latest):
                return
            for name in libsumo.person.getIDList():
                libsumo.person.remove(name)
            libsumo.simulationStep()
            self._step = self._now
            self._now = libsumo.simulation.getTime()

    def departures(self, log: str) -> Departures:
        """Return what was read. log: SUMO's error log"""
        warnings = []
        for line in log.splitlines():
            if line.startswith(WARNING):
                warnings.append(line.removeprefix(WARNING).strip())
        return Departures(
            vehicles=tuple(self._found[number] for number in sorted(self._found)),
            timeless=tuple(self._timeless),
            dropped=tuple(self._dropped),
            warnings=tuple(warnings),
        )

    def _take_from_road(self) -> None:
        """Take the vehicles of a loaded state.

        One on a junction is at the end of the street before it.
        """
        for name in libsumo.vehicle.getIDList():
            position = libsumo.vehicle.getLanePosition(name)
            if libsumo.vehicle.getRoadID(name).startswith(":"):
                position = -1.0
            place = str(libsumo.vehicle.getLaneIndex(name)), f"{position:.2f}"
            self._take(next(self._numbers), name, self._now, -math.inf, place)

    def _load(self) -> bool:
        """Queue the vehicles that the last step built; False without any."""
        names = libsumo.simulation.getLoadedIDList()
        for name in names:
            if self._waits(name):
                self._timeless.append(name)  # to remove it would end SUMO's count too early
                continue
            try:
                depart = round(self._now - libsumo.vehicle.getDepartDelay(name), 3)
            except REFUSALS:
                self._dropped.append(name)
                continue
            heapq.heappush(self._due, (depart, next(self._numbers), name, self._step))
        return bool(names)

    def _waits(self, name: str) -> bool:
        """Return True for a vehicle without a time of departure."""
        return self._given.get(original(name, self._given), False)

    def _take_due(self) -> None:
        """Take the vehicles that were due in the last step."""
        while self._due and self._due[0][0] <= self._step:
            depart, number, name, built = heapq.heappop(self._due)
            try:
                self._take(number, name, depart, built)
            except REFUSALS:
                self._dropped.append(name)

    def _take(
        self,
        number: int,
        name: str,
        depart: float,
        built: float,
        place: tuple[str, str] | None = None,
    ) -> None:
        vehicle = libsumo.vehicle
        edges = vehicle.getRoute(name)
        if place is not None:
            edges = edges[vehicle.getRouteIndex(name) :]
        self._found[number] = Departure(
            id=name,
            depart=depart,
            built=built,
            type=vehicle.getTypeID(name),
            kind=vehicle.getVehicleClass(name),
            line=vehicle.getLine(name),
            speed_factor=round(vehicle.getSpeedFactor(name), 6),
            route=vehicle.getRouteID(name),
            edges=tuple(edges),
            valid=vehicle.isRouteValid(name),
            routed=vehicle.getParameter(name, "has.rerouting.device") == "true",
            devices=tuple(device for device in self._devices if _has(name, device)),
            place=place,
        )
        vehicle.remove(name)


def _has(vehicle: str, device: str) -> bool:
    """Return True if SUMO gave a vehicle a device by chance.

    A vehicle without a route has a rerouting device anyhow, but one with a period of 0 s.
    """
    get = libsumo.vehicle.getParameter
    if get(vehicle, f"has.{device}.device") != "true":
        return False
    if device != "rerouting" or libsumo.simulation.getOption("device.rerouting.period") == "0":
        return True
    return float(get(vehicle, "device.rerouting.period")) > 0.0
