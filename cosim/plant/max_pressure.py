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

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from cosim.plant.gates import Green, Show
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
        self._junctions = [Junction(signal, now, gateways.get(signal.id)) for signal in signals]
        self._approaches = [Approaches(signal, self._roads.watched, now) for signal in signals]
        self._rationed = [junction for junction in self._junctions if junction.rations]
        self._programmed = float(np.mean([intergreen_share(signal.phases) for signal in signals]))
        self._start = now
        self._next = now  # time of the next decision [s]
        for junction in self._junctions:
            show(junction.signal, junction.state)

    def command(self, share: PerGateway) -> None:
        """Set the shares (G,) [-] of the cycles that begin from now on."""
        for junction in self._rationed:
            for ration in junction.rations.values():
                ration.share = float(share[ration.gateway])

    def green_time(self) -> dict[str, dict[int, Green]]:
        """Return signal -> gateway link -> green so far."""
        now = self._session.time
        green = {}
        for junction in self._rationed:
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
        counts = [self._session.lane_vehicles(lane) for lane in self._roads.lanes]
        present = np.array(counts, dtype=float)
        pressure = self._pressure(present)
        for junction, approaches, begin in zip(
            self._junctions, self._approaches, self._roads.begins, strict=True
        ):
            approaches.observe(junction.state, now)
            if not junction.may_switch(now):
                continue
            waiting = approaches.waiting(present, junction.exhausted_links())
            own_pressure = pressure[begin : begin + junction.stages]
            stage = self._next_stage(junction, own_pressure, waiting, approaches, now)
            if stage != junction.stage:
                self._show(junction.signal, junction.switch(stage, now))

    def _pressure(self, present: np.ndarray) -> np.ndarray:
        """Return the pressures (S,) of all stages. present: (L,) [veh]"""
        roads = self._roads
        weight = np.maximum(roads.weights @ present, 0.0)
        for junction in self._rationed:
            for link in junction.exhausted_links():
                weight[roads.movements[junction.movement[link]]] = 0.0
        return roads.gain @ weight + roads.apart @ present

    def _next_stage(
        self,
        junction: Junction,
        pressure: np.ndarray,
        waiting: np.ndarray,
        approaches: "Approaches",
        now: float,
    ) -> int:
        """Return the next stage, or the present one.

        pressure: of the stages (n,); waiting: a vehicle waits for the link (bool, (K,))
        """
        present = junction.stage
        called = approaches.serves @ waiting > 0
        others = []  # stages that a vehicle waits for, in the order of the programme
        for n in range(present + 1, present + len(pressure)):
            stage = n % len(pressure)
            if called[stage]:
                others.append(stage)
        if not others:
            return present
        overdue = approaches.serves @ (waiting * approaches.overdue(now))
        if overdue.any():
            return int(np.argmax(overdue))
        worth = {}
        for stage in others:
            time = self._lookahead + junction.loss(stage)
            worth[stage] = pressure[stage] * self._lookahead / time
        best = max(others, key=worth.__getitem__)
        too_long = now + DECISION_PERIOD_S > junction.stage_since + MAX_GREEN_S + 1e-6
        if worth[best] > pressure[present] or too_long:
            return best
        return present


class Approaches:
    """The links of one signal: where vehicles wait, and times of red.

    serves: 1 if link k is green in stage n, else 0 (n, K)
    """

    def __init__(self, signal: Signal, watched: Callable[[Link], set[int]], now: float):
        """watched: link -> numbers of the lanes whose vehicles may wait for it"""
        stages = [green_links(signal.phases[n].state) for n in stages_of(signal)]
        self.serves = np.array(stages, dtype=float)
        pairs = set()
        for link in (*signal.links, *signal.others):
            pairs |= {(link.index, lane) for lane in watched(link)}
        self._link, self._lane = np.array(sorted(pairs)).T
        self._last_green = np.full(self.serves.shape[1], now)

    def observe(self, state: str, now: float) -> None:
        """Note which links are green at `now` [s]."""
        self._last_green[green_links(state)] = now

    def waiting(self, present: np.ndarray, closed: Collection[int]) -> np.ndarray:
        """Return True for links that vehicles wait for (K,).

        closed: links that do not count
        present: vehicles by lane (veh, (L,))
        """
        waits = np.zeros(len(self._last_green), dtype=bool)
        waits[self._link[present[self._lane] > 0]] = True
        waits[list(closed)] = False
        return waits

    def overdue(self, now: float) -> np.ndarray:
        """Return the time of red of every link (s, (K,)), 0 below MAX_RED_S."""
        red = now - self._last_green
        return np.where(red >= MAX_RED_S - 1e-6, red, 0.0)
