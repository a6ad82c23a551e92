"""The SUMO session: at most one simulation per process.

Only this module and `departures` import libsumo.
"""

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
# By M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h: see _keep_freed.
KEPT_BYTES = {-1: 64 << 20, -3: 32 << 20}
GUI_OPTIONS = ("--start", "true", "--delay", "20")
ACTUATED = (
    libsumo.constants.TRAFFICLIGHT_TYPE_ACTUATED,
    libsumo.constants.TRAFFICLIGHT_TYPE_DELAYBASED,
)


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One phase of a signal programme.

    duration: (s)
    state: a character per link, of SUMO's G g y r u o O s
    """

    duration: float
    state: str


@dataclass(frozen=True, kw_only=True)
class Programme:
    """A signal programme.

    position: in its cycle when it was read (s)
    static: fixed-time, with the phases in order
    actuated: timed by detectors, and always in one of its phases
    id: among the programmes of the signal
    """

    signal: str
    phases: tuple[Phase, ...]
    position: float
    static: bool
    actuated: bool = False
    id: str = ""

    @property
    def cycle(self) -> float:
        """Duration of all phases (s)."""
        return sum(phase.duration for phase in self.phases)


class Session:
    """One running simulation.

    time: of the simulation (s)
    sumo_time: wall time inside SUMO's own step (s)
    command: command line of the same run
    flush: makes SUMO write its output buffers; None where that is not possible
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
        """Start the simulation.

        gui: in the window of sumo-gui
        Raises: RuntimeError if another session is open in this process, InputError if SUMO refuses
            to start
        """
        # A second libsumo.start would silently replace the first simulation.
        if Session._open:
            raise RuntimeError("a SUMO session is already open in this process; close it first")
        _keep_freed()
        self.sumo_time = 0.0
        self.step_length = step_length
        self.flush = _flush_all()
        self._gui = gui
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
        self.command = ["sumo"]
        for key, value in settings.items():
            self.command += [f"--{key}", str(value)]
        self.command += options
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
        self._lanes = cache(_lanes_of)
        self._bind()

    def _bind(self) -> None:
        """Bind SUMO's functions that need no translation.

        A Python call around them would cost as much as they do.
        """
        simulation = libsumo.simulation
        vehicle = libsumo.vehicle
        edge = libsumo.edge
        lane = libsumo.lane
        light = libsumo.trafficlight
        # Vehicles in the last step: read from files; inserted; ended as SUMO says, which tripinfo
        # may deny, without those that a program removed; taken off the road to be moved on; back on
        # the road, or gone for good.
        self.loaded = _compiled(simulation.getLoadedIDList)
        self.departed = _compiled(simulation.getDepartedIDList)
        self.arrived = _compiled(simulation.getArrivedIDList)
        self.started_teleport = _compiled(simulation.getStartingTeleportIDList)
        self.ended_teleport = _compiled(simulation.getEndingTeleportIDList)
        # Vehicles now: on the road, without teleporting ones, and their number; all that are loaded
        # and have not arrived; due to depart.
        self.running = _compiled(vehicle.getIDList)
        self.running_count = _compiled(vehicle.getIDCount)
        self.known = _compiled(vehicle.getLoadedIDList)
        self.pending = _compiled(simulation.getPendingVehicles)
        # One vehicle: edge, normal or internal; route; place on it; speed (m/s); time since it
        # stopped (s); length (m).
        self.road = _compiled(vehicle.getRoadID)
        self.route = _compiled(vehicle.getRoute)
        self.route_index = _compiled(vehicle.getRouteIndex)
        self.vehicle_speed = _compiled(vehicle.getSpeed)
        self.standing_time = _compiled(vehicle.getWaitingTime)
        self.vehicle_length = _compiled(vehicle.getLength)
        # One edge: its vehicles, their number, and of these under 0.1 m/s; mean speed (m/s). The
        # same of one lane.
        self.vehicles_on = _compiled(edge.getLastStepVehicleIDs)
        self.vehicle_count = _compiled(edge.getLastStepVehicleNumber)
        self.halting = _compiled(edge.getLastStepHaltingNumber)
        self._edge_speed = _compiled(edge.getLastStepMeanSpeed)
        self._on_lane = _compiled(lane.getLastStepVehicleIDs)
        self.lane_vehicles = _compiled(lane.getLastStepVehicleNumber)
        self._lane_speed = _compiled(lane.getLastStepMeanSpeed)
        # One loop detector: share of the last step in which a vehicle was on it (%).
        self.loop_occupancy = _compiled(libsumo.inductionloop.getLastStepOccupancy)
        # Signals: all of the network; state of one, a character per link; id of its programme; run
        # one of its own.
        self.signals = _compiled(light.getIDList)
        self.signal_state = _compiled(light.getRedYellowGreenState)
        self.programme_id = _compiled(light.getProgram)
        self.restart_programme = _compiled(light.setProgram)

    def close(self) -> None:
        """End the simulation, which completes SUMO's own outputs.

        A second call does nothing. libsumo cannot close a window, which stays until this process
        ends.
        """
        if Session._open:
            Session._open = False
            if not self._gui:
                libsumo.close()

    def step(self) -> None:
        """Advance by one simulation step.

        Raises: RunFailed with SUMO's words if it gives up
        """
        before = time.perf_counter()
        try:
            libsumo.simulationStep()
        except ERRORS as error:
            raise RunFailed(f"SUMO stopped at {self.time:g} s: {one_line(error)}") from None
        self.sumo_time += time.perf_counter() - before
        self.time = libsumo.simulation.getTime()

    def speeds(self, edge: str) -> tuple[float, float]:
        """Return the mean speed of vehicles on an edge, and SUMO's own (m/s).

        Both are the limit if the edge is empty. In SUMO's own, which is for routing, an empty lane
        counts as one vehicle at the limit. So a queue for one turn does not deter drivers with
        another lane.
        """
        routing = self._edge_speed(edge)
        lanes = self._lanes(edge)
        if len(lanes) == 1:
            return routing, routing
        vehicles = 0
        metres_per_second = 0.0
        for lane in lanes:
            count = self.lane_vehicles(lane)
            if count:
                vehicles += count
                metres_per_second += count * self._lane_speed(lane)
        if not vehicles:  # always in the mesoscopic model, which has no lanes
            return routing, routing
        return metres_per_second / vehicles, routing

    def teleports(self) -> int:
        """Return SUMO's own count of teleports so far.

        The mesoscopic model has no events for them.
        """
        return int(libsumo.simulation.getParameter("", "stats.teleports.total"))

    def is_free(self, vehicle: str) -> bool:
        """Return True if the driver may take another route.

        That is a driver of a private vehicle without stops.
        """
        return self.is_private(vehicle) and not libsumo.vehicle.getStops(vehicle, 1)

    def is_private(self, vehicle: str) -> bool:
        """Return False for vehicles that no controller commands."""
        kind = libsumo.vehicle.getVehicleClass(vehicle)
        return kind not in BOUND and not libsumo.vehicle.getLine(vehicle)

    def is_public(self, vehicle: str) -> bool:
        """Return True for public transport, by its class or because of a line."""
        kind = libsumo.vehicle.getVehicleClass(vehicle)
        return kind in PUBLIC or bool(libsumo.vehicle.getLine(vehicle))

    def departure(self, vehicle: str) -> tuple[float, float]:
        """Return time and delay of a departure (s).

        The time is now if the vehicle has not departed. The delay is below 0 if it is not due yet.
        """
        departed = libsumo.vehicle.getDeparture(vehicle)
        if departed < 0.0:
            departed = self.time
        return departed, libsumo.vehicle.getDepartDelay(vehicle)

    def place(self, vehicle: str) -> tuple[str, float]:
        """Return the lane of a vehicle, and the position on it (m)."""
        return libsumo.vehicle.getLaneID(vehicle), libsumo.vehicle.getLanePosition(vehicle)

    def lane(self, lane: str) -> tuple[float, frozenset[str]]:
        """Return the length of a lane (m), and the edges that it leads to."""
        onward = {libsumo.lane.getEdgeID(link[0]) for link in libsumo.lane.getLinks(lane)}
        return libsumo.lane.getLength(lane), frozenset(onward)

    def next_lanes(self, lane: str) -> list[str]:
        """Return the lanes that a lane leads to.

        Behind a lane on a junction there is one, which may lie on the junction, too.
        """
        return [link[0] for link in libsumo.lane.getLinks(lane)]

    def first_on(self, lane: str) -> str | None:
        """Return the vehicle nearest to the end of a lane, None without one."""
        vehicles = self._on_lane(lane)
        return vehicles[-1] if vehicles else None

    def room(self, lane: str) -> float:
        """Return the free length at the beginning of a lane (m)."""
        vehicle = libsumo.vehicle
        names = libsumo.lane.getLastStepVehicleIDs(lane)
        ends = [vehicle.getLanePosition(name) - vehicle.getLength(name) for name in names]
        return min(ends, default=libsumo.lane.getLength(lane))

    def set_down(self, vehicle: str, lane: str, position: float) -> bool:
        """Put a vehicle on a lane of its route; return False if SUMO refuses.

        position: on the lane (m)
        """
        return _accepted(libsumo.vehicle.moveTo, vehicle, lane, position)

    def fastest(self, edge: str, target: str) -> tuple[float, tuple[str, ...]]:
        """Return time (s) and edges of a car's fastest way on empty streets.

        There are no edges if there is no way.
        """
        try:
            stage = libsumo.simulation.findRoute(edge, target)
        except REFUSALS:  # the edge is closed to cars, such as a bus street
            return math.inf, ()
        return stage.travelTime, tuple(stage.edges)

    def set_route(self, vehicle: str, edges: list[str]) -> bool:
        """Give a vehicle on edges[0] a new route; return False if it is refused."""
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
        """Return the programme that runs on a signal now."""
        light = libsumo.trafficlight
        active = light.getProgram(signal)
        logic = self._logic(signal, active)
        until_switch = sum(phase.duration for phase in logic.phases[: light.getPhase(signal) + 1])
        in_order = not any(phase.next for phase in logic.phases)
        return Programme(
            signal=signal,
            id=active,
            phases=tuple(Phase(duration=p.duration, state=p.state) for p in logic.phases),
            position=until_switch - (light.getNextSwitch(signal) - libsumo.simulation.getTime()),
            static=logic.type == libsumo.constants.TRAFFICLIGHT_TYPE_STATIC and in_order,
            actuated=logic.type in ACTUATED,
        )

    def state_underneath(self, signal: str, programme: str) -> str:
        """Return the state that a programme would show if none had been set."""
        logic = self._logic(signal, programme)
        return logic.phases[logic.currentPhaseIndex].state

    def set_signal_state(self, signal: str, state: str) -> bool:
        """Set the state of a signal; return False if SUMO refuses it."""
        return _accepted(libsumo.trafficlight.setRedYellowGreenState, signal, state)

    def limit_speed(self, edge: str, limits: list[float]) -> list[float]:
        """Set the speed limits of an edge; return those before (m/s).

        limits: one per lane, or one for all (m/s)
        """
        lanes = self._lanes(edge)
        before = [libsumo.lane.getMaxSpeed(lane) for lane in lanes]
        if len(limits) == 1:
            limits = limits * len(lanes)
        for lane, limit in zip(lanes, limits, strict=True):
            libsumo.lane.setMaxSpeed(lane, limit)
        return before

    def _logic(self, signal: str, programme: str) -> Any:
        """Return a programme of a signal as SUMO's own object."""
        logics = libsumo.trafficlight.getAllProgramLogics(signal)
        return next(logic for logic in logics if logic.programID == programme)


