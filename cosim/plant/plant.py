"""The SUMO city as a plant: the same protocol as the regional plants, the same controllers."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.plant import webster
from cosim.plant.actuated import actuated_row
from cosim.plant.detectors import EVERY, Detectors, instruments, lay_out, probes, write_loops
from cosim.plant.guidance import Guide
from cosim.plant.incidents import Incidents
from cosim.plant.max_pressure import MaxPressure
from cosim.plant.meter import Meter
from cosim.plant.perimeter import GREEN, Actuator, GatewaySignal
from cosim.plant.record import Record
from cosim.plant.settings import ESTIMATE, Settings, settings
from cosim.plant.strategy import ACTUATED, FIXED, MAX_PRESSURE, WEBSTER
from cosim.sumo import outputs as sumo_output
from cosim.sumo.build import ensure_built
from cosim.sumo.net import City, Gateway, check_adjacency, gateway_movements, gateway_room_taken, load_city
from cosim.sumo.recorded_trips import MESOSCOPIC, Originals, check_edges, read_originals, read_routes, write_originals
from cosim.sumo.session import Session, Window
from cosim.sumo.signals import Signal, read_signals, write_programmes
from cosim.sumo.tripinfo import TripFacts, read_trip_facts, trip_options
from cosim.sumo.trips import write_trips
from cosim.sumo.turning_flows import own_flows, turning_flows
from cosim.sumo.xml_files import file_list
from nmfd.errors import InputError
from nmfd.model.estimation import Estimator
from nmfd.model.planning import PlanningModel, planning_model
from nmfd.model.scenario import Scenario
from nmfd.runs.scratch import Scratch
from nmfd.types import Controls, Observation, State

SAMPLE_EVERY = 10.0  # s, between two samples of the production and of the queues
# Equipped drivers take the fastest route by the mean speeds of the last 180 s (SUMO's default): when they depart, which
# needs their route to be read no earlier, and every minute from then on, as drivers with navigation do.
REROUTING = (
    "--route-steps", "1", "--device.rerouting.pre-period", "60", "--device.rerouting.period", "60",
    "--device.rerouting.adaptation-interval", "1", "--device.rerouting.adaptation-steps", "180")


def own_vehicles(scenario: Scenario, chosen: Settings, city: City) -> Originals:
    """The vehicles of the route files that [sumo] names. Raises InputError."""
    originals = read_originals([scenario.folder / name for name in chosen.routes])
    check_edges(originals, city, f"{scenario.folder / 'scenario.toml'}: sumo.routes")
    return originals


class SumoPlant:
    """A SUMO simulation of the scenario's city (nmfd.types.Plant).

    `simple_signals` may get another programme, `other_signals` are left alone (cosim.sumo.signals).
    `record()` tells what happened; `trips` is their number; `sumo_time` [s] is the wall time inside SUMO's own step
    since the reset.
    """

    def __init__(
        self, scenario: Scenario, *, overrides: Settings | None = None, outputs: Mapping[str, Path] | None = None,
        window: Window | None = None, planning: PlanningModel | None = None,
    ):
        """Builds the network if need be. Raises InputError for a city that does not fit the scenario's network.

        outputs: kind (cosim.sumo.outputs) -> file, of SUMO's own outputs; complete after `trip_facts` or `close`
        window: to watch; the simulation is the same, only slower
        planning: what states are estimated with; of the scenario itself, if None
        """
        self._scenario, self._window, self._planning = scenario, window, planning or planning_model(scenario)
        self._originals: Originals | None = None
        self._outputs = dict(outputs or {})
        self._settings = overrides or settings(scenario)
        _check_mesoscopic(scenario, self._settings)
        files = ensure_built(scenario.network)
        self.city: City = load_city(files.net_file, files.regions_csv, scenario.network.regions)
        check_adjacency(self.city, scenario.network)
        self._edge_region = np.array([self.city.region_of[edge] for edge in self.city.edges])
        self._number = {edge: n for n, edge in enumerate(self.city.edges)}
        self._upstream = sorted({g.from_edge for g in self.city.gateways})
        self._upstream_of = np.array([self._upstream.index(g.from_edge) for g in self.city.gateways], dtype=int)
        self._net_file = files.net_file
        self._layout = lay_out(self.city, self._settings.detector_share)
        self._instruments = instruments(self.city, self._layout, self._settings.probe_share)
        simple, others = read_signals(self.city, self._additional())
        left = set(self._settings.leave_signals)
        self.simple_signals = [signal for signal in simple if signal.id not in left]
        self.other_signals = sorted({*others, *(signal.id for signal in simple if signal.id in left)})
        if self._settings.signals != FIXED and not self.simple_signals:
            raise InputError(
                f"{files.net_file}: sumo.signals: {self._settings.signals} needs fixed-time signals with several green "
                f"phases, but none of the {len(self.other_signals)} signals here is one; choose fixed")
        self._gateway_ids = {gateway.signal for gateway in self.city.gateways if gateway.signal is not None}
        self._folder = Scratch("cosim-")
        self._session: Session | None = None

    def reset(self, seed: int) -> State:
        """Trips, drivers and reroutes all follow from `seed`."""
        self._end_session()
        scenario, chosen = self._scenario, self._settings
        routes = self._folder.path / "trips.rou.xml"
        self._vehicles, files = self._write_vehicles(routes, seed), [routes]
        self._trip_file = self._outputs.get("tripinfo", routes.with_name("tripinfo.xml"))
        steered = [s for s in self.simple_signals if not (
            chosen.gateways_fixed and chosen.signals == ACTUATED and s.id in self._gateway_ids)]
        options = [
            *trip_options(self._trip_file), *sumo_output.options(self._outputs), "--begin", str(chosen.begin),
            "--ignore-route-errors", str(bool(chosen.routes)).lower()]
        if chosen.rerouting > 0:
            options += [*REROUTING, "--device.rerouting.probability", str(chosen.rerouting)]
        if chosen.mesoscopic:
            options += MESOSCOPIC
        additional = self._signal_plan(steered)
        if scenario.folder is not None:
            files += [scenario.folder / name for name in chosen.background]
            additional = self._additional() + additional
        estimating = chosen.measurement == ESTIMATE
        if estimating:
            loops = self._folder.path / "loops.add.xml"
            write_loops(self.city, self._layout, scenario.step, loops)
            additional.append(loops)
        additional += self._window.additional if self._window else ()
        if "edgedata" in self._outputs:
            additional.append(sumo_output.write_edge_data(
                routes.with_name("edgedata.add.xml"), self._outputs["edgedata"], scenario.step))
        if additional:
            options += ["--additional-files", file_list(additional)]
        self._session = Session(
            self._net_file, files, seed=seed, step_length=chosen.step_length,
            time_to_teleport=chosen.time_to_teleport, collision_action=chosen.collision_action,
            options=tuple(options), window=self._window)
        self._meter = Meter(
            self._session, self.city, probes(self._vehicles, chosen.probe_share, seed) if estimating else frozenset())
        self._detectors, self._estimator = None, None
        if estimating:
            self._detectors = Detectors(self._session, self.city, self._layout, self._meter, self._instruments)
            self._estimator = Estimator(self._planning, self._instruments)
        self._guide = Guide(
            self._session, self.city, scenario.network.nominal_splits, compliance=chosen.compliance,
            most_detour=chosen.most_detour, ways_return=chosen.ways_return, period=chosen.guidance_period,
            random=np.random.default_rng([seed, 0x67756964]))
        self._incidents = Incidents(scenario.ordered_faults, self._session, self.city)
        self._max_pressure, self._rationed = None, {}
        if chosen.signals == MAX_PRESSURE:
            flows = self._own_flows()
            if flows is None:
                flows = turning_flows(self.city, scenario.demand, scenario.step)
            others = [signal for signal in self.simple_signals if signal not in steered]
            self._max_pressure = MaxPressure(
                self._session, self.city, steered, flows, others=others, min_green=chosen.min_green,
                show=self._incidents.show)
            self._rationed = {signal.id: signal for signal in steered if signal.id in self._gateway_ids}
        self._signals = self._gateway_signals()
        self._original_green = self._programmed_green()
        self._actuator = Actuator(list(self._signals.values()), self._incidents.show)
        self._speed: np.ndarray | None = None
        self._k, self._rows, self._opened = 0, [], {}
        return self._state()

    def step(self, controls: Controls) -> State:
        network, session, meter = self._scenario.network, self._session, self._meter
        before = self._totals()
        self._incidents.begin(self._k)
        if self._detectors:
            self._detectors.silence(self._incidents.silent_loops)
        share = np.clip((controls.perimeter - network.u_min) / (network.u_max - network.u_min), 0.0, 1.0)
        self._actuator.command(share, self._opened)
        if self._max_pressure is not None:
            self._max_pressure.command(share, self._opened)
        self._guide.command(controls.splits, self._speed)
        begin, steps = session.time, round(self._scenario.step / session.step_length)
        every, often = (
            min(max(1, round(time / session.step_length)), steps) for time in (SAMPLE_EVERY, EVERY))
        vehicles, metres = np.zeros((2, len(self.city.edges)))  # sums over the samples, by edge: n and n v
        queues = []
        for n in range(steps):
            self._actuator.play(session.time)
            if self._max_pressure is not None:
                self._max_pressure.play(session.time)
            self._incidents.play(session.time)
            session.step()
            self._guide.apply(meter.observe())
            if self._detectors and n % often == often - 1:
                self._detectors.sample()
            if n % every == every - 1:
                counts, speeds = self._sample()
                vehicles, metres = vehicles + counts, metres + counts * speeds
                queues.append([session.halting(edge) for edge in self._upstream])
        self._k += 1
        assert abs(session.time - begin - self._scenario.step) < 1e-6
        state = self._state()
        after = self._totals()
        if self._estimator:
            self._estimator.step(
                controls, self._detectors.readings(after["gateway_flow"] - before["gateway_flow"]))
        state = replace(state, problem=self._incidents.problem(estimating=self._estimator is not None))
        row = {key: after[key] - before[key] for key in after}
        with np.errstate(invalid="ignore"):
            speed = metres / vehicles
        speed[self._incidents.closed] = 0.0  # nobody is sent through a street because it is empty
        self._speed = speed
        row["production"], row["mean_accumulation"] = (
            np.bincount(self._edge_region, amount, network.regions) / len(queues) for amount in (metres, vehicles))
        self._opened = self._overridden(vehicles / len(queues))
        row["edge_vehicles"] = (vehicles / len(queues)).astype(np.float16)  # to 0.1 % and as small as an integer
        queues = np.array(queues).reshape(len(queues), len(self._upstream))
        row["gateway_queue"], row["gateway_queue_max"] = (
            queue[self._upstream_of] for queue in (queues.mean(axis=0), queues.max(axis=0)))
        row["gateway_original_green"] = self._original_green
        for n, gateway in enumerate(self.city.gateways):
            if gateway.signal in self._incidents.refused:
                row["gateway_green"][n] = self._original_green[n]
        self._rows.append(row)
        return state

    def observe(self) -> Observation | None:
        """The estimate, where states are estimated."""
        if self._estimator is None:
            return None
        return Observation(
            step=self._k, time=self._k * self._scenario.step, accumulation=self._estimator.accumulation,
            backlog=self._detectors.backlog())

    def close(self) -> None:
        self._end_session()
        self._folder.close()

    def record(self) -> Record:
        """Of all control intervals since the reset."""
        return Record(**{key: np.stack([row[key] for row in self._rows]) for key in self._rows[0]})

    def trip_facts(self) -> TripFacts:
        """Ends the simulation, for only then does SUMO tell of the trips under way."""
        self._end_session()
        return read_trip_facts(self._trip_file)

    @property
    def sumo_time(self) -> float:
        return self._session.sumo_time

    @property
    def session(self) -> Session:
        """The running simulation, for tests and for watching."""
        return self._session

    def leaks(self) -> list[Gateway]:
        """Gateways that no fixed-time signal controls: perimeter control does not reach them."""
        return [g for g in self.city.gateways if g.signal not in self._signals and g.signal not in self._rationed]

    @property
    def trips(self) -> int:
        """Vehicles of the run: those drawn from the demand, or of a city's own those that were due so far."""
        if not self._settings.routes:
            return len(self._vehicles)
        return int(self._meter.departures.sum() + self._meter.backlog().sum())

    def _write_vehicles(self, path: Path, seed: int) -> list[str]:
        """The route file of one run; the ids of its vehicles."""
        scenario, chosen = self._scenario, self._settings
        if not chosen.routes:
            return [f"v{n}" for n in range(write_trips(self.city, scenario.demand, scenario.step, seed, path))]
        if self._originals is None:
            self._originals = own_vehicles(scenario, chosen, self.city)
        return write_originals(
            self._originals, path, seed=seed, factor=scenario.demand_factor, jitter=chosen.departure_jitter,
            begin=chosen.begin)

    def _additional(self) -> list[Path]:
        """The city's own additional files."""
        return [self._scenario.folder / name for name in self._settings.additional] if self._scenario.folder else []

    def _own_flows(self) -> Mapping[tuple[str, str], float] | None:
        """Turning flows of the city's own vehicles; None where trips are drawn from the scenario's demand."""
        if self._originals is None:
            return None
        return own_flows(self.city, self._originals, read_routes(self._additional()), self._scenario.demand_factor)

    def _end_session(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    def _signal_plan(self, signals: list[Signal]) -> list[Path]:
        """Additional files with which SUMO runs other programmes than those of the network file."""
        if self._settings.signals == WEBSTER:
            path = webster.plan(
                self.city, self.simple_signals, self._scenario.demand, self._scenario.step,
                folder=self._scenario.network.folder / "build", flows=self._own_flows())
        elif self._settings.signals == ACTUATED:
            path = self._folder.path / "actuated.add.xml"
            write_programmes(path, [actuated_row(signal) for signal in signals])
        else:
            return []
        return [path]

    def _gateway_signals(self) -> dict[str, GatewaySignal]:
        movements, signals = gateway_movements(self.city), {}
        for signal in sorted(movements.keys() - self._rationed.keys()):
            if signal in self._settings.leave_signals:
                continue
            programme = self._session.programme(signal)
            if programme.static:
                signals[signal] = GatewaySignal(
                    programme, movements[signal], min_green=self._settings.min_green,
                    mode=self._settings.actuation, start=self._session.time)
        return signals

    def _overridden(self, edge_vehicles: np.ndarray) -> dict[str, set[int]]:
        """Signal -> links of the gateways that stay open because of their queue. edge_vehicles: (E,) [veh], mean."""
        limit, links = self._settings.queue_override, {}
        for n in np.flatnonzero(gateway_room_taken(edge_vehicles, self.city) >= limit) if limit else ():
            gateway = self.city.gateways[n]
            links.setdefault(gateway.signal, set()).update(gateway.links)
        return links

    def _programmed_green(self) -> np.ndarray:
        """(G,) [s] per control interval, as Record.gateway_original_green."""
        green = np.full(len(self.city.gateways), np.nan)
        for n, gateway in enumerate(self.city.gateways):
            if gateway.signal in self._signals or gateway.signal in self._rationed:
                plan = self._rationed.get(gateway.signal) or self._session.programme(gateway.signal)
                lasting = [phase.duration * (phase.state[link] in GREEN)
                           for phase in plan.phases for link in gateway.links]
                cycle = sum(phase.duration for phase in plan.phases)
                green[n] = sum(lasting) / len(gateway.links) * self._scenario.step / cycle
        return green

    def _state(self) -> State:
        return State(
            step=self._k, time=self._k * self._scenario.step, accumulation=self._meter.accumulation(self._k),
            backlog=self._meter.backlog(), completed=float(self._meter.arrivals.sum()))

    def _sample(self) -> tuple[np.ndarray, np.ndarray]:
        """Vehicles (E,) [veh] and mean speed (E,) [m/s] by edge, now."""
        count, mean_speed, edges = self._session.vehicle_count, self._session.mean_speed, self.city.edges
        counts, speeds = np.zeros((2, len(edges)))
        travelled = self._travelled()
        counts[travelled] = [count(edges[n]) for n in travelled]
        for n in np.flatnonzero(counts):
            speeds[n] = mean_speed(edges[n])
        return counts, speeds

    def _travelled(self) -> list[int]:
        """Numbers of edges, among them all that have vehicles: a large city has more edges than vehicles under way."""
        vehicles = self._session.running()
        if 2 * len(vehicles) > len(self.city.edges):
            return list(range(len(self.city.edges)))
        roads = set(map(self._session.road, vehicles))  # some may be junctions, or closed to cars
        return [self._number[road] for road in roads & self._number.keys()]

    def _totals(self) -> dict[str, np.ndarray]:
        # Several movements may lead from one region to one edge: they share its flow.
        alike = Counter((g.source, g.to_edge) for g in self.city.gateways)
        green = {signal: filtered.green_time() for signal, filtered in self._signals.items()}
        green |= self._max_pressure.green_time() if self._max_pressure is not None else {}
        return {
            "departures": self._meter.departures.copy(), "arrivals": self._meter.arrivals.copy(),
            "crossings": self._meter.crossings.copy(), "teleports": np.array(self._meter.teleports),
            "guided": self._guide.realised.copy(),
            "gateway_flow": np.array([
                self._meter.entry_flow[g.source, g.to_edge] / alike[g.source, g.to_edge] for g in self.city.gateways]),
            "gateway_green": np.array([
                sum(green[g.signal][link] for link in g.links) / len(g.links) if g.signal in green else np.nan
                for g in self.city.gateways])}


def _check_mesoscopic(scenario: Scenario, chosen: Settings) -> None:
    """InputError for what needs lanes where there are none."""
    for key, value, what in (("signals", MAX_PRESSURE, "counts vehicles lane by lane"),
                             ("measurement", ESTIMATE, "needs loop detectors on lanes")):
        if chosen.mesoscopic and getattr(chosen, key) == value:
            where = "scenario.toml" if scenario.folder is None else scenario.folder / "scenario.toml"
            raise InputError(
                f"{where}: sumo.{key}: {value} {what}, but SUMO's mesoscopic model has no lanes; leave it away, or set "
                "mesoscopic = false (import the city without --mesoscopic)")
