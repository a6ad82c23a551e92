"""What is drawn, as plain data: a city, which stays as it is, and frames of what happens in it.

A frame is made from a row of the record and a state, whether the run is still going on (cosim.view.run) or finished
(`frames`): the same page shows both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from jaxtyping import Float

from cosim.evaluation.run_metrics import regional_outflow
from cosim.importing.maps import rings_round
from cosim.sumo.arrays import EdgeNumbers, PerEdge, PerGateway, Points
from cosim.sumo.net import City, edge_shapes
from nmfd.arrays import PerPair, PerRegion
from nmfd.model.scenario import Scenario
from nmfd.types import Controls, Result, State

CURVE = 60  # points of an MFD
BLOCKS = 0.06  # of the map's extent: no hole in a region
BACK = 0.015  # of it: how far before the end of a street its gate is drawn
BEYOND = 2.0  # critical accumulations: where a curve ends, or at the jam if that comes first


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Where streets lead from one region to another over one junction: source, target; place (x, y) [m]; gateways:
    their numbers in the city; signal: whether a signal stands there."""

    source: int
    target: int
    place: tuple[float, float]
    gateways: tuple[int, ...]
    signal: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class CityPicture:
    """What does not change during a run. The same only as itself.

    name: of the scenario; region_names: R; edges: E ids
    shapes: E lines (n, 2) [m]; lane_km (E,) [km]: length times lanes; limit (E,) [m/s]; lanes, region: (E,)
    outlines: of every region, rings (n, 2) [m]; places: (R, 2) [m], where its number stands
    gates: of the map; critical: (R,) [veh]; curves: R MFDs, (n, 2) of [veh] and [veh/s]
    step: control interval [s]; steps: of them; low, high: bounds of u [-]
    """

    name: str
    region_names: tuple[str, ...]
    edges: tuple[str, ...]
    shapes: Sequence[Points]
    lane_km: PerEdge
    limit: PerEdge
    lanes: EdgeNumbers
    region: EdgeNumbers
    outlines: Sequence[Sequence[Points]]
    places: Points
    gates: tuple[Gate, ...]
    critical: PerRegion
    curves: Sequence[Points]
    step: float
    steps: int
    low: float
    high: float

    @property
    def regions(self) -> int:
        """R."""
        return len(self.region_names)

    @property
    def boundaries(self) -> list[tuple[int, int]]:
        """(i, h) that have a gate with a signal."""
        return sorted({(gate.source, gate.target) for gate in self.gates if gate.signal})

    @classmethod
    def of(cls, scenario: Scenario, city: City) -> Self:
        """The picture of a scenario's city."""
        shapes, network = edge_shapes(city), scenario.network
        region = np.array([city.region_of[edge] for edge in city.edges])
        middles = np.array([shape.mean(axis=0) for shape in shapes])
        return cls(
            name=scenario.name,
            region_names=network.region_names,
            edges=city.edges,
            shapes=shapes,
            lane_km=np.array([city.length[edge] * city.lanes[edge] for edge in city.edges]) / 1000.0,
            limit=np.array([city.speed[edge] for edge in city.edges]),
            lanes=np.array([city.lanes[edge] for edge in city.edges]),
            region=region,
            outlines=rings_round(shapes, np.ones(len(shapes), dtype=bool), region, BLOCKS),
            places=np.stack([middles[region == r].mean(axis=0) for r in range(city.regions)]),
            gates=_gates(city, dict(zip(city.edges, shapes, strict=True))),
            critical=network.critical,
            curves=[_curve(mfd.critical, mfd.jam, mfd.outflow) for mfd in network.mfds],
            step=scenario.step,
            steps=scenario.steps,
            low=network.u_min,
            high=network.u_max,
        )


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What the city is doing at one moment. What is counted per control interval is of the last one that has ended.

    time: since the start [s]; intervals: that have ended; whole: whether one ends just now
    density: (E,) [veh/km and lane]; speed: (E,) [-], of what is allowed, NaN where nobody drives or nobody measured it
    accumulation: (R,) [veh] inside; outflow: (R,) [veh/s]; waiting: [veh] that could not enter yet
    completed, removed: [veh] since the start; time_spent: total so far [veh s], of nmfd.metrics at the end
    perimeter: (R, R) [-], u as commanded; green: (G,) [-], of the original, NaN where nobody commands; queue: (G,)
    [veh] halting; guided: (R, R) [veh] rerouted from i to h
    note: what was not as it should be
    """

    time: float
    intervals: int
    whole: bool
    density: PerEdge
    speed: PerEdge
    accumulation: PerRegion
    outflow: PerRegion
    waiting: float
    completed: float
    removed: float
    time_spent: float
    perimeter: PerPair
    green: PerGateway
    queue: PerGateway
    guided: PerPair
    note: str = ""


def first(picture: CityPicture, gateways: int, state: State) -> Frame:
    """At the beginning. gateways: of the city"""
    edges, regions = len(picture.edges), picture.regions
    return Frame(
        time=0.0,
        intervals=0,
        whole=True,
        density=np.zeros(edges, np.float16),
        speed=np.full(edges, np.nan, np.float16),
        accumulation=state.accumulation.sum(axis=1),
        outflow=np.zeros(regions),
        waiting=float(state.backlog.sum()),
        completed=0.0,
        removed=0.0,
        time_spent=0.0,
        perimeter=np.full((regions, regions), picture.high),
        green=np.full(gateways, np.nan),
        queue=np.zeros(gateways),
        guided=np.zeros((regions, regions)),
    )


def between(picture: CityPicture, before: Frame, time: float, vehicles: PerEdge, speed: PerEdge) -> Frame:
    """In the middle of a control interval: `before` with what streets do at `time` [s] since the start.

    vehicles: (E,) [veh]; speed: (E,) [m/s]
    """
    return replace(
        before,
        time=time,
        whole=False,
        **_streets(picture, vehicles, speed),
        accumulation=np.bincount(picture.region, vehicles, picture.regions),
    )


def after(
    picture: CityPicture,
    before: Frame,
    spent: float,
    controls: Controls,
    state: State,
    row: Mapping[str, np.ndarray],
    speed: PerEdge | None = None,
) -> Frame:
    """At the end of a control interval.

    spent: vehicles that spent time in it [veh]; controls: of it; state: now; row: of the record; speed: (E,) [m/s],
    None where nobody measured it
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        green = row["gateway_green"] / row["gateway_original_green"]
    flows = {name: row[name][None] for name in ("arrivals", "crossings")}
    return Frame(
        time=state.time,
        intervals=state.step,
        whole=True,
        **_streets(picture, row["edge_vehicles"].astype(float), speed),
        accumulation=state.accumulation.sum(axis=1),
        outflow=regional_outflow(flows, picture.step)[0],
        waiting=float(state.backlog.sum()),
        completed=state.completed,
        removed=0.0 if state.removed is None else float(state.removed.sum()),
        time_spent=before.time_spent + picture.step * spent,
        perimeter=controls.perimeter,
        green=green,
        queue=row["gateway_queue"].astype(float),
        guided=row["guided"].sum(axis=2).astype(float),
        note="; ".join(filter(None, (controls.note, state.problem))),
    )


