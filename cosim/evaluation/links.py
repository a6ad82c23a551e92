"""Network of the link model (nmfd.model.links), from a SUMO network and static routes.

A link has the lanes of a street that share movements. Shares of turns, origins and ends of trips
are counted on the static routes. Lights follow the signal programmes.
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from cosim.plant.gates import MIN_GREEN_S, least_times
from cosim.plant.pressure import Roads
from cosim.plant.settings import Settings, own_files, settings
from cosim.plant.stages import stages_of, transition
from cosim.sumo import recorded_trips as recorded
from cosim.sumo.net import City, city_of
from cosim.sumo.session import Phase
from cosim.sumo.signals import HELD, Signal, phases_of, read_signals
from cosim.sumo.trips import PLANNING_SEEDS, make_trips
from cosim.sumo.xml_files import attribute, network_root, read_xml
from nmfd.errors import InputError
from nmfd.model.links.network import FILE, LinkNetwork
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped

Route: TypeAlias = tuple[str, ...]
Movement: TypeAlias = tuple[str, str]  # street, next street
Turn: TypeAlias = tuple[Movement, int]  # and the link entered
Lanes: TypeAlias = frozenset[int]
# Light -> share of the saturation flow.
CAPACITY = {"G": 1.0, "g": 1.0, "o": 1.0, "O": 1.0, "s": 0.5}
GIVES_WAY = frozenset("gso")  # lights
MINOR = frozenset("m=so")  # states of connections without a signal that must give way


class Connection(NamedTuple):
    """A lane of a movement, and the lane that it leads to.

    signal: None without one
    place: in the signal's state
    """

    lane: int
    entered: int
    signal: str | None
    place: int
    state: str


class Programme(NamedTuple):
    """Phases of a signal; offset: of its cycle (s)."""

    offset: float
    phases: Sequence[Phase]


class Lights(NamedTuple):
    """Capacity (-) and duty to give way (0 or 1) in every second of a cycle."""

    light: np.ndarray
    yields: np.ndarray


def write_links(scenario: Scenario, path: Path | None = None) -> Path:
    """Write the link network of `scenario` into its folder, or to `path`; return the file.

    Raises: InputError if a route leads where no connection is
    """
    if path is None:
        folder = scenario.folder or Path()
        path = shipped.beside(folder, FILE, "--out FILE", scenario=True)
    link_network(scenario).write(path)
    return path


def link_network(scenario: Scenario, routes: Iterable[Route] | None = None) -> LinkNetwork:
    """Return the link network of `scenario`; routes: static ones, those of the scenario if None.

    Raises: InputError if a route leads where no connection is
    """
    chosen, city = settings(scenario), city_of(scenario.network)
    if routes is None:
        routes = static_routes(scenario, chosen, city)
    driven = [route for route in routes if len(route) > 1]
    streets = _Streets(city, _read_connections(city), driven, scenario.where)
    counts = _Counts(streets, driven)
    files = own_files(scenario, chosen.additional)
    steered, _ = read_signals(city, files, HELD)
    obeying = {signal.id for signal in steered}.difference(chosen.leave_signals)
    gated = {
        (gateway.from_edge, gateway.to_edge)
        for gateway in city.gateways
        if gateway.signal in obeying
    }
    return LinkNetwork(
        regions=city.regions,
        **_link_arrays(streets),
        **_movement_arrays(streets, _programmes(city, files), chosen.begin, gated),
        **_vehicle_arrays(streets, counts),
        **_stage_arrays(streets, counts, steered),
    )


def static_routes(scenario: Scenario, settings: Settings, city: City) -> list[Route]:
    """Return the routes of the recorded trips, or those of trips made from the demand."""
    if not settings.routes:
        made = [make_trips(city, scenario.demand, scenario.step, seed) for seed in PLANNING_SEEDS]
        return [route for trips in made for route in trips.routes]
    shared = recorded.read_routes(own_files(scenario, settings.additional))
    routes = []
    for element in recorded.read_recorded_trips(own_files(scenario, settings.routes)).elements:
        edges, driven = recorded.edges_of(element, shared)
        if driven and city.number.keys() >= set(edges):
            routes.append(tuple(edges))
    return routes


def _read_connections(city: City) -> dict[Movement, list[Connection]]:
    """Return the connections of each movement between lanes that cars may use."""
    cars = {lane for lanes in city.lane_ids.values() for lane in lanes}
    connections = defaultdict[Movement, list[Connection]](list)
    with network_root(city.net_file) as root:
        for element in root.iterfind("connection"):
            source, target = attribute(element, "from"), attribute(element, "to")
            lane, entered = attribute(element, "fromLane"), attribute(element, "toLane")
            if f"{source}_{lane}" in cars and f"{target}_{entered}" in cars:
                connection = Connection(
                    lane=int(lane),
                    entered=int(entered),
                    signal=element.get("tl"),
                    place=int(element.get("linkIndex", "-1")),
                    state=element.get("state", "M"),
                )
                connections[source, target].append(connection)
    return dict(connections)


def _programmes(city: City, additional: Iterable[Path]) -> dict[str, Programme]:
    """Return the programme of each signal: the last one of those that SUMO reads."""
    programmes = {}
    for root in (read_xml(city.net_file), *map(read_xml, additional)):
        for logic in root.iter("tlLogic"):
            offset = float(logic.get("offset", 0.0))
            programmes[attribute(logic, "id")] = Programme(offset, phases_of(logic))
    return programmes


def _foes(city: City) -> set[tuple[Movement, Movement]]:
    """Return pairs of movements of which the first gives way to the second."""
    movement_over = {}
    for movement, way in city.over.items():
        for edge in way:
            movement_over[edge] = movement
    pairs = set()
    with network_root(city.net_file) as root:
        for junction in root.iterfind("junction"):
            inner = [lane.rpartition("_")[0] for lane in (junction.get("intLanes") or "").split()]
            movements = [movement_over.get(edge) for edge in inner]
            for request in junction.iterfind("request"):
                own = None
                number = int(attribute(request, "index"))
                if number < len(movements):
                    own = movements[number]
                # The last bit is that of the first movement.
                bits = reversed(attribute(request, "response"))
                for other, bit in zip(movements, bits, strict=False):
                    if bit == "1" and own and other and other != own:
                        pairs.add((own, other))
    return pairs


class _Streets:
    """Links of the streets on some routes.

    movements: sorted
    connections: of each
    links: street and lanes of each, shortest first
    link_of: movement -> its link
    """

    def __init__(
        self,
        city: City,
        connections: Mapping[Movement, Sequence[Connection]],
        routes: Iterable[Route],
        where: str,
    ):
        """where: file that errors name. Raises InputError if a connection is missing."""
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
        self._number = {}
        for number, (street, group) in enumerate(self.links):
            for lane in group:
                self._number[street, lane] = number
        self.link_of = {
            (street, onward): self._number[street, connections[street, onward][0].lane]
            for street, onward in self.movements
        }

    def ends(self, movement: Movement) -> dict[int, float]:
        """Return the links that a movement leads to, each with its share of their lanes."""
        entered = {
            self._number[movement[1], connection.entered]
            for connection in self.connections[movement]
        }
        total = sum(len(self.links[link][1]) for link in entered)
        return {link: len(self.links[link][1]) / total for link in sorted(entered)}

    def lanes(self, turn: Turn) -> list[int]:
        """Return the lanes of a movement that lead to a link.

        They are all its lanes if none leads there: vehicles change lanes behind the junction.
        """
        movement, link = turn
        connections = self.connections[movement]
        lanes = {one.lane for one in connections if one.entered in self.links[link][1]}
        return sorted(lanes or {one.lane for one in connections})


def _lanes(city: City, street: str) -> list[int]:
    return [int(name.rpartition("_")[2]) for name in city.lane_ids[street]]


class _Counts:
    """Vehicles on the routes.

    cells: by (turn, destination)
    flows: by movement
    entering, ending: by (link, destination), those that do not begin there, and that end there
    beginning: by (link, destination), trips that begin there
    trips: by (region, destination)
    """

    def __init__(self, streets: _Streets, routes: Iterable[Route]):
        self.cells = defaultdict[tuple[Turn, int], float](float)
        self.flows = Counter[Movement]()
        self.entering = defaultdict[tuple[int, int], float](float)
        self.ending = defaultdict[tuple[int, int], float](float)
        self.beginning = Counter[tuple[int, int]]()
        self.trips = Counter[tuple[int, int]]()
        region_of = streets.city.region_of
        for route in routes:
            destination = region_of[route[-1]]
            movements = list(itertools.pairwise(route))
            links = [streets.link_of[movement] for movement in movements]
            self.flows.update(movements)
            self.trips[region_of[route[0]], destination] += 1
            self.beginning[links[0], destination] += 1
            for movement, link in zip(movements, links[1:], strict=False):
                self.cells[(movement, link), destination] += 1
                self.entering[link, destination] += 1
            for link, share in streets.ends(movements[-1]).items():
                self.cells[(movements[-1], link), destination] += share
                self.entering[link, destination] += share
                self.ending[link, destination] += share


def _link_arrays(streets: _Streets) -> dict[str, np.ndarray]:
    """Return the arrays of links and lanes."""
    city = streets.city
    names = [street for street, _ in streets.links]
    behind = defaultdict[int, list[tuple[float, float]]](list)  # time and length over the junction
    for movement, link in streets.link_of.items():
        length = sum(city.inside.get(edge, 0.0) for edge in city.over.get(movement, ()))
        behind[link].append((city.turn_time[movement], length))
    over = np.array([np.mean(behind.get(link, [(0.0, 0.0)]), axis=0) for link in range(len(names))])
    length = np.array([city.length[street] for street in names])
    return {
        "street": np.array(names),
        "length": length,
        "behind": over[:, 1],
        "free_time": length / [city.speed[street] for street in names] + over[:, 0],
        "region": np.array([city.region_of[street] for street in names]),
        "lane_link": np.repeat(np.arange(len(names)), [len(lanes) for _, lanes in streets.links]),
    }


def _movement_arrays(
    streets: _Streets,
    programmes: Mapping[str, Programme],
    begin: float,
    gated: Collection[Movement],
) -> dict[str, np.ndarray]:
    """Return the arrays of movements, their lights from `begin` (s) on, and right of way."""
    city = streets.city
    number = {movement: n for n, movement in enumerate(streets.movements)}
    speeds = []
    lights = []
    for movement in streets.movements:
        first = next(iter(city.over.get(movement, ())), "")
        speed = city.speed[movement[0]]
        if city.inside.get(first) and city.turn_time[movement]:
            speed = min(speed, city.inside[first] / city.turn_time[movement])
        speeds.append(speed)
        shown = [_shown(one, programmes, begin) for one in streets.connections[movement]]
        cycle = max(len(one.light) for one in shown)
        light = np.mean([np.resize(one.light, cycle) for one in shown], axis=0)
        yields = np.mean([np.resize(one.yields, cycle) for one in shown], axis=0)
        lights.append(Lights(light, yields))
    pairs = []
    for movement, foe in sorted(_foes(city)):
        if movement in number and foe in number:
            pairs.append((number[movement], number[foe]))
    cycles = [len(one.light) for one in lights]
    yielding, foe_of = np.array(pairs, dtype=int).reshape(-1, 2).T
    return {
        "movement_link": np.array([streets.link_of[movement] for movement in streets.movements]),
        "speed": np.array(speeds),
        "yielding": yielding,
        "foe": foe_of,
        "cycle": np.array(cycles),
        "begin": np.concatenate([[0], np.cumsum(cycles)[:-1]]),
        "light": np.concatenate([one.light for one in lights]),
        "yields": np.concatenate([one.yields for one in lights]),
        "gated": np.array([movement in gated for movement in streets.movements]),
    }


def _shown(connection: Connection, programmes: Mapping[str, Programme], begin: float) -> Lights:
    """Return the lights of a connection; one second if it has no signal."""
    programme = programmes.get(connection.signal or "")
    if programme is None:
        return Lights(np.ones(1), np.array([float(connection.state in MINOR)]))
    offset, phases = programme
    ends = np.cumsum([phase.duration for phase in phases])
    cycle = max(round(ends[-1]), 1)
    clock = (begin - offset + np.arange(cycle) + 0.5) % ends[-1]
    number = np.searchsorted(ends, clock, side="right")
    states = [phases[n].state[connection.place] for n in number]
    light = np.array([CAPACITY.get(state, 0.0) for state in states])
    return Lights(light, np.array([float(state in GIVES_WAY) for state in states]))


def _vehicle_arrays(streets: _Streets, counts: _Counts) -> dict[str, np.ndarray]:
    """Return the arrays of turns, entries and cells."""
    region_of = streets.city.region_of
    free_time = _link_arrays(streets)["free_time"]
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
    origin = []
    ending = []
    for link, destination in entries:
        trips = counts.trips[region_of[streets.links[link][0]], destination]
        origin.append(counts.beginning[link, destination] / max(trips, 1))
        entering = counts.entering[link, destination]
        ending.append(counts.ending[link, destination] / max(entering, 1e-9))
    cells = sorted(counts.cells)
    source = [entry_number[streets.link_of[turn[0]], destination] for turn, destination in cells]
    vehicles = np.array([counts.cells[cell] for cell in cells])
    leaving = np.bincount(source, vehicles, len(entries))
    return {
        "turn_movement": np.array([number_of[movement] for movement, _ in turns]),
        "turn_link": np.array([link for _, link in turns]),
        "served": served,
        "server": server,
        "entry_link": np.array([link for link, _ in entries]),
        "destination": np.array([destination for _, destination in entries]),
        "ending": np.array(ending),
        "origin": np.array(origin),
        "cell_turn": np.array([turn_number[turn] for turn, _ in cells]),
        "cell_entry": np.array(source),
        "cell_onward": np.array([entry_number[turn[1], j] for turn, j in cells]),
        "cell_share": vehicles / leaving[source],
    }


def _stage_arrays(
    streets: _Streets, counts: _Counts, signals: Sequence[Signal]
) -> dict[str, np.ndarray]:
    """Return the arrays of the signals that can choose their stages."""
    number_of = {signal.id: number for number, signal in enumerate(signals)}
    phases = [stages_of(signal) for signal in signals]
    count = len(signals)
    most = max(map(len, phases), default=1)
    own = np.full(len(streets.movements), -1)
    light = np.zeros((len(streets.movements), most))
    yields = np.zeros_like(light)
    for row, movement in enumerate(streets.movements):
        here = streets.connections[movement]
        number = number_of.get(here[0].signal or "", -1)
        if number < 0:
            continue
        own[row] = number
        for stage, phase in enumerate(phases[number]):
            states = [signals[number].phases[phase].state[one.place] for one in here]
            light[row, stage] = np.mean([CAPACITY.get(state, 0.0) for state in states])
            yields[row, stage] = np.mean([state in GIVES_WAY for state in states])
    loss = np.zeros((count, most, most))
    low = np.full((count, most), MIN_GREEN_S)
    for row, (signal, numbers) in enumerate(zip(signals, phases, strict=True)):
        least = least_times(signal.phases)
        for stage, phase in enumerate(numbers):
            low[row, stage] = max(least[phase], MIN_GREEN_S)
            for other, coming in enumerate(numbers):
                if other != stage:
                    between = transition(signal.phases, phase, coming)
                    loss[row, stage, other] = sum(part.duration for part in between)
    return {
        "signal": own,
        "stages": np.array([len(numbers) for numbers in phases], dtype=int),
        "stage_light": light,
        "stage_yields": yields,
        "stage_loss": loss,
        "stage_least": low,
        **_pressure_arrays(streets, Roads(streets.city, signals, counts.flows), phases),
    }


def _pressure_arrays(
    streets: _Streets, roads: Roads, phases: Sequence[Sequence[int]]
) -> dict[str, np.ndarray]:
    """Return the weights of cosim.plant.max_pressure; the lanes of a link share its vehicles."""
    link_of_lane = np.full(len(roads.lanes), -1)
    part = np.zeros(len(roads.lanes))
    for link, (street, lanes) in enumerate(streets.links):
        for lane in lanes:
            number = roads.lane_number[f"{street}_{lane}"]
            link_of_lane[number] = link
            part[number] = 1.0 / len(lanes)
    row_of = np.full(len(roads.movements), -1)
    for row, movement in enumerate(streets.movements):
        if movement in roads.movements:
            row_of[roads.movements[movement]] = row
    most = max(map(len, phases), default=1)
    place: list[int] = []
    for number, some in enumerate(phases):
        first = number * most
        place += range(first, first + len(some))
    weights = roads.weights.tocoo()
    gain = roads.gain.tocoo()
    weighed = (row_of[weights.row] >= 0) & (link_of_lane[weights.col] >= 0)
    gained = row_of[gain.col] >= 0
    return {
        "pressure_movement": row_of[weights.row[weighed]],
        "pressure_link": link_of_lane[weights.col[weighed]],
        "pressure_weight": weights.data[weighed] * part[weights.col[weighed]],
        "gain_stage": np.array(place, dtype=int)[gain.row[gained]],
        "gain_movement": row_of[gain.col[gained]],
        "gain": gain.data[gained],
    }
