"""Fastest routes, and what drivers make of them, in machine code.

Guidance asks for a route per driver and minute. Each answer takes ten to thirty microseconds here,
most of them for memory that SUMO has used in between. Edges, moves, regions and gateways are
numbers; UNKNOWN is an edge closed to cars, or a move that the city does not have. All is in one
file, because machine code that was kept is made again when its own file has changed, not when
others have.

Searches start where drivers are and where they go, and reach no further than needed. A route that
comes back into its region has the same end as others, from its last gateway on.

Drivers keep their route unless the gain is large: every reroute invalidates the travel times used
for others.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.experimental import structref

from nmfd.model.links.compiled import compiled, inner

UNKNOWN = -1
LEAST_SHARE = 1e-3  # a region with a smaller share gets no drivers
# Drivers keep their route if another one saves less than this share of its delay, times the delay's
# share of its time.
SWITCHING_THRESHOLD = 0.6
MESO_THRESHOLD = 0.3  # in the mesoscopic model: less than this share of the other's own time
# Kinds of searches: from the driver to the gateways of the region; from the target back to behind
# them; from the driver to them by any edges, for routes that come back. As Python's integers they
# would be compiled one by one.
INSIDE, OUTSIDE, EVERYWHERE = np.arange(3)
ROWS_OF_A_DRIVER = 6  # the most searches for one driver
VISIT = np.dtype(
    [
        ("region", np.int64),
        ("destination", np.int64),  # region
        ("driver_class", np.int64),
        ("target", np.int64),  # last edge
        ("following", np.int64),  # next region that the driver was given; UNKNOWN if none yet
        ("interval", np.int64),  # control interval in which it was
    ]
)
DRIVER = np.dtype(
    [
        ("slot", np.int64),  # of the visit
        ("here", np.int64),  # present edge
        ("begin", np.int64),  # of the rest of the route, among all routes
        ("end", np.int64),
        ("known", np.bool_),  # the rest is open to cars
    ]
)


class Graph(NamedTuple):
    """Moves between edges, as rows of a sparse array.

    begins: first entry of each edge, and their number (E + 1,)
    ends, moves: where each entry leads, and the number of its move (M,)
    """

    begins: np.ndarray
    ends: np.ndarray
    moves: np.ndarray


class Streets(NamedTuple):
    """The streets of a city, for searches.

    Gateways are in the order of their regions and next regions; a boundary is all of them between
    two regions.

    region: of each edge (E,); onward, backward: moves in and against their direction
    allowed: edges inside each region, outside each, and all (bool, (2 R + 1, E))
    free, free_turns: times in free flow of edges (s, (E,)) and moves (s, (M,))
    gates: first gateway of each region, and G (R + 1,)
    boundaries: first boundary of each region, and their number B (R + 1,)
    boundary_gates: first gateway of each boundary, and G (B + 1,); neighbours: next regions (B,)
    before, behind, over: edges that each gateway joins, and its move (G,)
    leading: edges inside the region that lead to each gateway (bool, (G, E))
    reached: edges outside that each gateway leads to (bool, (G, E))
    ahead: no more than the time that a class of drivers takes from the nearest gateway out of a
        region to each edge outside (s, (R + 1, classes, E)); the last is 0
    back: the same to the edge before each gateway, by all edges (s, (G, classes))
    most_detour: that a next region, or a price, may cost a driver (s)
    ways_return: routes may come back into a region; lanes: False in the mesoscopic model
    """

    region: np.ndarray
    onward: Graph
    backward: Graph
    allowed: np.ndarray
    free: np.ndarray
    free_turns: np.ndarray
    gates: np.ndarray
    boundaries: np.ndarray
    boundary_gates: np.ndarray
    neighbours: np.ndarray
    before: np.ndarray
    behind: np.ndarray
    over: np.ndarray
    leading: np.ndarray
    reached: np.ndarray
    ahead: np.ndarray
    back: np.ndarray
    most_detour: float
    ways_return: bool
    lanes: bool


class Seen(NamedTuple):
    """Travel times of a control interval as drivers see them.

    The first views are those of the classes of drivers without prices.

    edges: times of edges in each view (s, (V, E)); turns: times of moves (s, (M,))
    onward, backward: times of moves and the edges that they lead to, in the order of the
        streets' graphs of these names (s, (V, M))
    views: view of a class with a destination (classes, R)
    """

    edges: np.ndarray
    turns: np.ndarray
    onward: np.ndarray
    backward: np.ndarray
    views: np.ndarray


class Work(NamedTuple):
    """Searches of a control interval that are kept, and room for the next one.

    rows: row of a search of a kind, in a view, for a region, from an edge, UNKNOWN without one
        (3, V, R, E)
    limits: longest time searched (s, (rows,)); complete: all gateways were reached (rows,)
    to_gates: times by gateway (s, (rows, most G))
    numbers: of the search in each row (rows,); latest: of those whose predecessors are in
        `before` (6,)
    used: number of rows in use, and of searches so far (2,)
    times, wanted: of edges; before: edges before each in seven searches (7, E)
    heap_times, heap_edges: what a search has to look at next (M + E,)
    """

    rows: np.ndarray
    limits: np.ndarray
    complete: np.ndarray
    to_gates: np.ndarray
    numbers: np.ndarray
    latest: np.ndarray
    used: np.ndarray
    times: np.ndarray
    wanted: np.ndarray
    before: np.ndarray
    heap_times: np.ndarray
    heap_edges: np.ndarray


class Counts(NamedTuple):
    """Drivers by next region, and their shares (cosim.plant.shares).

    own, theta: shares (-); wished, given: vehicles (veh), by region, destination and next region
    realised: drivers by region, next region and destination (veh)
    interval: number of the control interval
    memory: of the vehicles, per control interval (-)
    penalty: per vehicle that a region is behind its share (s)
    """

    own: np.ndarray
    theta: np.ndarray
    wished: np.ndarray
    given: np.ndarray
    realised: np.ndarray
    interval: int
    memory: float
    penalty: float


class Present(NamedTuple):
    """The present route of a driver.

    known: it is open to cars
    time: from the end of the first edge (s), infinite if unknown; delay: part of it (s)
    longest: time that no search for faster routes has to exceed (s)
    """

    known: bool
    time: float
    delay: float
    longest: float


class Trip(NamedTuple):
    """The rest of a driver's trip.

    region: the present one; sight: view that the driver sees
    here, target: present and last edge
    """

    region: int
    driver_class: int
    sight: int
    here: int
    target: int


class Choices(NamedTuple):
    """The fastest routes of a driver by each next region.

    times: (s, (N,)), infinite if too long; fastest: the least of them
    gates: of each (N,); exist: there is a route, however long (bool, (N,))
    rows: of searches of each kind, UNKNOWN without one (3,)
    returns: which of them comes back into the region, UNKNOWN if none
    """

    trip: Trip
    times: np.ndarray
    fastest: float
    gates: np.ndarray
    exist: np.ndarray
    rows: np.ndarray
    returns: int


# With heapq, which numba compiles, too, a search takes 2.7 times as long as with this heap.
@inner
def _push(times: np.ndarray, edges: np.ndarray, size: int, time: float, edge: int) -> None:
    """Add an edge to the heap of `size` edges."""
    place = size
    while place > 0:
        above = (place - 1) // 2
        if times[above] <= time:
            break
        times[place] = times[above]
        edges[place] = edges[above]
        place = above
    times[place] = time
    edges[place] = edge


@inner
def _drop_first(times: np.ndarray, edges: np.ndarray, size: int) -> None:
    """Take the first edge from the heap, which has `size` edges afterwards."""
    time = times[size]
    edge = edges[size]
    place = 0
    while 2 * place + 1 < size:
        below = 2 * place + 1
        if below + 1 < size and times[below + 1] < times[below]:
            below += 1
        if time <= times[below]:
            break
        times[place] = times[below]
        edges[place] = edges[below]
        place = below
    times[place] = time
    edges[place] = edge


class Parts(NamedTuple):
    """All that searches need."""

    streets: Streets
    seen: Seen
    work: Work


@structref.register
class SceneType(types.StructRef):
    """Type of a Scene in machine code."""

    def preprocess_fields(self, fields: Any) -> tuple:
        """Return fields whose types do not depend on their values."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Scene(structref.StructRefProxy):
    """Parts that machine code gets by reference.

    With the fifty arrays as arguments, calls would take twice as long.
    """


