"""Tables of regions and gateways, and the verdict on control at the gateways."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from cosim.importing.baseline import INTERVAL_S, Baseline
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeMask, EdgeNumbers
from cosim.sumo.net import City
from cosim.sumo.signals import CONTROLLED, STATIC, TIMETABLE, control, unfit
from nmfd.model import authority
from nmfd.model.authority import Boundaries, Verdict
from nmfd.model.regional_model import RegionalModel


class Tables(NamedTuple):
    """Rows of quality.csv (one per region, and one for all) and of gateways.csv (one per movement
    over a boundary)."""

    quality: Sequence[Mapping]
    gateways: Sequence[Mapping]


def tables(
    streets: Streets,
    regions: EdgeNumbers,
    names: Sequence[str],
    city: City,
    baseline: Baseline | None,
    left_alone: Mapping[str, str],
) -> Tables:
    """Return the tables of a partition.

    baseline: the run without control; None leaves densities and flows at zero
    left_alone: signal -> reason why perimeter control does not use it
    """
    moves = Counter() if baseline is None else baseline.moves()
    kinds = {
        signal: "fixed" if logic.kind == STATIC else logic.kind
        for signal, logic in streets.logics.items()
    }
    gateways = [
        {
            "source": g.source,
            "target": g.target,
            "from_edge": g.from_edge,
            "to_edge": g.to_edge,
            "lanes": " ".join(map(str, g.lanes)),
            "signal": g.signal or "",
            "links": " ".join(map(str, g.links)),
            "control": control(g, streets.logics, left_alone),
            "kind": kinds.get(g.signal or "", ""),
            "flow_veh": moves[streets.number[g.from_edge], streets.number[g.to_edge]],
        }
        for g in city.gateways
    ]
    density = np.zeros(len(regions)) if baseline is None else 1000.0 * baseline.density(streets)
    approaches = pd.Series(
        {edge: regions[streets.number[edge]] for edge in city.signals}, dtype=int
    )
    main_region = approaches.groupby(city.signals).agg(lambda part: part.mode()[0])

    def row(region: str, name: str, members: EdgeMask, own: Sequence[Mapping]) -> dict:
        usable = members & streets.drivable
        lanes = streets.lane_metres[usable]
        mean = float(np.average(density[usable], weights=lanes))
        flow = sum(g["flow_veh"] for g in own)
        free = sum(g["flow_veh"] for g in own if g["control"] != CONTROLLED)
        return {
            "region": region,
            "name": name,
            "edges": int(usable.sum()),
            "lane_km": round(float(lanes.sum()) / 1000.0, 2),
            "signals": int(main_region.isin(regions[members]).sum()),
            "density_veh_km": round(mean, 2),
            "variance": round(float(np.average((density[usable] - mean) ** 2, weights=lanes)), 2),
            "gateways": len(own),
            "controlled_gateways": sum(g["control"] == CONTROLLED for g in own),
            "uncontrolled_share": round(free / flow, 3) if flow else np.nan,
        }

    own = [[g for g in gateways if n in (g["source"], g["target"])] for n in range(len(names))]
    rows = [row(str(n), name, regions == n, own[n]) for n, name in enumerate(names)]
    return Tables(
        quality=[*rows, row("all", "all regions", regions >= 0, gateways)], gateways=gateways
    )


def left_alone(
    streets: Streets, switched: Iterable[str] = (), everywhere: str = ""
) -> dict[str, str]:
    """Return the signals that perimeter control does not use, with the reason.

    switched: signals whose programme a timetable changes; everywhere: reason for all signals
    """
    if everywhere:
        return dict.fromkeys(streets.logics, everywhere)
    reasons = {
        signal: "no programme"
        for signal in streets.link_signals
        if signal and signal not in streets.logics
    }
    for signal, logic in streets.logics.items():
        if reason := unfit(logic):
            reasons[signal] = reason
    return reasons | dict.fromkeys(switched, TIMETABLE)


def import_verdict(
    network: RegionalModel,
    gateways: Sequence[Mapping],
    regions: EdgeNumbers,
    baseline: Baseline,
    scenario: str,
) -> Verdict:
    """Judge from the run without control whether perimeter control can help; scenario: its name."""
    crossings = (
        (row["source"], row["target"], row["flow_veh"], row["control"] == CONTROLLED)
        for row in gateways
    )
    inside = (
        np.array([np.bincount(regions, row, network.regions) for row in baseline.presence])
        / INTERVAL_S
    )
    started = np.zeros(network.regions)
    for (way, _), vehicles in baseline.ways.items():
        if way:
            started[regions[way[0]]] += vehicles
    return authority.verdict(
        network,
        Boundaries.of_gateways(network.regions, crossings),
        most=inside.max(axis=0),
        started=started,
        waiting=baseline.waiting,
        slowness=baseline.slowness,
        where="in the run without control",
        scenario=f"scenarios/{scenario}",
    )
