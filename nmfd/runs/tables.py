"""Tables as text, for the terminal and in markdown."""

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

from tabulate import tabulate

WIDTH = 120  # characters of a line below a table
NUMBER = re.compile(r"[-+]?\d.*|-|nan|")  # also with a unit, an interval or a second number


def text_table(rows: Sequence[Mapping[str, object]], caption: str = "") -> str:
    """Return rows with the same headings as text, numbers aligned to the right, and the `caption`
    below."""
    return text_columns(
        list(rows[0]) if rows else [], [list(row.values()) for row in rows], caption
    )


def text_columns(
    headings: Sequence[str], lines: Iterable[Iterable[object]], caption: str = ""
) -> str:
    """Return headings and lines of cells as text, as `text_table`."""
    cells = [[str(cell) for cell in line] for line in (headings, *lines)]
    sides = [
        "right" if all(map(NUMBER.fullmatch, column[1:])) else "left"
        for column in zip(*cells, strict=True)
    ]
    # headings as a line: tabulate makes columns wider than their headings
    table = tabulate(cells, tablefmt="plain", disable_numparse=True, colalign=sides)
    return "\n".join([table, *wrapped(caption)])


def markdown_table(headings: Sequence[str], lines: Iterable[Iterable[object]]) -> str:
    """Return headings and lines of cells in markdown; without padding, so that a new line changes
    no other."""
    cells = [[str(cell).replace("|", "\\|") for cell in line] for line in (headings, *lines)]
    cells.insert(1, ["---"] * len(headings))
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def wrapped(caption: str) -> list[str]:
    """Return the caption in lines of at most WIDTH characters, with the indentation of its
    lines."""
    wrap = partial(textwrap.wrap, width=WIDTH, break_long_words=False, break_on_hyphens=False)
    indents = [(line, " " * (len(line) - len(line.lstrip()))) for line in caption.splitlines()]
    return [part for line, indent in indents for part in wrap(line, subsequent_indent=indent)]
