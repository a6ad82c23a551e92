"""Quality of a partition by region, and control at its gateways."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.sparse.csgraph import connected_components

from cosim.importing.baseline import INTERVAL_S, Baseline
from cosim.importing.streets import Streets, graph
from cosim.sumo.arrays import EdgeMask, EdgeNumbers, PerEdge
from cosim.sumo.net import City
from cosim.sumo.signals import FIXED, HELD
from nmfd.model import authority
from nmfd.model.authority import Boundaries, Verdict
from nmfd.model.regional_model import RegionalModel
from nmfd.runs.tables import text_table

CONTROLLED = "controlled"  # gateway with a signal that perimeter control uses


@dataclass(frozen=True, kw_only=True)
class Tables:
    """Rows of quality.csv (one per region, and one for all) and of gateways.csv (one per movement over a boundary)."""

    quality: Sequence[Mapping]
    gateways: Sequence[Mapping]

    @property
    def uncontrolled(self) -> float:
        """Share of the boundary flow that passes no controllable signal; NaN without flow."""
        return self.quality[-1]["uncontrolled_share"]


def tables(
    streets: Streets,
    regions: EdgeNumbers,
    names: Sequence[str],
    city: City,
    baseline: Baseline | None,
    left_alone: Mapping[str, str],
) -> Tables:
    """Return the quality and the gateways of a partition.

    Args:
        baseline: the run without control; None leaves densities and flows at zero.
        left_alone: signal -> reason why perimeter control does not use it.
    """
    moves = Counter() if baseline is None else baseline.moves()
    pairs: dict[str, set[tuple[int, int]]] = {}
    for gateway in city.gateways:
        if gateway.signal is not None:
            pairs.setdefault(gateway.signal, set()).add((gateway.source, gateway.target))
    kinds = {signal: "fixed" if logic.kind == FIXED else logic.kind for signal, logic in streets.logics.items()}
    gateways = [
        {
            "source": g.source,
            "target": g.target,
            "from_edge": g.from_edge,
            "to_edge": g.to_edge,
            "lanes": " ".join(map(str, g.lanes)),
            "shared_lanes": " ".join(map(str, g.shared)),
            "signal": g.signal or "",
            "links": " ".join(map(str, g.links)),
            "signal_serves": " ".join(f"{i}-{h}" for i, h in sorted(pairs.get(g.signal or "", ()))),
            "control": "no signal" if g.signal is None else left_alone.get(g.signal, CONTROLLED),
            "kind": kinds.get(g.signal or "", ""),
            "flow_veh": moves[streets.number[g.from_edge], streets.number[g.to_edge]],
        }
        for g in city.gateways
    ]
    density = np.zeros(len(regions)) if baseline is None else 1000.0 * baseline.density(streets)
    approaches = [(signal, regions[streets.number[edge]]) for edge, signal in city.signals.items()]
    main_region = (
        pd.DataFrame(approaches, columns=["signal", "region"]).groupby("signal").agg(lambda part: part.mode()[0])
    )
    signals = np.bincount(main_region["region"].astype(int), minlength=len(names))
    rows = []
    for region, name in enumerate(names):
        own = [g for g in gateways if region in (g["source"], g["target"])]
        rows.append(_row(streets, regions == region, str(region), name, signals[region], density, own))
    total = _row(streets, regions >= 0, "all", "all regions", signals.sum(), density, gateways)
    lanes = [row["lane_km"] for row in rows]
    total["variance_before"] = total["variance_within"]
    total["variance_within"] = round(float(np.average([row["variance_within"] for row in rows], weights=lanes)), 2)
    total["pieces"] = sum(row["pieces"] for row in rows)
    for row in rows:
        row["variance_before"] = total["variance_before"]
    return Tables(quality=[*rows, total], gateways=gateways)


def _row(
    streets: Streets,
    members: EdgeMask,
    region: str,
    name: str,
    signals: int,
    density: PerEdge,
    gateways: Sequence[Mapping],
) -> dict:
    usable = members & streets.drivable
    lanes = streets.lane_metres[usable]
    mean = float(np.average(density[usable], weights=lanes))
    flow = sum(g["flow_veh"] for g in gateways)
    free = sum(g["flow_veh"] for g in gateways if g["control"] != CONTROLLED)
    return {
        "region": region,
        "name": name,
        "edges": int(usable.sum()),
        "lane_km": round(float(lanes.sum()) / 1000.0, 2),
        "signals": int(signals),
        "pieces": pieces(streets, usable & streets.main_part),
        "mean_density_veh_km": round(mean, 2),
        "variance_before": np.nan,
        "variance_within": round(float(np.average((density[usable] - mean) ** 2, weights=lanes)), 2),
        "gateways": len(gateways),
        "controlled_gateways": sum(g["control"] == CONTROLLED for g in gateways),
        "boundary_flow_veh": flow,
        "uncontrolled_share": round(free / flow, 3) if flow else np.nan,
    }


def left_alone(streets: Streets, switched: Sequence[str] = ()) -> dict[str, str]:
    """Return the signals that perimeter control does not use, with the reason.

    Args:
        switched: signals whose programme a timetable changes.
    """
    reasons = {signal: "no programme" for signal in streets.link_signals if signal and signal not in streets.logics}
    for signal, logic in streets.logics.items():
        if logic.kind not in HELD or logic.programme == "off":
            reasons[signal] = "switched off" if logic.programme == "off" else f"{logic.kind} signal"
    return reasons | {signal: "programme follows a timetable" for signal in switched}


def pieces(streets: Streets, members: EdgeMask) -> int:
    """Count the parts into which some edges fall by the connections between them."""
    numbers = np.cumsum(members) - 1
    links = streets.links[members[streets.links].all(axis=1)]
    return int(connected_components(graph(numbers[links], int(members.sum())), directed=False)[0])


def quality_table(found: Tables) -> str:
    """Return the quality of a partition as text."""
    return text_table(
        [
            {
                "region": row["name"] if row["region"] == "all" else f"{row['region']} {row['name']}",
                "lane-km": row["lane_km"],
                "signals": row["signals"],
                "density": row["mean_density_veh_km"],
                "variance": row["variance_before"],
                "within": row["variance_within"],
                "gateways": row["gateways"],
                "controlled": row["controlled_gateways"],
                "uncontrolled": "-" if np.isnan(share := row["uncontrolled_share"]) else f"{100 * share:.0f} %",
            }
            for row in found.quality
        ],
        "density: vehicles per lane-km in the busiest quarter of an hour without control; variance over all lanes and "
        "within the region; uncontrolled: share of the boundary flow that passes no controllable signal",
    )


def import_verdict(
    network: RegionalModel, gateways: Sequence[Mapping], regions: EdgeNumbers, baseline: Baseline
) -> Verdict:
    """Judge from the run without control whether perimeter control can help."""
    crossings = ((row["source"], row["target"], row["flow_veh"], row["control"] == CONTROLLED) for row in gateways)
    boundaries = Boundaries.of_gateways(network.regions, crossings)
    inside = np.array([np.bincount(regions, row, network.regions) for row in baseline.presence]) / INTERVAL_S
    started = np.zeros(network.regions)
    for (way, _), vehicles in baseline.ways.items():
        if way:
            started[regions[way[0]]] += vehicles
    most = inside.max(axis=0) / network.critical
    return authority.verdict(network, boundaries, most=most, started=started, where="in the run without control")
