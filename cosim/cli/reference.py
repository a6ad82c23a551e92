"""The command reference of `cosim`: what scenario.toml and network.toml may say, from where it is declared."""

import json
from pathlib import Path

import click

from nmfd.cli.options import FOLDER


@click.command()
@click.argument("folder", type=FOLDER, default=".")
def reference(folder: Path) -> None:
    """Write the reference of scenario.toml and network.toml, and the JSON schemas that editors complete from.

    They go to README.md and *.schema.json in the folders scenarios and networks of FOLDER. What was written by hand in
    the pages stays. Editors that know Taplo, such as VS Code with Even Better TOML, find the schema by the first line
    of a file: #:schema ../scenario.schema.json
    """
    for path, text in files(folder).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        click.echo(path)


def files(folder: Path) -> dict[Path, str]:
    """The files that the command writes in `folder`, and what is in them."""
    from cosim.plant.settings import SumoTable  # the declarations of all controllers: torch
    from cosim.sumo.recipe import CityTable, RecipeTable
    from nmfd.controllers import registry
    from nmfd.model.network_file import NetworkTable
    from nmfd.model.scenario_file import ScenarioTable
    from nmfd.runs import reference, schema

    scenario, network = schema.of(ScenarioTable), schema.of(NetworkTable)
    sumo, city = schema.of(SumoTable), schema.of(CityTable)
    options = {name: schema.of(declared) for name, declared in registry.declarations().items()}
    pages = {
        "scenarios": ["## scenario.toml\n", *reference.sections(scenario, "Top level"),
                      *reference.sections(sumo, "`[sumo]`"),
                      *(section for names, table in _same(options).items() for section in reference.sections(
                          table, ", ".join(f"`[controllers.{name}]`" for name in names)))],
        "networks": ["## network.toml\n", *reference.sections(network, "Top level"),
                     *reference.sections(city, "`[sumo]`"),
                     "## city.toml, the recipe of a city\n", *reference.sections(schema.of(RecipeTable), "Top level")]}
    found = {}
    for name, parts in pages.items():
        page = folder / name / "README.md"
        found[page] = reference.placed(page.read_text() if page.is_file() else "", "\n" + "\n".join(parts) + "\n")
    # a scenario on another one need not say what that one says
    scenario["anyOf"] = [{"required": ["base"]}, {"required": scenario.pop("required")}]
    scenario["properties"]["sumo"], network["properties"]["sumo"] = sumo, city
    scenario["properties"]["controllers"] = {
        "type": "object", "properties": {**options, registry.OWN: {"type": "object"}},
        "patternProperties": {f"^{name}\\+": table for name, table in options.items()}, "additionalProperties": False}
    for file, content in (("scenarios/scenario", scenario), ("networks/network", network)):
        content["$schema"] = "http://json-schema.org/draft-07/schema#"
        found[folder / f"{file}.schema.json"] = json.dumps(content, indent=1) + "\n"
    return found


def _same(options: dict[str, dict]) -> dict[tuple[str, ...], dict]:
    """The options of controllers that have the same ones, together."""
    found: dict[tuple[str, ...], dict] = {}
    for table in options.values():
        names = tuple(name for name, other in options.items() if other == table)
        found[names] = table
    return found
