"""Processes for runs by pebble: a new process for each, with a time limit.

Where the system can, processes are forked from a server that has imported the modules of the first
job, which saves seconds for each. They do not import the user's script, which would do everything
again. The server is a fork of this process where that loses no thread, a new one elsewhere.
"""

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from multiprocessing import context, forkserver, resource_tracker, util
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
from pebble import ProcessExpired, concurrent

from nmfd.errors import InputError, uninterrupted

Job = Callable[[], Any]
NEVER_ANSWERED = 124  # exit status of a process whose controller does not answer
WATCH_S = 1.0  # between two looks at a decision
POLL_S = 0.2  # longest wait without a look at Ctrl-C, which Windows needs
PRELOADED = ("scipy.io",)  # which writes results
ALSO_THERE = ("torch", "casadi")  # preloaded if this process has them, as its jobs then need them
NAME = "run"  # of the processes
STARTING = threading.Lock()  # held while a process starts


class _Mainless:
    """Mixin of processes that do not import the user's script."""

    def start(self) -> None:
        script = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            super().start()  # type: ignore[misc]
        finally:
            sys.modules["__main__"] = script


if hasattr(os, "fork"):

    class _Process(_Mainless, context.ForkServerProcess):
        pass

    class _Context(context.ForkServerContext):
        Process = _Process

else:

    class _Process(_Mainless, context.SpawnProcess):  # type: ignore[no-redef]
        pass

    class _Context(context.SpawnContext):  # type: ignore[no-redef]
        Process = _Process  # type: ignore[assignment]


def attempt(job: Job) -> Any:
    """Return the outcome of a job, or the reason why there is none.

    The reason of an unexpected error names file and line.
    """
    try:
        return job()
    except InputError as error:
        return str(error)
    except (Exception, SystemExit) as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})"


def in_processes(
    jobs: Sequence[Job],
    workers: int,
    limits: Sequence[float | None],
    modules: Collection[str] = (),
) -> Generator[tuple[int, Any]]:
    """Yield the number and the outcome of each job, as they end.

    workers: jobs at a time
    limits: time after which a job is ended (s), None for none
    modules: imported once for all of them, if their server is not running yet
    """
    waiting = list(range(len(jobs)))
    live: dict[Future, int] = {}
    try:
        while waiting or live:
            while waiting and len(live) < workers:
                number = waiting.pop(0)
                live[_start(jobs[number], limits[number], modules)] = number
            done, _ = wait(live, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                number = live.pop(future)
                yield number, _outcome(future, limits[number])
    finally:  # after Ctrl-C there are some
        # Jobs are not cancelled: pebble raises an error if a process ends at that moment.
        for process in multiprocessing.active_children():
            if live and process.name == NAME:
                process.kill()


def in_subprocess(job: Job, folder: str) -> Any:
    """Return the outcome of a job in a new process.

    For workers of Dask, which may not fork.
    """
    command = [sys.executable, "-c", "from nmfd.runs.pool import answer; answer()"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONSAFEPATH": "1"}
    done = subprocess.run(
        command,
        input=cloudpickle.dumps(job),
        stdout=subprocess.PIPE,
        cwd=folder,
        env=environment,
        check=False,
    )
    if done.returncode:
        return died(done.returncode)
    return cloudpickle.loads(done.stdout)


def answer() -> None:
    """Write the outcome of the pickled job on stdin to stdout."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the job prints is no outcome
    outcome = attempt(cloudpickle.loads(sys.stdin.buffer.read()))
    out.write(cloudpickle.dumps(outcome))
    out.close()


def died(status: int) -> str:
    """Return the reason for a process that has ended without an outcome."""
    if status == NEVER_ANSWERED:
        return "its controller did not answer; ended after ten times its deadline"
    meaning = f", {signal.strsignal(-status)}" if status < 0 else ""
    return f"its process died (status {status}{meaning})"


def _start(job: Job, limit: float | None, modules: Collection[str]) -> Future:
    """Start the process of a job, in the current folder."""
    with STARTING, uninterrupted():
        here = _Context()
        if hasattr(os, "fork"):
            of_job = getattr(job, "func", job).__module__
            there = [name for name in ALSO_THERE if name in sys.modules]
            here.set_forkserver_preload([__name__, *PRELOADED, *there, *modules, of_job])
            _start_server()
        # Only as a decorator, and by this name, does pebble take the context.
        decorated = concurrent.process(name=NAME, timeout=limit, context=here)
        return decorated(work)(cloudpickle.dumps(job), os.getcwd(), dict(os.environ))


def _start_server() -> None:
    """Start the server that processes are forked from, unless it runs.

    Ctrl-C does not reach it.
    """
    resource_tracker.ensure_running()  # first, as it lets Ctrl-C through
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    new_process = util.spawnv_passfds
    with_threads = any(name in sys.modules for name in ALSO_THERE) or threading.active_count() > 1
    if sys.platform == "linux" and not with_threads:
        util.spawnv_passfds = _fork  # type: ignore[assignment]
    try:
        with _environment({"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(sys.path)}):
            forkserver.ensure_running()
    finally:
        util.spawnv_passfds = new_process
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _fork(_: Any, command: Sequence[Any], kept: Collection[int]) -> int:
    """Run the server in a fork of this process.

    It has the modules that this process has imported, and no other file open.

    command: its code is the last argument; kept: open files of the server
    """
    sys.stdout.flush()  # or every process would print what waits there
    sys.stderr.flush()
    process = os.fork()  # noqa: TID251
    if process:
        return process
    try:
        for number in map(int, os.listdir("/proc/self/fd")):
            if number > 2 and number not in kept:
                with suppress(OSError):  # the list was one of them
                    os.close(number)
        exec(command[-1], {})
    except Exception:
        traceback.print_exc()
    finally:
        os._exit(0)


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    before = dict(os.environ)
    os.environ |= changes
    try:
        yield
    finally:
        os.environ.clear()
        os.environ |= before


class Watchdog:
    """Time limit of a decision, as a context around it.

    It ends the process of a run. In a user's own process it does nothing: there is Ctrl-C.

    limit: longest decision (s)
    """

    def __init__(self, limit: float):
        self._limit = limit
        self._since = math.inf
        if multiprocessing.parent_process() is not None:
            threading.Thread(target=self._watch, daemon=True).start()

    def __enter__(self) -> None:
        self._since = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._since = math.inf

    def _watch(self) -> None:
        while time.monotonic() - self._since < self._limit:
            time.sleep(WATCH_S)
        os._exit(NEVER_ANSWERED)


def work(job: bytes, folder: str, environment: Mapping[str, str]) -> Any:
    """Return the outcome of a pickled job in `folder`.

    The process ends if its parent ends.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    outcome = attempt(lambda: cloudpickle.loads(job)())
    if hasattr(signal, "SIGPIPE"):  # after Ctrl-C nobody reads the outcome: no error message then
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    return outcome


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _outcome(future: Future, limit: float | None) -> Any:
    try:
        return future.result()
    except TimeoutError:
        return f"its time limit of {limit:g} s is over"
    except ProcessExpired as error:
        return died(error.exitcode or 0)
    except Exception as error:  # the outcome cannot be pickled
        return f"{type(error).__name__}: {error}"
