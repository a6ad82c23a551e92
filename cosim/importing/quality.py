"""How good a partition is, region by region, and what perimeter control can reach of its boundaries."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from cosim.importing.baseline import Baseline
from cosim.importing.homogeneity import ncut_silhouettes, variance_shares
from cosim.importing.regions import digraph
from cosim.importing.streets import Streets, graph
from cosim.sumo.arrays import EdgeMask, EdgeNumbers, PerEdge
from cosim.sumo.net import City
from cosim.sumo.signals import FIXED, HELD
from nmfd.arrays import PerRegion
from nmfd.runs.tables import text_table

QUALITY = (
    "region",
    "name",
    "edges",
    "lane_km",
    "signals",
    "pieces",
    "mean_density_veh_km",
    "variance_before",
    "variance_within",
    "ncut_silhouette",
    "tv_n",
    "half_on_edges",
    "gateways",
    "controlled_gateways",
    "boundary_flow_veh",
    "uncontrolled_share",
)
GATEWAYS = (
    "source",
    "target",
    "from_edge",
    "to_edge",
    "lanes",
    "shared_lanes",
    "signal",
    "links",
    "signal_serves",
    "control",
    "kind",
    "flow_veh",
)


PARTITIONS = ("asked", "regions", "ncut_silhouette", "tv_n", "smallest_lane_share", "chosen")


@dataclass(frozen=True, kw_only=True)
class Tables:
    """quality: a row of QUALITY per region and one for "all"; gateways: a row of GATEWAYS per boundary crossing;
    partitions: one of PARTITIONS for each number of regions that was tried, none without densities.

    NcutSilhouette, of a region and of the whole, and TV_n are those of cosim.importing.homogeneity, over the streets
    for cars in the busiest quarter of an hour; a region's TV_n is its part of the sum. half_on_edges: the fewest edges
    that hold half of all vehicles then."""

    quality: Sequence[Mapping]
    gateways: Sequence[Mapping]
    partitions: Sequence[Mapping] = ()

    @property
    def uncontrolled(self) -> float:
        """Share of the boundary flow that no controlled signal sees; NaN without flow."""
        return self.quality[-1]["uncontrolled_share"]


def tables(
    streets: Streets,
    regions: EdgeNumbers,
    names: Sequence[str],
    city: City,
    baseline: Baseline | None,
    left_alone: Mapping[str, str],
    others: Mapping[int, EdgeNumbers] | None = None,
) -> Tables:
    """left_alone: signal -> why perimeter control does not touch it; others: partitions to compare with, by the number
    of regions that was asked for."""
    moves = Counter() if baseline is None else baseline.moves()
    pairs: dict[str, set[tuple[int, int]]] = {}
    for gateway in city.gateways:
        if gateway.signal is not None:
            pairs.setdefault(gateway.signal, set()).add((gateway.source, gateway.target))
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
            "control": "no signal" if g.signal is None else left_alone.get(g.signal, "controlled"),
            "kind": kind(streets, g.signal),
            "flow_veh": moves[streets.number[g.from_edge], streets.number[g.to_edge]],
        }
        for g in city.gateways
    ]
    density = np.zeros(len(regions)) if baseline is None else 1000.0 * baseline.density(streets)
    everywhere = _variance(density, streets, streets.drivable)[1]
    signals = _signals(streets, regions, city)
    rows = [
        _row(
            streets,
            regions == region,
            str(region),
            name,
            signals[region],
            density,
            everywhere,
            [g for g in gateways if region in (g["source"], g["target"])],
        )
        for region, name in enumerate(names)
    ]
    total = _row(streets, regions >= 0, "all", "all regions", signals.sum(), density, everywhere, gateways)
    weight = np.array([row["lane_km"] for row in rows])
    total["variance_within"] = round(float(np.average([row["variance_within"] for row in rows], weights=weight)), 2)
    total["pieces"] = sum(row["pieces"] for row in rows)
    for row, half in zip([*rows, total], _halves(streets, regions, baseline), strict=True):
        row["half_on_edges"] = half
    for row, silhouette, share in zip(rows, *_homogeneity(streets, regions, density), strict=True):
        row |= {"ncut_silhouette": round(silhouette, 3), "tv_n": round(share, 4)}
    total |= _overall(streets, regions, density)
    partitions = (
        []
        if baseline is None
        else [
            _compared(streets, found, density, number, chosen=False)
            for number, found in (others or {}).items()
            if found.max() != regions.max()
        ]
    )
    if baseline is not None:
        partitions.append(_compared(streets, regions, density, len(rows), chosen=True))
    return Tables(
        quality=[*rows, total],
        gateways=gateways,
        partitions=sorted(partitions, key=lambda row: (row["regions"], row["asked"])),
    )


def _homogeneity(streets: Streets, regions: EdgeNumbers, density: PerEdge) -> tuple[PerRegion, PerRegion]:
    """(NS of every region, its part of TV_n), each (R,) [-]"""
    links = streets.drivable
    joined = digraph(streets, regions) > 0
    silhouettes = ncut_silhouettes(density[links], regions[links], joined | joined.T)
    return silhouettes, variance_shares(density[links], regions[links], len(joined))


def _overall(streets: Streets, regions: EdgeNumbers, density: PerEdge) -> dict[str, float]:
    """NcutSilhouette and TV_n of a partition; NaN where nothing tells."""
    silhouettes, parts = _homogeneity(streets, regions, density)
    told = silhouettes[~np.isnan(silhouettes)]
    return {
        "ncut_silhouette": round(float(told.mean()), 3) if len(told) else np.nan,
        "tv_n": round(float(parts.sum()), 4),
    }


def _compared(streets: Streets, regions: EdgeNumbers, density: PerEdge, asked: int, *, chosen: bool) -> dict:
    """A row of PARTITIONS."""
    lanes = np.bincount(regions, streets.lane_metres)
    return {
        "asked": asked,
        "regions": len(lanes),
        **_overall(streets, regions, density),
        "smallest_lane_share": round(float(lanes.min() / lanes.sum()), 3),
        "chosen": int(chosen),
    }


def _halves(streets: Streets, regions: EdgeNumbers, baseline: Baseline | None) -> list[int]:
    """The fewest edges that hold half of all vehicles, of every region and of all, when these have the most."""
    members = [streets.drivable & (regions == region) for region in range(int(regions.max()) + 1)]
    return [0 if baseline is None else baseline.concentration(edges)[0] for edges in (*members, streets.drivable)]


def left_alone(streets: Streets) -> dict[str, str]:
    """Signal -> why perimeter control, which holds back at programmes of HELD kinds, leaves it alone."""
    found = {signal: "no programme" for signal in streets.link_signals if signal and signal not in streets.logics}
    return found | {
        signal: "switched off" if logics[-1].programme == "off" else f"{logics[-1].kind} signal"
        for signal, logics in streets.logics.items()
        if logics[-1].kind not in HELD or logics[-1].programme == "off"
    }


def kind(streets: Streets, signal: str | None) -> str:
    """Of the programme that a signal runs: "fixed", or SUMO's word for others; "" where there is none."""
    logics = streets.logics.get(signal or "")
    return "" if not logics else "fixed" if logics[-1].kind == FIXED else logics[-1].kind


