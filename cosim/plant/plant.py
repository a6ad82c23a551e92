"""The SUMO city as a plant."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cosim.plant.actuation import Actuation
from cosim.plant.detectors import READING_PERIOD_S, Estimation, instruments, lay_out, probes
from cosim.plant.incidents import Incidents
from cosim.plant.launch import Launch
from cosim.plant.meter import Event, Meter
from cosim.plant.metering import Metering
from cosim.plant.programmes import city_signals, scenario_city
from cosim.plant.record import Recorder
from cosim.plant.sampling import SAMPLE_PERIOD_S, StreetMeans, StreetSampler
from cosim.plant.settings import ESTIMATE, Settings, check_lanes
from cosim.plant.settings import settings as settings_of
from cosim.plant.stuck import Junctions
from cosim.plant.waits import Waits
from cosim.sumo.arrays import PerEdge
from cosim.sumo.net import City, check_adjacency
from cosim.sumo.outputs import TripReader, edge_emissions, edge_traffic
from cosim.sumo.session import Session
from cosim.sumo.signals import read_files
from nmfd.arrays import Arrays
from nmfd.model.planning import PlanningModel, planning_model
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Observation, State

if TYPE_CHECKING:  # loads a compiler, which takes 0.4 s and 100 MB
    from cosim.plant.guidance import Guide

# Keeps the random numbers of the guided drivers apart from others of the same seed.
GUIDANCE = 0x67756964


class Observer:
    """Callbacks during a run.

    They block the simulation; an exception aborts it.
    """

    def began(self, city: City, state: State) -> None:
        """Take the initial state."""

    def sampled(self, time: float, vehicles: PerEdge, speed: PerEdge) -> None:
        """Take a sample every few seconds.

        time: SUMO's [s]; vehicles: (E,) [veh]; speed: (E,) [m/s], mean
        """

    def recorded(self, controls: Controls, state: State, row: Mapping[str, np.ndarray]) -> None:
        """Take controls, new state and row of the record of an interval."""


class _Unguided:
    """Guidance of a run without commands to drivers so far."""

    led_on = 0

    def __init__(self, regions: int):
        self.realised = np.zeros((regions,) * 3, dtype=int)

    def command(self, *_: object) -> None:
        """Let all drivers keep their routes."""

    def apply(self, events: list[Event]) -> None:
        """Guide nobody."""


class SumoPlant:
    """A SUMO simulation of the scenario's city (nmfd.types.Plant).

    city: its edges, regions and gateways; steered, other_signals: see programmes.city_signals
    meter, actuation: of the run; after `trip_facts` all trips have their whole time losses
    """

    guides_by_prices = True

    def __init__(
        self,
        scenario: Scenario,
        *,
        settings: Settings | None = None,
        trip_file: Path | None = None,
        gui: bool = False,
        planning: PlanningModel | None = None,
        observer: Observer | None = None,
        guides: bool | None = None,
    ):
        """Build the network if need be.

        settings: instead of the table [sumo]
        trip_file: for SUMO's tripinfo, complete after `trip_facts`
        gui: show the run in sumo-gui
        planning: model of the controller and the estimator, whose nominal split ratios stand for
            drivers without a command; that of the scenario if None
        guides: True: get ready for commands to drivers at the reset, instead of at the first one;
            False: there are none, and times over junctions are not measured
        Raises InputError for a city that does not fit the scenario's network or the settings.
        """
        self._scenario = scenario
        self._planning = planning or planning_model(scenario)
        self._observer = observer or Observer()
        self._guides = guides
        settings = settings or settings_of(scenario)
        self._settings = settings
        check_lanes(scenario, settings)
        self.city: City = scenario_city(scenario, settings)
        check_adjacency(self.city, scenario.network)
        self._layout = lay_out(self.city, settings.detector_share)
        self._instruments = instruments(self.city, self._layout, settings.probe_share)
        signals = city_signals(self.city, scenario, settings)
        self.steered, self.other_signals = signals
        self._launch = Launch(
            scenario, settings, self.city, signals, self._layout, trip_file=trip_file, gui=gui
        )
        self._session: Session | None = None

    def reset(self, seed: int) -> State:
        """Start a simulation whose trips, drivers and reroutes follow from `seed`."""
        self._end_session()
        scenario = self._scenario
        settings = self._settings
        city = self.city
        session = self._launch.start(seed)
        self._k = 0
        self._session = session
        self._trips = TripReader(self._launch.trip_file, session.flush or (lambda: None))
        self._incidents = Incidents(scenario.ordered_faults, session, city)
        self._metering = None
        if self._launch.held is not None:
            self._metering = Metering(
                session,
                self._launch.held,
                self._planning.network.critical,
                level=settings.metering,
                step=scenario.step,
            )
        estimated = settings.measurement == ESTIMATE
        known = probes(self._launch.vehicles, settings.probe_share if estimated else 0.0, seed)
        trips = self._trips if session.flush else None
        meter = Meter(
            session,
            city,
            known,
            trips,
            self._metering,
            demand=frozenset(self._launch.vehicles),
            beside=self._launch.beside,
        )
        self.meter = meter
        self._estimation = None
        if estimated:
            self._estimation = Estimation(
                session, city, self._layout, meter, self._instruments, self._planning
            )
        self._sampler = StreetSampler(
            session, city, known if estimated else None, turns=self._guides is not False
        )
        self._streets: StreetMeans | None = None
        self._seed = seed
        self._guide: Guide | _Unguided = _Unguided(city.regions)
        if self._guides:
            self._guide = self._new_guide()
        flows = self._launch.turning_flows() if settings.signals_from_outside else None
        self.actuation = Actuation(
            session,
            city,
            scenario.network,
            scenario.step,
            settings,
            self.steered,
            self._incidents,
            flows,
        )
        self._junctions = None
        self._waits = None
        if not settings.mesoscopic:  # that model has no lanes
            self._junctions = Junctions(session, city)
            self._waits = Waits(session, read_files(city.net_file).links, self.actuation.states)
        self._state = meter.state(0, 0.0)
        self._recorder = Recorder(meter, lambda: self._guide.realised, self.actuation)
        self._observer.began(city, self._state)
        return self._state

    def step(self, controls: Controls) -> State:
        """Simulate one control interval, and record it.

        In every simulation step: actuate, simulate, measure and guide.
        """
        session = self.session
        scenario = self._scenario
        steps = round(scenario.step / session.step_length)
        reading = self._period(READING_PERIOD_S, steps)
        sampling = self._period(SAMPLE_PERIOD_S, steps)
        self._incidents.begin(self._k)
        self.actuation.command(controls.perimeter, self._sampler.last[0])
        self._command_guide(controls)
        if self._metering:
            self._metering.command(controls.metering, self._state.accumulation.sum(axis=1))
        if self._junctions:
            self._junctions.free()
        for n in range(1, steps + 1):
            self.actuation.play()
            if self._metering:
                self._metering.play()
            session.step()
            self.actuation.observe(self._waits)
            events = self.meter.observe()
            if self._estimation and n % reading == 0:
                self._estimation.sample()
            if n % sampling == 0:
                self._sampler.sample()
                if self._waits:
                    self._waits.sample()
                if n < steps:
                    self.actuation.update(self._sampler.last[0])
                self._observer.sampled(session.time, *self._sampler.last)
            self._guide.apply(events)
        self._k += 1
        state = self.meter.state(self._k, self._k * scenario.step)
        streets = self._sampler.finish(self._incidents.closed)
        self._streets = streets
        realised = self.actuation.realised()
        if self._estimation:
            acted = controls
            if realised is not None:
                acted = replace(controls, perimeter=realised)
            self._estimation.update(acted)
        self._state = replace(state, problem=self._incidents.problem(), realised=realised)
        row = self._recorder.add(streets)
        self._observer.recorded(controls, self._state, row)
        return self._state

    def observe(self) -> Observation | None:
        """Return the estimate; None if the exact state is measured."""
        if self._estimation is None:
            return None
        return Observation(
            step=self._k,
            time=self._state.time,
            accumulation=self._estimation.accumulation,
            backlog=self._estimation.backlog(),
            realised=self._state.realised,
        )

    def close(self) -> None:
        """End the simulation and remove its files."""
        self._end_session()
        self._launch.close()

    def record(self) -> Arrays:
        """Return the arrays of cosim.plant.record.RECORD since the reset."""
        return self._recorder.record()

    def facts(self) -> dict[str, float]:
        """Return scalar facts of the run so far, by columns of its table."""
        return {
            "sumo_time_s": self.session.sumo_time,
            "signals_left_alone": len(self.other_signals),
            "freed_veh": 0 if self._junctions is None else self._junctions.freed,
            "led_on_veh": self._guide.led_on,
            **self.actuation.pressure_facts(),
        }

    def longest_waits(self) -> dict[str, float]:
        """Return signal -> longest wait of a driver at red so far [s]."""
        return self._waits.longest() if self._waits else {}

    def trip_facts(self) -> dict[str, float]:
        """End the simulation, close the books, and return emissions [kg].

        Raises LedgerError if SUMO's tripinfo differs from the books.
        """
        followed = self.session.flush is not None
        self._end_session()
        if followed:
            self.meter.close_books()
        else:
            self._trips.finish()
        self._recorder.close()
        self._emissions = edge_emissions(self._launch.emission_file)
        co2, fuel = np.array([(0.0, 0.0), *self._emissions.values()]).sum(axis=0).tolist()
        return {"co2_kg": co2, "fuel_kg": fuel}

    def edge_totals(self) -> Arrays:
        """Return the arrays of cosim.plant.record.TOTALS over edges.

        Call it after `trip_facts`.
        """
        emitted = {edge: co2 for edge, (co2, _) in self._emissions.items()}
        co2 = {edge: emitted.get(edge, 0.0) for edge in self.city.edges}
        for (_, edge), turn in self.city.over.items():
            co2[edge] += sum(emitted.get(inside, 0.0) for inside in turn)
        traffic = edge_traffic(self._launch.traffic_file)
        pairs = [traffic.get(edge, (0.0, 0.0)) for edge in self.city.edges]
        time_loss, passed = np.array(pairs, np.float32).T
        return {
            "co2": np.array([*co2.values()], np.float32),
            "queue_max": self._sampler.longest_queue.astype(np.int32),
            "time_loss": time_loss,
            "passed": passed,
        }

    @property
    def session(self) -> Session:
        """Return the running simulation.

        Raises RuntimeError before the first reset and after the end.
        """
        if self._session is None:
            raise RuntimeError("no simulation is running; call reset(seed) first")
        return self._session

    def _command_guide(self, controls: Controls) -> None:
        """Command the drivers, if there is a command."""
        splits = self._splits(controls)
        if splits is not None and isinstance(self._guide, _Unguided):
            self._guide = self._new_guide()
        self._guide.command(splits, self._streets, controls.prices)

    def _new_guide(self) -> "Guide":
        from cosim.plant.guidance import Guide

        settings = self._settings
        return Guide(
            self.session,
            self.city,
            self._planning.network.nominal_splits,
            compliance=settings.compliance,
            planned=self._launch.planned,
            ways_return=settings.ways_return,
            period=settings.guidance_period,
            lanes=not settings.mesoscopic,
            turn_late=not settings.signals_from_outside,
            random=np.random.default_rng([self._seed, GUIDANCE]),
        )

    def _period(self, seconds: float, steps: int) -> int:
        """Return a period in simulation steps, from 1 to `steps`."""
        return min(max(1, round(seconds / self.session.step_length)), steps)

    def _splits(self, controls: Controls) -> np.ndarray | None:
        """Return the split ratios of the guidance.

        They are the nominal ones for guidance by travel times.
        """
        by_travel_times = controls.splits is None and self._settings.guided
        if controls.prices is not None or by_travel_times:
            return self._planning.network.nominal_splits
        return controls.splits

    def _end_session(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
