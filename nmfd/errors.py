"""Errors that end a command in one line, and the delay of Ctrl-C."""

import difflib
import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec


class InputError(ValueError):
    """A mistake in a file, key, value or command line.

    The message is one line that names the file, the key, the value, what is allowed and the remedy;
    the command lines print it and exit with status 2.
    """


class RunFailed(Exception):
    """Some runs ended in an error. The message names them in one line."""


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """Return "; did you mean ...?" with the most similar of `choices`; "" if none is similar."""
    close = difflib.get_close_matches(word, list(choices), n=1)
    return f"; did you mean {close[0]}?" if close else ""


def need(what: str, extra: str, *modules: str) -> None:
    """Check that the `modules` of an extra of pyproject.toml, which `what` needs, are installed.
    Raises InputError."""
    if missing := [module for module in modules if find_spec(module) is None]:
        raise InputError(
            f"{what}: needs {', '.join(missing)}; install the extra {extra} with: pip install -e '.[{extra}]'"
        )


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of the block, for code that they would leave with a
    lock held."""
    held: list[int] = []
    numbers = (
        (signal.SIGINT, signal.SIGTERM)
        if threading.current_thread() is threading.main_thread()
        else ()
    )
    before = {
        number: signal.signal(number, lambda received, _: held.append(received))
        for number in numbers
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for received in held[:1]:
            signal.raise_signal(received)
