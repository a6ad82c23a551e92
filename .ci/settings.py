"""Page of all settings, from their declarations.

python .ci/settings.py writes scenarios/settings.md.
"""

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from cosim.plant.settings import Settings
from cosim.sumo.net import CityTable
from nmfd.controllers.strategy import CONTROLLERS
from nmfd.model.regional_model import NetworkTable
from nmfd.model.scenario import ScenarioTable

PAGE = Path(__file__).parents[1] / "scenarios" / "settings.md"
HEAD = ["| key | default | unit, range | meaning |", "|---|---|---|---|"]


def page() -> str:
    """Return the page in Markdown."""
    controllers: dict[type[BaseModel], list[str]] = {}
    for kind in CONTROLLERS.values():
        controllers.setdefault(kind.options, []).append(f"controllers.{kind.name}")
    lines = ["# Settings", "", "Written by `python .ci/settings.py` from the declarations."]
    lines += ["", "## scenario.toml", *section(ScenarioTable), *section(Settings, "sumo")]
    for options, names in controllers.items():
        lines += section(options, ", ".join(names))
    lines += ["", "## network.toml", *section(NetworkTable), *section(CityTable, "sumo")]
    return "\n".join(lines) + "\n"


def section(kind: type[BaseModel], name: str = "") -> list[str]:
    """Return the table of a declaration, then those of the tables inside it."""
    schema = kind.model_json_schema()
    if not schema.get("properties"):
        return []
    lines = rows(schema, f"`[{name}]`" if name else "Top level")
    for key, value in schema["properties"].items():
        repeated = items(value)
        reference = repeated or value.get("$ref")
        if reference:
            title = f"`[[{key}]]`" if repeated else f"`[{key}]`"
            lines += rows(schema["$defs"][reference.rpartition("/")[2]], title)
    return lines


def items(value: dict[str, Any]) -> str | None:
    """Return the reference to the table of a list of tables, else None."""
    for part in (value, *value.get("anyOf", [])):
        reference = part.get("items", {}).get("$ref")
        if reference:
            return reference
    return None


def rows(schema: dict[str, Any], title: str) -> list[str]:
    """Return a heading and one row per key."""
    lines = ["", f"### {title}", "", *HEAD]
    for key, value in schema.get("properties", {}).items():
        default = f"`{value.get('default')}`"
        if key in schema.get("required", ()):
            default = "**required**"
        lines.append(f"| `{key}` | {default} | {limits(value)} | {value.get('description', '')} |")
    return lines


def limits(value: dict[str, Any]) -> str:
    """Return unit and range of a setting."""
    for part in value.get("anyOf", []):
        if part.get("type") != "null":
            value = {**value, **part}
            break
    if "enum" in value:
        return ", ".join(value["enum"])
    low = value.get("minimum", value.get("exclusiveMinimum"))
    high = value.get("maximum", value.get("exclusiveMaximum"))
    lower = "" if low is None else f"{low:g}"
    upper = "" if high is None else f"{high:g}"
    bounds = f"{lower}..{upper}" if lower or upper else ""
    return f"{value.get('unit', '')} {bounds}".strip()


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
