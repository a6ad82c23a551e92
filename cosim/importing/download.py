"""A city of the catalogue, fetched whole or not at all."""

import gzip
import hashlib
import http.client
import os
import tarfile
import urllib.request
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from cosim.importing.catalogue import CITIES, Published
from nmfd.errors import InputError, did_you_mean
from nmfd.runs import files
from nmfd.runs.files import temporary_folder

RECORD = "SHA256SUMS"  # beside the cities: a line per address, as sha256sum writes them
PATIENCE = 60.0  # s without a byte
BLOCK = 1 << 20  # bytes


def get(name: str, out: Path, tell: Callable[[str], None] = lambda stage: None) -> str:
    """Fetch the city `name` into the new folder `out`; returns what to know about it. Raises InputError, and leaves
    nothing: for an unknown name, a folder that is there, no network, and content that has another hash than it should
    or had when its address was first fetched."""
    if name not in CITIES:
        raise InputError(
            f"cosim get: expected one of {', '.join(CITIES)}, got {name!r} instead" + did_you_mean(name, CITIES)
        )
    city = CITIES[name]
    if out.exists():
        raise InputError(f"--out: {out} exists; choose another folder, or remove it")
    record = out.parent / RECORD
    expected = city.sha256 or _recorded(record).get(city.address)
    with temporary_folder() as fetched:
        archive = fetched / "archive"
        found = _fetch(name, city, archive, tell)
        if expected not in (None, found):
            who = "its publisher says" if city.sha256 else f"{record} says"
            raise InputError(
                f"{name}: {city.address} has sha256 {found}, and {who} {expected}: it is not what it was; "
                f"nothing was kept, ask {city.owner}"
            )
        how = (
            "checked against its publisher's"
            if city.sha256
            else f"the same as when it was first fetched, by {record}"
            if expected
            else f"published nowhere: recorded in {record}, and later downloads are checked against it"
        )
        notice = (
            f"{name}: {city.about}\nLicence: {city.licence}\nOwner: {city.owner}\nFetched from {city.address}\n"
            f"sha256 {found}, {how}\n"
        )
        tell("unpacking")
        out.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(f".{out.name}-", where=out.parent) as scratch:
            count = _unpack(name, city, archive, scratch / "city")
            (scratch / "city" / "NOTICE.cosim.txt").write_text(notice, encoding="utf-8")
            os.replace(scratch / "city", out)
        if expected is None:
            known = {**_recorded(record), city.address: found}
            files.write_text(record, "".join(f"{value}  {address}\n" for address, value in known.items()))
    return f"{notice}{count} files in {out}. Next: cosim import {out / city.start} --out networks/{name}"


def _recorded(record: Path) -> dict[str, str]:
    """address -> sha256. Raises InputError."""
    try:
        lines = record.read_text(encoding="utf-8").splitlines()
        return {address: value for value, address in (line.split() for line in lines)}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{record}: expected a hash and an address per line ({error}); correct or remove it") from None


def _fetch(name: str, city: Published, target: Path, tell: Callable[[str], None]) -> str:
    """The hash of what came from the city's address and is in `target` now."""
    request = urllib.request.Request(city.address, headers={"User-Agent": "perimeter-cosim"})
    digest, size = hashlib.sha256(), 0
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE) as source, target.open("wb") as stream:
            length = source.headers.get("Content-Length")
            while block := source.read(BLOCK):
                stream.write(block)
                digest.update(block)
                size += len(block)
                tell(f"{size / 1e6:.0f} MB")
            if length is not None and size < int(length):
                raise ConnectionError(f"{size} of {length} bytes came")
    except (OSError, http.client.HTTPException) as error:
        raise InputError(
            f"{name}: {city.address} cannot be fetched ({error}); try again with a network, or unpack a "
            f"copy by hand: see {city.owner}"
        ) from None
    return digest.hexdigest()


def _unpack(name: str, city: Published, archive: Path, target: Path) -> int:
    """Write the files of the city's folder in the archive below `target`; returns how many."""
    count, folder = 0, PurePosixPath(city.folder)
    try:
        for path, stream in _members(archive):
            inside = PurePosixPath(path)
            if folder in inside.parents and ".." not in inside.parts:
                file = target / inside.relative_to(folder)
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(stream.read())
                count += 1
    except (zipfile.BadZipFile, tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise InputError(
            f"{name}: {city.address} is no .zip or .tar.gz that can be read ({error}); ask {city.owner}"
        ) from None
    if not count:
        raise InputError(f"{name}: {city.address} has no folder {city.folder}; ask {city.owner}")
    return count


def _members(archive: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """Name and content of every file."""
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as packed:
            for entry in packed.infolist():
                if not entry.is_dir():
                    with packed.open(entry) as stream:
                        yield entry.filename, stream
        return
    with tarfile.open(archive) as tape:
        for member in tape:
            if member.isfile() and (content := tape.extractfile(member)):
                yield member.name, content


def listed() -> str:
    """The catalogue, a city with its licence and owner on two lines."""
    return "\n".join(f"{name:<14}{city.about}\n{'':<14}{city.licence}; {city.owner}" for name, city in CITIES.items())
