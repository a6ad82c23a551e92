"""Made-up cities, and means over their streets in a control interval."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cosim.plant.sampling import StreetMeans
from cosim.sumo.net import City, Gateway

MANY = 1e5  # veh: so many that nothing else counts


def city(
    region_of: Mapping[str, int], successors: Mapping[str, Sequence[str]], **others: Any
) -> City:
    """Return a city with these edges, 10 m long, and a gateway wherever a move leads into another
    region."""
    edges = tuple(edge for edge in sorted(region_of) if edge in successors)
    moves = [(e, f) for e in edges for f in successors[e]]
    gateways = [
        Gateway(
            source=region_of[e], target=region_of[f], from_edge=e, to_edge=f, signal=None, links=()
        )
        for e, f in moves
        if region_of[e] != region_of[f]
    ]
    properties = {
        "length": dict.fromkeys(edges, 10.0),
        "lanes": dict.fromkeys(edges, 1),
        "lane_ids": {},
        "speed": dict.fromkeys(edges, 1.0),
        "turn_time": dict.fromkeys(moves, 0.0),
        "gateways": tuple(sorted(gateways, key=lambda g: (g.source, g.target))),
        "signals": {},
    }
    return City(
        net_file=Path(),
        regions=max(region_of.values()) + 1,
        region_of=region_of,
        edges=edges,
        successors={edge: tuple(successors[edge]) for edge in edges},
        **(properties | others),
    )


def side_street(length: float = 40.0) -> City:
    """A main road a m b t of 10 s each, of which m is in region 1 and t in 2, and the side street s
    from a to t, at 1 m/s."""
    region_of = {"a": 0, "b": 0, "m": 1, "s": 0, "t": 2}
    after = {"a": ("m", "s"), "b": ("t",), "m": ("b",), "s": ("t",), "t": ()}
    return city(region_of, after, length=dict.fromkeys(after, 10.0) | {"s": length})


def session(routes: dict[str, tuple[str, ...]], **others: Any) -> SimpleNamespace:
    """Return a session of drivers on the first edges of their `routes`, none of whom is near the
    end of a lane."""
    calls = {
        "arrived": tuple,
        "road": lambda vehicle: routes[vehicle][0],
        "route": routes.get,
        "route_index": lambda vehicle: 0,
        "step_length": 1.0,
        "set_route": lambda vehicle, way: routes.update({vehicle: tuple(way)}) or True,
        "standing_time": lambda vehicle: 0.0,
        "place": lambda vehicle: ("lane", 0.0),
        "lane": lambda lane: (1e9, frozenset()),
    }
    return SimpleNamespace(**calls | others)


def seen(
    speed: Sequence[float],
    vehicles: Sequence[float] | None = None,
    *,
    duration: float = 90.0,
    crossing: Sequence[float] = (),
    crossed: Sequence[float] = (),
) -> StreetMeans:
    """Speeds [m/s] by edge, NaN where nobody was; vehicles [veh]: MANY if not given."""
    mean = np.array(speed, dtype=float)
    on = (
        np.where(np.isnan(mean), 0.0, MANY) if vehicles is None else np.array(vehicles, dtype=float)
    )
    return StreetMeans(
        duration=duration,
        vehicles=on,
        timed=on,
        speed=mean,
        accumulation=np.zeros(1),
        production=np.zeros(1),
        queue=np.zeros(0),
        queue_max=np.zeros(0),
        crossing=np.array(crossing, dtype=float),
        crossed=np.array(crossed, dtype=float),
    )
