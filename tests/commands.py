"""Commands, called in this process as a user calls them, and what is said of wrong input."""

from functools import partial
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

import cosim.cli
import nmfd.cli
from nmfd.errors import InputError
from nmfd.types import Result as Run

MAINS = {"nmfd": nmfd.cli.main, "cosim": cosim.cli.main}


def words(*arguments) -> list[str]:
    """Return the words of a command line: those of texts; a path or number is one word."""
    found = []
    for argument in arguments:
        found += argument.split() if isinstance(argument, str) else [str(argument)]
    return found


def call(program: str, *arguments) -> Result:
    return CliRunner().invoke(MAINS[program], words(*arguments))


nmfd, cosim = (partial(call, program) for program in MAINS)


def good(result: Result) -> str:
    """Return the output of a command that ended well."""
    assert result.exit_code == 0, result.output + result.stderr + repr(result.exception)
    return result.stdout


def runs(folder: Path) -> dict:
    """Return path -> Dataset without times of every run below a folder."""
    files = folder.rglob("[!.]*.nc")
    return {str(file.relative_to(folder)): Run.read(file).without_times() for file in files}


def same(left: dict, right: dict) -> bool:
    return set(left) == set(right) and all(left[name].identical(right[name]) for name in left)


def last_words(result: Result, code: int) -> str:
    """Return the one line of stderr with which a command ended in this exit code."""
    assert result.exit_code == code, result.output + repr(result.exception)
    [line] = result.stderr.splitlines()
    return line


def error_line(result: Result, program: str = "cosim") -> str:
    """Return the line that a command ended with: ours alone, or the last one of click."""
    assert result.exit_code == 2, result.output + repr(result.exception)
    *others, line = result.stderr.splitlines()
    assert line.startswith("Error: ") or (line.startswith(f"{program}: error: ") and not others), (
        result.stderr
    )
    return line


def problem(read, *arguments, **options) -> str:
    """Return the one line of the InputError that `read` raises."""
    with pytest.raises(InputError) as caught:
        read(*arguments, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)
