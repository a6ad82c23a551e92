"""Regions as the user wants them: a number, a table, or AUTO.

With AUTO it is the partition whose gates can hold most vehicles.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from cosim.importing.baseline import Baseline
from cosim.importing.partition import finish, partition
from cosim.importing.quality import SMALLEST_LANE_KM
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers
from nmfd.errors import InputError

AUTO = "auto"
FEWEST_REGIONS = 2
MOST_REGIONS = 6
CHOSEN = "regions chosen: "  # how the reason begins


class Choice(NamedTuple):
    """A partition, and the reason for its number of regions in one sentence.

    The reason is "" if the user said which regions.
    """

    labels: EdgeNumbers
    reason: str = ""


def number_of(regions: str, fewest: int = FEWEST_REGIONS) -> int | None:
    """Return the number of regions to find, None for a file or AUTO.

    Raises: InputError
    """
    if not regions.isdecimal():
        return None
    if int(regions) < fewest:
        raise InputError(
            f"--regions: expected {fewest} or more regions, or a file, got {regions} instead"
        )
    return int(regions)


def labelled(
    streets: Streets,
    baseline: Baseline,
    moves: Mapping[tuple[int, int], int],
    wanted: int | EdgeNumbers | None,
    *,
    uncontrollable: Collection[str] = (),
) -> Choice:
    """Return the wanted regions.

    wanted: their number, those of the user's own table (E,), or None for AUTO
    moves, uncontrollable: as in `holdable`
    Raises: InputError if the network has too few streets
    """
    if wanted is None:
        return choose(streets, baseline, moves, uncontrollable=uncontrollable)
    if isinstance(wanted, int):
        return Choice(partition(streets, baseline, wanted, uncontrollable=uncontrollable))
    return Choice(finish(streets, wanted, own=True))


def densest_region(streets: Streets, baseline: Baseline, labels: EdgeNumbers) -> int:
    """Return the region with the most vehicles per lane metre at the peak."""
    lanes = streets.lane_metres
    vehicles = np.bincount(labels, baseline.density(streets) * lanes)
    return int(np.argmax(vehicles / np.bincount(labels, lanes)))


def holdable(
    streets: Streets,
    baseline: Baseline,
    moves: Mapping[tuple[int, int], int],
    labels: EdgeNumbers,
    uncontrollable: Collection[str],
) -> int:
    """Return the vehicles that gates into the densest region could hold.

    moves: (edge, next edge) -> how often routes lead there
    uncontrollable: signals that perimeter control cannot use
    """
    densest = densest_region(streets, baseline, labels)
    held = 0
    for (a, b), signal in zip(streets.links, streets.link_signals, strict=True):
        enters = labels[a] != densest and labels[b] == densest
        if enters and signal is not None and signal not in uncontrollable:
            held += moves.get((int(a), int(b)), 0)
    return held


def choose(
    streets: Streets,
    baseline: Baseline,
    moves: Mapping[tuple[int, int], int],
    *,
    uncontrollable: Collection[str] = (),
) -> Choice:
    """Return the partition with 2 to 6 regions whose gates can hold most.

    Vehicles are counted from the routes of all trips, as a run that locks drives only some. Every
    region has at least SMALLEST_LANE_KM, if two such regions are possible.

    moves, uncontrollable: as in `holdable`
    Raises: InputError if the network has too few streets
    """
    lane_km = streets.lane_metres[streets.drivable].sum() / 1000.0
    most = int(min(max(lane_km // SMALLEST_LANE_KM, FEWEST_REGIONS), MOST_REGIONS))
    found = {}
    for count in range(FEWEST_REGIONS, most + 1):
        labels = partition(streets, baseline, count, uncontrollable=uncontrollable)
        smallest = np.bincount(labels, streets.lane_metres).min() / 1000.0
        if count == FEWEST_REGIONS or smallest >= SMALLEST_LANE_KM:
            regions = int(labels.max()) + 1
            held = holdable(streets, baseline, moves, labels, uncontrollable)
            found[regions] = (held, labels)
    best = max(found, key=lambda regions: (found[regions][0], -regions))
    held, labels = found[best]
    others = [f"{found[regions][0]:,} with {regions}" for regions in found if regions != best]
    than = f", rather than {', '.join(others)}" if others else ""
    reason = f"{CHOSEN}{best} regions: gates into the densest one meet {held:,} vehicles{than}"
    return Choice(labels=labels, reason=reason)
