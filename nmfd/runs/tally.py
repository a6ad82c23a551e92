"""How far many runs are, those under way as well, in steps."""

from collections.abc import Callable, Sequence
from typing import Any

Progress = Callable[[int, int, str], object]  # takes what is done, what there is to do, and what is running


class Tally:
    """Tells `report` of the runs `todo`."""

    def __init__(
        self,
        report: Progress | None,
        todo: Sequence[Any],
        *,
        steps: Callable[[Any], int],
        label: Callable[[Any], str],
        at: Callable[[Any, float], str] = lambda run, share: "",
    ):
        """steps, label: of a run; at: where it is when so much [-] of it is done, in words"""
        self._report, self._label, self._at = report, label, at
        self._steps = [(run, steps(run)) for run in todo]
        self._total, self._done, self._ended, self._last = sum(n for _, n in self._steps), 0, 0, ""
        self._running: Sequence[tuple[Any, float]] = ()
        self.look(())

    def look(self, running: Sequence[tuple[Any, float]]) -> None:
        """running: the runs under way, and how much [-] of each is done"""
        self._running = running
        if not self._report or not self._total:
            return
        done = self._done + sum(share * self._of(run) for run, share in running)
        notes = [f"{self._ended}/{len(self._steps)} runs"] if len(self._steps) > 1 else []
        notes += [f"{self._label(run)}{self._at(run, share)}" for run, share in running] or filter(None, [self._last])
        self._report(round(done), self._total, "; ".join(notes))

    def end(self, run: Any, *, failed: bool) -> None:
        """A run has ended."""
        self._done, self._ended = self._done + self._of(run), self._ended + 1
        self._last = f"{'failed' if failed else 'last'} {self._label(run)}"
        self.look([(other, share) for other, share in self._running if other is not run])

    def _of(self, run: Any) -> int:
        return next((steps for one, steps in self._steps if one is run or one == run), 0)
