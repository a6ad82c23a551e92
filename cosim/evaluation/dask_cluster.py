"""Runs on a Dask cluster. Its workers see the same files under the same paths, and have this package installed.

A Dask scheduler and its workers run whatever Python somebody sends who reaches them, and what they answer is unpickled
here, which runs code, too: over plain tcp that is everybody on the network. With tls:// only who holds a certificate of
the same authority is talked to, on all three sides (host names are not looked at: have an authority for the cluster
alone).
"""

import ipaddress
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from cosim.evaluation import dask_worker
from nmfd.errors import InputError
from nmfd.extras import need
from nmfd.runs.files import check_file
from nmfd.runs.workers import Failure, Source

if TYPE_CHECKING:
    from distributed import Client
    from distributed.security import Security

PATIENCE = 10.0  # s, for the scheduler to answer
RETURN = 300.0  # s, for one that was lost to come back
LOSSES = 5  # of the scheduler, without a run that ended between them: then it may be the runs that it dies of
Tell = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Scheduler:
    """address: such as tls://host:8786; ca, cert, key: PEM files of the authority, of this side's certificate, and of
    its key; None: as Dask's own configuration says."""

    address: str
    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None

    @property
    def encrypted(self) -> bool:
        """Whether it is talked to by TLS."""
        return self.address.startswith("tls://")

    @property
    def warning(self) -> str:
        """What is to be said of whom it trusts, "" if nothing."""
        if self.encrypted or self.address.startswith("inproc://") or _here(self.address):
            return ""
        return (
            f"--scheduler {self.address}: is not encrypted; whoever reaches it can run code there and here. Use "
            "tls:// (cosim sweep --help) outside a network of your own"
        )


def _here(address: str) -> bool:
    """Whether only this machine reaches `address`."""
    try:
        host = urlsplit(address if "://" in address else f"tcp://{address}").hostname or ""
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return False


def source(scheduler: Scheduler | str | None, tell: Tell | None = None) -> Source | None:
    """`outcomes` of a scheduler, which has answered before anything is written; None without one. tell: takes one line
    where others may listen, where there are no workers yet, and where it was lost. InputError as `connect`."""
    if scheduler is None:
        return None
    found = Scheduler(address=scheduler) if isinstance(scheduler, str) else scheduler
    client = connect(found)
    workers = client.nthreads()
    _close(client)
    if tell and found.warning:
        tell(found.warning)
    if tell and not workers:
        tell(f"--scheduler {found.address}: has no workers; runs wait for the first (dask worker {found.address})")
    return partial(outcomes, found, tell=tell)


def outcomes(
    scheduler: Scheduler | str, function: Callable, tasks: Sequence, *, tell: Tell | None = None
) -> Iterator[tuple]:
    """(task, `function(task)` or Failure) of every task, once each, as they finish, from the workers of the scheduler.

    A task whose worker dies goes to another one; after several (Dask's distributed.scheduler.allowed-failures) it is
    a Failure. A scheduler that is lost is waited for, at the same address, and given the tasks that have not ended:
    what it knew is gone with it, what had ended was handed over here at once. Raises InputError without the extra
    `dask`, and where no scheduler answers at first.
    """
    at = Scheduler(address=scheduler) if isinstance(scheduler, str) else scheduler
    todo, losses, client = dict.fromkeys(tasks), 0, None
    while todo:
        client = connect(at) if client is None else _connect_again(at)
        if client is None or losses > LOSSES:
            why = f"did not come back in {RETURN:g} s" if client is None else f"was lost {losses} times in a row"
            yield from ((task, Failure(f"the scheduler at {at.address} {why}")) for task in todo)
            return
        for task, outcome in _until_lost(client, function, list(todo)):
            del todo[task]
            losses = 0
            yield task, outcome
        losses += 1
        if todo and tell:
            tell(
                f"the scheduler at {at.address} was lost; its {len(todo)} runs begin again when it is "
                f"back, within {RETURN:g} s"
            )


