"""Many independent runs in several processes; every outcome is handed over as soon as it is there."""

import multiprocessing
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path


@dataclass(frozen=True)
class Failure:
    """Why a task has no result, in one line."""

    reason: str


class RunFailed(Exception):
    """Some runs ended in an error. The message names them in one line."""


def attempt(function: Callable, task):
    """`function(task)`, or the Failure that it ended in."""
    try:
        return function(task)
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return Failure(f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})")


def outcomes(function: Callable, tasks: Sequence, workers: int) -> Iterator[tuple]:
    """(task, `attempt(function, task)`) for every task, as they finish, from `workers` processes.

    The processes are spawned, so `function` and the tasks must be picklable. A process that dies (out of memory, a
    crash in a library) is the Failure of the task it was at. Closing the iterator ends the processes at once.
    """
    todo, busy = list(tasks)[::-1], {}
    try:
        while todo or busy:
            while todo and len(busy) < workers:
                connection, process = _spawn(function)
                busy[connection] = process, _hand_over(connection, todo.pop())
            for connection in wait(list(busy)):
                process, task = busy[connection]
                outcome = _receive(connection, process)
                if todo and process.is_alive():
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


def _hand_over(connection, task):
    with suppress(OSError):  # a process that has just died is noticed by _receive
        connection.send(task)
    return task


def _receive(connection, process):
    try:
        return connection.recv()
    except (EOFError, OSError):
        process.join()
        return Failure(f"its process died (status {process.exitcode})")


def _spawn(function: Callable) -> tuple:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(function, there), daemon=True)
    with _interrupts_ignored():
        process.start()
    there.close()
    return here, process


@contextmanager
def _interrupts_ignored():
    """Processes started in here inherit it: Ctrl-C is the parent's business, and it ends its workers."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _serve(function: Callable, connection) -> None:
    while True:
        try:
            task = connection.recv()
        except EOFError:
            return
        connection.send(attempt(function, task))
