"""Build the SUMO network of an invented city, such as grid7, from its recipe city.toml.

    python networks/build_grid.py networks/grid7

city.toml -> plain XML -> netconvert -> city.net.xml and regions.csv beside it, the same bytes for
the same recipe.
"""

import re
import sys
import tomllib
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from xml.sax.saxutils import quoteattr

from cosim.sumo.programs import run_sumo
from nmfd.runs.files import temporary_folder

YELLOW_S, ALL_RED_S, LEFT_GREEN_S = 3, 0, 6  # of the signals; the last one of protected left turns
JUNCTION_RADIUS_M = 10.0  # that netconvert cuts off a street
# (lanes, movements, every movement has lanes of its own) -> lanes of each movement, numbered from
# the right
LANES = {
    (4, "rsl", True): {"r": [0], "s": [1, 2], "l": [3]},
    (3, "rsl", True): {"r": [0], "s": [1], "l": [2]},
    (3, "rsl", False): {"r": [0], "s": [0, 1], "l": [2]},
    (3, "rs", False): {"r": [0], "s": [1, 2]},
    (3, "sl", False): {"s": [0, 1], "l": [2]},
    (3, "rl", False): {"r": [0], "l": [1, 2]},
    (3, "r", False): {"r": [0, 1, 2]},
    (3, "l", False): {"l": [0, 1, 2]},
    (2, "rsl", False): {"r": [0], "s": [0], "l": [1]},
    (2, "rs", False): {"r": [0], "s": [1]},
    (2, "sl", False): {"s": [0], "l": [1]},
    (2, "rl", False): {"r": [0], "l": [1]},
    (1, "r", False): {"r": [0]},
    (1, "l", False): {"l": [0]},
}


def main(folder: Path) -> None:
    """Write city.net.xml and regions.csv into the folder."""
    table = tomllib.loads((folder / "city.toml").read_text(encoding="utf-8"))
    net, regions = build(table, str(folder / "city.toml"))
    (folder / "city.net.xml").write_bytes(net)
    (folder / "regions.csv").write_bytes(regions)


def read_nodes(table: dict) -> dict[str, SimpleNamespace]:
    """Return the junctions at (x, y) [m] by name, of the fine grid (centre) or the lattice around
    it."""
    centre, outer, nodes = table["centre"], table["outer"], {}
    for i, x in enumerate(centre["x"]):
        for j, y in enumerate(centre["y"]):
            nodes[f"c{i}{j}"] = SimpleNamespace(
                id=f"c{i}{j}", x=x, y=y, region=centre["region"], centre=True
            )
    picture = [line.split() for line in outer["regions"].splitlines() if line.strip()][::-1]
    for j, y in enumerate(outer["y"]):
        for i, x in enumerate(outer["x"]):
            if picture[j][i] != ".":
                nodes[f"o{i}{j}"] = SimpleNamespace(
                    id=f"o{i}{j}", x=x, y=y, region=int(picture[j][i]), centre=False
                )
    return nodes


def streets_of(nodes: dict) -> list[tuple[str, str]]:
    """Return both directions between neighbours; lines of the lattice may go on as streets of the
    centre."""
    streets = []
    for along, across in (("x", "y"), ("y", "x")):
        lines: dict[float, list] = {}
        for node in nodes.values():
            lines.setdefault(getattr(node, across), []).append(node)
        for line in lines.values():
            line.sort(key=lambda node: getattr(node, along))
            for a, b in pairwise(line):
                streets += [(a.id, b.id), (b.id, a.id)]
    return streets


