"""Errors that end a command in one line."""

import difflib
from collections.abc import Iterable
from importlib.util import find_spec


class InputError(ValueError):
    """A mistake in a file, key, value or command line.

    The message is one line that names the file, the key, the value, what is allowed and the remedy; the command
    lines print it and exit with status 2.
    """


class RunFailed(Exception):
    """Some runs ended in an error. The message names them in one line."""


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """Return "; did you mean ...?" with the most similar of `choices`; "" if none is similar."""
    close = difflib.get_close_matches(word, list(choices), n=1)
    return f"; did you mean {close[0]}?" if close else ""


def need(what: str, extra: str, *modules: str) -> None:
    """Check that the `modules` of an extra of pyproject.toml, which `what` needs, are installed. Raises InputError."""
    if missing := [module for module in modules if find_spec(module) is None]:
        raise InputError(
            f"{what}: needs {', '.join(missing)}; install the extra {extra} with: pip install -e '.[{extra}]'"
        )
