"""One run in a process of its own, on whatever machine this is called: what a worker of a cluster does.

A Dask worker may neither start processes by multiprocessing (it is daemonic) nor hold two simulations at once (SUMO
has one per process). So the run goes to `python -m cosim.evaluation.dask_worker`, which ends when the worker
that waits for it dies.
"""

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from nmfd.controllers import registry
from nmfd.runs.workers import Failure, attempt, outcomes

HEADER = 8  # bytes, the length of the pickle that follows


def run(function: Callable, task: Any, folder: str) -> Any:
    """`attempt(function, task)` in a new process in `folder`, to which the relative paths in `task` refer. task: a
    simulate.Task, or a tuple (controller, ...); function: of a module, so that it can be pickled."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    process = subprocess.Popen(
        [sys.executable, "-m", "cosim.evaluation.dask_worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=folder,
        env=environment,
    )
    with process:
        assert process.stdin is not None and process.stdout is not None  # they are pipes
        message = pickle.dumps((function, task))
        try:
            process.stdin.write(len(message).to_bytes(HEADER) + message)
            process.stdin.flush()
        except BrokenPipeError:  # of a process that has just died; its status says why
            with suppress(BrokenPipeError):
                process.stdin.close()
        outcome = process.stdout.read()  # stdin stays open as long as this process lives
    if process.returncode:
        return Failure(f"its process died (status {process.returncode})")
    return pickle.loads(outcome)


def _serve() -> None:
    """The other side: one task from stdin, its outcome to stdout."""
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print must not get between
    function, task = pickle.loads(sys.stdin.buffer.read(int.from_bytes(sys.stdin.buffer.read(HEADER))))
    answered = threading.Event()
    threading.Thread(target=_end_with_the_caller, args=[answered], daemon=True).start()
    if registry.runs_apart(task[0] if isinstance(task, tuple) else task.controller):
        ((_, found),) = outcomes(function, [task], 1)
    else:
        found = attempt(function, task)
    outcome = pickle.dumps(found)
    answer.write(outcome)
    answer.flush()
    answered.set()
    answer.close()  # with which the caller goes on
    os._exit(0)  # not by way of the interpreter's end, where the reading thread holds stdin


def _end_with_the_caller(answered: threading.Event) -> None:
    os.read(0, 1)  # nothing comes but the end
    os._exit(0 if answered.is_set() else 1)


if __name__ == "__main__":
    _serve()
