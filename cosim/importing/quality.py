"""Tables of regions and gateways, and the verdict on their control."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from cosim.importing.baseline import INTERVAL_S, Baseline
from cosim.importing.partition import pieces_of
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeMask, EdgeNumbers, PerTrip
from cosim.sumo.net import City
from cosim.sumo.signals import CONTROLLED, STATIC, TIMETABLE, control, unfit
from nmfd.model import authority
from nmfd.model.authority import Boundaries, Verdict
from nmfd.model.regional_model import RegionalModel

SMALLEST_LANE_KM = 3.0  # of a region: a few hundred vehicles would fill it
FEWEST_INTERVALS = 10  # with departures


class Tables(NamedTuple):
    """Rows of two tables.

    quality: of quality.csv, one per region, and one for all
    gateways: of gateways.csv, one per movement over a boundary
    """

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
    moves: Mapping[tuple[int, int], int] = Counter()
    density = np.zeros(len(regions))
    if baseline is not None:
        moves = baseline.moves()
        density = 1000.0 * baseline.density(streets)
    gateways = []
    for gateway in city.gateways:
        move = streets.number[gateway.from_edge], streets.number[gateway.to_edge]
        logic = streets.logics.get(gateway.signal or "")
        kind = "" if logic is None else logic.kind
        gateways.append(
            {
                "source": gateway.source,
                "target": gateway.target,
                "from_edge": gateway.from_edge,
                "to_edge": gateway.to_edge,
                "lanes": " ".join(map(str, gateway.lanes)),
                "signal": gateway.signal or "",
                "links": " ".join(map(str, gateway.links)),
                "control": control(gateway, streets.logics, left_alone),
                "kind": "fixed" if kind == STATIC else kind,
                "flow_veh": moves[move],
            }
        )
    # A railway crossing is no signal here: it has no programme.
    with_signal = [edge for edge, signal in city.signals.items() if signal in streets.logics]
    approaches = pd.Series({edge: regions[streets.number[edge]] for edge in with_signal}, dtype=int)
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

    rows = []
    for n, name in enumerate(names):
        own = [gateway for gateway in gateways if n in (gateway["source"], gateway["target"])]
        rows.append(row(str(n), name, regions == n, own))
    rows.append(row("all", "all regions", regions >= 0, gateways))
    return Tables(quality=rows, gateways=gateways)


def doubts(streets: Streets, regions: EdgeNumbers, names: Sequence[str]) -> list[str]:
    """Return sentences about streets apart, and small or torn regions."""
    sentences = []
    total = streets.lane_metres.sum()
    apart = streets.drivable & ~streets.main_part
    if apart.any():
        away = streets.lane_metres[apart].sum()
        sentences.append(
            f"the streets fall into {streets.parts} parts without a connection; {away / total:.1%} "
            "of the lanes lie outside the largest, and count for the region nearest to them"
        )
    piece = pieces_of(streets, regions)
    for region, name in enumerate(names):
        count = len(np.unique(piece[streets.main_part & (regions == region)]))
        if count > 1:
            sentences.append(
                f"region {region} {name} is in {count} pieces, as in your own table; trips between "
                "these cross other regions"
            )
        lane_km = streets.lane_metres[regions == region].sum() / 1000.0
        if lane_km < SMALLEST_LANE_KM:
            sentences.append(
                f"region {region} {name} has {lane_km:.1f} lane-kilometres, too few for an MFD "
                f"(below {SMALLEST_LANE_KM:g}); take fewer regions, or your own"
            )
    return sentences


def short_demand(depart: PerTrip, begin: float, step: float) -> list[str]:
    """Return a sentence if vehicles depart in too few intervals.

    depart: (N,) [s]; begin, step: of the control intervals [s]
    """
    intervals = int((float(depart[-1]) - begin) / step) + 1 if len(depart) else 0
    if intervals >= FEWEST_INTERVALS:
        return []
    return [
        f"vehicles depart in {intervals} control intervals of {step:g} s, too few for an MFD "
        f"(below {FEWEST_INTERVALS}); import a longer time"
    ]


def left_alone(
    streets: Streets, switched: Iterable[str] = (), everywhere: str = ""
) -> dict[str, str]:
    """Return the signals that perimeter control does not use, with the reason.

    switched: signals whose programme a timetable changes
    everywhere: reason for all signals, "" without one
    """
    if everywhere:
        return dict.fromkeys(streets.logics, everywhere)
    reasons = {}
    for signal in streets.link_signals:
        if signal and signal not in streets.logics:
            reasons[signal] = "no programme"
    for signal, logic in streets.logics.items():
        reason = unfit(logic)
        if reason:
            reasons[signal] = reason
    return reasons | dict.fromkeys(switched, TIMETABLE)


def import_verdict(
    network: RegionalModel,
    gateways: Sequence[Mapping],
    regions: EdgeNumbers,
    baseline: Baseline,
    scenario: str,
) -> Verdict:
    """Judge from the run without control if perimeter control can help.

    scenario: its name
    """
    crossings = []
    for row in gateways:
        controlled = row["control"] == CONTROLLED
        crossings.append((row["source"], row["target"], row["flow_veh"], controlled))
    vehicle_seconds = [np.bincount(regions, row, network.regions) for row in baseline.presence]
    inside = np.array(vehicle_seconds) / INTERVAL_S
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
