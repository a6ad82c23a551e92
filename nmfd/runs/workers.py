"""Many independent runs in several processes; every outcome is handed over as soon as it is there.

What a task runs of a user's own code may do to its process what it likes: exit, hang, crash, start threads. Where that
code begins it says so (`limited`), in memory that this process sees, too: a worker that is overdue there is ended.
"""

import math
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Any

import psutil

from nmfd.errors import InputError, RunFailed

GRACE = 2.0  # s, from the end of a time limit, of which a task is told, to that of its process
LEAVE = 5.0  # s, for a process that has nothing more to do
LOOK = 0.5  # s, between two looks at the time limits
SAID = 300  # bytes, of what a task is at
# Where tasks are done, other than in processes here: (function, tasks) -> (task, outcome) as they finish.
Source = Callable[[Callable, Sequence], Iterator[tuple]]


@dataclass(frozen=True)
class Failure:
    """Why a task has no result, in one line. mistake: the user can cure it (it was an InputError)."""

    reason: str
    mistake: bool = False


def ended(failures: Sequence[tuple[str, Failure]]) -> Exception:
    """What to raise for (run, Failure) pairs: an InputError if the user can cure them all, else RunFailed."""
    text = "; ".join(f"{run}: {failure.reason}" for run, failure in failures)
    return InputError(text) if all(failure.mistake for _, failure in failures) else RunFailed(text)


def cores() -> int:
    """How many of them this process may use."""
    mine = psutil.Process()
    return len(mine.cpu_affinity()) if hasattr(mine, "cpu_affinity") else os.cpu_count() or 1  # not on macOS


def at_a_time(workers: int | None) -> int:
    """How many runs go on side by side: as many as asked for, or one per core."""
    return cores() if workers is None else workers


def attempt(function: Callable, task: Any) -> Any:
    """`function(task)`, or the Failure that it ended in."""
    try:
        return function(task)
    except InputError as error:
        return Failure(str(error), mistake=True)
    except RunFailed as error:
        return Failure(str(error))
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return Failure(f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})")


class TimeUp(BaseException):
    """What `limited` raises at the end of its time. No Exception: code that catches those would go on."""


class Ended(BaseException):
    """SIGTERM, in a worker: it cleans up on its way out."""