structref.define_proxy(Scene, SceneType, Parts._fields)


@compiled
def scene_of(parts: Parts) -> Scene:
    """Return the scene of these parts."""
    return Scene(*parts)


class Field(NamedTuple):
    """Edges that a search may use.

    costs: times of the moves of the graph, and of the edges that they lead to (s, (M,))
    allowed: edges that it may use (bool, (E,))
    ahead: lower bound of the time from each edge to the nearest aim (s, (E,)), for an A* search:
        costs are reduced by the drop in this bound, so that times are cost + ahead - ahead[start],
        and detours come last
    """

    graph: Graph
    costs: np.ndarray
    allowed: np.ndarray
    ahead: np.ndarray


@inner
def _search(
    work: Work,
    field: Field,
    starts: np.ndarray,
    aims: np.ndarray,
    most: float,
    before: np.ndarray,
) -> bool:
    """Search from edges `starts` up to `most` (s), until all aims are reached.

    It is Dijkstra's algorithm. Times are left in work.times (s, (E,)), predecessors in `before`
    (E,). Returns whether all aims were reached.
    """
    graph = field.graph
    ahead = field.ahead
    times = work.times
    wanted = work.wanted
    times[:] = math.inf
    missing = 0
    for aim in aims:
        missing += not wanted[aim]
        wanted[aim] = True
    size = 0
    for edge in starts:
        times[edge] = 0.0
        _push(work.heap_times, work.heap_edges, size, 0.0, edge)
        size += 1
    while size and missing:
        time = work.heap_times[0]
        edge = work.heap_edges[0]
        size -= 1
        _drop_first(work.heap_times, work.heap_edges, size)
        if time > times[edge]:  # it was reached sooner in the meantime
            continue
        missing -= wanted[edge]
        for move in range(graph.begins[edge], graph.begins[edge + 1]):
            after = graph.ends[move]
            if not field.allowed[after]:
                continue
            later = time + (field.costs[move] + (ahead[after] - ahead[edge]))
            if later < times[after] and later <= most:
                times[after] = later
                before[after] = edge
                _push(work.heap_times, work.heap_edges, size, later, after)
                size += 1
    for aim in aims:
        wanted[aim] = False
    return missing == 0


