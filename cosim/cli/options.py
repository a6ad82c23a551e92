"""Options that commands of `cosim` share."""

import os
import sys
from collections.abc import Callable

import click

from nmfd.cli.options import FILE, FOLDER
from nmfd.errors import InputError

CONTROLLER_HELP = (
    "no-control, pi-gating, mpc-pc, mpc-pcrg, dpc-pc or dpc-pcrg; what else the city does is joined by +: webster, "
    "actuated, max-pressure or max-pressure-cyclic signals, rerouting-N (percent of the drivers), guided (drivers "
    "follow travel times), hold-back or redistribute, compliance-N, guidance-period-N (guided drivers are asked again "
    "every N seconds), queue-override-N, metering or metering-N (trips wait outside), short-first, estimate. A "
    "controller of your own: file.py:Class (see nmfd new-controller)."
)
CONTROLLER = click.option("--controller", required=True, metavar="NAME[+...]", help=CONTROLLER_HELP)
POLICY = click.option(
    "--policy", type=FILE, metavar="FILE", help="Policy of a DPC controller, if not SCENARIO/NAME.pt."
)
RUNS = click.option(
    "--runs",
    type=FOLDER,
    multiple=True,
    metavar="DIR",
    help="Finished runs of the same city that the model is fitted to besides, a folder of cosim run or evaluate: at a "
    "demand at which the loading runs lock, those under a gate say more. May be repeated.",
)


def scheduler_options(command: Callable) -> Callable:
    """Add --scheduler to a command."""
    return click.option(
        "--scheduler", metavar="ADDRESS", help="Dask scheduler that runs them, such as tls://host:8786 (extra dask)."
    )(command)


def chosen_scheduler(workers: int | None, address: str | None) -> str | None:
    """Return the Dask scheduler, None for processes here. Raise InputError if both are given."""
    if address is None:
        return None
    if workers is not None:
        raise InputError("--workers: is for processes here, and --scheduler has workers of its own; omit one")
    return address


def parsed_level(text: str, no_run: bool) -> float | None:
    """--level; None for auto. InputError for anything else."""
    if text == "auto":
        if no_run:
            raise InputError("--level: auto simulates the city, which --no-run forbids; omit one of them")
        return None
    from cosim.evaluation.settings import Window  # pydantic
    from nmfd.runs import config

    try:
        return config.parsed(Window, "demand", text)
    except ValueError:
        raise InputError(f"--level: expected a number above 0 up to 10, or auto, got {text!r} instead") from None


def tell(line: str) -> None:
    """Print a line about the work, apart from its results."""
    click.echo(f"cosim: {line}", err=True)


def has_screen() -> bool:
    """Whether a browser of this machine may be opened: somebody sits there, as far as one can tell."""
    screen = not sys.platform.startswith("linux") or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    return screen and sys.stdout.isatty()
