"""What is being watched: runs in processes of their own, what they have shown so far, and who may go on how far."""

import multiprocessing
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing.connection import Connection

from cosim.evaluation.simulate import Result, Task
from cosim.view.picture import CityPicture, Frame
from cosim.view.run import Pace, Switch, Switched, run
from nmfd.runs.workers import LEAVE, Failure, Worker

DELAYS = (0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # s of wall time per simulated second


@dataclass
class Seen:
    """What one run has shown: `whole` frames, one per control interval and the one at the beginning, and the latest.

    switched: the gates that were switched, (k, i, h, share); outcome: when it has ended
    """

    name: str
    whole: list[Frame] = field(default_factory=list)
    latest: Frame | None = None
    switched: list[tuple[int, int, int, float | None]] = field(default_factory=list)
    outcome: Result | Failure | None = None

    def add(self, frame: Frame) -> None:
        """It has just come."""
        if frame.whole:
            self.whole.append(frame)
        self.latest = frame

    def at(self, time: float) -> Frame | None:
        """The last frame until `time` [s]; None before the first."""
        if self.latest is not None and self.latest.time <= time:
            return self.latest
        return next((frame for frame in reversed(self.whole) if frame.time <= time), None)


class Show:
    """Runs side by side. All of it may be asked from any thread; frames come by threads of its own."""

    def __init__(
        self, tasks: Sequence[Task], *, delay: float = 0.0, progress: Callable[[int, int], None] | None = None
    ):
        """Starts them. delay: [s] of wall time per simulated second at least; progress: of the first one"""
        self.runs = [Seen(task.controller) for task in tasks]
        self.picture: CityPicture | None = None
        self.pace = Pace(delay=delay)
        self.changed = threading.Event()  # something was shown or has ended
        self._progress, self._lock = progress, threading.Lock()
        self._workers: list[Worker] = []
        self._pipes: list[Connection] = []
        self._threads: list[threading.Thread] = []
        for n, task in enumerate(tasks):
            here, there = multiprocessing.get_context("spawn").Pipe()
            worker = Worker(partial(run, there, self.pace))
            there.close()
            worker.hand(task)
            self._workers.append(worker)
            self._pipes.append(here)
            self._threads += [
                threading.Thread(target=self._listen, args=(n,), daemon=True),
                threading.Thread(target=self._conclude, args=(n,), daemon=True),
            ]
        for thread in self._threads:
            thread.start()

    @property
    def over(self) -> bool:
        """Whether all have ended."""
        return all(seen.outcome is not None for seen in self.runs)

    @property
    def now(self) -> float:
        """Until when [s] all that still go on have shown something."""
        times = [seen.latest.time if seen.latest else 0.0 for seen in self.runs if seen.outcome is None]
        return min(times, default=max((seen.latest.time for seen in self.runs if seen.latest), default=0.0))

    @property
    def paused(self) -> bool:
        """Whether the runs were told to wait, now or in a moment."""
        return self.pace.until != float("inf")

    def pause(self) -> None:
        """All wait at their next look at the streets."""
        self._set(replace(self.pace, until=0.0))

    def go(self) -> None:
        """All go on."""
        self._set(replace(self.pace, until=float("inf")))

    def step(self) -> None:
        """All go on to the end of the control interval in which the one ahead is, and wait there."""
        if self.picture is not None:
            ahead = max((seen.latest.time for seen in self.runs if seen.latest), default=0.0)
            self._set(replace(self.pace, until=(ahead // self.picture.step + 1) * self.picture.step))

    def hurry(self, by: int) -> None:
        """Faster (1) or slower (-1) by so many of DELAYS."""
        at = min(range(len(DELAYS)), key=lambda n: abs(DELAYS[n] - self.pace.delay))
        self._set(replace(self.pace, delay=DELAYS[min(max(at - by, 0), len(DELAYS) - 1)]))

    def switch(self, n: int, source: int, target: int, share: float | None) -> None:
        """Hold a gate of run n from its next control interval on at `share` [-]; None: let go of it."""
        self._tell(n, Switch(source=source, target=target, share=share))

    def wait(self, seconds: float | None = None) -> bool:
        """Until all have ended; whether they have."""
        for thread in self._threads:
            thread.join(seconds)
        return self.over

    def close(self) -> None:
        """End the runs that still go on."""
        for worker, seen in zip(self._workers, self.runs, strict=True):
            if seen.outcome is None:
                worker.terminate()
        for thread in self._threads:  # they hear of the end of a process
            thread.join(LEAVE)
        for worker in self._workers:
            worker.close()
        for pipe in self._pipes:
            pipe.close()

    def _set(self, pace: Pace) -> None:
        self.pace = pace
        for n in range(len(self.runs)):
            self._tell(n, pace)

    def _tell(self, n: int, order: object) -> None:
        with self._lock:
            try:
                self._pipes[n].send(order)
            except OSError:  # that run has ended
                return

    def _listen(self, n: int) -> None:
        """What run n shows, until its end."""
        seen, pipe = self.runs[n], self._pipes[n]
        while True:
            try:
                shown = pipe.recv()
            except (EOFError, OSError):
                return
            if isinstance(shown, CityPicture):
                self.picture = self.picture or shown
            elif isinstance(shown, Switched):
                switch = shown.switch
                seen.switched.append((shown.k, switch.source, switch.target, switch.share))
            else:
                seen.add(shown)
                if n == 0 and shown.whole and self._progress and shown.intervals and self.picture:
                    self._progress(shown.intervals, self.picture.steps)
            self.changed.set()

    def _conclude(self, n: int) -> None:
        """What has become of run n."""
        self.runs[n].outcome = self._workers[n].receive()
        self.changed.set()
