"""What the command lines `nmfd` and `cosim` share: every user error ends in one clear line and exit status 2."""

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import click

from nmfd.errors import InputError, RunFailed


class Interrupted(Exception):
    """Ctrl-C or SIGTERM. The message says in one line what was kept and how to go on."""


class Commands(click.Group):
    """A click group with the project's manners; use it as `@click.group(name="cosim", cls=Commands)`.

    InputError, mistakes on the command line, and files that cannot be written or read: status 2.
    RunFailed: status 1. Ctrl-C: status 130, SIGTERM 143, which is the same to commands: a KeyboardInterrupt; one that
    has something to say about it raises Interrupted.
    All these give one line on stderr, `<name>: error: ...`; anything else is a bug and keeps its traceback.
    Without arguments the help is shown.
    """

    # Not click's signature: the parameters that it has besides these go through `extra`.
    def main(  # type: ignore[override]
        self, args: Sequence[str] | None = None, prog_name: str | None = None, **extra: Any
    ) -> NoReturn:
        """Run the command that `args` name, and exit."""
        arguments = list(sys.argv[1:] if args is None else args) or ["--help"]
        extra["standalone_mode"] = False
        with _told_to_end() as told:
            try:
                _check_texts(arguments)
                result = super().main(arguments, self.name, **extra)
                if signal.SIGTERM in told:  # a command that makes do with what it has found
                    raise Interrupted("interrupted")
            except (Exception, KeyboardInterrupt) as error:
                text, status = _verdict(error)
                if told and not isinstance(error, Interrupted):  # compiled libraries make an error of their own of it
                    text, status = "interrupted", 130
                if text is None:
                    raise
                click.echo(f"{self.name}: {_printable(text)}", err=True)
                sys.exit(128 + told[-1] if told and status == 130 else status)
        # Outside its standalone mode click returns what the command returned, or an exit status.
        sys.exit(result if isinstance(result, int) else 0)

    def invoke(self, ctx: click.Context) -> Any:
        """As click does, but for Ctrl-C."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:  # before click sees it, which would print an empty line first
            raise Interrupted("interrupted") from None


@contextmanager
def _told_to_end() -> Iterator[list[int]]:
    """SIGTERM is a KeyboardInterrupt in here, as Ctrl-C is; the list then holds which it was.

    A second SIGTERM makes no difference. Where Ctrl-C is ignored or somebody else's, as in a notebook, it stays so.
    """
    told: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield told
        return

    def end(number: int, _: object) -> None:
        if number == signal.SIGTERM:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        told.append(number)
        raise KeyboardInterrupt

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, end)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        before[signal.SIGINT] = signal.signal(signal.SIGINT, end)
    try:
        yield told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


def _check_texts(arguments: Sequence[str]) -> None:
    """InputError for what cannot be the name of anything here: run folders hold their names as UTF-8 text."""
    for argument in arguments:
        try:
            argument.encode()
        except UnicodeEncodeError:
            raise InputError(f"{_printable(argument)}: is not UTF-8 text; choose another name") from None
        if "\0" in argument:
            raise InputError(f"{_printable(argument)}: holds a zero byte; choose another name")


def _printable(text: str) -> str:
    """On one line, and what a terminal cannot or should not show as ?."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))


def _verdict(error: BaseException) -> tuple[str | None, int]:
    """The line for `error` and the exit status; None for a bug."""
    match error:
        case Interrupted():
            return str(error), 130
        case click.Abort() | KeyboardInterrupt():
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
