"""Start of SUMO for one run: vehicles, additional files and command line."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path

from cosim.plant.detectors import Layout, write_loops
from cosim.plant.programmes import write_actuated, write_optimised
from cosim.plant.settings import ACTUATED, ESTIMATE, WEBSTER, Settings, own_files
from cosim.sumo import outputs
from cosim.sumo import recorded_trips as recorded
from cosim.sumo.net import City
from cosim.sumo.recorded_trips import DrawnTrip, HeldTrips, RecordedTrips, as_recorded
from cosim.sumo.route_plan import PlannedTrips, ends_of, planned_trips, read_plan
from cosim.sumo.session import Session
from cosim.sumo.signals import Signal
from cosim.sumo.trips import PLANNING_SEEDS, make_trips, turning_flows
from cosim.sumo.xml_files import file_list
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario
from nmfd.runs.files import temporary_folder

# Equipped drivers take the fastest route by the mean speeds of the last 180 s: at the departure,
# for which their route must be read no earlier, and every minute from then on.
REROUTING = {
    "route-steps": "1",
    "device.rerouting.pre-period": "60",
    "device.rerouting.period": "60",
    "device.rerouting.adaptation-interval": "1",
    "device.rerouting.adaptation-steps": "180",
}
GIVEN = ("step-length", "time-to-teleport", "collision.action")  # arguments of Session


def vehicles_of(scenario: Scenario, settings: Settings, city: City, seed: int) -> RecordedTrips:
    """Return the recorded trips, or trips made from the demand by `seed`.

    Raises: InputError
    """
    if settings.routes:
        return own_vehicles(scenario, settings, city)
    return as_recorded(make_trips(city, scenario.demand, scenario.step, seed))


def own_vehicles(scenario: Scenario, settings: Settings, city: City) -> RecordedTrips:
    """Return the recorded trips of the city. Raises InputError."""
    originals = recorded.read_recorded_trips(own_files(scenario, settings.routes))
    recorded.check_edges(originals, city, f"{scenario.where}: sumo.routes")
    return originals


def drawn_vehicles(
    scenario: Scenario, settings: Settings, originals: RecordedTrips, seed: int
) -> list[DrawnTrip]:
    """Return departure, number and id of the vehicles of one run.

    originals: recorded trips, or trips made from the demand by `seed`
    """
    factor = 1.0
    begin = 0.0
    jitter = 0.0
    if settings.routes:
        factor = scenario.demand_factor
        begin = settings.begin
        jitter = recorded.JITTER_S if seed else 0.0
    return recorded.draw(originals, seed=seed, factor=factor, jitter=jitter, begin=begin)


class Launch:
    """Start of SUMO for one run after the other.

    Files are in a temporary folder, which `close` removes.

    vehicles: ids of those of the last run; held: its trips under metering
    planned: ids of its vehicles for which a plan has routes
    trip_file: SUMO's tripinfo output; emission_file, traffic_file: by edge, at the end of the run
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
        """layout: loop detectors to install

        trip_file: where to keep SUMO's tripinfo
        gui: show the run in sumo-gui
        """
        self._scenario = scenario
        self._settings = settings
        self._city = city
        self._signals = signals
        self._layout = layout
        self._kept = trip_file is not None
        self._gui = gui
        self._temporary = ExitStack()
        self._folder = self._temporary.enter_context(temporary_folder())
        self.vehicles: list[str] = []
        self.held: HeldTrips | None = None
        self.planned: frozenset[str] = frozenset()
        self.trip_file = trip_file or self._folder / "tripinfo.xml"
        self.emission_file = self._folder / "emissions.xml"
        self.traffic_file = self._folder / "traffic.xml"

    def start(self, seed: int) -> Session:
        """Return a simulation in which everything random follows from `seed`."""
        settings = self._settings
        routes = self._folder / "trips.rou.xml"
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
        self._temporary.close()

    def _options(self) -> list[str]:
        """Return SUMO's options, as on its command line."""
        settings = self._settings
        options = outputs.options(self.trip_file, detailed=self._kept, drawn=settings.rerouting > 0)
        chosen = {
            "begin": str(settings.begin),
            "ignore-route-errors": str(bool(settings.routes)).lower(),
        }
        if settings.rerouting > 0:
            chosen |= REROUTING
            chosen["device.rerouting.probability"] = str(settings.rerouting)
        others = dict(settings.options)
        if settings.mesoscopic:
            others = recorded.MESOSCOPIC | others
        if settings.mesoscopic == "ltm":
            others["meso-ltm"] = "true"
        for key, value in others.items():
            if f"--{key}" not in options and key not in GIVEN:
                chosen.setdefault(key, value)
        for key, value in chosen.items():
            options += [f"--{key}", value]
        return [*options, "--additional-files", file_list(self._additional())]

    def _additional(self) -> list[Path]:
        """Return the additional files in the order in which SUMO reads them.

        The last programme of a signal runs.
        """
        scenario = self._scenario
        settings = self._settings
        folder = self._folder
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
        additional.append(folder / "edges.add.xml")
        files = self.emission_file.resolve(), self.traffic_file.resolve()
        outputs.write_edge_outputs(additional[-1], *files)
        return additional

    def _write_vehicles(self, path: Path, seed: int) -> list[str]:
        """Write the route file of one run, and return the ids of its vehicles."""
        scenario = self._scenario
        settings = self._settings
        originals = self._vehicles_of(seed)
        drawn = drawn_vehicles(scenario, settings, originals, seed)
        if settings.planned:
            trips = self._planned(originals, drawn, seed)
            originals = trips.originals
            drawn = trips.drawn
            self.planned = trips.planned
        if settings.metering > 0.0:
            self.held = recorded.write_held_trips(
                originals, drawn, path, self._shared_routes, self._city.region_of
            )
            if settings.routes and not self.held.orders:
                raise InputError(
                    f"{scenario.where}: sumo.metering: none of the vehicles in sumo.routes "
                    "can wait: only those without stops, via edges and attributes other than "
                    f"{', '.join(recorded.ORDERED)} can; omit it"
                )
        else:
            recorded.write_recorded_trips(originals, drawn, path)
        return [name for _, _, name in drawn]

    def _planned(
        self, originals: RecordedTrips, drawn: Sequence[DrawnTrip], seed: int
    ) -> PlannedTrips:
        """Return the vehicles of one run with planned routes. Raises InputError."""
        settings = self._settings
        where = f"{self._scenario.where}: sumo.planned"
        plan = read_plan(own_files(self._scenario, settings.planned), self._city)
        if not settings.routes:
            plan.add_parts(ends_of(element, self._shared_routes) for element in originals.elements)
        trips = planned_trips(
            plan,
            originals,
            drawn,
            self._shared_routes,
            seed=seed,
            compliance=settings.compliance,
        )
        if not trips.planned:
            raise InputError(
                f"{where}: no trip begins and ends on edges of a route of the plan; make "
                "the plan with cosim plan, or omit it"
            )
        return trips

    def _vehicles_of(self, seed: int) -> RecordedTrips:
        """Return the trips of one run; those of the city itself are read once."""
        if self._settings.routes:
            return self._recorded
        return vehicles_of(self._scenario, self._settings, self._city, seed)

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
        """Yield departure [s] and edges of the trips for Webster's plan."""
        originals = self._vehicles_of(PLANNING_SEEDS[0])
        for depart, element in zip(originals.depart.tolist(), originals.elements, strict=True):
            edges, driven = recorded.edges_of(element, self._shared_routes)
            if driven:
                yield depart, edges
