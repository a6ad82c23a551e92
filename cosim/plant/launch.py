"""What SUMO is started with: the vehicles of a run, the files beside them, and the command line."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path

from cosim.plant.detectors import Layout, write_loops
from cosim.plant.programmes import CitySignals, write_signal_programmes
from cosim.plant.settings import ESTIMATE, Settings, scenario_file
from cosim.sumo import outputs
from cosim.sumo.net import City
from cosim.sumo.recorded_trips import (
    MESOSCOPIC,
    ORDERED,
    RecordedTrips,
    check_edges,
    draw,
    edges_of,
    read_recorded_trips,
    read_routes,
    write_held_trips,
    write_recorded_trips,
)
from cosim.sumo.session import Session, Window
from cosim.sumo.tripinfo import trip_options
from cosim.sumo.trips import HeldTrips, held, make_trips, write_trips
from cosim.sumo.turning_flows import PLANNING_SEEDS, own_flows, turning_flows
from cosim.sumo.xml_files import file_list
from nmfd.errors import InputError
from nmfd.model.scenario import Scenario

# Equipped drivers take the fastest route by the mean speeds of the last 180 s (SUMO's default): when they depart, which
# needs their route to be read no earlier, and every minute from then on, as drivers with navigation do.
REROUTING = (
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
)


def own_vehicles(scenario: Scenario, chosen: Settings, city: City) -> RecordedTrips:
    """The vehicles of the route files that [sumo] names. Raises InputError."""
    originals = read_recorded_trips(own_files(scenario, chosen.routes))
    check_edges(originals, city, f"{scenario_file(scenario)}: sumo.routes")
    return originals


def own_files(scenario: Scenario, names: Sequence[str]) -> list[Path]:
    """Files of [sumo] beside scenario.toml; none of a scenario without a folder."""
    return [scenario.folder / name for name in names] if scenario.folder is not None else []


class Launch:
    """Starts SUMO for one run after the other, in a scratch folder that `close` removes.

    vehicles: ids of those of the last run; held: those of them that are metered; trip_file: what SUMO tells of them
    when it ends
    """

    def __init__(
        self,
        scenario: Scenario,
        chosen: Settings,
        city: City,
        signals: CitySignals,
        layout: Layout,
        *,
        outputs: Mapping[str, Path],
        window: Window | None,
    ):
        """outputs: kind (cosim.sumo.outputs) -> file; layout: of the loops, if states are estimated"""
        self._scenario, self._settings, self._city, self._signals = scenario, chosen, city, signals
        self._layout, self._outputs, self._window = layout, outputs, window
        self._scratch = tempfile.TemporaryDirectory(prefix="cosim-", ignore_cleanup_errors=True)
        self._folder = Path(self._scratch.name)
        self._originals: RecordedTrips | None = None
        self.vehicles: list[str] = []
        self.held: HeldTrips | None = None
        self.trip_file = outputs.get("tripinfo", self._folder / "tripinfo.xml")

    def start(self, seed: int) -> Session:
        """A simulation whose trips, drivers and reroutes all follow from `seed`."""
        scenario, chosen = self._scenario, self._settings
        routes = self._folder / "trips.rou.xml"
        self.vehicles = self._write_vehicles(routes, seed)
        return Session(
            self._city.net_file,
            [routes, *own_files(scenario, chosen.background)],
            seed=seed,
            step_length=chosen.step_length,
            time_to_teleport=chosen.time_to_teleport,
            collision_action=chosen.collision_action,
            options=tuple(self._options()),
            window=self._window,
        )

    def turning_flows(self) -> Mapping[tuple[str, str], float]:
        """(edge, next edge) -> flow [veh/s] of the vehicles of a run; of those of the city itself after a `start`."""
        flows = self._own_flows()
        return turning_flows(self._city, self._scenario.demand, self._scenario.step) if flows is None else flows

    def close(self) -> None:
        """Remove the scratch folder."""
        self._scratch.cleanup()

    def _options(self) -> list[str]:
        """SUMO's, besides those that every session has."""
        chosen = self._settings
        options = [
            *trip_options(self.trip_file),
            *outputs.options(self._outputs),
            "--begin",
            str(chosen.begin),
            "--ignore-route-errors",
            str(bool(chosen.routes)).lower(),
        ]
        if chosen.rerouting > 0:
            options += [*REROUTING, "--device.rerouting.probability", str(chosen.rerouting)]
        if chosen.mesoscopic:
            options += MESOSCOPIC
        if additional := self._additional():
            options += ["--additional-files", file_list(additional)]
        return options

    def _additional(self) -> list[Path]:
        """SUMO's additional files, in the order in which it reads them: of several programmes the last one runs."""
        scenario, chosen, folder = self._scenario, self._settings, self._folder
        files = own_files(scenario, chosen.additional)
        files += write_signal_programmes(folder, self._city, scenario, chosen, self._signals, self._planning_trips())
        if chosen.measurement == ESTIMATE:
            files.append(folder / "loops.add.xml")
            write_loops(self._city, self._layout, scenario.step, files[-1])
        files += self._window.additional if self._window else ()
        if "edgedata" in self._outputs:
            files.append(outputs.write_edge_data(folder / "edgedata.add.xml", self._outputs["edgedata"], scenario.step))
        return files

    def _write_vehicles(self, path: Path, seed: int) -> list[str]:
        """The route file of one run; the ids of its vehicles."""
        scenario, chosen = self._scenario, self._settings
        if not chosen.routes:
            trips = write_trips(self._city, scenario.demand, scenario.step, seed, path, metered=chosen.metering)
            self.held = held(trips) if chosen.metering else None
            return [f"v{n}" for n in range(len(trips.routes))]
        if self._originals is None:
            self._originals = own_vehicles(scenario, chosen, self._city)
        drawn = draw(
            self._originals,
            seed=seed,
            factor=scenario.demand_factor,
            jitter=chosen.departure_jitter,
            begin=chosen.begin,
        )
        if chosen.metering:
            self.held = write_held_trips(self._originals, drawn, path, self._shared_routes, self._city.region_of)
            if not self.held.orders:
                raise InputError(
                    f"{scenario_file(scenario)}: sumo.metering: none of the vehicles in sumo.routes can be made to "
                    "wait: those can that have neither stops nor edges to go by, and no attributes but "
                    f"{', '.join(ORDERED)}; omit it"
                )
        else:
            write_recorded_trips(self._originals, drawn, path)
        return [name for _, _, name in drawn]

    @cached_property
    def _shared_routes(self) -> Mapping[str, tuple[str, ...]]:
        return read_routes(own_files(self._scenario, self._settings.additional))

    def _planning_trips(self) -> Iterator[tuple[float, Sequence[str]]]:
        """Yield departure [s] and edges of the trips that Webster's plan is made for."""
        if self._originals is None:
            trips = make_trips(self._city, self._scenario.demand, self._scenario.step, PLANNING_SEEDS[0])
            yield from zip(trips.depart.tolist(), trips.routes, strict=True)
        else:
            for depart, element in zip(self._originals.depart.tolist(), self._originals.elements, strict=True):
                edges, driven = edges_of(element, self._shared_routes)
                if driven:
                    yield depart, edges

    def _own_flows(self) -> Mapping[tuple[str, str], float] | None:
        """Turning flows of the city's own vehicles; None where trips are drawn from the scenario's demand."""
        if self._originals is None:
            return None
        return own_flows(self._city, self._originals, self._shared_routes, self._scenario.demand_factor)
