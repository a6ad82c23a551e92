"""cosim get: a city from an archive of its publisher, whole or not at all."""

import io
import subprocess
import zipfile
from pathlib import Path

import pytest
from commands import cosim, error_line, good

from cosim.importing import get
from nmfd.errors import InputError


def zipped(files: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as packed:
        for name, content in files.items():
            packed.writestr(name, content)
    return stream.getvalue()


CONTENT = zipped(
    {"top-1/city/a.sumocfg": b"city", "top-1/city/more/b.xml": b"more", "top-1/other.txt": b"other"}
)


@pytest.fixture
def publish(monkeypatch, tmp_path):
    """publish(content, source) adds a city "there" with this archive."""

    def add(content: bytes = CONTENT, source: str | None = None):
        (tmp_path / "archive.zip").write_bytes(content)
        source = source or (tmp_path / "archive.zip").as_uri()
        city = dict(
            about="a city", licence="MIT", sources=[source], folder="top-1/city", start="a.sumocfg"
        )
        monkeypatch.setattr(get, "published", lambda: {"there": city})

    return add


def test_a_city_comes_with_its_licence(publish, tmp_path):
    publish()
    text = get.get("there", tmp_path / "mine" / "there")
    folder = tmp_path / "mine" / "there"
    assert (folder / "a.sumocfg").read_bytes() == b"city"
    assert (folder / "more" / "b.xml").read_bytes() == b"more"
    assert "Licence: MIT" in text
    assert "Licence: MIT" in (folder / "NOTICE.cosim.txt").read_text()
    assert f"cosim import {folder / 'a.sumocfg'} --out networks/there" in text
    assert [path.name for path in folder.parent.iterdir()] == ["there"]
    with pytest.raises(InputError, match="exists; choose another folder"):
        get.get("there", folder)


def test_a_package_comes_from_pip(publish, tmp_path, monkeypatch):
    publish(source="package==1.0")

    def download(command, **_):
        assert command[1:4] == ["-m", "pip", "download"]
        assert command[-1] == "package==1.0"
        (Path(command[-2]) / "package.whl").write_bytes(CONTENT)

    monkeypatch.setattr(subprocess, "run", download)
    get.get("there", tmp_path / "there")
    assert (tmp_path / "there" / "a.sumocfg").read_bytes() == b"city"


@pytest.mark.parametrize(
    ("content", "source", "expected"),
    [
        (CONTENT, "http://127.0.0.1:1/city.zip", "cannot be fetched"),
        (zipped({"top-1/other.txt": b""}), None, "top-1/city of .* cannot be fetched"),
        (CONTENT[:80], None, "is not a zip file"),
    ],
    ids=("address", "folder", "zip"),
)
def test_one_line_and_nothing_left(publish, tmp_path, content, source, expected):
    publish(content, source)
    with pytest.raises(InputError, match=expected):
        get.get("there", tmp_path / "mine" / "there")
    assert not list((tmp_path / "mine").iterdir())


def test_the_list_and_the_names():
    text = good(cosim("get"))
    for name, city in get.published().items():
        assert name in text
        assert city["licence"] in text
    assert "did you mean cologne8?" in error_line(cosim("get colone8"))
