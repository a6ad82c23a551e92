"""Reference pages of declared settings: markdown tables, and their place in a page that is written by hand."""

import json
import re
from collections.abc import Iterator
from typing import Any

from nmfd.runs import schema
from nmfd.runs.schema import Schema
from nmfd.runs.tables import markdown_table

BEGIN, END = "<!-- begin: written by `cosim reference` -->", "<!-- end -->"
HEADINGS = ("key", "default", "unit", "allowed", "what it is")


def sections(root: Schema, title: str, prefix: str = "") -> Iterator[str]:
    """Markdown of the table `title` and of those in it, a section each; `root` is its JSON schema.

    prefix: of the names of the tables in it, such as "sumo."
    """
    shown: dict[str, str] = {}
    todo = [(title, prefix, root)]
    while todo:
        title, prefix, table = todo.pop(0)
        rows = [_row(root, key, value, key in table.get("required", ())) for key, value in table["properties"].items()]
        yield f"### {title}\n\n{_text(table['description'])}\n\n{markdown_table(HEADINGS, rows)}\n"
        for key, value in table["properties"].items():
            listed = "$ref" in value.get("items", {})
            reference = value["items"]["$ref"] if listed else value.get("$ref")
            if reference is None or reference in shown:
                continue
            shown[reference] = key
            inner = {"$ref": reference}  # described by its declaration, not by the key
            name = f"`[[{prefix}{key}]]`" if listed else f"`[{prefix}{key}]`"
            todo.append((name, f"{prefix}{key}.", schema.resolved(root, inner)))


def placed(page: str, text: str) -> str:
    """`page` with `text` between the markers, which are put at its end if it has none."""
    generated = f"{BEGIN}\n{text}{END}"
    if BEGIN not in page:
        return f"{page.rstrip()}\n\n{generated}\n".lstrip()
    return re.sub(f"{re.escape(BEGIN)}.*{re.escape(END)}", lambda _: generated, page, flags=re.DOTALL)


def _row(root: Schema, key: str, value: Schema, required: bool) -> tuple[str, ...]:
    here = schema.resolved(root, value)
    default = "**required**" if required else _toml(here.get("default"))
    return f"`{key}`", default, here.get("unit", ""), schema.allowed(here), _text(value["description"])


def _toml(value: Any) -> str:
    """A default as TOML writes it; nothing for a table, and for what may be left out."""
    if value is None or isinstance(value, dict):
        return ""
    return f"`{value:g}`" if isinstance(value, float) else f"`{json.dumps(value)}`"


def _text(text: str) -> str:
    return " ".join(text.split())
