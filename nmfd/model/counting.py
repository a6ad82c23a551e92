"""Regional model counted from runs.

It has exit rates by destination, and MFDs with one peak. In an interval with accumulations x_ij
the regional model lets

    k_ij q_i x_ij s_ij / D_ij,    s_ij: share that boundaries let pass,
                                  D_ij: mean time in i by the next regions, 1 for j = i

vehicles a second leave region i towards j (nmfd.model.dynamics). The runs tell how many left, E_ij:
those that crossed a boundary, or for j = i ended their trip. So the rates are ratios of sums over
the intervals,

    q_i(n) = sum E_ij / sum k_ij x_ij s_ij / D_ij  over j and the intervals with about n vehicles,
    k_ij   = sum E_ij / sum q_i x_ij s_ij / D_ij   over the flowing intervals.

The largest flow of a boundary is that of its signals, or less where its crossings show a limit.
Only the storage of regions that locked cannot be counted: it is the one that predicts best.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nmfd.arrays import Adjacency, PerPair, PerRegion
from nmfd.metrics import largest_accumulation
from nmfd.model.identification import HORIZON, Observed, prediction_errors
from nmfd.model.mfd import JAM_DENSITY, RoundedLinear, guess_beyond, held_up
from nmfd.model.regional_model import LEAST_ROOM, RegionalModel, passing_share

ROUNDS = 6  # of MFD, rates and capacities after each other
BINS = 24  # of accumulation
FEWEST_INTERVALS = 3  # of a bin
FEW_VEHICLES = 10.0  # that leave as the average vehicle does, added to the counts
FLOWING = 0.6  # of the largest outflow: a fuller region with less is locked
PEAK = 0.995  # of the largest outflow, where the peak begins
LAST = 0.95  # of the largest accumulation, from which on its outflow is a mean
SEEN_BEYOND = 1.3  # times the critical accumulation, which must be seen to know a plateau
FEWEST_FALLEN = 10  # intervals with less outflow that tell a fall from chance
RISE = (0.2, 0.4, 0.6, 0.8, 1.0)  # of the critical accumulation, points of the rising branch
FALLS = (0.95, 0.5, 0.1, 0.01)  # of the largest outflow: points of the branch of locked states
LIMITS = np.geomspace(1.0, 0.02, 60)  # of the capacity of a boundary, of which one is chosen
LOCKED = 0.5  # of the largest outflow: with less at the end of its data, a region has locked
STORAGES = (1.0, 0.8, 0.7, 0.6)  # of the largest accumulation of a region that locked
TELLING = 0.98  # of the squared error: a limit that lowers it to less is believed


@dataclass(frozen=True, kw_only=True)
class Counts:
    """N intervals of runs.

    inside: mean x_ij (veh, (N, R, R))
    exits: E_ij (veh/s, (N, R, R))
    flows: over boundaries (veh/s, (N, R, R))
    perimeter: (-, (N, R, R))
    splits: (-, (N, R, R, R))
    held_up: True where a neighbour holds up the outflow (bool, (N, R))
    step: control interval (s)
    """

    inside: np.ndarray
    exits: np.ndarray
    flows: np.ndarray
    perimeter: np.ndarray
    splits: np.ndarray
    held_up: np.ndarray
    step: float

    @classmethod
    def of(cls, runs: Sequence[Observed], step: float, adjacency: Adjacency) -> "Counts":
        """Return the intervals of all runs.

        step: control interval (s)
        """
        held = []
        for run in runs:
            assert run.exits is not None
            outflow = run.exits.sum(axis=2) / step
            held.append(held_up(run.inside.sum(axis=2), outflow, adjacency))
        return cls(
            step=step,
            inside=np.concatenate([run.inside for run in runs]),
            held_up=np.concatenate(held),
            exits=np.concatenate([run.exits for run in runs]) / step,
            flows=np.concatenate([run.crossings for run in runs]) / step,
            perimeter=np.concatenate([run.perimeter for run in runs]),
            splits=np.concatenate([run.splits for run in runs]),
        )


def counted(
    network: RegionalModel,
    runs: Sequence[Observed],
    *,
    scheme: Mapping[str, Any],
    fastest: PerRegion,
    saturation: PerPair,
    lane_km: PerRegion,
) -> RegionalModel:
    """Return `network` with counted rates, capacities and MFDs.

    scheme: step [s], substeps and integrator of predictions
    fastest: largest rate of any vehicle (1/s, (R,))
    saturation: largest flow over each boundary that its signals allow (veh/s, (R, R))
    lane_km: lane-kilometres (km, (R,))
    """
    counts = Counts.of(runs, scheme["step"], network.adjacency)
    most = largest_accumulation(run.accumulation for run in runs)
    start = replace(
        network,
        exit_rates=np.ones(network.adjacency.shape),
        capacity=np.where(network.adjacency, saturation, 0.0),
        storage=np.maximum(JAM_DENSITY * lane_km, most),
        equal_ways=True,
        critical_above={},
    )
    model = _counted(start, counts, fastest, lane_km)
    locked = [_locked(model, region, most[region]) for region in range(model.regions)]
    if not any(locked):
        return model
    found = [model]
    for share in STORAGES:
        storage = np.where(locked, share * most, start.storage)
        found.append(_counted(replace(start, storage=storage), counts, fastest, lane_km))
    horizon = min(HORIZON, max(len(run.demand) for run in runs))
    errors = [(prediction_errors(one, runs, horizon, **scheme) ** 2).mean() for one in found]
    return found[int(np.argmin(errors))]


def _counted(
    start: RegionalModel, counts: Counts, fastest: PerRegion, lane_km: PerRegion
) -> RegionalModel:
    """Return the counted model with the storage of `start`.

    start: its capacities are the largest ones
    """
    assert start.capacity is not None
    model = start
    for _ in range(ROUNDS):
        passed = _passed(model, counts)
        model, flowing = _with_mfds(model, counts, passed, lane_km)
        model = _with_rates(model, counts, passed, flowing, fastest)
        model = _with_capacities(model, counts, flowing, start.capacity)
    return model


def _locked(model: RegionalModel, region: int, most: float) -> bool:
    """Return True if the outflow of a region has fallen at `most` vehicles."""
    if region in model.critical_above:
        return False
    curve = model.mfds[region]
    return bool(curve.outflow(most) < LOCKED * curve.capacity)


def _rates(model: RegionalModel, counts: Counts) -> np.ndarray:
    """Return q_i of each interval (1/s, (N, R))."""
    n = counts.inside.sum(axis=2)
    return np.stack([mfd.rate(n[:, i]) for i, mfd in enumerate(model.mfds)], axis=1)


def _durations(model: RegionalModel, counts: Counts) -> np.ndarray:
    """Return D_ij, the mean time in i by the next regions (-, (N, R, R))."""
    detours = model.detours
    assert detours is not None
    return 1.0 + (counts.splits * detours).sum(axis=2)


def _boundary_shares(model: RegionalModel, counts: Counts, wish: np.ndarray) -> np.ndarray:
    """Return the share of the desired flow that passes (-, (N, R, R))."""
    room = np.maximum(1.0 - counts.inside.sum(axis=2) / model.storage, LEAST_ROOM)
    limit = counts.perimeter * model.open_capacity * room[:, None, :]
    return passing_share(wish, limit)


def _desired_flows(model: RegionalModel, counts: Counts) -> np.ndarray:
    """Return the desired flow over each boundary (veh/s, (N, R, R))."""
    leaving = model.exit_rates * _rates(model, counts)[..., None] * counts.inside
    onward = leaving / _durations(model, counts) * ~np.eye(model.regions, dtype=bool)
    return np.einsum("nihj,nij->nih", counts.splits, onward)


def _passed(model: RegionalModel, counts: Counts) -> np.ndarray:
    """Return s_ij / D_ij, which leave in the mean time (-, (N, R, R))."""
    shares = _boundary_shares(model, counts, _desired_flows(model, counts))
    passed = np.einsum("nihj,nih->nij", counts.splits, shares)
    own = np.arange(model.regions)
    passed[:, own, own] = 1.0
    return passed / _durations(model, counts)


def _with_mfds(
    model: RegionalModel, counts: Counts, passed: np.ndarray, lane_km: PerRegion
) -> tuple[RegionalModel, np.ndarray]:
    """Return `model` with counted MFDs, and the flowing intervals (N, R)."""
    n = counts.inside.sum(axis=2)
    exits = counts.exits.sum(axis=2)
    ready = (model.exit_rates * counts.inside * passed).sum(axis=2)
    mfds = list(model.mfds)
    flowing = np.zeros(n.shape, dtype=bool)
    critical_above = {}
    for i in range(model.regions):
        used = (ready[:, i] > 0) & ~counts.held_up[:, i]
        if used.sum() < FEWEST_INTERVALS:
            critical_above[i] = float(n[:, i].max(initial=0.0))
            continue
        samples = n[used, i], exits[used, i], ready[used, i]
        mfds[i], flowing[used, i], seen = mfd_of(*samples, JAM_DENSITY * lane_km[i])
        if not seen:
            critical_above[i] = float(n[:, i].max())
    return replace(model, mfds=tuple(mfds), critical_above=critical_above), flowing


def mfd_of(
    n: np.ndarray, exits: np.ndarray, ready: np.ndarray, jam: float
) -> tuple[RoundedLinear, np.ndarray, bool]:
    """Return an MFD, its flowing intervals, and True if its end was seen.

    The outflow rises to its largest value, and does not rise beyond. After the largest accumulation
    it stays; but if neither a plateau nor a fall was seen, a guess goes on from there.

    n: accumulations (veh, (N,))
    exits: vehicles that left (veh/s, (N,))
    ready: vehicles that leave at the rate q; the others wait before a boundary (veh, (N,))
    jam: jam accumulation of the lanes (veh)
    """
    middle, level, intervals = _pooled(n, exits, ready)
    nearest = _unimodal(level, intervals)
    top = int(np.argmax(nearest >= PEAK * nearest.max()))
    critical = middle[top]
    end = middle[-1]
    capacity = float(nearest[top])
    falling = np.minimum.accumulate(nearest[top:])
    fallen = intervals[top:][falling < FALLS[0] * capacity].sum()
    seen = end >= SEEN_BEYOND * critical or fallen >= FEWEST_FALLEN
    if not seen:
        critical = end
        capacity = float(level[middle >= LAST * end].mean())
    rise = np.array(RISE) * critical
    outflows = [*np.interp(rise[:-1], [0.0, *middle], [0.0, *nearest]), capacity]
    if seen:
        beyond, further = _fall(middle[top:], falling, capacity, max(jam, 1.1 * end))
    else:
        known = RoundedLinear(accumulations=tuple(rise), outflows=tuple(outflows))
        guessed = guess_beyond(known, jam, end)
        beyond = np.linspace(guessed.critical, guessed.jam, len(FALLS))
        further = guessed.outflow(beyond)
    curve = RoundedLinear(
        accumulations=tuple(map(float, [*rise, *beyond])),
        outflows=tuple(map(float, [*outflows, *further])),
    )
    flowing = n * exits / ready >= FLOWING * curve.outflow(np.minimum(n, critical))
    return curve, flowing, bool(seen)


def _fall(
    n: np.ndarray, outflow: np.ndarray, capacity: float, jam: float
) -> tuple[list[float], list[float]]:
    """Return points beyond the largest outflow (veh), (veh/s).

    There the outflow falls to each of FALLS. Where it was not seen to fall so far, it stays.

    n, outflow: of the runs, from the critical accumulation; the outflow does not rise (veh, veh/s)
    jam: beyond all (veh)
    """
    points = []
    levels: list[float] = []
    last = float(n[0])
    for share in FALLS:
        level = min(max(share * capacity, float(outflow[-1])), capacity)
        place = float(np.interp(-level, -outflow, n))
        if share * capacity < level and levels and levels[-1] == level:
            place = 0.5 * (last + jam)
        last = max(place, 1.001 * last)
        points.append(last)
        levels.append(level)
    return points, levels


def _pooled(n: np.ndarray, exits: np.ndarray, ready: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return accumulations (veh), outflows (veh/s) and sizes of bins.

    Vehicles leave a bin at the ratio of sums; it falls with the accumulation.
    """
    from scipy.optimize import isotonic_regression  # slow to import

    bins = np.minimum((BINS * n / n.max()).astype(int), BINS - 1)
    sizes = np.bincount(bins)
    used = sizes > 0
    weight = np.bincount(bins, ready)[used]
    middle = np.bincount(bins, n)[used] / sizes[used]
    rates = np.bincount(bins, exits)[used] / weight
    falling = isotonic_regression(rates, weights=weight, increasing=False).x
    return middle, middle * falling, sizes[used].astype(float)