def frames(picture: CityPicture, trajectory: Result) -> list[Frame]:
    """Of a finished run, one at its beginning and one at the end of every control interval."""
    states = [
        State(
            step=k,
            time=k * trajectory.step,
            accumulation=trajectory.accumulation[k],
            backlog=trajectory.backlog[k],
            completed=float(trajectory.completed[k]),
            removed=trajectory.removed[k],
        )
        for k in range(len(trajectory.accumulation))
    ]
    record = {name: x.values for name, x in trajectory.data.data_vars.items() if x.dims[0] == "interval"}
    found = [first(picture, trajectory.gateway_green.shape[1], states[0])]
    for k, state in enumerate(states[1:]):
        controls = Controls(perimeter=trajectory.perimeter[k], splits=None, note=trajectory.note[k])
        row = {name: values[k] for name, values in record.items()}
        found.append(after(picture, found[-1], float(states[k].unfinished.sum()), controls, state, row))
    return found


def _streets(picture: CityPicture, vehicles: PerEdge, speed: PerEdge | None) -> dict[str, np.ndarray]:
    """Density and speed of a frame, as half of what they would take in full."""
    share = np.full(len(vehicles), np.nan) if speed is None else np.where(vehicles > 0, speed / picture.limit, np.nan)
    return {"density": (vehicles / picture.lane_km).astype(np.float16), "speed": share.astype(np.float16)}


def _curve(critical: float, jam: float, outflow: object) -> Points:
    x = np.linspace(0.0, min(jam, BEYOND * critical), CURVE)
    return np.stack([x, outflow(x)], axis=1)  # type: ignore[operator]


def _before_end(shape: Float[np.ndarray, "n 2"], distance: float) -> tuple[float, float]:
    """A point of a line so far before its end [m], or in its middle: gates of both ways must not lie on one another."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(shape, axis=0).T))])
    at = max(along[-1] - distance, 0.5 * along[-1])
    return float(np.interp(at, along, shape[:, 0])), float(np.interp(at, along, shape[:, 1]))


def _gates(city: City, shapes: Mapping[str, Float[np.ndarray, "n 2"]]) -> tuple[Gate, ...]:
    """One for every edge that ends at a boundary and region behind it."""
    members: dict[tuple[str, int], list[int]] = {}
    for n, gateway in enumerate(city.gateways):
        members.setdefault((gateway.from_edge, gateway.target), []).append(n)
    back = BACK * float(np.ptp(np.concatenate(list(shapes.values())), axis=0).max())
    return tuple(
        Gate(
            source=city.gateways[numbers[0]].source,
            target=target,
            place=_before_end(shapes[edge], back),
            gateways=tuple(numbers),
            signal=any(city.gateways[n].signal is not None for n in numbers),
        )
        for (edge, target), numbers in members.items()
    )
