"""Many independent runs in several processes; every outcome is handed over as soon as it is there."""

import math
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import psutil

from nmfd.errors import InputError, RunFailed


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


def outcomes(
    function: Callable, tasks: Sequence, workers: int, *, fresh: bool = False, seconds: float | None = None,
) -> Iterator[tuple]:
    """(task, `attempt(function, task)`) for every task, as they finish, from `workers` processes.

    fresh: every task in a process of its own
    seconds: wall time after which a task is ended; it needs `fresh`

    The processes are spawned, so `function` and the tasks must be picklable. A process that dies (out of memory, a
    crash in a library) is the Failure of the task it was at. Closing the iterator ends the processes at once, and so
    does the end of this process, however it comes.
    """
    todo, deadlines = list(tasks)[::-1], dict[Connection, float]()
    busy: dict[Connection, tuple[SpawnProcess, Any]] = {}
    try:
        while todo or busy:
            while todo and len(busy) < workers:
                connection, process = _spawn(function)
                busy[connection] = process, _hand_over(connection, todo.pop())
                deadlines[connection] = time.monotonic() + (math.inf if seconds is None else seconds)
            first = min(deadlines[connection] for connection in busy) - time.monotonic()
            ready = wait(list(busy), None if math.isinf(first) else max(first, 0.0))
            late = [connection for connection in busy if deadlines[connection] <= time.monotonic()]
            for connection in busy.keys() & {*ready, *late}:
                process, task = busy[connection]
                if connection in ready:
                    outcome = _receive(connection, process)
                else:
                    outcome = Failure(f"not finished after {seconds:g} s")
                    process.kill()
                if todo and process.is_alive() and not fresh:
                    busy[connection] = process, _hand_over(connection, todo.pop())
                else:
                    del busy[connection]
                    connection.close()  # the worker takes that as its end
                    process.join()
                yield task, outcome
    finally:
        for process, _ in busy.values():
            process.terminate()
        for process, _ in busy.values():
            process.join()


def _hand_over(connection: Connection, task: Any) -> Any:
    with suppress(OSError):  # a process that has just died is noticed by _receive
        connection.send(task)
    return task


def _receive(connection: Connection, process: SpawnProcess) -> Any:
    try:
        return connection.recv()
    except (EOFError, OSError):
        process.join()
        return Failure(f"its process died (status {process.exitcode})")


def _spawn(function: Callable) -> tuple[Connection, SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(function, there), daemon=True)
    with _interrupts_ignored():
        process.start()
    there.close()
    return here, process


def _end_with(parent: BaseProcess) -> None:
    """End this process when its parent has ended, which has no chance to say so when it is killed."""
    wait([parent.sentinel])
    os._exit(1)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Processes started in here inherit it: Ctrl-C is the parent's business, and it ends its workers."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _serve(function: Callable, connection: Connection) -> None:
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    while True:
        try:
            task = connection.recv()
        except EOFError:
            return
        connection.send(attempt(function, task))
