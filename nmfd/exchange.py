"""Commands of `nmfd` for what comes from elsewhere and goes there: controllers of one's own."""

from pathlib import Path

import click

from nmfd.errors import InputError
from nmfd.options import FILE, quoted


@click.command(name="new-controller")
@click.argument("file", type=FILE)
def new_controller(file: Path) -> None:
    """Write a commented controller to begin with. Any command takes it as FILE:Class instead of a controller's name.

    A package may offer controllers too, by name: entry points of the group nmfd.controllers.

    \b
    Example:
      nmfd new-controller mine.py
      nmfd benchmark scenarios/economic_mpc --controllers no-control,pi-gating,mine.py:MyController
    """
    from importlib import resources

    if file.suffix != ".py":
        raise InputError(f"{file}: expected a name that ends in .py, such as {file.with_suffix('.py')}")
    if file.exists():
        raise InputError(f"{file}: is there already; choose another name")
    if not file.parent.is_dir():
        raise InputError(f"{file.parent}: no such folder; make it first")
    text = resources.files("nmfd.controllers").joinpath("template.py").read_text(encoding="utf-8")
    file.write_text(text.replace("FILE", str(file)), encoding="utf-8")
    click.echo(f"Written to {file}; try it with: nmfd benchmark scenarios/economic_mpc "
               f"--controllers no-control,pi-gating,{quoted(file)}:MyController")
