"""Generated TOML files with one thing wrong each: what a user may hand in by mistake."""

import re
from collections.abc import Iterator

ASSIGNMENT = re.compile(r"^(?P<key>[A-Za-z_]+)\s*=\s*(?P<value>[^#]*?)\s*(?P<comment>#.*)?$")
HEADER = re.compile(r"^\[\[?(?P<name>[^\]]+)\]\]?")
# Values that no key takes whose value has this kind.
WRONG = {
    "number": ['"12"', "true", "nan", "[1.0]", "{}"],
    "text": ["17", "[]", '"line\\nbreak"'],
    "list": ["5", '["x"]', "[nan, nan]", "{}"],
    "flag": ["1", '"true"'],
}


def kind(value: str) -> str:
    """Return number, text, list or flag: the kind of a value in a TOML file."""
    if value in ("true", "false"):
        return "flag"
    return {'"': "text", "[": "list"}.get(value[:1], "number")


def assignments(text: str) -> list[tuple[int, str, str, str]]:
    """Return (line, table, key, value) of every key in its first table, except for texts of several
    lines."""
    table, keys, inside = "", {}, False
    for number, line in enumerate(text.splitlines()):
        if '"""' in line:
            inside = not inside if line.count('"""') == 1 else inside
        elif not inside and (header := HEADER.match(line)):
            table = header["name"]
        elif not inside and (match := ASSIGNMENT.match(line)):
            keys.setdefault((table, match["key"]), (number, table, match["key"], match["value"]))
    return list(keys.values())


def with_line(text: str, number: int, line: str | None) -> str:
    """Return `text` with another line, or without it."""
    lines = text.splitlines()
    lines[number : number + 1] = [] if line is None else [line]
    return "\n".join(lines) + "\n"


def wrong_files(text: str, required: tuple = ()) -> Iterator[tuple[str, str]]:
    """Yield (problem, file): every key with wrong values, twice and misspelt; without each of the
    `required` keys."""
    for number, table, key, value in assignments(text):
        for wrong in WRONG[kind(value)]:
            yield f"{table}.{key} = {wrong[:20]}", with_line(text, number, f"{key} = {wrong}")
        yield f"{table}.{key} twice", with_line(text, number, f"{key} = {value}\n{key} = {value}")
        yield f"{table}.{key} misspelt", with_line(text, number, f"{key}_ = {value}")
        if (table, key) in required:
            yield f"{table}.{key} missing", with_line(text, number, None)
