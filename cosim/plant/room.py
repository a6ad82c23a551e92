"""Gates with room: a command per boundary, shared over its gateways by the room before and behind
them.

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

import numpy as np

from cosim.sumo.arrays import PerEdge, PerGateway
from cosim.sumo.net import JAM_SPACING, City
from cosim.sumo.session import Session
from nmfd.arrays import PerPair

CHAIN_M = 400.0  # before a gateway


class Room:
    """The shares of one run: `command` once per control interval, `update` every few seconds.

    share: (G,) [-], of green, from now on
    """

    def __init__(
        self, session: Session, city: City, green: PerGateway, *, limit: float, lanes: bool
    ):
        """green: original one (G,), NaN where no command arrives; lanes: the simulation has lanes

        limit: share of the room; 0: all gateways of a boundary get the same share
        """
        gateways, number = city.gateways, city.number
        self._session, self._limit = session, limit
        self._source, self._target = (
            np.array([(g.source, g.target) for g in gateways], dtype=int).reshape(-1, 2).T
        )
        self._capacity = np.nan_to_num(green) * [len(g.lanes) for g in gateways]
        obedient = np.flatnonzero(self._capacity > 0)
        pairs = self._source[obedient], self._target[obedient]
        self._boundaries = {
            (int(i), int(h)): obedient[(pairs[0] == i) & (pairs[1] == h)]
            for i, h in set(zip(*pairs, strict=True))
        }
        self._room = city.room
        self._behind = np.array([number[g.to_edge] for g in gateways], dtype=int)
        self._chains = [[number[edge] for edge in upstream(city, g.from_edge)] for g in gateways]
        self._lanes = [
            [f"{g.from_edge}_{lane}" for lane in g.lanes] if lanes else [] for g in gateways
        ]
        self._lane_room = np.array(
            [len(g.lanes) * max(city.length[g.from_edge] / JAM_SPACING, 1.0) for g in gateways]
        )
        self._commanded = np.ones((city.regions, city.regions))
        self._shares: list[PerGateway] = []  # since the last command
        self.share = np.ones(len(gateways))

    def command(self, share: PerPair, vehicles: PerEdge) -> None:
        """Set the shares (R, R) [-] of the boundaries. vehicles: (E,) [veh] on the streets"""
        self._commanded, self._shares = share, []
        self.update(vehicles)

    def update(self, vehicles: PerEdge) -> None:
        """Share the commands again. vehicles: (E,) [veh] on the streets"""
        self.share = self.command_of_gateways()
        if self._limit > 0 and any(self._commanded[pair] < 1.0 for pair in self._boundaries):
            own = np.array([sum(map(self._session.lane_vehicles, lanes)) for lanes in self._lanes])
            chain = [vehicles[edges].sum() / self._room[edges].sum() for edges in self._chains]
            before = np.clip(np.maximum(own / self._lane_room, chain), 0.0, 1.0)
            behind = vehicles[self._behind] / self._room[self._behind]
            floor = np.clip(2.0 * before / self._limit - 1.0, 0.0, 1.0)
            for pair, members in self._boundaries.items():
                urgency, capacity = (before - behind)[members], self._capacity[members]
                self.share[members] = shared(
                    self._commanded[pair], urgency, floor[members], capacity
                )
        self._shares.append(self.share)

    def command_of_gateways(self) -> PerGateway:
        """Return (G,) [-], the share commanded of the boundary of every gateway."""
        return self._commanded[self._source, self._target]

    def gateway_shares(self) -> PerGateway:
        """Return (G,) [-], the mean shares since the last command."""
        return np.mean(self._shares, axis=0)

    def realised(self) -> PerPair | None:
        """Return the mean shares (R, R) [-] since the command, which counts where no gate obeys;
        None without limit."""
        if self._limit == 0:
            return None
        realised, share = self._commanded.copy(), self.gateway_shares()
        for pair, members in self._boundaries.items():
            realised[pair] = np.average(share[members], weights=self._capacity[members])
        return realised


def shared(
    share: float, urgency: PerGateway, floor: PerGateway, capacity: PerGateway
) -> PerGateway:
    """Return clip(urgency + m, floor, 1) with the mean `share`, weighted by capacity, or `floor` if
    that is more."""
    if share >= 1.0:
        return np.ones(len(urgency))
    bends = np.sort(
        np.concatenate([floor - urgency, 1.0 - urgency])
    )  # m where the mean, piecewise linear, bends
    means = np.clip(urgency + bends[:, None], floor, 1.0) @ (capacity / capacity.sum())
    return np.clip(urgency + np.interp(share, means, bends), floor, 1.0)


def upstream(city: City, edge: str) -> list[str]:
    """Return `edge` and all streets that lead there past no signal and end less than CHAIN_M before
    its end."""
    chain, waiting = {edge: city.length[edge]}, [edge]
    while waiting:
        street = waiting.pop(0)
        for source in city.before[street]:
            if chain[street] < CHAIN_M and source not in city.signals and source not in chain:
                chain[source] = chain[street] + city.length[source]
                waiting.append(source)
    return list(chain)
