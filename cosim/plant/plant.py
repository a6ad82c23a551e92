"""The SUMO city as a plant: the same protocol as the regional plants, the same controllers."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.plant.actuation import Actuation
from cosim.plant.detectors import instruments, lay_out, probes
from cosim.plant.feasible import check_settings, signals_of
from cosim.plant.guidance import Guide
from cosim.plant.incidents import Incidents
from cosim.plant.junctions import Junctions
from cosim.plant.launch import Launch
from cosim.plant.meter import Meter
from cosim.plant.metering import Metering
from cosim.plant.observer import Observer
from cosim.plant.record import Record, Recorder
from cosim.plant.sensing import Estimation, Sensing
from cosim.plant.settings import ESTIMATE, PRESSURES, Settings, settings
from cosim.sumo.arrays import PerEdge, Points
from cosim.sumo.net import City, Gateway, check_adjacency, city_of, edge_shapes
from cosim.sumo.session import Session, Window
from cosim.sumo.tripinfo import TripFacts, TripReader
from nmfd.arrays import PerRegion, PerTurn, Positions
from nmfd.model.planning import PlanningModel, planning_model
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Observation, State

GUIDANCE = 0x67756964  # keeps the random numbers of the guided drivers apart from others of the same seed


class SumoPlant:
    """A SUMO simulation of the scenario's city (nmfd.types.Plant).

    `simple_signals` may get another programme, `other_signals` are left alone (cosim.sumo.signals).
    `record()` tells what happened; `trips` is their number; `sumo_time` [s] is the wall time inside SUMO's own step
    since the reset.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        overrides: Settings | None = None,
        outputs: Mapping[str, Path] | None = None,
        window: Window | None = None,
        planning: PlanningModel | None = None,
        observer: Observer | None = None,
    ):
        """Builds the network if need be. Raises InputError for a city that does not fit the scenario's network.

        outputs: kind (cosim.sumo.outputs) -> file, of SUMO's own outputs; complete after `trip_facts` or `close`
        window: to watch; the simulation is the same, only slower
        planning: what states are estimated with; of the scenario itself, if None
        observer: is shown the run while it goes on, which stays the same
        """
        self._scenario, self._planning = scenario, planning or planning_model(scenario)
        self._observer = observer
        self._settings = chosen = overrides or settings(scenario)
        check_settings(scenario, chosen)
        self.city: City = city_of(scenario.network)
        check_adjacency(self.city, scenario.network)
        self._layout = lay_out(self.city, chosen.detector_share)
        self._instruments = instruments(self.city, self._layout, chosen.probe_share)
        self._signals = signals_of(self.city, scenario, chosen)
        self.simple_signals, self.other_signals = self._signals.simple, self._signals.others
        self._launch = Launch(
            scenario, chosen, self.city, self._signals, self._layout, outputs=dict(outputs or {}), window=window
        )
        self._session: Session | None = None

    def reset(self, seed: int) -> State:
        """Trips, drivers and reroutes all follow from `seed`."""
        self._end_session()
        self._k, self._session = 0, self._launch.start(seed)
        self._trips = TripReader(self._launch.trip_file, self.session.flush)
        self._incidents = Incidents(self._scenario.ordered_faults, self.session, self.city)
        self._metering = self._new_metering()
        self._sensing = self._new_sensing(seed)
        self._guide = self._new_guide(seed)
        self._actuation = self._new_actuation()
        self._junctions = None if self._settings.mesoscopic else Junctions(self.session, self.city)
        self._state = state = self._sensing.state(0)
        self._facts = TripFacts()
        self._recorder = Recorder(self._sensing.meter, self._guide, self._actuation)
        if self._observer:
            self._observer.began(self.city, state)
        return state

    def step(self, controls: Controls) -> State:
        """One control interval: in every simulation step actuate, simulate, measure and guide; then record."""
        state = self._drive(controls)
        if self._observer:
            self._observer.recorded(controls, state, self._recorder.last)
        return state

    def _drive(self, controls: Controls) -> State:
        session, streets = self.session, self._sensing.streets
        end = session.time + self._scenario.step
        vehicles = None if streets is None else streets.vehicles
        self._incidents.begin(self._k)
        self._actuation.command(controls.perimeter, vehicles)
        self._guide.command(self._splits(controls), streets, controls.prices)
        if self._metering:
            self._metering.command(controls.metering, self._state.accumulation.sum(axis=1))
        self._sensing.begin()
        if self._junctions:
            self._junctions.free()
        for _ in range(round(self._scenario.step / session.step_length)):
            self._actuation.play()
            if self._metering:
                self._metering.play()
            session.step()
            entered = self._sensing.measure()
            self._guide.apply(entered)
        assert abs(session.time - end) < 1e-6
        self._k += 1
        self._state, means = self._sensing.finish(self._k, controls)
        self._recorder.add(means)
        return self._state

    def observe(self) -> Observation | None:
        """The estimate, where states are estimated."""
        return self._sensing.observation(self._k)

    def close(self) -> None:
        """End the simulation and remove the scratch folder."""
        self._end_session()
        self._launch.close()

    def record(self) -> Record:
        """Of all control intervals since the reset."""
        return self._recorder.record()

    def trip_facts(self) -> TripFacts:
        """Ends the simulation, for only then does SUMO tell of the trips under way, and closes the books. LedgerError
        if they are not SUMO's."""
        if self._session is not None:
            self._end_session()
            self._sensing.meter.close_books()
            self._recorder.close()
            self._facts = self._with_held(self._trips.facts)
        return self._facts

    def time_loss(self) -> PerRegion:
        """(R,) [s]: lost on the road against driving freely until the end, by the region where trips began. After
        `trip_facts`."""
        return self._sensing.meter.time_loss

    def map(self) -> tuple[Positions, list[Points]]:
        """Where the regions are (R, 2), and the streets, E lines (n, 2) [m]."""
        shapes = edge_shapes(self.city)
        middles = np.array([shape.mean(axis=0) for shape in shapes])
        region = np.array([self.city.region_of[edge] for edge in self.city.edges])
        return np.stack([middles[region == r].mean(axis=0) for r in range(self.city.regions)]), shapes

    def density(self) -> PerEdge:
        """(E,) [veh/km and lane] on average over the control interval that has ended; 0 before."""
        lane_km = np.array([self.city.length[edge] * self.city.lanes[edge] for edge in self.city.edges]) / 1000.0
        return self._recorder.last["edge_vehicles"] / lane_km if self._k else np.zeros(len(lane_km))

    @property
    def sumo_time(self) -> float:
        """[s] of wall time inside SUMO's own step since the reset."""
        return self.session.sumo_time

    @property
    def session(self) -> Session:
        """The running simulation. Raises RuntimeError before the first reset and after the end."""
        if self._session is None:
            raise RuntimeError("no simulation is running; call reset(seed) first")
        return self._session

    def pressure_facts(self) -> dict[str, float]:
        """What can be said of a run under max-pressure (max_pressure.FACTS); NaN of others."""
        return self._actuation.pressure_facts()

    def helped(self) -> dict[str, int]:
        """Vehicles that SUMO would have let stand for ever: columns of sumo.csv."""
        return {"freed_veh": 0 if self._junctions is None else self._junctions.freed, "led_on_veh": self._guide.led_on}

    def leaks(self) -> list[Gateway]:
        """Gateways that no signal under perimeter control has: it does not reach them."""
        return self._actuation.leaks()

    @property
    def trips(self) -> int:
        """Vehicles of the run: those drawn from the demand, or of a city's own those that were due so far."""
        if not self._settings.routes:
            return len(self._launch.vehicles)
        meter = self._sensing.meter
        return int(meter.departures.sum() + meter.backlog().sum() + meter.given_up.sum())

    def _with_held(self, facts: TripFacts) -> TripFacts:
        """And those who were made to wait, of which SUMO does not know."""
        if self._metering is None:
            return facts
        held, waiting = self._metering.waiting()
        return replace(
            facts, trips=facts.trips + held, departure_delay=facts.departure_delay + self._metering.waited + waiting
        )

    def _splits(self, controls: Controls) -> PerTurn | None:
        """What drivers are guided by: their own split ratios mean guidance by travel times alone; where there are
        prices, these bring the split ratios about."""
        guided = controls.splits is None and self._settings.guided
        return self._scenario.network.nominal_splits if guided or controls.prices is not None else controls.splits

    def _new_metering(self) -> Metering | None:
        chosen, network, trips = self._settings, self._planning.network, self._launch.held
        if trips is None:
            return None
        return Metering(self.session, trips, network.critical, level=chosen.metering_level, step=self._scenario.step)

    def _new_sensing(self, seed: int) -> Sensing:
        chosen = self._settings
        if chosen.measurement != ESTIMATE:
            meter, estimation = Meter(self.session, self.city, trips=self._trips, metering=self._metering), None
        else:
            known = probes(self._launch.vehicles, chosen.probe_share, seed)
            meter = Meter(self.session, self.city, known, self._trips, self._metering)
            estimation = Estimation(self.session, self.city, self._layout, meter, self._instruments, self._planning)
        return Sensing(self._scenario, self.session, self.city, self._incidents, meter, estimation, self._observer)

    def _new_guide(self, seed: int) -> Guide:
        chosen = self._settings
        return Guide(
            self.session,
            self.city,
            self._scenario.network.nominal_splits,
            compliance=chosen.compliance,
            most_detour=chosen.most_detour,
            ways_return=chosen.ways_return,
            period=chosen.guidance_period,
            lanes=not chosen.mesoscopic,
            turn_late=chosen.signals not in PRESSURES,
            random=np.random.default_rng([seed, GUIDANCE]),
        )

    def _new_actuation(self) -> Actuation:
        flows = self._launch.turning_flows() if self._settings.signals in PRESSURES else None
        return Actuation(self.session, self.city, self._scenario, self._settings, self._signals, self._incidents, flows)

    def _end_session(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