def _compiled(function: Callable) -> Callable:
    """Return the compiled function that a function of libsumo calls."""
    name = function.__qualname__.replace(".", "_")
    return getattr(sys.modules["libsumo._libsumo"], name, function)


def _lanes_of(edge: str) -> tuple[str, ...]:
    """Return the lanes of an edge."""
    return tuple(f"{edge}_{n}" for n in range(libsumo.edge.getLaneNumber(edge)))


def _accepted(order: Callable, *arguments: object) -> bool:
    """Give an order to SUMO; return False if it refuses."""
    try:
        order(*arguments)
    except REFUSALS:
        return False
    return True


def _flush_all() -> Callable[[], None] | None:
    """Return OutputDevice::flushAll of SUMO; None where it is not found.

    It is not in SUMO's API, but has this name in the library on Linux and macOS.
    """
    try:
        library = ctypes.CDLL(sys.modules["libsumo._libsumo"].__file__)
        flush = library["_ZN12OutputDevice8flushAllEv"]
    except (AttributeError, KeyError, OSError):
        return None
    flush.argtypes = ()
    flush.restype = None
    return flush


def _keep_freed() -> None:
    """Make glibc keep freed memory.

    New pages took a sixth of the time of a guided run in Luxembourg.
    """
    with suppress(AttributeError, OSError, TypeError):
        for option, size in KEPT_BYTES.items():
            ctypes.CDLL(None).mallopt(option, size)


def start_quietly(command: list[str]) -> None:
    """Start libsumo.

    Raises: FatalTraCIError with what SUMO writes to stderr, which the library does not hand on
    """
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
    for line in words.splitlines():
        if line.startswith("Error: "):
            raise libsumo.FatalTraCIError(line.removeprefix("Error: "))
    raise libsumo.FatalTraCIError(one_line(failure))


def one_line(error: Exception) -> str:
    """Return the words of an error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
