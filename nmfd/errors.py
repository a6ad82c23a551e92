"""The errors that end a command in one line."""


class InputError(ValueError):
    """A mistake in a file, key, value or command line.

    The message is one line that names the file, the key, the value, what is allowed and the remedy; the command
    lines print it and exit with status 2.
    """


class RunFailed(Exception):
    """Some runs ended in an error. The message names them in one line."""
