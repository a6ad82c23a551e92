"""The one error that a user can cause."""


class InputError(ValueError):
    """A mistake in a file, key, value or command line.

    The message is one line that names the file, the key, the value, what is allowed and the remedy; the command
    lines print it and exit with status 2.
    """
