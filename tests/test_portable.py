"""Linux, Windows, macOS: texts have an encoding, files names that every system takes."""

import ast
import re
import subprocess

import pytest
from copies import ROOT

from nmfd.runs import files

RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?|.*[. ]", re.IGNORECASE)  # on Windows


def without_encoding(source: str) -> list[int]:
    """Lines that read or write a text in whatever encoding the system has."""
    found = []
    for call in ast.walk(ast.parse(source)):
        if not isinstance(call, ast.Call) or "encoding" in (
            keyword.arg for keyword in call.keywords
        ):
            continue
        of = getattr(getattr(call.func, "value", None), "id", "")
        match getattr(call.func, "attr", getattr(call.func, "id", "")):
            case "read_text" | "write_text":
                if of and of != "files":  # nmfd.runs.files: always UTF-8
                    found.append(call.lineno)
            case "open" | "fdopen" | "TemporaryFile" as name:
                if name == "TemporaryFile" and not call.args:  # binary
                    continue
                method = name == "open" and isinstance(
                    call.func, ast.Attribute
                )  # of a path: the mode comes first
                words = call.args[not method and name != "TemporaryFile" :] + [
                    keyword.value for keyword in call.keywords if keyword.arg == "mode"
                ]
                mode = words[0] if words else ast.Constant("r")
                if (
                    isinstance(mode, ast.Constant)
                    and isinstance(mode.value, str)
                    and "b" not in mode.value
                ):
                    found.append(call.lineno)
    return found


def test_what_is_looked_for():
    assert without_encoding(
        "p.write_text(x)\np.read_text()\nopen(p)\np.open('w')\nos.fdopen(n, 'w')"
    ) == [*range(1, 6)]
    assert not without_encoding(
        "p.read_text(encoding='utf-8')\nopen(p, 'rb')\nos.open(p, 0)\np.open(mode='wb')"
    )


@pytest.mark.parametrize("package", ["nmfd", "cosim"])
def test_every_text_has_an_encoding(package):
    found = {
        str(file): lines
        for file in (ROOT / package).rglob("*.py")
        if (lines := without_encoding(file.read_text(encoding="utf-8")))
    }
    assert not found


def test_every_system_takes_the_names_of_all_files():
    names = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True
    ).stdout.decode()
    paths = [name for name in names.split("\0") if name]
    bad = [
        path
        for path in paths
        if re.search(r'[<>:"|?*\\]', path)
        or not path.isascii()
        or len(path) > 120
        or any(RESERVED.fullmatch(part) for part in path.split("/"))
    ]
    assert paths
    assert not bad
    assert len({path.lower() for path in paths}) == len(paths), "names that differ in case only"


def test_where_no_way_leads_from_one_folder_to_another(monkeypatch):
    assert (
        files.relative(ROOT / "networks" / "grid7", ROOT / "scenarios" / "mine")
        == "../../networks/grid7"
    )

    def two_drives(path, start):
        raise ValueError("path is on mount 'C:', start on mount 'D:'")

    monkeypatch.setattr("os.path.relpath", two_drives)
    assert files.relative(ROOT / "networks", ROOT / "scenarios") == (ROOT / "networks").as_posix()
