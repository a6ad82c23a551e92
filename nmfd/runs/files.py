"""Files that are written whole or not at all, and by one process at a time; their names and fingerprints."""

import csv
import errno
import hashlib
import os
import platform
import re
import stat
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from nmfd.errors import InputError

if TYPE_CHECKING:  # heavy
    import pandas as pd

KINDS = {stat.S_ISDIR: "folder", stat.S_ISFIFO: "pipe", stat.S_ISSOCK: "socket"}
TEMPORARY = re.compile(r"\.(?P<stem>.+)-\d+\.tmp(\.\w+)?")  # names that `atomic` gives


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary name in the folder of `path` to write to; it becomes `path` if all goes well, else it goes.

    The suffix of `path` is kept, because matplotlib and NumPy choose the format by it.
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

    To be called by whoever has the folder or the files to themselves (`locked`).
    """
    for path in folder.iterdir():
        name = TEMPORARY.fullmatch(path.name)
        if name and (stems is None or name["stem"] in stems):
            path.unlink(missing_ok=True)


@contextmanager
def locked(file: Path, what: Path, wait: float = 0.0) -> Iterator[None]:
    """`what` to oneself: InputError if another process has it, for `wait` [s] or longer.

    file: the lock, which holds process and host. The system lets go of it when the process ends, however it ends.
    """
    lock = FileLock(file, timeout=wait)
    try:
        lock.acquire()
    except Timeout:
        raise InputError(
            f"{what}: {_holder(file)} is writing to it; wait for its end, or choose another name with --out"
        ) from None
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):  # a file system without locks
            raise
    try:
        with suppress(OSError), file.open("r+b", buffering=0) as stream:
            stream.truncate(1)  # the first byte is what Windows locks
            stream.seek(1)
            stream.write(f"process {os.getpid()} on {platform.node()}".encode())
        yield
    finally:
        with suppress(OSError):  # Windows does not remove what is open
            file.unlink()
        lock.release()


def _holder(lock: Path) -> str:
    text = b""
    with suppress(OSError), lock.open("rb", buffering=0) as stream:
        stream.seek(1)
        text = stream.read(200)
    return text.decode(errors="replace") or "another process"


@contextmanager
def temporary_folder(prefix: str = "cosim-", where: Path | None = None) -> Iterator[Path]:
    """Yield a new folder in `where`, or in the system's place for such folders, and remove it at the end."""
    with tempfile.TemporaryDirectory(prefix=prefix, dir=where, ignore_cleanup_errors=True) as name:
        yield Path(name)


def write_text(path: Path, text: str) -> None:
    """`text` in `path`, atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_table(path: Path, frame: "pd.DataFrame", **options: str) -> None:
    """`frame` as a csv file, atomically; options: of DataFrame.to_csv."""
    write_text(path, frame.to_csv(index=False, **options))


def read_table(path: Path, types: Mapping[str, type], remedy: str, columns: Collection[str] = ()) -> "pd.DataFrame":
    """A table of runs as `write_table` wrote it. types: of some columns; columns: those to be added,
    with NaN, where an older version did not write them. Raises InputError."""
    import pandas as pd  # heavy

    check_file(path, remedy)
    try:
        rows = pd.read_csv(path)
        missing = [name for name in columns if name not in rows.columns]
        return rows.reindex(columns=[*rows.columns, *missing]).astype(types)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {remedy}") from None
    except (OSError, ValueError, KeyError) as error:  # pandas' own errors are ValueErrors
        raise InputError(f"{path}: is no table of runs ({error}); {remedy}") from None


def write_rows(path: Path, columns: Mapping[str, type], rows: Sequence[Mapping]) -> None:
    """`rows` as a csv file with `columns`, atomically."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=[*columns], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: Path, columns: Mapping[str, type]) -> list[dict]:
    """The rows of a csv file with `columns`: name -> type. Raises InputError."""
    check_file(path, "delete the folder and run again")
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if list(reader.fieldnames or ()) != list(columns):
                raise ValueError(f"expected the columns {', '.join(columns)}")
            return [{name: convert(row[name]) for name, convert in columns.items()} for row in reader]
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; delete the folder and run again") from None
    except (OSError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: {error}; delete the folder and run again") from None


def check_file(path: Path, remedy: str = "give a file") -> None:
    """InputError for what is there but no file: reading a pipe or a device would not end. Nothing there is nothing."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # whoever opens it says why
        return
    if not stat.S_ISREG(mode):
        kind = next((name for test, name in KINDS.items() if test(mode)), "device")
        raise InputError(f"{path}: is a {kind}, no file; {remedy}")


def file_hash(path: Path) -> str:
    """A fingerprint of the bytes of a file. InputError for what is no file."""
    check_file(path)
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]


def relative(path: Path, folder: Path) -> str:
    """`path` as seen from `folder`, with / between its parts; as it is where no way leads there (Windows' drives)."""
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return path.absolute().as_posix()


def file_name(name: str) -> str:
    """`name` with everything that is awkward in a file name replaced."""
    return re.sub(r"[^\w.-]+", "-", name)


def default_folder(scenario: str) -> Path:
    """Return runs/<scenario>-<timestamp> in the current folder, a name that is not taken; scenario: its name."""
    stem = f"{file_name(scenario)}-{datetime.now():%Y%m%d-%H%M%S}"
    candidates = (Path("runs") / (stem + (f"-{n}" if n > 1 else "")) for n in range(1, 1000))
    return next(folder for folder in candidates if not folder.exists())
