"""From commands to lights: one object in front of all that controls signals.

Perimeter control acts on the gateway movements of fixed-time signals (`perimeter`) and of those that SUMO actuates
(`responsive`), or rations their green where max-pressure runs the signals (`max_pressure`, `green_quota`). Either way u
between its bounds becomes a share, a gateway before which the street is full may be spared (queue override), and a
signal that is out of order does not take what it is shown (`incidents`).
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import numpy as np

from cosim.plant.incidents import Incidents
from cosim.plant.max_pressure import FACTS, MaxPressure
from cosim.plant.perimeter import GREEN, GatewaySignal, GatewaySignals
from cosim.plant.programmes import CitySignals
from cosim.plant.responsive import ResponsiveSignal, ResponsiveSignals
from cosim.plant.settings import CYCLIC, Settings
from cosim.sumo.arrays import PerEdge, PerGateway
from cosim.sumo.net import City, Gateway, gateway_movements, gateway_room_taken
from cosim.sumo.session import Phase, Session
from nmfd.arrays import PerPair
from nmfd.model.scenario import Scenario


class SignalControl(Protocol):
    """What gives some signals of the city their states."""

    def command(self, share: PerPair, opened: Mapping[str, Collection[int]]) -> None:
        """Take over the commands of a control interval.

        share: (R, R) [-], [i, h] = (u_ih - u_min) / (u_max - u_min); opened: signal -> links whatever share says
        """

    def play(self, now: float) -> None:
        """Show what holds from `now` [s] on; called before every simulation step."""

    def green_time(self) -> dict[str, dict[int, float]]:
        """Signal -> gateway link -> seconds of green shown so far, of those that are commanded."""


class Actuation:
    """The signals of one run: `command` once per control interval, `play` before every simulation step.

    original_green: (G,) [s] per control interval in the original programme, the mean of the gateway's links; NaN where
        no command arrives
    """

    def __init__(
        self,
        session: Session,
        city: City,
        scenario: Scenario,
        chosen: Settings,
        signals: CitySignals,
        incidents: Incidents,
        flows: Mapping[tuple[str, str], float] | None,
    ):
        """flows: (edge, next edge) -> any measure of flow, if max-pressure is to run the signals"""
        self._session, self._city, self._incidents = session, city, incidents
        self._network, self._queue_override = scenario.network, chosen.queue_override
        self._controls: list[SignalControl] = []
        phases: dict[str, Sequence[Phase]] = {}  # of the original programmes of the signals that are commanded
        movements = gateway_movements(city)
        self._pressure = (
            None
            if flows is None
            else MaxPressure(
                session,
                city,
                signals.steered,
                flows,
                min_green=chosen.min_green,
                max_green=chosen.max_green,
                show=incidents.show,
                cyclic=chosen.signals == CYCLIC,
            )
        )
        if self._pressure is not None:
            self._controls.append(self._pressure)
            phases |= {signal.id: signal.phases for signal in signals.steered if signal.id in movements}
        own = [
            session.programme(signal)
            for signal in sorted(movements)
            if signal not in phases and signal not in chosen.leave_signals
        ]
        self._controls.append(
            GatewaySignals(
                [
                    GatewaySignal(
                        plan,
                        movements[plan.signal],
                        min_green=chosen.min_green,
                        mode=chosen.actuation,
                        start=session.time,
                    )
                    for plan in own
                    if plan.static
                ],
                incidents.show,
            )
        )
        self._controls.append(
            ResponsiveSignals(
                session,
                [
                    ResponsiveSignal(session, incidents, plan, movements[plan.signal], min_green=chosen.min_green)
                    for plan in own
                    if plan.actuated
                ],
            )
        )
        phases |= {plan.signal: plan.phases for plan in own if plan.static or plan.actuated}
        self._commanded = phases.keys()
        self.original_green = _programmed_green(city, phases, scenario.step)

    def command(self, perimeter: PerPair, edge_vehicles: PerEdge | None) -> None:
        """Take over u (R, R) [-] for the control interval that begins.

        edge_vehicles: (E,) [veh], means of the interval before, for the queue override; None before the first
        """
        network = self._network
        share = np.clip((perimeter - network.u_min) / (network.u_max - network.u_min), 0.0, 1.0)
        opened = {} if edge_vehicles is None else self._overridden(edge_vehicles)
        for control in self._controls:
            control.command(share, opened)

    def play(self) -> None:
        """Show what holds from now on."""
        now = self._session.time
        for control in self._controls:
            control.play(now)
        self._incidents.play(now)

    def green_time(self) -> PerGateway:
        """(G,) [s] of green shown so far per gateway, the mean of its links; NaN where no command arrives."""
        green: dict[str, dict[int, float]] = {}
        for control in self._controls:
            green |= control.green_time()
        return np.array(
            [
                sum(green[g.signal][link] for link in g.links) / len(g.links) if g.signal in green else np.nan
                for g in self._city.gateways
            ]
        )

    def as_shown(self, green: PerGateway) -> PerGateway:
        """(G,) [s] per gateway in the last control interval, where `green` was meant to be shown: where a signal was
        out of order it was the original one."""
        out = [gateway.signal in self._incidents.refused for gateway in self._city.gateways]
        return np.where(out, self.original_green, green)

    def pressure_facts(self) -> dict[str, float]:
        """max_pressure.FACTS of this run; NaN where it does not run the signals."""
        if self._pressure is None:
            return dict.fromkeys(FACTS, float("nan"))
        return self._pressure.facts(self._session.time)

    def leaks(self) -> list[Gateway]:
        """Gateways that no command reaches."""
        return [gateway for gateway in self._city.gateways if gateway.signal not in self._commanded]

    def _overridden(self, edge_vehicles: PerEdge) -> dict[str, set[int]]:
        """Signal -> links of the gateways that stay open because of their queue."""
        limit = self._queue_override
        links: dict[str, set[int]] = {}
        for n in np.flatnonzero(gateway_room_taken(edge_vehicles, self._city) >= limit) if limit else ():
            gateway = self._city.gateways[n]
            if gateway.signal is not None:
                links.setdefault(gateway.signal, set()).update(gateway.links)
        return links


def _programmed_green(city: City, phases: Mapping[str, Sequence[Phase]], step: float) -> PerGateway:
    """(G,) [s] per control interval `step` [s]; NaN without phases."""
    green = np.full(len(city.gateways), np.nan)
    for n, gateway in enumerate(city.gateways):
        plan = None if gateway.signal is None else phases.get(gateway.signal)
        if plan is not None:
            lasting = [phase.duration * (phase.state[link] in GREEN) for phase in plan for link in gateway.links]
            green[n] = sum(lasting) / len(gateway.links) * step / sum(phase.duration for phase in plan)
    return green
