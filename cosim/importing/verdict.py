"""What an import can say of perimeter control: from the gateways, and from the run without control."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cosim.importing.baseline import INTERVAL, Baseline
from cosim.importing.written import write_table
from cosim.sumo.arrays import EdgeNumbers
from nmfd.model import authority
from nmfd.model.authority import Boundaries, Verdict
from nmfd.model.regional_model import RegionalModel


def of_import(
    network: RegionalModel, gateways: Sequence[Mapping], regions: EdgeNumbers, baseline: Baseline | None
) -> Verdict:
    """gateways: rows of gateways.csv (cosim.importing.quality); regions: (E,)"""
    shape = (network.regions,) * 2
    flow, controlled = np.zeros(shape), np.zeros(shape)
    count, controllable = np.zeros(shape, dtype=int), np.zeros(shape, dtype=int)
    for row in gateways:
        pair, reached = (row["source"], row["target"]), str(row["control"]).startswith("controlled")
        count[pair] += 1
        flow[pair] += row["flow_veh"]
        controllable[pair] += reached
        controlled[pair] += row["flow_veh"] * reached
    boundaries = Boundaries(flow=flow, controlled=controlled, gateways=count, controllable=controllable)
    if baseline is None:
        return authority.verdict(network, boundaries, most=None, started=None, where="")
    held = np.array([np.bincount(regions, row, network.regions) for row in baseline.presence]) / INTERVAL
    started = np.zeros(network.regions)
    for (way, _), vehicles in baseline.ways.items():
        if way:
            started[regions[way[0]]] += vehicles
    critical = network.critical
    return authority.verdict(
        network, boundaries, most=held.max(axis=0) / critical, started=started, where="in the run without control"
    )


def write_verdict(folder: Path, found: Verdict) -> None:
    """verdict.txt and boundaries.csv."""
    (folder / authority.FILE).write_text(found.text(), encoding="utf-8")
    write_table(folder / "boundaries.csv", authority.COLUMNS, found.boundaries.rows())
