"""Links, turns and cells of the link model, from routes."""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from cosim.evaluation.link_vehicles import Drive, Route
from cosim.sumo.net import City, Connection, connections_for_cars
from nmfd.arrays import Arrays
from nmfd.errors import InputError

Movement: TypeAlias = tuple[str, str]  # street, next street
Turn: TypeAlias = tuple[Movement, int]  # and the link entered
Lanes: TypeAlias = frozenset[int]
LONG_M = 100.0  # of a street on which all vehicles find their lane


def connections_of(city: City) -> dict[Movement, list[Connection]]:
    """Return the connections of each movement between lanes for cars."""
    connections = defaultdict[Movement, list[Connection]](list)
    for connection in connections_for_cars(city.net_file, city.number.keys()):
        connections[connection.source, connection.target].append(connection)
    return dict(connections)


class Streets:
    """Links of the streets on some routes.

    movements: sorted
    connections: of each
    links: street and lanes of each, shortest first
    number: street and lane -> number of the link
    link_of: movement -> its link
    """

    def __init__(
        self,
        city: City,
        connections: Mapping[Movement, Sequence[Connection]],
        routes: Iterable[Route],
        where: str,
    ):
        """where: file that errors name

        Raises: InputError if a connection is missing
        """
        self.city = city
        self.connections = connections
        movements = {pair for route in routes for pair in itertools.pairwise(route)}
        for movement in sorted(movements.difference(connections)):
            problem = "no connection leads from {} to {}".format(*movement)
            raise InputError(f"{where}: sumo.routes: {problem}; give routes of this network")
        self.movements = sorted(movements)
        groups: dict[str, list[Lanes]] = {}
        for street in sorted({street for route in routes for street in route}):
            groups[street] = [frozenset({lane}) for lane in _lanes(city, street)]
        for street, onward in self.movements:
            lanes = {connection.lane for connection in connections[street, onward]}
            joined = frozenset[int]()
            apart = []
            for group in groups[street]:
                if group & lanes:
                    joined |= group
                else:
                    apart.append(group)
            groups[street] = [*apart, joined]
        links = [(street, group) for street, some in groups.items() for group in some]
        self.links = sorted(links, key=lambda link: (city.length[link[0]], link[0], min(link[1])))
        self.number: dict[tuple[str, int], int] = {}
        for number, (street, group) in enumerate(self.links):
            for lane in group:
                self.number[street, lane] = number
        self.link_of = {
            (street, onward): self.number[street, connections[street, onward][0].lane]
            for street, onward in self.movements
        }

    def ends(self, movement: Movement) -> dict[int, float]:
        """Return link -> share of the lanes that a movement leads to."""
        entered = {
            self.number[movement[1], connection.to_lane]
            for connection in self.connections[movement]
        }
        total = sum(len(self.links[link][1]) for link in entered)
        return {link: len(self.links[link][1]) / total for link in sorted(entered)}

    def lanes(self, turn: Turn) -> list[int]:
        """Return the lanes of a movement that lead to a link.

        They are all its lanes if none leads there, or the next street is long: vehicles change
        lanes behind the junction.
        """
        movement, link = turn
        connections = self.connections[movement]
        lanes: set[int] = set()
        if self.city.length[movement[1]] < LONG_M:
            lanes = {one.lane for one in connections if one.to_lane in self.links[link][1]}
        return sorted(lanes or {one.lane for one in connections})


def _lanes(city: City, street: str) -> list[int]:
    return [int(name.rpartition("_")[2]) for name in city.lane_ids[street]]


class Counts:
    """Vehicles on the routes.

    cells: by (turn, destination)
    flows: by movement
    entering, ending: by (link, destination), those that do not begin there, and that end there
    beginning: by (link, destination), trips that begin there
    trips: by (region, destination)
    first, last: sums of Drive by link
    """

    def __init__(self, streets: Streets, drives: Iterable[Drive]):
        self.cells = defaultdict[tuple[Turn, int], float](float)
        self.flows = Counter[Movement]()
        self.entering = defaultdict[tuple[int, int], float](float)
        self.ending = defaultdict[tuple[int, int], float](float)
        self.beginning = Counter[tuple[int, int]]()
        self.trips = Counter[tuple[int, int]]()
        self.first = defaultdict[int, float](float)
        self.last = defaultdict[int, float](float)
        region_of = streets.city.region_of
        for _, route, first, last in drives:
            destination = region_of[route[-1]]
            movements = list(itertools.pairwise(route))
            links = [streets.link_of[movement] for movement in movements]
            self.flows.update(movements)
            self.trips[region_of[route[0]], destination] += 1
            self.beginning[links[0], destination] += 1
            self.first[links[0]] += first
            for movement, link in zip(movements, links[1:], strict=False):
                self.cells[(movement, link), destination] += 1
                self.entering[link, destination] += 1
            for link, share in streets.ends(movements[-1]).items():
                self.cells[(movements[-1], link), destination] += share
                self.entering[link, destination] += share
                self.ending[link, destination] += share
                self.last[link] += share * last


