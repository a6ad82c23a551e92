"""The command that makes what is written now: for manifests and trails, and light enough for every `--help`."""

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

# Options that change no result, and where there are paths that concern nobody.
ELSEWHERE = re.compile(r"--(out|workers|scheduler(-ca|-cert|-key)?)(=.*)?")
_called: list[str] = []


@contextmanager
def called(program: str, arguments: Sequence[str]) -> Iterator[None]:
    """In here, this command is what makes all that is written."""
    words, left = [program], iter(arguments)
    for word in left:
        if found := ELSEWHERE.fullmatch(word):
            if found[3] is None:
                next(left, None)
        else:
            words.append(word)
    _called.append(shlex.join(words))
    try:
        yield
    finally:
        _called.pop()


def present() -> str | None:
    """The command of this process, None where it was not called by one."""
    return _called[-1] if _called else None