@inner
def _ends(streets: Streets, trip: Trip, kind: int) -> tuple[int, np.ndarray]:
    """Return the start and the aims of a search."""
    gates = slice(streets.gates[trip.region], streets.gates[trip.region + 1])
    if kind == OUTSIDE:
        return trip.target, streets.behind[gates]
    return trip.here, streets.before[gates]


@inner
def _run(scene: Scene, trip: Trip, kind: int, most: float, before: np.ndarray) -> bool:
    """Search routes of a kind for a trip up to `most` (s)."""
    streets = scene.streets
    costs = scene.seen.onward[trip.sight]
    allowed = streets.allowed[-1 if kind == EVERYWHERE else trip.region]
    field = Field(streets.onward, costs, allowed, streets.ahead[-1, 0])
    if kind == OUTSIDE:
        costs = scene.seen.backward[trip.sight]
        allowed = streets.allowed[len(streets.gates) - 1 + trip.region]
        ahead = streets.ahead[trip.region, trip.driver_class]
        field = Field(streets.backward, costs, allowed, ahead)
    start, aims = _ends(streets, trip, kind)
    return _search(scene.work, field, np.array([start]), aims, most, before)


@inner
def _row(scene: Scene, trip: Trip, kind: int, most: float, first: int) -> int:
    """Return the row of a search for a trip, at least up to `most` (s).

    first: row of work.before for predecessors of the first kind
    """
    work = scene.work
    start, aims = _ends(scene.streets, trip, kind)
    row = work.rows[kind, trip.sight, trip.region, start]
    if row != UNKNOWN and (work.complete[row] or work.limits[row] >= most):
        return row
    if row == UNKNOWN:
        row = work.used[0]
        work.used[0] += 1
        work.rows[kind, trip.sight, trip.region, start] = row
    work.used[1] += 1
    work.numbers[row] = work.used[1]
    work.latest[first + kind] = work.used[1]
    work.limits[row] = most
    work.complete[row] = _run(scene, trip, kind, most, work.before[first + kind])
    for n, aim in enumerate(aims):
        work.to_gates[row, n] = work.times[aim]
    return row