def link_arrays(streets: Streets, blocked: Mapping[str, float]) -> Arrays:
    """Return the arrays of links and lanes.

    blocked: lane -> share of the time in which a stopping vehicle blocks it
    """
    city = streets.city
    names = [street for street, _ in streets.links]
    behind = defaultdict[int, list[tuple[float, float]]](list)  # time and length over the junction
    for movement, link in streets.link_of.items():
        length = sum(city.inside.get(edge, 0.0) for edge in city.over.get(movement, ()))
        behind[link].append((city.turn_time[movement], length))
    over = np.array([np.mean(behind.get(link, [(0.0, 0.0)]), axis=0) for link in range(len(names))])
    length = np.array([city.length[street] for street in names])
    limit = np.array([city.speed[street] for street in names])
    stopped = []
    for street, lanes in streets.links:
        stopped.append(np.mean([blocked.get(f"{street}_{lane}", 0.0) for lane in lanes]))
    return {
        "street": np.array(names),
        "length": length,
        "behind": over[:, 1],
        "limit": limit,
        "stopped": np.array(stopped),
        "free_time": length / limit + over[:, 0],
        "region": np.array([city.region_of[street] for street in names]),
        "lane_link": np.repeat(np.arange(len(names)), [len(lanes) for _, lanes in streets.links]),
    }


def vehicle_arrays(
    streets: Streets, free_time: np.ndarray, counts: Counts, draws: Sequence[Counts]
) -> Arrays:
    """Return the arrays of turns, entries and cells.

    free_time: of the links (s, (L,))
    counts: of all draws of trips together
    """
    number_of = {movement: number for number, movement in enumerate(streets.movements)}
    lane_number: dict[tuple[str, int], int] = {}
    for street, lanes in streets.links:
        for lane in sorted(lanes):
            lane_number[street, lane] = len(lane_number)
    turns = sorted({turn for turn, _ in counts.cells})
    turn_number = {turn: number for number, turn in enumerate(turns)}
    serving = []
    for number, turn in enumerate(turns):
        street, _ = turn[0]
        serving += [(number, lane_number[street, lane]) for lane in streets.lanes(turn)]
    served, server = np.array(serving).T
    entries = sorted(
        {*counts.entering, *counts.beginning}, key=lambda entry: (free_time[entry[0]], entry)
    )
    entry_number = {entry: number for number, entry in enumerate(entries)}
    cells = sorted(counts.cells)
    source = [entry_number[streets.link_of[turn[0]], destination] for turn, destination in cells]
    pairs = [(streets.city.region_of[streets.links[link][0]], j) for link, j in entries]
    every = [counts, *draws]
    entering = np.array([[one.entering[entry] for entry in entries] for one in every])
    ending = np.array([[one.ending[entry] for entry in entries] for one in every])
    beginning = np.array([[one.beginning[entry] for entry in entries] for one in every])
    trips = np.array([[one.trips[pair] for pair in pairs] for one in every], dtype=float)
    vehicles = np.array([[one.cells[cell] for cell in cells] for one in every])
    leaving = np.array([np.bincount(source, some, len(entries)) for some in vehicles])
    entered = np.array([link for link, _ in entries])
    links = range(len(streets.links))
    first = [counts.first[link] for link in links]
    last = [counts.last[link] for link in links]
    begun = np.bincount(entered, beginning[0], len(links))
    ended = np.bincount(entered, ending[0], len(links))
    return {
        "turn_movement": np.array([number_of[movement] for movement, _ in turns]),
        "turn_link": np.array([link for _, link in turns]),
        "served": served,
        "server": server,
        "entry_link": entered,
        "first": np.divide(first, begun, where=begun > 0, out=np.ones(len(links))),
        "last": np.divide(last, ended, where=ended > 0, out=np.ones(len(links))),
        "destination": np.array([destination for _, destination in entries]),
        "ending": _shares(ending, entering),
        "origin": _shares(beginning, trips),
        "cell_turn": np.array([turn_number[turn] for turn, _ in cells]),
        "cell_entry": np.array(source),
        "cell_onward": np.array([entry_number[turn[1], j] for turn, j in cells]),
        "cell_share": _shares(vehicles, leaving[:, source]),
    }


def _shares(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return shares by draw (-, (D, n)).

    Where a draw has no vehicle, the share is that of all draws together.

    part, whole: vehicles of all draws together, then of each ((1 + D, n))
    """
    with np.errstate(invalid="ignore"):
        together, *by_draw = part / whole
    return np.where(np.isnan(by_draw), np.nan_to_num(together), by_draw)
