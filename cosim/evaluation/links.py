"""Streets of a SUMO network for the link model (nmfd.model.links).

A link has the lanes of a street that share movements. Shares of turns, origins and ends of trips
are counted on the static routes, those of recorded trips by quarter of an hour. Lights follow the
signal programmes.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.evaluation.link_phases import clock_at, phase_arrays
from cosim.evaluation.link_streets import (
    Counts,
    Movement,
    Streets,
    connections_of,
    link_arrays,
    vehicle_arrays,
)
from cosim.evaluation.link_vehicles import Drive, blocked, draws_of, drives_of, means_of
from cosim.plant.gates import MIN_GREEN_S, least_times
from cosim.plant.pressure import Roads
from cosim.plant.settings import own_files, settings
from cosim.plant.stages import stages_of, transition
from cosim.sumo import recorded_trips as recorded
from cosim.sumo.net import City, Connection, city_of
from cosim.sumo.route_plan import QUARTER_S
from cosim.sumo.signals import HELD, Cycle, Signal, read_cycles, read_signals
from cosim.sumo.trips import PLANNING_SEEDS
from cosim.sumo.xml_files import attribute, network_root
from nmfd.arrays import Arrays
from nmfd.errors import InputError
from nmfd.model.links.flows import Numbers
from nmfd.model.links.network import FILE, LinkNetwork
from nmfd.model.scenario import Scenario
from nmfd.runs import shipped

# Light -> share of the saturation flow.
CAPACITY = {"G": 1.0, "g": 1.0, "o": 1.0, "O": 1.0, "s": 0.5}
GIVES_WAY = frozenset("gso")  # lights
MINOR = frozenset("m=so")  # states of connections without a signal that must give way


class Lights(NamedTuple):
    """Capacity (-) and duty to give way (0 or 1) in every second of a cycle."""

    light: np.ndarray
    yields: np.ndarray


def write_links(
    scenario: Scenario,
    path: Path | None = None,
    seeds: Sequence[int] = PLANNING_SEEDS,
    numbers: Numbers | None = None,
) -> Path:
    """Write the link network of `scenario`; return its file.

    path: file, that of the scenario if None
    seeds: of the draws of trips, if they are not recorded
    numbers: calibration, the defaults if None
    Raises: InputError if a route leads where no connection is
    """
    if path is None:
        folder = scenario.folder or Path()
        path = shipped.beside(folder, FILE, "--out FILE", scenario=True)
    network = link_network(scenario, seeds)
    if numbers is not None:
        network = replace(network, numbers=np.array(numbers))
    network.write(path)
    return path


def link_network(scenario: Scenario, seeds: Sequence[int] = PLANNING_SEEDS) -> LinkNetwork:
    """Return the link network of `scenario`.

    seeds: of the draws of trips, if they are not recorded
    Raises: InputError if a route leads where no connection is, or no trip has one
    """
    chosen = settings(scenario)
    files = own_files(scenario, chosen.additional)
    city = city_of(scenario.network)
    draws = draws_of(scenario, chosen, city, seeds)
    shared = recorded.read_routes(files)
    # Some vehicles drive where cars may not.
    driven: set[str] = set()
    for draw in draws:
        for element in draw.elements:
            driven.update(recorded.edges_of(element, shared)[0])
    city = city_of(scenario.network, opened=driven & city.region_of.keys())
    by_draw = [drives_of(draw, shared, files, city) for draw in draws]
    together = [drive for drives in by_draw for drive in drives]
    routes = [drive.route for drive in together]
    if not routes:
        raise InputError(f"{scenario.where}: sumo.routes: no trip leads over two streets for cars")
    streets = Streets(city, connections_of(city), routes, scenario.where)
    counts = Counts(streets, together)
    rows = by_draw
    if chosen.routes:  # one draw
        rows = by_quarter(together, chosen.begin, scenario.steps * scenario.step)
    means = means_of(draws[0], files)
    steered, _ = read_signals(city, files, HELD)
    fixed, _ = read_signals(city, files)
    obeying = {signal.id for signal in steered}.difference(chosen.leave_signals)
    gated = set()
    for gateway in city.gateways:
        if gateway.signal in obeying:
            gated.add((gateway.from_edge, gateway.to_edge))
    actuated = {signal.id for signal in fixed if signal.id in obeying}
    cycles = read_cycles(city.net_file, files)
    period = max(float(np.ptp([drive.depart for drive in together])), QUARTER_S)
    links = link_arrays(streets, blocked(own_files(scenario, chosen.background), files, period))
    return LinkNetwork(
        regions=city.regions,
        periods=len(rows) // len(draws),
        period=QUARTER_S,
        numbers=np.array(Numbers()),
        spacing=means["length"] + means["minGap"],
        headway=means["tau"],
        dawdling=0.5 * means["sigma"] * means["accel"],
        acceleration=means["accel"],
        **links,
        **_movement_arrays(streets, cycles, chosen.begin, gated),
        **vehicle_arrays(
            streets, links["free_time"], counts, [Counts(streets, drives) for drives in rows]
        ),
        **_stage_arrays(streets, counts, steered),
        **phase_arrays(streets, steered, actuated, cycles, chosen.begin),
    )


def by_quarter(drives: Iterable[Drive], begin: float, duration: float) -> list[list[Drive]]:
    """Return the trips that are due in each quarter of an hour.

    Those before or after these count in the first or the last one.

    begin: of the first quarter; duration: of all of them (s)
    """
    quarters: list[list[Drive]] = [[] for _ in range(math.ceil(duration / QUARTER_S))]
    for drive in drives:
        own = int((drive.depart - begin) / QUARTER_S)
        quarters[min(max(own, 0), len(quarters) - 1)].append(drive)
    return quarters


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


def _movement_arrays(
    streets: Streets,
    cycles: Mapping[str, Cycle],
    begin: float,
    gated: Collection[Movement],
) -> Arrays:
    """Return the arrays of movements, lights and right of way.

    begin: time of the first second (s)
    """
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
        shown = [_shown(one, cycles, begin) for one in streets.connections[movement]]
        cycle = max(len(one.light) for one in shown)
        light = np.mean([np.resize(one.light, cycle) for one in shown], axis=0)
        yields = np.mean([np.resize(one.yields, cycle) for one in shown], axis=0)
        lights.append(Lights(light, yields))
    pairs = []
    for movement, foe in sorted(_foes(city)):
        if movement in number and foe in number:
            pairs.append((number[movement], number[foe]))
    lengths = np.array([len(one.light) for one in lights])
    yielding, foe_of = np.array(pairs, dtype=int).reshape(-1, 2).T
    return {
        "movement_link": np.array([streets.link_of[movement] for movement in streets.movements]),
        "speed": np.array(speeds),
        "yielding": yielding,
        "foe": foe_of,
        "cycle": lengths,
        "begin": np.cumsum(lengths) - lengths,
        "light": np.concatenate([one.light for one in lights]),
        "yields": np.concatenate([one.yields for one in lights]),
        "gated": np.array([movement in gated for movement in streets.movements]),
    }


def _shown(connection: Connection, cycles: Mapping[str, Cycle], begin: float) -> Lights:
    """Return the lights of a connection; one second if it has no signal."""
    known = cycles.get(connection.signal or "")
    if known is None:
        return Lights(np.ones(1), np.array([float(connection.state in MINOR)]))
    ends = np.cumsum([phase.duration for phase in known.phases])
    cycle = max(round(ends[-1]), 1)
    clock = (clock_at(known, begin) + np.arange(cycle) + 0.5) % ends[-1]
    number = np.searchsorted(ends, clock, side="right")
    states = [known.phases[n].state[connection.link] for n in number]
    light = np.array([CAPACITY.get(state, 0.0) for state in states])
    yields = np.array([float(state in GIVES_WAY) for state in states])
    for second in range(2 * cycle):  # twice: yellow may begin before the end of the cycle
        before = states[(second - 1) % cycle]
        if states[second % cycle] == "y" and before == "g":
            states[second % cycle] = before
            light[second % cycle] = 1.0  # those who wait on the junction go at last
    return Lights(light, yields)


def _stage_arrays(streets: Streets, counts: Counts, signals: Sequence[Signal]) -> Arrays:
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
            states = [signals[number].phases[phase].state[one.link] for one in here]
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


def _pressure_arrays(streets: Streets, roads: Roads, phases: Sequence[Sequence[int]]) -> Arrays:
    """Return the weights of cosim.plant.max_pressure.

    The lanes of a link share its vehicles.
    """
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
