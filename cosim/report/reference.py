"""The reference of scenario.toml and network.toml, pages and JSON schemas, from where their keys are declared."""

import json
from pathlib import Path

from cosim.plant.settings import SumoTable
from cosim.sumo.recipe import CityTable, RecipeTable
from nmfd.controllers import registry
from nmfd.model.network_file import NetworkTable
from nmfd.model.scenario_file import PlanningOptions, ScenarioTable
from nmfd.runs import schema
from nmfd.runs.reference import placed, sections
from nmfd.runs.schema import Schema

DIALECT = {"$schema": "http://json-schema.org/draft-07/schema#"}  # that Taplo knows


def files(folder: Path) -> dict[Path, str]:
    """README.md and the JSON schema of the folders scenarios and networks in `folder`: path -> what is to be in it."""
    found = {}
    for name, text in (("scenarios", scenarios_page()), ("networks", networks_page())):
        page = folder / name / "README.md"
        found[page] = placed(page.read_text(encoding="utf-8") if page.is_file() else "", text)
    for name, content in (("scenarios/scenario", scenario_schema()), ("networks/network", network_schema())):
        found[folder / f"{name}.schema.json"] = json.dumps(DIALECT | content, indent=1) + "\n"
    return found


def scenarios_page() -> str:
    """Every key of scenario.toml, in Markdown."""
    options = _options()
    same = {tuple(name for name in options if options[name] == table): table for table in options.values()}
    return (
        "\n".join(
            [
                "\n## scenario.toml\n",
                *sections(schema.of(ScenarioTable), "Top level"),
                *sections(schema.of(SumoTable), "`[sumo]`"),
                *sections(schema.of(PlanningOptions), "`[controllers.NAME]`"),
                *(
                    section
                    for names, table in same.items()
                    if table["properties"]
                    for section in sections(table, ", ".join(f"`[controllers.{name}]`" for name in names))
                ),
            ]
        )
        + "\n"
    )


def networks_page() -> str:
    """Every key of network.toml and of the recipe of a city, in Markdown."""
    return (
        "\n".join(
            [
                "\n## network.toml\n",
                *sections(schema.of(NetworkTable), "Top level"),
                *sections(schema.of(CityTable), "`[sumo]`"),
                "## city.toml, the recipe of a city\n",
                *sections(schema.of(RecipeTable), "Top level"),
            ]
        )
        + "\n"
    )


def scenario_schema() -> Schema:
    """The JSON schema of scenario.toml, with [sumo] and the options of every controller."""
    root, model = schema.of(ScenarioTable), schema.of(PlanningOptions)["properties"]
    # a scenario on another one need not say what that one says
    root["anyOf"] = [{"required": ["base"]}, {"required": root.pop("required")}]
    for name, table in _options().items():
        root["$defs"][name] = {**table, "properties": {**model, **table["properties"]}}
    tables = {name: {"$ref": f"#/$defs/{name}"} for name in _options()}
    root["properties"]["sumo"] = schema.of(SumoTable)
    root["properties"]["controllers"] = {
        "type": "object",
        "properties": {**tables, registry.OWN: {"type": "object"}},
        "additionalProperties": False,
        "patternProperties": {f"^{name}\\+": table for name, table in tables.items()},
    }
    return root


def network_schema() -> Schema:
    """The JSON schema of network.toml, with [sumo]."""
    root = schema.of(NetworkTable)
    root["properties"]["sumo"] = schema.of(CityTable)
    return root


def _options() -> dict[str, Schema]:
    return {name: schema.of(declared) for name, declared in registry.declarations().items()}
