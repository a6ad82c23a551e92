"""Declared settings: what is wrong is one line that names key, value and what is allowed."""

import datetime
import math

import pytest
from commands import problem
from pydantic import model_validator

from nmfd.errors import InputError
from nmfd.runs import config
from nmfd.runs.config import (
    Numbers,
    PositiveNumbers,
    Problem,
    Rows,
    Settings,
    Share,
    Text,
    Texts,
    setting,
    whole,
)


class Row(Settings):
    speed: float = setting("of the row", unit="m/s", gt=0.0)


class Table(Settings):
    share: Share = setting("of all", 0.5)
    count: int = whole("of them", 3, low=1, high=10)
    flag: bool = setting("or not", False)
    name: Text | None = setting("of it", None)
    names: Texts = setting("of them", ())
    numbers: Numbers = setting("of it", ())
    gains: PositiveNumbers = setting("of it", ())
    rows: Rows[Row] = setting("of it", ())
    table: Row | None = setting("in it", None)

    @model_validator(mode="after")
    def _one(self):
        if self.count == 7:
            raise Problem("a.b", "takes both; omit one")
        return self


@pytest.mark.parametrize(
    "values, message",
    [
        ({"share": "0.5"}, "share: should be a valid number, got '0.5'"),
        ({"share": math.nan}, "share: should be a finite number, got nan"),
        ({"share": 1.5}, "share: should be less than or equal to 1, got 1.5"),
        ({"count": 1.0}, "count: should be a valid integer, got 1.0"),
        ({"flag": 1}, "flag: should be a valid boolean, got 1"),
        ({"name": ""}, "name: should have at least 1 character, got ''"),
        ({"name": "a\nb"}, "name: should be printable text on one line, got 'a\\nb'"),
        ({"name": datetime.date(1979, 5, 27)}, "name: should be a valid string, got datetime.date"),
        ({"names": ["a", "a"]}, "names: should be distinct values, got ['a', 'a']"),
        ({"numbers": [1, [2]]}, "numbers[1]: should be a valid number, got [2]"),
        ({"gains": [1, 0]}, "gains[1]: should be greater than 0, got 0"),
        ({"rows": [{"speed": 1}, {"speed": 0}]}, "rows[1].speed: should be greater than 0, got 0"),
        ({"rows": [{}]}, "rows[0].speed: missing; add it"),
        ({"rows": [3]}, "rows[0]: should be a valid table, got 3"),
        (
            {"rows": [{"sped": 3.0}]},
            "rows[0].sped: unknown key; did you mean speed?; allowed here: speed; remove or ",
        ),
        (
            {"table": {"sped": 3.0}},
            "table.sped: unknown key; did you mean speed?; allowed here: speed; remove or ",
        ),
        (
            {"quux": 3},
            "quux: unknown key; allowed here: share, count, flag, name, names, numbers, gains, "
            "rows, table",
        ),
        ({"count": 7}, "a.b: takes both; omit one"),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)
def test_mistakes(values, message):
    line = problem(config.checked, Table, values, "file.toml", "sumo.")
    assert line.startswith(f"file.toml: sumo.{message}")


def test_valid_values_and_changes():
    table = config.checked(
        Table, {"share": 1, "numbers": [1, 2.5], "rows": [{"speed": 3}]}, "file.toml"
    )
    assert (table.share, table.numbers, table.rows[0].speed, table.count) == (
        1.0,
        (1.0, 2.5),
        3.0,
        3,
    )
    assert isinstance(table.share, float)
    assert table.changed(count=4).count == 4
    with pytest.raises(
        InputError, match="settings: count: should be less than or equal to 10, got 11"
    ):
        Table().changed(count=11)


@pytest.mark.parametrize(
    "content, message",
    [
        (b"x = ", "is not valid TOML: Invalid value"),
        (b"\xff\xfex", "is not valid TOML: 'utf-8' codec"),
        (b"x = 1\nx = 2", "is not valid TOML: Cannot overwrite"),
        (b"x = " + 5000 * b"[", "is not valid TOML: "),
        (None, "no such file; did you mean city?; give the path"),
    ],
)
def test_files(tmp_path, content, message):
    (tmp_path / "city").mkdir()
    (tmp_path / "city" / "network.toml").touch()
    file = tmp_path / "citty" / "network.toml"
    if content is not None:
        file.parent.mkdir()
        file.write_bytes(content)
    assert problem(config.read, file).startswith(f"{file}: {message}")
