"""Page of all settings, from their declarations: python .ci/settings.py writes
scenarios/settings.md."""

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cosim.plant.settings import Settings
from cosim.sumo.net import CityTable
from nmfd.controllers.strategy import CONTROLLERS
from nmfd.model.regional_model import NetworkTable
from nmfd.model.scenario import ScenarioTable

PAGE = Path(__file__).parents[1] / "scenarios" / "settings.md"
FILES = (
    ("scenario.toml", [ScenarioTable, ("sumo", Settings)]),
    ("network.toml", [NetworkTable, ("sumo", CityTable)]),
)


def page() -> str:
    """Return the page in Markdown."""
    options = {kind.options: [] for kind in CONTROLLERS.values()}
    for kind in CONTROLLERS.values():
        options[kind.options].append(kind.name)
    lines = ["# Settings", "", "Written by `python .ci/settings.py` from the declarations."]
    for file, tables in FILES:
        lines += ["", f"## {file}"]
        for table in tables:
            name, kind = table if isinstance(table, tuple) else ("", table)
            lines += section(kind, name)
        if file == "scenario.toml":
            for kind, names in options.items():
                lines += section(kind, ", ".join(f"controllers.{name}" for name in names))
    return "\n".join(lines) + "\n"


def section(kind: type[BaseModel], name: str) -> list[str]:
    """Return the table of a declaration, then those of the tables inside it."""
    schema = kind.model_json_schema()
    definitions = schema.pop("$defs", {})
    if not schema.get("properties"):
        return []
    parts = [rows(schema, f"`[{name}]`" if name else "Top level")]
    for key, value in schema["properties"].items():
        inner = value.get("items", {}).get("$ref") or next(
            (
                part.get("items", {}).get("$ref")
                for part in value.get("anyOf", [])
                if "items" in part
            ),
            None,
        )
        if reference := inner or value.get("$ref"):
            title = f"`[[{key}]]`" if inner else f"`[{key}]`"
            parts.append(rows(definitions[reference.rpartition("/")[2]], title))
    return [line for part in parts for line in part]


def rows(schema: dict[str, Any], title: str) -> list[str]:
    """Return a heading and one row per key."""
    lines = [
        "",
        f"### {title}",
        "",
        "| key | default | unit, range | meaning |",
        "|---|---|---|---|",
    ]
    for key, value in schema.get("properties", {}).items():
        default = (
            "**required**" if key in schema.get("required", ()) else f"`{value.get('default')}`"
        )
        lines.append(f"| `{key}` | {default} | {limits(value)} | {value.get('description', '')} |")
    return lines


def limits(value: dict[str, Any]) -> str:
    """Return unit and range of a setting."""
    value = {
        **value,
        **next((part for part in value.get("anyOf", []) if part.get("type") != "null"), {}),
    }
    if "enum" in value:
        return ", ".join(value["enum"])
    low = value.get("minimum", value.get("exclusiveMinimum"))
    high = value.get("maximum", value.get("exclusiveMaximum"))
    bounds = (
        ""
        if low is None and high is None
        else f"{'' if low is None else f'{low:g}'}..{'' if high is None else f'{high:g}'}"
    )
    return " ".join(part for part in (value.get("unit", ""), bounds) if part)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
