"""What the commands tell of themselves and of what comes with the package: --version, --cite, list."""

from collections.abc import Callable, Iterable
from importlib import import_module, resources

import click

from nmfd import __version__

KINDS = ("scenarios", "networks", "policies", "controllers")


def about(name: str) -> Callable[[Callable], Callable]:
    """--version and --cite of the command line `name`."""

    def cite(context: click.Context, _: click.Parameter, wanted: bool) -> None:
        if wanted and not context.resilient_parsing:
            text = resources.files("nmfd").joinpath("CITATION.cff").read_text(encoding="utf-8")
            click.echo(f"{text}version: {__version__}")
            context.exit()

    def decorate(command: Callable) -> Callable:
        command = click.option(
            "--cite",
            is_flag=True,
            expose_value=False,
            is_eager=True,
            callback=cite,
            help="Show how to cite this software, as CITATION.cff, and exit.",
        )(command)
        return click.version_option(__version__, prog_name=name)(command)

    return decorate


def overview() -> str:
    """List the shipped scenarios, networks, policies and controllers, one line each."""
    catalogue = import_module("nmfd.cli.catalogue")  # heavy
    return "\n\n".join(f"{kind}\n{_lines(getattr(catalogue, kind)())}" for kind in KINDS)


def _lines(rows: Iterable[tuple[str, str]]) -> str:
    found = list(rows)
    width = max((len(name) for name, _ in found), default=0)
    return "\n".join(f"  {name:{width}}  {text}".rstrip() for name, text in found) or "  none"