@inner
def _over(scene: Scene, view: int, gate: int) -> float:
    """Return the time over a gateway, to the end of the next edge (s)."""
    streets = scene.streets
    return scene.seen.turns[streets.over[gate]] + scene.seen.edges[view, streets.behind[gate]]


@inner
def _out(scene: Scene, trip: Trip, row: int, gate: int) -> float:
    """Return the time inside a region as far as over a gateway (s).

    row: of the search
    """
    streets = scene.streets
    over = _over(scene, trip.sight, gate)
    if not streets.lanes:
        over = scene.seen.edges[trip.sight, streets.behind[gate]]
    return scene.work.to_gates[row, gate - streets.gates[trip.region]] + over


@inner
def _onward(scene: Scene, trip: Trip, row: int, gate: int) -> float:
    """Return the time from behind a gateway to the target (s).

    row: of the search
    """
    streets = scene.streets
    ahead = streets.ahead[trip.region, trip.driver_class, trip.target]
    return scene.work.to_gates[row, gate - streets.gates[trip.region]] + ahead


@inner
def choices(scene: Scene, trip: Trip, longest: float, first: int) -> Choices:
    """Return the fastest routes of a trip by each next region.

    first: see `_row`
    longest: no less than the fastest of all takes (s), infinite if unknown. Beyond it and
    `most_detour`, routes are left out
    """
    streets = scene.streets
    region = trip.region
    ahead = streets.ahead[region, trip.driver_class, trip.target]
    most = streets.most_detour + longest
    inside = _row(scene, trip, INSIDE, max(most - ahead, 0.0), first)
    nearest = math.inf
    for gate in range(streets.gates[region], streets.gates[region + 1]):
        nearest = min(nearest, _out(scene, trip, inside, gate))
    left = 0.0
    if nearest < math.inf:
        left = max(most - min(nearest, most) - ahead, 0.0)
    outside = _row(scene, trip, OUTSIDE, left, first)
    boundaries = range(streets.boundaries[region], streets.boundaries[region + 1])
    count = len(boundaries)
    times = np.full(count, math.inf)
    gates = np.zeros(count, np.int64)
    exist = np.full(count, False)
    soonest = math.inf
    for n in range(count):
        boundary = boundaries.start + n
        gates[n] = streets.boundary_gates[boundary]
        for gate in range(gates[n], streets.boundary_gates[boundary + 1]):
            exist[n] |= streets.leading[gate, trip.here] and streets.reached[gate, trip.target]
            time = _out(scene, trip, inside, gate) + _onward(scene, trip, outside, gate)
            if time < times[n]:
                times[n] = time
                gates[n] = gate
        soonest = min(soonest, times[n])
    rows = np.array([inside, outside, UNKNOWN])
    returns = UNKNOWN
    if streets.ways_return:
        gate, time = _returning(scene, trip, rows, nearest, min(soonest, longest), first)
        if time < soonest:
            soonest = time
            for n in range(count):
                if gate >= streets.boundary_gates[boundaries.start + n]:
                    returns = n
            times[returns] = time
            gates[returns] = gate
            exist[returns] = True
    return Choices(trip, times, soonest, gates, exist, rows, returns)


