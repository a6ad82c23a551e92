"""The SUMO session: the only file that imports libsumo. At most one simulation per process."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import libsumo

from cosim.originals import BOUND
from nmfd.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One phase of a signal programme: duration [s] and one character per link (SUMO's G g y r u o O s)."""

    duration: float
    state: str


@dataclass(frozen=True, kw_only=True)
class Programme:
    """A signal programme. position [s]: where in its cycle it was when it was read; static: fixed-time."""

    signal: str
    phases: tuple[Phase, ...]
    position: float
    static: bool

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
        self, net_file: Path, route_file: Path | Sequence[Path], *, seed: int, step_length: float = 1.0,
        time_to_teleport: float = -1.0, collision_action: str = "warn", options: tuple[str, ...] = (),
    ):
        """Raises RuntimeError if another session is open in this process, InputError if SUMO refuses to start."""
        if Session._open:
            raise RuntimeError("a SUMO session is already open in this process; close it first")
        self.sumo_time, self.step_length = 0.0, step_length
        routes = ",".join(map(str, [route_file] if isinstance(route_file, Path) else route_file))
        self.command = [
            "sumo", "--net-file", str(net_file), "--route-files", routes, "--seed", str(seed),
            "--step-length", str(step_length), "--time-to-teleport", str(time_to_teleport), "--collision.action",
            collision_action, "--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true",
            *options]
        try:
            libsumo.start(self.command)
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            raise InputError(f"{net_file}: SUMO cannot run it with {routes}: {_one_line(error)}") from None
        Session._open = True
        self.time = libsumo.simulation.getTime()

    def close(self) -> None:
        if Session._open:
            Session._open = False
            libsumo.close()

    def step(self) -> None:
        """Advance by one simulation step."""
        before = time.perf_counter()
        try:
            libsumo.simulationStep()
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            raise RuntimeError(f"SUMO stopped at {self.time:g} s: {_one_line(error)}") from None
        self.sumo_time += time.perf_counter() - before
        self.time = libsumo.simulation.getTime()

    # Vehicles: what happened in the last step.

    def loaded(self) -> tuple[str, ...]:
        return libsumo.simulation.getLoadedIDList()

    def departed(self) -> tuple[str, ...]:
        return libsumo.simulation.getDepartedIDList()

    def arrived(self) -> tuple[str, ...]:
        return libsumo.simulation.getArrivedIDList()

    def started_teleport(self) -> tuple[str, ...]:
        return libsumo.simulation.getStartingTeleportIDList()

    def ended_teleport(self) -> tuple[str, ...]:
        return libsumo.simulation.getEndingTeleportIDList()

    # Vehicles: the present state.

    def running(self) -> tuple[str, ...]:
        """On the road; teleporting ones are not."""
        return libsumo.vehicle.getIDList()

    def teleports(self) -> int:
        """How many there were so far, by SUMO's own count: the mesoscopic model has no events for them."""
        return int(libsumo.simulation.getParameter("", "stats.teleports.total"))

    def known(self) -> tuple[str, ...]:
        """All that were loaded and have not arrived, wherever they are."""
        return libsumo.vehicle.getLoadedIDList()

    def pending(self) -> tuple[str, ...]:
        """Due to depart, but not yet inserted: the backlog."""
        return libsumo.simulation.getPendingVehicles()

    # Asked so often that a Python call around them would cost as much as SUMO's answer:
    # road(vehicle), the edge it is on, normal or internal; route(vehicle), its edges.
    road = staticmethod(libsumo.vehicle.getRoadID)
    route = staticmethod(libsumo.vehicle.getRoute)

    def is_free(self, vehicle: str) -> bool:
        """Whether its driver may choose another way: no public transport, and nothing to do on the way."""
        return (
            libsumo.vehicle.getVehicleClass(vehicle) not in BOUND and not libsumo.vehicle.getLine(vehicle)
            and not libsumo.vehicle.getStops(vehicle, 1))

    def route_index(self, vehicle: str) -> int:
        """Where on its route a vehicle is."""
        return libsumo.vehicle.getRouteIndex(vehicle)

    def emission_class(self, vehicle_type: str) -> str:
        return libsumo.vehicletype.getEmissionClass(vehicle_type)

    def set_route(self, vehicle: str, edges: list[str]) -> bool:
        """Give a vehicle on edges[0] a new route; False where SUMO refuses it (the old route then stays)."""
        try:
            libsumo.vehicle.setRoute(vehicle, edges)
        except libsumo.TraCIException:
            return False
        return True

    def reroutes(self, vehicle: str) -> bool:
        """Whether it has SUMO's rerouting device."""
        return libsumo.vehicle.getParameter(vehicle, "has.rerouting.device") == "true"

    # Edges: the vehicles on one and their number, mean speed [m/s] (the limit if empty), vehicles under 0.1 m/s.
    vehicles_on = staticmethod(libsumo.edge.getLastStepVehicleIDs)
    vehicle_count = staticmethod(libsumo.edge.getLastStepVehicleNumber)
    mean_speed = staticmethod(libsumo.edge.getLastStepMeanSpeed)
    halting = staticmethod(libsumo.edge.getLastStepHaltingNumber)

    # Lanes: the same, for max-pressure control, which asks for a thousand of them every few seconds.
    lane_vehicles = staticmethod(libsumo.lane.getLastStepVehicleNumber)
    lane_halting = staticmethod(libsumo.lane.getLastStepHaltingNumber)

    # Loop detectors: the share of the last step in which a vehicle was on one [%].
    loop_occupancy = staticmethod(libsumo.inductionloop.getLastStepOccupancy)

    # Signals.

    def programme(self, signal: str) -> Programme:
        """The programme that runs on `signal` now."""
        active = libsumo.trafficlight.getProgram(signal)
        for logic in libsumo.trafficlight.getAllProgramLogics(signal):
            if logic.programID == active:
                elapsed = sum(p.duration for p in logic.phases[:libsumo.trafficlight.getPhase(signal) + 1])
                left = libsumo.trafficlight.getNextSwitch(signal) - libsumo.simulation.getTime()
                return Programme(
                    signal=signal, phases=tuple(Phase(duration=p.duration, state=p.state) for p in logic.phases),
                    position=elapsed - left,
                    static=logic.type == libsumo.constants.TRAFFICLIGHT_TYPE_STATIC)
        raise RuntimeError(f"signal {signal} has no programme {active}")

    def signals(self) -> tuple[str, ...]:
        return libsumo.trafficlight.getIDList()

    def signal_state(self, signal: str) -> str:
        return libsumo.trafficlight.getRedYellowGreenState(signal)

    def set_signal_state(self, signal: str, state: str) -> None:
        libsumo.trafficlight.setRedYellowGreenState(signal, state)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
