"""Pressures of stages from the vehicles on every lane, as sparse matrices.

`Roads.weights` turns vehicles by lane into weights of movements, `Roads.gain` turns weights into
pressures of stages (cosim.plant.max_pressure). Turning shares divide the vehicles on shared lanes
and upstream of the turn lanes. A shared lane counts only for stages that serve all its movements.
If no stage does, it counts with the probability that its first vehicle is served.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.sparse import csr_array

from cosim.plant.stages import stages_of
from cosim.sumo.net import City
from cosim.sumo.signals import GREEN, Link, Signal, lane_id

SHORT_ROAD_M = 15.0  # two vehicles
REACH_M = 100.0  # before a signal within which vehicles count, wherever roads join and part there
WHOLE = 1 - 1e-9  # share of the vehicles of a lane: all of them
PERMISSIVE = 0.3  # saturation flow of a movement that must give way, as a share of a protected one
SATURATION = {"G": 1.0, "g": PERMISSIVE}  # light -> saturation flow [lanes]


class Roads:
    """The roads before signals as matrices from vehicles to pressures.

    lanes: names (L,), those for cars and all others before the signals, such as bus lanes, which
        have no weight
    movements: (edge, next edge) at `signals` -> number; weights: shares of vehicles (-, (M, L))
    gain, apart: saturation flows (lanes) in stages, of movements (S, M), and of lanes on streets
        closed to cars (S, L)
    begins: number of the first stage of every signal
    shared: numbers of lanes for cars before signals, of those that a stage serves in part, and of
        those that no stage serves whole
    """

    def __init__(
        self, city: City, signals: Sequence[Signal], flows: Mapping[tuple[str, str], float]
    ):
        """flows: (edge, next edge) -> flow, any unit, for the turning shares"""
        self._city = city
        self._flows = flows
        cars = [lane for edge in city.edges for lane in city.lane_ids[edge]]
        links = [link for signal in signals for link in signal.links]
        others = [link for signal in signals for link in signal.others]
        self.lanes = list(dict.fromkeys([*cars, *map(lane_id, links), *map(lane_id, others)]))
        self.lane_number = {lane: n for n, lane in enumerate(self.lanes)}
        self._cars = frozenset(cars)
        self._links: dict[str, list[Link]] = {}  # edge -> its links at signals, for cars
        for link in links:
            if lane_id(link) in self._cars:
                self._links.setdefault(link.from_edge, []).append(link)
        movements = set()
        for edge, onward in self._links.items():
            movements |= {(edge, link.to_edge) for link in onward}
        self.movements = {movement: n for n, movement in enumerate(sorted(movements))}
        rows = [self._weight(edge, target) for edge, target in self.movements]
        self.weights = _sparse(rows, len(self.lanes))
        self._add_stages(signals)

    def counted(self, others: np.ndarray) -> np.ndarray:
        """Return the numbers of the lanes whose vehicles count.

        others: numbers of further lanes
        """
        return np.unique(np.concatenate([self.weights.indices, self.apart.indices, others]))

    def watched(self, link: Link) -> set[int]:
        """Return the lanes (numbers) whose vehicles may wait for a link.

        They are its own lane and, if its road is short, those behind the road.
        """
        movement = (link.from_edge, link.to_edge)
        lanes = {self.lane_number[lane_id(link)]}
        if movement in self.movements and self._city.length[link.from_edge] < SHORT_ROAD_M:
            lanes |= self._queue(*movement, arriving=True).keys()
        return lanes

    def _weight(self, edge: str, target: str) -> dict[int, float]:
        """Return the weight of a movement, as lane -> share of its vehicles.

        Those who want to make the movement count, minus those in the way behind it.
        """
        row = self._queue(edge, target, arriving=True)
        end = self._end(target)
        for onward, share in self._turns(end).items():
            for lane, part in self._queue(end, onward).items():
                row[lane] = row.get(lane, 0.0) - share * part
        return row

    def _add_stages(self, signals: Iterable[Signal]) -> None:
        """Set `gain`, `apart`, `begins` and `shared`."""
        self.begins: list[int] = []
        gain: list[dict[int, float]] = []
        apart: list[dict[int, float]] = []
        lanes: set[str] = set()
        split: set[str] = set()
        whole: set[str] = set()
        for signal in signals:
            self.begins.append(len(gain))
            states = [signal.phases[number].state for number in stages_of(signal)]
            served = [self._served(signal, state) for state in states]
            whole_here = set()
            for parts in served:
                for lane, part in parts.items():
                    if part < WHOLE:
                        split.add(lane)
                    else:
                        whole_here.add(lane)
            for state, parts in zip(states, served, strict=True):
                gain.append(self._gain(signal, state, parts, whole_here))
                apart.append(self._apart(signal, state))
            lanes |= {lane_id(link) for link in signal.links}
            whole |= whole_here
        self.gain = _sparse(gain, len(self.movements))
        self.apart = _sparse(apart, len(self.lanes))
        self.shared = len(lanes & self._cars), len(split), len(split - whole)

    def _served(self, signal: Signal, state: str) -> dict[str, float]:
        """Return lane -> share of its vehicles that have green in `state`."""
        targets = defaultdict[str, set[str]](set)
        for link in signal.links:
            if state[link.index] in GREEN and lane_id(link) in self._cars:
                targets[lane_id(link)].add(link.to_edge)
        served = {}
        for lane, edges in targets.items():
            shares = self._lane_shares(lane)
            served[lane] = sum(shares[edge] for edge in sorted(edges))
        return served

    def _gain(
        self, signal: Signal, state: str, served: Mapping[str, float], whole: set[str]
    ) -> dict[int, float]:
        """Return movement -> saturation flow (lanes) in `state`.

        served: lane -> share of its vehicles with green
        whole: lanes that another stage or this one serves wholly
        """
        row = defaultdict[int, float](float)
        # Several links may join the same lane and edge.
        links = {(link.from_edge, link.lane, link.to_edge): link for link in signal.links}
        for link in links.values():
            lane = lane_id(link)
            flow = SATURATION.get(state[link.index])
            if flow is None or lane not in self._cars:
                continue
            if lane in whole and served[lane] < WHOLE:
                continue  # its queue may stand behind a vehicle that this stage does not serve
            share = self._lane_shares(lane)[link.to_edge] * min(served[lane], 1.0)
            row[self.movements[link.from_edge, link.to_edge]] += share * flow
        return row

    def _apart(self, signal: Signal, state: str) -> dict[int, float]:
        """Return lane -> saturation flow (lanes) in `state`.

        Only lanes on streets closed to cars count.
        """
        row = {}
        for link in signal.others:
            light = state[link.index]
            if light in GREEN and lane_id(link) not in self._cars:
                row[self.lane_number[lane_id(link)]] = SATURATION[light]
        return row

    def _queue(self, edge: str, to: str, *, arriving: bool = False) -> dict[int, float]:
        """Return lane -> share of its vehicles from `edge` to `to`.

        arriving: also from beyond the road
        """
        queue = {}
        share = self._turns(edge)[to]
        for lane in self._city.lane_ids[edge]:
            own = share
            if edge in self._links:
                own = self._lane_shares(lane).get(to, 0.0)
            if own:
                queue[self.lane_number[lane]] = own
        first = edge  # of the road
        length = self._city.length[edge]
        while (before := self._upstream(first)) is not None:
            for lane in self._city.lane_ids[before]:
                queue[self.lane_number[lane]] = share
            length += self._city.length[before]
            first = before
        if arriving:
            for before, part in self._arriving(first, length).items():
                for lane in self._city.lane_ids[before]:
                    queue[self.lane_number[lane]] = share * part
        return queue

    def _arriving(self, edge: str, length: float) -> dict[str, float]:
        """Return edge before the road -> share of its vehicles that take `edge`.

        These edges have no signal, and one is within REACH_M. length: of the road from `edge` (m)
        """
        shares = {edge: 1.0}
        todo = [(edge, length)]
        for onward, distance in todo:
            if distance >= REACH_M:
                continue
            for before in self._city.before[onward]:
                if before not in self._links and before not in shares:
                    shares[before] = shares[onward] * self._turns(before)[onward]
                    todo.append((before, distance + self._city.length[before]))
        del shares[edge]
        return shares

    def _lane_shares(self, lane: str) -> dict[str, float]:
        """Return turning shares of a lane before a signal."""
        edge = lane.rpartition("_")[0]
        targets = {link.to_edge for link in self._links[edge] if lane_id(link) == lane}
        return self._shares(edge, sorted(targets))

    def _turns(self, edge: str) -> dict[str, float]:
        """Return turning shares among all next edges of `edge`."""
        if edge not in self._links:
            return self._shares(edge, self._city.successors[edge])
        return self._shares(edge, sorted({link.to_edge for link in self._links[edge]}))

    def _shares(self, edge: str, targets: Sequence[str]) -> dict[str, float]:
        """Return turning shares among `targets`, equal ones without flow."""
        flows = {target: self._flows.get((edge, target), 0.0) for target in targets}
        total = sum(flows.values())
        if not total:
            return dict.fromkeys(targets, 1.0 / max(len(targets), 1))
        return {target: flow / total for target, flow in flows.items()}

    def _upstream(self, edge: str) -> str | None:
        """Return the edge before if the road only gets turn lanes here."""
        edges = self._city.before[edge]
        if len(edges) != 1 or edges[0] in self._links:
            return None
        return edges[0] if len(self._city.successors[edges[0]]) == 1 else None

    def _end(self, edge: str) -> str:
        """Return the last edge of a road from `edge` to the next signal or fork."""
        road = [edge]
        while after := self._city.successors[road[-1]]:
            if self._upstream(after[0]) != road[-1] or after[0] in road:
                break
            road.append(after[0])
        return road[-1]


def _sparse(rows: list[dict[int, float]], columns: int) -> csr_array:
    """Return a matrix with these entries, column -> value in every row."""
    numbers: list[int] = []
    places: list[int] = []
    values: list[float] = []
    for n, row in enumerate(rows):
        numbers += [n] * len(row)
        places += row.keys()
        values += row.values()
    return csr_array((values, (numbers, places)), shape=(len(rows), columns))