@inner
def _returning(
    scene: Scene, trip: Trip, rows: np.ndarray, nearest: float, most: float, first: int
) -> tuple[int, float]:
    """Return the fastest route that comes back into the region.

    Returns its last gateway and its time (s). The time is infinite if it is not below `most` (s).

    rows: of searches of each kind (3,); first: see `_row`
    nearest: time over the nearest gateway (s)
    """
    streets = scene.streets
    gates = range(streets.gates[trip.region], streets.gates[trip.region + 1])
    back = streets.back[:, trip.driver_class]
    around = math.inf  # least time from a gateway back to one and over it
    end = math.inf  # least time from before a gateway on
    for gate in gates:
        over = _over(scene, trip.sight, gate)
        around = min(around, back[gate] + over)
        on = over + _onward(scene, trip, rows[OUTSIDE], gate)
        if nearest + back[gate] + on < most:
            end = min(end, on)
    ahead = streets.ahead[trip.region, trip.driver_class, trip.target]
    best = UNKNOWN
    least = math.inf
    # It has left, and come back, which alone takes too long for most drivers.
    if nearest + around + ahead >= most or end == math.inf:
        return best, least
    rows[EVERYWHERE] = _row(scene, trip, EVERYWHERE, most - end, first)
    there = scene.work.to_gates[rows[EVERYWHERE]]
    for gate in gates:
        on = _over(scene, trip.sight, gate) + _onward(scene, trip, rows[OUTSIDE], gate)
        time = there[gate - gates.start] + on
        if nearest + back[gate] + on < most and time < least:
            best = gate
            least = time
    return best, least


@compiled
def forget(work: Work) -> None:
    """Forget all searches."""
    work.rows[:] = UNKNOWN
    work.used[0] = 0


@inner
def _search_again(scene: Scene, found: Choices, first: int) -> None:
    """Find the predecessors of choices, for their routes.

    They are left in three rows of work.before, from `first` on. Only drivers who change their route
    need them.
    """
    work = scene.work
    for kind in range(len(found.rows)):
        row = found.rows[kind]
        if row != UNKNOWN and work.latest[first + kind] != work.numbers[row]:
            work.latest[first + kind] = work.numbers[row]
            _run(scene, found.trip, kind, work.limits[row], work.before[first + kind])


@inner
def _path(before: np.ndarray, first: int, last: int) -> np.ndarray:
    """Return the edges from `first` back to `last`, where a search began."""
    length = 1
    edge = first
    while edge != last:
        edge = before[edge]
        length += 1
    way = np.empty(length, np.int64)
    edge = first
    for n in range(length):
        way[n] = edge
        edge = before[edge]
    return way


@inner
def _route(scene: Scene, found: Choices, n: int, first: int) -> np.ndarray:
    """Return the n-th route of choices, after `_search_again`."""
    streets = scene.streets
    before = scene.work.before
    gate = found.gates[n]
    kind = EVERYWHERE if n == found.returns else INSIDE
    inside = _path(before[first + kind], streets.before[gate], found.trip.here)
    outside = _path(before[first + OUTSIDE], streets.behind[gate], found.trip.target)
    return np.concatenate((inside[::-1], outside))


@inner
def homeward(scene: Scene, trip: Trip, most: float) -> tuple[float, np.ndarray]:
    """Return time (s) and edges of the fastest route in one region.

    It stays inside the region, unless routes may return. The time is infinite above `most`.
    """
    streets = scene.streets
    costs = scene.seen.backward[trip.sight]
    allowed = streets.allowed[-1 if streets.ways_return else trip.region]
    field = Field(streets.backward, costs, allowed, streets.ahead[-1, 0])
    work = scene.work
    before = work.before[-1]
    _search(work, field, np.array([trip.target]), np.array([trip.here]), most, before)
    time = work.times[trip.here]
    if time == math.inf:
        return time, np.zeros(0, np.int64)
    return time, _path(before, trip.here, trip.target)


@inner
def move_between(onward: Graph, first: int, second: int) -> int:
    """Return the move from one edge to another, UNKNOWN if there is none."""
    for entry in range(onward.begins[first], onward.begins[first + 1]):
        if onward.ends[entry] == second:
            return onward.moves[entry]
    return UNKNOWN


