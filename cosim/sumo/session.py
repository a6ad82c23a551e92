"""The SUMO session: the only file that imports libsumo. At most one simulation per process.

libsumo has no window: where one is asked for, sumo-gui runs beside this process and traci, which has libsumo's
functions, talks to it.
"""

import ctypes
import io
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path

import libsumo
import sumo
import traci
from sumolib.miscutils import getFreeSocketPort

from cosim.sumo.recorded_trips import BOUND
from cosim.sumo.xml_files import file_list
from nmfd.errors import InputError, RunFailed

REFUSALS = (libsumo.TraCIException, traci.TraCIException)  # of one order: the simulation goes on
FATAL = (libsumo.FatalTraCIError, traci.FatalTraCIError)
KEPT = {-1: 64 << 20, -3: 32 << 20}  # bytes, by M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h: see _keep_freed
LOST = (traci.FatalTraCIError, ConnectionError)  # what every order raises once the window was closed


@dataclass(frozen=True, kw_only=True)
class Window:
    """Run in sumo-gui: its command line options, and additional files to draw. program: of eclipse-sumo."""

    options: tuple[str, ...] = ()
    additional: tuple[Path, ...] = ()
    program: str = "sumo-gui"


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One phase of a signal programme: duration [s] and one character per link (SUMO's G g y r u o O s)."""

    duration: float
    state: str


@dataclass(frozen=True, kw_only=True)
class Programme:
    """A signal programme. id: of those of the signal; position [s]: where in its cycle it was when it was read; static:
    fixed-time, one phase after the other; actuated: timed by detectors, and what it shows is one of its phases."""

    signal: str
    phases: tuple[Phase, ...]
    position: float
    static: bool
    actuated: bool = False
    id: str = ""

    @property
    def cycle(self) -> float:
        """[s]"""
        return sum(phase.duration for phase in self.phases)


class Session:
    """One running simulation.

    libsumo holds a single simulation per process and a second start would silently replace the first: here it is an
    error. `sumo_time` [s] is the wall time spent inside SUMO's own step; `command` is the command line of the same run.
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
        window: Window | None = None,
    ):
        """Raises RuntimeError if another session is open in this process, InputError if SUMO refuses to start."""
        if Session._open:
            raise RuntimeError("a SUMO session is already open in this process; close it first")
        _keep_freed()
        self.sumo_time, self.step_length = 0.0, step_length
        routes = file_list([route_file] if isinstance(route_file, Path) else route_file)
        self.command = [
            "sumo",
            "--net-file",
            str(net_file),
            "--route-files",
            routes,
            "--seed",
            str(seed),
            "--step-length",
            str(step_length),
            "--time-to-teleport",
            str(time_to_teleport),
            "--collision.action",
            collision_action,
            "--no-step-log",
            "true",
            "--no-warnings",
            "true",
            "--duration-log.disable",
            "true",
            *options,
        ]
        self._sumo = sumo = libsumo if window is None else traci
        try:
            if window is None:
                _start_quietly(self.command)
            else:
                _start(window, self.command)
        except (*REFUSALS, *FATAL) as error:
            if window is not None:
                raise InputError(
                    f"{window.program} cannot show {net_file}: {_one_line(error)}; check DISPLAY, or use `cosim run` "
                    "and `cosim report`"
                ) from None
            raise InputError(f"{net_file}: SUMO cannot run it with {routes}: {_one_line(error)}") from None
        Session._open = True
        self._flush = _flush_all() if window is None else None
        self.time = sumo.simulation.getTime()
        # Asked so often that a Python call around them would cost as much as SUMO's answer:
        # road(vehicle), the edge it is on, normal or internal; route(vehicle), its edges.
        self.road, self.route = sumo.vehicle.getRoadID, sumo.vehicle.getRoute
        # Edges: the vehicles on one, their number, and of these under 0.1 m/s.
        self.vehicles_on, self.vehicle_count = sumo.edge.getLastStepVehicleIDs, sumo.edge.getLastStepVehicleNumber
        self.halting = sumo.edge.getLastStepHaltingNumber
        self._lanes_of: dict[str, tuple[str, ...]] = {}  # of edges that were asked for
        # Lanes: the same, for max-pressure control, which asks for a thousand of them every few seconds.
        self.lane_vehicles = sumo.lane.getLastStepVehicleNumber
        self.lane_halting = sumo.lane.getLastStepHaltingNumber
        # Loop detectors: the share of the last step in which a vehicle was on one [%].
        self.loop_occupancy = sumo.inductionloop.getLastStepOccupancy

    def speeds(self, edge: str) -> tuple[float, float]:
        """Two mean speeds [m/s] of an edge, both the limit where nobody is: that of its vehicles, and that which SUMO's
        own routing goes by. There an empty lane counts as one vehicle at the limit, so that a queue before one turn
        does not keep away who has another lane to himself.
        """
        routing = self._sumo.edge.getLastStepMeanSpeed(edge)
        lanes = self._lanes_of.get(edge)
        if lanes is None:
            lanes = tuple(f"{edge}_{n}" for n in range(self._sumo.edge.getLaneNumber(edge)))
            self._lanes_of[edge] = lanes
        if len(lanes) > 1:
            counts = [self._sumo.lane.getLastStepVehicleNumber(lane) for lane in lanes]
            if total := sum(counts):  # the mesoscopic model knows no lanes, and counts none
                speed = self._sumo.lane.getLastStepMeanSpeed
                return sum(n * speed(lane) for n, lane in zip(counts, lanes, strict=True) if n) / total, routing
        return routing, routing

    def close(self) -> None:
        """End the simulation, which completes SUMO's own outputs; a second time it does nothing."""
        if Session._open:
            Session._open = False
            with suppress(*LOST):  # the window may be gone
                self._sumo.close()

    def step(self) -> None:
        """Advance by one simulation step. RunFailed, with its own words, if SUMO gives up."""
        before = time.perf_counter()
        try:
            self._sumo.simulationStep()
        except (libsumo.FatalTraCIError, *REFUSALS) as error:
            raise RunFailed(f"SUMO stopped at {self.time:g} s: {_one_line(error)}") from None
        self.sumo_time += time.perf_counter() - before
        self.time = self._sumo.simulation.getTime()

    def flush(self) -> bool:
        """Have SUMO write what it keeps in memory of its output files; False where nobody can ask it to."""
        if self._flush is not None:
            self._flush()
        return self._flush is not None

    # Vehicles: what happened in the last step.

    def loaded(self) -> tuple[str, ...]:
        """Read from the route files, to depart then or later."""
        return self._sumo.simulation.getLoadedIDList()

    def departed(self) -> tuple[str, ...]:
        """Inserted into the network."""
        return self._sumo.simulation.getDepartedIDList()

    def arrived(self) -> tuple[str, ...]:
        """At the end of their trips or, as their tripinfo tells, not: calibrators, collisions and teleports beyond the
        end remove vehicles, too. Those that a program removes (TraCI) are not among them."""
        return self._sumo.simulation.getArrivedIDList()

    def started_teleport(self) -> tuple[str, ...]:
        """Taken off the road, to be moved on."""
        return self._sumo.simulation.getStartingTeleportIDList()

    def ended_teleport(self) -> tuple[str, ...]:
        """Back on the road, or gone for good."""
        return self._sumo.simulation.getEndingTeleportIDList()

    # Vehicles: the present state.

    def running(self) -> tuple[str, ...]:
        """On the road; teleporting ones are not."""
        return self._sumo.vehicle.getIDList()

    def teleports(self) -> int:
        """How many there were so far, by SUMO's own count: the mesoscopic model has no events for them."""
        return int(self._sumo.simulation.getParameter("", "stats.teleports.total"))

    def known(self) -> tuple[str, ...]:
        """All that were loaded and have not arrived, wherever they are."""
        return self._sumo.vehicle.getLoadedIDList()

    def pending(self) -> tuple[str, ...]:
        """Due to depart, but not yet inserted: the backlog."""
        return self._sumo.simulation.getPendingVehicles()

    def is_free(self, vehicle: str) -> bool:
        """Whether its driver may choose another way: no public transport, and nothing to do on the way."""
        return (
            self._sumo.vehicle.getVehicleClass(vehicle) not in BOUND
            and not self._sumo.vehicle.getLine(vehicle)
            and not self._sumo.vehicle.getStops(vehicle, 1)
        )

    def route_index(self, vehicle: str) -> int:
        """Where on its route a vehicle is."""
        return self._sumo.vehicle.getRouteIndex(vehicle)

    def place(self, vehicle: str) -> tuple[str, float]:
        """The lane that a vehicle is on, and where on it [m]."""
        return self._sumo.vehicle.getLaneID(vehicle), self._sumo.vehicle.getLanePosition(vehicle)

    def standing_time(self, vehicle: str) -> float:
        """Since when a vehicle has not moved [s]."""
        return self._sumo.vehicle.getWaitingTime(vehicle)

    def lane(self, lane: str) -> tuple[float, frozenset[str]]:
        """Length [m] of a lane, and the edges that it leads to."""
        onward = {self._sumo.lane.getEdgeID(link[0]) for link in self._sumo.lane.getLinks(lane)}
        return self._sumo.lane.getLength(lane), frozenset(onward)

    def vehicle_length(self, vehicle: str) -> float:
        """[m]"""
        return self._sumo.vehicle.getLength(vehicle)

    def next_lane(self, lane: str) -> str:
        """What a lane on a junction leads to: a lane of the street behind it, or another one on the junction."""
        return self._sumo.lane.getLinks(lane)[0][0]

    def room(self, lane: str) -> float:
        """How much of a lane is free at its beginning [m]."""
        rear = [
            self._sumo.vehicle.getLanePosition(vehicle) - self._sumo.vehicle.getLength(vehicle)
            for vehicle in self._sumo.lane.getLastStepVehicleIDs(lane)
        ]
        return min(rear, default=self._sumo.lane.getLength(lane))

    def set_down(self, vehicle: str, lane: str, position: float) -> bool:
        """Put a vehicle at `position` [m] on a lane of its route; False where SUMO does not."""
        try:
            self._sumo.vehicle.moveTo(vehicle, lane, position)
        except REFUSALS:
            return False
        return True

    def fastest(self, edge: str, target: str) -> tuple[float, tuple[str, ...]]:
        """The fastest way of a car from one edge to another on empty streets: how long it takes [s], and its edges, ()
        where there is none."""
        found = self._sumo.simulation.findRoute(edge, target)
        return found.travelTime, tuple(found.edges)

    def emission_class(self, vehicle_type: str) -> str:
        """Of SUMO's emission model, as HBEFA4/PC_petrol_Euro-4."""
        return self._sumo.vehicletype.getEmissionClass(vehicle_type)

    def set_route(self, vehicle: str, edges: list[str]) -> bool:
        """Give a vehicle on edges[0] a new route; False where SUMO refuses it (the old route then stays)."""
        try:
            self._sumo.vehicle.setRoute(vehicle, edges)
        except REFUSALS:
            return False
        return True

    def begin_trip(self, order: Mapping[str, str]) -> None:
        """Let a vehicle depart now. order: arguments of libsumo.vehicle.add, with a route that SUMO knows."""
        self._sumo.vehicle.add(**order, depart="now")

    def reroutes(self, vehicle: str) -> bool:
        """Whether it has SUMO's rerouting device."""
        return self._sumo.vehicle.getParameter(vehicle, "has.rerouting.device") == "true"

    # Signals.

    def programme(self, signal: str) -> Programme:
        """The programme that runs on `signal` now."""
        active, types = self._sumo.trafficlight.getProgram(signal), self._sumo.constants
        for logic in self._sumo.trafficlight.getAllProgramLogics(signal):
            if logic.programID == active:
                elapsed = sum(p.duration for p in logic.phases[: self._sumo.trafficlight.getPhase(signal) + 1])
                left = self._sumo.trafficlight.getNextSwitch(signal) - self._sumo.simulation.getTime()
                return Programme(
                    signal=signal,
                    id=active,
                    phases=tuple(Phase(duration=p.duration, state=p.state) for p in logic.phases),
                    position=elapsed - left,
                    static=logic.type == types.TRAFFICLIGHT_TYPE_STATIC
                    and not any(phase.next for phase in logic.phases),
                    actuated=logic.type in (types.TRAFFICLIGHT_TYPE_ACTUATED, types.TRAFFICLIGHT_TYPE_DELAYBASED),
                )
        raise RuntimeError(f"signal {signal} has no programme {active}")

    def signals(self) -> tuple[str, ...]:
        """All of the network."""
        return self._sumo.trafficlight.getIDList()

    def signal_state(self, signal: str) -> str:
        """What it shows now, a character per link."""
        return self._sumo.trafficlight.getRedYellowGreenState(signal)

    def state_underneath(self, signal: str, programme: str) -> str:
        """What a programme of `signal` would show, were it not for the states that were set: it runs on."""
        for logic in self._sumo.trafficlight.getAllProgramLogics(signal):
            if logic.programID == programme:
                return logic.phases[logic.currentPhaseIndex].state
        raise RuntimeError(f"signal {signal} has no programme {programme}")

    def set_signal_state(self, signal: str, state: str) -> bool:
        """False where SUMO does not take it."""
        try:
            self._sumo.trafficlight.setRedYellowGreenState(signal, state)
        except REFUSALS:
            return False
        return True

    # Incidents.

    def programme_id(self, signal: str) -> str:
        """Of the programme that runs on `signal` now."""
        return self._sumo.trafficlight.getProgram(signal)

    def restart_programme(self, signal: str, programme: str) -> None:
        """Let a signal run one of its own programmes again."""
        self._sumo.trafficlight.setProgram(signal, programme)

    def limit_speed(self, edge: str, limits: list[float]) -> list[float]:
        """Set the speed limits [m/s] of the lanes of an edge, one for each or one for all; those before."""
        lanes = [f"{edge}_{n}" for n in range(self._sumo.edge.getLaneNumber(edge))]
        before = [self._sumo.lane.getMaxSpeed(lane) for lane in lanes]
        for lane, limit in zip(lanes, limits * len(lanes) if len(limits) == 1 else limits, strict=True):
            self._sumo.lane.setMaxSpeed(lane, limit)
        return before

    # What is drawn in the window.

    def paint(self, colours: Mapping[str, tuple[int, int, int]]) -> None:
        """Give points of interest, by id, a colour (red, green, blue)."""
        for mark, colour in colours.items():
            self._sumo.poi.setColor(mark, (*colour, 255))


def _flush_all() -> Callable[[], None] | None:
    """OutputDevice::flushAll of SUMO, which neither libsumo nor TraCI hand on: by the name that it has in the library,
    where the compiler gives it this name (Linux, macOS)."""
    try:
        flush = ctypes.CDLL(libsumo._libsumo.__file__)["_ZN12OutputDevice8flushAllEv"]
    except (AttributeError, OSError):
        return None
    flush.argtypes, flush.restype = (), None
    return flush


def _keep_freed() -> None:
    """Have glibc keep the memory that is freed for whoever asks next. By itself it gives blocks of more than 0.1 MB
    back to the system at once, and SUMO and the searches for ways take and free such blocks thousands of times a
    second: every time they were new pages, for a sixth of the time of a guided run in Luxembourg. Other C libraries
    are left alone."""
    with suppress(AttributeError, OSError, TypeError):
        for option, size in KEPT.items():
            ctypes.CDLL(None).mallopt(option, size)


def _start_quietly(command: list[str]) -> None:
    """libsumo.start. Raises FatalTraCIError with what SUMO says: it tells stderr what is wrong, not the caller."""
    with tempfile.TemporaryFile() as said:
        sys.stderr.flush()
        stderr = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            libsumo.start(command)
            failure = None
        except (*REFUSALS, *FATAL) as error:
            failure = error
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        said.seek(0)
        words = said.read().decode(errors="replace")
    if failure is None:
        sys.stderr.write(words)
        return
    lines = [line.removeprefix("Error: ") for line in words.splitlines() if line.startswith("Error: ")]
    raise libsumo.FatalTraCIError(lines[0] if lines else _one_line(failure))


def _start(window: Window, command: list[str]) -> None:
    """As libsumo.start, with `window`. Raises FatalTraCIError with what the program has said."""
    program = str(Path(sumo.SUMO_HOME) / "bin" / window.program)
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as said:
        port = getFreeSocketPort()
        process = subprocess.Popen(
            [program, *command[1:], *window.options, "--remote-port", str(port)], stdout=said, stderr=said
        )
        try:
            with redirect_stdout(io.StringIO()):  # traci prints every attempt to connect
                traci.init(port, numRetries=600, proc=process)  # one a second, while it reads its files
        except BaseException as error:
            process.kill()
            process.wait()
            if not isinstance(error, (*REFUSALS, *FATAL)):
                raise
            said.seek(0)
            words = [line for line in said.read().splitlines() if line.strip()]
            raise traci.FatalTraCIError(words[-1] if words else _one_line(error)) from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