def _unimodal(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the nearest values that rise to a largest one, and then fall."""
    from scipy.optimize import isotonic_regression  # slow to import

    found = []
    for top in range(len(values)):
        rise = isotonic_regression(values[: top + 1], weights=weights[: top + 1]).x
        fall = isotonic_regression(values[top:], weights=weights[top:], increasing=False).x
        found.append([*rise[:-1], max(rise[-1], fall[0]), *fall[1:]])
    misfit = (weights * (np.array(found) - values) ** 2).sum(axis=1)
    return np.array(found[int(misfit.argmin())])


def _with_rates(
    model: RegionalModel,
    counts: Counts,
    passed: np.ndarray,
    flowing: np.ndarray,
    fastest: PerRegion,
) -> RegionalModel:
    """Return `model` with counted exit rates, 1 for the average vehicle.

    The MFDs take the rest, so that as many vehicles leave as were counted.
    """
    usual = _rates(model, counts)[..., None] * counts.inside * passed
    left = (counts.exits * flowing[..., None]).sum(axis=0) * counts.step
    expected = (usual * flowing[..., None]).sum(axis=0) * counts.step
    rates = (left + FEW_VEHICLES) / (expected + FEW_VEHICLES)
    vehicles = counts.inside.sum(axis=0) + 1e-9
    mean = (rates * vehicles).sum(axis=1) / vehicles.sum(axis=1)
    mfds = []
    for curve, level in zip(model.mfds, mean, strict=True):
        if isinstance(curve, RoundedLinear):
            curve = replace(curve, outflows=tuple(float(level * g) for g in curve.outflows))
        mfds.append(curve)
    free = np.array([curve.rate_up_to_jam(0.0) for curve in mfds])
    rates = np.minimum(rates / mean[:, None], (fastest / free)[:, None])
    return replace(model, mfds=tuple(mfds), exit_rates=rates)


def _with_capacities(
    model: RegionalModel, counts: Counts, flowing: np.ndarray, saturation: PerPair
) -> RegionalModel:
    """Return `model` with the capacities that crossings show.

    They are those of the signals, or less. A limit and a lower exit rate explain the same number of
    crossings. So each limit is judged with the desired flows that give this number under it.
    """
    both = flowing[:, :, None] & flowing[:, None, :]
    wish = _desired_flows(model, counts) * both
    flows = counts.flows * both
    seen = flows.sum(axis=0)
    misfits = []
    for limit in LIMITS:
        limited = replace(model, capacity=limit * saturation * model.adjacency)
        scaled = wish
        for _ in range(ROUNDS):
            flow = scaled * _boundary_shares(limited, counts, scaled)
            scaled = scaled * (seen / np.maximum(flow.sum(axis=0), 1e-9))
        misfits.append(((flow - flows) ** 2).sum(axis=0))
    misfit = np.array(misfits)
    shown = misfit.min(axis=0) < TELLING * misfit[0]
    limit = np.where(shown, LIMITS[misfit.argmin(axis=0)], 1.0)
    return replace(model, capacity=limit * saturation * model.adjacency)