@inner
def times_of(scene: Scene, view: int, route: np.ndarray) -> tuple[float, float, bool]:
    """Return the time of a route in a view, and that in free flow (s).

    They begin at the end of its first edge. Returns, too, whether the city has all its moves.
    """
    streets = scene.streets
    seen = scene.seen.edges[view]
    turns = scene.seen.turns
    along = 0.0
    free_along = 0.0
    over = 0.0
    free_over = 0.0
    known = True
    for n in range(1, len(route)):
        edge = route[n]
        along += seen[edge]
        free_along += streets.free[edge]
        move = move_between(streets.onward, route[n - 1], edge)
        if move == UNKNOWN:
            known = False
        else:
            over += turns[move]
            free_over += streets.free_turns[move]
    return along + over, free_along + free_over, known


@inner
def _time_of(scene: Scene, view: int, route: np.ndarray) -> float:
    """Return the time of a route from the end of its first edge (s)."""
    time, _, _ = times_of(scene, view, route)
    return time


@inner
def _leaves_once(route: np.ndarray, region: np.ndarray) -> bool:
    """Return True if a route does not come back into its first region."""
    away = False
    for edge in route:
        if region[edge] != region[route[0]]:
            away = True
        elif away:
            return False
    return True


@inner
def present_route(scene: Scene, trip: Trip, route: np.ndarray, known: bool) -> Present:
    """Return the present route of a driver.

    route: the rest of it; known: it is open to cars
    """
    if not known or route[0] != trip.here:
        return Present(known, math.inf, math.inf, math.inf)
    time, free, found = times_of(scene, trip.sight, route)
    longest = math.inf
    if found and (scene.streets.ways_return or _leaves_once(route, scene.streets.region)):
        longest = time + 1.0
    return Present(known, time, max(time - free, 0.0), longest)


@inner
def next_region(streets: Streets, route: np.ndarray) -> int:
    """Return the next region of a route.

    It is the first other region, or with `ways_return` the region after its last exit.
    """
    region = streets.region
    home = region[route[0]]
    following = home
    for edge in route:
        if region[edge] == home:
            if streets.ways_return:
                following = home
        elif following == home:
            following = region[edge]
    return following


@inner
def worth(streets: Streets, present: Present) -> float:
    """Return the time (s) below which another route is worth a change."""
    if not streets.lanes or present.time == math.inf:
        return present.time / (1.0 + MESO_THRESHOLD)
    saved = SWITCHING_THRESHOLD * present.delay**2 / max(present.time, 1e-9)
    return present.time - saved


@inner
def keeps(
    streets: Streets, present: Present, route: np.ndarray, time: float, following: int
) -> bool:
    """Return True if a driver keeps the present route.

    route: edges of the present route
    time: of another route (s); following: its next region, UNKNOWN if it has none
    """
    if not present.known:
        return True
    if present.time == math.inf:
        return False
    if following != UNKNOWN and next_region(streets, route) != following:
        return False
    return time >= worth(streets, present)


