"""The SUMO session; only it and `departures` import libsumo. At most one simulation per process."""

import ctypes
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import libsumo

from cosim.sumo.recorded_trips import BOUND, PUBLIC
from cosim.sumo.xml_files import file_list
from nmfd.errors import InputError, RunFailed

REFUSALS = libsumo.TraCIException  # of one order: the simulation goes on
ERRORS = (REFUSALS, libsumo.FatalTraCIError)
KEPT_BYTES = {
    -1: 64 << 20,
    -3: 32 << 20,
}  # by M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h: see _keep_freed
GUI_OPTIONS = ("--start", "true", "--delay", "20")


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One phase of a signal programme: duration [s] and one character per link (SUMO's G g y r u o
    O s)."""

    duration: float
    state: str


@dataclass(frozen=True, kw_only=True)
class Programme:
    """A signal programme.

    id: among those of the signal; position: in its cycle when it was read [s]; static: fixed-time,
        phases in order
    actuated: timed by detectors, and always in one of its phases
    """

    signal: str
    phases: tuple[Phase, ...]
    position: float
    static: bool
    actuated: bool = False
    id: str = ""

    @property
    def cycle(self) -> float:
        return sum(phase.duration for phase in self.phases)


class Session:
    """One running simulation.

    time: of the simulation [s]; sumo_time: wall time inside SUMO's own step [s]; command: command
        line of the same run
    A second libsumo.start would silently replace the first simulation: here it is an error.
    """

    _open = False

    def __init__(
        self,
        net_file: Path,
        route_file: Path | Sequence[Path],
        *,
        seed: int,
        step_length: float = 1.0,
        time_to_teleport: float = -1.0,
        collision_action: str = "warn",
        options: tuple[str, ...] = (),
        gui: bool = False,
    ):
        """Start the simulation, in the window of sumo-gui if `gui`.

        Raises RuntimeError if another session is open in this process, InputError if SUMO refuses
        to start.
        """
        if Session._open:
            raise RuntimeError("a SUMO session is already open in this process; close it first")
        _keep_freed()
        self.sumo_time, self.step_length = 0.0, step_length
        routes = file_list([route_file] if isinstance(route_file, Path) else route_file)
        settings = {
            "net-file": net_file,
            "route-files": routes,
            "seed": seed,
            "step-length": step_length,
            "time-to-teleport": time_to_teleport,
            "collision.action": collision_action,
            "no-step-log": "true",
            "no-warnings": "true",
            "duration-log.disable": "true",
        }
        self.command = [
            "sumo",
            *(part for key, value in settings.items() for part in (f"--{key}", str(value))),
        ]
        self.command += options
        self._gui, self.flush = gui, _flush_all()  # the latter makes SUMO write its output buffers
        try:
            if gui:
                libsumo.start(["sumo-gui", *self.command[1:], *GUI_OPTIONS])
            else:
                start_quietly(self.command)
        except ERRORS as error:
            raise InputError(
                f"{net_file}: SUMO cannot run it with {routes}: {one_line(error)}"
            ) from None
        Session._open = True
        self.time = libsumo.simulation.getTime()
        self._lanes = cache(
            lambda edge: tuple(f"{edge}_{n}" for n in range(libsumo.edge.getLaneNumber(edge)))
        )
        self._bind()

    def _bind(self) -> None:
        """Bind SUMO's functions that need no translation; a Python call around them would cost as
        much as they do."""
        simulation, vehicle, edge, lane = (
            libsumo.simulation,
            libsumo.vehicle,
            libsumo.edge,
            libsumo.lane,
        )
        # Vehicles in the last step: read from files; inserted; ended as SUMO says, which tripinfo
        # may deny, without those that a program removed; taken off the road to be moved on; back on
        # the road, or gone for good.
        self.loaded, self.departed = simulation.getLoadedIDList, simulation.getDepartedIDList
        self.arrived = simulation.getArrivedIDList
        self.started_teleport = simulation.getStartingTeleportIDList
        self.ended_teleport = simulation.getEndingTeleportIDList
        # Vehicles now: on the road, without teleporting ones; all that are loaded and have not
        # arrived; due to depart.
        self.running, self.known = vehicle.getIDList, vehicle.getLoadedIDList
        self.pending = simulation.getPendingVehicles
        # One vehicle: edge, normal or internal; route; place on it; speed [m/s]; time since it
        # stopped [s]; length [m].
        self.road, self.route, self.route_index = (
            vehicle.getRoadID,
            vehicle.getRoute,
            vehicle.getRouteIndex,
        )
        self.vehicle_speed = vehicle.getSpeed
        self.standing_time, self.vehicle_length = vehicle.getWaitingTime, vehicle.getLength
        # One edge: its vehicles, their number, and of these under 0.1 m/s. One lane: the number of
        # its vehicles.
        self.vehicles_on, self.vehicle_count = (
            edge.getLastStepVehicleIDs,
            edge.getLastStepVehicleNumber,
        )
        self.halting, self.lane_vehicles = (
            edge.getLastStepHaltingNumber,
            lane.getLastStepVehicleNumber,
        )
        # One loop detector: share of the last step in which a vehicle was on it [%].
        self.loop_occupancy = libsumo.inductionloop.getLastStepOccupancy
        # Signals: all of the network; state of one, a character per link; id of its programme; run
        # one of its own.
        light = libsumo.trafficlight
        self.signals, self.signal_state = light.getIDList, light.getRedYellowGreenState
        self.programme_id, self.restart_programme = light.getProgram, light.setProgram

    def close(self) -> None:
        """End the simulation, which completes SUMO's own outputs; a second call does nothing.

        libsumo cannot close a window, which stays until this process ends.
        """
        if Session._open:
            Session._open = False
            if not self._gui:
                libsumo.close()

    def step(self) -> None:
        """Advance by one simulation step. Raises RunFailed with SUMO's words if it gives up."""
        before = time.perf_counter()
        try:
            libsumo.simulationStep()
        except ERRORS as error:
            raise RunFailed(f"SUMO stopped at {self.time:g} s: {one_line(error)}") from None
        self.sumo_time += time.perf_counter() - before
        self.time = libsumo.simulation.getTime()

    def speeds(self, edge: str) -> tuple[float, float]:
        """Return two mean speeds [m/s] of an edge, the limit if it is empty: of its vehicles, and
        of SUMO's routing.

        In the second one, an empty lane counts as one vehicle at the limit, so that a queue for one
        turn does not deter drivers with another lane.
        """
        routing = libsumo.edge.getLastStepMeanSpeed(edge)
        lanes = self._lanes(edge)
        if len(lanes) > 1:
            counts = [libsumo.lane.getLastStepVehicleNumber(lane) for lane in lanes]
            if total := sum(counts):  # 0 in the mesoscopic model, which has no lanes
                speed = libsumo.lane.getLastStepMeanSpeed
                return sum(
                    n * speed(lane) for n, lane in zip(counts, lanes, strict=True) if n
                ) / total, routing
        return routing, routing

    def teleports(self) -> int:
        """Return SUMO's own count so far: the mesoscopic model has no events for them."""
        return int(libsumo.simulation.getParameter("", "stats.teleports.total"))

    def is_free(self, vehicle: str) -> bool:
        """Return True if the driver may take another route: a private vehicle without stops."""
        return self.is_private(vehicle) and not libsumo.vehicle.getStops(vehicle, 1)

    def is_private(self, vehicle: str) -> bool:
        """Return False for public transport, and for classes that no controller commands."""
        return libsumo.vehicle.getVehicleClass(
            vehicle
        ) not in BOUND and not libsumo.vehicle.getLine(vehicle)

    def is_public(self, vehicle: str) -> bool:
        """Return True for public transport: by its class, or a vehicle with a line."""
        return libsumo.vehicle.getVehicleClass(vehicle) in PUBLIC or bool(
            libsumo.vehicle.getLine(vehicle)
        )

    def departure(self, vehicle: str) -> tuple[float, float]:
        """Return the time of the departure, or else now, and the departure delay until then [s]; <
        0: not due yet."""
        departed = libsumo.vehicle.getDeparture(vehicle)
        return departed if departed >= 0.0 else self.time, libsumo.vehicle.getDepartDelay(vehicle)

    def place(self, vehicle: str) -> tuple[str, float]:
        """Return the lane of a vehicle, and the position on it [m]."""
        return libsumo.vehicle.getLaneID(vehicle), libsumo.vehicle.getLanePosition(vehicle)

    def lane(self, lane: str) -> tuple[float, frozenset[str]]:
        """Return the length of a lane [m], and the edges that it leads to."""
        onward = {libsumo.lane.getEdgeID(link[0]) for link in libsumo.lane.getLinks(lane)}
        return libsumo.lane.getLength(lane), frozenset(onward)

    def next_lane(self, lane: str) -> str:
        """Return the lane that a lane on a junction leads to, of a street or on the junction."""
        return libsumo.lane.getLinks(lane)[0][0]

    def first_on(self, lane: str) -> str | None:
        """Return the vehicle nearest to the end of a lane, None if the lane is empty."""
        vehicles = libsumo.lane.getLastStepVehicleIDs(lane)
        return vehicles[-1] if vehicles else None

    def room(self, lane: str) -> float:
        """Return the free length at the beginning of a lane [m]."""
        position, length = libsumo.vehicle.getLanePosition, libsumo.vehicle.getLength
        vehicles = libsumo.lane.getLastStepVehicleIDs(lane)
        return min(
            (position(v) - length(v) for v in vehicles), default=libsumo.lane.getLength(lane)
        )

    def set_down(self, vehicle: str, lane: str, position: float) -> bool:
        """Put a vehicle at `position` [m] on a lane of its route; return False if SUMO refuses."""
        return _accepted(libsumo.vehicle.moveTo, vehicle, lane, position)

    def fastest(self, edge: str, target: str) -> tuple[float, tuple[str, ...]]:
        """Return time [s] and edges of a car's fastest way on empty streets, () if there is
        none."""
        try:
            stage = libsumo.simulation.findRoute(edge, target)
        except REFUSALS:  # the edge is closed to cars, such as a bus street
            return math.inf, ()
        return stage.travelTime, tuple(stage.edges)

    def set_route(self, vehicle: str, edges: list[str]) -> bool:
        """Give a vehicle on edges[0] a new route; return False if SUMO refuses it and keeps the old
        one."""
        return _accepted(libsumo.vehicle.setRoute, vehicle, edges)

    def begin_trip(self, order: Mapping[str, str]) -> None:
        """Let a vehicle depart now.

        order: arguments of libsumo.vehicle.add, with a route that SUMO knows, and speedFactor
        """
        arguments = dict(order)
        factor = arguments.pop("speedFactor", None)
        libsumo.vehicle.add(**arguments, depart="now")
        if factor is not None:
            libsumo.vehicle.setSpeedFactor(order["vehID"], float(factor))

    def programme(self, signal: str) -> Programme:
        """Return the programme that runs on `signal` now."""
        light, types = libsumo.trafficlight, libsumo.constants
        active = light.getProgram(signal)
        logic = self._logic(signal, active)
        elapsed = sum(phase.duration for phase in logic.phases[: light.getPhase(signal) + 1])
        return Programme(
            signal=signal,
            id=active,
            phases=tuple(Phase(duration=p.duration, state=p.state) for p in logic.phases),
            position=elapsed - (light.getNextSwitch(signal) - libsumo.simulation.getTime()),
            static=logic.type == types.TRAFFICLIGHT_TYPE_STATIC
            and not any(phase.next for phase in logic.phases),
            actuated=logic.type
            in (types.TRAFFICLIGHT_TYPE_ACTUATED, types.TRAFFICLIGHT_TYPE_DELAYBASED),
        )

    def state_underneath(self, signal: str, programme: str) -> str:
        """Return the state that a programme of `signal` would show without the states that were
        set."""
        logic = self._logic(signal, programme)
        return logic.phases[logic.currentPhaseIndex].state

    def set_signal_state(self, signal: str, state: str) -> bool:
        """Set the state of a signal; return False if SUMO refuses it."""
        return _accepted(libsumo.trafficlight.setRedYellowGreenState, signal, state)

    def limit_speed(self, edge: str, limits: list[float]) -> list[float]:
        """Set the speed limits [m/s] of an edge, one per lane or one for all; return those
        before."""
        lanes = self._lanes(edge)
        before = [libsumo.lane.getMaxSpeed(lane) for lane in lanes]
        for lane, limit in zip(
            lanes, limits * len(lanes) if len(limits) == 1 else limits, strict=True
        ):
            libsumo.lane.setMaxSpeed(lane, limit)
        return before

    def _logic(self, signal: str, programme: str) -> Any:
        logics = libsumo.trafficlight.getAllProgramLogics(signal)
        return next(logic for logic in logics if logic.programID == programme)


