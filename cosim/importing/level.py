"""The demand level at which a city without control congests: `cosim import --level auto`.

Congested is a city where at least one region, as the whole that perimeter control and the regional model see, comes to
its critical accumulation and stays there for a quarter of an hour: the accumulation beyond which its production, the
distance driven in it per second, falls. That is looked for in all runs tried so far (provisional regions, intervals of
baseline.INTERVAL). Neither will a bottleneck do, behind which a queue grows while the rest of the region flows as
before, nor a queue of a few streets that makes driving slow on the average: in the region's busiest quarter of an hour
half of its vehicles must be on more than FEW of its streets.

Levels are tried in SUMO's mesoscopic model, a tenth of the cost, then upwards in that of the scenario.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from cosim.importing.baseline import INTERVAL, PEAK, Baseline
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers

NEAR = 0.9  # of the critical accumulation
FALLEN = 0.9  # of the highest production: below, what is beyond counts as beyond critical
FEW = 0.03  # of the streets of a region
BINS = 12  # of the accumulation, in which the production is averaged
RATIO = 1.2  # between two levels that are tried: ..., 0.83, 1, 1.2, 1.44, ...
MOST = 6  # levels above and below 1


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """What one run showed of R regions in K intervals. accumulation: (K, R) [veh]; production: (K, R) [veh m/s];
    spread: (R,) the share of a region's streets that held half of its vehicles when it had the most [-]."""

    accumulation: Float[np.ndarray, "K R"]
    production: Float[np.ndarray, "K R"]
    spread: Float[np.ndarray, " R"]


Probe = Callable[[float, bool], Loaded]


def level(n: int) -> float:
    """The n-th level above 1 [-]; below it for a negative n."""
    return round(RATIO**n, 2)


def loaded(baseline: Baseline, streets: Streets, regions: EdgeNumbers) -> Loaded:
    """A run, region by region."""
    members = [streets.drivable & (regions == region) for region in range(int(regions.max()) + 1)]
    half, count = np.array([baseline.concentration(edges) for edges in members]).T
    return Loaded(
        accumulation=np.stack([baseline.presence[:, edges].sum(axis=1) / INTERVAL for edges in members], axis=1),
        production=np.stack([baseline.production[:, edges].sum(axis=1) / INTERVAL for edges in members], axis=1),
        spread=half / np.maximum(count, 1),
    )


def critical(accumulation: Float[np.ndarray, " N"], production: Float[np.ndarray, " N"]) -> float:
    """[veh] The accumulation with the highest production, in bins of the former; infinite if nothing beyond has less
    than FALLEN of it: then nobody knows where it is, but higher than all that was seen."""
    if accumulation.max() <= 0:
        return np.inf
    place = np.minimum((accumulation / accumulation.max() * BINS).astype(int), BINS - 1)
    count = np.bincount(place, minlength=BINS)
    used = count > 0
    mean = (np.bincount(place, production, BINS) / np.maximum(count, 1))[used]
    held = (np.bincount(place, accumulation, BINS) / np.maximum(count, 1))[used]
    top = int(np.argmax(mean))
    return float(held[top]) if mean[top:].min() < FALLEN * mean[top] else np.inf


def congested(run: Loaded, runs: Sequence[Loaded]) -> np.ndarray:
    """(R,) bool: the regions that are congested in `run`, one of `runs`, as the head of this file says."""
    found = []
    for region in range(len(run.spread)):
        limit = NEAR * critical(
            *(
                np.concatenate([getattr(one, name)[:, region] for one in runs])
                for name in ("accumulation", "production")
            )
        )
        above = (run.accumulation[:, region] >= limit).astype(int)
        long = np.convolve(above, np.ones(min(PEAK, len(above))), mode="valid").max() >= min(PEAK, len(above))
        found.append(bool(long) and run.spread[region] > FEW)
    return np.array(found, dtype=bool)


def congesting(probe: Probe, *, mesoscopic: bool, tell: Callable[[str], None]) -> tuple[float, bool]:
    """(the lowest level tried that congests, True), or (the highest there is, False).

    probe(level, mesoscopic): a run at this level
    """
    seen: dict[bool, dict[int, Loaded]] = {True: {}, False: {}}

    def congests(n: int, meso: bool) -> bool:
        if n not in seen[meso]:
            tell(f"demand times {level(n):g}{', mesoscopic' if meso else ''}")
            seen[meso][n] = probe(level(n), meso)
        return bool(congested(seen[meso][n], list(seen[meso].values())).any())

    n = 0
    while n < MOST and not congests(n, True):
        n += 1
    while n > -MOST and congests(n - 1, True):  # a critical accumulation seen higher up may be near further down
        n -= 1
    while not congests(n, mesoscopic):
        if n == MOST:
            return level(n), False
        n += 1
    while n - 1 in seen[mesoscopic] and congests(n - 1, mesoscopic):
        n -= 1
    return level(n), True