@inner
def shifted(wish: np.ndarray, own: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return shares that differ from `wish` as `theta` from `own` (-, (N,)).

    A next region that theta lowers loses the same part of its wishes. The regions that theta raises
    get these in proportion to how much it raises them.
    """
    shares = wish.copy()
    raised = 0.0
    for n in range(len(wish)):
        if theta[n] < own[n]:
            shares[n] *= theta[n] / own[n]
        else:
            raised += theta[n] - own[n]
    freed = wish.sum() - shares.sum()
    for n in range(len(wish)):
        if theta[n] > own[n]:
            shares[n] += freed * (theta[n] - own[n]) / max(raised, 1e-12)
    return shares


@inner
def assigned(times: np.ndarray, shares: np.ndarray, given: np.ndarray, penalty: float) -> int:
    """Return which next region a driver gets.

    times: by each next region (s, (N,)), infinite if too long; shares: of the drivers (-, (N,))
    given: vehicles assigned before (veh, (N,))
    penalty: per vehicle that a region is behind its share (s)
    """
    most = given.sum() + 1.0
    best = times.argmin()  # if every region with a share is too long a detour
    least = math.inf
    for n in range(len(times)):
        cost = times[n] - penalty * (shares[n] * most - given[n])
        if shares[n] > LEAST_SHARE and cost < least:
            best = n
            least = cost
    return best


@compiled
def chosen(
    counts: Counts,
    region: int,
    destination: int,
    neighbours: np.ndarray,
    times: np.ndarray,
    exist: np.ndarray,
    limit: float,
) -> int:
    """Return which of `neighbours` (N,) a driver in `region` gets.

    It is UNKNOWN if no share is left.

    times: by each of them (s, (N,)); exist: there is a route (bool, (N,))
    limit: time beyond which a route is too long (s)
    """
    within = times.copy()
    within[times > limit] = math.inf
    wished = counts.wished[region, destination]
    wished[neighbours[within.argmin()]] += 1.0
    wish = wished[neighbours]
    own = counts.own[region, destination][neighbours]
    theta = counts.theta[region, destination][neighbours]
    shares = shifted(wish / wish.sum(), own, theta)
    shares[~exist] = 0.0
    total = shares.sum()
    if total <= 0.0:
        return UNKNOWN
    given = counts.given[region, destination][neighbours]
    return assigned(within, shares / total, given, counts.penalty)


@compiled
def assign(counts: Counts, visits: np.ndarray, slot: int, following: int) -> None:
    """Count a driver for a next region, and no more for the one given before.

    visits: of all drivers (VISIT, (slots,)); slot: of this one
    """
    visit = visits[slot]
    region = visit.region
    destination = visit.destination
    if visit.following != UNKNOWN:
        age = float(counts.interval - visit.interval)
        counts.realised[region, visit.following, destination] -= 1
        counts.given[region, destination, visit.following] -= counts.memory**age
    counts.realised[region, following, destination] += 1
    counts.given[region, destination, following] += 1.0
    visit.following = following
    visit.interval = counts.interval


@compiled
def next_change(
    scene: Scene,
    counts: Counts,
    visits: np.ndarray,
    drivers: np.ndarray,
    routes: np.ndarray,
    begin: int,
) -> tuple[int, int, np.ndarray]:
    """Guide drivers from number `begin` on, until one gets another route.

    Returns the driver's number, the next region that the route counts for, and its edges. If nobody
    gets one, the number is n and there are no edges. The next region is UNKNOWN in the region of
    destination.

    visits: of all drivers (VISIT, (slots,)); drivers: those to guide (DRIVER, (n,))
    routes: their edges, one route after the other
    """
    for n in range(begin, len(drivers)):
        if scene.work.used[0] + ROWS_OF_A_DRIVER > len(scene.work.limits):
            forget(scene.work)
        driver = drivers[n]
        visit = visits[driver.slot]
        edges = routes[driver.begin : driver.end]
        view = scene.seen.views[visit.driver_class, visit.destination]
        trip = Trip(visit.region, visit.driver_class, view, driver.here, visit.target)
        present = present_route(scene, trip, edges, driver.known)
        if visit.region == visit.destination:
            following = UNKNOWN
            route = _plan_home(scene, trip, edges, present)
        else:
            following, route = _plan_on(scene, counts, trip, visit.destination, edges, present)
        if len(route):
            return n, following, route
        if following != UNKNOWN:
            assign(counts, visits, driver.slot, following)
    return len(drivers), UNKNOWN, np.zeros(0, np.int64)


@inner
def _unpriced(trip: Trip) -> Trip:
    """Return the trip of a driver who does not see prices."""
    return Trip(trip.region, trip.driver_class, trip.driver_class, trip.here, trip.target)


@inner
def _plan_home(scene: Scene, trip: Trip, edges: np.ndarray, present: Present) -> np.ndarray:
    """Return the fastest route inside the region of destination.

    If routes may return, it is the fastest of all. There are no edges if the present one is kept.
    """
    streets = scene.streets
    if trip.here == trip.target:
        return np.zeros(0, np.int64)
    time, route = homeward(scene, trip, worth(streets, present) + 1.0)
    if time == math.inf or keeps(streets, present, edges, time, UNKNOWN):
        return np.zeros(0, np.int64)
    if trip.sight != trip.driver_class:  # prices may have made the route a long detour
        takes = _time_of(scene, trip.driver_class, route)
        time, shortest = homeward(scene, _unpriced(trip), takes)
        if time < takes - streets.most_detour:
            return shortest
    return route


@inner
def _plan_on(
    scene: Scene,
    counts: Counts,
    trip: Trip,
    destination: int,
    edges: np.ndarray,
    present: Present,
) -> tuple[int, np.ndarray]:
    """Return the next region of a driver, and the fastest route by it.

    There are no edges if the present route is kept, and the region is UNKNOWN if nothing changes.

    destination: region; edges: of the present route
    """
    streets = scene.streets
    region = trip.region
    plain = trip.driver_class
    found = choices(scene, trip, present.longest, 0)
    nothing = np.zeros(0, np.int64)
    if found.fastest == math.inf:
        return UNKNOWN, nothing
    first = streets.boundaries[region]
    neighbours = streets.neighbours[first : streets.boundaries[region + 1]]
    if trip.sight == plain:
        limit = found.fastest + streets.most_detour
        n = chosen(counts, region, destination, neighbours, found.times, found.exist, limit)
        if n == UNKNOWN:
            return UNKNOWN, nothing
        following = neighbours[n]
        if keeps(streets, present, edges, found.times[n], following):
            return following, nothing
        _search_again(scene, found, 0)
        return following, _route(scene, found, n, 0)
    # The driver sees prices. By the times without them, no route is a long detour.
    blind = _unpriced(trip)
    unpriced = present_route(scene, blind, edges, present.known)
    shortest = choices(scene, blind, unpriced.longest, 3)
    limit = shortest.fastest + streets.most_detour
    _search_again(scene, found, 0)
    _search_again(scene, shortest, 3)
    times = np.full(len(neighbours), math.inf)
    for n in range(len(neighbours)):
        way = _shortened(scene, found, shortest, n, limit)
        if len(way):
            times[n] = _time_of(scene, trip.sight, way)
    exist = found.exist | shortest.exist
    n = chosen(counts, region, destination, neighbours, times, exist, math.inf)
    if n == UNKNOWN:
        return UNKNOWN, nothing
    following = neighbours[n]
    way = _shortened(scene, found, shortest, n, limit)
    time = times[n]
    if unpriced.time > limit:
        # Prices do not justify so long a detour: the present route is judged without them.
        present = unpriced
        time = _time_of(scene, plain, way)
    if keeps(streets, present, edges, time, following):
        return following, nothing
    return following, way


@inner
def _shortened(scene: Scene, found: Choices, shortest: Choices, n: int, limit: float) -> np.ndarray:
    """Return the n-th route within the limit, no edges if there is none.

    found: the fastest routes with prices; shortest: without prices
    limit: of the time without prices (s)
    """
    if found.times[n] < math.inf:
        way = _route(scene, found, n, 0)
        if _time_of(scene, shortest.trip.sight, way) <= limit:
            return way
    if shortest.times[n] <= limit < math.inf:
        return _route(scene, shortest, n, 3)
    return np.zeros(0, np.int64)


@compiled
def least_times(scene: Scene, view: int, starts: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Return the time from the nearest start to each edge (s, (E,)).

    starts: edges
    allowed: edges that routes may use (bool, (E,))
    """
    work = scene.work
    streets = scene.streets
    field = Field(streets.onward, scene.seen.onward[view], allowed, streets.ahead[-1, 0])
    everything = np.arange(len(allowed))
    _search(work, field, starts, everything, math.inf, work.before[-1])
    return work.times.copy()


@compiled
def connected(graph: Graph, start: int, allowed: np.ndarray) -> np.ndarray:
    """Return the edges that `start` leads to, itself among them (bool, (E,)).

    allowed: edges that routes may use (bool, (E,))
    """
    reached = np.full(len(allowed), False)
    waiting = [start]
    reached[start] = True
    while waiting:
        edge = waiting.pop()
        for entry in range(graph.begins[edge], graph.begins[edge + 1]):
            after = graph.ends[entry]
            if allowed[after] and not reached[after]:
                reached[after] = True
                waiting.append(after)
    return reached
