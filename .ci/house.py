"""Size and style of the house against its budget, and its picture.

python .ci/house.py            print the figures; exit 1 if one is beyond its budget or the picture is out of date
python .ci/house.py --draw     draw .ci/house.svg from the imports
"""

import ast
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from itertools import chain
from pathlib import Path

import grimp
import matplotlib.pyplot as plt
from pydantic import BaseModel

ROOT = Path(__file__).parents[1]
PICTURE = Path(__file__).with_name("house.svg")
LINES, MODULES, TEST_LINES, WORDS, WORDS_OF_A_PAGE, COMMANDS, PARAMETERS, SETTINGS = (
    20_000, 140, 14_000, 12_000, 900, 17, 110, 120,
)  # fmt: skip
LONG_PAGES = {"scenarios/settings.md"}
ODD = re.compile(r"(Of|What|Whether|Who|Where|As|The same)\b")


def main() -> None:
    if "--draw" in sys.argv:
        PICTURE.write_text(drawn(), encoding="utf-8")
        return
    figures = measured()
    for name, (value, limit) in figures.items():
        print(f"{name:45} {value:8,} of {limit:,}")
    problems = [
        f"{name}: {value:,} is more than {limit:,}" for name, (value, limit) in figures.items() if value > limit
    ]
    problems += odd_docstrings() + long_pages()
    if not PICTURE.is_file() or edges_in(PICTURE.read_text(encoding="utf-8")) != arrows():
        problems.append(f"{PICTURE.name}: is out of date; run python .ci/house.py --draw")
    sys.exit("\n".join(problems) or None)


def sources(*folders: str) -> list[Path]:
    """Return the Python files that git tracks in these folders."""
    listed = subprocess.run(["git", "ls-files", *folders], cwd=ROOT, capture_output=True, text=True, check=True)
    return [ROOT / name for name in listed.stdout.split() if name.endswith(".py")]


def measured() -> dict[str, tuple[int, int]]:
    """Return each figure of the house with its limit."""
    code, tests = sources("nmfd", "cosim"), sources("tests")
    commands = shown_commands()
    return {
        "lines outside the tests": (lines(code), LINES),
        "modules outside the tests": (len(code), MODULES),
        "lines of tests": (lines(tests), TEST_LINES),
        "words of pages": (sum(words().values()), WORDS),
        "commands": (len(commands), COMMANDS),
        "parameters of all commands": (sum(len(command.params) for command in commands), PARAMETERS),
        "declared settings": (sum(len(kind.model_fields) for kind in settings()), SETTINGS),
    }


def lines(files: list[Path]) -> int:
    """Return the number of lines in `files`."""
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def words() -> dict[str, int]:
    """Return the number of words of every page that git tracks."""
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True)
    return {name: len((ROOT / name).read_text(encoding="utf-8").split()) for name in listed.stdout.split()}


def shown_commands() -> list:
    """Return the commands of both command lines."""
    from cosim.cli import main as cosim
    from nmfd.cli import main as nmfd

    return [command for group in (nmfd, cosim) for command in group.commands.values()]


def settings() -> list[type[BaseModel]]:
    """Return every pydantic model of the house once; a field that a subclass inherits counts there only."""
    graph = grimp.build_graph("nmfd", "cosim", cache_dir=None)
    for module in graph.modules:
        __import__(module) if not module.endswith("__main__") else None
    kinds, queue = [], [BaseModel]
    while queue:
        queue += (below := queue.pop().__subclasses__())
        kinds += [kind for kind in below if kind.__module__.split(".")[0] in ("nmfd", "cosim")]
    return [kind for kind in dict.fromkeys(kinds) if not kind.__subclasses__()]


