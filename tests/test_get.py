"""cosim get, against a server of our own: content, hashes, licences, and what is left when it fails."""

import hashlib
import io
import tarfile
import threading
import zipfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest
from commands import cosim, error_line, good

from cosim.importing import catalogue, download
from cosim.importing.catalogue import Published

CONTENT = {
    "top-1/city/city.sumocfg": b"<configuration/>",
    "top-1/city/in/city.net.xml": b"<net/>",
    "top-1/README": b"-",
    "top-1/city/../../../escaped": b"out",
}


def zipped(content) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as packed:
        for name, text in content.items():
            packed.writestr(zipfile.ZipInfo(name), text)
    return out.getvalue()


def tarred(content) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as packed:
        for name, text in content.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(text)
            packed.addfile(entry, io.BytesIO(text))
        link = tarfile.TarInfo("top-1/city/passwd")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        packed.addfile(link)
    return out.getvalue()


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


@pytest.fixture
def publish(tmp_path, monkeypatch):
    """Puts an archive on a server, and the city `there` into the catalogue; returns its address."""
    folder = tmp_path / "server"
    folder.mkdir()
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()

        def put(content: bytes, **changes):
            (folder / "city.pack").write_bytes(content)
            fields = dict(
                about="a city",
                owner="https://example.org",
                licence="MIT, by its authors",
                folder="top-1/city",
                address=f"http://127.0.0.1:{server.server_port}/city.pack",
                start="city.sumocfg --regions 2",
            )
            city = Published(**{**fields, **changes})
            monkeypatch.setitem(catalogue.CITIES, "there", city)
            return city.address

        yield put
        server.shutdown()


@pytest.mark.parametrize("pack", [zipped, tarred])
def test_only_the_city_s_folder_comes_with_its_licence(publish, tmp_path, monkeypatch, pack):
    monkeypatch.chdir(tmp_path)
    publish(pack(CONTENT), sha256=hashlib.sha256(pack(CONTENT)).hexdigest() if pack is zipped else None)
    said = good(cosim("get", "there"))
    there = tmp_path / "cities" / "there"
    found = {str(file.relative_to(there)) for file in there.rglob("*") if not file.is_dir()}
    assert found == {"city.sumocfg", "in/city.net.xml", "NOTICE.cosim.txt"}
    assert (there / "in" / "city.net.xml").read_bytes() == b"<net/>"
    assert "Licence: MIT, by its authors" in said and "Licence: MIT" in (there / "NOTICE.cosim.txt").read_text()
    assert "cosim import cities/there/city.sumocfg --regions 2 --out networks/there" in said
    assert not list(tmp_path.rglob("escaped"))
    assert "exists; choose another folder" in error_line(cosim("get", "there"))


def test_a_hash_that_nobody_publishes_is_that_of_the_first_download(publish, tmp_path):
    address = publish(zipped(CONTENT))
    assert "recorded in" in good(cosim("get", "there", "--out", tmp_path / "all" / "first"))
    record = tmp_path / "all" / download.RECORD
    assert record.read_text() == f"{hashlib.sha256(zipped(CONTENT)).hexdigest()}  {address}\n"
    assert "the same as when it was first fetched" in good(cosim("get", "there", "--out", tmp_path / "all" / "second"))
    publish(zipped({**CONTENT, "top-1/city/more": b"more"}))
    assert f"{record} says" in error_line(cosim("get", "there", "--out", tmp_path / "all" / "third"))
    assert not (tmp_path / "all" / "third").exists()
    record.write_text("nonsense")
    assert "expected a hash and an address per line" in error_line(
        cosim("get", "there", "--out", tmp_path / "all" / "third")
    )


@pytest.mark.parametrize(
    ("content", "changes", "expected"),
    [
        (zipped(CONTENT), {"sha256": "0" * 64}, "its publisher says 000"),
        (zipped(CONTENT), {"address": "http://127.0.0.1:1/city.zip"}, "cannot be fetched"),
        (zipped(CONTENT), {"folder": "top-1/other"}, "has no folder top-1/other"),
        (zipped(CONTENT)[:80], {}, "is no .zip or .tar.gz"),
        (tarred(CONTENT)[:80], {}, "is no .zip or .tar.gz"),
    ],
    ids=("hash", "address", "folder", "zip", "tar"),
)
def test_one_line_and_nothing_left(publish, tmp_path, content, changes, expected):
    publish(content, **changes)
    assert expected in error_line(cosim("get", "there", "--out", tmp_path / "mine" / "there"))
    assert not [file for file in tmp_path.rglob("*") if "mine" in file.parts and not file.is_dir()]


def test_the_list_and_the_names():
    said = good(cosim("get"))
    for name, city in catalogue.CITIES.items():
        assert name in said and city.licence in said and city.owner in said
        assert city.address.startswith("https://")
    assert "did you mean cologne8?" in error_line(cosim("get", "colone8"))
