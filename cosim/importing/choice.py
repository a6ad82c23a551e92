"""Regions at whose boundary gates hold most vehicles, and their number.

Searches start from partitions by density, and from these with a centre cut out round the densest
place: the ring and centre of perimeter control.
"""

from collections.abc import Collection, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from cosim.importing.baseline import Baseline
from cosim.importing.boundaries import (
    Clusters,
    Entered,
    Labels,
    Limits,
    Routes,
    Turns,
    with_room,
)
from cosim.importing.partition import (
    SMALLEST_SHARE,
    block_density,
    connect,
    features,
    finish,
    make_blocks,
    partition,
    without_signals,
)
from cosim.importing.quality import SMALLEST_LANE_KM
from cosim.importing.streets import Streets
from cosim.sumo.arrays import EdgeNumbers
from nmfd.errors import InputError

AUTO = "auto"
FEWEST_REGIONS = 2
MOST_REGIONS = 6
CENTRES = (0.15, 0.25, 0.35, 0.5)  # share of the lanes in a centre that is cut out
LARGEST_CLUSTER = 0.5  # of the smallest region
EVEN = 0.4  # of the variance of density that the best partition by density explains, at least
ENOUGH = 0.8  # of what gates hold at most: the fewest regions with so much are chosen
CHOSEN = "regions chosen: "  # how the reason begins


class Choice(NamedTuple):
    """A partition, and its reason in one sentence, "" without a search."""

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
    routes: Routes,
    wanted: int | EdgeNumbers | None,
    *,
    uncontrollable: Collection[str] = (),
) -> Choice:
    """Return the wanted regions.

    wanted: their number, those of the user's own table (E,), or None for AUTO
    routes, uncontrollable: as in `choose`
    Raises: InputError if the network has too few streets
    """
    if wanted is None or isinstance(wanted, int):
        return choose(streets, baseline, routes, regions=wanted, uncontrollable=uncontrollable)
    return Choice(finish(streets, wanted, own=True))


class _Found(NamedTuple):
    """Regions (E,), and vehicles that enter the densest one."""

    labels: EdgeNumbers
    entered: Entered

    @property
    def net(self) -> int:
        """Vehicles held less those leaking in."""
        return self.entered.held - self.entered.leaked


def densest_region(streets: Streets, baseline: Baseline, labels: EdgeNumbers) -> int:
    """Return the region with the most vehicles per lane metre at the peak."""
    lanes = streets.lane_metres
    vehicles = np.bincount(labels, baseline.density(streets) * lanes)
    return int(np.argmax(vehicles / np.bincount(labels, lanes)))


