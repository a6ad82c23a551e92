"""Command-line values that several commands of `nmfd` share."""

import shlex
from collections.abc import Callable
from pathlib import Path

import click

from nmfd.cli.declared import Declared, declared
from nmfd.errors import InputError

FOLDER = click.Path(path_type=Path, file_okay=False)
FILE = click.Path(path_type=Path, dir_okay=False)
SEED = click.IntRange(0, 2**31 - 1)  # SUMO's are 32 bits long

SCENARIO = click.argument("scenario", type=FOLDER)
STEPS = declared("nmfd.model.scenario_file:ScenarioTable", "steps", instead="the scenario's")
TIME_LIMIT = click.option(
    "--time-limit", "own_time_limit", cls=Declared, declaration="nmfd.model.scenario_file:ScenarioTable",
    instead="the scenario's, else {}", metavar="SECONDS")
ADAM_STEPS = declared(
    "nmfd.controllers.dpc.options:Training", "steps", instead="what scenario.toml says, else {}")
POLICIES = click.option(
    "--policy", "policies", multiple=True, metavar="NAME=FILE",
    help="The file of a policy (dpc-) or plan (bound-), if not SCENARIO/NAME.pt or .npz. May be repeated.")
PARQUET = click.option("--parquet", is_flag=True, help="Write the tables as Parquet files too (nmfd.runs.frames).")


def controllers_option(text: str, default: str | None = None) -> Callable[[Callable], Callable]:
    """--controllers, which is required without a default."""
    more = {"required": True} if default is None else {"default": default, "show_default": True}
    return click.option("--controllers", metavar="A,B,...", help=text, **more)


def out_option(kind: str = "<time>", text: str = "The run folder.") -> Callable[[Callable], Callable]:
    """--out, a folder."""
    return click.option("--out", type=FOLDER, metavar="DIR", help=f"{text} [default: runs/<scenario>-{kind}]")


def fault_option(more: str = "") -> Callable[[Callable], Callable]:
    """--fault, which may be repeated. more: kinds besides those of every plant"""
    kinds = ("frozen, delayed:N, missing:REGION, detectors:SHARE, off:FACTOR, solver-fails, solver-diverges, "
             "solver-late, ")
    return click.option(
        "--fault", "faults", multiple=True, metavar="KIND[:VALUE][@FROM-TO]",
        help=f"Inject a fault, in the control intervals FROM to TO - 1: {kinds}policy-nan{', ' if more else ''}{more}. "
             "May be repeated; what is done instead is in the status of every decision.")


def controller_names(controllers: str, check: Callable[[str], object] | None = None) -> list[str]:
    """The controllers in a list separated by commas. InputError for an unknown, repeated or empty name.

    check: raises InputError for an unknown name; that of the regional controllers if None
    """
    from nmfd.controllers import registry  # heavy

    names = [name.strip() for name in controllers.split(",")]
    for name in names:
        (check or registry.check)(name)
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
