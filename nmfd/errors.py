"""The errors that end a command in one line."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """A mistake in a file, key, value or command line.

    The message is one line that names the file, the key, the value, what is allowed and the remedy; the command
    lines print it and exit with status 2.
    """


class RunFailed(Exception):
    """Some runs ended in an error. The message names them in one line."""


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """ "; did you mean ...?" with the one of `choices` that is written most like `word`; "" if none is."""
    close = difflib.get_close_matches(word, list(choices), n=1)
    return f"; did you mean {close[0]}?" if close else ""
