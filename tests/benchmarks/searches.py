"""What a search for fastest ways costs with the libraries that there are.

    pip install networkit igraph rustworkx routingkit-cch
    python tests/benchmarks/searches.py [--scenario luxembourg] [--searches 200]

Every library searches from the same edges of the city, at free flow, on the moves between edges as guidance does
(cosim.plant.shortest_paths): the times to everywhere, of which guidance needs those up to LIMIT s, or in the case of
contraction hierarchies, which know no trees, to GATEWAYS edges. A library that is not installed is left out. Times are
of the processor, the best of ROUNDS [ms]: per search, and for getting ready, once for every set of travel times, of
which guidance has one per driver class, region and interval.
"""

import argparse
import importlib
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from cosim.plant.shortest_paths import Moves
from cosim.plant.travel_times import TravelTimes
from cosim.sumo.net import city_of, edge_shapes
from nmfd.api import load_scenario

LIMIT, GATEWAYS, ROUNDS = 270.0, 30, 3

Search = Callable[[int], object]  # from a node


def with_scipy(costs: csr_array, limit: float = np.inf) -> Callable[[], Search]:
    """scipy's, as guidance has it with a limit [s]."""
    return lambda: lambda node: dijkstra(costs, indices=node, return_predecessors=True, limit=limit)


def with_networkit(costs: csr_array) -> Callable[[], Search]:
    """networkit's, in C++."""
    networkit = importlib.import_module("networkit")
    moves = costs.tocoo()

    def ready() -> Search:
        graph = networkit.GraphFromCoo(
            (moves.data, (moves.row.astype(np.uint64), moves.col.astype(np.uint64))),
            costs.shape[0],
            weighted=True,
            directed=True,
        )

        def search(node: int) -> object:
            found = networkit.distance.Dijkstra(graph, node, True, False)
            found.run()
            return found.getDistances()

        return search

    return ready


def with_igraph(costs: csr_array) -> Callable[[], Search]:
    """igraph's, in C; distances only."""
    igraph = importlib.import_module("igraph")
    moves = costs.tocoo()
    graph = igraph.Graph(n=costs.shape[0], edges=np.column_stack([moves.row, moves.col]).tolist(), directed=True)

    def ready() -> Search:
        graph.es["time"] = moves.data.tolist()
        return lambda node: graph.distances(node, weights="time")

    return ready


def with_rustworkx(costs: csr_array) -> Callable[[], Search]:
    """rustworkx's, in Rust; distances only."""
    rustworkx = importlib.import_module("rustworkx")
    moves = costs.tocoo()

    def ready() -> Search:
        graph = rustworkx.PyDiGraph()
        graph.add_nodes_from(range(costs.shape[0]))
        graph.add_edges_from(list(zip(moves.row.tolist(), moves.col.tolist(), moves.data.tolist(), strict=True)))
        return lambda node: rustworkx.digraph_dijkstra_shortest_path_lengths(graph, node, float)

    return ready


def with_contraction(costs: csr_array, middle: np.ndarray) -> Callable[[], Search]:
    """RoutingKit's customizable contraction hierarchies, in C++; whole milliseconds, to GATEWAYS edges."""
    routingkit = importlib.import_module("routingkit_cch")
    moves = costs.tocoo()
    tail, head = moves.row.tolist(), moves.col.tolist()
    order = routingkit.compute_order_inertial(costs.shape[0], tail, head, middle[:, 1].tolist(), middle[:, 0].tolist())
    hierarchy = routingkit.CCH(order, tail, head, False)
    gateways = np.random.default_rng(0).choice(costs.shape[0], GATEWAYS, replace=False).tolist()

    def ready() -> Search:
        metric = routingkit.CCHMetric(hierarchy, np.rint(1000.0 * moves.data).astype(int).tolist())
        return routingkit.CCHOneToMany(metric, gateways).distances_from

    return ready


def from_all(search: Search, nodes: list[int]) -> None:
    """A search from each node."""
    for node in nodes:
        search(node)


def best(work: Callable[[], object]) -> float:
    """Processor time of the fastest of ROUNDS [ms]."""
    times = []
    for _ in range(ROUNDS):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return 1e3 * min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="luxembourg")
    parser.add_argument("--searches", type=int, default=200)
    asked = parser.parse_args()
    city = city_of(load_scenario(asked.scenario).network)
    times = TravelTimes(city)
    moves = Moves(times.first, times.second, allowed=np.full(len(city.edges), True), reverse=False)
    costs = moves.costing(times.free, times.free_turns)
    middle = np.array([shape.mean(axis=0) for shape in edge_shapes(city)])
    nodes = np.random.default_rng(1).integers(costs.shape[0], size=asked.searches).tolist()
    within = np.mean([np.isfinite(dijkstra(costs, indices=node, limit=LIMIT)).mean() for node in nodes])
    print(f"{asked.scenario}: {costs.shape[0]} edges, {costs.nnz} moves; {within:.0%} of them within {LIMIT:.0f} s\n")
    print("| library | getting ready [ms] | a search [ms] |\n|---|---|---|")
    for name, library in (
        (f"scipy, {LIMIT:.0f} s", lambda: with_scipy(costs, LIMIT)),
        ("scipy", lambda: with_scipy(costs)),
        ("networkit", lambda: with_networkit(costs)),
        ("igraph", lambda: with_igraph(costs)),
        ("rustworkx", lambda: with_rustworkx(costs)),
        (f"contraction hierarchies, to {GATEWAYS} edges", lambda: with_contraction(costs, middle)),
    ):
        try:
            ready = library()
        except ImportError as error:
            print(f"| {name} | not installed ({error.name}) | |")
            continue
        each = best(partial(from_all, ready(), nodes)) / len(nodes)
        print(f"| {name} | {best(ready):.2f} | {each:.3f} |")


if __name__ == "__main__":
    main()
