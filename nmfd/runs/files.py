"""Files that are written whole or not at all; names and fingerprints."""

import hashlib
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from filelock import FileLock, Timeout

from nmfd.errors import InputError

if TYPE_CHECKING:
    import pandas as pd


HELD = ".held"  # locked as long as the process of a temporary folder lives
NEW_S = 2.0  # age up to which a temporary folder is left alone


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary file name beside `path`.

    The file becomes `path` if the block succeeds. It has the suffix of `path`, by which matplotlib
    and NumPy choose the format.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}-{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename in (None, str(temporary)):  # a full disk has no name
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def temporary_folder(prefix: str = "cosim-", where: Path | None = None) -> Iterator[Path]:
    """Yield a new folder and remove it at the end.

    Folders of killed processes are removed first.

    where: folder above, the system's place for temporary folders if None
    """
    parent = Path(tempfile.gettempdir() if where is None else where)
    sweep(parent, prefix)
    made = tempfile.TemporaryDirectory(prefix=prefix, dir=where, ignore_cleanup_errors=True)
    with made as name, FileLock(Path(name) / HELD):
        yield Path(name)


def sweep(parent: Path, prefix: str) -> None:
    """Remove temporary folders whose process was killed."""
    for folder in parent.glob(f"{prefix}*"):
        lock = folder / HELD
        try:
            old = time.time() - lock.stat().st_mtime > NEW_S
            if old:
                with FileLock(lock, timeout=0):
                    shutil.rmtree(folder, ignore_errors=True)
        except (OSError, Timeout):  # it has no lock, is in use, or belongs to somebody else
            continue


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path`, whole or not at all."""
    with atomic(path) as temporary:
        # A name in the text may not be UTF-8.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def is_newer(path: Path, than: Path) -> bool:
    """Return True if `path` is a file that was written after `than`."""
    return path.is_file() and path.stat().st_mtime_ns > than.stat().st_mtime_ns


def write_if_changed(path: Path, text: str) -> None:
    """Write `text` to `path` unless the file has it already."""
    if not path.is_file() or path.read_text(encoding="utf-8", errors="replace") != text:
        write_text(path, text)


def write_table(path: Path, frame: "pd.DataFrame", **options: str) -> None:
    """Write `frame` as a csv file, whole or not at all.

    options: those of DataFrame.to_csv
    """
    write_text(path, frame.to_csv(index=False, **options))


def check_file(path: Path | str, remedy: str = "give a file") -> None:
    """Check that a path is a file, or does not exist.

    Raises: InputError for a folder, pipe or device, which would be read for ever
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(f"{path}: is not a file; {remedy}")


def check_name(path: Path | str) -> None:
    """Check that a path is text, which SUMO and netCDF need.

    Raises: InputError for a name that is not UTF-8
    """
    absolute = os.path.abspath(path)
    try:
        absolute.encode()
    except UnicodeEncodeError:
        raise InputError(
            f"{absolute}: the name is not UTF-8, and SUMO and netCDF cannot open it; rename the "
            "file or folder"
        ) from None


def file_hash(path: Path) -> str:
    """Return a fingerprint of the bytes of a file.

    Raises: InputError if it is not a file
    """
    check_file(path)
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]


def relative(path: Path, folder: Path) -> str:
    """Return `path` relative to `folder`, with / between its parts.

    On another drive of Windows, return the absolute path.
    """
    try:
        return Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:
        return path.absolute().as_posix()


def file_name(name: str) -> str:
    """Return `name` as a file name: word characters, dots and hyphens."""
    return re.sub(r"[^\w.-]+", "-", name)


def parts_of(text: str, sign: str = ",") -> list[str]:
    """Return the parts of a text between signs outside of parentheses.

    >>> parts_of("no-control, pi-gating(kp=2.0, ki=0.1)")
    ['no-control', 'pi-gating(kp=2.0, ki=0.1)']
    """
    parts = re.split(rf"{re.escape(sign)}(?![^(]*\))", text)
    return [part.strip() for part in parts]


def run_name(controller: str, seed: int) -> str:
    """Return the stem of the file of a run.

    The controller may be path/to/file.py:Class.
    """
    return f"{quote(controller, safe='+,-._ ()=')}-{seed}"


def folder_of(name: str, command: str, out: Path | str | None) -> Path:
    """Return the folder `out` or, if it is None, runs/NAME-COMMAND."""
    if out is None:
        return Path("runs", f"{file_name(name)}-{command}")
    return Path(out)


def path_of(file: Path | str | None) -> Path | None:
    """Return a file or folder that a user may have given."""
    return None if file is None else Path(file)


def default_folder(scenario: str) -> Path:
    """Return runs/<scenario>-<timestamp>, a name that is not taken.

    scenario: its name
    """
    stem = f"{file_name(scenario)}-{datetime.now():%Y%m%d-%H%M%S}"
    folder = Path("runs", stem)
    number = 1
    while folder.exists():
        number += 1
        folder = Path("runs", f"{stem}-{number}")
    return folder
