"""Settings: pydantic models whose fields carry text and unit.

TOML files are validated against them.
"""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from nmfd.errors import InputError, did_you_mean

SHOWN_CHARACTERS = 60  # of a wrong value in a message
S = TypeVar("S", bound="Settings")


def setting(text: str, default: Any = ..., *, unit: str = "", **limits: Any) -> Any:
    """Return the field of a setting.

    limits: ge, gt, le, lt, min_length, max_length, alias of pydantic.Field
    """
    if unit:
        limits["json_schema_extra"] = {"unit": unit}
    return Field(default, description=text, **limits)


def whole(text: str, default: Any = ..., *, low: int = 0, high: int = 10**9, **more: Any) -> Any:
    """Return the field of a whole number from `low` to `high`."""
    return setting(text, default, ge=low, le=high, **more)


class Problem(ValueError):
    """Error of a validator about `key` of its table.

    The text ends in the remedy.
    """

    def __init__(self, key: str, text: str):
        super().__init__(text)
        self.key = key


class Settings(BaseModel):
    """Table of settings.

    Unknown keys, texts for numbers and numbers that are not finite are errors.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        keys = [field.alias or name for name, field in cls.model_fields.items()]
        for key in values:
            if key not in keys:
                hint = did_you_mean(str(key), keys)
                raise Problem(
                    key, f"unknown key{hint}; allowed here: {', '.join(keys)}; remove or correct it"
                )
        return values

    def changed(self: S, **changes: Any) -> S:
        """Return a checked copy with other values. Raise InputError."""
        return checked(type(self), {**vars(self), **changes}, "settings")


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("should be printable text on one line")
    return text


def _distinct(values: tuple) -> tuple:
    if len(set(values)) < len(values):
        raise ValueError("should be distinct values")
    return values


DISTINCT = (AfterValidator(_distinct), Field(strict=False))
Text = Annotated[str, Field(min_length=1, max_length=1000), AfterValidator(_printable)]
# Names become file names.
Name = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_printable)]
Texts = Annotated[tuple[Text, ...], *DISTINCT]
Region = Annotated[int, Field(ge=0)]
Regions = Annotated[tuple[Region, ...], *DISTINCT]
Numbers = Annotated[tuple[float, ...], Field(strict=False)]
PositiveNumbers = Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(strict=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0, json_schema_extra={"unit": "-"})]
Seconds = Annotated[float, Field(ge=0.0, json_schema_extra={"unit": "s"})]
Flow = Annotated[float, Field(ge=0.0, le=1e6, json_schema_extra={"unit": "veh/s"})]
Rows = Annotated[tuple[S, ...], Field(strict=False)]  # a list of tables


def read(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raise InputError if it is missing or not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        near = (file.parent.name for file in path.parent.parent.glob(f"*/{path.name}"))
        hint = did_you_mean(path.parent.name, near)
        raise InputError(f"{path}: no such file{hint}; give the path of an existing one") from None
    except OSError as problem:
        reason = problem.strerror
        raise InputError(f"{path}: cannot be read ({reason}); give a readable file") from None
    except (ValueError, RecursionError) as problem:  # also text in another encoding
        raise InputError(f"{path}: is not valid TOML: {problem}; correct it") from None


def checked(
    declaration: type[S], values: Mapping[str, Any], where: Path | str, prefix: str = ""
) -> S:
    """Return validated settings.

    Raises: InputError that begins with "where: prefix + key: "
    """
    try:
        return declaration.model_validate(values)
    except ValidationError as invalid:
        raise InputError(f"{where}: {prefix}{_first_problem(invalid)}") from None


def error(where: Path | str, key: str, problem: str) -> InputError:
    """Return the error for a key in the form of `checked`."""
    return InputError(f"{where}: {key}: {problem}")


def got(allowed: str, value: Any) -> str:
    """Return the sentence that says what a value should be and is."""
    return f"expected {allowed}, got {repr(value)[:SHOWN_CHARACTERS]} instead"


def quoted(text: str) -> str:
    """Return a text without line breaks as TOML writes it."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def filled(template: Path, **values: Any) -> str:
    """Return the TOML file that a template of Jinja makes of `values`.

    Its filters are `quoted` and numbers(form).
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined  # few commands write a file

    loader = FileSystemLoader(template.parent)
    how: Any = {"trim_blocks": True, "keep_trailing_newline": True, "undefined": StrictUndefined}
    environment = Environment(loader=loader, **how)
    environment.filters |= {
        "quoted": quoted,
        "numbers": lambda row, form: ", ".join(form % number for number in row),
    }
    return environment.get_template(template.name).render(values)


def _first_problem(invalid: ValidationError) -> str:
    first = invalid.errors(include_url=False)[0]
    path = ""
    for place in first["loc"]:
        path += f"[{place}]" if isinstance(place, int) else f".{place}"
    path = path.lstrip(".")
    problem = first.get("ctx", {}).get("error")
    if isinstance(problem, Problem):
        parts = [part for part in (path, problem.key) if part]
        return f"{'.'.join(parts)}: {problem}"
    if first["type"] == "missing":
        return f"{path}: missing; add it"
    text = re.sub(r"^(Value error, |(Input|String|Tuple|List|Value) (?=should))", "", first["msg"])
    text = re.sub("dictionary( or instance of .*)?", "table", text)
    return f"{path}: {text}, got {repr(first['input'])[:SHOWN_CHARACTERS]}"
