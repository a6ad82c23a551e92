"""Command-line values that several commands of `nmfd` share."""

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from nmfd.cli.declared import declared
from nmfd.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from nmfd.controllers.strategy import Strategy

FOLDER = click.Path(path_type=Path, file_okay=False)
FILE = click.Path(path_type=Path, dir_okay=False)
SEED = click.IntRange(0, 2**31 - 1)  # SUMO's are 32 bits long

SCENARIO = click.argument("scenario", type=FOLDER)
STEPS = declared("nmfd.model.scenario:ScenarioTable", "steps", instead="the scenario's")
ADAM_STEPS = declared("nmfd.controllers.dpc.training:Training", "steps", instead="what scenario.toml says, else {}")
POLICIES = click.option(
    "--policy",
    "policies",
    multiple=True,
    metavar="NAME=FILE",
    help="The file of a policy (dpc-) or plan (bound-), if not SCENARIO/NAME.pt or .npz. May be repeated.",
)


def controllers_option(text: str, default: str | None = None) -> Callable[[Callable], Callable]:
    """--controllers, which is required without a default."""
    more = {"required": True} if default is None else {"default": default, "show_default": True}
    return click.option("--controllers", metavar="A,B,...", help=f"{text} In quotes also patterns: 'dpc-*'.", **more)


def out_option(kind: str = "<time>", text: str = "The run folder.") -> Callable[[Callable], Callable]:
    """--out, a folder."""
    return click.option("--out", type=FOLDER, metavar="DIR", help=f"{text} [default: runs/<scenario>-{kind}]")


def strategies_in(
    controllers: str, scenario: Path, *, regional: bool = True, where: str = "--controllers"
) -> "list[Strategy]":
    """Return the strategies in a list separated by commas, patterns replaced. Raise InputError."""
    from nmfd.api import load_scenario  # heavy
    from nmfd.controllers.strategy import parse_many

    return parse_many(controllers, load_scenario(scenario), regional=regional, where=where)


def policy_files(options: tuple[str, ...], strategies: "Sequence[Strategy]") -> dict[str, Path]:
    """NAME=FILE options as a table. InputError for another form, or a controller that is not run."""
    files: dict[str, Path] = {}
    names = [strategy.name for strategy in strategies]
    for option in options:
        name, equals, file = option.partition("=")
        if not equals or not file:
            raise InputError(f"--policy: expected NAME=FILE, such as dpc-pc=mine.pt, got {option!r} instead")
        if name not in names:
            raise InputError(
                f"--policy: {name!r} is not among --controllers {','.join(names)}"
                f"{did_you_mean(name, names)}; add it there"
            )
        if name in files:
            raise InputError(f"--policy: {name} is there twice; give one file for each controller")
        files[name] = Path(file)
    return files


def quoted(path: Path) -> str:
    """`path` as a shell reads it."""
    return shlex.quote(str(path))
