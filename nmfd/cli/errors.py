"""What the command lines `nmfd` and `cosim` share: every user error ends in one clear line and exit status 2."""

import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import click

from nmfd.errors import InputError, RunFailed


class Interrupted(Exception):
    """Ctrl-C. The message says in one line what was kept and how to go on."""


class Commands(click.Group):
    """A click group with the project's manners; use it as `@click.group(name="cosim", cls=Commands)`.

    InputError, mistakes on the command line, and files that cannot be written or read: status 2.
    RunFailed: status 1. Ctrl-C: status 130; a command that has something to say about it raises Interrupted.
    All these give one line on stderr, `<name>: error: ...`; anything else is a bug and keeps its traceback.
    Without arguments the help is shown.
    """

    # Not click's signature: the parameters that it has besides these go through `extra`.
    def main(  # type: ignore[override]
        self, args: Sequence[str] | None = None, prog_name: str | None = None, **extra: Any,
    ) -> NoReturn:
        """Run the command that `args` name, and exit."""
        arguments = list(sys.argv[1:] if args is None else args) or ["--help"]
        extra["standalone_mode"] = False
        try:
            result = super().main(arguments, self.name, **extra)
        except Exception as error:
            text, status = _verdict(error)
            if text is None:
                raise
            click.echo(f"{self.name}: {' '.join(text.split())}", err=True)
            sys.exit(status)
        # Outside its standalone mode click returns what the command returned, or an exit status.
        sys.exit(result if isinstance(result, int) else 0)

    def invoke(self, ctx: click.Context) -> Any:
        """As click does, but for Ctrl-C."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:  # before click sees it, which would print an empty line first
            raise Interrupted("interrupted") from None


def _verdict(error: Exception) -> tuple[str | None, int]:
    """The line for `error` and the exit status; None for a bug."""
    match error:
        case Interrupted():
            return str(error), 130
        case click.Abort():
            return "interrupted", 130
        case RunFailed():
            return f"error: {error}", 1
        case InputError():
            return f"error: {error}", 2
        case click.ClickException():
            context = getattr(error, "ctx", None)
            hint = f" (see '{context.command_path} --help')" if context else ""
            return f"error: {error.format_message()}{hint}", 2
        case OSError():
            return f"error: {error.filename}: {error.strerror}" if error.filename else f"error: {error}", 2
    return None, 1
