"""Files that are written whole or not at all, and by one process at a time; their names and fingerprints."""

import csv
import errno
import fcntl
import hashlib
import os
import platform
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from nmfd.errors import InputError

TEMPORARY = re.compile(r"\.(?P<stem>.+)-\d+\.tmp(\.\w+)?")  # names that `atomic` gives


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary name in the folder of `path` to write to; it becomes `path` if all goes well, else it goes.

    The suffix of `path` is kept, because matplotlib and NumPy choose the format by it. A process that is killed leaves
    the temporary file behind; `sweep` removes it.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}-{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException as error:
        if isinstance(error, OSError) and error.filename in (None, str(temporary)):  # a full disk is met without a name
            error.filename = str(path)
        with suppress(OSError):
            temporary.unlink()
        raise


def sweep(folder: Path, stems: Collection[str] | None = None) -> None:
    """Remove what killed processes left half-written in `folder`, of files with these stems, or of all.

    To be called by whoever has the folder or the files to himself (`locked`).
    """
    for path in folder.iterdir():
        name = TEMPORARY.fullmatch(path.name)
        if name and (stems is None or name["stem"] in stems):
            path.unlink(missing_ok=True)


@contextmanager
def locked(file: Path, what: Path) -> Iterator[None]:
    """`what` to oneself: InputError if another process has it.

    file: the lock, which holds process and host. The system lets go of it when the process ends, however it ends.
    """
    while True:
        handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(handle, 200).decode(errors="replace") or "another process"
            os.close(handle)
            raise InputError(
                f"{what}: {holder} is writing to it; wait for its end, or choose another name with --out") from None
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
                os.close(handle)
                raise
        with suppress(FileNotFoundError):  # whoever had it may have removed it meanwhile
            if os.path.samestat(os.fstat(handle), os.stat(file)):
                break
        os.close(handle)
    try:
        os.ftruncate(handle, 0)
        os.write(handle, f"process {os.getpid()} on {platform.node()}".encode())
        yield
    finally:
        with suppress(OSError):
            os.unlink(file)
        os.close(handle)


def write_text(path: Path, text: str) -> None:
    """`text` in `path`, atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_rows(path: Path, columns: Mapping[str, type], rows: Sequence[Mapping]) -> None:
    """`rows` as a csv file with `columns`, atomically."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: Path, columns: Mapping[str, type]) -> list[dict]:
    """The rows of a csv file with `columns`: name -> type. Raises InputError."""
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if reader.fieldnames != list(columns):
                raise ValueError(f"expected the columns {', '.join(columns)}")
            return [{name: convert(row[name]) for name, convert in columns.items()} for row in reader]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; delete the folder and run again") from None
    except (OSError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: {error}; delete the folder and run again") from None


def file_hash(path: Path) -> str:
    """A fingerprint of the bytes of a file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]


def file_name(name: str) -> str:
    """`name` with everything that is awkward in a file name replaced."""
    return re.sub(r"[^\w.-]+", "-", name)
