"""Route guidance to reroutes: the next region of a vehicle is drawn from the split ratios, once per region it enters.

A guided vehicle in region i bound for edge d takes the fastest way inside i to a gateway i -> h, and from there to d
without coming back to i, at the travel times of the last control interval (smoothed). In h it is guided again.
"""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cosim.measure import Event
from cosim.regions import City
from cosim.sumo import Session

SMOOTHING = 0.5  # weight of the newest travel times
NONE = -9999  # scipy's "no predecessor"


class Guide:
    """Reroutes vehicles; `compliance` is the probability that a driver follows, drawn anew in every region.

    realised: (R, R, R) [veh], [i, h, j] = vehicles sent from i to h on their way to j since the start
    """

    def __init__(self, session: Session, city: City, *, compliance: float, random: np.random.Generator):
        self._session, self._city, self._compliance, self._random = session, city, compliance, random
        self._index = {edge: n for n, edge in enumerate(city.edges)}
        self._region = np.array([city.region_of[edge] for edge in city.edges])
        pairs = [(self._index[e], self._index[f]) for e, after in city.successors.items() for f in after]
        self._from, self._to = (np.array(column) for column in zip(*pairs, strict=True))
        self._turn = np.array([city.turn_time[pair] for pair in (
            (e, f) for e, after in city.successors.items() for f in after)])
        self._time = np.array([city.length[edge] / city.speed[edge] for edge in city.edges])
        self._ways: dict[int, _Ways] = {}
        self._splits: np.ndarray | None = None
        self.realised = np.zeros((city.regions,) * 3, dtype=int)
        self.refused = 0

    def command(self, splits: np.ndarray | None) -> None:
        """Take over theta (R, R, R) [-] for the next control interval and the travel times of the last; None: no
        guidance."""
        self._splits = splits
        if splits is not None:
            now = np.array([self._session.travel_time(edge) for edge in self._city.edges])
            self._time += SMOOTHING * (np.minimum(now, 3600.0) - self._time)
            self._ways = {}

    def apply(self, events: list[Event]) -> None:
        """Guide the vehicles that departed or entered a region in the last step."""
        if self._splits is None:
            return
        for event in events:
            if event.region != event.destination and self._random.random() < self._compliance:
                self._guide(event)

    def _guide(self, event: Event) -> None:
        ways, target = self._ways_from(event.region), self._index[event.edge]
        here = self._index.get(self._session.road(event.vehicle))
        if here is None or self._region[here] != event.region:  # on a junction already: too late to turn
            return
        cost = ways.cost(here, target)
        reachable = np.isfinite(np.minimum.reduceat(cost, ways.begins))
        shares = np.cumsum(self._splits[event.region, ways.neighbours, event.destination] * reachable)
        if shares[-1] <= 0:
            return
        n = int(np.searchsorted(shares, self._random.random() * shares[-1], side="right"))
        following = int(ways.neighbours[n])
        gateway = int(ways.begins[n] + np.argmin(cost[ways.begins[n] : ways.ends[n]]))
        route = [self._city.edges[n] for n in ways.route(here, gateway, target)]
        if self._session.set_route(event.vehicle, route):
            self.realised[event.region, following, event.destination] += 1
        else:
            self.refused += 1

    def _ways_from(self, region: int) -> "_Ways":
        if region not in self._ways:
            gateways = [g for g in self._city.gateways if g.source == region]
            self._ways[region] = _Ways(
                first=np.array([self._index[g.from_edge] for g in gateways]),
                second=np.array([self._index[g.to_edge] for g in gateways]),
                next_region=np.array([g.target for g in gateways]),  # sorted, as the gateways are
                inside=self._graph(self._region == region, reverse=True),
                outside=self._graph(self._region != region, reverse=False), time=self._time)
        return self._ways[region]

    def _graph(self, allowed: np.ndarray, *, reverse: bool) -> csr_array:
        """Moves between allowed edges; a move costs the time of the turn and of the edge that it leads to."""
        keep = allowed[self._from] & allowed[self._to]
        rows, columns = self._from[keep], self._to[keep]
        cost = np.maximum(self._time[columns] + self._turn[keep], 1e-3)
        size = len(self._time)
        return csr_array((cost, (columns, rows) if reverse else (rows, columns)), shape=(size, size))


class _Ways:
    """Fastest ways out of one region by each of its G gateways (first[g] -> second[g], into next_region[g]).

    Gateways begins[n] to ends[n] - 1 lead into region neighbours[n].
    """

    def __init__(self, *, first, second, next_region, inside, outside, time):
        self._first, self._second = first, second
        self.neighbours, self.begins = np.unique(next_region, return_index=True)
        self.ends = np.append(self.begins[1:], len(next_region))
        self._to_gateway, self._after = dijkstra(inside, indices=first, return_predecessors=True)
        self._from_gateway, self._before = dijkstra(outside, indices=second, return_predecessors=True)
        self._enter = time[second]

    def cost(self, here: int, target: int) -> np.ndarray:
        """(G,) [s] from the end of edge `here` to the end of edge `target`; infinite where there is no way."""
        return self._to_gateway[:, here] + self._enter + self._from_gateway[:, target]

    def route(self, here: int, gateway: int, target: int) -> list[int]:
        """The edges from `here` to `target` through `gateway`."""
        to_gateway = [here]
        while to_gateway[-1] != self._first[gateway]:
            to_gateway.append(int(self._after[gateway, to_gateway[-1]]))
        back = [target]
        while back[-1] != self._second[gateway]:
            back.append(int(self._before[gateway, back[-1]]))
        return to_gateway + back[::-1]
