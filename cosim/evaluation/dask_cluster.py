"""Runs on a Dask cluster. Its workers see the same files under the same paths, and have this package installed.

A Dask scheduler and its workers run whatever Python somebody sends who reaches them, and what they answer is unpickled
here, which runs code, too: over plain tcp that is everybody on the network. With tls:// only who holds a certificate of
the same authority is talked to, on all three sides (host names are not looked at: have an authority for the cluster
alone).
"""

import ipaddress
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from cosim.evaluation import dask_worker
from cosim.evaluation.simulate import Result, Task
from nmfd.errors import InputError
from nmfd.extras import need
from nmfd.runs.files import check_file
from nmfd.runs.workers import Failure

if TYPE_CHECKING:
    from distributed import Client
    from distributed.security import Security

PATIENCE = 10.0  # s, for the scheduler to answer


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
        return (f"--scheduler {self.address}: is not encrypted; whoever reaches it can run code there and here. Use "
                "tls:// (cosim sweep --help) outside a network of your own")


def _here(address: str) -> bool:
    """Whether only this machine reaches `address`."""
    try:
        host = urlsplit(address if "://" in address else f"tcp://{address}").hostname or ""
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return False


def checked(scheduler: Scheduler | str, tell: Callable[[str], None] | None = None) -> Scheduler:
    """The scheduler, of which somebody has answered; before anything is written. tell: takes one line where others
    may listen. InputError as `connect`."""
    found = Scheduler(address=scheduler) if isinstance(scheduler, str) else scheduler
    connect(found).close()
    if tell and found.warning:
        tell(found.warning)
    return found


def outcomes(scheduler: Scheduler | str, tasks: Sequence[Task]) -> Iterator[tuple[Task, Result | Failure]]:
    """(task, Result or Failure) of every task, as they finish, from the workers of the scheduler.

    A task whose worker dies goes to another one; after several (Dask's distributed.scheduler.allowed-failures) it is
    a Failure. Raises InputError without the extra `dask`, and where no scheduler answers.
    """
    client = connect(scheduler)
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
                outcome = Failure(f"the scheduler at {client.scheduler.address} was lost")
            else:
                error = future.exception()
                outcome = Failure(f"{type(error).__name__}: {' '.join(str(error).split())}")
            future.release()
            yield task, outcome
    finally:
        client.cancel(list(futures), force=True)
        client.close()


def connect(scheduler: Scheduler | str) -> "Client":
    """A distributed.Client. Raises InputError."""
    need("--scheduler", "dask", "distributed")
    from distributed import Client  # of an extra: not there for everybody

    scheduler = Scheduler(address=scheduler) if isinstance(scheduler, str) else scheduler
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what went wrong is in the outcomes
    security = _security(scheduler)
    try:
        return Client(scheduler.address, timeout=PATIENCE, set_as_default=False, security=security)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        certificates = " with certificates that it trusts" if scheduler.encrypted else ""
        raise InputError(
            f"--scheduler: no Dask scheduler answers at {scheduler.address!r} ({reason}); start "
            f"one with 'dask scheduler' and give its address, such as tcp://host:8786{certificates}") from None


def _security(scheduler: Scheduler) -> "Security | None":
    """What Dask takes for its certificates; None: as its own configuration says. Raises InputError."""
    from distributed.security import Security  # of an extra

    options = {"--scheduler-ca": scheduler.ca, "--scheduler-cert": scheduler.cert, "--scheduler-key": scheduler.key}
    given = {option: path for option, path in options.items() if path is not None}
    if given and not scheduler.encrypted:
        raise InputError(
            f"{next(iter(given))}: is for an encrypted scheduler, at tls://..., not {scheduler.address!r}: omit it, or "
            "start the scheduler with --protocol tls")
    for option, path in given.items():
        check_file(path, "give a PEM file")
        if not path.is_file():
            raise InputError(f"{option}: {path}: no such file; give a PEM file")
    if not scheduler.encrypted:
        return None
    own = Security()  # with what dask's configuration says (distributed.comm.tls)
    security = Security(
        require_encryption=True, tls_ca_file=str(scheduler.ca or own.tls_ca_file or "") or None,
        tls_client_cert=str(scheduler.cert or own.tls_client_cert or "") or None,
        tls_client_key=str(scheduler.key or own.tls_client_key or "") or None)
    missing = [option for option, value in zip(
        options, (security.tls_ca_file, security.tls_client_cert), strict=False) if value is None]
    if missing:
        raise InputError(f"{missing[0]}: missing for {scheduler.address!r}; give a PEM file, or name it in Dask's "
                         "configuration (distributed.comm.tls)")
    return security
