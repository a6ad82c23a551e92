"""The signals of one run, from commands to states."""

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.plant.gates import GatewaySignal, Green, ResponsiveSignal
from cosim.plant.incidents import Incidents
from cosim.plant.max_pressure import FACTS, MaxPressure
from cosim.plant.room import Room
from cosim.plant.settings import SIGNAL_CONTROLS, Settings
from cosim.plant.supervisor import Supervisor
from cosim.plant.waits import Waits
from cosim.sumo.arrays import PerEdge, PerGateway
from cosim.sumo.net import City, Gateway, gateway_movements
from cosim.sumo.session import Phase, Session
from cosim.sumo.signals import GREEN, Signal, held_city, running_logic
from nmfd.arrays import PerPair
from nmfd.model.regional_model import RegionalModel

# Share of what a boundary can let through. Above it a gate holds no queue, but takes green that is
# needed.
OPEN_SHARE = 0.95


class Actuation:
    """All signals under control.

    Call `command` once per control interval and `play` before every simulation step. Between them,
    `update` from time to time shares the command over the gateways again (cosim.plant.room).

    original_green: (G,) [s] per control interval in the original programme, mean of the gateway's
        links; NaN where no command arrives
    states: signal -> time [s] and state at every change, as SUMO shows it
    """

    def __init__(
        self,
        session: Session,
        city: City,
        network: RegionalModel,
        step: float,
        settings: Settings,
        steered: Sequence[Signal],
        incidents: Incidents,
        flows: Mapping[tuple[str, str], float] | None,
    ):
        """step: control interval [s]; steered: signals that are set from outside

        flows: (edge, next edge) -> flow, any unit, if they are set from outside
        """
        self._session = session
        self._city = city
        self._network = network
        self._incidents = incidents
        programmes = {signal: session.programme(signal) for signal in gateway_movements(city)}
        logics = {signal: running_logic(plan) for signal, plan in programmes.items()}
        held = held_city(city, logics, settings.leave_signals)
        movements = gateway_movements(held)
        self._gateways = held.gateways
        show = incidents.show
        phases: dict[str, Sequence[Phase]] = {}  # original ones of the signals that are commanded
        self._controls: list[MaxPressure | GatewaySignal | ResponsiveSignal] = []
        self._pressure: MaxPressure | None = None
        if flows is not None:
            control = SIGNAL_CONTROLS[settings.signals].load()
            everywhere = control(
                session, held, steered, flows, show=show, lookahead=settings.lookahead
            )
            if isinstance(everywhere, MaxPressure):
                self._pressure = everywhere
            self._controls.append(everywhere)
            phases = {signal.id: signal.phases for signal in steered if signal.id in movements}
        self._rationed = np.array([gateway.signal in phases for gateway in held.gateways], bool)
        for name in sorted(movements.keys() - phases.keys()):
            plan = programmes[name]
            links = movements[name]
            phases[name] = plan.phases
            signal: GatewaySignal | ResponsiveSignal
            if plan.static:
                signal = GatewaySignal(
                    plan, links, start=session.time, step=session.step_length, show=show
                )
            else:
                signal = ResponsiveSignal(
                    session, plan, links, show=show, release=incidents.release
                )
            self._controls.append(signal)
        self.original_green = _programmed_green(held, phases, step)
        self.room = Room(
            session,
            city,
            self.original_green,
            limit=settings.chain_limit,
            lanes=not settings.mesoscopic,
        )
        self._supervisor = Supervisor(network, step) if settings.chain_limit > 0 else None
        self.states: dict[str, list[tuple[float, str]]] = {name: [] for name in session.signals()}
        self._shown = [""] * len(self.states)

    def command(self, perimeter: PerPair, vehicles: PerEdge) -> None:
        """Set u (R, R) [-] of the control interval that begins.

        vehicles: (E,) [veh] on the streets
        """
        network = self._network
        share = np.clip((perimeter - network.u_min) / (network.u_max - network.u_min), 0.0, 1.0)
        share[share >= OPEN_SHARE] = 1.0
        if self._supervisor:
            accumulation = np.bincount(self._city.edge_region, vehicles, len(share))
            share[:, self._supervisor.opened(share, accumulation)] = 1.0
        self.room.command(share, vehicles)
        self._obey()

    def update(self, vehicles: PerEdge) -> None:
        """Share the command over the gateways again.

        vehicles: (E,) [veh] on the streets
        """
        before = self.room.share
        self.room.update(vehicles)
        if (self.room.share != before).any():
            self._obey()

    def realised(self) -> PerPair | None:
        """Return u (R, R) [-] that the gateways were given since the last command.

        None: it is the command itself.
        """
        network = self._network
        share = self.room.realised()
        if share is None:
            return None
        realised = network.u_min + share * (network.u_max - network.u_min)
        return np.where(network.adjacency, realised, 0.0)

    def _obey(self) -> None:
        for control in self._controls:
            control.command(self.room.share)

    def play(self) -> None:
        """Set all states from now on."""
        now = self._session.time
        for control in self._controls:
            control.play(now)
        self._incidents.play(now)

    def observe(self, waits: Waits | None = None) -> None:
        """Note the states that SUMO showed in the last simulation step.

        waits: is told of every change
        """
        now = self._session.time
        shown = list(map(self._session.signal_state, self.states))
        if shown == self._shown:
            return
        for signal, before, state in zip(self.states, self._shown, shown, strict=True):
            if state != before:
                self.states[signal].append((now, state))
                if waits is not None:
                    waits.changed(signal, state, now)
        self._shown = shown

    def green_time(self) -> tuple[PerGateway, PerGateway]:
        """Return two (G,) [s], means of links; NaN where no command arrives.

        They are the green so far, and the green that there would be without commands.
        """
        times: dict[str, dict[int, Green]] = {}
        for control in self._controls:
            times |= control.green_time()
        green = np.full((2, len(self._gateways)), np.nan)
        for n, gateway in enumerate(self._gateways):
            if gateway.signal in times:
                of_links = [times[gateway.signal][link] for link in gateway.links]
                green[:, n] = np.sum(of_links, axis=0) / len(of_links)
        return green[0], green[1]

    def ungated(self, green: PerGateway) -> PerGateway:
        """Return the green (G,) [s] of the last interval without commands.

        green: as timed, from `green_time`. Max-pressure seldom asks for the green of a link that is
        held: there the original programme tells what it would get.
        """
        held = self._rationed & (self.room.gateway_shares() < 1.0)
        return np.where(held, np.maximum(green, self.original_green), green)

    def as_shown(self, green: PerGateway, ungated: PerGateway) -> PerGateway:
        """Return the green (G,) [s] that was shown in the last interval.

        It is `green`, or `ungated` where a signal did not obey.
        """
        refused = self._incidents.refused
        disobeyed = [gateway.signal in refused for gateway in self._city.gateways]
        return np.where(disobeyed, ungated, green)

    def pressure_facts(self) -> dict[str, float]:
        """Return max_pressure.FACTS of this run; NaN without max-pressure."""
        if self._pressure is None:
            return dict.fromkeys(FACTS, float("nan"))
        return self._pressure.facts(self._session.time)

    def leaks(self) -> list[Gateway]:
        """Return the gateways that no command reaches."""
        return [self._city.gateways[n] for n in np.flatnonzero(np.isnan(self.original_green))]


def _programmed_green(city: City, phases: Mapping[str, Sequence[Phase]], step: float) -> PerGateway:
    """Return (G,) [s] of green per control interval; NaN without phases.

    step: control interval [s]
    """
    green = np.full(len(city.gateways), np.nan)
    for n, gateway in enumerate(city.gateways):
        plan = phases.get(gateway.signal or "")
        if plan is None:
            continue
        lasting = 0.0
        for phase in plan:
            for link in gateway.links:
                if phase.state[link] in GREEN:
                    lasting += phase.duration
        cycle = sum(phase.duration for phase in plan)
        green[n] = lasting / len(gateway.links) * step / cycle
    return green
