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


def listing(*more: str) -> click.Command:
    """The command list. more: "module:function" of further kinds, each named like its function."""
    where = {kind: "nmfd.cli.catalogue" for kind in KINDS} | {
        kind: module for module, _, kind in (place.partition(":") for place in more)
    }

    @click.command(name="list")
    @click.argument("kinds", nargs=-1, type=click.Choice(list(where)), metavar=f"[{'|'.join(where)}]...")
    def command(kinds: tuple[str, ...]) -> None:
        """List what comes with the package, scenarios and networks, policies and controllers, with a line each.

        Scenarios and networks are named without a path, from any folder: nmfd benchmark economic_mpc, cosim run
        grid7_peak. A scenario of your own in a folder of that name goes before it. A policy is found by the name of the
        controller; where a file is asked for, it is called as it is here.

        \b
        Examples:
          nmfd list
          cosim list scenarios policies
        """
        for kind in kinds or where:
            click.echo(f"{kind}\n{_lines(getattr(import_module(where[kind]), kind)())}\n")  # heavy

    return command


def _lines(rows: Iterable[tuple[str, str]]) -> str:
    found = list(rows)
    width = max((len(name) for name, _ in found), default=0)
    return "\n".join(f"  {name:{width}}  {text}".rstrip() for name, text in found) or "  none"
