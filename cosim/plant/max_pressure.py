"""Max-pressure control of signals.

It follows Varaiya, "Max pressure control of a network of signalized intersections", 2013.
A movement from road l to road m has the weight w(l, m) = x(l, m) - sum_p r(m, p) x(m, p). These are
the vehicles that want to make it, minus those in the way behind it, by turning shares r. A stage (a
green phase of the original programme) has the pressure sum c(l, m) max(w(l, m), 0) over its
movements, where c is their saturation flow. The stage with the highest pressure gets the green,
after yellow and all-red (cosim.plant.stages). Perimeter control rations the green of the gateway
movements (cosim.plant.gates.Ration). A movement whose ration is spent exerts no pressure.

x counts vehicles per lane (cosim.plant.pressure), r comes from the demand's static routes. Vehicles
on streets closed to cars, such as buses, press for the stages that serve them.

A link that was red for MAX_RED_S while a vehicle waited there comes first. No green outlasts
MAX_GREEN_S while others wait. A change costs intergreen time t. Another stage's pressure is
therefore multiplied by lookahead / (lookahead + t). A shorter lookahead gives fewer changes.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import block_diag

from cosim.plant.gates import Green, Ration, Show
from cosim.plant.pressure import Roads
from cosim.plant.stages import Junction, green_links, intergreen_share, stages_of
from cosim.sumo.arrays import PerGateway
from cosim.sumo.net import City, gateway_movements
from cosim.sumo.session import Session
from cosim.sumo.signals import Link, Signal

FACTS = {  # columns of the table of runs
    "signal_lanes": "lanes before signals under max-pressure",
    "split_lanes": "those that a stage serves in part",
    "never_whole_lanes": "those that no stage serves whole",
    "intergreen_share": "share of the time between two stages under max-pressure",
    "programmed_intergreen_share": "the same in the original programmes",
}
DECISION_PERIOD_S = 5.0  # about two vehicles per lane
MAX_GREEN_S = 50.0  # netconvert's for actuated signals
MAX_RED_S = 120.0  # about the longest usual cycle (Signal Timing Manual, 2nd edition, 2015)


class Gate(NamedTuple):
    """A gateway link with rationed green.

    link: its number among the links of all signals; movement: (edge, next edge)
    """

    ration: Ration
    link: int
    movement: tuple[str, str]


class MaxPressure:
    """Max-pressure at `signals`.

    Call `command` once per control interval, and `play` before every simulation step.
    """

    def __init__(
        self,
        session: Session,
        city: City,
        signals: Sequence[Signal],
        flows: Mapping[tuple[str, str], float],
        *,
        show: Show,
        lookahead: float,
    ):
        """flows: (edge, next edge) -> flow, any unit
        lookahead: green time after a stage change over which stages are compared (s)
        """
        now = session.time
        gateways = gateway_movements(city)
        self._session = session
        self._show = show
        self._lookahead = lookahead
        self._roads = Roads(city, signals, flows)
        self._approaches = Approaches(signals, self._roads.watched, now)
        self._junctions = [Junction(signal, now, gateways.get(signal.id)) for signal in signals]
        self._gates = []
        for signal, junction, first in zip(
            signals, self._junctions, self._approaches.begins, strict=True
        ):
            movement = {link.index: (link.from_edge, link.to_edge) for link in signal.links}
            for link, ration in junction.rations.items():
                self._gates.append(Gate(ration, first + link, movement[link]))
            show(junction.signal, junction.state)
        self._counted = self._roads.counted(self._approaches.lanes)
        self._names = [self._roads.lanes[n] for n in self._counted]
        self._programmed = float(np.mean([intergreen_share(signal.phases) for signal in signals]))
        self._start = now
        self._next = now  # time of the next decision [s]

    def command(self, share: PerGateway) -> None:
        """Set the shares (G,) [-] of the cycles that begin from now on."""
        for gate in self._gates:
            gate.ration.share = float(share[gate.ration.gateway])

    def green_time(self) -> dict[str, dict[int, Green]]:
        """Return signal -> gateway link -> green so far."""
        now = self._session.time
        green = {}
        for junction in self._junctions:
            if junction.rations:
                rations = junction.rations.items()
                green[junction.signal] = {link: ration.green_time(now) for link, ration in rations}
        return green

    def facts(self, now: float) -> dict[str, float]:
        """Return FACTS until `now` [s]."""
        lost = float(np.mean([junction.lost for junction in self._junctions]))
        share = lost / max(now - self._start, 1.0)
        return dict(zip(FACTS, (*self._roads.shared, share, self._programmed), strict=True))

    def play(self, now: float) -> None:
        """Set all states from `now` [s] on."""
        for junction in self._junctions:
            if now >= junction.next_change - 1e-6:
                self._show(junction.signal, junction.advance(now))
        if now >= self._next - 1e-6:
            self._next = now + DECISION_PERIOD_S
            self._decide(now)

    def _decide(self, now: float) -> None:
        """Switch the junctions whose next stage is another one."""
        present = np.zeros(len(self._roads.lanes))
        present[self._counted] = [self._session.lane_vehicles(lane) for lane in self._names]
        closed = [gate for gate in self._gates if gate.ration.exhausted]
        pressure = self._pressure(present, closed)
        approaches = self._approaches
        approaches.observe([junction.state for junction in self._junctions], now)
        waiting = approaches.waiting(present, closed)
        called = approaches.served(waiting)
        overdue = approaches.served(waiting * approaches.overdue(now))
        for junction, begin in zip(self._junctions, self._roads.begins, strict=True):
            if not junction.may_switch(now):
                continue
            own = slice(begin, begin + junction.stages)
            stage = self._next_stage(junction, pressure[own], called[own], overdue[own], now)
            if stage != junction.stage:
                self._show(junction.signal, junction.switch(stage, now))

    def _pressure(self, present: np.ndarray, closed: Iterable[Gate]) -> list[float]:
        """Return the pressures of all stages (veh).

        present: vehicles by lane (veh, (L,)); closed: gateway links without more green
        """
        roads = self._roads
        weight = np.maximum(roads.weights @ present, 0.0)
        for gate in closed:
            weight[roads.movements[gate.movement]] = 0.0
        return (roads.gain @ weight + roads.apart @ present).tolist()

    def _next_stage(
        self,
        junction: Junction,
        pressure: list[float],
        called: list[float],
        overdue: list[float],
        now: float,
    ) -> int:
        """Return the next stage of a signal, or the present one.

        pressure: of its stages (veh); called: links with waiting vehicles that each serves
        overdue: times of red of these, if too long (s)
        """
        present = junction.stage
        best = present
        highest = -math.inf
        for n in range(present + 1, present + junction.stages):
            stage = n % junction.stages
            if not called[stage]:
                continue
            time = self._lookahead + junction.losses[present, stage]
            worth = pressure[stage] * self._lookahead / time
            if worth > highest:
                best = stage
                highest = worth
        if best != present and any(overdue):
            return overdue.index(max(overdue))
        too_long = now + DECISION_PERIOD_S > junction.stage_since + MAX_GREEN_S + 1e-6
        if highest > pressure[present] or too_long:
            return best
        return present


class Approaches:
    """The links of all signals: where vehicles wait, and times of red.

    begins: number of the first link of every signal
    lanes: numbers of the lanes whose vehicles may wait
    """

    def __init__(self, signals: Sequence[Signal], watched: Callable[[Link], set[int]], now: float):
        """watched: link -> numbers of the lanes whose vehicles may wait for it"""
        self.begins = []
        serves = []  # of every signal: whether a link is green in a stage (bool, (stages, links))
        pairs = set()
        links = 0
        for signal in signals:
            self.begins.append(links)
            serves.append([green_links(signal.phases[n].state) for n in stages_of(signal)])
            for link in (*signal.links, *signal.others):
                pairs |= {(links + link.index, lane) for lane in watched(link)}
            links += len(signal.phases[0].state)
        self._link, self.lanes = np.array(sorted(pairs)).T
        self._serves = block_diag(serves, format="csr", dtype=float)
        self._last_green = np.full(links, now)

    def observe(self, states: Iterable[str], now: float) -> None:
        """Note which links are green at `now` [s]."""
        green = np.concatenate([green_links(state) for state in states])
        self._last_green[green] = now

    def waiting(self, present: np.ndarray, closed: Iterable[Gate]) -> np.ndarray:
        """Return True for links that vehicles wait for (K,).

        present: vehicles by lane (veh, (L,)); closed: gateway links that do not count
        """
        waits = np.zeros(len(self._last_green), dtype=bool)
        waits[self._link[present[self.lanes] > 0]] = True
        waits[[gate.link for gate in closed]] = False
        return waits

    def overdue(self, now: float) -> np.ndarray:
        """Return the time of red of every link (s, (K,)), 0 below MAX_RED_S."""
        red = now - self._last_green
        return np.where(red >= MAX_RED_S - 1e-6, red, 0.0)

    def served(self, values: np.ndarray) -> list[float]:
        """Return the sum of values of links (K,) that each stage serves."""
        return (self._serves @ values).tolist()
