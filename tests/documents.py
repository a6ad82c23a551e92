"""What the READMEs and the notebooks of the tutorials say: their links, names in backticks, and
commands."""

import ast
import json
import re
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from copies import ROOT
from markdown_it import MarkdownIt

FOLDERS = ("cosim", "networks", "nmfd", "scenarios", "tests")
FILES = [
    ROOT / "README.md",
    *sorted(
        file
        for folder in FOLDERS
        for pattern in ("README.md", "record.md", "*.ipynb")
        for file in (ROOT / folder).rglob(pattern)
        if not any(part[0] == "." for part in file.relative_to(ROOT).parts)
    ),
]
NOTEBOOKS = [file for file in FILES if file.suffix == ".ipynb"]
PROGRAMS = [
    "nmfd",
    "cosim",
    "python",
    "python3",
    "pip",
    "pytest",
    "dask",
    "pdoc",
    "jupyter",
    ".",
    "netgenerate",
    "openssl",
    "ruff",
    ".ci/run",
]


@dataclass(frozen=True)
class Document:
    """links: targets of links and pictures; names: what stands in backticks; headings: their
    anchors;
    blocks: of code; commands: their lines, and those that a notebook calls, as lists of words."""

    file: Path
    links: list[str]
    names: list[str]
    headings: list[str]
    blocks: list[str]
    commands: list[list[str]]


def read(file: Path) -> Document:
    text, called = file.read_text(encoding="utf-8"), []
    if file.suffix == ".ipynb":
        cells = [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(text)["cells"]]
        text = "\n\n".join(source for kind, source in cells if kind == "markdown")
        called = list(_called([source for kind, source in cells if kind == "code"]))
    links, names, headings, blocks = [], [], [], []
    tokens = MarkdownIt("commonmark").enable("table").parse(text)
    for token, before in zip(tokens, [None, *tokens], strict=False):
        if token.type in ("code_block", "fence"):
            blocks.append(token.content)
        if before is not None and before.type == "heading_open":
            headings.append(re.sub(r"[^\w\- ]", "", token.content.lower()).replace(" ", "-"))
        for part in token.children or ():
            if part.type in ("link_open", "image"):
                links.append(str(part.attrs["href" if part.type == "link_open" else "src"]))
            if part.type == "code_inline":
                names.append(part.content)
    lines = [line for block in blocks if kind(block) == "shell" for line in _lines(block)]
    return Document(
        file,
        links,
        names,
        headings,
        blocks,
        [words for line in (*lines, *called) for words in _words(line) if words],
    )


def kind(block: str) -> str:
    """shell, toml or python; "" for what is none of them."""
    lines = _lines(block)
    if lines and all(line.split()[0] in PROGRAMS for line in lines):
        return "shell"
    for name, parse, errors in (
        ("toml", tomllib.loads, tomllib.TOMLDecodeError),
        ("python", ast.parse, SyntaxError),
    ):
        try:
            parse(block)
        except errors:
            continue
        return name
    return ""


def _lines(block: str) -> list[str]:
    whole = re.sub(r"\\\n\s*", "", block)
    return [
        line.strip()
        for line in whole.splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]


def _words(line: str) -> Iterator[list[str]]:
    words: list[str] = []
    for word in shlex.split(line, comments=True):
        if word == "&&":
            yield words
            words = []
        else:
            words.append(word)
    yield words


def _called(sources: list[str]) -> Iterator[str]:
    """The first argument of every call of `command` in the cells of a notebook. {NAME} in it is
    what NAME = QUICK-value if QUICK else VALUE gives to whoever runs it whole."""
    nodes = [
        node
        for source in sources
        if not source.startswith("%%")
        for node in ast.walk(ast.parse(source))
    ]
    values = {
        node.targets[0].id: node.value.orelse.value
        for node in nodes
        if isinstance(node, ast.Assign)
        and isinstance(getattr(node.value, "orelse", None), ast.Constant)
    }
    for node in nodes:
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "command":
            given = node.args[0]
            parts = given.values if isinstance(given, ast.JoinedStr) else [given]
            yield "".join(
                str(part.value if isinstance(part, ast.Constant) else values[part.value.id])
                for part in parts
            )
