"""Folders for files that nobody needs afterwards.

A killed process leaves its folder behind. Whoever makes the next one removes those whose process has ended: it had a
lock on its folder, and the system lets go of that however it ended.
"""

import shutil
import tempfile
from contextlib import suppress
from glob import escape
from pathlib import Path

from filelock import FileLock, Timeout

LOCK = ".scratch"  # not the name of any other file: folders that have one, locked by nobody, are removed


class Scratch:
    """A new folder, there until `close`, the end of a `with` block (which gets its path), or that of this process."""

    def __init__(self, prefix: str, *, where: Path | None = None):
        """prefix: of its name, and of those that are looked at; where: the system's place for such folders if None"""
        where = Path(tempfile.gettempdir()) if where is None else where
        sweep(where, prefix)
        while True:
            self._folder = tempfile.TemporaryDirectory(prefix=prefix, dir=where, ignore_cleanup_errors=True)
            self.path = Path(self._folder.name)
            self._lock = FileLock(self.path / LOCK, timeout=0)
            try:
                self._lock.acquire()
                return
            except (Timeout, FileNotFoundError):  # somebody takes it for an old one, before it was locked
                continue
            except OSError:  # a file system without locks: nothing is ever removed there
                return

    def close(self) -> None:
        """Remove it."""
        self._lock.release()
        self._folder.cleanup()

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_: object) -> None:
        self.close()


def sweep(where: Path, prefix: str) -> None:
    """Remove the folders in `where` with this prefix whose processes have ended."""
    for lock in where.glob(f"{escape(prefix)}*/{LOCK}"):
        with suppress(OSError, Timeout):
            with FileLock(lock, timeout=0):
                shutil.rmtree(lock.parent, ignore_errors=True)
            shutil.rmtree(lock.parent, ignore_errors=True)  # Windows keeps what is open
