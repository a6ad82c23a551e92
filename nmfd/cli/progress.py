"""One line of progress on stderr, where that is a terminal; silence elsewhere."""

import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

BAR = 24  # characters
INTERVAL = 0.1  # s, between two redraws: a fast loop must not spend its time on the terminal


class ProgressLine:
    """A callback `line(done, total)`, as `closed_loop.run` wants it, that redraws `label [###...] done/total`."""

    def __init__(self, label: str, stream: TextIO):
        self._label, self._stream = label, stream
        self._begin, self._drawn, self._width = time.monotonic(), -INTERVAL, 0

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """`note`, such as a validation loss, is put behind the remaining time."""
        now = time.monotonic()
        if now - self._drawn < INTERVAL and done < total:
            return
        self._drawn = now
        filled = BAR * done // max(total, 1)
        left = (now - self._begin) * (total - done) / done if done else 0.0
        parts = [self._label, f"[{'#' * filled}{'.' * (BAR - filled)}]", f"{done}/{total}"]
        parts += [f"{_clock(left)} left"] if 0 < done < total else []
        self._write("  ".join(parts + ([note] if note else [])))

    def clear(self) -> None:
        self._write("")
        self._stream.write("\r")
        self._stream.flush()

    def _write(self, text: str) -> None:
        text = text[:shutil.get_terminal_size().columns - 1]  # a line that wraps could not be drawn over
        self._stream.write("\r" + text.ljust(self._width))
        self._stream.flush()
        self._width = len(text)


@contextmanager
def progress_line(label: str, stream: TextIO | None = None) -> Iterator[ProgressLine | None]:
    """A ProgressLine that is wiped at the end; None if `stream` (default stderr) is no terminal."""
    stream = sys.stderr if stream is None else stream
    if not stream.isatty():
        yield None
        return
    line = ProgressLine(label, stream)
    try:
        yield line
    finally:
        line.clear()


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}" if minutes >= 60 else f"{minutes}:{seconds:02d}"
