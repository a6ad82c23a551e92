"""Start of SUMO for one run: vehicles, additional files and command line."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from cosim.plant.detectors import Layout, write_loops
from cosim.plant.programmes import write_actuated, write_optimised
from cosim.plant.settings import ACTUATED, ESTIMATE, WEBSTER, Settings, own_files
from cosim.sumo import outputs
from cosim.sumo import recorded_trips as recorded
from cosim.sumo.net import City
from cosim.sumo.recorded_trips import HeldTrips, RecordedTrips, as_recorded
from cosim.sumo.session import Session
from cosim.sumo.signals import Signal
from cosim.sumo.trips import PLANNING_SEEDS, make_trips, turning_flows
from cosim.sumo.xml_files import file_list
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario

# Equipped drivers take the fastest route by the mean speeds of the last 180 s: at the departure,
# for which their route must be read no earlier, and every minute from then on.
REROUTING = [
    "--route-steps",
    "1",
    "--device.rerouting.pre-period",
    "60",
    "--device.rerouting.period",
    "60",
    "--device.rerouting.adaptation-interval",
    "1",
    "--device.rerouting.adaptation-steps",
    "180",
]
GIVEN = ("step-length", "time-to-teleport", "collision.action")  # arguments of Session


def own_vehicles(scenario: Scenario, settings: Settings, city: City) -> RecordedTrips:
    """Return the recorded trips of the city. Raises InputError."""
    originals = recorded.read_recorded_trips(own_files(scenario, settings.routes))
    recorded.check_edges(originals, city, f"{scenario.where}: sumo.routes")
    return originals


class Launch:
    """Starts SUMO for one run after the other, with files in a temporary folder that `close`
    removes.

    vehicles: ids of those of the last run; held: its trips under metering
    trip_file, emission_file: SUMO's tripinfo output, and its emissions by edge at the end of the
        run
    """

    def __init__(
        self,
        scenario: Scenario,
        settings: Settings,
        city: City,
        signals: tuple[list[Signal], list[str]],
        layout: Layout,
        *,
        trip_file: Path | None,
        gui: bool,
    ):
        """layout: of the loop detectors; trip_file: of SUMO's tripinfo, to be kept; gui: in the
        window of sumo-gui"""
        self._scenario, self._settings, self._city, self._signals = (
            scenario,
            settings,
            city,
            signals,
        )
        self._layout, self._kept, self._gui = layout, trip_file is not None, gui
        self._temporary = tempfile.TemporaryDirectory(prefix="cosim-", ignore_cleanup_errors=True)
        self._folder = Path(self._temporary.name)
        self.vehicles: list[str] = []
        self.held: HeldTrips | None = None
        self.trip_file = trip_file or self._folder / "tripinfo.xml"
        self.emission_file = self._folder / "emissions.xml"

    def start(self, seed: int) -> Session:
        """Return a simulation whose trips, drivers and reroutes follow from `seed`."""
        settings, routes = self._settings, self._folder / "trips.rou.xml"
        self.vehicles = self._write_vehicles(routes, seed)
        beside = own_files(self._scenario, settings.background)
        files = [routes, *beside]
        if settings.routes:
            files = recorded.run_files(routes, beside, seed)
        return Session(
            self._city.net_file,
            files,
            seed=seed,
            step_length=settings.step_length,
            time_to_teleport=settings.time_to_teleport,
            collision_action=settings.options.get("collision.action", "warn"),
            options=tuple(self._options()),
            gui=self._gui,
        )

    def turning_flows(self) -> Mapping[tuple[str, str], float]:
        """Return (edge, next edge) -> flow [veh/s] of the vehicles."""
        if not self._settings.routes:
            return turning_flows(self._city, self._scenario.demand, self._scenario.step)
        return recorded.own_flows(
            self._city, self._recorded, self._shared_routes, self._scenario.demand_factor
        )

    def close(self) -> None:
        self._temporary.cleanup()

    def _options(self) -> list[str]:
        settings = self._settings
        options = [
            *outputs.options(self.trip_file, detailed=self._kept, drawn=settings.rerouting > 0.0),
            "--begin",
            str(settings.begin),
        ]
        options += ["--ignore-route-errors", str(bool(settings.routes)).lower()]
        if settings.rerouting > 0:
            options += [*REROUTING, "--device.rerouting.probability", str(settings.rerouting)]
        more = (recorded.MESOSCOPIC if settings.mesoscopic else {}) | settings.options
        for key, value in more.items():
            if f"--{key}" not in options and key not in GIVEN:
                options += [f"--{key}", value]
        return [*options, "--additional-files", file_list(self._additional())]

    def _additional(self) -> list[Path]:
        """Return the additional files in SUMO's order of reading: the last programme of a signal
        runs."""
        scenario, settings, folder = self._scenario, self._settings, self._folder
        steered, others = self._signals
        additional = own_files(scenario, settings.additional)
        if settings.signals == WEBSTER:
            additional += write_optimised(folder, self._city, others, self._planning_trips())
        if settings.signals == ACTUATED:
            additional.append(folder / "actuated.add.xml")
            write_actuated(additional[-1], steered)
        if settings.measurement == ESTIMATE:
            additional.append(folder / "loops.add.xml")
            write_loops(self._city, self._layout, scenario.step, additional[-1])
        additional.append(folder / "emissions.add.xml")
        outputs.write_emission_data(additional[-1], self.emission_file.resolve())
        return additional

    def _write_vehicles(self, path: Path, seed: int) -> list[str]:
        """Write the route file of one run, and return the ids of its vehicles."""
        scenario, settings, originals = self._scenario, self._settings, self._vehicles_of(seed)
        factor, begin = (scenario.demand_factor, settings.begin) if settings.routes else (1.0, 0.0)
        jitter = recorded.JITTER_S if settings.routes and seed else 0.0
        drawn = recorded.draw(originals, seed=seed, factor=factor, jitter=jitter, begin=begin)
        if settings.metering > 0.0:
            self.held = recorded.write_held_trips(
                originals, drawn, path, self._shared_routes, self._city.region_of
            )
            if settings.routes and not self.held.orders:
                some = f"those without stops, via edges and attributes other than {', '.join(recorded.ORDERED)}"
                none = "none of the vehicles in sumo.routes can wait: only"
                raise InputError(f"{scenario.where}: sumo.metering: {none} {some} can; omit it")
        else:
            recorded.write_recorded_trips(originals, drawn, path)
        return [name for _, _, name in drawn]

    def _vehicles_of(self, seed: int) -> RecordedTrips:
        """Return the recorded trips, or trips that are made from the demand by `seed`."""
        if self._settings.routes:
            return self._recorded
        return as_recorded(make_trips(self._city, self._scenario.demand, self._scenario.step, seed))

    @cached_property
    def beside(self) -> frozenset[str]:
        """Ids of the vehicles and flows of the city's files outside the demand."""
        settings = self._settings
        files = own_files(self._scenario, (*settings.background, *settings.additional))
        return recorded.ids(files)

    @cached_property
    def _recorded(self) -> RecordedTrips:
        return own_vehicles(self._scenario, self._settings, self._city)

    @cached_property
    def _shared_routes(self) -> Mapping[str, tuple[str, ...]]:
        return recorded.read_routes(own_files(self._scenario, self._settings.additional))

    def _planning_trips(self) -> Iterator[tuple[float, Sequence[str]]]:
        """Yield departure [s] and edges of the trips that Webster's plan is made for."""
        originals = self._vehicles_of(PLANNING_SEEDS[0])
        for depart, element in zip(originals.depart.tolist(), originals.elements, strict=True):
            edges, driven = recorded.edges_of(element, self._shared_routes)
            if driven:
                yield depart, edges
