"""Plain data of what is drawn.

They are a city, and frames of a live or finished run in it.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from cosim.evaluation.simulate import regional_outflow
from cosim.importing.maps import rings_round
from cosim.sumo.arrays import EdgeNumbers, PerEdge, PerGateway, Points
from cosim.sumo.net import City, edge_shapes, points_along
from nmfd.arrays import PerPair, PerRegion
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, State

CURVE_POINTS = 60  # of an MFD
CURVE_END = 2.0  # critical accumulations, or the jam accumulation if that is less
REGION_REACH = 0.08  # of the map's extent: places farther from all streets belong to no region
GATE_SETBACK = 0.015  # of the map's extent: distance of a gate from the end of its street
BOUNDARY_SETBACK = 0.02  # of the map's extent: further distance of the mark of a boundary
ROW = (  # variables of a result that `after` reads
    "gateway_green",
    "gateway_original_green",
    "gateway_queue",
    "arrivals",
    "crossings",
    "edge_vehicles",
    "time_spent",
)


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Place where an edge ends at a boundary.

    source, target: regions
    place: (x, y) [m]
    gateways: their numbers in the city
    signal: True if controlled
    """

    source: int
    target: int
    place: tuple[float, float]
    gateways: tuple[int, ...]
    signal: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class CityPicture:
    """Constant part of a picture.

    name: of the scenario
    region_names: R names
    edges: E ids
    shapes: E lines (n, 2) [m]
    lane_km: (E,) length times lanes
    lanes, region: (E,) of each edge
    outlines: rings (n, 2) [m] of every region
    places: (R, 2) [m] of the numbers of the regions
    protected: regions
    critical: (R,) critical accumulation [veh], NaN where it was not seen
    curves: R MFDs (n, 2) in veh and veh/s
    step: control interval [s]
    steps: number of control intervals
    """

    name: str
    region_names: tuple[str, ...]
    edges: tuple[str, ...]
    shapes: Sequence[Points]
    lane_km: PerEdge
    lanes: EdgeNumbers
    region: EdgeNumbers
    outlines: Sequence[Sequence[Points]]
    places: Points
    gates: tuple[Gate, ...]
    protected: tuple[int, ...]
    critical: PerRegion
    curves: Sequence[Points]
    step: float
    steps: int

    @property
    def regions(self) -> int:
        """Number of regions R."""
        return len(self.region_names)

    @property
    def boundaries(self) -> tuple[Gate, ...]:
        """One gate for all between two regions, in one direction.

        It stands for the controlled ones if there are any.
        """
        between: dict[tuple[int, int], list[Gate]] = defaultdict(list)
        for gate in self.gates:
            between[gate.source, gate.target].append(gate)
        setback = BOUNDARY_SETBACK * extent(self.shapes)
        merged = []
        for (source, _), gates in between.items():
            controlled = [gate for gate in gates if gate.signal]
            members = controlled or gates
            middle = np.mean([gate.place for gate in members], axis=0)
            back = self.places[source] - middle
            x, y = middle + setback * back / max(np.hypot(*back), 1e-9)
            numbers: list[int] = []
            for gate in members:
                numbers.extend(gate.gateways)
            place = (float(x), float(y))
            merged.append(replace(members[0], place=place, gateways=tuple(numbers)))
        return tuple(merged)

    @classmethod
    def of(cls, scenario: Scenario, city: City) -> Self:
        """Return the picture of a scenario's city."""
        network = scenario.network
        shapes = edge_shapes(city)
        region = city.edge_region
        middles = np.array([shape.mean(axis=0) for shape in shapes])
        lanes = np.array([city.lanes[edge] for edge in city.edges])
        curves = []
        for mfd in network.mfds:
            x = np.linspace(0.0, min(mfd.jam, CURVE_END * mfd.critical), CURVE_POINTS)
            curves.append(np.stack([x, mfd.outflow(x)], axis=1))
        return cls(
            name=scenario.name,
            region_names=network.region_names,
            edges=city.edges,
            shapes=shapes,
            lane_km=city.lane_metres / 1000.0,
            lanes=lanes,
            region=region,
            outlines=rings_round(shapes, region, REGION_REACH),
            places=np.stack([middles[region == r].mean(axis=0) for r in range(city.regions)]),
            gates=_gates(city, shapes),
            protected=scenario.protected,
            critical=network.seen_critical,
            curves=curves,
            step=scenario.step,
            steps=scenario.steps,
        )


@dataclass(frozen=True, kw_only=True)
class Frame:
    """City at one moment.

    Flows and signals are those of the last complete control interval.

    time: since the start [s]
    intervals: number of completed ones
    whole: True at the end of an interval
    density: (E,) [veh/km and lane]
    accumulation: (R,) [veh]
    outflow: (R,) [veh/s]
    waiting: to enter [veh]
    completed, removed: since the start [veh]
    time_spent: total since the start [veh s]
    perimeter: (R, R) commanded u
    green: (G,) share of the original green, NaN without control
    queue: (G,) halting vehicles
    note: a warning
    """

    time: float = 0.0
    intervals: int = 0
    whole: bool = True
    density: PerEdge
    accumulation: PerRegion
    outflow: PerRegion
    waiting: float
    completed: float = 0.0
    removed: float = 0.0
    time_spent: float = 0.0
    perimeter: PerPair
    green: PerGateway
    queue: PerGateway
    note: str = ""