class Watch:
    """What a worker is at, and until when [s, time.monotonic], in memory that it shares with its parent; and how much
    of its task [-] is done."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._until, self._doing = context.RawValue("d", 0.0), context.RawArray("c", SAID)
        self._share = context.RawValue("d", 0.0)

    @property
    def share(self) -> float:
        return self._share.value

    @share.setter
    def share(self, share: float) -> None:
        self._share.value = share

    def set(self, doing: str, until: float = 0.0) -> None:
        """From now on; until: 0 for no limit."""
        self._doing.value = doing.encode(errors="replace")[: SAID - 1]
        self._until.value = until

    @property
    def doing(self) -> str:
        return self._doing.value.decode(errors="ignore")

    @property
    def overdue(self) -> bool:
        return 0.0 < self._until.value < time.monotonic()


_here: Watch | None = None  # of this process, if it is a worker


def inside() -> bool:
    """Whether this process is a worker."""
    return _here is not None


def reached(share: float) -> None:
    """So much [-] of the task of this process is done, if it is a worker."""
    if _here:
        _here.share = share


@contextmanager
def limited(seconds: float, doing: str) -> Iterator[None]:
    """The body has so many seconds, 0 for as many as it likes; TimeUp at their end, in the main thread, on POSIX.

    In a worker, the process is ended a little later where Python does not hear of that, or the body does not care.
    doing: for the Failure of a worker that ends in the body
    """
    if _here:
        _here.set(doing, time.monotonic() + seconds + GRACE if seconds else 0.0)
    try:
        with _alarm(seconds):
            yield
    finally:
        if _here:
            _here.set("")


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    main = threading.current_thread() is threading.main_thread()
    if not seconds or not main or not hasattr(signal, "setitimer"):
        yield
        return

    def ring(*_: object) -> None:
        raise TimeUp

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before or signal.SIG_DFL)


class Worker:
    """A process of its own that does one task after another. It ends when this process does, however that comes."""

    def __init__(self, function: Callable):
        """function: of a task, both picklable, for the process is spawned"""
        context = multiprocessing.get_context("spawn")
        self._watch = Watch()
        self.connection, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(function, there, self._watch), daemon=True)
        with _interrupts_ignored(), _nothing_of_main(function):
            self._process.start()
        there.close()
        self.task: Any = None

    def hand(self, task: Any) -> None:
        """Have it do `task`."""
        self.task, self._watch.share = task, 0.0
        with suppress(OSError):  # a process that has just died is noticed by `receive`
            self.connection.send(task)

    def receive(self) -> Any:
        """The outcome of its task, a Failure if it has died; waits for it."""
        try:
            while not self.connection.poll(LOOK):
                if self._watch.overdue:
                    return self.overrun()
            return self.connection.recv()
        except Exception:  # EOFError, OSError, and whatever somebody else may have sent
            self._leave()
            doing = self._watch.doing
            reason = f"its process died (status {self._process.exitcode})"
            return Failure(f"{doing}: {reason}" if doing else reason, mistake=bool(doing))

    @property
    def share(self) -> float:
        """How much of its task [-] is done, as that has said (`reached`)."""
        return self._watch.share

    @property
    def overdue(self) -> bool:
        """Whether a time limit within its task is over, and it still at it."""
        return self._watch.overdue

    def overrun(self) -> Failure:
        """End it for that."""
        self.kill()
        return Failure(f"{self._watch.doing}: took longer than its time limit, and its process was ended", mistake=True)

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.join()

    def terminate(self) -> None:
        """Ask it to end in the middle of its task."""
        self._process.terminate()

    def close(self) -> None:
        """Its end, which it takes from that of the connection; user code may have left threads that do not care."""
        self.connection.close()
        self._leave()

    def _leave(self) -> None:
        self._process.join(LEAVE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def outcomes(
    function: Callable,
    tasks: Sequence,
    workers: int,
    *,
    fresh: bool = False,
    group: Callable[[Any], str] = lambda task: "",
    seconds: float | None = None,
    look: Callable[[Sequence[tuple[Any, float]]], object] | None = None,
) -> Iterator[tuple]:
    """(task, `attempt(function, task)`) for every task, as they finish, from `workers` processes.

    fresh: every task in a process of its own; group: of a task, which shares no process with those of other groups
    seconds: wall time after which a task is ended; it needs `fresh`
    look: called now and then with the tasks under way, and how much [-] of each is done

    The processes are spawned, so `function` and the tasks must be picklable. A process that dies (out of memory, a
    crash in a library) is the Failure of the task it was at. Closing the iterator ends the processes at once, and so
    does the end of this process, however it comes.
    """
    todo, deadlines = list(tasks)[::-1], dict[Worker, float]()
    try:
        while todo or deadlines:
            while todo and len(deadlines) < workers:
                worker = Worker(function)
                deadlines[worker] = time.monotonic() + (math.inf if seconds is None else seconds)
                worker.hand(todo.pop())
            first = min(deadlines.values()) - time.monotonic()
            ready = wait([worker.connection for worker in deadlines], max(min(first, LOOK), 0.0))
            if look:
                look([(worker.task, worker.share) for worker in deadlines])
            for worker in list(deadlines):
                task = worker.task
                if worker.connection in ready:
                    outcome = worker.receive()
                elif worker.overdue:
                    outcome = worker.overrun()
                elif deadlines[worker] <= time.monotonic():
                    outcome = Failure(f"not finished after {seconds:g} s")
                    worker.kill()
                else:
                    continue
                more = [n for n, other in enumerate(todo) if group(other) == group(task)]
                if more and worker.connection in ready and worker.alive and not fresh:
                    worker.hand(todo.pop(more[-1]))
                else:
                    del deadlines[worker]
                    worker.close()
                yield task, outcome
    finally:
        for worker in deadlines:
            worker.terminate()
        for worker in deadlines:
            worker.close()


def _end_with(parent: BaseProcess) -> None:
    """End this process when its parent has ended, which has no chance to say so when it is killed."""
    wait([parent.sentinel])
    os._exit(1)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes started in here inherit it: Ctrl-C is the parent's business, and it ends its workers.

    SIGTERM waits until they have started: a process that loses its parent half-way complains.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    term = signal.signal(signal.SIGTERM, lambda number, _: waiting.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        signal.signal(signal.SIGTERM, term or signal.SIG_DFL)
        if waiting:
            signal.raise_signal(signal.SIGTERM)


@contextmanager
def _nothing_of_main(function: Callable) -> Iterator[None]:
    """Processes started in here do not run the script of this one once more, which need not be made for that."""
    if getattr(getattr(function, "func", function), "__module__", "__main__") == "__main__":  # func: of a partial
        yield
        return
    main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _serve(function: Callable, connection: Connection, watch: Watch) -> None:
    global _here
    _here = watch
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    try:
        signal.signal(signal.SIGTERM, _ended)
        while True:
            try:
                task = connection.recv()
            except EOFError:
                return
            connection.send(_attempt_all(function, task))
    except Ended:
        os._exit(128 + signal.SIGTERM)
    except OSError:  # the connection is gone, by user code
        os._exit(1)


def _ended(*_: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise Ended


def _attempt_all(function: Callable, task: Any) -> Any:
    """As `attempt`; nothing but the end of this process goes beyond."""
    try:
        return attempt(function, task)
    except Ended:
        raise
    except BaseException as error:
        return Failure(f"{type(error).__name__}: {error}")
