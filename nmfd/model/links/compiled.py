"""Steps of the link model, and their derivatives, in machine code.

The equations are those of `flows.Flows.step`, `signals.Gates.limit`, `signals.MaxPressure` and
`interval.Steps`, which say what they mean, are the reference, and run on a GPU. On a processor, a
step is a hundred operations on arrays of a few thousand counts, and each goes through memory; here
all steps of one rollout follow each other in the cache. All counts are arrays of one precision.

`derive` has the equations of `advance` in reverse order, with derivatives d_x, by x, of what the
rollout is judged by. As in torch, a limit that binds passes none. All is in one file, because
machine code that was kept is made again when its own file has changed, not when others have.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numba import njit

if TYPE_CHECKING:  # guidance in SUMO takes `compiled` from here, without torch
    from nmfd.model.links.signals import Stages

F = TypeVar("F", bound=Callable)


def compiled(function: F) -> F:
    """Return a function as machine code, which is kept beside its file."""
    return _compiled(function)


def inner(function: F) -> F:
    """Return a function as machine code that only machine code calls."""
    return _compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def _compiled(function: F, **others: bool) -> F:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        code: Any = njit(cache=True, **options, **others)(function)
    except RuntimeError:  # no folder to keep it in may be written: every process compiles anew
        code = njit(**options, **others)(function)
    return code


class City(NamedTuple):
    """Places and numbers of a city, as Flows, Gates and LinkModel name them.

    movement, link, whole, taken, cycle: of each gate (G,)
    cells: in the order of their entries (C,); first_cell: of each entry among these (E + 1,)
    extended: gates are those of actuated signals; chain_limit: as of nmfd.model.links.model.Choices
    gap, smoothing, dt, epsilon, least, zero, one: numbers in the precision of the counts
    """

    link_of_entry: Any
    region_of_entry: Any
    entry_of_cell: Any
    cells: Any
    first_cell: Any
    onward: Any
    turn_of_cell: Any
    movement_of_turn: Any
    link_entered: Any
    link_left: Any
    served: Any
    server: Any
    link_of_lane: Any
    yielding: Any
    foe: Any
    gaps: Any
    minor: Any
    home: Any
    home_link: Any
    ahead: Any
    met: Any
    pace_to_end: Any
    earlier: Any
    part: Any
    along: Any
    started: Any
    to_end: Any
    backwards: Any
    storage: Any
    most_in: Any
    first_of_lane: Any
    lanes_of_turn: Any
    lane_share: Any
    pace: Any
    per_step: Any
    movement: Any
    link: Any
    whole: Any
    taken: Any
    cycle: Any
    extended: bool
    chain_limit: Any
    smoothing: Any
    dt: Any
    epsilon: Any
    least: Any
    zero: Any
    one: Any


class Choosing(NamedTuple):
    """Places and numbers of signals.MaxPressure, with its names.

    called, decision_period, longest_green, longest_red: constants of nmfd.model.links.signals
    dt, zero, one: as of City
    """

    chooses: Any
    signal: Any
    light: Any
    yields: Any
    loss: Any
    least: Any
    count: Any
    link: Any
    pressed: Any
    presses: Any
    weight: Any
    gain_stage: Any
    gain_movement: Any
    gain: Any
    lost: Any
    called: Any
    decision_period: Any
    longest_green: Any
    longest_red: Any
    lookahead: Any
    dt: Any
    zero: Any
    one: Any


class Given(NamedTuple):
    """Commands and shares of B rollouts in an interval of K steps.

    due: trips of a step, by entry (veh, (B, E))
    cells, goes_on, at_end: as of flows.Ways
    chosen: share of the vehicles that move up now, by cell, which machine code sets (B, C);
        `cells` if streams divide
    low, high, draws: as of chance.Choice; no rows if streams divide
    metering: (veh/s, (B, R)); gates: share of each gate (-, (B, G)); no rows without commands
    light, yields: as of signals.Lights in each step (K, B, M)
    opens: 1 where the window of a gate begins (K, G)
    """

    due: Any
    cells: Any
    goes_on: Any
    at_end: Any
    chosen: Any
    low: Any
    high: Any
    draws: Any
    metering: Any
    gates: Any
    light: Any
    yields: Any
    opens: Any


class Counts(NamedTuple):
    """Counts before each step, and after the last one (rows, B, any number).

    With one row, steps change it.

    asked, used: as of interval.LinkState; others: as of flows.Traffic
    """

    asked: Any
    held: Any
    due: Any
    queue: Any
    first: Any
    standing: Any
    stopping: Any
    inside: Any
    recent: Any
    completed: Any
    moved: Any
    left: Any
    used: Any


class Histories(NamedTuple):
    """Histories of flows.Traffic, and what K steps add (B, rows + K, n)."""

    entered: Any
    started: Any
    ending: Any
    had_left: Any


class Sums(NamedTuple):
    """Sums of B rollouts over an interval.

    begun: trips (veh, (B,)); held, outside: vehicles (veh, (B,))
    waiting: vehicles outside after the last step, by link (veh, (B, L))
    present: vehicles (veh, (B, L)); share: mean share of each gate (-, (B, G))
    """

    begun: Any
    held: Any
    outside: Any
    waiting: Any
    present: Any
    share: Any


class _Work(NamedTuple):
    """Intermediate numbers of a step of one rollout.

    Names are those of the reference.

    left: share of a gate's green before it is limited to what there is
    free: room on each link before it is limited
    """

    held: Any
    begin: Any
    waits: Any
    rate: Any
    light: Any
    share: Any
    left: Any
    opened: Any
    arrived: Any
    up: Any
    first: Any
    by_turn: Any
    stood: Any
    arriving: Any
    leader: Any
    green: Any
    going: Any
    open_share: Any
    gap: Any
    in_lane: Any
    room: Any
    queued: Any
    moving_up: Any
    share_in_queue: Any
    stopping: Any
    waiting: Any
    put: Any
    wanted: Any
    minor: Any
    wanted_minor: Any
    rho_minor: Any
    entering: Any
    free: Any
    receives: Any
    rho: Any
    entered: Any
    started: Any
    passed: Any
    coming: Any
    gone: Any


@inner
def _work_of(city: City, given: Given) -> _Work:
    """Return room for the intermediate numbers of a rollout."""
    kind = given.cells.dtype
    entries = len(city.link_of_entry)
    cells = len(city.onward)
    turns = len(city.link_entered)
    movements = len(city.link_left)
    links = len(city.storage)
    gates = len(city.whole)
    return _Work(
        held=np.empty(entries, kind),
        begin=np.empty(entries, kind),
        waits=np.empty(given.metering.shape[1], kind),
        rate=np.empty(given.metering.shape[1], kind),
        light=np.empty(movements, kind),
        share=np.empty(gates, kind),
        left=np.empty(gates, kind),
        opened=np.empty(gates, kind),
        arrived=np.empty(entries, kind),
        up=np.empty(entries, kind),
        first=np.empty(cells, kind),
        by_turn=np.empty(turns, kind),
        stood=np.empty(turns, kind),
        arriving=np.empty(turns, kind),
        leader=np.empty(turns, kind),
        green=np.empty(turns, kind),
        going=np.empty(turns, kind),
        open_share=np.empty(movements, kind),
        gap=np.empty(movements, kind),
        in_lane=np.empty(len(city.first_of_lane), kind),
        room=np.empty(links, kind),
        queued=np.empty(links, kind),
        moving_up=np.empty(links, kind),
        share_in_queue=np.empty(links, kind),
        stopping=np.empty(links, kind),
        waiting=np.empty(links, kind),
        put=np.empty(links, kind),
        wanted=np.empty(links, kind),
        minor=np.empty(turns, kind),
        wanted_minor=np.empty(links, kind),
        rho_minor=np.empty(links, kind),
        entering=np.empty(turns, kind),
        free=np.empty(links, kind),
        receives=np.empty(links, kind),
        rho=np.empty(links, kind),
        entered=np.empty(entries, kind),
        started=np.empty(entries, kind),
        passed=np.empty(movements, kind),
        coming=np.empty(links, kind),
        gone=np.empty(links, kind),
    )


@inner
def _row(history: Any, given: Given, k: int) -> int:
    """Return the row of a history for the values of step k."""
    return history.shape[1] - len(given.light) + k


@compiled
def advance(
    city: City,
    given: Given,
    counts: Counts,
    histories: Histories,
    sums: Sums,
    signals: Choosing | None,
    stages: Any,
    first: int,
    begin: int,
    end: int,
    rollouts: tuple[int, int],
) -> None:
    """Advance rollouts from step `begin` of the interval to step `end`.

    signals, stages: under max-pressure, and their state (signals.Stages), which it changes
    first: number of the first step of the interval
    rollouts: number of the first one, and of the one after the last
    """
    work = _work_of(city, given)
    # Each step adds to them, and `_count_entries` leaves 0.
    work.entered[:] = city.zero
    work.started[:] = city.zero
    for b in range(*rollouts):
        if begin == 0:
            _choose(city, given, counts, b)
        for k in range(begin, end):
            now = k % len(counts.queue)
            if signals is not None:
                since = (first + k) * signals.dt % signals.decision_period
                if since < signals.dt:
                    _decide(signals, counts.inside[now, b], stages, b)
                _show(signals, stages, given.light[k, b], given.yields[k, b], b)
            sums.begun[b] += _flow(city, given, counts, histories, b, now, k, work)
            _leave(city, counts, b, k, work)
            _count_links(city, counts, histories, given, sums, b, k, work)
            _count_entries(city, counts, histories, given, sums, b, k, work)
            _count_gates(city, counts, given, sums, b, k, work)


@inner
def _choose(city: City, given: Given, counts: Counts, b: int) -> None:
    """Set which cells the next vehicles of rollout b take."""
    if len(given.draws) > 0:
        for e in range(len(city.link_of_entry)):
            _take(city, given, b, e, counts.moved[0, b, e])


@inner
def _choose_again(city: City, given: Given, counts: Counts, b: int, before: int, now: int) -> None:
    """Set them where the next vehicles are not those of row `before`."""
    if len(given.draws) > 0:
        for e in range(len(city.link_of_entry)):
            moved = counts.moved[now, b, e]
            if int(moved) != int(counts.moved[before, b, e]):
                _take(city, given, b, e, moved)


@inner
def _take(city: City, given: Given, b: int, e: int, moved: float) -> None:
    """Set which cells the next vehicle of entry e takes.

    moved: vehicles that moved up so far
    """
    last = given.draws.shape[1] - 1  # all bits are 1
    draw = given.draws[b, int(moved) & last, e]
    for n in range(city.first_cell[e], city.first_cell[e + 1]):
        c = city.cells[n]
        taken = given.low[b, c] <= draw < given.high[b, c]
        given.chosen[b, c] = city.one if taken else city.zero


@inner
def _take_each(city: City, given: Given, b: int, e: int, before: float, up: float) -> None:
    """Set the shares of cells that a step's vehicles of entry e take.

    before: vehicles that moved up before; up: those that do in this step
    """
    last = given.draws.shape[1] - 1
    after = before + up
    first = city.first_cell[e]
    end = city.first_cell[e + 1]
    for n in range(first, end):
        given.chosen[b, city.cells[n]] = city.zero
    number = int(before)
    while number < after:
        part = (min(after, number + city.one) - max(before, city.one * number)) / (after - before)
        draw = given.draws[b, number & last, e]
        for n in range(first, end):
            c = city.cells[n]
            if given.low[b, c] <= draw < given.high[b, c]:
                given.chosen[b, c] += part
        number += 1


@inner
def _decide(signals: Choosing, inside: np.ndarray, stages: "Stages", b: int) -> None:
    """Change stages of rollout b to those that signals want now.

    inside: vehicles on each link (veh, (L,))
    """
    zero = signals.zero
    most = signals.light.shape[1]
    pressure = np.zeros(signals.least.size, inside.dtype)
    waiting = np.zeros(signals.least.shape, inside.dtype)
    overdue = np.zeros_like(waiting)
    weight = np.zeros(len(signals.signal), inside.dtype)
    for n in range(len(signals.pressed)):
        weight[signals.pressed[n]] += inside[signals.presses[n]] * signals.weight[n]
    for n in range(len(signals.gain)):
        gained = max(weight[signals.gain_movement[n]], zero) * signals.gain[n]
        pressure[signals.gain_stage[n]] += gained
    for m in range(len(weight)):
        present = inside[signals.link[m]]
        red = stages.red[b, m]
        if red < signals.longest_red or present < signals.called:
            red = zero
        for n in range(most):
            light = signals.light[m, n]
            waiting[signals.signal[m], n] += light * present
            if light > zero:
                overdue[signals.signal[m], n] += red
    for s in range(len(waiting)):
        own = stages.stage[b, s]
        pressures = pressure[s * most : (s + 1) * most]
        wanted = _wanted(signals, stages, b, s, waiting[s], overdue[s], pressures)
        may = stages.clearing[b, s] == zero and stages.green[b, s] >= signals.least[s, own]
        if may and wanted != own:
            stages.stage[b, s] = wanted
            stages.before[b, s] = own
            stages.clearing[b, s] = signals.loss[s, own, wanted]
            stages.green[b, s] = zero


@inner
def _wanted(
    signals: Choosing,
    stages: "Stages",
    b: int,
    s: int,
    waiting: np.ndarray,
    overdue: np.ndarray,
    pressure: np.ndarray,
) -> int:
    """Return the stage that signal s wants.

    waiting: vehicles for each stage (veh, (n,))
    overdue: sum of the red of movements that wait too long for each stage (s, (n,))
    pressure: of each stage (n,)
    """
    own = stages.stage[b, s]
    best = own
    ahead = signals.zero
    for n in range(signals.count[s]):
        if n == own or waiting[n] < signals.called:
            continue
        kept = signals.lookahead / (signals.lookahead + signals.loss[s, own, n])
        if best == own or pressure[n] * kept > ahead:
            ahead = pressure[n] * kept
            best = n
    late = np.argmax(overdue)
    if best != own and overdue[late] > signals.zero:
        return late
    too_long = stages.green[b, s] + signals.decision_period > signals.longest_green
    return best if too_long or ahead > pressure[own] else own


@inner
def _show(
    signals: Choosing, stages: "Stages", light: np.ndarray, yields: np.ndarray, b: int
) -> None:
    """Set the lights of rollout b in a step, and the stages after it.

    light, yields: as of signals.Lights (M,); those of the programmes, which some signals keep
    """
    one = signals.one
    for m in range(len(signals.signal)):
        if not signals.chooses[m]:
            continue
        s = signals.signal[m]
        stage = stages.stage[b, s]
        earlier = stages.before[b, s]
        after = signals.light[m, stage]
        before = signals.light[m, earlier]
        # Those who gave way wait on the junction, and go while it clears.
        both = min(after, before)
        kept = max(both, before * signals.yields[m, earlier])
        lost = max(signals.lost[m] - stages.green[b, s], signals.zero)
        waits = min(stages.clearing[b, s] / signals.dt, one)
        starts = min((stages.clearing[b, s] + lost) / signals.dt, one)
        light[m] = waits * kept + (starts - waits) * both + (one - starts) * after
        yields[m] = (one - waits) * signals.yields[m, stage]
        red = stages.red[b, m] + signals.dt
        stages.red[b, m] = signals.zero if after > signals.zero else red
    for s in range(len(signals.count)):
        stages.green[b, s] += max(signals.dt - stages.clearing[b, s], signals.zero)
        stages.clearing[b, s] = max(stages.clearing[b, s] - signals.dt, signals.zero)


@inner
def _flow(
    city: City,
    given: Given,
    counts: Counts,
    histories: Histories,
    b: int,
    now: int,
    k: int,
    work: _Work,
) -> float:
    """Compute which vehicles of rollout b move in step k.

    now: row of the counts before the step
    Return the trips that begin.
    """
    begun = _begin(city, given, counts, b, now, k, work)
    _gate(city, given, counts, b, now, k, work)
    _arrive(city, given, counts, histories, b, now, k, work)
    _move_up(city, given, counts, histories, b, now, k, work)
    _see_green(city, given, counts, b, now, k, work)
    _receive(city, given, counts, histories, b, now, k, work)
    return begun


@inner
def _begin(
    city: City, given: Given, counts: Counts, b: int, now: int, k: int, work: _Work
) -> float:
    """Trips that may begin."""
    one = city.one
    then = (k + 1) % len(counts.queue)
    by_chance = len(given.draws) > 0
    metered = len(given.metering) > 0
    begun = 0.0
    work.waits[:] = city.zero
    for e in range(len(work.begin)):
        trips = given.due[b, e]
        asked = counts.asked[now, b, e]
        if by_chance:
            start = asked + given.draws[b, 0, e]
            trips = np.floor(start + trips) - np.floor(start)
        counts.asked[then, b, e] = asked + given.due[b, e]
        begun += trips
        # Without metering, trips that were held begin in the first step.
        if metered or k == 0:
            trips += counts.held[now, b, e]
        work.begin[e] = trips
        if metered:
            work.held[e] = trips
            work.waits[city.region_of_entry[e]] += trips
    if metered:
        for r in range(len(work.rate)):
            limit = given.metering[b, r] * city.dt
            work.rate[r] = min(limit / max(work.waits[r], city.least), one)
        for e in range(len(work.begin)):
            work.begin[e] = work.held[e] * work.rate[city.region_of_entry[e]]
    return begun


@inner
def _gate(city: City, given: Given, counts: Counts, b: int, now: int, k: int, work: _Work) -> None:
    """Lights under the gates."""
    one = city.one
    zero = city.zero
    work.light[:] = given.light[k, b]
    if len(given.gates) == 0:
        return
    for g in range(len(work.opened)):
        m = city.movement[g]
        link = city.link[g]
        share = given.gates[b, g]
        if city.chain_limit > zero:
            full = counts.inside[now, b, link] / city.storage[link]
            share = max(share, min(max((full + full) / city.chain_limit - one, zero), one))
        budget = city.whole[g] - (one - share) * city.taken[g]
        if city.extended and share >= one:  # an open gate has more green than the programme
            budget = city.cycle[g]
        seconds = work.light[m] * city.dt
        used = counts.used[now, b, g] * (one - given.opens[k, g])
        left = (budget - used) / max(seconds, city.least)
        work.share[g] = share
        work.left[g] = left
        work.opened[g] = min(max(left, zero), one)
        work.light[m] *= work.opened[g]


@inner
def _arrive(
    city: City,
    given: Given,
    counts: Counts,
    histories: Histories,
    b: int,
    now: int,
    k: int,
    work: _Work,
) -> None:
    """Vehicles that arrive at the queue."""
    entered = _row(histories.entered, given, k)
    started = _row(histories.started, given, k)
    work.queued[:] = city.zero
    work.waiting[:] = city.zero
    for e in range(len(work.up)):
        i = city.link_of_entry[e]
        age = city.along[e]
        soon = histories.entered[b, entered - age, e]
        older = histories.entered[b, entered - age - 1, e]
        arriving = soon + city.part[e] * (older - soon)
        arriving = arriving + histories.started[b, started - city.started[e], e]
        work.arrived[e] = counts.queue[now, b, e] + arriving
        work.queued[i] += work.arrived[e]
        work.waiting[i] += counts.due[now, b, e] + work.begin[e]


@inner
def _move_up(
    city: City,
    given: Given,
    counts: Counts,
    histories: Histories,
    b: int,
    now: int,
    k: int,
    work: _Work,
) -> None:
    """1. The first vehicles."""
    one = city.one
    zero = city.zero
    ending = _row(histories.ending, given, k)
    by_chance = len(given.draws) > 0
    work.in_lane[:] = zero
    for p in range(len(city.served)):
        standing = counts.standing[now, b, city.served[p]]
        work.in_lane[city.server[p]] += standing * city.lane_share[p]
    work.room[:] = zero
    for n in range(len(work.in_lane)):
        free = city.first_of_lane[n] * max(one - work.in_lane[n], zero)
        work.room[city.link_of_lane[n]] += free
    for i in range(len(work.room)):
        full = city.met[i] * counts.inside[now, b, i] / city.storage[i]
        work.share_in_queue[i] = min(full, one)
        in_queue = histories.ending[b, ending - city.to_end[i], i] * work.share_in_queue[i]
        work.stopping[i] = counts.stopping[now, b, i] + in_queue
        work.moving_up[i] = min(work.room[i] / max(work.queued[i], city.least), one)
    work.by_turn[:] = zero
    for e in range(len(work.up)):
        up = work.arrived[e] * work.moving_up[city.link_of_entry[e]]
        work.up[e] = up
        before = counts.moved[now, b, e]
        if by_chance and int(before + up) != int(before):
            _take_each(city, given, b, e, before, up)
        for n in range(city.first_cell[e], city.first_cell[e + 1]):
            c = city.cells[n]
            first = counts.first[now, b, c] + up * given.chosen[b, c]
            work.first[c] = first
            work.by_turn[city.turn_of_cell[c]] += first


@inner
def _see_green(
    city: City, given: Given, counts: Counts, b: int, now: int, k: int, work: _Work
) -> None:
    """2. Vehicles that can go."""
    one = city.one
    work.gap[:] = city.zero
    for f in range(len(city.foe)):
        work.gap[city.yielding[f]] += city.gaps[f] * counts.recent[now, b, city.foe[f]]
    for m in range(len(work.gap)):
        work.gap[m] = math.exp(-work.gap[m])
        kept = one - given.yields[k, b, m] * (one - work.gap[m])
        work.open_share[m] = work.light[m] * kept
    work.wanted[:] = city.zero
    work.wanted_minor[:] = city.zero
    for t in range(len(work.by_turn)):
        m = city.movement_of_turn[t]
        standing = counts.standing[now, b, t]
        stood = standing / max(work.by_turn[t], city.epsilon)
        arriving = city.pace[m] * work.open_share[m]
        most = city.per_step[m] * work.open_share[m] * city.lanes_of_turn[t]
        leader = min(most / max(standing, city.least), one)
        work.stood[t] = stood
        work.arriving[t] = arriving
        work.leader[t] = leader
        green = arriving + (leader - arriving) * stood
        work.green[t] = min(green, most / max(work.by_turn[t], city.least))
        able = work.by_turn[t] * work.green[t]
        minor = city.minor[t] * given.yields[k, b, m]
        work.minor[t] = minor
        work.wanted[city.link_entered[t]] += able - able * minor
        work.wanted_minor[city.link_entered[t]] += able * minor


@inner
def _receive(
    city: City,
    given: Given,
    counts: Counts,
    histories: Histories,
    b: int,
    now: int,
    k: int,
    work: _Work,
) -> None:
    """3. Room on the next link."""
    one = city.one
    had_left = _row(histories.had_left, given, k)
    for i in range(len(work.rho)):
        later = histories.had_left[b, had_left - city.backwards[i], i]
        before = histories.had_left[b, had_left - city.backwards[i] - 1, i]
        reached = later + city.earlier[i] * (before - later)
        left = counts.left[now, b, i]
        free = city.storage[i] - counts.inside[now, b, i] - (left - reached)
        put = min(city.most_in[i] / max(work.waiting[i], city.least), one)
        work.put[i] = put
        work.free[i] = free
        work.receives[i] = min(max(free, city.zero), city.most_in[i])
        work.wanted[i] += work.waiting[i] * put
        work.rho[i] = min(work.receives[i] / max(work.wanted[i], city.least), one)
        left = work.receives[i] - work.rho[i] * work.wanted[i]
        work.rho_minor[i] = min(left / max(work.wanted_minor[i], city.least), one)
    for t in range(len(work.going)):
        i = city.link_entered[t]
        rho = work.rho[i]
        work.entering[t] = rho + work.minor[t] * (work.rho_minor[i] - rho)
        work.going[t] = work.green[t] * work.entering[t]


@inner
def _leave(city: City, counts: Counts, b: int, k: int, work: _Work) -> None:
    """4. Flows from cells and turns."""
    now = k % len(counts.queue)
    then = (k + 1) % len(counts.queue)
    for c in range(len(work.first)):
        t = city.turn_of_cell[c]
        leaving = work.first[c] * work.going[t]
        counts.first[then, b, c] = work.first[c] - leaving
        work.entered[city.onward[c]] += leaving
        work.started[city.onward[c]] += leaving * work.stood[t]
    work.passed[:] = city.zero
    work.coming[:] = city.zero
    work.gone[:] = city.zero
    for t in range(len(work.going)):
        flow = work.by_turn[t] * work.going[t]
        counts.standing[then, b, t] = work.by_turn[t] - flow
        work.passed[city.movement_of_turn[t]] += flow
        work.coming[city.link_entered[t]] += flow
    for m in range(len(work.passed)):
        passed = work.passed[m]
        work.gone[city.link_left[m]] += passed
        recent = counts.recent[now, b, m]
        counts.recent[then, b, m] = recent + city.smoothing * (passed / city.dt - recent)


@inner
def _count_links(
    city: City,
    counts: Counts,
    histories: Histories,
    given: Given,
    sums: Sums,
    b: int,
    k: int,
    work: _Work,
) -> None:
    """Counts by link after the step."""
    now = k % len(counts.queue)
    then = (k + 1) % len(counts.queue)
    ending = _row(histories.ending, given, k)
    had_left = _row(histories.had_left, given, k)
    for i in range(len(work.gone)):
        ends = histories.ending[b, ending - city.to_end[i], i]
        speed = min(city.pace_to_end[i] * work.moving_up[i], city.one)
        stopped = work.stopping[i] * speed
        completed = ends - ends * work.share_in_queue[i] + stopped
        begun = work.waiting[i] * (work.put[i] * work.rho[i])
        coming = work.coming[i] + begun
        inside = counts.inside[now, b, i] + coming - work.gone[i] - completed
        left = counts.left[now, b, i] + work.gone[i]
        outside = work.waiting[i] - begun
        counts.stopping[then, b, i] = work.stopping[i] - stopped
        counts.inside[then, b, i] = inside
        counts.completed[then, b, i] = counts.completed[now, b, i] + completed
        counts.left[then, b, i] = left
        histories.had_left[b, had_left, i] = left
        histories.ending[b, ending, i] = city.zero
        sums.waiting[b, i] = outside
        sums.outside[b] += outside
        sums.present[b, i] += inside
    for h in range(len(city.home)):
        ends = work.entered[city.home[h]] * given.at_end[b, h]
        histories.ending[b, ending, city.home_link[h]] += ends


@inner
def _count_entries(
    city: City,
    counts: Counts,
    histories: Histories,
    given: Given,
    sums: Sums,
    b: int,
    k: int,
    work: _Work,
) -> None:
    """Counts by entry after the step."""
    now = k % len(counts.queue)
    then = (k + 1) % len(counts.queue)
    entered = _row(histories.entered, given, k)
    started = _row(histories.started, given, k)
    by_chance = len(given.draws) > 0
    metered = len(given.metering) > 0
    for e in range(len(work.entered)):
        i = city.link_of_entry[e]
        due = counts.due[now, b, e] + work.begin[e]
        begun = due * (work.put[i] * work.rho[i])
        ahead = begun * city.ahead[e]
        starting = work.started[e] * given.goes_on[b, e]
        passing = work.entered[e] * given.goes_on[b, e] - starting
        work.started[e] = city.zero
        work.entered[e] = city.zero
        before = counts.moved[now, b, e]
        moved = before + work.up[e]
        if by_chance and int(moved) != int(before):
            _take(city, given, b, e, moved)
        held = work.held[e] - work.begin[e] if metered else city.zero
        counts.held[then, b, e] = held
        sums.held[b] += held
        counts.due[then, b, e] = due - begun
        counts.queue[then, b, e] = work.arrived[e] - work.up[e] + ahead
        counts.moved[then, b, e] = moved
        histories.started[b, started, e] = starting
        histories.entered[b, entered, e] = passing + begun - ahead


@inner
def _count_gates(
    city: City, counts: Counts, given: Given, sums: Sums, b: int, k: int, work: _Work
) -> None:
    """Capacity that each gate used after the step."""
    now = k % len(counts.queue)
    then = (k + 1) % len(counts.queue)
    counts.used[then, b] = counts.used[now, b]
    if len(given.gates) == 0:
        return
    for g in range(len(work.opened)):
        used = counts.used[now, b, g] * (city.one - given.opens[k, g])
        seconds = given.light[k, b, city.movement[g]] * city.dt
        counts.used[then, b, g] = used + seconds * work.opened[g]
        sums.share[b, g] += work.share[g] / len(given.light)


@compiled
def derive(
    city: City,
    given: Given,
    counts: Counts,
    histories: Histories,
    d_given: Given,
    d_counts: Counts,
    d_histories: Histories,
    d_sums: Sums,
    rollouts: tuple[int, int],
) -> None:
    """Compute the derivatives by what an interval begins with.

    counts, histories: with a row for each step, as `advance` leaves them
    d_given: by due, cells, metering and gates, which are added up
    d_counts, d_histories: by those after the interval (B, n); then by those before
    d_sums: by the sums
    rollouts: as of `advance`
    """
    work = _work_of(city, given)
    d = _work_of(city, given)  # derivatives by what has these names
    for b in range(*rollouts):
        for k in range(len(given.light) - 1, -1, -1):
            _choose_again(city, given, counts, b, k + 1, k)
            _flow(city, given, counts, histories, b, k, k, work)
            _leave_back(city, given, counts, d_counts, d_histories, d_sums, b, k, work, d)
            _receive_back(city, given, d_counts, d_histories, d_sums, b, k, work, d)
            _see_green_back(city, given, counts, d_counts, b, k, work, d)
            _gate_back(city, given, d_given, d_counts, d_sums, b, k, work, d)
            _move_up_back(
                city, given, counts, histories, d_given, d_counts, d_histories, b, k, work, d
            )
            _arrive_back(city, given, d_counts, d_histories, b, k, work, d)
            _begin_back(city, given, d_given, d_counts, d_sums, b, k, work, d)
            _choose_again(city, given, counts, b, k + 1, k)  # as `_flow` takes each vehicle


@inner
def _leave_back(
    city: City,
    given: Given,
    counts: Counts,
    d_counts: Counts,
    d_histories: Histories,
    d_sums: Sums,
    b: int,
    k: int,
    work: _Work,
    d: _Work,
) -> None:
    """4. Flows: entries that vehicles enter, then the cells that they leave."""
    entered = _row(d_histories.entered, given, k)
    started = _row(d_histories.started, given, k)
    ending = _row(d_histories.ending, given, k)
    had_left = _row(d_histories.had_left, given, k)
    for i in range(len(d.coming)):
        d.coming[i] = d_counts.inside[b, i] + d_sums.present[b, i]
        d_counts.left[b, i] += d_histories.had_left[b, had_left, i]
    d.put[:] = city.zero
    for e in range(len(d.entered)):
        i = city.link_of_entry[e]
        goes_on = given.goes_on[b, e]
        d_passing = d_histories.entered[b, entered, e]
        d_starting = d_histories.started[b, started, e]
        d_ahead = d_counts.queue[b, e] - d_passing
        d_begun = d_passing - d_counts.due[b, e] + d_ahead * city.ahead[e]
        d.entered[e] = d_passing * goes_on
        d.started[e] = (d_starting - d_passing) * goes_on
        d.put[i] += d_begun * (counts.due[k, b, e] + work.begin[e])
        d.begin[e] = d_counts.due[b, e] + d_begun * (work.put[i] * work.rho[i])
        d.up[e] = d_counts.moved[b, e] - d_counts.queue[b, e]
    for h in range(len(city.home)):
        d_ends = d_histories.ending[b, ending, city.home_link[h]]
        d.entered[city.home[h]] += d_ends * given.at_end[b, h]
    for m in range(len(d.passed)):
        i = city.link_left[m]
        d_recent = d_counts.recent[b, m]
        d.passed[m] = d_counts.left[b, i] - d.coming[i]
        d.passed[m] += d_recent * city.smoothing / city.dt
        d_counts.recent[b, m] = d_recent - d_recent * city.smoothing
    for t in range(len(d.going)):
        d_flow = d.coming[city.link_entered[t]] - d_counts.standing[b, t]
        d_flow += d.passed[city.movement_of_turn[t]]
        d.by_turn[t] = d_counts.standing[b, t] + d_flow * work.going[t]
        d.going[t] = d_flow * work.by_turn[t]
        d.stood[t] = city.zero
    for c in range(len(d.first)):
        t = city.turn_of_cell[c]
        e = city.onward[c]
        d_leaving = d.entered[e] + d.started[e] * work.stood[t] - d_counts.first[b, c]
        d.stood[t] += d.started[e] * (work.first[c] * work.going[t])
        d.first[c] = d_counts.first[b, c] + d_leaving * work.going[t]
        d.going[t] += d_leaving * work.first[c]


@inner
def _receive_back(
    city: City,
    given: Given,
    d_counts: Counts,
    d_histories: Histories,
    d_sums: Sums,
    b: int,
    k: int,
    work: _Work,
    d: _Work,
) -> None:
    """3. Room on the next link."""
    one = city.one
    least = city.least
    had_left = _row(d_histories.had_left, given, k)
    d.rho[:] = city.zero
    d.rho_minor[:] = city.zero
    for t in range(len(d.going)):
        d_entering = d.going[t] * work.green[t]
        d.rho[city.link_entered[t]] += d_entering * (one - work.minor[t])
        d.rho_minor[city.link_entered[t]] += d_entering * work.minor[t]
    for i in range(len(d.rho)):
        waiting = work.waiting[i]
        put = work.put[i]
        rho = work.rho[i]
        d_coming = d.coming[i] - d_sums.outside[b]
        d_both = d.put[i] + d_coming * waiting
        below = max(work.wanted_minor[i], least)
        ratio = (work.receives[i] - rho * work.wanted[i]) / below
        d_left = d.rho_minor[i] / below if ratio <= one else city.zero
        d.wanted_minor[i] = -d_left * ratio if work.wanted_minor[i] >= least else city.zero
        d_rho = d.rho[i] + d_both * put - d_left * work.wanted[i]
        d_waiting = d_sums.outside[b] + d_coming * (put * rho)
        below = max(work.wanted[i], least)
        ratio = work.receives[i] / below
        d_receives = d_rho / below if ratio <= one else city.zero
        d.wanted[i] = -d_receives * ratio if work.wanted[i] >= least else city.zero
        d.wanted[i] -= d_left * rho
        d_receives += d_left
        d_put = d_both * rho + d.wanted[i] * waiting
        d_waiting += d.wanted[i] * put
        ratio = city.most_in[i] / max(waiting, least)
        if ratio <= one and waiting >= least:
            d_waiting -= d_put * ratio / waiting
        d.waiting[i] = d_waiting
        later = had_left - city.backwards[i]
        if work.free[i] < city.zero or work.free[i] > city.most_in[i]:
            d_receives = city.zero
        d_histories.had_left[b, later, i] += d_receives * (one - city.earlier[i])
        d_histories.had_left[b, later - 1, i] += d_receives * city.earlier[i]
        d_counts.left[b, i] -= d_receives
        d_counts.inside[b, i] = d.coming[i] - d_receives


@inner
def _see_green_back(
    city: City,
    given: Given,
    counts: Counts,
    d_counts: Counts,
    b: int,
    k: int,
    work: _Work,
    d: _Work,
) -> None:
    """2. Vehicles that can go."""
    one = city.one
    least = city.least
    d.open_share[:] = city.zero
    for t in range(len(d.going)):
        i = city.link_entered[t]
        m = city.movement_of_turn[t]
        standing = counts.standing[k, b, t]
        stood = work.stood[t]
        d_able = d.wanted[i] + (d.wanted_minor[i] - d.wanted[i]) * work.minor[t]
        d_green = d.going[t] * work.entering[t] + d_able * work.by_turn[t]
        d.by_turn[t] += d_able * work.green[t]
        most = city.per_step[m] * work.open_share[m] * city.lanes_of_turn[t]
        first = max(work.by_turn[t], least)
        green = work.arriving[t] + (work.leader[t] - work.arriving[t]) * stood
        if green > most / first:
            d.open_share[m] += d_green / first * city.per_step[m] * city.lanes_of_turn[t]
            if work.by_turn[t] >= least:
                d.by_turn[t] -= d_green * work.green[t] / first
            d_green = city.zero
        d_leader = d_green * stood
        d.stood[t] += d_green * (work.leader[t] - work.arriving[t])
        d.open_share[m] += d_green * (one - stood) * city.pace[m]
        below = max(standing, least)
        ratio = most / below
        d_standing = d.stood[t] / max(work.by_turn[t], city.epsilon)
        if ratio <= one:
            d.open_share[m] += d_leader / below * city.per_step[m] * city.lanes_of_turn[t]
            if standing >= least:
                d_standing -= d_leader * ratio / below
        if work.by_turn[t] >= city.epsilon:
            d.by_turn[t] -= d.stood[t] * stood / work.by_turn[t]
        d_counts.standing[b, t] = d_standing
    for m in range(len(d.light)):
        gap = work.gap[m]
        yields = given.yields[k, b, m]
        d.light[m] = d.open_share[m] * (one - yields * (one - gap))
        d.open_share[m] *= -gap * work.light[m] * yields  # by the flow of its foes
    for f in range(len(city.foe)):
        d_counts.recent[b, city.foe[f]] += city.gaps[f] * d.open_share[city.yielding[f]]


@inner
def _gate_back(
    city: City,
    given: Given,
    d_given: Given,
    d_counts: Counts,
    d_sums: Sums,
    b: int,
    k: int,
    work: _Work,
    d: _Work,
) -> None:
    """Lights under the gates."""
    one = city.one
    zero = city.zero
    if len(given.gates) == 0:
        return
    for g in range(len(work.opened)):
        light = given.light[k, b, city.movement[g]]
        seconds = light * city.dt
        share = work.share[g]
        kept = one - given.opens[k, g]
        below = max(seconds, city.least)
        d_left = d.light[city.movement[g]] * light + d_counts.used[b, g] * seconds
        if work.left[g] < zero or work.left[g] > one:
            d_left = zero
        d_share = d_sums.share[b, g] / len(given.light)
        if share < one or not city.extended:
            d_share += d_left / below * city.taken[g]
        d_counts.used[b, g] = (d_counts.used[b, g] - d_left / below) * kept
        if share == given.gates[b, g]:
            d_given.gates[b, g] += d_share
        elif share < one:
            link = city.link[g]
            by_full = (one + one) / city.chain_limit
            d_counts.inside[b, link] += d_share * by_full / city.storage[link]


@inner
def _move_up_back(
    city: City,
    given: Given,
    counts: Counts,
    histories: Histories,
    d_given: Given,
    d_counts: Counts,
    d_histories: Histories,
    b: int,
    k: int,
    work: _Work,
    d: _Work,
) -> None:
    """1. The first vehicles."""
    one = city.one
    zero = city.zero
    ending = _row(histories.ending, given, k)
    for c in range(len(d.first)):
        e = city.entry_of_cell[c]
        d_cell = d.first[c] + d.by_turn[city.turn_of_cell[c]]
        d_counts.first[b, c] = d_cell
        d_given.cells[b, c] += d_cell * work.up[e]
        d.up[e] += d_cell * given.chosen[b, c]
    d.moving_up[:] = zero
    for e in range(len(d.up)):
        d.moving_up[city.link_of_entry[e]] += d.up[e] * work.arrived[e]
    for i in range(len(d.room)):
        d_completed = d_counts.completed[b, i] - d.coming[i]
        d_stopped = d_completed - d_counts.stopping[b, i]
        d_moving_up = d.moving_up[i]
        speed = city.pace_to_end[i] * work.moving_up[i]
        d_stopping = d_counts.stopping[b, i] + d_stopped * min(speed, one)
        if speed <= one:
            d_moving_up += d_stopped * work.stopping[i] * city.pace_to_end[i]
        below = max(work.queued[i], city.least)
        ratio = work.room[i] / below
        d.room[i] = d_moving_up / below if ratio <= one else zero
        d.queued[i] = -d.room[i] * ratio if work.queued[i] >= city.least else zero
        d_in_queue = d_stopping - d_completed
        before = ending - city.to_end[i]
        d_counts.stopping[b, i] = d_stopping
        d_histories.ending[b, before, i] += d_completed + d_in_queue * work.share_in_queue[i]
        if city.met[i] * counts.inside[k, b, i] / city.storage[i] <= one:
            by_inside = histories.ending[b, before, i] * city.met[i] / city.storage[i]
            d_counts.inside[b, i] += d_in_queue * by_inside
    for p in range(len(city.served)):
        n = city.server[p]
        if work.in_lane[n] <= one:
            d_in_lane = -d.room[city.link_of_lane[n]] * city.first_of_lane[n]
            d_counts.standing[b, city.served[p]] += d_in_lane * city.lane_share[p]


@inner
def _arrive_back(
    city: City,
    given: Given,
    d_counts: Counts,
    d_histories: Histories,
    b: int,
    k: int,
    work: _Work,
    d: _Work,
) -> None:
    """Vehicles that arrive at the queue."""
    entered = _row(d_histories.entered, given, k)
    started = _row(d_histories.started, given, k)
    for e in range(len(d.up)):
        i = city.link_of_entry[e]
        d_arrived = d_counts.queue[b, e] + d.up[e] * work.moving_up[i] + d.queued[i]
        before = entered - city.along[e]
        d_counts.queue[b, e] = d_arrived
        d_histories.entered[b, before, e] += d_arrived * (city.one - city.part[e])
        d_histories.entered[b, before - 1, e] += d_arrived * city.part[e]
        d_histories.started[b, started - city.started[e], e] += d_arrived
        d.begin[e] += d.waiting[i]
        d_counts.due[b, e] = d.begin[e]


@inner
def _begin_back(
    city: City,
    given: Given,
    d_given: Given,
    d_counts: Counts,
    d_sums: Sums,
    b: int,
    k: int,
    work: _Work,
    d: _Work,
) -> None:
    """Trips that may begin."""
    metered = len(given.metering) > 0
    if metered:
        d.rate[:] = city.zero
        for e in range(len(d.begin)):
            d_held = d_counts.held[b, e] + d_sums.held[b]
            d.rate[city.region_of_entry[e]] += (d.begin[e] - d_held) * work.held[e]
        for r in range(len(d.rate)):
            below = max(work.waits[r], city.least)
            ratio = given.metering[b, r] * city.dt / below
            d_ratio = d.rate[r] / below if ratio <= city.one else city.zero
            d_given.metering[b, r] += d_ratio * city.dt
            d.rate[r] = -d_ratio * ratio if work.waits[r] >= city.least else city.zero
    for e in range(len(d.begin)):
        d_held = d.begin[e]
        d_trips = d.begin[e]
        if metered:
            r = city.region_of_entry[e]
            d_held = (d_counts.held[b, e] + d_sums.held[b]) * (city.one - work.rate[r])
            d_held += d.begin[e] * work.rate[r] + d.rate[r]
            d_trips = d_held
        elif k > 0:
            d_held = city.zero
        d_counts.held[b, e] = d_held
        d_given.due[b, e] += d_trips + d_sums.begun[b]