class Grid:
    """The streets of a recipe as plain XML for netconvert, and the region of every edge."""

    def __init__(self, table: dict):
        self.table, self.nodes = table, read_nodes(table)
        self.streets = streets_of(self.nodes)

    def movements(self, start: str, end: str) -> dict[str, str]:
        """Return {"r", "s" or "l": next node} at the end of a street, without turning back."""
        # A radial is entered straight ahead only, so that no queue before it stands on the ring
        # round the centre.
        nodes, turns = self.nodes, {}
        heading = _heading(nodes[start], nodes[end])
        for a, b in self.streets:
            if a == end and b != start:
                onward = _heading(nodes[a], nodes[b])
                cross = heading[0] * onward[1] - heading[1] * onward[0]
                turn = "s" if cross == 0 else "l" if cross > 0 else "r"
                if turn == "s" or nodes[a].centre or not nodes[b].centre:
                    turns[turn] = b
        return {turn: turns[turn] for turn in "rsl" if turn in turns}

    def leads_in(self, a: str, b: str) -> bool:
        """Return True for a street of the lattice at whose end a radial leads into the centre."""
        outside = not self.nodes[a].centre and not self.nodes[b].centre
        return outside and any(self.nodes[to].centre for to in self.movements(a, b).values())

    def plain_xml(self) -> tuple[dict[str, str], dict[str, int]]:
        """Return node, edge and connection files, and edge -> region."""
        nodes, centre = self.nodes, self.table["centre"]
        legs = {name: sum(a == name for a, _ in self.streets) for name in nodes}
        node_rows = [
            _row(
                "node",
                id=n.id,
                x=float(n.x),
                y=float(n.y),
                type="traffic_light" if legs[n.id] > 2 else "priority",
            )
            for n in nodes.values()
        ]
        edge_rows, connection_rows, region_of, first, last, lanes = [], [], {}, {}, {}, {}
        for a, b in self.streets:
            start, end, name = nodes[a], nodes[b], f"{a}-{b}"
            speed = (centre if start.centre or end.centre else self.table["outer"])["speed"]
            if start.centre and end.centre:
                pieces = [(name, a, b, 1)]
                if legs[b] > 2:
                    joint = f"{name}.j"
                    length = abs(end.x - start.x) + abs(end.y - start.y)
                    share = 1.0 - (centre["pocket"] + JUNCTION_RADIUS_M) / length
                    x, y = start.x + share * (end.x - start.x), start.y + share * (end.y - start.y)
                    node_rows.append(_row("node", id=joint, x=x, y=y, type="priority"))
                    pieces = [(name, a, joint, 1), (f"{name}.p", joint, b, 2)]
                    connection_rows += [_link(name, f"{name}.p", 0, lane) for lane in (0, 1)]
            else:
                pieces = [(name, a, b, 4 if self.leads_in(a, b) else 3)]
            for piece, begin, finish, count in pieces:
                edge_rows.append(
                    _row(
                        "edge", id=piece, **{"from": begin}, to=finish, numLanes=count, speed=speed
                    )
                )
                region_of[piece] = end.region if start.centre and not end.centre else start.region
                lanes[piece] = count
            first[a, b], last[a, b] = pieces[0][0], pieces[-1][0]
        for a, b in self.streets:
            turns, source = self.movements(a, b), last[a, b]
            own = self.leads_in(a, b) or (nodes[b].centre and not nodes[a].centre)
            for turn, lanes_of_turn in LANES[lanes[source], "".join(turns), own].items():
                target = first[b, turns[turn]]
                for lane, into in zip(
                    lanes_of_turn, _into(turn, len(lanes_of_turn), lanes[target]), strict=True
                ):
                    connection_rows += [_link(source, target, lane, number) for number in into]
        tables = {"node": node_rows, "edge": edge_rows, "connection": connection_rows}
        return {
            kind: f"<{kind}s>\n{''.join(rows)}</{kind}s>\n" for kind, rows in tables.items()
        }, region_of


def _heading(a: SimpleNamespace, b: SimpleNamespace) -> tuple[int, int]:
    return (b.x > a.x) - (b.x < a.x), (b.y > a.y) - (b.y < a.y)


def _into(turn: str, lanes: int, target_lanes: int) -> list[range]:
    """Return the lanes that each lane of a movement leads into: one each, or all for a single lane
    that turns."""
    # Two vehicles in a queue that want each other's lane would wait forever.
    if turn == "s" or lanes > 1:
        cuts = [target_lanes * n // lanes for n in range(lanes + 1)]
        return [range(a, b) for a, b in pairwise(cuts)]
    return [range(target_lanes)]


def _row(tag: str, **attributes: str | float) -> str:
    texts = [f"{key}={quoteattr(str(value))}" for key, value in attributes.items()]
    return f"  <{tag} {' '.join(texts)}/>\n"


def _link(source: str, target: str, lane: int, into: int) -> str:
    return _row("connection", **{"from": source}, to=target, fromLane=lane, toLane=into)


def build(table: dict, where: str) -> tuple[bytes, bytes]:
    """Return the bytes of city.net.xml and regions.csv."""
    files, region_of = Grid(table).plain_xml()
    with temporary_folder() as folder:
        options = {
            "output-file": folder / "net.xml",
            "no-turnarounds": "true",
            "tls.cycle.time": table["signals"]["cycle"],
            "tls.yellow.time": YELLOW_S,
            "tls.allred.time": ALL_RED_S,
            "tls.left-green.time": LEFT_GREEN_S,
        }
        for kind, content in files.items():
            (folder / f"{kind}.xml").write_text(content, encoding="utf-8")
            options[f"{kind}-files"] = folder / f"{kind}.xml"
        run_sumo("netconvert", options, where=where)
        net = (folder / "net.xml").read_bytes()
    regions = "".join(
        ["edge,region\n", *(f"{edge},{region}\n" for edge, region in sorted(region_of.items()))]
    )
    # The comment holds the date and the temporary folder.
    return re.sub(rb"<!--.*?-->\s*", b"", net, count=1, flags=re.DOTALL), regions.encode()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
