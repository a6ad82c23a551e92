"""Command-line values that several commands of `nmfd` share."""

import shlex
from pathlib import Path

import click

from nmfd.errors import InputError

FOLDER = click.Path(path_type=Path, file_okay=False)
FILE = click.Path(path_type=Path, dir_okay=False)


def controller_names(controllers: str) -> list[str]:
    """The controllers in a list separated by commas. InputError for an unknown, repeated or empty name."""
    from nmfd.controllers import registry

    names = [name.strip() for name in controllers.split(",")]
    for name in names:
        registry.check(name)
    if repeated := [name for n, name in enumerate(names) if name in names[:n]]:
        raise InputError(f"--controllers: {repeated[0]} is there twice; name every controller once")
    return names


def policy_files(options: tuple[str, ...], names: list[str]) -> dict[str, Path]:
    """NAME=FILE options as a table. InputError for another form, or a controller that is not run."""
    files: dict[str, Path] = {}
    for option in options:
        name, equals, file = option.partition("=")
        if not equals or not file:
            raise InputError(f"--policy: expected NAME=FILE, such as dpc-pc=mine.pt, got {option!r} instead")
        if name not in names:
            raise InputError(f"--policy: {name!r} is not among --controllers {','.join(names)}; add it there")
        if name in files:
            raise InputError(f"--policy: {name} is there twice; give one file for each controller")
        files[name] = Path(file)
    return files


def quoted(path: Path) -> str:
    return shlex.quote(str(path))
