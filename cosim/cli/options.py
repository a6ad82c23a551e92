"""Options that commands of `cosim` share."""

import click

from nmfd.errors import InputError

CONTROLLER_HELP = (
    "no-control, pi-gating, mpc-pc, mpc-pcrg, dpc-pc or dpc-pcrg; what else the city does is joined by +: webster, "
    "actuated, max-pressure or max-pressure-cyclic signals, rerouting-N (percent of the drivers), hold-back or "
    "redistribute, compliance-N, guidance-period-N (guided drivers are asked again every N seconds), "
    "queue-override-N, estimate. A controller of your own: file.py:Class (see nmfd new-controller).")


def parsed_level(text: str, no_run: bool) -> float | None:
    """--level; None for auto. InputError for anything else."""
    if text == "auto":
        if no_run:
            raise InputError("--level: auto simulates the city, which --no-run forbids; omit one of them")
        return None
    try:
        (found,) = parsed_levels("--level", text)
    except (InputError, ValueError):
        raise InputError(f"--level: expected a number above 0 up to 10, or auto, got {text!r} instead") from None
    return found


def parsed_levels(option: str, text: str) -> list[float]:
    """Demand levels separated by commas. InputError for anything else."""
    try:
        levels = [float(level) for level in text.split(",")]
    except ValueError:
        levels = [0.0]
    if not all(0.0 < level <= 10.0 for level in levels):
        raise InputError(f"{option}: expected numbers above 0 up to 10, such as 0.6,0.8,1.0, got {text!r} instead")
    if len(set(levels)) < len(levels):
        raise InputError(f"{option}: {text!r} names a level twice; name every level once")
    return levels


def parsed_compliance(text: str | None) -> tuple[float, ...]:
    """Shares, of whole percentages separated by commas. InputError for anything else."""
    if text is None:
        return ()
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdigit() and int(part) <= 100 for part in parts):
        raise InputError(f"--compliance: expected whole percentages, such as 0,50,100, got {text!r} instead")
    if len(set(map(int, parts))) < len(parts):
        raise InputError(f"--compliance: {text!r} names a percentage twice; name every one once")
    return tuple(int(part) / 100 for part in parts)


def tell(line: str) -> None:
    """Print a line about the work, apart from its results."""
    click.echo(f"cosim: {line}", err=True)
