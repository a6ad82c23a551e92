"""The command reference of `cosim`."""

from pathlib import Path

import click

from nmfd.cli.options import FOLDER


@click.command()
@click.argument("folder", type=FOLDER, default=".")
def reference(folder: Path) -> None:
    """Write the reference of scenario.toml and network.toml, and the JSON schemas that editors complete from.

    They go to README.md and *.schema.json in the folders scenarios and networks of FOLDER. What is written by hand in
    the pages stays. Editors that know Taplo, such as VS Code with Even Better TOML, find the schema by the first line
    of a file: #:schema ../scenario.schema.json

    \b
    Example:
      cosim reference
    """
    from cosim.report.reference import files  # the declarations of all controllers: torch

    for path, text in files(folder).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        click.echo(path)
