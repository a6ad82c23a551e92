"""Perimeter control where max-pressure runs the signals: the green of a gateway movement is rationed.

Max-pressure has no cycle and no windows that could be shortened. Here a gateway movement i -> h may be green for

    m + (u_ih - u_min) / (u_max - u_min) (C - m)        of every C seconds,

m the minimum green and C the cycle of the signal's original programme, whenever max-pressure likes; under u_max there
is no limit. Once that is spent its link turns yellow and red, and it exerts no pressure until the next C seconds begin.
At signals that SUMO actuates (cosim.plant.responsive) the second C is less, the green in a cycle that is usual there.
"""

from cosim.sumo.signals import GREEN

NEVER = float("inf")


class Ration:
    """The green of one link.

    cycle: [s]; min_green: [s]; yellow: [s], after its green; start: simulation time at which the first cycle begins;
    full: [s] of green in a cycle that the share 1 stands for, the cycle if None
    """

    def __init__(
        self,
        pair: tuple[int, int],
        *,
        cycle: float,
        min_green: float,
        yellow: float,
        start: float,
        full: float | None = None,
    ):
        """pair: (i, h), whose command it follows"""
        self.pair, self._green_time = pair, 0.0
        self._full = cycle if full is None else full
        self._cycle, self._min_green, self._yellow = cycle, min(min_green, self._full), yellow
        self._share, self._budget, self._spent = 1.0, NEVER, 0.0
        self._cycle_end = start
        self._open, self._opened_at = False, -NEVER
        self._light, self._since, self._yellow_until = "r", start, start

    def command(self, share: float) -> None:
        """share: (u - u_min) / (u_max - u_min) [-], for the cycles that begin from now on."""
        self._share = share

    @property
    def limited(self) -> bool:
        """Whether there is an end to its green in this cycle."""
        return self._budget < NEVER

    @property
    def exhausted(self) -> bool:
        """Whether it gets no more green in this cycle."""
        return not self._open and self._budget - self._spent < self._min_green - 1e-6

    def show(self, light: str, now: float, *, lasting: bool = True) -> tuple[str, float]:
        """What to show instead of `light` from `now` [s] on, and when that must be looked at again.

        Call it whenever `light` changes, and at the time that the last call gave. lasting: whether a green stays for
        the minimum green at least.
        """
        if self._light in GREEN:
            self._spent += now - self._since
            self._green_time += now - self._since
        self._since = now
        while now >= self._cycle_end - 1e-6:
            self._cycle_end += self._cycle
            self._spent = 0.0
            limit = self._min_green + self._share * (self._full - self._min_green)
            self._budget = NEVER if self._share >= 1.0 else limit
        self._light, again = self._filter(light, now, lasting)
        return self._light, min(again, self._cycle_end)

    def green_time(self, now: float) -> float:
        """Seconds of green that were shown before `now`."""
        return self._green_time + (now - self._since if self._light in GREEN else 0.0)

    def opened(self, now: float) -> bool:
        """Whether it has turned green just `now`."""
        return self._open and self._opened_at >= now - 1e-6

    def _filter(self, light: str, now: float, lasting: bool) -> tuple[str, float]:
        left = self._budget - self._spent
        if light in GREEN:
            if self._open and left <= 1e-6:
                self._open, self._yellow_until = False, now + self._yellow
            elif not self._open and lasting and now >= self._yellow_until - 1e-6 and left >= self._min_green - 1e-6:
                self._open, self._opened_at = True, now
            if self._open:
                return light, now + left
        elif self._open:
            self._open = light == "y"  # its yellow after this green
            return light, NEVER
        return ("y", self._yellow_until) if now < self._yellow_until - 1e-6 else ("r", NEVER)
