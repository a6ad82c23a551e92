"""Fastest routes and what drivers make of them, in machine code.

Guidance asks for a route per driver and minute. Each answer takes a few microseconds here, and a
hundred by operations on lists or arrays. Edges, moves, regions and nodes are numbers; -1 is an edge
closed to cars, or a move that the city does not have. Graphs are rows as in
scipy.sparse.csr_array: `columns` and `costs` from begins[n] to begins[n + 1] are the moves from
node n.
"""

import math

import numpy as np

from nmfd.model.links.compiled import compiled, inner

UNKNOWN = -1
LEAST_SHARE = 1e-3  # a region with a smaller share gets no drivers


# With heapq, which numba compiles, too, a search takes 2.7 times as long as with this heap.
@inner
def _push(times: np.ndarray, nodes: np.ndarray, size: int, time: float, node: int) -> None:
    """Add a node to the heap of `size` nodes."""
    place = size
    while place > 0:
        above = (place - 1) // 2
        if times[above] <= time:
            break
        times[place] = times[above]
        nodes[place] = nodes[above]
        place = above
    times[place] = time
    nodes[place] = node


@inner
def _drop_first(times: np.ndarray, nodes: np.ndarray, size: int) -> None:
    """Take the first node from the heap, which has `size` nodes afterwards."""
    time = times[size]
    node = nodes[size]
    place = 0
    while 2 * place + 1 < size:
        below = 2 * place + 1
        if below + 1 < size and times[below + 1] < times[below]:
            below += 1
        if time <= times[below]:
            break
        times[place] = times[below]
        nodes[place] = nodes[below]
        place = below
    times[place] = time
    nodes[place] = node


