"""Max-pressure control of signals (Varaiya, "Max pressure control of a network of signalized
intersections", 2013).

A movement from road l to road m has the weight w(l, m) = x(l, m) - sum_p r(m, p) x(m, p): vehicles
that want to make it, minus those in the way behind it, by turning shares r. A stage (a green phase
of the original programme) has the pressure sum c(l, m) max(w(l, m), 0) over its movements, c their
saturation flows. The stage with the highest pressure gets the green, after the original yellow and
all-red. Perimeter control rations the green of the gateway movements (cosim.plant.gates.Ration); a
movement whose ration is spent exerts no pressure.

x counts vehicles per lane; on shared lanes and upstream of the turn lanes, r divides them, from the
demand's static routes. Vehicles on streets closed to cars, such as buses, press for the stages that
serve them. A shared lane counts for the stages that serve all of it; if there is none, for the
others with the chance that its first vehicle is served.

The next stage is the one with the highest pressure; a link that was red for MAX_RED_S while a
vehicle waited there comes first. No green outlasts MAX_GREEN_S while others wait. A change costs
yellow and red: the pressure of another stage counts for the share of green in these and the
`lookahead` that follows: the shorter, the fewer the changes.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import permutations

import numpy as np
from scipy.sparse import csr_array

from cosim.plant.gates import (
    MIN_GREEN_S,
    NEVER,
    Green,
    Movements,
    Ration,
    Show,
    ends_bare,
    run_length,
    yellow_time,
)
from cosim.sumo.arrays import PerGateway
from cosim.sumo.net import City, gateway_movements
from cosim.sumo.session import Phase, Session
from cosim.sumo.signals import GREEN, Link, Signal, is_stage, lane_id

LEVELS = "rsgG"  # from red by way of turns on red to the right of way
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
SHORT_ROAD_M = 15.0  # two vehicles
REACH_M = 100.0  # before a signal within which vehicles count, wherever roads join and part there
WHOLE = 1 - 1e-9  # share of the vehicles of a lane: all of them
PERMISSIVE = 0.3  # saturation flow of a movement that must give way, as a share of a protected one
SATURATION = {"G": 1.0, "g": PERMISSIVE}  # light -> saturation flow [lanes]


class MaxPressure:
    """Max-pressure at `signals`: `command` once per control interval, `play` before every
    simulation step."""

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
        """flows: (edge, next edge) -> flow, any unit; lookahead: green that follows a change [s]"""
        self._session, self._show, self._lookahead = session, show, lookahead
        roads = Roads(city, signals, flows)
        self._roads, self._start = roads, session.time
        movements = gateway_movements(city)
        self._programmed = float(np.mean([_intergreen(signal.phases) for signal in signals]))
        self._junctions = [
            Junction(signal, session.time, movements.get(signal.id)) for signal in signals
        ]
        self._approaches = [Approaches(signal, roads.watched, session.time) for signal in signals]
        self._rationed = [junction for junction in self._junctions if junction.rations]
        self._next = session.time
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
        return {
            junction.signal: {
                link: ration.green_time(now) for link, ration in junction.rations.items()
            }
            for junction in self._rationed
        }

    def facts(self, now: float) -> dict[str, float]:
        """Return FACTS until `now` [s]."""
        share = float(np.mean([junction.lost for junction in self._junctions])) / max(
            now - self._start, 1.0
        )
        return dict(zip(FACTS, (*self._roads.shared, share, self._programmed), strict=True))

    def play(self, now: float) -> None:
        """Set all states from `now` [s] on."""
        for junction in self._junctions:
            if now >= junction.next_change - 1e-6:
                self._show(junction.signal, junction.advance(now))
        if now < self._next - 1e-6:
            return
        self._next = now + DECISION_PERIOD_S
        present = np.array(
            [self._session.lane_vehicles(lane) for lane in self._roads.lanes], dtype=float
        )
        pressure = self._pressure(present)
        for junction, approaches, begin in zip(
            self._junctions, self._approaches, self._roads.begins, strict=True
        ):
            approaches.observe(junction.state, now)
            if junction.may_switch(now):
                waiting = approaches.waiting(present, junction.exhausted_links())
                stage = self._next_stage(
                    junction, pressure[begin : begin + junction.stages], waiting, approaches, now
                )
                if stage != junction.stage:
                    self._show(junction.signal, junction.switch(stage, now))

    def _next_stage(
        self,
        junction: "Junction",
        pressure: np.ndarray,
        waiting: np.ndarray,
        approaches: "Approaches",
        now: float,
    ) -> int:
        """Return the next stage, or the present one. pressure: (n,) of the stages; waiting: (K,)
        bool, of the links"""
        own, called = junction.stage, approaches.serves @ waiting > 0
        in_turn = [
            n % len(pressure)
            for n in range(own + 1, own + len(pressure))
            if called[n % len(pressure)]
        ]
        if not in_turn:
            return own
        overdue = approaches.serves @ (waiting * approaches.overdue(now))
        if overdue.any():
            return int(np.argmax(overdue))
        worth = {
            n: pressure[n] * self._lookahead / (self._lookahead + junction.loss(n)) for n in in_turn
        }
        best = max(in_turn, key=worth.__getitem__)
        too_long = now + DECISION_PERIOD_S > junction.stage_since + MAX_GREEN_S + 1e-6
        if worth[best] > pressure[own] or too_long:
            return best
        return own

    def _pressure(self, present: np.ndarray) -> np.ndarray:
        roads = self._roads
        weight = np.maximum(roads.weights @ present, 0.0)
        for junction in self._rationed:
            for link in junction.exhausted_links():
                weight[roads.movements[junction.movement[link]]] = 0.0
        return roads.gain @ weight + roads.apart @ present


class Junction:
    """The states of one signal, second by second: a stage, or the transition between two stages.

    stages: their number; stage: the present or coming one; stage_since: time at which it begins [s]
    movement: link index -> (edge, next edge)
    rations: link index -> limit of the green of a gateway link
    lost: [s] between stages so far; next_change: time of the next `advance` [s]
    """

    def __init__(self, signal: Signal, now: float, gateways: Movements | None = None):
        """gateways: links whose green is rationed"""
        self.signal, self._phases, self._numbers = signal.id, signal.phases, stages_of(signal)
        self.stages, self.stage, phases = len(self._numbers), 0, signal.phases
        crossed = {
            k: max(run_length(phases, n, k, GREEN) for n in range(len(phases)))
            for k in ends_bare(phases)
        }
        self._least = [  # of every stage [s]
            max(
                [
                    MIN_GREEN_S,
                    *(green for k, green in crossed.items() if phases[n].state[k] in GREEN),
                ]
            )
            for n in self._numbers
        ]
        self._green_since, self.stage_since = now, now
        cycle = sum(phase.duration for phase in phases)
        self.rations = {
            link: Ration(gateway, cycle=cycle, yellow=yellow_time(phases, link), start=now)
            for link, gateway in (gateways or {}).items()
        }
        self.movement = {link.index: (link.from_edge, link.to_edge) for link in signal.links}
        self._coming: list[tuple[float, str]] = []
        self.lost, self._base = 0.0, phases[self._numbers[0]].state
        self.state = self._base
        self.next_change = (
            now if self.rations else NEVER
        )  # until then, commands hold from the first second on

    def exhausted_links(self) -> list[int]:
        """Return the gateway links without more green in this cycle."""
        return [link for link, ration in self.rations.items() if ration.exhausted]

    def may_switch(self, now: float) -> bool:
        """Return True if the stage may end at `now` [s]."""
        least = max(self._green_since + MIN_GREEN_S, self.stage_since + self._least[self.stage])
        return not self._coming and now >= least - 1e-6

    def switch(self, stage: int, now: float) -> str:
        """Leave the stage for another one; return the state from `now` on."""
        begin, self._coming = now, []
        for phase in self._way(stage):
            self._coming.append((begin, phase.state))
            begin += phase.duration
        self._coming.append((begin, self._phases[self._numbers[stage]].state))
        self.stage, self._green_since, self.stage_since = stage, begin, begin
        self.lost += begin - now
        return self.advance(now)

    def loss(self, stage: int) -> float:
        """Return the time between the present stage and another one [s]."""
        return sum(phase.duration for phase in self._way(stage))

    def _way(self, stage: int) -> list[Phase]:
        return transition(self._phases, self._numbers[self.stage], self._numbers[stage])

    def advance(self, now: float) -> str:
        """Return the state from `now` [s] on; call at every `next_change`."""
        while self._coming and now >= self._coming[0][0] - 1e-6:
            self._base = self._coming.pop(0)[1]
        self.next_change = self._coming[0][0] if self._coming else NEVER
        shown = list(self._base)
        for link, ration in self.rations.items():
            lasting = all(state[link] in GREEN for _, state in self._coming)
            shown[link], again = ration.show(shown[link], now, lasting=lasting)
            self.next_change = min(self.next_change, again)
            if ration.opened(
                now
            ):  # perhaps in the middle of a stage: it gets its minimum green, too
                self._green_since = max(self._green_since, now)
        self.state = "".join(shown)
        return self.state


def stages_of(signal: Signal) -> tuple[int, ...]:
    """Return the phases to choose from: stages whose green no other stage covers."""
    level = {
        n: np.array([LEVELS.index(light) for light in signal.phases[n].state])
        for n in signal.stages
    }
    covered = {
        n
        for n, m in permutations(level, 2)
        if (level[n] <= level[m]).all() and (m < n or (level[n] < level[m]).any())
    }
    return tuple(n for n in level if n not in covered)


@lru_cache(maxsize=4096)
def clearance(phases: tuple[Phase, ...]) -> np.ndarray:
    """Return the least times (K, K) [s] from the end of a green to the green of another link that
    was red with it.

    Those of the programme, where the other link is among the next ones and waits for no third one
    that goes on; elsewhere the least after the end of this green.
    """
    green = np.array([_green(phase.state) for phase in phases])
    apart, bare = ~(green.T @ green), ends_bare(phases)
    direct = np.full(apart.shape, NEVER)
    for n, link in np.argwhere(np.roll(green, 1, axis=0) & ~green):
        time, first, left = 0.0, NEVER, apart[link]
        for m in range(n, n + len(phases)):
            on = green[m % len(phases)]
            if (on & apart[link]).any():
                first = min(first, time)
            if time >= first + MIN_GREEN_S:
                break
            direct[link, on & left] = np.minimum(direct[link, on & left], time)
            time += phases[m % len(phases)].duration
            left = left & ~on
            if time >= MIN_GREEN_S and link not in bare:
                left = left & ~(apart @ on)
    usual = direct.min(axis=1, keepdims=True)
    return np.where(
        apart, np.where(direct < NEVER, direct, np.where(usual < NEVER, usual, 0.0)), 0.0
    )


@lru_cache(maxsize=4096)
def transition(phases: tuple[Phase, ...], source: int, target: int) -> list[Phase]:
    """Return the phases between two stages.

    The original ones if the programme goes from `source` to `target`; else yellow, as long as in
    the programme, and red, as long as after `source` and until all is clear, for links that lose
    their green or their right of way (G, then g). The others stay as they are, so that no
    conflicting movement is green before the target stage.
    """
    between, n = [], (source + 1) % len(phases)
    while phases[n].state == phases[source].state:
        n = (n + 1) % len(phases)
    while not is_stage(phases[n].state):
        between.append(phases[n])
        n = (n + 1) % len(phases)
    if n == target:
        return between
    before, after = phases[source].state, phases[target].state
    losing = {
        k
        for k, (a, b) in enumerate(zip(before, after, strict=True))
        if a in GREEN and (b not in GREEN or (a, b) == ("G", "g"))
    }
    if not losing:
        return []
    coming = {
        k for k, b in enumerate(after) if b in GREEN and (k in losing or before[k] not in GREEN)
    }
    clear = {k: max(clearance(phases)[k, [*coming]], default=0.0) for k in losing}
    walking = losing & ends_bare(phases)  # their red begins while cars beside them are still green
    yellow = max(yellow_time(phases, link) for link in losing)
    red = sum(phase.duration for phase in between if "y" not in phase.state)
    red = max([red, *(clear[k] - yellow for k in losing - walking)])
    alone = max((clear[k] - yellow - red for k in walking), default=0.0)
    return [
        Phase(
            duration=seconds, state="".join(light if k in ends else a for k, a in enumerate(before))
        )
        for seconds, light, ends in (
            (alone, "y", walking),
            (yellow, "y", losing),
            (red, "r", losing),
        )
        if seconds > 0.0
    ]


def _intergreen(phases: Sequence[Phase]) -> float:
    """Return the share of the cycle between two stages."""
    return sum(p.duration for p in phases if not is_stage(p.state)) / sum(
        p.duration for p in phases
    )


class Approaches:
    """The links of one signal: whether vehicles wait, and since when it is red.

    serves: (n, K) [0 or 1], link k is green in stage n
    """

    def __init__(self, signal: Signal, watched: Callable[[Link], set[int]], now: float):
        """watched: link -> numbers of the lanes whose vehicles may wait for it"""
        self.serves = np.array(
            [_green(signal.phases[n].state) for n in stages_of(signal)], dtype=float
        )
        pairs = sorted(
            {
                (link.index, lane)
                for link in (*signal.links, *signal.others)
                for lane in watched(link)
            }
        )
        self._link, self._lane = np.array(pairs).T
        self._last_green = np.full(self.serves.shape[1], now)

    def observe(self, state: str, now: float) -> None:
        self._last_green[_green(state)] = now

    def waiting(self, present: np.ndarray, closed: Collection[int]) -> np.ndarray:
        """Return (K,) bool: a vehicle is on a lane of the link, which is not `closed`. present:
        (L,) [veh]"""
        waits = np.zeros(len(self._last_green), dtype=bool)
        waits[self._link[present[self._lane] > 0]] = True
        waits[list(closed)] = False
        return waits

    def overdue(self, now: float) -> np.ndarray:
        """Return (K,) [s] of red, 0 below MAX_RED_S."""
        red = now - self._last_green
        return red * (red >= MAX_RED_S - 1e-6)


@lru_cache(maxsize=4096)  # a city shows the same states all day
def _green(state: str) -> np.ndarray:
    return np.isin(list(state), list(GREEN))


class Roads:
    """Vehicles by lane -> weights of movements -> pressures of stages, as sparse matrices.

    lanes: (L,) names, those for cars and all others before the signals, such as bus lanes, which
        have no weight
    movements: (edge, next edge) at `signals` -> number; weights: (M, L) [-]
    gain, apart: saturation flows [lanes] in stages, (S, M) of movements, (S, L) of lanes on streets
        closed to cars
    begins: first stage of every signal
    shared: numbers of lanes for cars before signals, of those that a stage serves in part, and that
        none serves whole
    """

    def __init__(
        self, city: City, signals: Sequence[Signal], flows: Mapping[tuple[str, str], float]
    ):
        """flows: (edge, next edge) -> flow, any unit, for the turning shares"""
        self._city, self._flows = city, flows
        cars = [lane for edge in city.edges for lane in city.lane_ids[edge]]
        links = [link for signal in signals for link in signal.links]
        others = (lane_id(link) for signal in signals for link in signal.others)
        self.lanes = list(dict.fromkeys([*cars, *map(lane_id, links), *others]))
        self.lane_number = {lane: n for n, lane in enumerate(self.lanes)}
        self._links: dict[str, list[Link]] = {}
        self._cars = frozenset(cars)
        for link in links:
            if lane_id(link) in self._cars:
                self._links.setdefault(link.from_edge, []).append(link)
        movements = sorted(
            {(link.from_edge, link.to_edge) for links in self._links.values() for link in links}
        )
        self.movements = {movement: n for n, movement in enumerate(movements)}
        rows = []
        for edge, target in movements:
            row = self._queue(edge, target, arriving=True)
            end = self._end(target)
            for onward, share in self._turns(end).items():
                for lane, part in self._queue(end, onward).items():
                    row[lane] = row.get(lane, 0.0) - share * part
            rows.append(row)
        self.weights = _sparse(rows, len(self.lanes))
        self._add_stages(signals)

    def _add_stages(self, signals: Iterable[Signal]) -> None:
        """Set `gain`, `apart`, `begins` and `shared`."""
        rows, apart = list[dict[int, float]](), list[dict[int, float]]()
        lanes, split, whole = set[str](), set[str](), set[str]()
        self.begins: list[int] = []
        for signal in signals:
            self.begins.append(len(rows))
            lanes |= {lane_id(link) for link in signal.links} & self._cars
            states = [signal.phases[number].state for number in stages_of(signal)]
            served = [self._served(signal, state) for state in states]
            split |= {lane for parts in served for lane, part in parts.items() if part < WHOLE}
            here = {lane for parts in served for lane, part in parts.items() if part >= WHOLE}
            whole |= here
            links = {
                (link.from_edge, link.lane, link.to_edge): link for link in signal.links
            }.values()
            for state, parts in zip(states, served, strict=True):
                row = defaultdict[int, float](float)
                for link in links:
                    lane, flow = lane_id(link), SATURATION.get(state[link.index])
                    if (
                        flow
                        and lane in self._cars
                        and (lane not in here or parts.get(lane, 0.0) >= WHOLE)
                    ):
                        gain = self._lane_shares(lane)[link.to_edge] * min(parts[lane], 1.0) * flow
                        row[self.movements[link.from_edge, link.to_edge]] += gain
                rows.append(row)
                apart.append(
                    {
                        self.lane_number[lane_id(link)]: SATURATION[state[link.index]]
                        for link in signal.others
                        if state[link.index] in GREEN and lane_id(link) not in self._cars
                    }
                )
        self.gain, self.apart = _sparse(rows, len(self.movements)), _sparse(apart, len(self.lanes))
        self.shared = len(lanes), len(split), len(split - whole)

    def _served(self, signal: Signal, state: str) -> dict[str, float]:
        """Return lane -> share of its vehicles that have green in `state`."""
        to: dict[str, set[str]] = {}
        for link in signal.links:
            if state[link.index] in GREEN and lane_id(link) in self._cars:
                to.setdefault(lane_id(link), set()).add(link.to_edge)
        return {
            lane: sum(self._lane_shares(lane)[edge] for edge in sorted(edges))
            for lane, edges in to.items()
        }

    def _queue(self, edge: str, to: str, *, arriving: bool = False) -> dict[int, float]:
        """Return lane -> share of its vehicles from `edge` to `to`. arriving: also from beyond the
        road"""
        queue = {}
        share = self._turns(edge)[to]
        for lane in self._city.lane_ids[edge]:
            if own := self._lane_shares(lane).get(to) if edge in self._links else share:
                queue[self.lane_number[lane]] = own
        before, last, length = self._upstream(edge), edge, self._city.length[edge]
        while before is not None:
            queue |= {self.lane_number[lane]: share for lane in self._city.lane_ids[before]}
            length, last = length + self._city.length[before], before
            before = self._upstream(before)
        if arriving:
            for before, part in self._arriving(last, length).items():
                queue |= {
                    self.lane_number[lane]: share * part for lane in self._city.lane_ids[before]
                }
        return queue

    def watched(self, link: Link) -> set[int]:
        """Return the lanes (numbers) whose vehicles may wait for a link: its own, and those behind
        a short road."""
        own = {self.lane_number[lane_id(link)]}
        if (link.from_edge, link.to_edge) in self.movements and self._city.length[
            link.from_edge
        ] < SHORT_ROAD_M:
            own |= self._queue(link.from_edge, link.to_edge, arriving=True).keys()
        return own

    def _arriving(self, edge: str, length: float) -> dict[str, float]:
        """Return edge without a signal, within REACH_M of one -> share of its vehicles that take
        `edge`."""
        shares, todo = {edge: 1.0}, [(edge, length)]
        for onward, there in todo:
            for before in self._city.before[onward] if there < REACH_M else ():
                if before not in self._links and before not in shares:
                    shares[before] = shares[onward] * self._turns(before)[onward]
                    todo.append((before, there + self._city.length[before]))
        del shares[edge]
        return shares

    def _lane_shares(self, lane: str) -> dict[str, float]:
        edge = lane.rpartition("_")[0]
        return self._shares(
            edge, sorted({link.to_edge for link in self._links[edge] if lane_id(link) == lane})
        )

    def _turns(self, edge: str) -> dict[str, float]:
        """Return turning shares among all next edges of `edge`, with a signal or not."""
        links = self._links.get(edge)
        return self._shares(
            edge, sorted({link.to_edge for link in links}) if links else self._city.successors[edge]
        )

    def _shares(self, edge: str, targets: Sequence[str]) -> dict[str, float]:
        """Return turning shares among `targets`, equal ones without flow."""
        flows = np.array([self._flows.get((edge, target), 0.0) for target in targets])
        total = flows.sum()
        return dict(
            zip(
                targets, flows / total if total else flows + 1.0 / max(len(targets), 1), strict=True
            )
        )

    def _upstream(self, edge: str) -> str | None:
        """Return the edge before if the road only gets turn lanes here."""
        before = self._city.before[edge]
        alone = (
            len(before) == 1
            and len(self._city.successors[before[0]]) == 1
            and before[0] not in self._links
        )
        return before[0] if alone else None

    def _end(self, edge: str) -> str:
        """Return the last edge of a road from `edge` to the next signal or fork."""
        chain = [edge]
        while (after := self._city.successors[chain[-1]]) and self._upstream(after[0]) == chain[-1]:
            if after[0] in chain:
                break
            chain.append(after[0])
        return chain[-1]


def _sparse(rows: list[dict[int, float]], columns: int) -> csr_array:
    entries = [(n, column, value) for n, row in enumerate(rows) for column, value in row.items()]
    n, column, value = zip(*entries, strict=True) if entries else ((), (), ())
    return csr_array((value, (n, column)), shape=(len(rows), columns))