def odd_docstrings() -> list[str]:
    """Return the docstrings that begin with a word that no verb or noun follows."""
    problems = []
    for file in sources("nmfd", "cosim"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        for node in (node for node in ast.walk(tree) if isinstance(node, kinds)):
            text = ast.get_docstring(node) or ""
            if ODD.match(text):
                line = getattr(node, "lineno", 1)
                problems.append(f"{file.relative_to(ROOT)}:{line}: begins with {ODD.match(text)[0]!r}")
    return problems


def long_pages() -> list[str]:
    """Return the pages that have more words than a page may have."""
    return [
        f"{name}: {count} words, more than {WORDS_OF_A_PAGE}"
        for name, count in words().items()
        if count > WORDS_OF_A_PAGE and name not in LONG_PAGES
    ]


def room(module: str) -> str:
    """Return the room of a module: package and first part, such as nmfd.model."""
    return ".".join(module.split(".")[:2])


def arrows() -> set[tuple[str, str]]:
    """Return the imports between rooms, without those that a longer way implies (the transitive reduction)."""
    graph = grimp.build_graph("nmfd", "cosim", exclude_type_checking_imports=True, cache_dir=None)
    inside, below = floors(), defaultdict(set)
    for one in graph.modules:
        for other in graph.find_modules_directly_imported_by(one):
            if room(one) != room(other) and room(one) in inside and room(other) in inside:
                below[room(one)].add(room(other))

    def reached(start: str) -> set[str]:
        return {start}.union(*(reached(other) for other in below[start]))

    return {
        (one, other)
        for one in list(below)
        for other in below[one]
        if not any(other in reached(third) for third in below[one] if third != other)
    }


def floors() -> dict[str, int]:
    """Return the floor of every room in the layers of pyproject.toml, the lowest is 0."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    layers = [contract["layers"] for contract in contracts if contract["type"] == "layers"]
    ordered = [re.split(r"\s*[|:]\s*", layer) for layer in chain.from_iterable(reversed(layers[::-1][::-1]))]
    cosim = [layer for layer in ordered if layer[0].startswith("cosim")]
    nmfd = [layer for layer in ordered if layer[0].startswith("nmfd")]
    return {name: floor for floor, layer in enumerate([*nmfd[::-1], *cosim[::-1]]) for name in layer}


def edges_in(picture: str) -> set[tuple[str, str]]:
    """Return the arrows that a picture of `drawn` shows."""
    return {tuple(pair.split(" ")) for pair in re.findall(r'id="arrow ([\w.]+ [\w.]+)"', picture)}


def drawn() -> str:
    """Return the rooms and the imports between them as SVG, the highest floor on top."""
    place = floors()
    figure, axes = plt.subplots(figsize=(7, 7))
    position = {}
    for floor in sorted(set(place.values())):
        rooms = [name for name, there in place.items() if there == floor]
        for index, name in enumerate(rooms):
            position[name] = ((index + 1) / (len(rooms) + 1), floor)
            colour = "#dbe9f6" if name.startswith("nmfd") else "#fde5cc"
            box = {"boxstyle": "round,pad=0.35", "facecolor": colour, "edgecolor": "#555555"}
            axes.text(*position[name], name, ha="center", va="center", fontsize=9, bbox=box, zorder=3)
    for index, (one, other) in enumerate(sorted(arrows())):
        bend = 0.05 * (-1) ** index * min(abs(place[one] - place[other]) - 1, 4)
        style = {"arrowstyle": "->", "color": "#888888", "lw": 0.9, "connectionstyle": f"arc3,rad={bend}"}
        arrow = axes.annotate("", position[other], position[one], arrowprops=style, zorder=1)
        arrow.arrow_patch.set_gid(f"arrow {one} {other}")
    axes.set(xlim=(0, 1), ylim=(-0.7, max(place.values()) + 0.7))
    axes.axis("off")
    plt.rcParams.update({"svg.hashsalt": "house", "svg.fonttype": "none"})
    from io import StringIO

    out = StringIO()
    figure.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
    return out.getvalue()


if __name__ == "__main__":
    main()