@compiled
def search(
    begins: np.ndarray,
    columns: np.ndarray,
    costs: np.ndarray,
    start: int,
    most: float,
    aims: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Search from node `start` up to `most` (s), until all aims are reached.

    It is Dijkstra's algorithm. Returns times to the aims (s, (aims,)), infinite above `most`,
    predecessors (nodes,), and whether all aims were reached.
    """
    nodes = len(begins) - 1
    times = np.full(nodes, math.inf)
    before = np.full(nodes, np.int32(UNKNOWN))
    wanted = np.full(nodes, False)
    wanted[aims] = True
    missing = wanted.sum()
    heap_times = np.empty(len(columns) + 1)
    heap_nodes = np.empty(len(columns) + 1, np.int32)
    times[start] = 0.0
    _push(heap_times, heap_nodes, 0, 0.0, start)
    size = 1
    while size and missing:
        time = heap_times[0]
        node = heap_nodes[0]
        size -= 1
        _drop_first(heap_times, heap_nodes, size)
        if time > times[node]:  # it was reached sooner in the meantime
            continue
        missing -= wanted[node]
        for move in range(begins[node], begins[node + 1]):
            later = time + costs[move]
            after = columns[move]
            if later < times[after] and later <= most:
                times[after] = later
                before[after] = node
                _push(heap_times, heap_nodes, size, later, after)
                size += 1
    return times[aims], before, missing == 0


@compiled
def path(before: np.ndarray, edges: np.ndarray, first: int, last: int) -> np.ndarray:
    """Return the edges from node `first` back to `last`, where a search began.

    before: predecessors (nodes,); edges: of all nodes (nodes,)
    """
    length = 1
    node = first
    while node != last:
        node = before[node]
        length += 1
    way = np.empty(length, np.int64)
    node = first
    for n in range(length):
        way[n] = edges[node]
        node = before[node]
    return way


@compiled
def by_region(
    there: np.ndarray,
    onward: np.ndarray,
    begins: np.ndarray,
    leading: np.ndarray,
    reached: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return times (s), gateways and existence by each next region (N,).

    Returns, too, the least time (s).

    there, onward: times to each gateway and from there on (s, (G,))
    begins: first gateway into each region, and G (N + 1,)
    leading, reached: a driver can get to each gateway, and from there to his aim (G,)
    """
    regions = len(begins) - 1
    times = np.full(regions, math.inf)
    gateways = begins[:-1].copy()
    exist = np.full(regions, False)
    least = math.inf
    for n in range(regions):
        for gateway in range(begins[n], begins[n + 1]):
            exist[n] |= leading[gateway] and reached[gateway]
            time = there[gateway] + onward[gateway]
            if time < times[n]:
                times[n] = time
                gateways[n] = gateway
        least = min(least, times[n])
    return times, gateways, exist, least


@compiled
def ends_of_returns(
    nearest: float, back: np.ndarray, entering: np.ndarray, onward: np.ndarray, most: float
) -> tuple[np.ndarray, float]:
    """Return times from before each gateway on (s, (G,)), and the least.

    They are infinite if a route that leaves the region and comes back takes `most` or longer (s).

    nearest: time to the nearest gateway (s); back: no more than from there back to each (s, (G,))
    entering: time over each gateway (s, (G,)); onward: from there on (s, (G,))
    """
    ends = entering + onward
    for gateway in range(len(ends)):
        if nearest + back[gateway] + ends[gateway] >= most:
            ends[gateway] = math.inf
    return ends, ends.min()


@compiled
def moves_of(
    route: np.ndarray, begins: np.ndarray, second: np.ndarray, numbers: np.ndarray
) -> np.ndarray:
    """Return the moves between the edges of a route (its length - 1,).

    begins, second, numbers: moves from each edge (E + 1,), where they lead, and their numbers (M,)
    """
    moves = np.full(max(len(route) - 1, 0), UNKNOWN)
    for n in range(len(moves)):
        if route[n] == UNKNOWN:
            continue
        for move in range(begins[route[n]], begins[route[n] + 1]):
            if second[move] == route[n + 1]:
                moves[n] = numbers[move]
    return moves


@compiled
def times_of(
    route: np.ndarray,
    moves: np.ndarray,
    seen: np.ndarray,
    turns: np.ndarray,
    free: np.ndarray,
    free_turns: np.ndarray,
) -> tuple[float, float, bool]:
    """Return the time of a route, and that in free flow (s).

    They begin at the end of its first edge. Returns, too, whether all its moves are known.

    seen, free: times of edges (s, (E,)); turns, free_turns: of moves (s, (M,))
    """
    along = 0.0
    free_along = 0.0
    for edge in route[1:]:
        along += seen[edge]
        free_along += free[edge]
    over = 0.0
    free_over = 0.0
    known = True
    for move in moves:
        if move == UNKNOWN:
            known = False
        else:
            over += turns[move]
            free_over += free_turns[move]
    return along + over, free_along + free_over, known


@compiled
def leaves_once(route: np.ndarray, region: np.ndarray) -> bool:
    """Return True if a route does not come back into its first region.

    region: of each edge (E,)
    """
    away = False
    for edge in route:
        if region[edge] != region[route[0]]:
            away = True
        elif away:
            return False
    return True


@compiled
def next_region(route: np.ndarray, region: np.ndarray, ways_return: bool) -> int:
    """Return the next region of a route.

    It is the first other region, or with `ways_return` the region after its last exit.

    region: of each edge (E,)
    """
    home = region[route[0]]
    following = home
    for edge in route:
        if region[edge] == home:
            if ways_return:
                following = home
        elif following == home:
            following = region[edge]
    return following


@compiled
def shifted(wish: np.ndarray, own: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return shares that differ from `wish` as `theta` from `own` (-, (N,)).

    A next region that theta lowers loses the same part of its wishes. The regions that theta raises
    get these in proportion to how much it raises them.
    """
    kept = np.where(theta < own, wish * (theta / own), wish)
    raised = np.maximum(theta - own, 0.0)
    freed = wish.sum() - kept.sum()
    return kept + freed * raised / max(raised.sum(), 1e-12)


@compiled
def assigned(times: np.ndarray, shares: np.ndarray, given: np.ndarray, penalty: float) -> int:
    """Return which next region a driver gets.

    times: by each next region (s, (N,)), infinite if too long; shares: of the drivers (-, (N,))
    given: vehicles assigned before (veh, (N,))
    penalty: per vehicle that a region is behind its share (s)
    """
    allowed = (shares > LEAST_SHARE) & (times < math.inf)
    if not allowed.any():  # every region with a share is too long a detour
        allowed = times <= times.min()
    behind = shares * (given.sum() + 1.0) - given
    return np.where(allowed, times - penalty * behind, math.inf).argmin()


@compiled
def chosen(
    times: np.ndarray,
    exist: np.ndarray,
    limit: float,
    neighbours: np.ndarray,
    wished: np.ndarray,
    own: np.ndarray,
    theta: np.ndarray,
    given: np.ndarray,
    penalty: float,
) -> int:
    """Return which of `neighbours` (N,) a driver gets.

    It is UNKNOWN if no share is left.

    times: by each of them (s, (N,)); exist: there is a route (N,)
    limit: time beyond which a route is too long (s)
    wished, given: vehicles by next region (veh, (R,)); own, theta: shares (-, (R,))
    penalty: as in `assigned` (s)
    """
    within = np.where(times <= limit, times, math.inf)
    wished[neighbours[within.argmin()]] += 1.0
    wish = wished[neighbours]
    shares = shifted(wish / wish.sum(), own[neighbours], theta[neighbours])
    shares = np.where(exist, shares, 0.0)
    total = shares.sum()
    if total <= 0.0:
        return UNKNOWN
    return assigned(within, shares / total, given[neighbours], penalty)