def _accepted(order: Callable, *arguments: object) -> bool:
    """Give an order to SUMO; return False if it refuses."""
    try:
        order(*arguments)
    except REFUSALS:
        return False
    return True


def _flush_all() -> Callable[[], None] | None:
    """Return OutputDevice::flushAll of SUMO, which is not in its API, by its name in the library of
    Linux and macOS."""
    try:
        flush = ctypes.CDLL(libsumo._libsumo.__file__)["_ZN12OutputDevice8flushAllEv"]
    except (AttributeError, OSError):
        return None
    flush.argtypes, flush.restype = (), None
    return flush


def _keep_freed() -> None:
    """Make glibc keep freed memory: new pages took a sixth of the time of a guided run in
    Luxembourg."""
    with suppress(AttributeError, OSError, TypeError):
        for option, size in KEPT_BYTES.items():
            ctypes.CDLL(None).mallopt(option, size)


def start_quietly(command: list[str]) -> None:
    """Start libsumo. Raises FatalTraCIError with what SUMO writes to stderr, which the library does
    not hand on."""
    with tempfile.TemporaryFile() as said:
        sys.stderr.flush()
        stderr = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            libsumo.start(command)
            failure = None
        except ERRORS as error:
            failure = error
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        said.seek(0)
        words = said.read().decode(errors="replace")
    if failure is None:
        with suppress(BrokenPipeError):  # perhaps nobody reads on
            sys.stderr.write(words)
        return
    lines = [
        line.removeprefix("Error: ") for line in words.splitlines() if line.startswith("Error: ")
    ]
    raise libsumo.FatalTraCIError(lines[0] if lines else one_line(failure))


def one_line(error: Exception) -> str:
    """Return the words of an error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
