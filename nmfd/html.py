"""Results as a small table in a notebook."""

from collections.abc import Iterable, Sequence
from html import escape

from tabulate import tabulate


def html_table(headings: Sequence[str], lines: Iterable[Iterable[object]], caption: str = "") -> str:
    """A table, names to the left and numbers to the right, with its `caption` below; all text is escaped."""
    table = tabulate(
        [[str(cell) for cell in line] for line in lines],
        headings,
        tablefmt="html",
        disable_numparse=True,
        colglobalalign="right",
        colalign=["left"],
    )
    return f"<div>{table}<p><small>{escape(caption)}</small></p></div>"
