"""Options that commands of `cosim` share."""

import click

from nmfd.cli.options import FILE
from nmfd.errors import InputError

CONTROLLER_HELP = (
    "no-control, pi-gating, mpc-pc, mpc-pcrg, dpc-pc or dpc-pcrg; what else the city does is joined by +: webster, "
    "actuated, max-pressure or max-pressure-cyclic signals, rerouting-N (percent of the drivers), guided (drivers "
    "follow travel times), hold-back or redistribute, compliance-N, guidance-period-N (guided drivers are asked again "
    "every N seconds), queue-override-N, estimate. A controller of your own: file.py:Class (see nmfd new-controller).")
CONTROLLER = click.option("--controller", required=True, metavar="NAME[+...]", help=CONTROLLER_HELP)
POLICY = click.option(
    "--policy", type=FILE, metavar="FILE", help="Policy of a DPC controller, if not SCENARIO/NAME.pt.")
REFERENCE = click.option(
    "--reference", metavar="NAME",
    help="Pair all controllers with this one too, besides no-control, or the first one if that is not there.")


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
