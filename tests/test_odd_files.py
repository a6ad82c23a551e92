"""Files and names that are no files, no text, or cannot be written to: one clear line each, and nothing waits."""

import os
import shutil
import socket
from pathlib import Path

import pytest
import tiny
from commands import cosim, error_line, nmfd

from cosim.evaluation import experiment
from cosim.sumo.xml_files import read_xml
from nmfd.api import load_scenario
from nmfd.controllers import custom, open_loop
from nmfd.controllers.dpc import policy_file
from nmfd.errors import InputError
from nmfd.runs import files, run_folder

COMMAND = ("benchmark", "scenario", "--controllers", "no-control", "--out")


@pytest.fixture
def place(tmp_path, monkeypatch):
    tiny.write(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fifo(path):
    os.mkfifo(path)


def device(path):
    path.symlink_to("/dev/zero")


def unix_socket(path):
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name if path.parent == Path() else os.path.relpath(path))


def loop(path):
    path.symlink_to(path.name)


KINDS = {
    fifo: "is a pipe, no file",
    device: "is a device, no file",
    unix_socket: "is a socket, no file",
    Path.mkdir: "is a folder, no file",
    loop: "symbolic link",
}


@pytest.mark.parametrize("make", KINDS)
@pytest.mark.parametrize("file", ["scenario/scenario.toml", "network/network.toml"])
def test_what_is_no_file(place, make, file):
    Path(file).unlink()
    make(Path(file))
    line = error_line(nmfd(*COMMAND, "out"), "nmfd")
    assert Path(file).name in line and KINDS[make] in line and not Path("out").exists()


def test_whatever_is_read_is_no_pipe(place):
    """None of these waits for somebody to write into it."""
    scenario, pipe = load_scenario("scenario"), place / "pipe"
    fifo(pipe)
    for suffix in (".py", ".xml", ".nc"):
        fifo(pipe.with_suffix(suffix))
    for read in (
        lambda: files.file_hash(pipe),
        lambda: files.read_rows(pipe, {"a": int}),
        lambda: run_folder.read_manifest(pipe),
        lambda: run_folder.read_trajectory(pipe.with_suffix(".nc")),
        lambda: policy_file.load_policy(pipe, scenario.network),
        lambda: open_loop.read(pipe, scenario, guidance=False),
        lambda: custom.check("pipe.py:Mine"),
        lambda: experiment.read_facts(pipe),
        lambda: read_xml(pipe.with_suffix(".xml")),
    ):
        with pytest.raises(InputError, match="is a pipe, no file"):
            read()
    Path("scenario/scenario.toml").write_text(
        tiny.SCENARIO.replace("[[demand]]", 'demand_file = "../pipe"\n\n[[demand]]', 1), encoding="utf-8"
    )
    assert "is a pipe, no file" in error_line(nmfd(*COMMAND, "out"), "nmfd")


@pytest.mark.parametrize(
    "content, expected",
    [
        (b"steps = " + b"9" * 5000, "a number of thousands of digits"),
        (b"steps = -" + b"9" * 5000, "a number of thousands of digits"),
        (tiny.SCENARIO.replace("step = 30.0", "step = 1e999").encode(), "step: should be a finite number"),
        (b'name = "\xff"', "is not UTF-8"),
        (b"\xff\xfe" + tiny.SCENARIO.encode("utf-16-le"), "is not UTF-8"),
        (b'name = "\0"', "is not valid TOML"),
        (b"", "missing"),
        (b"\0" * 100, "is not valid TOML"),
        (b"a = " + b"[" * 100_000, "nested too deeply|is not valid TOML"),
        (b"a = " + b"{b = " * 20_000, "nested too deeply|is not valid TOML"),
        (b"a" + b".a" * 100_000 + b" = 1", "unknown key|is not valid TOML"),
        (b"[" + b"a." * 2000 + b"a]", "unknown key|is not valid TOML"),
    ],
    ids=range(12),
)
def test_what_is_no_scenario(place, content, expected):
    Path("scenario/scenario.toml").write_bytes(content)
    line = error_line(nmfd(*COMMAND, "out"), "nmfd")
    assert "scenario.toml: " in line and any(part in line for part in expected.split("|")) and len(line) < 800, line


@pytest.mark.parametrize(
    "out, expected",
    [
        (os.fsdecode(b"o\xff"), "o?: is not UTF-8 text"),
        ("a\0b", "holds a zero byte"),
        ("x" * 300, "File name too long"),
        ("/dev/full", "is a file; choose another"),
        ("/dev/full/x", "Not a directory"),
        ("pipe", "is a file"),
        ("loop", "loop"),
        ("/proc/x", "/proc/x: "),
        ("\x1b[2Jx/" + "y" * 300, "?[2Jx/"),
    ],
)
def test_places_that_cannot_be_written_to(place, out, expected):
    fifo(Path("pipe"))
    loop(Path("loop"))
    before = {path for path in Path().rglob("*") if "runs" not in path.parts}
    assert expected in error_line(nmfd(*COMMAND, out), "nmfd")
    assert {path for path in Path().rglob("*") if "runs" not in path.parts} == before


def test_names_that_are_no_text(place):
    odd = os.fsdecode(b"s\xff")
    shutil.copytree("scenario", odd)
    for program in (nmfd, cosim):
        result = program("show" if program is nmfd else "report", odd)
        assert result.exit_code == 2 and "s?: is not UTF-8 text; choose another name" in result.stderr


def test_a_full_disk_is_one_line(place, monkeypatch):
    """What is written does not fit: nothing is left half-written."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert "No space left on device" in error_line(nmfd(*COMMAND, "out"), "nmfd")
    assert not Path("out").exists()
