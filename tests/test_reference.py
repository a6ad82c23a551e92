"""Reference pages and JSON schemas are what the declarations of the settings give, and what is in the files."""

import json
import re
import tomllib
from pathlib import Path

import pytest

from cosim.plant.settings import SumoTable
from cosim.report.reference import files
from nmfd.model.model_file import schema_line
from nmfd.runs import reference, schema

ROOT = Path(__file__).parents[1]


def test_the_committed_pages_and_schemas_are_up_to_date():
    stale = [path.name for path, text in files(ROOT).items() if not path.is_file() or path.read_text() != text]
    assert not stale, f"{stale}: write them anew with: cosim reference"


@pytest.mark.parametrize(
    "file",
    [*ROOT.glob("scenarios/*/scenario.toml"), *ROOT.glob("networks/*/network.toml")],
    ids=lambda file: file.parent.name,
)
def test_every_committed_file_names_its_schema_and_has_only_keys_of_it(file):
    line, _ = file.read_text().split("\n", 1)
    root = json.loads((file.parent / line.removeprefix("#:schema ")).read_text())

    def check(table, declared, path):
        for key, value in table.items():
            fitting = [other for form, other in declared.get("patternProperties", {}).items() if re.search(form, key)]
            here = schema.resolved(root, [*fitting, declared["properties"].get(key)][0])
            for row in value if isinstance(value, list) else [value]:
                if isinstance(row, dict):
                    check(row, schema.resolved(root, here.get("items", here)), f"{path}.{key}")

    check(tomllib.loads(file.read_text()), root, "")


def test_a_table_of_the_page():
    (section,) = reference.sections(schema.of(SumoTable), "`[sumo]`")
    assert section.startswith("### `[sumo]`\n\nHow the city is simulated")
    assert "| `compliance` | `1` | - | a number in [0, 1] | share of the decisions in which" in section
    assert '| `actuation` | `"hold-back"` |  | one of hold-back, redistribute |' in section


def test_what_is_written_by_hand_stays():
    page = reference.placed("# Head\n", "first\n")
    assert reference.placed(page + "tail\n", "second\n") == page.replace("first", "second") + "tail\n"


def test_editors_find_the_schema_of_a_network_that_is_written(tmp_path):
    assert schema_line(tmp_path / "networks" / "mine") == ""
    (tmp_path / "networks").mkdir()
    (tmp_path / "networks" / "network.schema.json").touch()
    assert schema_line(tmp_path / "networks" / "mine") == "#:schema ../network.schema.json\n"
    assert schema_line(tmp_path / "networks" / "mine" / "guided") == "#:schema ../../network.schema.json\n"
