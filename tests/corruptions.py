"""Files and command lines with one thing wrong, generated and seeded: what a user may hand in by mistake."""

import random
import re
from collections.abc import Iterator

ASSIGNMENT = re.compile(r"^(?P<key>[A-Za-z_]+)\s*=\s*(?P<value>[^#]*?)\s*(?P<comment>#.*)?$")
HEADER = re.compile(r"^\[\[?(?P<name>[^\]]+)\]\]?")
# What no key takes that holds a value of this kind now. Of every kind: nothing, another type, a nested one.
WRONG = {
    "number": ['"12"', "true", "nan", "inf", "-inf", "[1.0]", "{}", "1979-05-27", '""', "1" + 400 * "0"],
    "text": ["17", "true", "[]", "{ a = 1 }", '"\\u0000"', '"' + 300 * "x" + '/"', '"line\\nbreak"'],
    "list": ["5", '"12"', '["x"]', "[nan, nan]", "[1, [2]]", "{}", "[true]", "[-1e999, 0]"],
    "flag": ["1", '"true"', "[true]", "nan"],
}


def kind(value: str) -> str:
    """number, text, list or flag: of a value in a TOML file."""
    if value in ("true", "false"):
        return "flag"
    return {'"': "text", "[": "list"}.get(value[:1], "number")


def assignments(text: str) -> list[tuple[int, str, str, str]]:
    """(line, table, key, value) of every key in its first table of that name, but for texts of several lines."""
    table, found, inside = "", {}, False
    for number, line in enumerate(text.splitlines()):
        if '"""' in line:
            inside = not inside if line.count('"""') == 1 else inside
        elif not inside and (header := HEADER.match(line)):
            table = header["name"]
        elif not inside and (match := ASSIGNMENT.match(line)):
            found.setdefault((table, match["key"]), (number, table, match["key"], match["value"]))
    return list(found.values())


def with_line(text: str, number: int, line: str | None) -> str:
    lines = text.splitlines()
    lines[number : number + 1] = [] if line is None else [line]
    return "\n".join(lines) + "\n"


def wrong_values(text: str) -> Iterator[tuple[str, str]]:
    """(what is wrong, the file) for every key of a TOML file: wrong values, written twice, misspelt."""
    for number, table, key, value in assignments(text):
        for wrong in WRONG[kind(value)]:
            yield f"{table}.{key} = {wrong[:20]}", with_line(text, number, f"{key} = {wrong}")
        yield f"{table}.{key} twice", with_line(text, number, f"{key} = {value}\n{key} = {value}")
        yield f"{table}.{key} misspelt", with_line(text, number, f"{key}_ = {value}")


def missing_keys(text: str, required: set[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Without each of the keys (table, key) that there must be."""
    for number, table, key, _ in assignments(text):
        if (table, key) in required:
            yield f"{table}.{key} missing", with_line(text, number, None)


def broken_files(content: bytes, seed: int) -> Iterator[tuple[str, bytes]]:
    """The file cut off, overwritten, emptied, of another encoding, of another format."""
    draw = random.Random(seed)
    yield "empty", b""
    yield "zeros", bytes(100)
    yield "noise", draw.randbytes(300)
    yield "another encoding", b"\xff\xfe" + content.decode().encode("utf-16-le")
    yield "a picture", b"\x89PNG\r\n\x1a\n" + draw.randbytes(60)
    yield "gzip", b"\x1f\x8b\x08\x00" + draw.randbytes(40)
    yield "nested", b"x = " + 5000 * b"["
    yield "nested tables", b"x = " + 5000 * b"{ a = "
    for _ in range(4):
        at = draw.randrange(len(content) // 2)
        yield f"bytes at {at}", content[:at] + draw.randbytes(12) + content[at + 12 :]


def cut(content: bytes, seed: int, count: int = 8) -> Iterator[tuple[str, bytes]]:
    """Cut off behind an equals sign: a file that was not copied to its end."""
    places = [match.end() for match in re.finditer(rb" = ", content)]
    for at in sorted(random.Random(seed).sample(places, min(count, len(places)))):
        yield f"cut at {at}", content[:at]
