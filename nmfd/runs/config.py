"""Settings, declared once as pydantic models and read from TOML: the edge at which files are validated.

A declaration is a subclass of `Settings` whose fields are made by `setting` and `whole`; the reference pages and the
JSON schemas for editors come from it (nmfd.runs.reference).
"""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from nmfd.errors import InputError, did_you_mean
from nmfd.runs import schema
from nmfd.runs.files import check_file

MOST = 10**9  # of a whole number without a limit of its own
LONGEST = 1000  # characters of a text
LONGEST_NAME = 100  # characters: names become file names
DEEP = re.compile(rb"(?:\s*\.\s*[\"']?[\w-]+[\"']?){100}")  # a dotted key of so many parts
SHOWN = 60  # characters of a wrong value that a message repeats
S = TypeVar("S", bound="Settings")


def setting(text: str, default: Any = ..., *, unit: str = "", **limits: Any) -> Any:
    """The field of a declaration. limits: ge, gt, le, lt, min_length, max_length, alias of pydantic.Field."""
    if unit:  # given even so, it would replace what a type says of itself
        limits["json_schema_extra"] = {"unit": unit}
    return Field(default, description=text, **limits)


def whole(
    text: str, default: Any = ..., *, low: int = 0, high: int = MOST, unit: str = "", alias: str | None = None
) -> Any:
    """The same of a whole number from `low` to `high`."""
    return setting(text, default, unit=unit, ge=low, le=high, alias=alias)


class Problem(ValueError):
    """What a validator finds wrong with `key` of its table, in words that end in the remedy."""

    def __init__(self, key: str, text: str):
        super().__init__(text)
        self.key = key


class Settings(BaseModel):
    """A table of settings: unknown keys, texts for numbers, numbers that are not finite are mistakes."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    def changed(self: S, **changes: Any) -> S:
        """A copy with other values, checked like the first. InputError."""
        return checked(type(self), {**vars(self), **changes}, "settings")


def _line(text: str) -> str:
    if not text.isprintable():
        raise ValueError("not printable")
    return text


def _distinct(values: tuple) -> tuple:
    if len(set(values)) < len(values):
        raise ValueError("not distinct")
    return values


DISTINCT = AfterValidator(_distinct), Field(strict=False, json_schema_extra={"uniqueItems": True})
Text = Annotated[str, Field(min_length=1, max_length=LONGEST), AfterValidator(_line)]
Name = Annotated[str, Field(min_length=1, max_length=LONGEST_NAME), AfterValidator(_line)]
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
    """The content of a TOML file; InputError if it is missing or not TOML."""
    path = Path(path)
    check_file(path, "give a TOML file")
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        hint = did_you_mean(path.parent.name, (file.parent.name for file in path.parent.parent.glob(f"*/{path.name}")))
        raise InputError(f"{path}: no such file{hint}; give the path of an existing one") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a readable file") from None
    try:
        if DEEP.search(content):  # the parser would take hours
            raise RecursionError
        return tomllib.loads(content.decode())
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text; save it as UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not valid TOML: {error}; correct the line named") from None
    except ValueError:  # of Python, which reads no whole numbers of thousands of digits
        raise InputError(f"{path}: is not valid TOML: a number of thousands of digits; give a shorter one") from None
    except RecursionError:
        raise InputError(f"{path}: is not valid TOML: nested too deeply; write it anew") from None


def checked(declaration: type[S], values: Mapping[str, Any], where: Path | str, prefix: str = "") -> S:
    """The table `values` as `declaration` has it. InputError, which begins with "where: prefix + key: "."""
    try:
        return declaration.model_validate(values)
    except ValidationError as error:
        raise InputError(f"{where}: {prefix}{_told(declaration, values, error)}") from None


def parsed(declaration: type[S], key: str, text: str | list[str]) -> Any:
    """The value of a setting, or those of a list, from what the command line says. ValueError."""
    field = declaration.model_fields[key]
    kind: Any = Annotated[field.annotation, field]
    return TypeAdapter(kind, config=declaration.model_config).validate_python(text, strict=False)


def error(where: Path | str, key: str, problem: str) -> InputError:
    """What else is wrong with a key, in the same form."""
    return InputError(f"{where}: {key}: {problem}")


def got(allowed: str, value: Any) -> str:
    """What a value should have been."""
    return f"expected {allowed}, got {shown(value)} instead"


def quoted(text: str) -> str:
    """A text without line breaks as TOML writes it."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def shown(value: Any) -> str:
    """A wrong value as a message repeats it: not more than the beginning of a long one."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to print whole numbers of thousands of digits
        text = "a number of thousands of digits"
    return text if len(text) <= SHOWN else text[:SHOWN] + "..."


def _told(declaration: type[Settings], values: Any, error: ValidationError) -> str:
    """ "key: problem" of the first mistake; a misspelt key comes before the one that is missing for it."""
    first = min(error.errors(include_url=False), key=lambda found: found["type"] != "extra_forbidden")
    root = schema.of(declaration)
    path, here, table, kind = "", root, root, first["type"]
    for place in first["loc"]:
        table = here
        if isinstance(place, str):
            path += f".{place}" if path else place
            here = schema.resolved(root, here.get("properties", {}).get(place, here.get("additionalProperties") or {}))
            values = values.get(place)
        elif "$ref" in here.get("items", {}):
            path += f"[{place}]"
            here, values = schema.resolved(root, here["items"]), values[place]
        else:  # of a list of plain values, which is shown as a whole
            kind = "value"
            break
    if isinstance(problem := first.get("ctx", {}).get("error"), Problem):
        return f"{'.'.join(filter(None, (path, problem.key)))}: {problem}"
    if kind == "missing":
        return f"{path}: missing; add {first['loc'][-1]} = <{schema.allowed(here)}>"
    if kind == "extra_forbidden":
        keys = list(table["properties"])
        hint = did_you_mean(str(first["loc"][-1]), keys)
        return f"{path}: unknown key{hint}; allowed here: {', '.join(keys)}; remove or correct it"
    return f"{path}: {got(schema.allowed(here), values)}"