def first(picture: CityPicture, gateways: int, state: State) -> Frame:
    """Return the frame at the start of a run.

    gateways: their number in the city
    """
    regions = picture.regions
    return Frame(
        density=np.zeros(len(picture.edges), np.float16),
        accumulation=state.accumulation.sum(axis=1),
        outflow=np.zeros(regions),
        waiting=float(state.backlog.sum()),
        perimeter=np.full((regions, regions), np.nan),
        green=np.full(gateways, np.nan),
        queue=np.zeros(gateways),
    )


def between(picture: CityPicture, before: Frame, time: float, vehicles: PerEdge) -> Frame:
    """Return a frame within a control interval.

    before: the last whole frame, from which all else is taken
    vehicles: (E,) now
    """
    return replace(
        before,
        time=time,
        whole=False,
        density=(vehicles / picture.lane_km).astype(np.float16),
        accumulation=np.bincount(picture.region, vehicles, picture.regions),
    )


def after(
    picture: CityPicture,
    before: Frame,
    controls: Controls,
    state: State,
    row: Mapping[str, np.ndarray],
) -> Frame:
    """Return the frame at the end of a control interval.

    row: variable of ROW -> its values in the interval
    """
    ungated = row["gateway_original_green"]
    # A gate without any green to take is open.
    green = np.divide(row["gateway_green"], ungated, out=np.ones_like(ungated), where=ungated != 0)
    removed = 0.0 if state.removed is None else float(state.removed.sum())
    warnings = [text for text in (controls.note, state.problem) if text]
    return Frame(
        time=state.time,
        intervals=state.step,
        density=(row["edge_vehicles"].astype(float) / picture.lane_km).astype(np.float16),
        accumulation=state.accumulation.sum(axis=1),
        outflow=regional_outflow(row, picture.step),
        waiting=float(state.backlog.sum()),
        completed=state.completed,
        removed=removed,
        time_spent=before.time_spent + float(row["time_spent"]),
        perimeter=controls.perimeter,
        green=green,
        queue=row["gateway_queue"].astype(float),
        note="; ".join(warnings),
    )


def frames(picture: CityPicture, result: Any) -> list[Frame]:
    """Return the frames of a finished run.

    One is at its start, the others at the ends of the control intervals.
    """
    states = []
    for k in range(len(result["accumulation"])):
        state = State(
            step=k,
            time=k * picture.step,
            accumulation=result["accumulation"][k],
            backlog=result["backlog"][k],
            completed=result["completed"][k],
            removed=result["removed"][k],
        )
        states.append(state)
    made = [first(picture, result["gateway_green"].shape[1], states[0])]
    for k, state in enumerate(states[1:]):
        controls = Controls(perimeter=result["perimeter"][k], note=str(result["note"][k]))
        row = {name: result[name][k] for name in ROW}
        made.append(after(picture, made[-1], controls, state, row))
    return made


def totals(picture: CityPicture, results: Sequence[Any]) -> dict[str, list[PerEdge]]:
    """Return label -> values (E,) over whole runs to colour streets by.

    There is one of each result, and none at all if a result has no emissions.
    """
    if any("co2" not in result for result in results):
        return {}
    kilometres = picture.lane_km / picture.lanes
    return {
        "CO2 [kg/km]": [result["co2"] / kilometres for result in results],
        "longest queue [veh]": [result["queue_max"].astype(float) for result in results],
    }


def extent(shapes: Sequence[Points]) -> float:
    """Return the longer side [m] of the box around all shapes."""
    return float(np.ptp(np.concatenate(shapes), axis=0).max())


def _gates(city: City, shapes: Sequence[Points]) -> tuple[Gate, ...]:
    """Return one gate for every edge that ends at a boundary.

    An edge that leads to several regions has a gate for each.
    shapes: of the edges
    """
    members: dict[tuple[str, int], list[int]] = defaultdict(list)
    for number, gateway in enumerate(city.gateways):
        members[gateway.from_edge, gateway.target].append(number)
    setback = GATE_SETBACK * extent(shapes)

    def before_its_end(length: float) -> float:
        return max(length - setback, 0.5 * length)

    gates = []
    for (edge, target), numbers in members.items():
        x, y = points_along(shapes[city.number[edge]], before_its_end)
        gate = Gate(
            source=city.gateways[numbers[0]].source,
            target=target,
            place=(float(x), float(y)),
            gateways=tuple(numbers),
            signal=any(city.gateways[n].signal is not None for n in numbers),
        )
        gates.append(gate)
    return tuple(gates)