def _until_lost(client: "Client", function: Callable, tasks: Sequence) -> Iterator[tuple]:
    """(task, outcome) as they finish, of all or until the scheduler is lost; closes the client."""
    from distributed import CancelledError, as_completed  # of an extra, which `connect` has asked for

    run = partial(dask_worker.run, function, folder=os.getcwd())
    futures = {}
    try:
        futures = {client.submit(run, task, pure=False): task for task in tasks}
        for future in as_completed(list(futures), loop=client.loop):
            if future.status not in ("finished", "error"):
                return
            try:
                error = future.exception()
                outcome = (
                    future.result()
                    if error is None
                    else Failure(f"{type(error).__name__}: {' '.join(str(error).split())}")
                )
            except (CancelledError, OSError, TimeoutError):  # lost between its end and here
                return
            future.release()
            yield futures.pop(future), outcome
    finally:
        if client.status == "running":
            client.cancel(list(futures), force=True)
        _close(client)


def _close(client: "Client") -> None:
    """Also one whose scheduler does not answer any more."""
    with suppress(TimeoutError):
        client.close()


def _connect_again(scheduler: Scheduler) -> "Client | None":
    """To one that was lost; None where it does not come back."""
    deadline = time.monotonic() + RETURN
    while time.monotonic() < deadline:
        try:
            return connect(scheduler)
        except InputError:
            time.sleep(1.0)
    return None


def connect(scheduler: Scheduler | str) -> "Client":
    """A distributed.Client. Raises InputError."""
    need("--scheduler", "dask", "distributed")
    from distributed import Client  # of an extra: not there for everybody

    scheduler = Scheduler(address=scheduler) if isinstance(scheduler, str) else scheduler
    for logger in ("distributed", "distributed.client"):  # Dask sets both; what went wrong is in the outcomes
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    security = _security(scheduler)
    try:
        return Client(scheduler.address, timeout=PATIENCE, set_as_default=False, security=security)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        certificates = " with certificates that it trusts" if scheduler.encrypted else ""
        raise InputError(
            f"--scheduler: no Dask scheduler answers at {scheduler.address!r} ({reason}); start "
            f"one with 'dask scheduler' and give its address, such as tcp://host:8786{certificates}"
        ) from None


def _security(scheduler: Scheduler) -> "Security | None":
    """What Dask takes for its certificates; None: as its own configuration says. Raises InputError."""
    from distributed.security import Security  # of an extra

    options = {"--scheduler-ca": scheduler.ca, "--scheduler-cert": scheduler.cert, "--scheduler-key": scheduler.key}
    given = {option: path for option, path in options.items() if path is not None}
    if given and not scheduler.encrypted:
        raise InputError(
            f"{next(iter(given))}: is for an encrypted scheduler, at tls://..., not {scheduler.address!r}: omit it, or "
            "start the scheduler with --protocol tls"
        )
    for option, path in given.items():
        check_file(path, "give a PEM file")
        if not path.is_file():
            raise InputError(f"{option}: {path}: no such file; give a PEM file")
    if not scheduler.encrypted:
        return None
    own = Security()  # with what dask's configuration says (distributed.comm.tls)
    security = Security(
        require_encryption=True,
        tls_ca_file=str(scheduler.ca or own.tls_ca_file or "") or None,
        tls_client_cert=str(scheduler.cert or own.tls_client_cert or "") or None,
        tls_client_key=str(scheduler.key or own.tls_client_key or "") or None,
    )
    missing = [
        option
        for option, value in zip(options, (security.tls_ca_file, security.tls_client_cert), strict=False)
        if value is None
    ]
    if missing:
        raise InputError(
            f"{missing[0]}: missing for {scheduler.address!r}; give a PEM file, or name it in Dask's "
            "configuration (distributed.comm.tls)"
        )
    return security
