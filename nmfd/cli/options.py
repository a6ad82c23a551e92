"""Command-line values that several commands of `nmfd` share."""

import math
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from nmfd.errors import InputError

FOLDER = click.Path(path_type=Path, file_okay=False)
FILE = click.Path(path_type=Path, dir_okay=False)
SEED = click.IntRange(0, 2**31 - 1)  # SUMO's are 32 bits long
COUNT = click.IntRange(1, 10**6)


class Positive(click.FloatRange):
    """Above 0, or from it, and up to `most`; not NaN, which click lets pass."""

    def __init__(self, most: float, *, zero: bool = False):
        super().__init__(0.0, most, min_open=not zero)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number. A usage error for one out of the range."""
        number = super().convert(value, param, ctx)
        if math.isnan(number):
            self.fail(f"{value} is not in the range {self._describe_range()}.", param, ctx)
        return number


POSITIVE = Positive(1e6)
LEVEL = Positive(10.0)  # of demand


def time_limit_option() -> Callable[[Callable], Callable]:
    """--time-limit"""
    return click.option(
        "--time-limit", type=Positive(1e6, zero=True), metavar="SECONDS",
        help="Of every call of a controller of your own, in which its run is ended; 0: none. [default: the scenario's "
             "own_time_limit, else 600]")


def fault_option(more: str = "") -> Callable[[Callable], Callable]:
    """--fault, which may be repeated. more: kinds besides those of every plant"""
    kinds = ("frozen, delayed:N, missing:REGION, detectors:SHARE, off:FACTOR, solver-fails, solver-diverges, "
             "solver-late, ")
    return click.option(
        "--fault", "faults", multiple=True, metavar="KIND[:VALUE][@FROM-TO]",
        help=f"Inject a fault, in the control intervals FROM to TO - 1: {kinds}policy-nan{', ' if more else ''}{more}. "
             "May be repeated; what is done instead is in the status of every decision.")


def controller_names(controllers: str) -> list[str]:
    """The controllers in a list separated by commas. InputError for an unknown, repeated or empty name."""
    from nmfd.controllers import registry  # heavy

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
    """`path` as a shell reads it."""
    return shlex.quote(str(path))


def whole_numbers(option: str, text: str, example: str) -> list[int]:
    """Different whole numbers from 2 up in a list separated by commas. InputError for anything else."""
    parts = [part.strip() for part in text.split(",")]
    values = [int(part) if part.isdecimal() and len(part) < 7 else 0 for part in parts]
    if min(values) < 2 or len(set(values)) < len(values):
        raise InputError(
            f"{option}: expected different whole numbers from 2 up, such as {example}, got {text!r} instead")
    return values
