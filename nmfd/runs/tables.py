"""Tables as text, for the terminal and in markdown."""

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

from tabulate import tabulate

WIDTH = 120  # characters of a line below a table
NARROW = 100  # of a table and all lines around it, where a table can be made so narrow
NUMBER = re.compile(r"[-+]?\d.*|-|nan|")  # also with a unit, an interval or a second number


def text_table(rows: Sequence[Mapping[str, object]], caption: str = "") -> str:
    """Return rows with the same headings as text, with a caption below.

    Numbers are aligned to the right.
    """
    headings = list(rows[0]) if rows else []
    return text_columns(headings, [row.values() for row in rows], caption)


def text_columns(
    headings: Sequence[str], lines: Iterable[Iterable[object]], caption: str = ""
) -> str:
    """Return headings and lines of cells as text, as `text_table`."""
    cells = [list(map(str, line)) for line in (headings, *lines)]
    sides = []
    for column in zip(*cells, strict=True):
        numbers = all(map(NUMBER.fullmatch, column[1:]))
        sides.append("right" if numbers else "left")
    # headings as a line: tabulate makes columns wider than their headings
    table = tabulate(cells, tablefmt="plain", disable_numparse=True, colalign=sides)
    return "\n".join([table, *wrapped(caption)])


def cell(value: float, form: str) -> str:
    """Return a number as `form`, such as "{:.1f} %", shows it; "-" for NaN."""
    return "-" if math.isnan(value) else form.format(value)


def markdown_table(headings: Sequence[str], lines: Iterable[Iterable[object]]) -> str:
    """Return headings and lines of cells in markdown.

    Cells are not padded, so that a new line changes no other.
    """
    rows = []
    for line in (headings, *lines):
        cells = [str(cell).replace("|", "\\|") for cell in line]
        rows.append(f"| {' | '.join(cells)} |")
    rows.insert(1, "| --- " * len(headings) + "|")
    return "\n".join(rows)


def wrapped(caption: str, width: int = WIDTH) -> list[str]:
    """Return a caption in lines of at most so many characters.

    Continued lines keep their indentation.
    """
    wrap = partial(textwrap.wrap, width=width, break_long_words=False, break_on_hyphens=False)
    parts = []
    for line in caption.splitlines():
        indent = " " * (len(line) - len(line.lstrip()))
        parts += wrap(line, subsequent_indent=indent)
    return parts
