"""The JSON schema of declared settings, and what a setting may be, in words."""

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema

Schema = dict[str, Any]

PLURALS = {"number": "numbers", "integer": "whole numbers", "string": "texts in quotes"}


class _WithoutNull(GenerateJsonSchema):
    """TOML has no null: a setting that may be None is one that may be left out."""

    def nullable_schema(self, schema: Any) -> Schema:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Schema:
        known = schema.get("default") is not None
        return super().default_schema(schema) if known else self.generate_inner(schema["schema"])

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


def of(declaration: type[BaseModel]) -> Schema:
    """The JSON schema of a declaration."""
    return declaration.model_json_schema(schema_generator=_WithoutNull)


def resolved(root: Schema, schema: Schema) -> Schema:
    """`schema`, or what it refers to in `root` with what is said beside the reference."""
    if "$ref" not in schema:
        return schema
    return {**root["$defs"][schema["$ref"].rpartition("/")[2]], **schema}


def allowed(schema: Schema) -> str:
    """What a setting may be: "a number in [0, 1]"."""
    kind = schema.get("type")
    if kind == "boolean":
        return "true or false"
    if kind == "string":
        most = schema.get("maxLength")
        return (
            f"one of {', '.join(schema['enum'])}"
            if "enum" in schema
            else "text in quotes" + (f" of 1 to {most} printable characters" if most else "")
        )
    if kind == "array":
        return _list(schema)
    return (
        f"a whole number{_range(schema)}"
        if kind == "integer"
        else (f"a number{_range(schema)}" if kind == "number" else "a table")
    )


def _range(schema: Schema) -> str:
    low, high, above = (schema.get(key) for key in ("minimum", "maximum", "exclusiveMinimum"))
    if above is not None:
        return f" above {above:g}" + ("" if high is None else f" up to {high:g}")
    if low is None:
        return ""
    if high is None:
        return f" from {low:g} up"
    return f" from {low} to {high}" if schema["type"] == "integer" else f" in [{low:g}, {high:g}]"


def _list(schema: Schema) -> str:
    items = schema["items"] if "items" in schema else schema["prefixItems"][0]
    least, most = schema.get("minItems", 0), schema.get("maxItems")
    if "$ref" in items:
        return "a list of tables" + (", at least one" if least else "")
    count = "" if most is None else f"{most} " if least == most else f"{least} to {most} "
    distinct = "distinct " if schema.get("uniqueItems") else ""
    return f"a list of {count}{distinct}{PLURALS[items['type']]}{_range(items)}"
