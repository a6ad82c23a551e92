"""The command get of `cosim`."""

from pathlib import Path

import click

from nmfd.cli.options import FOLDER
from nmfd.cli.progress import progress_line


@click.command()
@click.argument("name", required=False)
@click.option("--out", type=FOLDER, metavar="DIR", help="A new folder. [default: cities/NAME]")
def get(name: str | None, out: Path | None) -> None:
    """Fetch a city of others from where it is published; without NAME, list them.

    Its licence is named and kept beside it, and its content is checked: against the hash that its publisher names,
    or, where none is published, against that of the first download (SHA256SUMS beside the folders). Bologna needs no
    fetching: it is a scenario here.

    \b
    Examples:
      cosim get
      cosim get cologne8
      cosim import cities/cologne8/cologne8.sumocfg --regions 3 --out networks/cologne8
    """
    from cosim.importing import download

    if name is None:
        click.echo(download.listed())
        return
    with progress_line("get") as progress:
        text = download.get(name, Path("cities") / name if out is None else out, lambda stage: progress(0, 1, stage))
    click.echo(text)
