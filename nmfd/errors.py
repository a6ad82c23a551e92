"""Errors that end a command in one line, and the delay of Ctrl-C."""

import difflib
import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec


class InputError(ValueError):
    """Mistake in a file, key, value or command line.

    The message is one line that names the file, the key, the value, what is allowed and the remedy;
    the command lines print it and exit with status 2.
    """


class RunFailed(Exception):
    """Failure of some runs. The message names them in one line."""


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """Return "; did you mean ...?" with the most similar choice.

    Return "" if none is similar.
    """
    close = difflib.get_close_matches(word, list(choices), n=1)
    if not close:
        return ""
    return f"; did you mean {close[0]}?"


def need(what: str, extra: str, *modules: str) -> None:
    """Check that the modules of an optional dependency are installed.

    what: the part of the program that needs them
    extra: their group in pyproject.toml

    Raises: InputError
    """
    missing = [module for module in modules if find_spec(module) is None]
    if missing:
        raise InputError(
            f"{what}: needs {', '.join(missing)}; install the extra {extra} with: pip install -e "
            f"'.[{extra}]'"
        )


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of the block.

    It is for code that an interruption would leave with a lock held.
    """
    held = []
    before = {}
    # Python runs handlers in the main thread only, and lets no other thread set them.
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, lambda received, _: held.append(received))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if held:
            signal.raise_signal(held[0])
