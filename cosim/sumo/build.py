"""The SUMO network of a city: given files, or built from a recipe by netconvert.

city.toml -> plain XML -> netconvert -> <network>/build/<name>.net.xml and regions.csv; in the user's cache if nothing
can be written beside the network (nmfd.runs.shipped.build_folder).
"""

import hashlib
import os
import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Self
from xml.sax.saxutils import quoteattr

import sumo
from pydantic import AfterValidator, Field, model_validator

from nmfd.errors import InputError
from nmfd.model.regional_model import RegionalModel
from nmfd.runs import config, shipped
from nmfd.runs.config import Numbers, Problem, Region, Settings, Text, got, setting, whole
from nmfd.runs.files import atomic, temporary_folder

YELLOW_S, ALL_RED_S, LEFT_GREEN_S = 3, 0, 6  # of the signals; the last one of protected left turns
LEAST_SPACING_M = 60.0  # of parallel streets
JUNCTION_RADIUS_M = 10.0  # that netconvert cuts off a street
# (lanes, movements, every movement has lanes of its own) -> lanes of each movement, numbered from the right
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


class CityTable(Settings):
    """The table [sumo] of network.toml: a recipe, or SUMO's network and the region of every edge."""

    recipe: Text | None = setting("file from which the city is built, relative to the network's folder", None)
    net: Text | None = setting("instead: SUMO's network", None)
    regions: Text | None = setting("with net: csv with the columns edge, region", None)

    @model_validator(mode="after")
    def _one_or_the_other(self) -> Self:
        given = self.model_fields_set
        if self.recipe is not None and len(given) > 1:
            raise Problem("recipe", "a city has a recipe, or net and regions; remove one of them")
        for key in ("net", "regions"):
            if self.recipe is None and key not in given:
                raise Problem(key, f'missing; add {key} = "...", or recipe = "city.toml"')
        return self


def _apart(lines: tuple[float, ...]) -> tuple[float, ...]:
    if any(b - a < LEAST_SPACING_M for a, b in pairwise(lines)):
        raise Problem("", got(f"rising numbers at least {LEAST_SPACING_M:g} m apart", list(lines)))
    return lines


Lines = Annotated[Numbers, Field(min_length=3, max_length=10), AfterValidator(_apart)]


class Streets(Settings):
    """Lines with streets in both directions, and junctions where they meet."""

    x: Lines = setting("streets that run north-south; rising, at least 60 m apart", unit="m")
    y: Lines = setting("streets that run east-west; rising, at least 60 m apart", unit="m")
    speed: float = setting("speed limit", unit="m/s", gt=0.0)


class CentreTable(Streets):
    """The fine grid in the middle: one lane in each direction."""

    region: Region = setting("region of the centre")
    pocket: float = setting("length of the second lane before a signal", unit="m", ge=10.0)


class OuterTable(Streets):
    """The lattice of arterials around it: three lanes in each direction."""

    regions: str = setting("region of every junction in lines, north at the top; a dot where the centre is")

    @property
    def picture(self) -> list[list[str]]:
        """Return the words of every line that is not empty."""
        return [line.split() for line in self.regions.splitlines() if line.strip()]

    @model_validator(mode="after")
    def _fits_the_lines(self) -> Self:
        if [len(row) for row in self.picture] != [len(self.x)] * len(self.y):
            raise Problem("regions", f"expected {len(self.y)} rows of {len(self.x)} regions or dots; correct it")
        return self


class SignalsTable(Settings):
    """The fixed-time signals of all junctions."""

    cycle: int = whole("cycle time", low=30, unit="s")


class RecipeTable(Settings):
    """A city with a fine grid in a wide lattice of arterials."""

    centre: CentreTable = setting("the fine grid")
    outer: OuterTable = setting("the lattice")
    signals: SignalsTable = setting("of all junctions")


@dataclass(frozen=True, kw_only=True)
class SumoFiles:
    """The files of a city: SUMO's network, and the region of every edge."""

    net_file: Path
    regions_csv: Path