def _row(
    streets: Streets,
    members: np.ndarray,
    region: str,
    name: str,
    signals: int,
    density: np.ndarray,
    everywhere: float,
    gateways: Sequence[Mapping],
) -> dict:
    usable = members & streets.drivable
    mean, variance = _variance(density, streets, usable)
    flow = sum(g["flow_veh"] for g in gateways)
    free = sum(g["flow_veh"] for g in gateways if g["control"] != "controlled")
    return dict(
        zip(
            QUALITY,
            (
                region,
                name,
                int(usable.sum()),
                round(float(streets.lane_metres[usable].sum()) / 1000.0, 2),
                int(signals),
                pieces(streets, usable & streets.main_part),
                round(mean, 2),
                round(everywhere, 2),
                round(variance, 2),
                np.nan,
                np.nan,
                0,
                len(gateways),
                sum(g["control"] == "controlled" for g in gateways),
                flow,
                round(free / flow, 3) if flow else float("nan"),
            ),
            strict=True,
        )
    )


def _variance(density: np.ndarray, streets: Streets, members: np.ndarray) -> tuple[float, float]:
    """Mean and variance of the density over the lanes of some edges."""
    weight = streets.lane_metres[members]
    mean = float(np.average(density[members], weights=weight))
    return mean, float(np.average((density[members] - mean) ** 2, weights=weight))


def pieces(streets: Streets, members: EdgeMask) -> int:
    """The parts into which some edges fall by the connections between them; 1 is connected."""
    numbers = np.cumsum(members) - 1
    links = streets.links[members[streets.links].all(axis=1)]
    return int(connected_components(graph(numbers[links], int(members.sum())), directed=False)[0])


def _signals(streets: Streets, regions: np.ndarray, city: City) -> np.ndarray:
    """(R,): every signal that cars see counts for the region in which most of its approaches lie."""
    votes: dict[str, Counter[int]] = {}
    for edge, signal in city.signals.items():
        votes.setdefault(signal, Counter())[int(regions[streets.number[edge]])] += 1
    count = np.zeros(int(regions.max()) + 1, dtype=int)
    for found in votes.values():
        count[max(sorted(found), key=found.__getitem__)] += 1
    return count


def text(tables: Tables) -> str:
    """The quality table for the terminal."""
    lines = []
    for row in tables.quality:
        share = "-" if np.isnan(row["uncontrolled_share"]) else f"{100 * row['uncontrolled_share']:.0f} %"
        title = row["name"] if row["region"] == "all" else f"{row['region']} {row['name']}"
        lines.append(
            {
                "region": title,
                "lane-km": row["lane_km"],
                "signals": row["signals"],
                "density": row["mean_density_veh_km"],
                "var. before": row["variance_before"],
                "within": row["variance_within"],
                "NS": row["ncut_silhouette"],
                "TV_n": row["tv_n"],
                "gateways": row["gateways"],
                "controlled": row["controlled_gateways"],
                "uncontrolled": share,
            }
        )
    return text_table(
        lines,
        "density: vehicles per lane-km in the busiest quarter of an hour without control; its variance over "
        "lanes; NS: NcutSilhouette, below 1 where streets are more like each other than like those of the most similar "
        "neighbour; TV_n: share of the variance over streets that is left within; uncontrolled: share of the flow over "
        "the region's boundary that no controlled signal sees",
    )
