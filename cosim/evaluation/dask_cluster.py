"""Runs on a Dask cluster. Its workers see the same files under the same paths, and have this package installed."""

import logging
import os
from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

from cosim.evaluation import dask_worker
from cosim.evaluation.simulate import Result, Task
from nmfd.errors import InputError
from nmfd.extras import need
from nmfd.runs.workers import Failure

if TYPE_CHECKING:
    from distributed import Client

PATIENCE = 10.0  # s, for the scheduler to answer


def outcomes(address: str, tasks: Sequence[Task]) -> Iterator[tuple[Task, Result | Failure]]:
    """(task, Result or Failure) of every task, as they finish, from the workers of the scheduler at `address`.

    A task whose worker dies goes to another one; after several (Dask's distributed.scheduler.allowed-failures) it is
    a Failure. Raises InputError without the extra `dask`, and where no scheduler answers.
    """
    client = connect(address)
    futures = {}
    try:
        from distributed import as_completed  # of an extra, which `connect` has asked for

        run = partial(dask_worker.run, folder=os.getcwd())
        futures = {client.submit(run, task, pure=False): task for task in tasks}
        for future in as_completed(list(futures), loop=client.loop):
            task = futures.pop(future)
            if future.status == "finished":
                outcome = future.result()
            elif future.status == "cancelled":
                outcome = Failure(f"the scheduler at {address} was lost")
            else:
                error = future.exception()
                outcome = Failure(f"{type(error).__name__}: {' '.join(str(error).split())}")
            future.release()
            yield task, outcome
    finally:
        client.cancel(list(futures), force=True)
        client.close()


def connect(address: str) -> "Client":
    """A distributed.Client. Raises InputError."""
    need("--scheduler", "dask", "distributed")
    from distributed import Client  # of an extra: not there for everybody

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what went wrong is in the outcomes
    try:
        return Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--scheduler: no Dask scheduler answers at {address!r} ({' '.join(str(error).split())}); start one with "
            "'dask scheduler' and give its address, such as tcp://host:8786") from None
