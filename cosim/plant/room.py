"""Gates with room: a command per boundary, shared over its gateways.

The room before and behind the gateways decides.

A command u_ih is the share s = (u_ih - u_min) / (u_max - u_min) of what the boundary i -> h can let
through. Gateway g of this boundary gets the share of green

    s_g = f_g - o_g + m, but at least floor_g and at most 1

f_g: share of the room before g that is taken: on its own lanes or, if that is more, on these and
    all streets that lead there past no signal, up to CHAIN_M away
o_g: share of the room on the street behind g that is taken
m: such that the mean of s_g, weighted by capacity (lanes times original green), is s
floor_g: 0 up to f_g = limit / 2, then linear up to 1 at f_g = limit, so that no command fills a
    chain beyond `limit`

If the floors let more through than s, controllers see it (`realised`). Sharing a permitted inflow
by the queues before the gates: Keyvan-Ekbatani, Carlson, Knoop and Papageorgiou, "Optimizing
distribution of metered traffic flow in perimeter control: queue and delay balancing approaches",
2021.
"""

from collections import defaultdict, deque

import numpy as np

from cosim.sumo.arrays import PerEdge, PerGateway
from cosim.sumo.net import JAM_SPACING, City
from cosim.sumo.session import Session
from nmfd.arrays import PerPair

CHAIN_M = 400.0  # before a gateway


class Room:
    """The shares of one run.

    Call `command` once per control interval and `update` every few seconds.

    share: (G,) [-], of green, from now on
    """

    def __init__(
        self, session: Session, city: City, green: PerGateway, *, limit: float, lanes: bool
    ):
        """green: original one (G,) [s], NaN where no command arrives

        lanes: the simulation has lanes
        limit: share of the room; 0: all gateways of a boundary get the same share
        """
        gateways = city.gateways
        number = city.number
        self._session = session
        self._limit = limit
        self._source = np.array([gateway.source for gateway in gateways], dtype=int)
        self._target = np.array([gateway.target for gateway in gateways], dtype=int)
        self._capacity = np.nan_to_num(green) * [len(gateway.lanes) for gateway in gateways]
        boundaries = defaultdict[tuple[int, int], list[int]](list)
        for n in np.flatnonzero(self._capacity > 0):  # the gateways that obey
            boundaries[gateways[n].source, gateways[n].target].append(n)
        self._boundaries = {pair: np.array(members) for pair, members in boundaries.items()}
        self._room = city.room
        self._behind = np.array([number[gateway.to_edge] for gateway in gateways], dtype=int)
        self._chains: list[list[int]] = []  # of edges
        self._lanes: list[list[str]] = []
        lane_room = []
        for gateway in gateways:
            edge = gateway.from_edge
            self._chains.append([number[street] for street in upstream(city, edge)])
            self._lanes.append([f"{edge}_{lane}" for lane in gateway.lanes] if lanes else [])
            lane_room.append(len(gateway.lanes) * max(city.length[edge] / JAM_SPACING, 1.0))
        self._lane_room = np.array(lane_room)
        self._commanded = np.ones((city.regions, city.regions))
        self._shares: list[PerGateway] = []  # since the last command
        self.share = np.ones(len(gateways))

    def command(self, share: PerPair, vehicles: PerEdge) -> None:
        """Set the shares (R, R) [-] of the boundaries.

        vehicles: (E,) [veh] on the streets
        """
        self._commanded = share
        self._shares = []
        self.update(vehicles)

    def update(self, vehicles: PerEdge) -> None:
        """Share the commands again. vehicles: (E,) [veh] on the streets"""
        self.share = self.command_of_gateways()
        if self._limit > 0 and any(self._commanded[pair] < 1.0 for pair in self._boundaries):
            own = np.array([sum(map(self._session.lane_vehicles, lanes)) for lanes in self._lanes])
            chain = [vehicles[edges].sum() / self._room[edges].sum() for edges in self._chains]
            before = np.clip(np.maximum(own / self._lane_room, chain), 0.0, 1.0)
            behind = vehicles[self._behind] / self._room[self._behind]
            urgency = before - behind
            floor = np.clip(2.0 * before / self._limit - 1.0, 0.0, 1.0)
            for pair, members in self._boundaries.items():
                self.share[members] = shared(
                    self._commanded[pair], urgency[members], floor[members], self._capacity[members]
                )
        self._shares.append(self.share)

    def command_of_gateways(self) -> PerGateway:
        """Return (G,) [-], the share commanded of the boundary of every gateway."""
        return self._commanded[self._source, self._target]

    def gateway_shares(self) -> PerGateway:
        """Return (G,) [-], the mean shares since the last command."""
        return np.mean(self._shares, axis=0)

    def realised(self) -> PerPair | None:
        """Return (R, R) [-], the mean share of each boundary since the command.

        The commanded share counts where no gateway is controlled. None if `chain_limit` is 0.
        """
        if self._limit == 0:
            return None
        realised = self._commanded.copy()
        share = self.gateway_shares()
        for pair, members in self._boundaries.items():
            realised[pair] = np.average(share[members], weights=self._capacity[members])
        return realised


def shared(
    share: float, urgency: PerGateway, floor: PerGateway, capacity: PerGateway
) -> PerGateway:
    """Return clip(urgency + m, floor, 1) with the mean `share`.

    The mean is weighted by capacity; it is that of `floor` if that is more.
    """
    if share >= 1.0:
        return np.ones(len(urgency))
    # The mean is piecewise linear in m, with bends where a gateway reaches floor or 1.
    bends = np.sort(np.concatenate([floor - urgency, 1.0 - urgency]))
    means = np.clip(urgency + bends[:, None], floor, 1.0) @ (capacity / capacity.sum())
    return np.clip(urgency + np.interp(share, means, bends), floor, 1.0)


def upstream(city: City, edge: str) -> list[str]:
    """Return `edge` and the streets that lead there past no signal.

    They end less than CHAIN_M before the end of `edge`.
    """
    to_the_end = {edge: city.length[edge]}  # street -> distance from its begin to the gateway [m]
    waiting = deque([edge])
    while waiting:
        street = waiting.popleft()
        if to_the_end[street] >= CHAIN_M:
            continue
        for source in city.before[street]:
            if source not in city.signals and source not in to_the_end:
                to_the_end[source] = to_the_end[street] + city.length[source]
                waiting.append(source)
    return list(to_the_end)
