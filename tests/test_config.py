"""Declared settings: what is wrong is one line that names key, value and what is allowed."""

import datetime
import math

import pytest

from nmfd.errors import InputError
from nmfd.runs import config
from nmfd.runs.config import Numbers, PositiveNumbers, Rows, Settings, Share, Text, Texts, setting, whole


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


@pytest.mark.parametrize(
    "values, message",
    [
        ({"share": "0.5"}, "share: expected a number in [0, 1], got '0.5' instead"),
        ({"share": True}, "share: expected a number in [0, 1], got True instead"),
        ({"share": math.nan}, "share: expected a number in [0, 1], got nan instead"),
        ({"share": 1.5}, "share: expected a number in [0, 1], got 1.5 instead"),
        ({"share": 10**400}, "share: expected a number in [0, 1], got 1000"),
        ({"count": 1.0}, "count: expected a whole number from 1 to 10, got 1.0 instead"),
        (
            {"count": 10**5000},
            "count: expected a whole number from 1 to 10, got a number of thousands of digits instead",
        ),
        ({"count": False}, "count: expected a whole number from 1 to 10, got False instead"),
        ({"flag": 1}, "flag: expected true or false, got 1 instead"),
        ({"name": ""}, "name: expected text in quotes of 1 to 1000 printable characters, got '' instead"),
        ({"name": "a\nb"}, "name: expected text in quotes of 1 to 1000 printable characters, got 'a\\nb' instead"),
        ({"name": 2000 * "x"}, "name: expected text in quotes of 1 to 1000 printable characters, got 'xxx"),
        ({"name": datetime.date(1979, 5, 27)}, "name: expected text in quotes"),
        ({"names": ["a", "a"]}, "names: expected a list of distinct texts in quotes, got ['a', 'a'] instead"),
        ({"names": "a"}, "names: expected a list of distinct texts in quotes, got 'a' instead"),
        ({"numbers": [1, [2]]}, "numbers: expected a list of numbers, got [1, [2]] instead"),
        ({"gains": [1, 0]}, "gains: expected a list of numbers above 0, got [1, 0] instead"),
        ({"rows": [{"speed": 1}, {"speed": 0}]}, "rows[1].speed: expected a number above 0, got 0 instead"),
        ({"rows": [{}]}, "rows[0].speed: missing; add speed = <a number above 0>"),
        ({"rows": {}}, "rows: expected a list of tables, got {} instead"),
        ({"rows": [3]}, "rows[0]: expected a table, got 3 instead"),
        ({"table": []}, "table: expected a table, got [] instead"),
        ({"table": {"sped": 3.0}}, "table.sped: unknown key; did you mean speed?; allowed here: speed; remove or "),
        (
            {"quux": 3},
            "quux: unknown key; allowed here: share, count, flag, name, names, numbers, gains, rows, table; ",
        ),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)
def test_mistakes(values, message):
    with pytest.raises(InputError) as caught:
        config.checked(Table, values, "file.toml", "sumo.")
    assert str(caught.value).startswith(f"file.toml: sumo.{message}") and "\n" not in str(caught.value)


def test_what_is_right_is_taken():
    table = config.checked(Table, {"share": 1, "numbers": [1, 2.5], "rows": [{"speed": 3}]}, "file.toml")
    assert (table.share, table.numbers, table.rows[0].speed, table.count) == (1.0, (1.0, 2.5), 3.0, 3)
    assert isinstance(table.share, float) and table.changed(count=4).count == 4


def test_changes_are_checked_too():
    with pytest.raises(InputError, match="settings: count: expected a whole number from 1 to 10, got 11 instead"):
        Table().changed(count=11)
