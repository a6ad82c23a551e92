"""Measures of finished runs by region: trip times by origin, CO2, and the street with the longest queue."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from cosim.evaluation.results import Level
from cosim.sumo.net import City
from nmfd.arrays import PerRegion
from nmfd.types import Result


def common_runs(level: Level, names: Sequence[str]) -> list[list[Result]]:
    """Return the runs of each controller on the seeds that all have, without those that lack these measures."""
    runs = [{run.seed: run for run in level.results(name) if "trip_time_by_origin" in run} for name in names]
    seeds = sorted(set.intersection(*map(set, runs)))
    return [[of[seed] for seed in seeds] for of in runs]


def longer_trips(level: Level, name: str, against: str) -> PerRegion:
    """Return the change of the mean trip time [%] by origin, (R,), or (0,) without a common seed; NaN without trips."""
    own, before = (np.array([run.trip_time_by_origin for run in runs]) for runs in common_runs(level, (name, against)))
    return 100.0 * (own.mean(axis=0) / before.mean(axis=0) - 1.0) if len(own) else np.zeros(0)


def table(level: Level, city: City, region_names: Sequence[str], names: Sequence[str]) -> pd.DataFrame | None:
    """Return a row of text per region and one of all; None without a common seed.

    names: controllers, the reference first; means over their common seeds, but the longest queue of all
    """
    runs = common_runs(level, names)
    if not runs[0]:
        return None
    region = np.array([city.region_of[edge] for edge in city.edges])
    means = [np.mean([_numbers(run, region, len(region_names)) for run in of], axis=0) for of in runs]
    columns: dict[tuple[str, str], list[str]] = {("", "region"): [*region_names, "all"]}
    for n, heading in enumerate(("trip from here [s]", "CO2 [kg]")):
        for name, values in zip(names, means, strict=True):
            columns[heading, name] = [f"{value:,.0f}" for value in values[n]]
        if len(names) > 1:
            changes = 100.0 * (means[-1][n] / means[0][n] - 1.0)
            columns[heading, "change"] = [f"{change:+.1f} %" for change in changes]
    for name, of in zip(names, runs, strict=True):
        queue = np.max([run.queue_max for run in of], axis=0)
        inside = [np.flatnonzero(region == r) for r in range(len(region_names))] + [np.arange(len(region))]
        longest = [edges[np.argmax(queue[edges])] for edges in inside]
        columns["longest queue [veh], on street", name] = [f"{queue[edge]}, {city.edges[edge]}" for edge in longest]
    return pd.DataFrame(columns)


def _numbers(run: Result, region: np.ndarray, regions: int) -> np.ndarray:
    """Return trip times [s] by origin and CO2 [kg], (2, R + 1), by region and at last of all."""
    co2 = np.bincount(region, run.co2, regions)
    return np.array([[*run.trip_time_by_origin, run.mean_trip_time_s], [*co2, co2.sum()]])
