"""Lists of controllers as users give them: one name, several, or patterns such as dpc-*."""

from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase

from nmfd.controllers import custom
from nmfd.errors import InputError


def chosen(
    given: str | Sequence[str],
    check: Callable[[str], object],
    ready: Callable[[], Iterable[str]],
    where: str = "controllers",
) -> list[str]:
    """The controllers in `given`: names and patterns (*, ?, [...]), as a sequence or separated by commas.

    check: raises InputError for an unknown name; ready: the names that a pattern stands for, as far as they match and
    are not given besides. InputError for an unknown or repeated name, none at all, and a pattern without a match.
    """
    words = [word.strip() for word in given.split(",")] if isinstance(given, str) else list(given)
    if isinstance(given, str) and len(words) > 1 and not words[-1]:  # a trailing comma
        words.pop()
    if not any(words):
        raise InputError(f"{where}: expected at least one controller, got none; name one, such as no-control")
    named = [word for word in words if not _is_pattern(word)]
    for word in named:
        if not word:
            raise InputError(f"{where}: expected a name between commas, got {given!r} instead; omit one comma")
        check(word)
    if repeated := [word for n, word in enumerate(named) if word in named[:n]]:
        raise InputError(f"{where}: {repeated[0]} is there twice; name every controller once")
    found: list[str] = []
    for word in words:
        matching = [word] if word in named else _matching(word, tuple(ready()), where)
        found += [name for name in matching if name == word or name not in (*named, *found)]
    return found


def _matching(pattern: str, names: Sequence[str], where: str) -> list[str]:
    found = [name for name in names if fnmatchcase(name, pattern)]
    if not found:
        raise InputError(
            f"{where}: no controller here matches {pattern!r}; there are {', '.join(names)}, and others once their "
            "policies are trained"
        )
    return found


def _is_pattern(word: str) -> bool:
    return any(sign in word for sign in "*?[") and not custom.is_file(word)