@dataclass(frozen=True, kw_only=True)
class Node:
    """A junction at (x, y) [m], of the fine grid (centre) or the lattice around it."""

    id: str
    x: float
    y: float
    region: int
    centre: bool


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A checked city.toml with its junctions and the streets between neighbours."""

    table: RecipeTable
    nodes: dict[str, Node]
    streets: list[tuple[str, str]]


def network_folder(network: RegionalModel) -> Path:
    """Return the folder of `network`. Raises InputError for one that was not loaded from a file."""
    if network.folder is None:
        raise InputError(f"network {network.name}: was not loaded from a folder; load it with load_network")
    return network.folder


def ensure_built(network: RegionalModel) -> SumoFiles:
    """Return the SUMO files of `network`, built first if they are missing or the recipe has changed.

    Raises InputError for a wrong [sumo] table of network.toml, a missing file, or an error of netconvert.
    """
    folder = network_folder(network)
    path = folder / "network.toml"
    content = config.read(path)
    if "sumo" not in content:
        raise InputError(
            f'{path}: sumo: missing; this network has no city to simulate: add [sumo] with recipe = "city.toml"'
        )
    table = config.checked(CityTable, content["sumo"], path, "sumo.")
    if table.recipe is not None:
        return _built(folder / table.recipe, network)
    net, regions = (folder / str(name) for name in (table.net, table.regions))  # both, by CityTable
    for key, file in (("net", net), ("regions", regions)):
        if not file.is_file():
            raise config.error(path, f"sumo.{key}", f"no such file: {file}; give the path of an existing one")
    return SumoFiles(net_file=net, regions_csv=regions)


def _built(recipe_file: Path, network: RegionalModel) -> SumoFiles:
    folder = shipped.build_folder(recipe_file.parent)
    files = SumoFiles(net_file=folder / f"{network.name}.net.xml", regions_csv=folder / "regions.csv")
    stamp_file = folder / f"{network.name}.stamp"
    recipe = read_recipe(recipe_file, network.regions)
    content = recipe_file.read_bytes() + Path(__file__).read_bytes() + metadata.version("eclipse-sumo").encode()
    stamp = hashlib.sha256(content).hexdigest()
    built = all(file.is_file() for file in (stamp_file, files.net_file, files.regions_csv))
    if built and stamp_file.read_text(encoding="utf-8") == stamp:
        return files
    stamp_file.unlink(missing_ok=True)
    net, regions = build(recipe, str(recipe_file))
    # The stamp comes last: with it, all files are there.
    for file, content in ((files.net_file, net), (files.regions_csv, regions), (stamp_file, stamp.encode())):
        with atomic(file) as temporary:
            temporary.write_bytes(content)
    return files


def read_recipe(path: Path, regions: int) -> Recipe:
    """Read and check a city.toml. Raises InputError."""
    table = config.checked(RecipeTable, config.read(path), path)
    centre, outer = table.centre, table.outer
    if centre.region >= regions:
        raise config.error(path, "centre.region", config.got(f"a whole number from 0 to {regions - 1}", centre.region))
    picture, nodes = outer.picture[::-1], {}
    for i, x in enumerate(centre.x):
        for j, y in enumerate(centre.y):
            nodes[f"c{i}{j}"] = Node(id=f"c{i}{j}", x=x, y=y, region=centre.region, centre=True)
    for j, y in enumerate(outer.y):
        for i, x in enumerate(outer.x):
            inside = centre.x[0] <= x <= centre.x[-1] and centre.y[0] <= y <= centre.y[-1]
            word = picture[j][i]
            if inside and word == ".":
                continue
            if inside or word not in map(str, range(regions)):
                allowed = "a dot (it lies in the centre)" if inside else f"a region from 0 to {regions - 1}"
                raise config.error(
                    path, "outer.regions", f"expected {allowed} at x = {x:g}, y = {y:g}, got {word!r} instead"
                )
            nodes[f"o{i}{j}"] = Node(id=f"o{i}{j}", x=x, y=y, region=int(word), centre=False)
    streets = []  # both directions between neighbours; lines of the lattice may go on as streets of the centre
    for along, across in (("x", "y"), ("y", "x")):
        lines: dict[float, list[Node]] = {}
        for node in nodes.values():
            lines.setdefault(getattr(node, across), []).append(node)
        for line in lines.values():
            line.sort(key=lambda node: getattr(node, along))
            for a, b in pairwise(line):
                streets += [(a.id, b.id), (b.id, a.id)]
    return Recipe(table=table, nodes=nodes, streets=streets)


def _movements(recipe: Recipe, start: str, end: str) -> dict[str, str]:
    """Return {"r", "s" or "l": next node} at the end of a street, without turning back."""
    # A radial is entered straight ahead only, so that no queue before it stands on the ring round the centre.
    nodes = recipe.nodes
    heading = _heading(nodes[start], nodes[end])
    turns = {}
    for a, b in recipe.streets:
        if a == end and b != start:
            onward = _heading(nodes[a], nodes[b])
            cross = heading[0] * onward[1] - heading[1] * onward[0]
            turn = "s" if cross == 0 else "l" if cross > 0 else "r"
            if turn == "s" or nodes[a].centre or not nodes[b].centre:
                turns[turn] = b
    return {turn: turns[turn] for turn in "rsl" if turn in turns}


def _heading(a: Node, b: Node) -> tuple[int, int]:
    return (b.x > a.x) - (b.x < a.x), (b.y > a.y) - (b.y < a.y)


def _plain_xml(recipe: Recipe) -> tuple[dict[str, str], dict[str, int]]:
    """Return node, edge and connection files for netconvert, and the region of every edge."""
    nodes = recipe.nodes
    legs = {name: sum(a == name for a, _ in recipe.streets) for name in nodes}
    node_rows = [
        _row("node", id=n.id, x=n.x, y=n.y, type="traffic_light" if legs[n.id] > 2 else "priority")
        for n in nodes.values()
    ]
    edge_rows, connection_rows, region_of, first, last, lanes = [], [], {}, {}, {}, {}
    for a, b in recipe.streets:
        start, end, name = nodes[a], nodes[b], f"{a}-{b}"
        speed = (recipe.table.centre if start.centre or end.centre else recipe.table.outer).speed
        if start.centre and end.centre:
            pieces = [(name, a, b, 1)]
            if legs[b] > 2:
                joint = f"{name}.j"
                length = abs(end.x - start.x) + abs(end.y - start.y)
                share = 1.0 - (recipe.table.centre.pocket + JUNCTION_RADIUS_M) / length
                x, y = start.x + share * (end.x - start.x), start.y + share * (end.y - start.y)
                node_rows.append(_row("node", id=joint, x=x, y=y, type="priority"))
                pieces = [(name, a, joint, 1), (f"{name}.p", joint, b, 2)]
                connection_rows += [_link(name, f"{name}.p", 0, lane) for lane in (0, 1)]
        else:
            pieces = [(name, a, b, 4 if _leads_in(recipe, a, b) else 3)]
        for piece, begin, finish, count in pieces:
            edge_rows.append(_row("edge", id=piece, **{"from": begin}, to=finish, numLanes=count, speed=speed))
            region_of[piece] = end.region if start.centre and not end.centre else start.region
            lanes[piece] = count
        first[a, b], last[a, b] = pieces[0][0], pieces[-1][0]
    for a, b in recipe.streets:
        turns, source = _movements(recipe, a, b), last[a, b]
        own = _leads_in(recipe, a, b) or (nodes[b].centre and not nodes[a].centre)
        for turn, lanes_of_turn in LANES[lanes[source], "".join(turns), own].items():
            target = first[b, turns[turn]]
            for lane, into in zip(lanes_of_turn, _into(turn, len(lanes_of_turn), lanes[target]), strict=True):
                connection_rows += [_link(source, target, lane, number) for number in into]
    tables = {"node": node_rows, "edge": edge_rows, "connection": connection_rows}
    return {kind: f"<{kind}s>\n{''.join(rows)}</{kind}s>\n" for kind, rows in tables.items()}, region_of


def _leads_in(recipe: Recipe, a: str, b: str) -> bool:
    """Return True for a street of the lattice at whose end a radial leads into the centre."""
    outside = not recipe.nodes[a].centre and not recipe.nodes[b].centre
    return outside and any(recipe.nodes[to].centre for to in _movements(recipe, a, b).values())


def _into(turn: str, lanes: int, target_lanes: int) -> list[range]:
    """Return the lanes that each lane of a movement leads into: one each, or all for a single lane that turns."""
    # Two vehicles in a queue that want each other's lane would wait forever.
    if turn == "s" or lanes > 1:
        cuts = [target_lanes * n // lanes for n in range(lanes + 1)]
        return [range(a, b) for a, b in pairwise(cuts)]
    return [range(target_lanes)]


def _row(tag: str, **attributes: str | float) -> str:
    return f"  <{tag} {' '.join(f'{key}={quoteattr(str(value))}' for key, value in attributes.items())}/>\n"


def _link(source: str, target: str, lane: int, into: int) -> str:
    return _row("connection", **{"from": source}, to=target, fromLane=lane, toLane=into)


def build(recipe: Recipe, where: str) -> tuple[bytes, bytes]:
    """Return the bytes of net.xml and regions.csv, the same ones for the same recipe.

    Raises InputError if netconvert fails.
    """
    files, region_of = _plain_xml(recipe)
    with temporary_folder() as folder:
        options = {
            "output-file": "net.xml",
            "no-turnarounds": "true",
            "tls.cycle.time": recipe.table.signals.cycle,
            "tls.yellow.time": YELLOW_S,
            "tls.allred.time": ALL_RED_S,
            "tls.left-green.time": LEFT_GREEN_S,
        }
        for kind, content in files.items():
            (folder / f"{kind}.xml").write_text(content, encoding="utf-8")
            options[f"{kind}-files"] = f"{kind}.xml"
        run_sumo("netconvert", options, where=where, folder=folder)
        net = (folder / "net.xml").read_bytes()
    table = "".join(["edge,region\n", *(f"{edge},{region}\n" for edge, region in sorted(region_of.items()))])
    # The comment holds the date and the temporary folder.
    return re.sub(rb"<!--.*?-->\s*", b"", net, count=1, flags=re.DOTALL), table.encode()


def run_sumo(program: str, options: Mapping[str, object], *flags: str, where: str, folder: Path | None = None) -> None:
    """Run one of SUMO's programs in a folder. Raises InputError with its first error line and the file `where`."""
    arguments = [text for name, value in options.items() for text in (f"--{name}", str(value))]
    command = [str(Path(sumo.SUMO_HOME) / "bin" / program), *arguments, *flags]
    environment = os.environ | {"SUMO_HOME": sumo.SUMO_HOME}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", env=environment)
    if done.returncode:
        lines = (done.stderr + done.stdout).splitlines()
        error = next((line for line in lines if "rror" in line), "no reason given")
        raise InputError(f"{where}: {program} cannot run it: {' '.join(error.split())}; correct the input")