def choose(
    streets: Streets,
    baseline: Baseline,
    routes: Routes,
    *,
    regions: int | None = None,
    uncontrollable: Collection[str] = (),
) -> Choice:
    """Return the partition whose gates hold most vehicles; see `boundaries`.

    Vehicles are counted from the routes of all trips, as a run that locks drives only some. Every
    region has at least SMALLEST_LANE_KM, if such regions are possible.

    regions: their number, None for 2 to 6
    uncontrollable: signals that perimeter control cannot use
    Raises: InputError if the network has too few streets
    """
    lane_km = streets.lane_metres[streets.drivable].sum() / 1000.0
    most = int(min(max(lane_km // SMALLEST_LANE_KM, FEWEST_REGIONS), MOST_REGIONS))
    counts = range(FEWEST_REGIONS, most + 1)
    if regions is not None:
        counts = range(regions, regions + 1)
    turns = Turns(streets, routes, with_room(streets, uncontrollable))
    search = _Search(streets, baseline, uncontrollable)

    def judged(labels: EdgeNumbers) -> _Found:
        densest = densest_region(streets, baseline, labels)
        return _Found(labels, turns.entered(labels == densest))

    by_density = [search.by_density(count) for count in counts]
    even = EVEN * max(map(search.explained, by_density))
    plain = max(map(judged, by_density), key=lambda one: one.net)
    best: dict[int, _Found] = {}  # number of regions -> the best with so many
    for labels in (*by_density, *search.results(by_density, turns, even)):
        number = int(labels.max()) + 1
        smallest = np.bincount(labels, streets.lane_metres).min() / 1000.0
        if smallest < SMALLEST_LANE_KM or number < FEWEST_REGIONS:
            continue
        if regions not in (None, number):
            continue
        one = judged(labels)
        if number not in best or one.net > best[number].net:
            best[number] = one
    chosen = judged(by_density[0])
    if best:
        most = max(one.net for one in best.values())
        least = most - (1.0 - ENOUGH) * abs(most)
        chosen = best[min(number for number, one in best.items() if one.net >= least)]
    reason = f"{CHOSEN}{chosen.labels.max() + 1}"
    if regions is None:
        reason += f", the fewest whose gates hold {ENOUGH:.0%} of the most"
    held, leaked = chosen.entered
    reason += (
        f"; of {sum(routes.values()):,} vehicles {held:,} first enter the densest one past gates "
        f"with room and {leaked:,} elsewhere; by density alone these were "
        f"{plain.entered.held:,} and {plain.entered.leaked:,}"
    )
    return Choice(labels=chosen.labels, reason=reason)


class _Search:
    """Partitions by density, and searches from them."""

    def __init__(self, streets: Streets, baseline: Baseline, uncontrollable: Collection[str]):
        self._streets = streets
        self._baseline = baseline
        self._uncontrollable = uncontrollable
        blocks = make_blocks(streets)
        limit = LARGEST_CLUSTER * 1000.0 * SMALLEST_LANE_KM
        controllable = with_room(streets, uncontrollable)
        group = without_signals(streets, blocks, baseline.moves(), controllable, limit)
        of = np.where(blocks.of >= 0, group[blocks.of], -1)
        self._clusters = Clusters.made(streets, of, baseline.density(streets))
        smooth = features(blocks, block_density(streets, blocks, baseline))[:, 0]
        metres = np.bincount(group, blocks.weight)
        away = np.hypot(*(blocks.position - blocks.position[np.argmax(smooth)]).T)
        self._away = np.bincount(group, blocks.weight * away) / metres
        self.by_density = cache(self._by_density)

    def _by_density(self, regions: int) -> EdgeNumbers:
        """Return regions (E,) by density alone, a single one if that is asked for."""
        if regions < FEWEST_REGIONS:
            return np.zeros(len(self._streets.edges), dtype=int)
        return partition(
            self._streets, self._baseline, regions, uncontrollable=self._uncontrollable
        )

    def explained(self, labels: EdgeNumbers) -> float:
        """Return the share of the variance of density between regions."""
        return self._clusters.between(self._on_clusters(labels))

    def results(
        self, by_density: Sequence[EdgeNumbers], turns: Turns, even: float
    ) -> Iterator[EdgeNumbers]:
        """Yield regions (E,) found from those by density and from centres.

        even: as in Limits
        """
        clusters = self._clusters
        for plain in by_density:
            regions = int(plain.max()) + 1
            smallest = SMALLEST_SHARE * clusters.metres.sum() / regions
            limits = Limits(smallest=max(1000.0 * SMALLEST_LANE_KM, smallest), even=even)
            starts = [self._on_clusters(plain)]
            around = self._on_clusters(self.by_density(regions - 1))
            for share in CENTRES:
                starts.append(self._with_centre(around, share))
            for labels in starts:
                better = clusters.improved(labels, turns, limits)
                if clusters.between(better) >= even:
                    yield finish(self._streets, clusters.on_edges(better))

    def _with_centre(self, labels: Labels, share: float) -> Labels:
        """Return regions (U,) with a new one round the densest place.

        share: of all lanes
        """
        metres = self._clusters.metres
        order = np.argsort(self._away)
        centre = order[np.cumsum(metres[order]) <= share * metres.sum()]
        cut = labels.copy()
        cut[centre] = labels.max() + 1
        edges = np.maximum(self._clusters.on_edges(cut), 0)
        return self._on_clusters(connect(self._streets, edges))

    def _on_clusters(self, labels: EdgeNumbers) -> Labels:
        """Return the region (U,) of every cluster from that of edges."""
        of = self._clusters.of
        inside = of >= 0
        found = np.zeros(len(self._clusters.metres), dtype=int)
        found[of[inside]] = labels[inside]
        return np.unique(found, return_inverse=True)[1]
