"""What loading runs say of perimeter control in a city (nmfd.model.authority)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from cosim.evaluation.simulate import Result
from cosim.sumo.net import City, city_of
from nmfd.model import authority
from nmfd.model.authority import Boundaries, Verdict
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import files


def of_runs(network: RegionalModel, results: Sequence[Result]) -> Verdict:
    """Of the city of `network`, by runs in which no gateway was closed."""
    critical = network.critical
    most = np.max([result.accumulation.sum(axis=2).max(axis=0) for result in results], axis=0) / critical
    started = np.sum([result["departures"].sum(axis=(0, 2)) for result in results], axis=0)
    where = f"in {len(results)} loading run{'s' * (len(results) > 1)} under {results[0].controller}"
    seen = boundaries(city_of(network), results)
    return authority.verdict(network, seen, most=most, started=started.astype(float), where=where)


def boundaries(city: City, results: Sequence[Result]) -> Boundaries:
    """Who crossed where, and whether past a signal under control: one without has no original green in a record."""
    shape = (city.regions,) * 2
    flow, controlled = np.zeros(shape), np.zeros(shape)
    count, controllable = np.zeros(shape, dtype=int), np.zeros(shape, dtype=int)
    for n, gateway in enumerate(city.gateways):
        pair = gateway.source, gateway.target
        reached = not np.isnan(results[0]["gateway_original_green"][0, n])
        passed = sum(float(result["gateway_flow"][:, n].sum()) for result in results)
        count[pair] += 1
        flow[pair] += passed
        controllable[pair] += reached
        controlled[pair] += passed * reached
    return Boundaries(flow=flow, controlled=controlled, gateways=count, controllable=controllable)


def write_verdict(folder: Path, found: Verdict) -> None:
    """verdict.txt and boundaries.csv."""
    files.write_text(folder / authority.FILE, found.text())
    files.write_text(
        folder / "boundaries.csv", pd.DataFrame(found.boundaries.rows(), columns=authority.COLUMNS).to_csv(index=False)
    )
