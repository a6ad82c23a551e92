"""How much of the processor the server of the live page may take, however many look."""

import time
from collections.abc import Callable

SHARE = 0.2  # of a core, for pages and pictures
SAVED = 2.0  # s of processor time that may be spent at once: the first few pages
PAGE = 0.7  # s that one page takes, of a city with 5,747 streets: paid in advance
SETTLED = 1.0  # s after which a page is made, and what was paid too much comes back
WINDOW = 2.0  # s, over which pictures are counted
SLOWEST = 40.0  # times the usual period


class Budget:
    """Counts the processor time of this process, whatever it is spent on."""

    def __init__(self, *, clock: Callable[[], float] = time.monotonic, spent: Callable[[], float] = time.process_time):
        """clock, spent: wall time and processor time so far [s]"""
        self._clock, self._spent, self._saved, self._slower = clock, spent, SAVED, 1.0
        self._at, self._since = (clock(), spent()), (clock(), spent())
        self._paid, self._page_at = 0.0, 0.0

    def page(self) -> bool:
        """Whether a page may be made now. It is paid for at once: many may be asked for before the first is made."""
        before, self._at = self._at, (self._clock(), self._spent())
        spent = self._at[1] - before[1]
        covered = min(spent, self._paid)
        self._paid -= covered
        back = self._paid if self._at[0] - self._page_at > SETTLED else 0.0
        self._paid -= back
        self._saved = min(self._saved + SHARE * (self._at[0] - before[0]) - (spent - covered) + back, SAVED)
        if self._saved <= 0.0:
            return False
        self._saved -= PAGE
        self._paid, self._page_at = self._paid + PAGE, self._at[0]
        return True

    def slower(self) -> float:
        """Times the usual period between two pictures: so that all of them together keep to the share."""
        now = self._clock(), self._spent()
        if (wall := now[0] - self._since[0]) >= WINDOW:
            load = (now[1] - self._since[1]) / wall / SHARE
            self._slower = min(max(self._slower * min(max(load, 0.5), 4.0), 1.0), SLOWEST)
            self._since = now
        return self._slower
